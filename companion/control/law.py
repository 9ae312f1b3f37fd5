"""The adaptive backstepping law with thrust by dynamic extension (sections I-IV of the paper), as pure functions.

Read it top down: `errors` (8) (25) (30) (15), `estimator_rate` (33) with its projection, `evaluate` (19) (34) (20)
which gives the derivatives of the controller's state and the angular acceleration, and `step`, which integrates those
derivatives over one sample and limits them. `evaluate` is the continuous form: an ODE integrator can call it. `step`
calls the same function: there is one set of equations.

The drag D is part of the model: q2, q3, q4 stand wherever the paper has p_d'', p_d''', p_d''''. What the print gets
wrong is listed in docs/law.md. All functions are kernels (see `companion.accelerate`): plain Python, or compiled from
the same source.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.control.heading import HeadingState, heading_torque
from companion.control.types import Quat, Reference, State, Vec3
from companion.control.vectors import axes, cross, norm

LIMIT_THRUST_MIN = 1
LIMIT_THRUST_MAX = 2
LIMIT_ROLL_PITCH_RATE = 4
LIMIT_YAW_RATE = 8
LIMIT_DISTURBANCE = 16
LIMIT_ESTIMATOR_FROZEN = 32
LIMIT_HEADING_HELD = 64

PROJECTION_LAYER = 0.1
"""Share of the ball's radius over which the projection fades in: a hard one would step the torque."""


LEAD_FADE_1_S = 0.2
"""How fast the memory of the autopilot's integrals fades: slower leads are left to the autopilot, as trims."""


class Gains(NamedTuple):
    """The gain set, in the paper's symbols; `companion.control.certificate` says which sets are sound."""

    k1: float
    """Position loop [1/s]."""
    k2: float
    """Velocity loop, dimensionless."""
    k3: float
    """Acceleration loop [1/s]."""
    k4: float
    """Jerk loop [1/s]."""
    gamma: float
    """Estimator gain [1/s^3], scalar; 0 switches the estimator off."""
    p_max: float
    """Bound of the position error that the law reacts to [m] (26)."""
    heading_kind: int
    """heading.DAMPING, heading.SIDESLIP or heading.COMMANDED."""
    l1: float
    """Heading error gain [1/s] (42)."""
    l2: float
    """Heading rate gain [1/s] (42)."""
    damping: float
    """Yaw rate damping [1/s], where no heading is wanted or defined."""


class Model(NamedTuple):
    """What the law knows of the vehicle and the world."""

    mass: float
    """[kg]"""
    gravity: float
    """[m/s^2]"""
    drag: float
    """Linear drag D [1/s]."""
    rate_lag: Vec3
    """Time constants of the body rates behind their setpoints [s]; 0: the setpoint is w + tau dt."""
    rate_integral: Vec3
    """Integral over proportional gain of the autopilot's rate loops [1/s]: their answer to leads is taken back out."""
    thrust_lag: float
    """Time constant of the thrust behind its setpoint that the command makes up for [s]; 0: no compensation."""


class Limits(NamedTuple):
    """Every saturation of the control step, by name."""

    thrust_min: float
    """[N], above zero: also the smallest divisor in (20)."""
    thrust_max: float
    """[N]"""
    rate_max: Vec3
    """Largest commanded body rates [rad/s]: roll and pitch keep their direction, yaw is cut by itself."""
    disturbance_max: float
    """Radius B of the ball that b_hat stays in [m/s^2]."""
    heading_rate_max: float
    """Fastest turn of the desired heading [rad/s]."""
    heading_speed_min: float
    """|r3d x p_d'| below which the last heading is held; left again at twice the value [m/s]."""


class ControllerState(NamedTuple):
    """What the controller remembers from one sample to the next."""

    thrust: float
    """T [N]."""
    thrust_rate: float
    """T' [N/s]."""
    b_hat: Vec3
    """Estimate of b/m, NED [m/s^2]."""
    heading: HeadingState
    lead_integral: Vec3
    """What the autopilot's rate integrals hold because setpoints lead the rates [rad]."""


