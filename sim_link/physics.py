"""Rigid body with four rotors: one fourth-order step on SO(3), and the ground.

Frames: inertial north-east-down, body forward-right-down. Thrust acts along -body z. Model:

    p' = v                  v' = g u3 - (T/m) r3 - D (v - air) + force/m
    R' = R S(w)             J w' = n - w x J w
    T_i' = (T_i,cmd - T_i) / lag

The rotors' lag is solved exactly. The body rates go through the classic Runge-Kutta scheme; they do not depend on the
attitude, so that the attitude over the step is the exact exponential of a fourth-order Magnus series of them, and the
quaternion stays a unit one. The velocity sees the attitude at the ends and in the middle of the step: order four
throughout.

Scalar code on tuples: runs as plain Python, compiles with numba unchanged (see `accelerate`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .rotation import Quat, Vec3, Vec4, body_z, clip, exponential, from_yaw, inertial_z_in_body, multiply
from .vehicle_file import VehicleFile

STANDARD_GRAVITY_M_S2 = 9.81
"""What the law assumes; a world's gravity is a factor times this."""

_FRICTION = 0.6
"""Coulomb coefficient of the landing gear on the ground."""
_LEVELLING_1_S = 20.0
"""How fast the gear turns a tilted vehicle upright: rate [rad/s] per sine of the tilt."""
_LEVELLING_MAX_RAD_S = 3.0


class Body(NamedTuple):
    """Constants of the vehicle and of the gravity that it is in."""

    mass_kg: float
    inertia_kg_m2: Vec3
    """Principal moments about body x, y, z."""
    drag_1_s: float
    """Linear drag D: the air brakes by m D (v - air)."""
    gravity_m_s2: float
    """Gravity of the world."""
    rotor_thrust_max_n: float
    """Of one rotor at full command."""
    rotor_lag_s: float
    """First-order lag from command to thrust; 0 = none."""
    curve_factor: float
    """f of thrust/thrust_max = f u^2 + (1 - f) u."""
    rotor_x_m: Vec4
    """Forward positions, in the order of the commands."""
    rotor_y_m: Vec4
    """Positions to the right."""
    rotor_yaw_m: Vec4
    """Yaw moment per newton of thrust; positive turns the nose right."""
    rotor_share: Vec4
    """Of its thrust that each rotor still gives at a command; 1 = whole, 0 = it stands still."""


class RigidState(NamedTuple):
    """The whole mechanical state."""

    p: Vec3
    """Position, NED [m]."""
    v: Vec3
    """Velocity, NED [m/s]."""
    q: Quat
    """Attitude, body to inertial."""
    w: Vec3
    """Body rates, FRD [rad/s]."""
    rotor_n: Vec4
    """Thrust of each rotor [N]."""


def make_body(vehicle: VehicleFile, gravity_m_s2: float) -> Body:
    """Return the constants of a vehicle in a world with this gravity [m/s^2]."""
    return Body(
        vehicle.mass_kg,
        vehicle.inertia_kg_m2,
        vehicle.drag_1_s,
        gravity_m_s2,
        vehicle.rotor_thrust_max_n,
        vehicle.rotor_lag_s,
        vehicle.curve_factor,
        vehicle.rotor_x_m,
        vehicle.rotor_y_m,
        vehicle.rotor_yaw_m,
        (1.0, 1.0, 1.0, 1.0),
    )


def at_rest(p: Vec3, yaw: float, rotor_n: Vec4) -> RigidState:
    """Return a level vehicle without motion at p [m, NED], nose at yaw [rad], its rotors giving rotor_n [N]."""
    return RigidState(p, (0.0, 0.0, 0.0), from_yaw(yaw), (0.0, 0.0, 0.0), rotor_n)


def rotor_target(command: float, body: Body) -> float:
    """Return the thrust [N] on which a whole rotor settles: command kept to 0..1, the thrust curve; NaN: it stands."""
    if not command > 0.0:
        return 0.0
    u = min(command, 1.0)
    return body.rotor_thrust_max_n * (body.curve_factor * u * u + (1.0 - body.curve_factor) * u)


