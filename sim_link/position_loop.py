"""Cascaded position controller with PX4's structure and default gains: from position down to attitude and thrust.

Order of the steps, as in PX4's mc_pos_control (PositionControl): P on position plus velocity feed-forward, the
position part first in line under the velocity limit; PID on velocity plus acceleration feed-forward; thrust vector
from the acceleration with the hover thrust, limited in tilt, at the bottom and at the top with the vertical part
first but for a horizontal margin; integral with anti-windup by what the limits left. The thrust vector and the
heading make the attitude.

Scalar code on tuples: runs as plain Python, compiles with numba unchanged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .inner_loops import ATTITUDE, Setpoint
from .rotation import Quat, Vec3, clip, cross, dot, norm, yaw_of

_GRAVITY_M_S2 = 9.80665
"""What PX4's hover thrust stands for."""
_INTEGRAL_MAX_M_S2 = 1.0e6
"""Keeps finite what gains that nobody should set let diverge."""
_TINY = 1.0e-9


class PositionParameters(NamedTuple):
    """PX4's parameters of the same names, in PX4's units, at PX4's defaults; read and set by their names."""

    MPC_XY_P: float = 0.95
    """[1/s]"""
    MPC_Z_P: float = 1.0
    """[1/s]"""
    MPC_XY_VEL_P_ACC: float = 1.8
    """[1/s], as for z"""
    MPC_XY_VEL_I_ACC: float = 0.4
    """[1/s^2], as for z"""
    MPC_XY_VEL_D_ACC: float = 0.2
    """[-], as for z"""
    MPC_Z_VEL_P_ACC: float = 4.0
    MPC_Z_VEL_I_ACC: float = 2.0
    MPC_Z_VEL_D_ACC: float = 0.0
    MPC_XY_VEL_MAX: float = 12.0
    """[m/s]"""
    MPC_Z_VEL_MAX_UP: float = 3.0
    """[m/s]"""
    MPC_Z_VEL_MAX_DN: float = 1.5
    """[m/s]"""
    MPC_TILTMAX_AIR: float = 45.0
    """[deg]"""
    MPC_THR_MIN: float = 0.12
    """Share of the collective thrust, as for the others."""
    MPC_THR_MAX: float = 1.0
    MPC_THR_XY_MARG: float = 0.3
    MPC_THR_HOVER: float = 0.5
    """Share at which the vehicle hovers in standard gravity."""
    MPC_VELD_LP: float = 5.0
    """Cut-off of the measured acceleration [Hz]; 0 = no filter."""


class PositionSetpoint(NamedTuple):
    """What to fly; NaN = not commanded."""

    p: Vec3
    """Position NED [m]."""
    v: Vec3
    """Velocity NED [m/s]: feed-forward where a position is commanded too."""
    a: Vec3
    """Acceleration NED [m/s^2]: feed-forward where a position or velocity is commanded too."""
    yaw: float
    """Heading [rad]; NaN holds the present one."""
    yaw_rate: float
    """Feed-forward [rad/s]."""


class PositionState(NamedTuple):
    """What the controller remembers."""

    integral: Vec3
    """Of the velocity error [m/s^2]."""
    v_previous: Vec3
    """Velocity at the last call [m/s]."""
    v_dot: Vec3
    """Filtered derivative of the velocity [m/s^2]."""


def initial_position_state(v: Vec3) -> PositionState:
    """Return the controller's state at start, at the velocity v."""
    return PositionState((0.0, 0.0, 0.0), v, (0.0, 0.0, 0.0))


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def _either(a: float, b: float) -> float:
    """Return the sum of what is commanded; NaN when neither is."""
    if math.isnan(a):
        return b
    return a if math.isnan(b) else a + b


def _limited_horizontal(first: tuple[float, float], second: tuple[float, float], limit: float) -> tuple[float, float]:
    """Return first + second within a circle of radius `limit`; `first` has priority, `second` gets what is left."""
    x, y = first[0] + second[0], first[1] + second[1]
    if x * x + y * y <= limit * limit:
        return x, y
    length = math.sqrt(first[0] * first[0] + first[1] * first[1])
    if length >= limit:
        return first[0] * limit / length, first[1] * limit / length
    # Largest factor on `second` that stays on the circle: the positive root of |first + s second|^2 = limit^2.
    a = second[0] * second[0] + second[1] * second[1]
    b = first[0] * second[0] + first[1] * second[1]
    c = length * length - limit * limit
    s = (math.sqrt(max(0.0, b * b - a * c)) - b) / a
    return first[0] + s * second[0], first[1] + s * second[1]


