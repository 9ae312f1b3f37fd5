"""PX4-like rate loop and attitude loop, and the kernel that runs them with allocation, physics and ground.

The attitude loop follows PX4's mc_att_control: the quaternion error is split into the tilt that turns the thrust
direction and a heading remainder of less weight; since 1.18 the attitude setpoint passes a second-order reference
model that is stepped when a setpoint arrives. The rate loop follows lib/rate_control: P on the rate error, D on the
measured rates, a limited integral.

Scalar code on tuples: runs as plain Python, compiles with numba unchanged (see `accelerate`). Norms, units and the
design of the gains are in `loop_gains`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .allocation import allocate, rotor_command
from .loop_gains import LoopGains, Normalisation, make_gains, normalisation
from .physics import Body, RigidState, contact, step
from .rotation import (
    Quat,
    Vec3,
    Vec4,
    body_z,
    clip,
    conjugate,
    exponential,
    inertial_z_in_body,
    logarithm,
    multiply,
    normalised,
    rotate_back,
)

__all__ = [
    "ATTITUDE",
    "RATES",
    "ROTORS",
    "STOPPED",
    "STOPPED_SETPOINT",
    "TORQUE",
    "LoopGains",
    "LoopState",
    "Normalisation",
    "Setpoint",
    "Touch",
    "advance",
    "advance_step",
    "attitude_rates",
    "control",
    "filtered_attitude",
    "initial_loops",
    "make_gains",
    "normalisation",
    "rate_torque",
]

STOPPED = 0
"""All rotors off, integrals cleared."""
RATES = 1
"""Body rates and thrust."""
ATTITUDE = 2
"""Attitude, yaw-rate feed-forward and thrust."""
TORQUE = 3
"""Normalised torque and thrust, straight into allocation (SET_ACTUATOR_CONTROL_TARGET)."""
ROTORS = 4
"""Commands of the rotors, past all loops: another autopilot flies (`hil`)."""

_RATE_INPUT_MAX_RAD_S = 1.0e3
"""Keeps infinite inputs finite; far beyond what any axis can do."""
_NO_SETPOINT_YET_S = 1.0e3
"""Age of the attitude setpoint before the first one: the reference model forgets its start."""
_OPPOSITE = 1.0e-5
"""1 + cos(tilt error) below which the thrust direction points the other way and no shortest turn to it exists."""


class Setpoint(NamedTuple):
    """What the inner loops follow until the next one; NaN and infinity are taken as they come from the wire."""

    mode: int
    """STOPPED, RATES, ATTITUDE, TORQUE or ROTORS."""
    thrust: float
    """Collective thrust as a share of 4 rotor_thrust_max_n, 0..1; NaN stops the rotors."""
    rates: Vec3
    """Body rates [rad/s] (RATES); a NaN holds the rate measured when the setpoint arrived."""
    q: Quat
    """Attitude (ATTITUDE), need not be normalised; zero or NaN is not an attitude, see `filtered_attitude`. With ROTORS
    no attitude, but the four commands 0..1, before the thrust curve; NaN stops a rotor."""
    yaw_rate: float
    """Feed-forward about the inertial z axis [rad/s] (ATTITUDE); NaN = none."""
    torque: Vec3
    """Normalised torque -1..1 about body x, y, z (TORQUE); NaN = 0."""


STOPPED_SETPOINT = Setpoint(STOPPED, 0.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))
"""Rotors off: disarmed."""


class LoopState(NamedTuple):
    """What the inner loops remember."""

    integral: Vec3
    """Normalised torque of the rate loop's integral."""
    w_previous: Vec3
    """Body rates one step ago [rad/s]."""
    rates: Vec3
    """Body rates that the rate loop follows [rad/s]."""
    q_ref: Quat
    """Attitude that the attitude loop follows: the reference model's state; without a model the setpoint itself."""
    w_ref: Vec3
    """Rates of the reference model [rad/s]."""
    reference_age_s: float
    """Time since the last attitude setpoint."""


class Touch(NamedTuple):
    """What the ground did during `advance`."""

    on_ground: bool
    """At the end of the last step."""
    impact_m_s: float
    """Downward speed of the hardest touchdown (from the air) among the steps; 0.0 when there was none."""


def initial_loops(w: Vec3) -> LoopState:
    """Return the loops' state at start, at the body rates w [rad/s]."""
    return LoopState((0.0, 0.0, 0.0), w, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), _NO_SETPOINT_YET_S)