def wrench(rotor_n: Vec4, body: Body) -> Vec4:
    """Return (collective thrust [N], roll, pitch, yaw moment [N m]) of rotor thrusts.

    A thrust T along -z at (x, y, 0) has the moment (x, y, 0) x (0, 0, -T) = (-y T, x T, 0).
    """
    a, b, c, d = rotor_n
    x = body.rotor_x_m
    y = body.rotor_y_m
    k = body.rotor_yaw_m
    return (
        a + b + c + d,
        -(y[0] * a + y[1] * b + y[2] * c + y[3] * d),
        x[0] * a + x[1] * b + x[2] * c + x[3] * d,
        k[0] * a + k[1] * b + k[2] * c + k[3] * d,
    )


def _decayed(start: Vec4, target: Vec4, left: float) -> Vec4:
    """Return where a first-order lag is when the share `left` of the way from start to target is still to go."""
    return (
        target[0] + (start[0] - target[0]) * left,
        target[1] + (start[1] - target[1]) * left,
        target[2] + (start[2] - target[2]) * left,
        target[3] + (start[3] - target[3]) * left,
    )


def _angular_acceleration(x: float, y: float, z: float, load: Vec4, inertia: Vec3) -> Vec3:
    """Return w' of Euler's equation at the body rates (x, y, z) under a wrench."""
    jx, jy, jz = inertia
    return (
        (load[1] + (jy - jz) * y * z) / jx,
        (load[2] + (jz - jx) * z * x) / jy,
        (load[3] + (jx - jy) * x * y) / jz,
    )


def _spin(w: Vec3, a1: Vec3, half: Vec4, end: Vec4, inertia: Vec3, dt: float) -> Vec3:
    """Return the body rates after dt: classic Runge-Kutta from w with w' = a1, wrenches at the middle and the end."""
    x, y, z = w
    h = 0.5 * dt
    a2 = _angular_acceleration(x + h * a1[0], y + h * a1[1], z + h * a1[2], half, inertia)
    a3 = _angular_acceleration(x + h * a2[0], y + h * a2[1], z + h * a2[2], half, inertia)
    a4 = _angular_acceleration(x + dt * a3[0], y + dt * a3[1], z + dt * a3[2], end, inertia)
    s = dt / 6.0
    return (
        x + s * (a1[0] + 2.0 * (a2[0] + a3[0]) + a4[0]),
        y + s * (a1[1] + 2.0 * (a2[1] + a3[1]) + a4[1]),
        z + s * (a1[2] + 2.0 * (a2[2] + a3[2]) + a4[2]),
    )


def _turn(w0: Vec3, w1: Vec3, a0: Vec3, a1: Vec3, dt: float) -> Vec3:
    """Return the rotation vector of a step with rates w0, w1 and angular accelerations a0, a1 at its ends.

    Magnus series for R' = R S(w): the integral of the rates' cubic through these values, plus half the double
    integral of their cross product, dt^2/12 w0 x w1. The error is of fifth order in dt.
    """
    h = 0.5 * dt
    k = dt * dt / 12.0
    return (
        h * (w0[0] + w1[0]) + k * (a0[0] - a1[0] + w0[1] * w1[2] - w0[2] * w1[1]),
        h * (w0[1] + w1[1]) + k * (a0[1] - a1[1] + w0[2] * w1[0] - w0[0] * w1[2]),
        h * (w0[2] + w1[2]) + k * (a0[2] - a1[2] + w0[0] * w1[1] - w0[1] * w1[0]),
    )