class Errors(NamedTuple):
    """The four errors of the paper, NED [m], and the bounded first one."""

    e1: Vec3
    e2: Vec3
    e3: Vec3
    e4: Vec3
    sigma: Vec3
    """sigma(e1): e1 within p_max (26)."""


class Evaluation(NamedTuple):
    """The law at one instant."""

    errors: Errors
    b_hat_rate: Vec3
    """The estimate's derivative that is really integrated: 0 while frozen, projected at the bound [m/s^3]."""
    thrust_acceleration: float
    """T'' [N/s^2]."""
    tau: Vec3
    """Angular acceleration w' [rad/s^2]."""
    heading: HeadingState
    heading_error: float
    """Angle from the desired to the actual heading [rad], NaN when none is wanted."""


class Command(NamedTuple):
    """What one control step asks of the vehicle."""

    thrust: float
    """Collective thrust setpoint [N]."""
    rates: Vec3
    """Body rate setpoint, FRD [rad/s]."""
    rates_model: Vec3
    """The setpoint that has the same effect on a rate loop without integral: what a prediction uses [rad/s]."""
    tau: Vec3
    """Angular acceleration that it stands for [rad/s^2]."""
    limits: int
    """Which limits acted: a sum of LIMIT_*."""


class Parameters(NamedTuple):
    """All constants of a control step."""

    gains: Gains
    model: Model
    limits: Limits


def errors(
    state: State, ref: Reference, thrust: float, thrust_rate: float, b_hat: Vec3, gains: Gains, model: Model
) -> Errors:
    """The errors e1 to e4 of equations (8), (25), (30), (15), and sigma(e1) of (26)."""
    k1 = gains.k1
    per_k1 = 1.0 / k1
    c0 = per_k1 * per_k1 / gains.k2
    c1 = c0 / (k1 * gains.k2 + gains.k3)
    (p0, p1, p2), (v0, v1, v2), q, (w1, w2, _) = state
    (pd0, pd1, pd2), (vd0, vd1, vd2), (ad0, ad1, ad2), (jd0, jd1, jd2), _, _, _, _ = ref
    (r10, r11, r12), (r20, r21, r22), (r30, r31, r32) = axes(q)
    b0, b1, b2 = b_hat
    t_m = thrust / model.mass
    td_m = thrust_rate / model.mass
    d = model.drag

    x, y, z = p0 - pd0, p1 - pd1, p2 - pd2
    size = math.sqrt(x * x + y * y + z * z)
    bound = gains.p_max / size if size > gains.p_max else 1.0
    s0, s1, s2 = bound * x, bound * y, bound * z

    e20, e21, e22 = s0 + per_k1 * (v0 - vd0), s1 + per_k1 * (v1 - vd1), s2 + per_k1 * (v2 - vd2)
    # a = g u3 - (T/m) r3 + b_hat - q2
    e30 = e20 + c0 * (b0 - t_m * r30 - ad0 - d * vd0)
    e31 = e21 + c0 * (b1 - t_m * r31 - ad1 - d * vd1)
    e32 = e22 + c0 * (b2 - t_m * r32 - ad2 - d * vd2 + model.gravity)
    # j = -(T'/m) r3 - (T/m) R S(w) u3 - q3, with R S(w) u3 = w2 r1 - w1 r2
    f1, f2 = -t_m * w2, t_m * w1
    e40 = e30 + c1 * (f1 * r10 + f2 * r20 - td_m * r30 - jd0 - d * ad0)
    e41 = e31 + c1 * (f1 * r11 + f2 * r21 - td_m * r31 - jd1 - d * ad1)
    e42 = e32 + c1 * (f1 * r12 + f2 * r22 - td_m * r32 - jd2 - d * ad2)
    return Errors((x, y, z), (e20, e21, e22), (e30, e31, e32), (e40, e41, e42), (s0, s1, s2))