def _wanted_velocity(p: Vec3, setpoint: PositionSetpoint, parameters: PositionParameters) -> Vec3:
    """Return the velocity setpoint [m/s], limited; NaN on axes with neither a position nor a velocity commanded."""
    to_go = (
        (setpoint.p[0] - p[0]) * parameters.MPC_XY_P,
        (setpoint.p[1] - p[1]) * parameters.MPC_XY_P,
        (setpoint.p[2] - p[2]) * parameters.MPC_Z_P,
    )
    x = _either(setpoint.v[0], to_go[0])
    y = _either(setpoint.v[1], to_go[1])
    z = _either(setpoint.v[2], to_go[2])
    first = (_or_zero(to_go[0]), _or_zero(to_go[1]))
    limited = _limited_horizontal(first, (_or_zero(x) - first[0], _or_zero(y) - first[1]), parameters.MPC_XY_VEL_MAX)
    return (
        math.nan if math.isnan(x) else limited[0],
        math.nan if math.isnan(y) else limited[1],
        clip(z, -parameters.MPC_Z_VEL_MAX_UP, parameters.MPC_Z_VEL_MAX_DN),
    )


def _derivative(v: Vec3, state: PositionState, cutoff_hz: float, dt_s: float) -> Vec3:
    """Return the measured acceleration through a first-order low-pass."""
    taken = 1.0 - math.exp(-2.0 * math.pi * cutoff_hz * dt_s) if cutoff_hz > 0.0 else 1.0
    old = state.v_dot
    last = state.v_previous
    return (
        old[0] + taken * ((v[0] - last[0]) / dt_s - old[0]),
        old[1] + taken * ((v[1] - last[1]) / dt_s - old[1]),
        old[2] + taken * ((v[2] - last[2]) / dt_s - old[2]),
    )


def _tilt_limited(direction: Vec3, tilt_max: float) -> Vec3:
    """Return a unit vector (up is -z) turned towards up until its tilt [rad] is allowed."""
    horizontal = math.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
    if horizontal < _TINY or math.atan2(horizontal, -direction[2]) <= tilt_max:
        return direction
    scale = math.sin(tilt_max) / horizontal
    return (direction[0] * scale, direction[1] * scale, -math.cos(tilt_max))


def limited_thrust(thrust: Vec3, thrust_max: float, margin: float) -> Vec3:
    """Return a thrust vector within thrust_max: vertical first, but for a horizontal margin."""
    x, y, z = thrust
    horizontal = math.sqrt(x * x + y * y)
    reserved = min(horizontal, margin)
    z = max(z, -math.sqrt(max(0.0, thrust_max * thrust_max - reserved * reserved)))
    left = math.sqrt(max(0.0, thrust_max * thrust_max - z * z))
    if horizontal > left:
        return (x * left / horizontal, y * left / horizontal, z)
    return (x, y, z)


def wanted_thrust(a: Vec3, parameters: PositionParameters) -> Vec3:
    """Return the thrust vector NED, as a share of the collective maximum, for an acceleration NED [m/s^2].

    It is not yet limited at the top.

    Horizontal acceleration tilts against standard gravity whatever the vertical one is (MPC_ACC_DECOUPLE = 1), and
    the collective is raised by the tilt's cosine.
    """
    up = norm((a[0], a[1], _GRAVITY_M_S2))
    direction = _tilt_limited((a[0] / up, a[1] / up, -_GRAVITY_M_S2 / up), math.radians(parameters.MPC_TILTMAX_AIR))
    hover = parameters.MPC_THR_HOVER
    vertical = a[2] * hover / _GRAVITY_M_S2 - hover
    collective = max(vertical / direction[2], parameters.MPC_THR_MIN)
    return (direction[0] * collective, direction[1] * collective, direction[2] * collective)


def thrust_attitude(thrust: Vec3, yaw: float) -> Quat:
    """Return the attitude whose -z axis is along a thrust vector NED that points upwards, nose towards yaw [rad]."""
    length = norm(thrust)
    z = (-thrust[0] / length, -thrust[1] / length, -thrust[2] / length)
    # The nose lies in the vertical plane of the heading: at right angles to the level axis to its right.
    nose = cross((-math.sin(yaw), math.cos(yaw), 0.0), z)
    size = norm(nose)
    x = (nose[0] / size, nose[1] / size, nose[2] / size)
    return _from_axes(x, cross(z, x), z)


def _from_axes(x: Vec3, y: Vec3, z: Vec3) -> Quat:
    """Return the quaternion of the rotation matrix with these columns, by its largest element."""
    trace = x[0] + y[1] + z[2]
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        return (0.25 * s, (y[2] - z[1]) / s, (z[0] - x[2]) / s, (x[1] - y[0]) / s)
    if x[0] >= y[1] and x[0] >= z[2]:
        s = 2.0 * math.sqrt(1.0 + x[0] - y[1] - z[2])
        return ((y[2] - z[1]) / s, 0.25 * s, (y[0] + x[1]) / s, (z[0] + x[2]) / s)
    if y[1] >= z[2]:
        s = 2.0 * math.sqrt(1.0 + y[1] - x[0] - z[2])
        return ((z[0] - x[2]) / s, (y[0] + x[1]) / s, 0.25 * s, (z[1] + y[2]) / s)
    s = 2.0 * math.sqrt(1.0 + z[2] - x[0] - y[1])
    return ((x[1] - y[0]) / s, (z[0] + x[2]) / s, (z[1] + y[2]) / s, 0.25 * s)


