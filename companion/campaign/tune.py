"""Searches gains: certified ones with enough delay margin that fly a study's disturbances best.

A candidate first passes the gates that every flight passes, over the setpoints that the study's flight sends, and more
delay margin than those ask for; only then it flies. All candidates fly the same flights, noise and gusts included, so
that they differ by their gains alone. The search is scipy's differential evolution over the logarithms of the gains: it
needs no derivatives and bears the jumps of a flight that is lost. What it finds is then flown, beside the gains of
before, in flights that the search has not seen.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.campaign import worker
from companion.campaign.engines import cores
from companion.campaign.outcome import measured
from companion.campaign.study import Study, from_json
from companion.campaign.whole import fly
from companion.config import Vehicle
from companion.control.certificate import certify, disturbance_overcome
from companion.control.sampled import DELAY_STRIDE_S, INTERVAL_STRIDE_S
from companion.errors import CompanionError, InputError, RefusedError
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S, loop_margins

FloatArray = NDArray[np.float64]

GAINS: Final = ("k1_1_s", "k2", "k3_1_s", "k4_1_s", "gamma_1_s3")
"""What is searched; p_max follows from them, see `p_max_of`."""
REACH: Final = 4.0
"""Gains are looked for within this factor of the vehicle's own, unless the study spreads them itself."""
OVERCOME: Final = 1.03
"""The bounded position error holds against this much more than the largest disturbance."""
LOST: Final = 2.0
"""What a flight that does not converge costs beside its error: as much as an error exp(2) = 7.4 times as large."""
UNFIT: Final = 100.0
"""Cost of gains that no flight would be allowed with, and more the further off they are."""
POPULATION: Final = 8
"""Candidates per gain and generation."""
GOLDEN: Final = 0.5 * (math.sqrt(5.0) - 1.0)
"""Steps of this share of a whole, round and round, lie evenly in it wherever they end."""
STEP: Final = 1.25
"""By this factor each gain is changed in the end, to tell what stands in the way of more."""


class Wish(NamedTuple):
    """What is asked of the gains."""

    delay_margin_s: float
    """At least; below what every flight is asked for, that counts."""
    flights: int
    """Of the study that every candidate flies."""
    actuation_weight: float
    """How much a factor in the actuation counts beside the same factor in the error."""

    @property
    def least_s(self) -> float:
        """The delay margin that counts [s]."""
        return max(self.delay_margin_s, DELAY_MARGIN_MIN_S)


class Score(NamedTuple):
    """How a gain set does."""

    cost: float
    """Lower is better; at least UNFIT where it is not allowed."""
    unfit: str
    """Why it is not allowed; empty where it is."""
    eigenvalue_min: float
    """The smallest of the certificate [1/s]."""
    delay_margin_s: float
    """As far as it was looked for."""
    rms_m: float
    """Geometric mean over the flights that converged."""
    actuation_rad_s2: float
    converged: int
    flights: int
    lost: str = ""
    """What became of the first flight that does not count as converged; empty where all do."""


@dataclass(frozen=True)
class Neighbour:
    """What one gain a step higher or lower would do."""

    gain: str
    factor: float
    score: Score


@dataclass(frozen=True)
class Tuned:
    """What the search found."""

    gains: dict[str, float]
    """By their keys in [controller], p_max among them."""
    before: dict[str, float]
    search: Score
    """In the flights of the search."""
    fresh: Score
    """In flights that the search has not seen."""
    fresh_before: Score
    """The gains of before in the same."""
    neighbours: list[Neighbour]
    evaluations: int
    output: str
    """What the law sends: the loop whose margins are judged."""


def p_max_of(vehicle: Vehicle, gains: Mapping[str, float]) -> float:
    """The smallest bound of the position error that overcomes the largest disturbance with the estimator still [m].

    No larger: k1^2 k2 p_max is how hard the vehicle brakes and turns when it is far off.
    """
    k1, k2, k3, k4 = (gains[name] for name in GAINS[:4])
    share = 1.0 / (k1 * k1 * k2) + 1.0 / (k1 * (k1 * k2 + k3 + k4))
    return OVERCOME * vehicle.limits.disturbance_max_m_s2 * share