def estimator_rate(e: Errors, b_hat: Vec3, gamma: float, bound: float) -> Vec3:
    """b_hat' = Gamma (e2 + e3 + e4) (33), projected so that |b_hat| stays within `bound`.

    In the outer PROJECTION_LAYER of the ball the outward part fades out smoothly. As long as the true value lies inside
    that layer (|b/m| <= 0.9 B), the projection only adds a non-positive term to V'.
    """
    _, (e20, e21, e22), (e30, e31, e32), (e40, e41, e42), _ = e
    b0, b1, b2 = b_hat
    x, y, z = gamma * (e20 + e30 + e40), gamma * (e21 + e31 + e41), gamma * (e22 + e32 + e42)
    size_sq = b0 * b0 + b1 * b1 + b2 * b2
    inner = (1.0 - PROJECTION_LAYER) * bound
    outward = b0 * x + b1 * y + b2 * z
    if size_sq > inner * inner and outward > 0.0:
        share = min(1.0, (size_sq - inner * inner) / (bound * bound - inner * inner))
        cut = share * outward / size_sq
        return (x - cut * b0, y - cut * b1, z - cut * b2)
    return (x, y, z)


def error_rates(e: Errors, e1_rate: Vec3, b_hat_rate: Vec3, gains: Gains, drag: float) -> tuple[Vec3, Vec3, Vec3]:
    """e2', e3', e4' of the closed loop (docs/law.md section 3 in one line each), with b_tilde taken as zero.

    Args:
        e: the errors [m].
        e1_rate: v - p_d' [m/s].
        b_hat_rate: the estimate's derivative [m/s^3].
        gains: the gain set.
        drag: D [1/s].
    """
    k1, k2, k3, k4, _, p_max, _, _, _, _ = gains
    (x, y, z), (e20, e21, e22), (e30, e31, e32), (e40, e41, e42), _ = e
    x1, y1, z1 = e1_rate
    c0 = 1.0 / (k1 * k1 * k2)
    # Ds e1' is the rate of sigma: all of e1' inside, its tangential part shrunk by p_max/|e1| outside.
    size_sq = x * x + y * y + z * z
    radial = 0.0
    bound = 1.0
    if size_sq > p_max * p_max:
        bound = p_max / math.sqrt(size_sq)
        radial = (x * x1 + y * y1 + z * z1) / size_sq
    kk = k1 * k2
    ks = kk + k3
    share = drag / k1
    # per axis; -D e1'/k1 is the drag's share
    d0, d1, d2 = kk * (e30 - e20), kk * (e31 - e21), kk * (e32 - e22)
    e2r0 = bound * (x1 - radial * x) - share * x1 + d0
    e2r1 = bound * (y1 - radial * y) - share * y1 + d1
    e2r2 = bound * (z1 - radial * z) - share * z1 + d2
    g0, g1, g2 = e2r0 + ks * (e40 - e30), e2r1 + ks * (e41 - e31), e2r2 + ks * (e42 - e32)
    k4s = ks + k4
    return (
        (e2r0, e2r1, e2r2),
        (g0 + c0 * b_hat_rate[0], g1 + c0 * b_hat_rate[1], g2 + c0 * b_hat_rate[2]),
        (g0 - d0 - k4s * e40, g1 - d1 - k4s * e41, g2 - d2 - k4s * e42),
    )


