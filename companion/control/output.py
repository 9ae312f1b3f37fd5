"""From the law's command to what an autopilot takes: thrust fraction, attitude setpoint, actuator controls."""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.control.law import torque
from companion.control.types import Quat, Vec3, new_record
from companion.control.vectors import clip, quat_exp, quat_multiply, quat_normalise

LEAD_FILTER_S = 0.015
"""Time constant of the filter on the lead of actuator controls: less would pass the state's noise to the rotors."""
STEEPEST = 0.3
"""Cosine of the tilt beyond which the yaw feed-forward grows no more."""


class RateSetpoint(NamedTuple):
    """Body rates and thrust: SET_ATTITUDE_TARGET with mask 128."""

    thrust: float
    """Collective thrust as a fraction 0 to 1 of what the autopilot calls full."""
    w: Vec3
    """Body rates, FRD [rad/s]."""


class AttitudeSetpoint(NamedTuple):
    """Attitude, yaw rate and thrust: SET_ATTITUDE_TARGET with mask 3."""

    thrust: float
    """Collective thrust, 0 to 1."""
    q: Quat
    """Attitude, body to NED, unit length."""
    yaw_rate: float
    """Feed-forward about the vertical, positive clockwise from above [rad/s]."""


class ActuatorSetpoint(NamedTuple):
    """Normalised torque and thrust: SET_ACTUATOR_CONTROL_TARGET, group 0 (PX4 before 1.14)."""

    thrust: float
    """Collective thrust, 0 to 1."""
    torque: Vec3
    """About body x, y, z, -1 to 1."""


class PositionSetpoint(NamedTuple):
    """A point of a trajectory for the autopilot's own position controller: SET_POSITION_TARGET_LOCAL_NED, local NED.

    What is None is not commanded: its ignore bits are set.
    """

    p: Vec3 | None
    """Position [m]."""
    v: Vec3
    """Velocity [m/s]; feed-forward where a position is commanded too."""
    a: Vec3 | None
    """Acceleration [m/s^2], feed-forward."""
    yaw: float | None
    """Heading [rad], -pi to pi; None: PX4 holds the one that it has."""
    yaw_rate: float | None
    """Feed-forward about the vertical, positive clockwise from above [rad/s]."""


LawSetpoint = RateSetpoint | AttitudeSetpoint | ActuatorSetpoint
"""What the law sends."""
Setpoint = LawSetpoint | PositionSetpoint


def thrust_of(setpoint: Setpoint) -> float:
    """The thrust that a setpoint commands, 0 to 1; NaN where that is the autopilot's own business."""
    return math.nan if isinstance(setpoint, PositionSetpoint) else setpoint.thrust


class Conversion(NamedTuple):
    """The vehicle's normalisation."""

    thrust_full_n: float
    """Collective thrust at a command of 1 [N]."""
    curve_factor: float
    """f of thrust/full = f u^2 + (1 - f) u (PX4's THR_MDL_FAC)."""
    attitude_gain: Vec3
    """The attitude loop's gains [1/s]."""
    attitude_lag: float
    """By how much the autopilot's reference model lags behind attitude setpoints [s]; 0: it has none."""
    inertia: Vec3
    """[kg m^2]"""
    torque_full_n_m: Vec3
    """Torque at a control of 1 about body x, y, z [N m]."""


def thrust_fraction(thrust_n: float, full_n: float, curve_factor: float) -> float:
    """The thrust command that gives `thrust_n`: the inverse of the thrust curve, within 0 to 1."""
    share = clip(thrust_n / full_n, 0.0, 1.0)
    if curve_factor < 1e-6:
        return share
    half = 0.5 * (1.0 - curve_factor) / curve_factor
    return math.sqrt(half * half + share / curve_factor) - half


def rates_output(thrust_n: float, rates: Vec3, conversion: Conversion) -> RateSetpoint:
    """Body rates and thrust as they are."""
    share = thrust_fraction(thrust_n, conversion.thrust_full_n, conversion.curve_factor)
    return new_record(RateSetpoint, (share, rates))


def attitude_output(
    thrust_n: float, rates: Vec3, tau: Vec3, q: Quat, w: Vec3, conversion: Conversion
) -> AttitudeSetpoint:
    """R_cmd = R Exp(w_cmd / P_att): the attitude loop then asks its rate loop for w_cmd.

    The yaw rate goes along as feed-forward, so the attitude carries no yaw error. PX4 turns by it about the world's z
    axis: of a tilted vehicle that is roll and pitch too, which the attitude takes back.
    An autopilot that filters the setpoint with lag T gets it ahead by T times its own rate of change, w + tau / P_att.

    Args:
        thrust_n: thrust setpoint [N].
        rates: body rate setpoint [rad/s].
        tau: angular acceleration [rad/s^2].
        q: the attitude predicted for the time of effect.
        w: the body rates there [rad/s].
        conversion: the vehicle's normalisation.
    """
    gain, lag = conversion.attitude_gain, conversion.attitude_lag
    a, b, c, d = q
    down = (2.0 * (b * d - a * c), 2.0 * (c * d + a * b), 1.0 - 2.0 * (b * b + c * c))  # the world's z axis in the body
    turn = rates[2] / max(down[2], STEEPEST)
    lead = (
        (rates[0] - down[0] * turn + lag * tau[0]) / gain[0] + lag * w[0],
        (rates[1] - down[1] * turn + lag * tau[1]) / gain[1] + lag * w[1],
        lag * w[2],
    )
    thrust = thrust_fraction(thrust_n, conversion.thrust_full_n, conversion.curve_factor)
    return AttitudeSetpoint(thrust, quat_normalise(quat_multiply(q, quat_exp(lead))), turn)


def lead(tau: Vec3, slow: Vec3, lag_s: float, dt_s: float) -> tuple[Vec3, Vec3]:
    """The torque's lag behind the controls, made up for: (1 + lag s)/(1 + filter s) of tau, filtered against noise.

    Args:
        tau: angular acceleration wanted [rad/s^2].
        slow: the filter's state, tau through 1/(1 + LEAD_FILTER_S s).
        lag_s: of the rotors [s]; no longer than the filter: nothing is made up for.
        dt_s: since the last call [s].

    Returns:
        the angular acceleration to command, and the filter's next state.
    """
    k = 1.0 - math.exp(-dt_s / LEAD_FILTER_S)
    slow = (slow[0] + k * (tau[0] - slow[0]), slow[1] + k * (tau[1] - slow[1]), slow[2] + k * (tau[2] - slow[2]))
    ratio = max(lag_s / LEAD_FILTER_S, 1.0)
    ahead = (
        slow[0] + ratio * (tau[0] - slow[0]),
        slow[1] + ratio * (tau[1] - slow[1]),
        slow[2] + ratio * (tau[2] - slow[2]),
    )
    return ahead, slow


def actuator_output(thrust_n: float, tau: Vec3, w: Vec3, conversion: Conversion) -> ActuatorSetpoint:
    """n = J tau + S(w) J w (6) over the torque of full control, and the thrust: what actuator controls are."""
    n = torque(tau, w, conversion.inertia)
    full = conversion.torque_full_n_m
    controls = (clip(n[0] / full[0], -1.0, 1.0), clip(n[1] / full[1], -1.0, 1.0), clip(n[2] / full[2], -1.0, 1.0))
    return ActuatorSetpoint(thrust_fraction(thrust_n, conversion.thrust_full_n, conversion.curve_factor), controls)