def complete(vehicle: Vehicle, values: Iterable[float]) -> dict[str, float]:
    """Gains in the order of GAINS as a [controller] has them, p_max among them; rounded as people write them."""
    gains = {name: float(f"{value:.3g}") for name, value in zip(GAINS, values, strict=True)}
    p_max = p_max_of(vehicle, gains)
    digits = 10.0 ** (math.floor(math.log10(p_max)) - 2)
    return gains | {"position_error_max_m": float(f"{math.ceil(p_max / digits) * digits:.3g}")}


def ranges(study: Study) -> list[tuple[float, float]]:
    """Low and high of each gain: the study's own spread, or around the vehicle's value."""
    found = []
    own = study.flight.vehicle.controller
    for name in GAINS:
        spread = study.spreads.get(f"controller.{name}")
        pair = None if spread is None else spread.uniform or spread.log_uniform or (spread.grid and spread.grid[:2])
        now = max(getattr(own, name), 0.05)
        low, high = pair if pair else (now / REACH, now * REACH)
        found.append((max(low, 0.02), min(high, 100.0)))
    return found


def flight_at(study: Study, place: int) -> int:
    """Which flight of a study the search takes in this place; in the first `study.total` places each one once.

    The flights of one point of a grid stand together: taken in their order, a few would all be of its lowest values.
    """
    if not study.grid:
        return place % study.total
    stride = max(1, round(GOLDEN * study.total))
    while math.gcd(stride, study.total) != 1:
        stride += 1
    return place * stride % study.total


def over_what(output: str) -> str:
    """Which loop it is whose margins are judged, by the setpoints that close it."""
    return "attitude setpoints" if output == "attitude" else "body rates"


def score(study_json: str, gains: Mapping[str, float], wish: Wish, first: int, engine: str) -> Score:
    """Judge a gain set: the gates, then the flights from the place `first` on, see `flight_at`."""
    study = from_json(study_json)
    changes = {f"controller.{name}": value for name, value in gains.items()}
    flight = study.case_with(flight_at(study, first), changes).flight
    vehicle, output = flight.vehicle, flight.output.by_law
    parameters = vehicle.parameters()
    found = certify(parameters.gains, parameters.model.drag)
    least = min(min(values) for values in found[:4])
    nothing = (math.nan, math.nan, 0, wish.flights)
    failure = found.failure()
    if failure is not None:
        return Score(2.0 * UNFIT - least, f"not certified: {failure}", least, math.nan, *nothing)
    overcome, ball = disturbance_overcome(parameters.gains), vehicle.limits.disturbance_max_m_s2
    if ball > overcome:
        words = f"a bounded position error that holds against {overcome:.2f} m/s^2, limits.disturbance_max_m_s2 is more"
        return Score(UNFIT * ball / overcome, words, least, math.nan, *nothing)
    gap_s, asked_s, over = vehicle.limits.state_gap_max_s, wish.least_s, over_what(output)
    loop = loop_margins(vehicle, output, asked_s + DELAY_STRIDE_S, gap_s + 1.5 * INTERVAL_STRIDE_S)
    if loop.delay_margin_s < asked_s:
        words = f"a delay margin of {loop.delay_margin_s * 1e3:.1f} ms over {over}, {asked_s * 1e3:g} ms are asked for"
        return Score(UNFIT * (1.0 + asked_s - loop.delay_margin_s), words, least, loop.delay_margin_s, *nothing)
    if loop.interval_max_s < gap_s:
        bears = f"a sampled loop over {over} that bears {loop.interval_max_s * 1e3:.0f} ms"
        words = f"{bears}, limits.state_gap_max_s is longer"
        return Score(UNFIT * (1.0 + gap_s - loop.interval_max_s), words, least, loop.delay_margin_s, *nothing)
    return _flown(study, changes, wish, first, engine, least, loop.delay_margin_s)