def _turn_half(w0: Vec3, w1: Vec3, a0: Vec3, a1: Vec3, dt: float) -> Vec3:
    """Return the rotation vector of the first half of the step, from the same cubic."""
    h = 0.125 * dt
    mx = 0.5 * (w0[0] + w1[0]) + h * (a0[0] - a1[0])
    my = 0.5 * (w0[1] + w1[1]) + h * (a0[1] - a1[1])
    mz = 0.5 * (w0[2] + w1[2]) + h * (a0[2] - a1[2])
    # Over the first half the cubic's integral is dt/32 (13 w0 + 3 w1) + dt^2/192 (11 a0 - 5 a1).
    c = dt / 32.0
    d = dt * dt / 192.0
    k = dt * dt / 48.0
    return (
        c * (13.0 * w0[0] + 3.0 * w1[0]) + d * (11.0 * a0[0] - 5.0 * a1[0]) + k * (w0[1] * mz - w0[2] * my),
        c * (13.0 * w0[1] + 3.0 * w1[1]) + d * (11.0 * a0[1] - 5.0 * a1[1]) + k * (w0[2] * mx - w0[0] * mz),
        c * (13.0 * w0[2] + 3.0 * w1[2]) + d * (11.0 * a0[2] - 5.0 * a1[2]) + k * (w0[0] * my - w0[1] * mx),
    )


def _turned(q: Quat, rotation: Vec3) -> Quat:
    """Return q followed by a rotation in the body frame; a Newton step of 1/|q| takes rounding off the length."""
    a, b, c, d = multiply(q, exponential(rotation))
    scale = 1.5 - 0.5 * (a * a + b * b + c * c + d * d)
    return (a * scale, b * scale, c * scale, d * scale)


def _move(p: float, v: float, u0: float, uh: float, u1: float, drag: float, dt: float) -> tuple[float, float]:
    """Return one axis' position and velocity after dt for v' = u(t) - D v, u at start, middle and end (Runge-Kutta)."""
    h = 0.5 * dt
    k1 = u0 - drag * v
    k2 = uh - drag * (v + h * k1)
    k3 = uh - drag * (v + h * k2)
    k4 = u1 - drag * (v + dt * k3)
    s = dt / 6.0
    return p + dt * (v + s * (k1 + k2 + k3)), v + s * (k1 + 2.0 * (k2 + k3) + k4)


def step(state: RigidState, command: Vec4, air: Vec3, force_n: Vec3, body: Body, dt_s: float) -> RigidState:
    """Return the state dt_s later, in free air.

    Args:
        state: state now.
        command: rotor commands 0..1, before the thrust curve, held over the step; beyond is saturated.
        air: velocity of the air, NED [m/s], held over the step.
        force_n: further force on the centre of mass, NED [N].
        body: the vehicle's constants.
        dt_s: length of the step [s].
    """
    target = (
        body.rotor_share[0] * rotor_target(command[0], body),
        body.rotor_share[1] * rotor_target(command[1], body),
        body.rotor_share[2] * rotor_target(command[2], body),
        body.rotor_share[3] * rotor_target(command[3], body),
    )
    lag = body.rotor_lag_s
    left_half = math.exp(-0.5 * dt_s / lag) if lag > 0.0 else 0.0
    rotor = state.rotor_n if lag > 0.0 else target
    rotor_end = _decayed(rotor, target, left_half * left_half)

    # A wrench is linear in the thrusts, so it decays as they do.
    load = wrench(rotor, body)
    load_target = wrench(target, body)
    load_half = _decayed(load, load_target, left_half)
    load_end = _decayed(load, load_target, left_half * left_half)

    w0 = state.w
    a0 = _angular_acceleration(w0[0], w0[1], w0[2], load, body.inertia_kg_m2)
    w1 = _spin(w0, a0, load_half, load_end, body.inertia_kg_m2, dt_s)
    a1 = _angular_acceleration(w1[0], w1[1], w1[2], load_end, body.inertia_kg_m2)
    q_half = multiply(state.q, exponential(_turn_half(w0, w1, a0, a1, dt_s)))
    q_end = _turned(state.q, _turn(w0, w1, a0, a1, dt_s))

    m = body.mass_kg
    drag = body.drag_1_s
    z0 = body_z(state.q)
    zh = body_z(q_half)
    z1 = body_z(q_end)
    t0 = load[0] / m
    th = load_half[0] / m
    t1 = load_end[0] / m
    bx = force_n[0] / m + drag * air[0]
    by = force_n[1] / m + drag * air[1]
    bz = force_n[2] / m + drag * air[2] + body.gravity_m_s2
    p = state.p
    v = state.v
    px, vx = _move(p[0], v[0], bx - t0 * z0[0], bx - th * zh[0], bx - t1 * z1[0], drag, dt_s)
    py, vy = _move(p[1], v[1], by - t0 * z0[1], by - th * zh[1], by - t1 * z1[1], drag, dt_s)
    pz, vz = _move(p[2], v[2], bz - t0 * z0[2], bz - th * zh[2], bz - t1 * z1[2], drag, dt_s)
    return RigidState((px, py, pz), (vx, vy, vz), q_end, w1, rotor_end)


