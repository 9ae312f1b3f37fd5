"""The margins of the sampled loop where attitude setpoints go out: the autopilot's attitude loop is in it too.

As `control.sampled`, with the same law, prediction and delay. The setpoint is what `output.attitude_output` makes of
the law's command; the autopilot follows it through a reference model, a proportional loop and its rate loop, so that
the vehicle turns on between two setpoints, and not as the prediction believes, which knows held body rates only. Gains
that are fine with body rates need not be fine here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from companion.control.law import ControllerState, Parameters, step
from companion.control.linearise import FloatArray, jacobian, rotation_vector, split, state_of
from companion.control.output import Conversion, attitude_output
from companion.control.sampled import (
    INTERVAL_LIMIT_S,
    MARGIN_LIMIT_S,
    PLANT,
    Loop,
    Margins,
    Timing,
    margins_of,
)
from companion.control.types import Reference, Vec3

BODY = PLANT + 6
"""The plant, and the attitude loop's reference with its rate."""
SENT = 8
"""Thrust; body rates as the prediction takes them; attitude setpoint as a rotation vector; yaw rate."""
CONTROLLER = 5
UNUSED_LAG_S = 0.001


class AttitudeLoop(NamedTuple):
    """The autopilot's loop from an attitude setpoint to a body rate setpoint."""

    gain_1_s: Vec3
    lag_s: float
    """Of its reference model, critically damped: 2 over its frequency; 0: it has none."""


def loop_matrix(parameters: Parameters, timing: Timing, inner: AttitudeLoop, extra_delay_s: float = 0.0) -> FloatArray:
    """The linear map of one sample of the loop around a hover.

    The state is [plant 13, reference 6, controller 5, modelled thrust 1, the last commands 8 each].

    Args:
        parameters: what flies.
        timing: interval, delay, lags.
        inner: the attitude loop.
        extra_delay_s: delay on top of `timing.delay_s` that the prediction knows nothing of [s].
    """
    loop, dt = Loop(parameters, timing.lags_s), timing.interval_s
    waits, part = split(timing.delay_s + extra_delay_s, dt)
    waits_model, part_model = split(timing.delay_s, dt)
    memory = max(waits, waits_model) + 1
    first = BODY + CONTROLLER + 1
    size = first + SENT * memory

    def sent(i: int) -> slice:
        """Where the command of i samples ago stands; i >= 1."""
        return slice(first + SENT * (i - 1), first + SENT * i)

    seen = np.zeros((PLANT, size))
    seen[:12, :12] = np.eye(12)
    seen[12, BODY + CONTROLLER] = 1.0
    if timing.predict:
        for i, duration in [(waits_model + 1, part_model)] + [(i, dt) for i in range(waits_model, 0, -1)]:
            f, g, h = loop.plant(duration)
            seen = f @ seen
            seen[:, sent(i)][:, :4] += g
            seen[:, BODY + 2 : BODY + CONTROLLER] += h
    law_input = np.zeros((12 + CONTROLLER, size))
    law_input[:12] = seen[:12]
    law_input[12:, BODY : BODY + CONTROLLER] = np.eye(CONTROLLER)
    law = _controller(loop, inner, dt) @ law_input  # rows: what goes out, then the controller's next state

    def advanced(rows: FloatArray, f: FloatArray, g: FloatArray, i: int) -> FloatArray:
        """The rows after a piece under the command of i samples ago (0: the one computed now)."""
        rows = f @ rows
        if i == 0:
            return np.asarray(rows + g @ law[:SENT])
        rows[:, sent(i)] += g
        return rows

    body = np.eye(BODY, size)
    for i, duration in ((waits + 1, part), (waits, dt - part)):
        body = advanced(body, *_body(loop, inner, timing, duration), i)
    thrust = np.zeros((1, size))
    thrust[0, BODY + CONTROLLER] = 1.0
    for i, duration in ((waits_model + 1, part_model), (waits_model, dt - part_model)):
        f, g, _ = loop.plant(duration)
        wide = np.zeros((1, SENT))
        wide[:, :4] = g[12:13]
        thrust = advanced(thrust, f[12:13, 12:13], wide, i)
    out = np.zeros((size, size))
    out[:BODY] = body
    out[BODY : BODY + CONTROLLER] = law[SENT:]
    out[BODY + CONTROLLER] = thrust
    out[sent(1)] = law[:SENT]
    for i in range(2, memory + 1):
        out[sent(i), sent(i - 1)] = np.eye(SENT)
    keep = [i for i in range(size) if loop.estimator or not BODY + 2 <= i < BODY + CONTROLLER]
    return out[np.ix_(keep, keep)]