def thrust_and_torque(
    e: Errors,
    b_hat_rate: Vec3,
    body: tuple[Vec3, Vec3, Vec3],
    w: Vec3,
    ref: Reference,
    thrust: float,
    thrust_rate: float,
    parameters: Parameters,
) -> tuple[float, float, float]:
    """T'', tau1, tau2 from equations (19), (34), (20).

    Divides by max(T, thrust_min): below that the law is not defined, and the thrust limit keeps the flight away from
    there.
    """
    gains, model, limits = parameters
    k1, k2, k3, k4, _, _, _, _, _, _ = gains
    kk = k1 * k2
    ks = kk + k3
    k_sum = ks + k4
    c0 = 1.0 / (k1 * kk)
    c1 = c0 / ks
    d = model.drag
    (r10, r11, r12), (r20, r21, r22), (r30, r31, r32) = body
    w1, w2, w3 = w
    _, (e20, e21, e22), (e30, e31, e32), (e40, e41, e42), _ = e
    j0, j1, j2 = ref.j
    s0, s1, s2 = ref.s
    # h (19) without its gyroscopic term, plus c0 b_hat' (34); q4 = p_d'''' + D p_d'''
    h0 = kk * (e30 - e20) + k_sum * e40 - c1 * (s0 + d * j0) + c0 * b_hat_rate[0]
    h1 = kk * (e31 - e21) + k_sum * e41 - c1 * (s1 + d * j1) + c0 * b_hat_rate[1]
    h2 = kk * (e32 - e22) + k_sum * e42 - c1 * (s2 + d * j2) + c0 * b_hat_rate[2]
    m_c1 = model.mass / c1
    # S(w) (S(w) T u3 + 2 T' u3) of (19), in body coordinates, where S(w) u3 = (w2, -w1, 0), is added to R'h; its factor
    # c1/m cancels in (34)
    t_w3, two_t_rate = thrust * w3, 2.0 * thrust_rate
    y0 = t_w3 * w1 + two_t_rate * w2 - m_c1 * (r10 * h0 + r11 * h1 + r12 * h2)
    y1 = t_w3 * w2 - two_t_rate * w1 - m_c1 * (r20 * h0 + r21 * h1 + r22 * h2)
    y2 = -thrust * (w1 * w1 + w2 * w2) - m_c1 * (r30 * h0 + r31 * h1 + r32 * h2)
    divisor = max(thrust, limits.thrust_min)
    return (-y2, y1 / divisor, -y0 / divisor)


def evaluate(
    state: State, ref: Reference, controller: ControllerState, parameters: Parameters, frozen: bool, dt_s: float
) -> Evaluation:
    """The law at one instant: errors, derivatives of the controller's state, angular acceleration.

    Args:
        state: the vehicle at the time for which the command is computed.
        ref: the reference at the same time.
        controller: T, T', b_hat and the heading's memory.
        parameters: gains, model and limits.
        frozen: the estimator stands still (thrust at a limit, on the ground, stale state).
        dt_s: sample interval for the heading's rate limit [s]; 0 for the continuous form, which has none.
    """
    gains, model, limits = parameters
    thrust, thrust_rate, b_hat, memory, _ = controller
    _, v, q, w = state
    _, vd, ad, jd, sd, _, _, _ = ref
    gamma, d = gains.gamma, model.drag
    body = axes(q)
    e = errors(state, ref, thrust, thrust_rate, b_hat, gains, model)
    b_hat_rate = (0.0, 0.0, 0.0)
    b_hat_acceleration = (0.0, 0.0, 0.0)
    if not frozen and gamma > 0.0:
        b_hat_rate = estimator_rate(e, b_hat, gamma, limits.disturbance_max)
        # b_hat'' is needed by the heading only, and is left out while the projection bends b_hat'
        x, y, z = e.e2[0] + e.e3[0] + e.e4[0], e.e2[1] + e.e3[1] + e.e4[1], e.e2[2] + e.e3[2] + e.e4[2]
        if b_hat_rate == (gamma * x, gamma * y, gamma * z):
            e1_rate = (v[0] - vd[0], v[1] - vd[1], v[2] - vd[2])
            e2r, e3r, e4r = error_rates(e, e1_rate, b_hat_rate, gains, d)
            b_hat_acceleration = (
                gamma * (e2r[0] + e3r[0] + e4r[0]),
                gamma * (e2r[1] + e3r[1] + e4r[1]),
                gamma * (e2r[2] + e3r[2] + e4r[2]),
            )
    thrust_acceleration, tau1, tau2 = thrust_and_torque(e, b_hat_rate, body, w, ref, thrust, thrust_rate, parameters)
    # F/m = g u3 + b_hat - q2 and its derivatives: the direction that the thrust will have with no error (41)
    x, y, z = ad
    x1, y1, z1 = jd
    force = (b_hat[0] - x - d * vd[0], b_hat[1] - y - d * vd[1], b_hat[2] - z - d * vd[2] + model.gravity)
    force_rate = (b_hat_rate[0] - x1 - d * x, b_hat_rate[1] - y1 - d * y, b_hat_rate[2] - z1 - d * z)
    force_acceleration = (
        b_hat_acceleration[0] - sd[0] - d * x1,
        b_hat_acceleration[1] - sd[1] - d * y1,
        b_hat_acceleration[2] - sd[2] - d * z1,
    )
    tau3, heading, heading_error = heading_torque(
        state,
        ref,
        (force, force_rate, force_acceleration),
        memory,
        gains.heading_kind,
        (gains.l1, gains.l2, gains.damping),
        (limits.heading_rate_max, limits.heading_speed_min),
        dt_s,
        body,
    )
    return Evaluation(e, b_hat_rate, thrust_acceleration, (tau1, tau2, tau3), heading, heading_error)