def _flown(
    study: Study, changes: Mapping[str, float], wish: Wish, first: int, engine: str, least: float, margin_s: float
) -> Score:
    cost, rms, actuation, converged, lost = 0.0, [], [], 0, ""
    for place in range(first, first + wish.flights):
        number = flight_at(study, place)
        case = study.case_with(number, changes)
        try:
            outcome = measured(study, number, case, fly(case, engine), True)
        except (CompanionError, ArithmeticError, ValueError) as error:
            cost += LOST + math.log(study.file.diverged_m)
            lost = lost or " ".join(str(error).split())
            continue
        m = outcome.measures
        effort = m["actuation_rad_s2"] if math.isfinite(m["actuation_rad_s2"]) else 1.0  # lost before the trajectory
        if outcome.converged and math.isfinite(m["rms_m"]) and effort > 0.0:
            converged += 1
            rms.append(math.log(m["rms_m"]))
            actuation.append(math.log(effort))
            cost += rms[-1] + wish.actuation_weight * actuation[-1]
        else:
            worst = m["error_max_m"] if math.isfinite(m["error_max_m"]) else study.file.diverged_m
            cost += LOST + math.log(max(worst, 1.0)) + wish.actuation_weight * math.log(max(effort, 1.0))
            lost = lost or outcome.reason or "it settled, but ended before its statistics begin"
    mean_rms = math.exp(sum(rms) / len(rms)) if rms else math.nan
    mean_actuation = math.exp(sum(actuation) / len(actuation)) if actuation else math.nan
    # the search would take NaN for the best that there is
    each, unfit = (cost / wish.flights, "") if math.isfinite(cost) else (UNFIT, "flights whose cost is no number")
    return Score(each, unfit, least, margin_s, mean_rms, mean_actuation, converged, wish.flights, lost)


def _score_of(task: tuple[str, dict[str, float], Wish, int, str]) -> Score:
    return score(*task)


def tune(
    study: Study,
    wish: Wish,
    engine: str,
    *,
    generations: int,
    workers: int | None = None,
    progress: Callable[[int, Score], None] = lambda evaluations, best: None,
) -> Tuned:
    """Search.

    Args:
        study: its flight gives vehicle and gains of before, its spreads the disturbances.
        wish: what is asked for.
        engine: "python" or "numba".
        generations: of the search, at most.
        workers: processes; None: one per core.
        progress: called after every generation with the number of gain sets judged, and the best one's score.

    Raises:
        InputError: the study has no flights beside those of the search.
        RefusedError: no gain set is allowed, or none flies.
    """
    from scipy.optimize import differential_evolution

    if study.total <= wish.flights:
        raise InputError(
            f"{study.source}: count: every candidate flies {wish.flights} flights, and of {study.total} none is left"
            " that the search has not seen; give more, or lower --flights"
        )
    text, vehicle = study.to_json(), study.flight.vehicle
    bounds: Any = [(math.log(low), math.log(high)) for low, high in ranges(study)]
    own = [max(getattr(vehicle.controller, name), 0.05) for name in GAINS]
    count = 0
    best = Score(math.inf, "nothing was judged", math.nan, math.nan, math.nan, math.nan, 0, wish.flights)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or cores(), mp_context=context, initializer=worker.begin) as pool:

        def judge(sets: list[dict[str, float]], first: int, flights: int) -> list[Score]:
            tasks = [(text, gains, wish._replace(flights=flights), first, engine) for gains in sets]
            return list(pool.map(_score_of, tasks))

        def together(_: Any, candidates: Iterable[FloatArray]) -> list[float]:
            nonlocal count, best
            scores = judge([complete(vehicle, np.exp(x)) for x in candidates], 0, wish.flights)
            count += len(scores)
            best = min([best, *scores], key=lambda s: s.cost)
            return [s.cost for s in scores]

        def told(*_: Any, **__: Any) -> None:
            progress(count, best)

        found = differential_evolution(
            _unused,
            bounds,
            x0=[min(max(math.log(x), low), high) for x, (low, high) in zip(own, bounds, strict=True)],
            maxiter=generations,
            popsize=POPULATION,
            rng=np.random.default_rng(study.file.seed),
            workers=together,
            updating="deferred",
            polish=False,
            init="sobol",
            tol=0.01,
            callback=told,
        )
        gains = complete(vehicle, np.exp(found.x))
        at = judge([gains], 0, wish.flights)[0]
        if at.unfit:
            raise RefusedError(
                f"no gain set of {count} is allowed for vehicle {vehicle.name!r}; the best has {at.unfit}: ask for less"
                " margin, or reduce the delay and the lags"
            )
        _refuse_lost(vehicle, at, "of the search")
        before = {name: float(getattr(vehicle.controller, name)) for name in gains}
        many = min(4 * wish.flights, study.total - wish.flights)
        fresh, fresh_before = judge([gains, before], wish.flights, many)
        _refuse_lost(vehicle, fresh, "that the search has not seen")
        steps = list(itertools.product(GAINS, (STEP, 1.0 / STEP)))
        changed = [complete(vehicle, [gains[n] * (f if n == name else 1.0) for n in GAINS]) for name, f in steps]
        scores = judge(changed, 0, wish.flights)
    neighbours = [Neighbour(name, factor, s) for (name, factor), s in zip(steps, scores, strict=True)]
    return Tuned(gains, before, at, fresh, fresh_before, neighbours, count, study.flight.output.by_law)


