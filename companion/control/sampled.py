"""The margins of the sampled loop: how much more delay, and how long a sample interval, the loop bears around a hover.

Certificate section 4 speaks of the continuous law with perfect actuators. The flown loop is sampled, its state is old,
the autopilot's rate loop and the rotors lag. Here the very functions that fly (`law.step`, `model.advance`) are
linearised around a hover by central differences, strung together with the delay as it really acts (a command is held
for one interval, beginning one delay after its state's stamp), and the eigenvalues of one sample's map tell whether the
loop is stable. All six axes are in it at once; the heading is the commanded one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from companion.control import heading
from companion.control.heading import HeadingState
from companion.control.law import ControllerState, Parameters, step
from companion.control.linearise import FloatArray, jacobian, rotation_vector, split, state_of
from companion.control.model import advance, factors
from companion.control.types import Reference

PLANT = 13
"""p, v, rotation vector, w, thrust."""
INPUTS = 4
"""Thrust and body rate setpoints."""
MARGIN_LIMIT_S = 0.3
INTERVAL_LIMIT_S = 0.5
DELAY_STRIDE_S = 0.004
INTERVAL_STRIDE_S = 0.010
"""Steps of the search for both; the last one is bisected."""


class Timing(NamedTuple):
    """The clockwork of the loop and the lags of the vehicle."""

    interval_s: float
    """Between two states."""
    delay_s: float
    """From a state's stamp to the effect of its command."""
    lags_s: tuple[float, float, float, float]
    """Of roll, pitch, yaw rate and thrust behind their setpoints."""
    predict: bool
    """Whether the state is predicted over `delay_s`."""


class Margins(NamedTuple):
    """What the loop bears."""

    spectral_radius: float
    """Of the loop as configured; below 1: stable."""
    delay_margin_s: float
    """Delay that the prediction does not know of, up to which the loop is stable; sought up to MARGIN_LIMIT_S."""
    interval_max_s: float
    """Longest sample interval; at most INTERVAL_LIMIT_S is looked for."""