def filtered_attitude(
    q_ref: Quat, w_ref: Vec3, q_setpoint: Quat, age_s: float, reference_rad_s: float
) -> tuple[Quat, Vec3]:
    """Return the reference model's attitude and rates after a new setpoint.

    Critically damped, solved exactly over the time since the setpoint before (age_s) with the new setpoint held: a
    stream lags by 2/w_n less half its interval, 40 ms at most with PX4's 50 rad/s. A quaternion without an attitude
    in it (zero, NaN) makes the state NaN, and no later setpoint brings it back: so it is in PX4 1.18. With
    reference_rad_s = 0 (before 1.18) the setpoint is only normalised, and the next one is followed again.
    """
    q_new = normalised(q_setpoint)
    if reference_rad_s <= 0.0:
        return q_new, (0.0, 0.0, 0.0)
    error = logarithm(multiply(conjugate(q_new), q_ref))
    left = math.exp(-reference_rad_s * age_s)
    slope = (
        w_ref[0] + reference_rad_s * error[0],
        w_ref[1] + reference_rad_s * error[1],
        w_ref[2] + reference_rad_s * error[2],
    )
    rest = (
        (error[0] + slope[0] * age_s) * left,
        (error[1] + slope[1] * age_s) * left,
        (error[2] + slope[2] * age_s) * left,
    )
    brake = reference_rad_s * age_s
    rates = (
        (w_ref[0] - brake * slope[0]) * left,
        (w_ref[1] - brake * slope[1]) * left,
        (w_ref[2] - brake * slope[2]) * left,
    )
    return multiply(q_new, exponential(rest)), rates


def attitude_rates(q: Quat, q_wanted: Quat, yaw_rate: float, gains: LoopGains) -> Vec3:
    """Return the body rates [rad/s] that turn q to q_wanted; NaN when q_wanted is.

    The error is the shortest turn of the thrust direction, followed by a turn about it that gets only a share of its
    angle (yaw weight); twice its vector part times the gains, plus the yaw rate about the inertial z axis, limited
    per axis.
    """
    error = multiply(conjugate(q), q_wanted)
    goal = rotate_back(q, body_z(q_wanted))
    if 1.0 + goal[2] > _OPPOSITE:
        tilt = normalised((1.0 + goal[2], -goal[1], goal[0], 0.0))
        twist = multiply(conjugate(tilt), error)
        sign = -1.0 if twist[0] < 0.0 else 1.0
        half = gains.yaw_weight * math.atan2(sign * twist[3], sign * twist[0])
        error = multiply(tilt, (math.cos(half), 0.0, 0.0, math.sin(half)))
    gain = -2.0 if error[0] < 0.0 else 2.0
    down = inertial_z_in_body(q)
    turn = 0.0 if math.isnan(yaw_rate) else clip(yaw_rate, -_RATE_INPUT_MAX_RAD_S, _RATE_INPUT_MAX_RAD_S)
    p = gains.attitude_p
    limit = gains.rate_max
    return (
        clip(gain * error[1] * p[0] + down[0] * turn, -limit[0], limit[0]),
        clip(gain * error[2] * p[1] + down[1] * turn, -limit[1], limit[1]),
        clip(gain * error[3] * p[2] + down[2] * turn, -limit[2], limit[2]),
    )


def _rate_or_hold(wanted: float, measured: float) -> float:
    """Return a rate setpoint; NaN becomes the measured rate (mc_rate_control), infinity something large."""
    if math.isnan(wanted):
        return measured
    return clip(wanted, -_RATE_INPUT_MAX_RAD_S, _RATE_INPUT_MAX_RAD_S)


def _rates_or_hold(wanted: Vec3, measured: Vec3) -> Vec3:
    return (
        _rate_or_hold(wanted[0], measured[0]),
        _rate_or_hold(wanted[1], measured[1]),
        _rate_or_hold(wanted[2], measured[2]),
    )


def _torque_or_zero(torque: float) -> float:
    return 0.0 if math.isnan(torque) else clip(torque, -1.0, 1.0)


def rate_torque(w: Vec3, loops: LoopState, rates: Vec3, gains: LoopGains, dt_s: float) -> Vec3:
    """Return the normalised torque -1..1: P (rates - w) + integral - D w'."""
    p = gains.rate_p
    d = gains.rate_d
    back = loops.w_previous
    sums = loops.integral
    return (
        clip(p[0] * (rates[0] - w[0]) + sums[0] - d[0] * (w[0] - back[0]) / dt_s, -1.0, 1.0),
        clip(p[1] * (rates[1] - w[1]) + sums[1] - d[1] * (w[1] - back[1]) / dt_s, -1.0, 1.0),
        clip(p[2] * (rates[2] - w[2]) + sums[2] - d[2] * (w[2] - back[2]) / dt_s, -1.0, 1.0),
    )


def _grown(integral: float, error: float, torque: float, delivered: float, gain: float, gains: LoopGains) -> float:
    """Return one axis' integral after a step (gain includes dt).

    It stands still in the direction in which the axis is saturated, grows less the larger the rate error is, and is
    limited.
    """
    saturated = delivered < 1.0 or abs(torque) >= 1.0
    if saturated and error * torque > 0.0:
        return integral
    ratio = error / gains.integral_error_max_rad_s
    share = max(0.0, 1.0 - ratio * ratio)
    return clip(integral + gain * error * share, -gains.integral_limit, gains.integral_limit)


