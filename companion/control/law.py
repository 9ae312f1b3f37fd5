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
from companion.control.vectors import axes, cross, dot, norm

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
    c0 = 1.0 / (k1 * k1 * gains.k2)
    c1 = c0 / (k1 * gains.k2 + gains.k3)
    r1, r2, r3 = axes(state.q)
    t_m = thrust / model.mass
    td_m = thrust_rate / model.mass
    d = model.drag
    w1, w2, _ = state.w

    x, y, z = state.p[0] - ref.p[0], state.p[1] - ref.p[1], state.p[2] - ref.p[2]
    size = math.sqrt(x * x + y * y + z * z)
    bound = gains.p_max / size if size > gains.p_max else 1.0
    s = (bound * x, bound * y, bound * z)

    e2 = (s[0] + (state.v[0] - ref.v[0]) / k1, s[1] + (state.v[1] - ref.v[1]) / k1, s[2] + (state.v[2] - ref.v[2]) / k1)
    # a = g u3 - (T/m) r3 + b_hat - q2
    e3 = (
        e2[0] + c0 * (b_hat[0] - t_m * r3[0] - ref.a[0] - d * ref.v[0]),
        e2[1] + c0 * (b_hat[1] - t_m * r3[1] - ref.a[1] - d * ref.v[1]),
        e2[2] + c0 * (b_hat[2] - t_m * r3[2] - ref.a[2] - d * ref.v[2] + model.gravity),
    )
    # j = -(T'/m) r3 - (T/m) R S(w) u3 - q3, with R S(w) u3 = w2 r1 - w1 r2
    f1, f2 = -t_m * w2, t_m * w1
    e4 = (
        e3[0] + c1 * (f1 * r1[0] + f2 * r2[0] - td_m * r3[0] - ref.j[0] - d * ref.a[0]),
        e3[1] + c1 * (f1 * r1[1] + f2 * r2[1] - td_m * r3[1] - ref.j[1] - d * ref.a[1]),
        e3[2] + c1 * (f1 * r1[2] + f2 * r2[2] - td_m * r3[2] - ref.j[2] - d * ref.a[2]),
    )
    return Errors((x, y, z), e2, e3, e4, s)