def rate_setpoint(w: float, tau: float, lag_s: float, dt_s: float) -> float:
    """Setpoint that, held over dt, takes a first-order rate loop from w to w + tau dt (docs/law.md section 8)."""
    if lag_s <= 0.0:
        return w + tau * dt_s
    return w - tau * dt_s / math.expm1(-dt_s / lag_s)


def step(
    state: State, ref: Reference, controller: ControllerState, parameters: Parameters, frozen: bool, dt_s: float
) -> tuple[Command, ControllerState, Evaluation]:
    """One sampled control step: evaluate the law, integrate its state over dt, and limit.

    T += T' dt + T'' dt^2/2, T' += T'' dt, b_hat += b_hat' dt (explicit Euler on T diverges when sampled slowly).
    At a thrust limit T' may only lead back inside, and the estimator stops.

    Args:
        state: the vehicle at the time the command takes effect.
        ref: the reference at the same time.
        controller: the controller's state.
        parameters: gains, model and limits.
        frozen: hold the estimator still for another reason than the thrust limits.
        dt_s: time since the last step, from the vehicle's own stamps [s].

    Returns:
        the command, the next controller state, and the evaluation behind it.
    """
    _, model, limits = parameters
    thrust_min, thrust_max, (most_x, most_y, most_z), bound, _, _ = limits
    thrust_now, thrust_rate_now, (b0, b1, b2), _, (lead_x, lead_y, lead_z) = controller
    hold = frozen or thrust_now <= thrust_min or thrust_now >= thrust_max
    out = evaluate(state, ref, controller, parameters, hold, dt_s)
    _, (b0_rate, b1_rate, b2_rate), thrust_acceleration, tau, heading, _ = out
    flags = 0
    if hold:
        flags |= LIMIT_ESTIMATOR_FROZEN
    if heading.held:
        flags |= LIMIT_HEADING_HELD

    thrust = thrust_now + dt_s * (thrust_rate_now + 0.5 * dt_s * thrust_acceleration)
    thrust_rate = thrust_rate_now + dt_s * thrust_acceleration
    if thrust <= thrust_min:
        thrust = thrust_min
        thrust_rate = max(0.0, thrust_rate)
        flags |= LIMIT_THRUST_MIN
    elif thrust >= thrust_max:
        thrust = thrust_max
        thrust_rate = min(0.0, thrust_rate)
        flags |= LIMIT_THRUST_MAX
    b0, b1, b2 = b0 + dt_s * b0_rate, b1 + dt_s * b1_rate, b2 + dt_s * b2_rate
    size_sq = b0 * b0 + b1 * b1 + b2 * b2
    if size_sq > (1.0 - PROJECTION_LAYER) ** 2 * bound * bound:
        flags |= LIMIT_DISTURBANCE
        if size_sq > bound * bound:  # the last of the discretisation: the smooth projection has done the rest
            shrink = bound / math.sqrt(size_sq)
            b0, b1, b2 = shrink * b0, shrink * b1, shrink * b2
    (wx, wy, wz), lag = state.w, model.rate_lag
    x = rate_setpoint(wx, tau[0], lag[0], dt_s)
    y = rate_setpoint(wy, tau[1], lag[1], dt_s)
    z = rate_setpoint(wz, tau[2], lag[2], dt_s)
    if abs(x) > most_x or abs(y) > most_y:
        over = max(abs(x) / most_x, abs(y) / most_y)
        x, y = x / over, y / over
        flags |= LIMIT_ROLL_PITCH_RATE
    if abs(z) > most_z:
        z = math.copysign(most_z, z)
        flags |= LIMIT_YAW_RATE
    kx, ky, kz = model.rate_integral
    rx, ry, rz = x - kx * lead_x, y - ky * lead_y, z - kz * lead_z
    if abs(rx) > most_x:
        rx = math.copysign(most_x, rx)
    if abs(ry) > most_y:
        ry = math.copysign(most_y, ry)
    if abs(rz) > most_z:
        rz = math.copysign(most_z, rz)
    # The autopilot integrates every lead w_cmd - w. All of it must not be taken back out: what a constant torque
    # disturbance leaves is the integral's own business, so the memory fades.
    lead = (
        lead_x + dt_s * (x - wx - (kx + LEAD_FADE_1_S) * lead_x),
        lead_y + dt_s * (y - wy - (ky + LEAD_FADE_1_S) * lead_y),
        lead_z + dt_s * (z - wz - (kz + LEAD_FADE_1_S) * lead_z),
    )
    # the same inversion for the rotors' lag: the setpoint that brings the thrust to T at the end of the interval
    ahead = rate_setpoint(thrust_now, (thrust - thrust_now) / dt_s, model.thrust_lag, dt_s)
    if ahead > thrust_max:
        ahead = thrust_max
        flags |= LIMIT_THRUST_MAX
    elif ahead < thrust_min:
        ahead = thrust_min
        flags |= LIMIT_THRUST_MIN
    command = Command(ahead, (rx, ry, rz), (x, y, z), tau, flags)
    return command, ControllerState(thrust, thrust_rate, (b0, b1, b2), heading, lead), out


