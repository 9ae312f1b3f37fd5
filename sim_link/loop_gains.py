"""Constants of the inner loops, computed from the vehicle file, and what their normalised controls mean."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .rotation import Vec3, Vec4
from .vehicle_file import VehicleFile

_DAMPING = 0.8
"""Of the closed rate loop: the step's 63 % time stays within 15 % of the stated lag, the overshoot is small."""
_INTEGRAL_LIMIT = 0.3
"""MC_ROLLRATE_INT_LIM and its siblings: normalised torque that the integral may reach."""
_INTEGRAL_ERROR_MAX_RAD_S = math.radians(400.0)
"""Rate error from which on the integral does not grow (PX4's lib/rate_control)."""
_YAW_WEIGHT = 0.4
"""MC_YAW_WEIGHT: the direction of thrust has priority over the heading."""
_RATE_MAX_RAD_S = (math.radians(220.0), math.radians(220.0), math.radians(200.0))
"""MC_ROLLRATE_MAX, MC_PITCHRATE_MAX, MC_YAWRATE_MAX: of the attitude loop's output alone."""
PX4_VERSIONS = ("1.18", "1.13")
"""Behaviours of the autopilot that can be simulated."""


class Normalisation(NamedTuple):
    """Control 1.0 of actuator group 0 in physical units."""

    torque_max_n_m: Vec3
    """Roll, pitch, yaw torque of control 1.0 [N m]: control = torque / torque_max."""
    thrust_max_n: float
    """Collective thrust of control 1.0 [N]: control = T / thrust_max, before the thrust curve (which the autopilot
    inverts)."""


class LoopGains(NamedTuple):
    """Constants of the inner loops; torque is normalised (see `normalisation`)."""

    rate_p: Vec3
    """Torque per rate error [1/(rad/s)]."""
    rate_i: Vec3
    """Torque per integral of the rate error [1/rad]."""
    rate_d: Vec3
    """Torque per measured angular acceleration [1/(rad/s^2)]."""
    integral_limit: float
    integral_error_max_rad_s: float
    attitude_p: Vec3
    """Rate per attitude error [1/s]; yaw over the yaw weight, so that the heading alone closes at the stated gain."""
    yaw_weight: float
    rate_max: Vec3
    """Of the attitude loop's output [rad/s]."""
    reference_rad_s: float
    """Natural frequency of the reference model on the attitude setpoint; 0 = there is none."""
    mix_roll: Vec4
    """Share of rotor_thrust_max_n that each rotor takes per unit of roll control."""
    mix_pitch: Vec4
    mix_yaw: Vec4
    mix_thrust: Vec4
    curve_factor: float
    """f of the thrust curve that the allocation inverts (PX4: THR_MDL_FAC)."""


def normalisation(vehicle: VehicleFile) -> Normalisation:
    """Return what the normalised controls mean for a vehicle.

    torque_max of an axis is rotor_thrust_max_n / 2 times the sum of the rotors' arms about it (|y_i| for roll, |x_i|
    for pitch, |yaw_i| for yaw): what a symmetric vehicle reaches at half its collective thrust with two rotors full
    and two off. thrust_max is 4 rotor_thrust_max_n.
    """
    half = 0.5 * vehicle.rotor_thrust_max_n
    torque_max = (
        half * sum(abs(y) for y in vehicle.rotor_y_m),
        half * sum(abs(x) for x in vehicle.rotor_x_m),
        half * sum(abs(k) for k in vehicle.rotor_yaw_m),
    )
    return Normalisation(torque_max, 4.0 * vehicle.rotor_thrust_max_n)


def rate_loop_gains(rate_lag_s: float, rotor_lag_s: float) -> tuple[float, float]:
    """Return P [1/s] and D [-] of w' (commanded) = P (w_sp - w) - D w' behind a rotor lag.

    The closed loop is P / (lag s^2 + (1 + D) s + P). Its delay at low frequency, (1 + D)/P, is set to rate_lag_s, its
    damping to 0.8 by D; where the rotors are so quick that D = 0 already damps more, P = 1/rate_lag_s and the loop is
    nearly the first-order lag itself.
    """
    damping = max(0.0, 4.0 * _DAMPING * _DAMPING * rotor_lag_s / rate_lag_s - 1.0)
    return (1.0 + damping) / rate_lag_s, damping


def _mix(vehicle: VehicleFile, norm: Normalisation) -> tuple[Vec4, Vec4, Vec4, Vec4]:
    """Return the columns roll, pitch, yaw, thrust of the inverse of the geometry, in normalised units."""
    geometry = np.array(
        [
            [-y for y in vehicle.rotor_y_m],
            list(vehicle.rotor_x_m),
            list(vehicle.rotor_yaw_m),
            [1.0, 1.0, 1.0, 1.0],
        ]
    )
    full = np.array([*norm.torque_max_n_m, norm.thrust_max_n])
    rotors = np.linalg.inv(geometry) * full / vehicle.rotor_thrust_max_n
    columns = [(float(c[0]), float(c[1]), float(c[2]), float(c[3])) for c in rotors.T]
    return columns[0], columns[1], columns[2], columns[3]


def make_gains(vehicle: VehicleFile, px4: str = "1.18") -> LoopGains:
    """Return the loops' constants; px4 is "1.18" (with the attitude reference model) or "1.13" (without)."""
    if px4 not in PX4_VERSIONS:
        raise ValueError(f"px4 version {px4!r} is not one of {', '.join(PX4_VERSIONS)}")
    norm = normalisation(vehicle)
    p, i, d = [], [], []
    for axis in range(3):
        gain, damping = rate_loop_gains(vehicle.rate_lag_s[axis], vehicle.rotor_lag_s)
        unit = vehicle.inertia_kg_m2[axis] / norm.torque_max_n_m[axis]
        p.append(gain * unit)
        i.append(vehicle.rate_integral_1_s[axis] * gain * unit)
        d.append(damping * unit)
    attitude = vehicle.attitude_gain_1_s
    roll, pitch, yaw, thrust = _mix(vehicle, norm)
    return LoopGains(
        (p[0], p[1], p[2]),
        (i[0], i[1], i[2]),
        (d[0], d[1], d[2]),
        _INTEGRAL_LIMIT,
        _INTEGRAL_ERROR_MAX_RAD_S,
        (attitude[0], attitude[1], attitude[2] / _YAW_WEIGHT),
        _YAW_WEIGHT,
        _RATE_MAX_RAD_S,
        2.0 / vehicle.attitude_lag_s if px4 == "1.18" and vehicle.attitude_lag_s > 0.0 else 0.0,
        roll,
        pitch,
        yaw,
        thrust,
        vehicle.curve_factor,
    )


def hover_thrusts(vehicle: VehicleFile, thrust_n: float) -> Vec4:
    """Return the rotor thrusts [N] that give a collective thrust [N] without torque."""
    mix = make_gains(vehicle).mix_thrust
    share = 0.25 * thrust_n
    return (share * mix[0], share * mix[1], share * mix[2], share * mix[3])