def _new_integral(
    integral: Vec3, error: Vec3, a: Vec3, wanted_z: float, thrust: Vec3, parameters: PositionParameters, dt_s: float
) -> Vec3:
    """Return the velocity integral: still at the vertical limits, led back by what the horizontal ones cut off.

    wanted_z is the thrust's down part before the upper limit, thrust what the limit made of it.
    """
    ex, ey, ez = error
    if (wanted_z >= -parameters.MPC_THR_MIN and ez >= 0.0) or (wanted_z <= -parameters.MPC_THR_MAX and ez <= 0.0):
        ez = 0.0
    scale = _GRAVITY_M_S2 / parameters.MPC_THR_HOVER
    made_x, made_y = thrust[0] * scale, thrust[1] * scale
    if a[0] * a[0] + a[1] * a[1] > made_x * made_x + made_y * made_y:
        back = 2.0 / parameters.MPC_XY_VEL_P_ACC
        ex -= back * (a[0] - made_x)
        ey -= back * (a[1] - made_y)
    gain = parameters.MPC_XY_VEL_I_ACC * dt_s
    z = integral[2] + ez * parameters.MPC_Z_VEL_I_ACC * dt_s
    x = clip(integral[0] + ex * gain, -_INTEGRAL_MAX_M_S2, _INTEGRAL_MAX_M_S2)
    y = clip(integral[1] + ey * gain, -_INTEGRAL_MAX_M_S2, _INTEGRAL_MAX_M_S2)
    return (x, y, clip(z, -_GRAVITY_M_S2, _GRAVITY_M_S2))


def position_control(
    p: Vec3,
    v: Vec3,
    q: Quat,
    setpoint: PositionSetpoint,
    state: PositionState,
    parameters: PositionParameters,
    dt_s: float,
) -> tuple[Setpoint, PositionState]:
    """Return the ATTITUDE setpoint (attitude, thrust, yaw rate) and the controller's new state.

    Args:
        p: position believed, NED [m].
        v: velocity believed, NED [m/s].
        q: attitude believed; only its heading is used, where no yaw is commanded.
        setpoint: what to fly; an axis without position, velocity and acceleration gets no acceleration.
        state: from the last call, or `initial_position_state`.
        parameters: PX4's; MPC_THR_HOVER is that of the vehicle.
        dt_s: time since the last call [s], above 0.
    """
    wanted = _wanted_velocity(p, setpoint, parameters)
    error = (_or_zero(wanted[0] - v[0]), _or_zero(wanted[1] - v[1]), _or_zero(wanted[2] - v[2]))
    v_dot = _derivative(v, state, parameters.MPC_VELD_LP, dt_s)
    sums = state.integral
    held_x = 0.0 if math.isnan(wanted[0]) else sums[0] - parameters.MPC_XY_VEL_D_ACC * v_dot[0]
    held_y = 0.0 if math.isnan(wanted[1]) else sums[1] - parameters.MPC_XY_VEL_D_ACC * v_dot[1]
    held_z = 0.0 if math.isnan(wanted[2]) else sums[2] - parameters.MPC_Z_VEL_D_ACC * v_dot[2]
    a = (
        _or_zero(setpoint.a[0]) + parameters.MPC_XY_VEL_P_ACC * error[0] + held_x,
        _or_zero(setpoint.a[1]) + parameters.MPC_XY_VEL_P_ACC * error[1] + held_y,
        _or_zero(setpoint.a[2]) + parameters.MPC_Z_VEL_P_ACC * error[2] + held_z,
    )
    raw = wanted_thrust(a, parameters)
    thrust = limited_thrust(raw, parameters.MPC_THR_MAX, parameters.MPC_THR_XY_MARG)
    integral = _new_integral(sums, error, a, raw[2], thrust, parameters, dt_s)
    yaw = yaw_of(q) if math.isnan(setpoint.yaw) else setpoint.yaw
    attitude = thrust_attitude(thrust, yaw)
    out = Setpoint(
        ATTITUDE,
        math.sqrt(dot(thrust, thrust)),
        (0.0, 0.0, 0.0),
        attitude,
        _or_zero(setpoint.yaw_rate),
        (0.0, 0.0, 0.0),
    )
    return out, PositionState(integral, v, v_dot)