def _refuse_lost(vehicle: Vehicle, found: Score, which: str) -> None:
    """Gains with which every flight is lost are nobody's choice. Raises RefusedError."""
    if found.converged == 0:
        raise RefusedError(
            f"the best gain set for vehicle {vehicle.name!r} converges in none of {found.flights} flights {which} (the"
            f" first: {found.lost}): ease the study's disturbances, or fly them longer (duration_s)"
        )


def _unused(_: FloatArray) -> float:
    """What is minimised is computed for a whole generation at once, by `workers`."""
    raise AssertionError


def words(tuned: Tuned, wish: Wish) -> list[str]:
    """Why these gains, in sentences."""
    s, fresh, old = tuned.search, tuned.fresh, tuned.fresh_before
    said = [
        f"Certified: the smallest eigenvalue is {s.eigenvalue_min:.3g}, it must be above 0; the delay margin of"
        f" the loop over {over_what(tuned.output)} is at least {s.delay_margin_s * 1e3:.0f} ms,"
        f" {wish.least_s * 1e3:g} ms are asked for.",
        f"In {fresh.flights} flights that the search has not seen {fresh.converged} converge, with a position error of"
        f" {fresh.rms_m * 100:.2f} cm rms and {fresh.actuation_rad_s2:.2f} rad/s^2 of actuation (geometric means).",
    ]
    if old.unfit:
        said.append(f"The gains of before would not do: {old.unfit}.")
    elif old.converged:
        said.append(
            f"The gains of before: {old.converged} converge, {old.rms_m * 100:.2f} cm, {old.actuation_rad_s2:.2f}"
            f" rad/s^2; the error is {_change(fresh.rms_m, old.rms_m)}, the actuation"
            f" {_change(fresh.actuation_rad_s2, old.actuation_rad_s2)}."
        )
    else:
        said.append("With the gains of before none of them converges.")
    said += [_neighbour(n, s, wish) for n in tuned.neighbours]
    p_max = tuned.gains["position_error_max_m"]
    said.append(
        f"position_error_max_m = {p_max:g} m is the least that holds against limits.disturbance_max_m_s2 while the"
        " estimator stands still; more would only fly harder when far off."
    )
    return said


def _neighbour(n: Neighbour, at: Score, wish: Wish) -> str:
    up = "higher" if n.factor > 1.0 else "lower"
    begin = f"{n.gain} a quarter {up}: "
    if n.score.unfit:
        return begin + f"not allowed, {n.score.unfit}."
    if n.score.converged < at.converged:
        return begin + f"{at.converged - n.score.converged} of {at.flights} flights more are lost."
    if not at.converged:
        return begin + "no flight converges either."
    error, effort = _change(n.score.rms_m, at.rms_m), _change(n.score.actuation_rad_s2, at.actuation_rad_s2)
    verdict = "worse" if n.score.cost >= at.cost else "better, a longer search may get there"
    weight = f"{wish.actuation_weight:g}"
    return begin + f"the error is {error}, the actuation {effort}: {verdict} (actuation counts {weight} times as much)."


def _change(new: float, old: float) -> str:
    percent = 100.0 * (new / old - 1.0)
    if abs(percent) < 0.5:
        return "the same"
    return f"{abs(percent):.0f} % {'more' if percent > 0.0 else 'less'}"
