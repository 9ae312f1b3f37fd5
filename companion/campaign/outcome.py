"""What became of a flight, in one row: the measures that a study compares, and the course of the error over time."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.campaign import kernel
from companion.campaign.study import Study, Value
from companion.campaign.whole import Case, Whole
from companion.control.certificate import certify
from companion.control.law import LIMIT_ROLL_PITCH_RATE, LIMIT_THRUST_MAX, LIMIT_THRUST_MIN, LIMIT_YAW_RATE
from companion.errors import CompanionError

FloatArray = NDArray[np.float64]
BINS: Final = 120
"""Pieces of the flight of which the largest error is kept."""

FLOWN, DIVERGED, GROUND, RAISED = "flown", "diverged", "ground", "raised"


class Measure(NamedTuple):
    """One number of the outcome."""

    unit: str
    meaning: str


MEASURES: Final[dict[str, Measure]] = {
    "settled_at_s": Measure("s", "time on the trajectory after which the error stays below the bound"),
    "rms_m": Measure("m", "rms of the position error after settling"),
    "p95_m": Measure("m", "95 % of the position errors after settling are below this"),
    "max_m": Measure("m", "largest position error after settling"),
    "track_rms_m": Measure("m", "rms of the position error over the whole trajectory"),
    "error_max_m": Measure("m", "largest position error of the flight"),
    "vertical_rms_m": Measure("m", "rms of the vertical error after settling"),
    "heading_rms_rad": Measure("rad", "rms of the heading error after settling"),
    "thrust_min_n": Measure("N", "least thrust of the law"),
    "thrust_max_n": Measure("N", "greatest thrust of the law"),
    "tilt_max_rad": Measure("rad", "greatest tilt"),
    "thrust_limited_s": Measure("s", "time with the thrust at a limit"),
    "rate_limited_s": Measure("s", "time with a commanded body rate cut"),
    "saturated_s": Measure("s", "time with any of both"),
    "bounded_s": Measure("s", "time with the position error beyond p_max"),
    "actuation_rad_s2": Measure("rad/s^2", "rms of the commanded angular acceleration after settling"),
    "disturbance_error_m_s2": Measure("m/s^2", "distance of the last estimate from the mean disturbance"),
    "flown_s": Measure("s", "length of the flight"),
}
"""The numbers of an outcome; NaN where one does not exist."""


class Outcome(NamedTuple):
    """One flight of a study."""

    number: int
    seed: int
    values: dict[str, Value]
    ended: str
    """FLOWN, DIVERGED, GROUND or RAISED."""
    reason: str
    """In words, for flights that did not converge; else empty."""
    converged: bool
    certified: bool
    measures: dict[str, float]
    error_m: NDArray[np.float32]
    """Largest error of each of BINS pieces of the planned time, NaN where it was not flown."""


def fly_number(study: Study, number: int, engine: str) -> Outcome:
    """Fly one flight of a study; whatever goes wrong in it is its outcome."""
    from companion.campaign.whole import fly

    values, seed = study.values(number), study.flight_seed(number)
    try:
        case = study.case(number)
        parameters = case.flight.vehicle.parameters()
        certified = certify(parameters.gains, parameters.model.drag).failure() is None
        return measured(study, number, case, fly(case, engine), certified)
    except (CompanionError, ArithmeticError, ValueError) as error:
        return _raised(number, seed, values, " ".join(str(error).split()))


def _raised(number: int, seed: int, values: dict[str, Value], reason: str) -> Outcome:
    nothing = np.full(BINS, np.nan, dtype=np.float32)
    return Outcome(number, seed, values, RAISED, reason, False, False, dict.fromkeys(MEASURES, math.nan), nothing)


def measured(study: Study, number: int, case: Case, flown: Whole, certified: bool) -> Outcome:
    """The outcome of a flight that was flown."""
    rows, track_s = flown.rows, flown.track_s
    error = np.sqrt((rows[:, kernel.ERROR] ** 2).sum(axis=1))
    on_track = (track_s >= 0.0) & (track_s <= flown.course.track_s)
    below = study.file.converged.below_m
    complete = flown.ended == kernel.FLOWN
    settled_at_s = _settled_at_s(track_s[on_track], error[on_track], below) if complete else math.nan
    given_s = case.flight.statistics_from_s
    from_s = settled_at_s + study.file.converged.statistics_after_s if given_s is None else given_s
    window = on_track & (track_s >= from_s)  # empty where it never settled
    interval_s = float(track_s[1] - track_s[0]) if len(track_s) > 1 else 0.0
    limits = rows[:, kernel.LIMITS].astype(np.int64)
    thrust_limited = limits & (LIMIT_THRUST_MIN | LIMIT_THRUST_MAX) != 0
    rate_limited = limits & (LIMIT_ROLL_PITCH_RATE | LIMIT_YAW_RATE) != 0
    tau = np.sqrt((rows[:, kernel.TAU] ** 2).sum(axis=1))
    heading = rows[window, kernel.HEADING_ERROR]
    p_max = case.flight.vehicle.controller.position_error_max_m
    last = rows[-1, kernel.B_HAT] if len(rows) else np.full(3, np.nan)
    settled = math.isfinite(settled_at_s)
    measures = {
        "settled_at_s": settled_at_s,
        "rms_m": _rms(error[window]),
        "p95_m": float(np.percentile(error[window], 95.0)) if window.any() else math.nan,
        "max_m": _most(error[window]),
        "track_rms_m": _rms(error[on_track]),
        "error_max_m": _most(error),
        "vertical_rms_m": _rms(rows[window, 2]),
        "heading_rms_rad": _rms(heading[np.isfinite(heading)]),
        "thrust_min_n": -_most(-rows[:, kernel.THRUST]),
        "thrust_max_n": _most(rows[:, kernel.THRUST]),
        "tilt_max_rad": float(np.arccos(np.clip(-_most(-rows[:, kernel.TILT_COSINE]), -1.0, 1.0))),
        "thrust_limited_s": float(thrust_limited.sum()) * interval_s,
        "rate_limited_s": float(rate_limited.sum()) * interval_s,
        "saturated_s": float((thrust_limited | rate_limited).sum()) * interval_s,
        "bounded_s": float((rows[:, kernel.E1_SQUARED] > p_max * p_max).sum()) * interval_s,
        "actuation_rad_s2": _rms(tau[window if window.any() else on_track]),
        "disturbance_error_m_s2": float(np.linalg.norm(last - np.array(flown.disturbance_m_s2))),
        "flown_s": float(flown.time_s[-1]) if len(rows) else 0.0,
    }
    ended = (FLOWN, DIVERGED, GROUND)[flown.ended]
    reason = _reason(ended, flown, error, below, settled)
    return Outcome(
        number,
        case.flight.world.seed,
        study.values(number),
        ended,
        reason,
        settled,
        certified,
        measures,
        _course_of(flown, error, case),
    )


def _settled_at_s(track_s: FloatArray, error: FloatArray, below_m: float) -> float:
    """As `record.summary` has it."""
    outside = np.flatnonzero(~(error < below_m))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(track_s[first]) if first < len(error) else math.nan


def _reason(ended: str, flown: Whole, error: FloatArray, below_m: float, settled: bool) -> str:
    at_s = float(flown.time_s[-1]) if len(flown.time_s) else 0.0
    if ended == DIVERGED:
        last = float(error[-1])
        return (
            f"the position error reached {last:.4g} m at {at_s:.2f} s"
            if math.isfinite(last)
            else (f"a number became infinite at {at_s:.2f} s")
        )
    if ended == GROUND:
        return f"touched the ground at {at_s:.2f} s"
    if settled:
        return ""
    if at_s < flown.course.join_s:
        return f"it ended at {at_s:.2f} s, while the trajectory was still being joined ({flown.course.join_s:.2f} s)"
    return f"the error was {float(error[-1]):.3g} m at the end and did not stay below {below_m:g} m"


def _course_of(flown: Whole, error: FloatArray, case: Case) -> NDArray[np.float32]:
    planned_s = min(flown.course.duration_s, case.duration_s)
    found = np.full(BINS, -np.inf)
    place = np.minimum((flown.time_s * (BINS / planned_s)).astype(np.intp), BINS - 1)
    np.maximum.at(found, place, error)
    found[np.isneginf(found)] = np.nan
    return found.astype(np.float32)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values * values))) if len(values) else math.nan


def _most(values: FloatArray) -> float:
    return float(values.max()) if len(values) else math.nan


def as_row(outcome: Outcome) -> dict[str, Any]:
    """For people and JSON: one flat dictionary, without the error's course; numbers that do not exist are None."""
    numbers = {key: value if math.isfinite(value) else None for key, value in outcome.measures.items()}
    head = {"flight": outcome.number, "seed": outcome.seed, **outcome.values}
    return head | {
        "ended": outcome.ended,
        "reason": outcome.reason,
        "converged": outcome.converged,
        "certified": outcome.certified,
        **numbers,
    }