def estimator_rate(e: Errors, b_hat: Vec3, gamma: float, bound: float) -> Vec3:
    """b_hat' = Gamma (e2 + e3 + e4) (33), projected so that |b_hat| stays within `bound`.

    In the outer PROJECTION_LAYER of the ball the outward part fades out smoothly. As long as the true value lies inside
    that layer (|b/m| <= 0.9 B), the projection only adds a non-positive term to V'.
    """
    x = gamma * (e.e2[0] + e.e3[0] + e.e4[0])
    y = gamma * (e.e2[1] + e.e3[1] + e.e4[1])
    z = gamma * (e.e2[2] + e.e3[2] + e.e4[2])
    size_sq = b_hat[0] * b_hat[0] + b_hat[1] * b_hat[1] + b_hat[2] * b_hat[2]
    inner = (1.0 - PROJECTION_LAYER) * bound
    outward = b_hat[0] * x + b_hat[1] * y + b_hat[2] * z
    if size_sq > inner * inner and outward > 0.0:
        share = min(1.0, (size_sq - inner * inner) / (bound * bound - inner * inner))
        cut = share * outward / size_sq
        return (x - cut * b_hat[0], y - cut * b_hat[1], z - cut * b_hat[2])
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
    k1, k2, k3, k4 = gains.k1, gains.k2, gains.k3, gains.k4
    c0 = 1.0 / (k1 * k1 * k2)
    # Ds e1' is the rate of sigma: all of e1' inside, its tangential part shrunk by p_max/|e1| outside.
    size_sq = e.e1[0] * e.e1[0] + e.e1[1] * e.e1[1] + e.e1[2] * e.e1[2]
    radial = 0.0
    bound = 1.0
    if size_sq > gains.p_max * gains.p_max:
        bound = gains.p_max / math.sqrt(size_sq)
        radial = dot(e.e1, e1_rate) / size_sq
    kk = k1 * k2
    ks = kk + k3
    # per axis; -D e1'/k1 is the drag's share
    e2r0 = bound * (e1_rate[0] - radial * e.e1[0]) - drag * e1_rate[0] / k1 + kk * (e.e3[0] - e.e2[0])
    e2r1 = bound * (e1_rate[1] - radial * e.e1[1]) - drag * e1_rate[1] / k1 + kk * (e.e3[1] - e.e2[1])
    e2r2 = bound * (e1_rate[2] - radial * e.e1[2]) - drag * e1_rate[2] / k1 + kk * (e.e3[2] - e.e2[2])
    g0 = e2r0 + ks * (e.e4[0] - e.e3[0])
    g1 = e2r1 + ks * (e.e4[1] - e.e3[1])
    g2 = e2r2 + ks * (e.e4[2] - e.e3[2])
    return (
        (e2r0, e2r1, e2r2),
        (g0 + c0 * b_hat_rate[0], g1 + c0 * b_hat_rate[1], g2 + c0 * b_hat_rate[2]),
        (
            g0 - kk * (e.e3[0] - e.e2[0]) - (ks + k4) * e.e4[0],
            g1 - kk * (e.e3[1] - e.e2[1]) - (ks + k4) * e.e4[1],
            g2 - kk * (e.e3[2] - e.e2[2]) - (ks + k4) * e.e4[2],
        ),
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
    gains, model = parameters.gains, parameters.model
    k1 = gains.k1
    c0 = 1.0 / (k1 * k1 * gains.k2)
    kk = k1 * gains.k2
    ks = kk + gains.k3
    c1 = c0 / ks
    k_sum = ks + gains.k4
    d = model.drag
    r1, r2, r3 = body
    w1, w2, w3 = w
    # S(w) (S(w) T u3 + 2 T' u3) of (19), in body coordinates, where S(w) u3 = (w2, -w1, 0); its factor c1/m cancels in
    # (34)
    gyro = (
        thrust * w3 * w1 + 2.0 * thrust_rate * w2,
        thrust * w3 * w2 - 2.0 * thrust_rate * w1,
        -thrust * (w1 * w1 + w2 * w2),
    )
    # h (19) without that term, plus c0 b_hat' (34); q4 = p_d'''' + D p_d'''
    h = (
        kk * (e.e3[0] - e.e2[0]) + k_sum * e.e4[0] - c1 * (ref.s[0] + d * ref.j[0]) + c0 * b_hat_rate[0],
        kk * (e.e3[1] - e.e2[1]) + k_sum * e.e4[1] - c1 * (ref.s[1] + d * ref.j[1]) + c0 * b_hat_rate[1],
        kk * (e.e3[2] - e.e2[2]) + k_sum * e.e4[2] - c1 * (ref.s[2] + d * ref.j[2]) + c0 * b_hat_rate[2],
    )
    m_c1 = model.mass / c1
    y0 = -m_c1 * dot(r1, h) + gyro[0]
    y1 = -m_c1 * dot(r2, h) + gyro[1]
    y2 = -m_c1 * dot(r3, h) + gyro[2]
    divisor = max(thrust, parameters.limits.thrust_min)
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
    gains, model, limits = parameters.gains, parameters.model, parameters.limits
    body = axes(state.q)
    e = errors(state, ref, controller.thrust, controller.thrust_rate, controller.b_hat, gains, model)
    b_hat_rate = (0.0, 0.0, 0.0)
    b_hat_acceleration = (0.0, 0.0, 0.0)
    if not frozen and gains.gamma > 0.0:
        b_hat_rate = estimator_rate(e, controller.b_hat, gains.gamma, limits.disturbance_max)
    # b_hat'' is needed by the heading only, and is left out while the projection bends b_hat'
    if not frozen and gains.gamma > 0.0 and b_hat_rate[0] == gains.gamma * (e.e2[0] + e.e3[0] + e.e4[0]):
        e1_rate = (state.v[0] - ref.v[0], state.v[1] - ref.v[1], state.v[2] - ref.v[2])
        e2r, e3r, e4r = error_rates(e, e1_rate, b_hat_rate, gains, model.drag)
        b_hat_acceleration = (
            gains.gamma * (e2r[0] + e3r[0] + e4r[0]),
            gains.gamma * (e2r[1] + e3r[1] + e4r[1]),
            gains.gamma * (e2r[2] + e3r[2] + e4r[2]),
        )
    thrust_acceleration, tau1, tau2 = thrust_and_torque(
        e, b_hat_rate, body, state.w, ref, controller.thrust, controller.thrust_rate, parameters
    )
    b, d = controller.b_hat, model.drag
    # F/m = g u3 + b_hat - q2 and its derivatives: the direction that the thrust will have with no error (41)
    force = (
        b[0] - ref.a[0] - d * ref.v[0],
        b[1] - ref.a[1] - d * ref.v[1],
        b[2] - ref.a[2] - d * ref.v[2] + model.gravity,
    )
    force_rate = (
        b_hat_rate[0] - ref.j[0] - d * ref.a[0],
        b_hat_rate[1] - ref.j[1] - d * ref.a[1],
        b_hat_rate[2] - ref.j[2] - d * ref.a[2],
    )
    force_acceleration = (
        b_hat_acceleration[0] - ref.s[0] - d * ref.j[0],
        b_hat_acceleration[1] - ref.s[1] - d * ref.j[1],
        b_hat_acceleration[2] - ref.s[2] - d * ref.j[2],
    )
    tau3, heading, heading_error = heading_torque(
        state,
        ref,
        (force, force_rate, force_acceleration),
        controller.heading,
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
    model, limits = parameters.model, parameters.limits
    at_limit = controller.thrust <= limits.thrust_min or controller.thrust >= limits.thrust_max
    hold = frozen or at_limit
    out = evaluate(state, ref, controller, parameters, hold, dt_s)
    flags = 0
    if hold:
        flags |= LIMIT_ESTIMATOR_FROZEN
    if out.heading.held:
        flags |= LIMIT_HEADING_HELD

    thrust = controller.thrust + dt_s * (controller.thrust_rate + 0.5 * dt_s * out.thrust_acceleration)
    thrust_rate = controller.thrust_rate + dt_s * out.thrust_acceleration
    if thrust <= limits.thrust_min:
        thrust = limits.thrust_min
        thrust_rate = max(0.0, thrust_rate)
        flags |= LIMIT_THRUST_MIN
    elif thrust >= limits.thrust_max:
        thrust = limits.thrust_max
        thrust_rate = min(0.0, thrust_rate)
        flags |= LIMIT_THRUST_MAX
    b, b_rate = controller.b_hat, out.b_hat_rate
    b_hat = (b[0] + dt_s * b_rate[0], b[1] + dt_s * b_rate[1], b[2] + dt_s * b_rate[2])
    size_sq = b_hat[0] * b_hat[0] + b_hat[1] * b_hat[1] + b_hat[2] * b_hat[2]
    bound = limits.disturbance_max
    if size_sq > (1.0 - PROJECTION_LAYER) ** 2 * bound * bound:
        flags |= LIMIT_DISTURBANCE
        if size_sq > bound * bound:  # the last of the discretisation: the smooth projection has done the rest
            shrink = bound / math.sqrt(size_sq)
            b_hat = (shrink * b_hat[0], shrink * b_hat[1], shrink * b_hat[2])
    w, tau, lag, most = state.w, out.tau, model.rate_lag, limits.rate_max
    x = rate_setpoint(w[0], tau[0], lag[0], dt_s)
    y = rate_setpoint(w[1], tau[1], lag[1], dt_s)
    z = rate_setpoint(w[2], tau[2], lag[2], dt_s)
    if abs(x) > most[0] or abs(y) > most[1]:
        over = max(abs(x) / most[0], abs(y) / most[1])
        x, y = x / over, y / over
        flags |= LIMIT_ROLL_PITCH_RATE
    if abs(z) > most[2]:
        z = math.copysign(most[2], z)
        flags |= LIMIT_YAW_RATE
    lead, k = controller.lead_integral, model.rate_integral
    rates = (
        min(max(x - k[0] * lead[0], -most[0]), most[0]),
        min(max(y - k[1] * lead[1], -most[1]), most[1]),
        min(max(z - k[2] * lead[2], -most[2]), most[2]),
    )
    # The autopilot integrates every lead w_cmd - w. All of it must not be taken back out: what a constant torque
    # disturbance leaves is the integral's own business, so the memory fades.
    lead = (
        lead[0] + dt_s * (x - w[0] - (k[0] + LEAD_FADE_1_S) * lead[0]),
        lead[1] + dt_s * (y - w[1] - (k[1] + LEAD_FADE_1_S) * lead[1]),
        lead[2] + dt_s * (z - w[2] - (k[2] + LEAD_FADE_1_S) * lead[2]),
    )
    # the same inversion for the rotors' lag: the setpoint that brings the thrust to T at the end of the interval
    ahead = rate_setpoint(controller.thrust, (thrust - controller.thrust) / dt_s, model.thrust_lag, dt_s)
    if ahead > limits.thrust_max:
        ahead = limits.thrust_max
        flags |= LIMIT_THRUST_MAX
    elif ahead < limits.thrust_min:
        ahead = limits.thrust_min
        flags |= LIMIT_THRUST_MIN
    command = Command(ahead, rates, (x, y, z), tau, flags)
    return command, ControllerState(thrust, thrust_rate, b_hat, out.heading, lead), out


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
    size = norm(e.e1)
    potential = 0.5 * size * size if size <= p_max else p_max * size - 0.5 * p_max * p_max
    return potential + 0.5 * (dot(e.e2, e.e2) + dot(e.e3, e.e3) + dot(e.e4, e.e4))


def torque(tau: Vec3, w: Vec3, inertia: Vec3) -> Vec3:
    """n = J tau + S(w) J w [N m] (6), J diagonal [kg m^2]."""
    momentum = (inertia[0] * w[0], inertia[1] * w[1], inertia[2] * w[2])
    gyro = cross(w, momentum)
    return (inertia[0] * tau[0] + gyro[0], inertia[1] * tau[1] + gyro[1], inertia[2] * tau[2] + gyro[2])