def _mean_arm(arms: Vec4) -> float:
    return 0.25 * (abs(arms[0]) + abs(arms[1]) + abs(arms[2]) + abs(arms[3]))


def _held_rates(w: Vec3, q: Quat, impulse_n_s: float, body: Body) -> Vec3:
    """Return the body rates that the gear leaves: towards upright and no spin, as far as its moments reach.

    Past 90 degrees of tilt the gear is in the air: the vehicle lies as it fell.
    """
    # u3 x down is the axis that turns the belly down.
    down = inertial_z_in_body(q)
    if down[2] > 0.0:
        goal_x = clip(-_LEVELLING_1_S * down[1], -_LEVELLING_MAX_RAD_S, _LEVELLING_MAX_RAD_S)
        goal_y = clip(_LEVELLING_1_S * down[0], -_LEVELLING_MAX_RAD_S, _LEVELLING_MAX_RAD_S)
    else:
        goal_x = 0.0
        goal_y = 0.0
    arm_x = _mean_arm(body.rotor_y_m)
    arm_y = _mean_arm(body.rotor_x_m)
    reach_x = impulse_n_s * arm_x / body.inertia_kg_m2[0]
    reach_y = impulse_n_s * arm_y / body.inertia_kg_m2[1]
    reach_z = impulse_n_s * _FRICTION * math.sqrt(arm_x * arm_x + arm_y * arm_y) / body.inertia_kg_m2[2]
    return (
        w[0] + clip(goal_x - w[0], -reach_x, reach_x),
        w[1] + clip(goal_y - w[1], -reach_y, reach_y),
        w[2] + clip(-w[2], -reach_z, reach_z),
    )


def contact(
    before: RigidState, after: RigidState, ground_d_m: float, body: Body, dt_s: float
) -> tuple[RigidState, float]:
    """Return a step's result corrected by the ground, and the downward speed that the ground took.

    The ground is a plane at the down coordinate ground_d_m; the vehicle touches it with its origin. It takes the
    downward velocity (no bounce); that impulse bounds what friction takes from sliding and what the gear's moments
    take from turning. At rest all of it is taken, and position and attitude are led by the corrected rates, so that
    nothing creeps.

    Args:
        before: state at the start of the step.
        after: result of `step`.
        ground_d_m: down coordinate of the ground [m].
        body: the vehicle's constants.
        dt_s: length of the step [s].

    Returns:
        The corrected state, and the speed [m/s] at which it met the ground: g dt at rest, more at a touchdown; -1.0 in
        the air.
    """
    sinking = after.v[2]
    if not (after.p[2] >= ground_d_m and sinking >= 0.0):
        return after, -1.0
    vx, vy = after.v[0], after.v[1]
    sliding = math.sqrt(vx * vx + vy * vy)
    kept = 1.0 - min(1.0, _FRICTION * sinking / sliding) if sliding > 0.0 else 0.0
    vx *= kept
    vy *= kept
    w = _held_rates(after.w, before.q, body.mass_kg * sinking, body)
    h = 0.5 * dt_s
    p = (before.p[0] + h * (before.v[0] + vx), before.p[1] + h * (before.v[1] + vy), ground_d_m)
    turn = (h * (before.w[0] + w[0]), h * (before.w[1] + w[1]), h * (before.w[2] + w[2]))
    return RigidState(p, (vx, vy, 0.0), _turned(before.q, turn), w, after.rotor_n), sinking