def _controller(loop: Loop, inner: AttitudeLoop, interval_s: float) -> FloatArray:
    """The map (state 12, T, T', b_hat 3) -> (what goes out 8, T, T', b_hat 3); shape (13, 17)."""
    zero = (0.0, 0.0, 0.0)
    reference = Reference(zero, zero, zero, zero, zero, 0.0, 0.0, 0.0)
    conversion = Conversion(1e3 * loop.weight, 0.0, inner.gain_1_s, inner.lag_s, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))

    def run(z: FloatArray) -> FloatArray:
        n, state = z.tolist(), state_of(z)
        controller = ControllerState(n[12], n[13], (n[14], n[15], n[16]), loop.memory, zero)
        command, after, out = step(state, reference, controller, loop.parameters, False, interval_s)
        setpoint = attitude_output(command.thrust, command.rates, out.tau, state.q, state.w, conversion)
        goes = (command.thrust, *command.rates, *rotation_vector(setpoint.q), setpoint.yaw_rate)
        return np.array([*goes, after.thrust, after.thrust_rate, *after.b_hat])

    at = np.zeros(12 + CONTROLLER)
    at[12] = loop.weight
    scales = np.full(12 + CONTROLLER, 1e-6)
    scales[12] = scales[13] = 1e-5 * loop.weight
    return jacobian(run, at, scales)


def _body(loop: Loop, inner: AttitudeLoop, timing: Timing, duration_s: float) -> tuple[FloatArray, FloatArray]:
    """F and G of the vehicle with its attitude loop over a time under one command."""
    mass, gravity, drag = loop.vehicle
    p, v, turn, w, thrust, ref, slope = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12, 13, 16)
    a, b = np.zeros((BODY, BODY)), np.zeros((BODY, SENT))
    a[p, v] = np.eye(3)
    a[v, v] = -drag * np.eye(3)
    a[3, 7], a[4, 6], a[5, thrust] = -gravity, gravity, -1.0 / mass  # r3 of a small rotation is (y, -x, 1)
    a[turn, w] = np.eye(3)
    lag = max(timing.lags_s[3], 1e-4)
    a[thrust, thrust], b[thrust, 0] = -1.0 / lag, 1.0 / lag
    for axis in range(3):
        rate = 1.0 / max(timing.lags_s[axis], 1e-4)
        followed = ref + axis
        a[9 + axis, 9 + axis] = -rate
        a[9 + axis, 6 + axis] = -rate * inner.gain_1_s[axis]
        if inner.lag_s > 0.0:
            own = 2.0 / inner.lag_s
            a[followed, slope + axis] = 1.0
            a[slope + axis, followed], a[slope + axis, slope + axis] = -own * own, -2.0 * own
            b[slope + axis, 4 + axis] = own * own
            a[9 + axis, followed] = rate * inner.gain_1_s[axis]
        else:  # nothing drives the reference's state: it dies away
            a[followed, followed] = a[slope + axis, slope + axis] = -1.0 / UNUSED_LAG_S
            b[9 + axis, 4 + axis] = rate * inner.gain_1_s[axis]
    b[11, 7] = 1.0 / max(timing.lags_s[2], 1e-4)
    whole = np.zeros((BODY + SENT, BODY + SENT))
    whole[:BODY, :BODY], whole[:BODY, BODY:] = a, b
    moved = expm(whole * duration_s)
    return moved[:BODY, :BODY], moved[:BODY, BODY:]


def attitude_margins(
    parameters: Parameters,
    timing: Timing,
    inner: AttitudeLoop,
    delay_limit_s: float = MARGIN_LIMIT_S,
    interval_limit_s: float = INTERVAL_LIMIT_S,
) -> Margins:
    """Delay margin and longest sample interval of the loop over attitude setpoints; see `sampled.margins`."""

    def radius(at: Timing, extra_delay_s: float) -> float:
        if not math.isfinite(at.interval_s + extra_delay_s):
            return math.inf
        return float(np.abs(np.linalg.eigvals(loop_matrix(parameters, at, inner, extra_delay_s))).max())

    return margins_of(radius, timing, delay_limit_s, interval_limit_s)