def start(thrust: float, q: Quat, mass: float, gravity: float, bound: float) -> tuple[float, Vec3]:
    """T(0) and b_hat(0) = (T/m) r3 - g u3, bounded, for a take-over from a hover in which nothing steps (section 8)."""
    r3 = axes(q)[2]
    t_m = thrust / mass
    b = (t_m * r3[0], t_m * r3[1], t_m * r3[2] - gravity)
    size = norm(b)
    if size > bound:
        b = (b[0] * bound / size, b[1] * bound / size, b[2] * bound / size)
    return thrust, b


def lyapunov(e: Errors, p_max: float) -> float:
    """V_H of docs/law.md section 4 without its b_tilde term, which nobody can measure [m^2]."""
    (x, y, z), (e20, e21, e22), (e30, e31, e32), (e40, e41, e42), _ = e
    size_sq = x * x + y * y + z * z
    potential = 0.5 * size_sq if size_sq <= p_max * p_max else p_max * math.sqrt(size_sq) - 0.5 * p_max * p_max
    outer = e20 * e20 + e21 * e21 + e22 * e22 + e30 * e30 + e31 * e31 + e32 * e32
    return potential + 0.5 * (outer + e40 * e40 + e41 * e41 + e42 * e42)


def torque(tau: Vec3, w: Vec3, inertia: Vec3) -> Vec3:
    """n = J tau + S(w) J w [N m] (6), J diagonal [kg m^2]."""
    momentum = (inertia[0] * w[0], inertia[1] * w[1], inertia[2] * w[2])
    gyro = cross(w, momentum)
    return (inertia[0] * tau[0] + gyro[0], inertia[1] * tau[1] + gyro[1], inertia[2] * tau[2] + gyro[2])