def _integrals(
    loops: LoopState, w: Vec3, rates: Vec3, torque: Vec3, delivered: Vec3, gains: LoopGains, dt_s: float
) -> Vec3:
    i = gains.rate_i
    s = loops.integral
    return (
        _grown(s[0], rates[0] - w[0], torque[0], delivered[0], i[0] * dt_s, gains),
        _grown(s[1], rates[1] - w[1], torque[1], delivered[1], i[1] * dt_s, gains),
        _grown(s[2], rates[2] - w[2], torque[2], delivered[2], i[2] * dt_s, gains),
    )


def control(
    rigid: RigidState,
    loops: LoopState,
    setpoint: Setpoint,
    fresh: bool,
    on_ground: bool,
    gains: LoopGains,
    dt_s: float,
) -> tuple[Vec4, LoopState]:
    """Return the rotor commands of one step (before the thrust curve) and the loops' new state.

    A change of mode takes effect with a fresh setpoint; without one the rate loop keeps the rates that it had. The
    integral stands still on the ground, as in PX4 while landed.
    """
    w = rigid.w
    age = loops.reference_age_s + dt_s
    if setpoint.mode in (STOPPED, ROTORS):
        idle = LoopState((0.0, 0.0, 0.0), w, (0.0, 0.0, 0.0), loops.q_ref, loops.w_ref, age)
        return setpoint.q if setpoint.mode == ROTORS else (0.0, 0.0, 0.0, 0.0), idle
    q_ref = loops.q_ref
    w_ref = loops.w_ref
    rates = loops.rates
    if setpoint.mode == ATTITUDE:
        if fresh:
            q_ref, w_ref = filtered_attitude(q_ref, w_ref, setpoint.q, loops.reference_age_s, gains.reference_rad_s)
            age = dt_s
        rates = _rates_or_hold(attitude_rates(rigid.q, q_ref, setpoint.yaw_rate, gains), w)
    elif setpoint.mode == RATES and fresh:
        rates = _rates_or_hold(setpoint.rates, w)

    if setpoint.mode == TORQUE:
        torque = (
            _torque_or_zero(setpoint.torque[0]),
            _torque_or_zero(setpoint.torque[1]),
            _torque_or_zero(setpoint.torque[2]),
        )
        rates = w
        integral = (0.0, 0.0, 0.0)
        shares, delivered = allocate(torque, setpoint.thrust, gains)
    else:
        torque = rate_torque(w, loops, rates, gains, dt_s)
        shares, delivered = allocate(torque, setpoint.thrust, gains)
        integral = loops.integral
        if not on_ground:
            integral = _integrals(loops, w, rates, torque, delivered, gains, dt_s)
    curve = gains.curve_factor
    command = (
        rotor_command(shares[0], curve),
        rotor_command(shares[1], curve),
        rotor_command(shares[2], curve),
        rotor_command(shares[3], curve),
    )
    return command, LoopState(integral, w, rates, q_ref, w_ref, age)


def advance_step(
    rigid: RigidState,
    loops: LoopState,
    setpoint: Setpoint,
    fresh: bool,
    air: Vec3,
    force_n: Vec3,
    body: Body,
    gains: LoopGains,
    ground_d_m: float,
    dt_s: float,
) -> tuple[RigidState, LoopState, float, float]:
    """Run one step of loops, rotors, rigid body and ground: what both engines of the simulated vehicle repeat.

    Args:
        rigid: state now.
        loops: the loops' state now (`initial_loops`).
        setpoint: followed over the step.
        fresh: it is a new one (NaN rates, reference model).
        air: velocity of the air, NED [m/s], held over the step.
        force_n: force from outside, NED [N], held over the step.
        body: `physics.make_body`.
        gains: `make_gains`.
        ground_d_m: down coordinate of the ground [m].
        dt_s: the step [s], the loops' period.

    Returns:
        Both states after the step, the speed at which the ground was met (`physics.contact`; -1.0 in the air), and
        the speed [m/s] of a touchdown from the air, 0.0 when there was none.
    """
    on_ground = rigid.p[2] >= ground_d_m
    command, loops_after = control(rigid, loops, setpoint, fresh, on_ground, gains, dt_s)
    after = step(rigid, command, air, force_n, body, dt_s)
    resting, sinking = contact(rigid, after, ground_d_m, body, dt_s)
    return resting, loops_after, sinking, 0.0 if on_ground else max(sinking, 0.0)


def advance(
    rigid: RigidState,
    loops: LoopState,
    setpoint: Setpoint,
    fresh: bool,
    air: Vec3,
    force_n: Vec3,
    body: Body,
    gains: LoopGains,
    ground_d_m: float,
    dt_s: float,
    n_steps: int,
) -> tuple[RigidState, LoopState, Touch]:
    """Run n_steps (at least 1) of `advance_step` with one setpoint; `fresh` acts on the first."""
    sinking = -1.0
    impact = 0.0
    new = fresh
    for _ in range(n_steps):
        rigid, loops, sinking, hit = advance_step(
            rigid, loops, setpoint, new, air, force_n, body, gains, ground_d_m, dt_s
        )
        impact = max(impact, hit)
        new = False
    return rigid, loops, Touch(sinking >= 0.0, impact)