@lru_cache(maxsize=256)
def _plant(
    vehicle: tuple[float, float, float], lags_s: tuple[float, float, float, float], duration_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """See `Loop.plant`; kept, because it is most of the work and no gain is in it. The arrays cannot be written to."""
    if duration_s <= 0.0:
        found = np.eye(PLANT), np.zeros((PLANT, INPUTS)), np.zeros((PLANT, 3))
    else:
        found = _plant_over(vehicle, lags_s, duration_s)
    for array in found:
        array.flags.writeable = False
    return found


def _plant_over(
    vehicle: tuple[float, float, float], lags_s: tuple[float, float, float, float], duration_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    pieces = max(1, math.ceil(duration_s / 0.005))
    piece_s = duration_s / pieces
    lags = factors(lags_s, piece_s)
    weight = vehicle[0] * vehicle[1]

    def run(z: FloatArray) -> FloatArray:
        state, thrust = state_of(z), float(z[12])
        n = z.tolist()
        for _ in range(pieces):
            state, thrust = advance(
                state, thrust, (n[14], n[15], n[16]), n[13], (n[17], n[18], n[19]), vehicle, lags, piece_s
            )
        return np.array([*state.p, *state.v, *rotation_vector(state.q), *state.w, thrust])

    at = np.zeros(20)
    at[12] = at[13] = weight
    scales = np.full(20, 1e-5)
    scales[12] = scales[13] = 1e-4 * weight
    j = jacobian(run, at, scales)
    return j[:, :13], j[:, 13:17], j[:, 17:20]


class Loop:
    """The linearised pieces of one loop."""

    def __init__(self, parameters: Parameters, lags: tuple[float, float, float, float]) -> None:
        # the commanded heading has no singular direction at a hover, and its gains are those of the sideslip heading
        gains = parameters.gains._replace(heading_kind=heading.COMMANDED)
        # the autopilot's rate integral and what takes it back out cancel each other: neither is in the linear loop
        model = parameters.model._replace(rate_integral=(0.0, 0.0, 0.0))
        limits = parameters.limits._replace(rate_max=(1e6, 1e6, 1e6), heading_rate_max=1e6)
        self.parameters = parameters._replace(gains=gains, limits=limits, model=model)
        self.lags = lags
        self.weight = model.mass * model.gravity
        self.vehicle = (model.mass, model.gravity, model.drag)
        self.estimator = gains.gamma > 0.0
        self.memory = HeadingState((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), False)

    def plant(self, duration_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """F, G, H of x+ = F x + G u + H b_hat over `duration_s` under one command."""
        return _plant(self.vehicle, self.lags, duration_s)

    def controller(self, interval_s: float) -> FloatArray:
        """The map (state 12, T, T', b_hat 3) -> (u 4, T, T', b_hat 3); shape (9, 17)."""
        zero = (0.0, 0.0, 0.0)
        ref = Reference(zero, zero, zero, zero, zero, 0.0, 0.0, 0.0)

        def run(z: FloatArray) -> FloatArray:
            n = z.tolist()
            ctrl = ControllerState(n[12], n[13], (n[14], n[15], n[16]), self.memory, (0.0, 0.0, 0.0))
            command, after, _ = step(state_of(z), ref, ctrl, self.parameters, False, interval_s)
            return np.array([command.thrust, *command.rates, after.thrust, after.thrust_rate, *after.b_hat])

        at = np.zeros(17)
        at[12] = self.weight
        scales = np.full(17, 1e-6)
        scales[12] = scales[13] = 1e-5 * self.weight
        return jacobian(run, at, scales)


def loop_matrix(parameters: Parameters, timing: Timing, extra_delay_s: float = 0.0) -> FloatArray:
    """The linear map of one sample of the loop around a hover.

    The state is [plant 13, controller 5, modelled thrust 1, the last commands 4 each]; without the estimator b_hat is
    left out.

    Args:
        parameters: what flies.
        timing: interval, delay, lags.
        extra_delay_s: delay on top of `timing.delay_s` that the prediction knows nothing of [s].
    """
    loop = Loop(parameters, timing.lags_s)
    dt = timing.interval_s
    # how many intervals a command waits, and which part of an interval is left
    waits, part = split(timing.delay_s + extra_delay_s, dt)
    waits_model, part_model = split(timing.delay_s, dt)
    memory = max(waits, waits_model) + 1
    size = PLANT + 5 + 1 + INPUTS * memory
    control = loop.controller(dt)

    def command(i: int) -> slice:
        """Where the command of i samples ago stands; i >= 1."""
        return slice(PLANT + 6 + INPUTS * (i - 1), PLANT + 6 + INPUTS * i)

    # the state that the law sees, as a linear function of everything
    seen = np.zeros((PLANT, size))
    seen[:12, :12] = np.eye(12)
    seen[12, PLANT + 5] = 1.0
    if timing.predict:
        spans = [(waits_model + 1, part_model)] + [(i, dt) for i in range(waits_model, 0, -1)]
        for i, duration in spans:
            f, g, h = loop.plant(duration)
            seen = f @ seen
            seen[:, command(i)] += g
            seen[:, PLANT + 2 : PLANT + 5] += h
    law_input = np.zeros((17, size))
    law_input[:12] = seen[:12]
    law_input[12:, PLANT : PLANT + 5] = np.eye(5)
    law = control @ law_input  # rows: u, then the controller's next state

    out = np.zeros((size, size))
    plant = np.zeros((PLANT, size))
    plant[:, :PLANT] = np.eye(PLANT)
    thrust_model = np.zeros((1, size))
    thrust_model[0, PLANT + 5] = 1.0
    for i, duration in ((waits + 1, part), (waits, dt - part)):
        f, g, _ = loop.plant(duration)
        plant = f @ plant
        _apply(plant, g, i, command, law)
    for i, duration in ((waits_model + 1, part_model), (waits_model, dt - part_model)):
        f, g, _ = loop.plant(duration)
        thrust_model = f[12:13, 12:13] @ thrust_model
        _apply(thrust_model, g[12:13], i, command, law)
    out[:PLANT] = plant
    out[PLANT : PLANT + 5] = law[4:]
    out[PLANT + 5] = thrust_model
    out[command(1)] = law[:4]
    for i in range(2, memory + 1):
        out[command(i), command(i - 1)] = np.eye(INPUTS)
    if not loop.estimator:
        keep = [i for i in range(size) if not PLANT + 2 <= i < PLANT + 5]
        out = out[np.ix_(keep, keep)]
    return out


def _apply(rows: FloatArray, g: FloatArray, i: int, command: Callable[[int], slice], law: FloatArray) -> None:
    """Adds the command of i samples ago (0: the one computed now) to the rows."""
    if i == 0:
        rows += g @ law[:4]
    else:
        rows[:, command(i)] += g


def spectral_radius(parameters: Parameters, timing: Timing, extra_delay_s: float = 0.0) -> float:
    """The largest |eigenvalue| of one sample's map."""
    return float(np.abs(np.linalg.eigvals(loop_matrix(parameters, timing, extra_delay_s))).max())


def margins(
    parameters: Parameters,
    timing: Timing,
    delay_limit_s: float = MARGIN_LIMIT_S,
    interval_limit_s: float = INTERVAL_LIMIT_S,
) -> Margins:
    """Delay margin and longest sample interval of a loop; both are 0 when it is unstable as it is.

    Args:
        parameters: what flies.
        timing: interval, delay, lags.
        delay_limit_s: no longer delay is looked at [s]; what is found up to there does not depend on it.
        interval_limit_s: no longer interval is looked at [s].
    """
    return margins_of(partial(spectral_radius, parameters), timing, delay_limit_s, interval_limit_s)


def margins_of(
    radius_of: Callable[[Timing, float], float], timing: Timing, delay_limit_s: float, interval_limit_s: float
) -> Margins:
    """The same for any loop that gives its spectral radius for a timing and a delay on top of it [s]."""
    radius = radius_of(timing, 0.0)
    if radius >= 1.0:
        return Margins(radius, 0.0, 0.0)
    delay = _first_failure(lambda x: radius_of(timing, x) < 1.0, 0.0, delay_limit_s, DELAY_STRIDE_S)
    interval = _first_failure(
        lambda x: radius_of(timing._replace(interval_s=x), 0.0) < 1.0,
        timing.interval_s,
        interval_limit_s,
        INTERVAL_STRIDE_S,
    )
    return Margins(radius, delay, interval)


def _first_failure(holds: Callable[[float], bool], low: float, high: float, stride: float) -> float:
    """The end of the range from `low` in which `holds`: a scan in strides, then bisection."""
    x = low
    while x + stride <= high and holds(x + stride):
        x += stride
    if x + stride > high:
        return x
    good, bad = x, x + stride
    for _ in range(8):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if holds(middle) else (good, middle)
    return good
