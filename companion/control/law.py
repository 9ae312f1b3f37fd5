"""The adaptive backstepping law with thrust by dynamic extension (sections I-IV of the paper), as pure functions.

Read it top down: `evaluate_plain` has the errors (8) (25) (30) (15), the estimator (33) and (19) (34) (20), and gives
the derivatives of the controller's state and the angular acceleration; `step_plain` integrates those derivatives over
one sample and limits them. `evaluate` and `step` are the same with names. `evaluate` is the continuous form: an ODE
integrator can call it. There is one set of equations.

The drag D is part of the model: q2, q3, q4 stand wherever the paper has p_d'', p_d''', p_d''''. What the print gets
wrong is listed in docs/law.md. All functions are kernels (see `companion.accelerate`): plain Python, or compiled from
the same source.
"""

from __future__ import annotations

from math import copysign, expm1, sqrt
from typing import NamedTuple

from companion.control.heading import DAMPING, HeadingState, PlainHeading, heading_torque
from companion.control.types import PlainReference, PlainState, Quat, Reference, State, Vec3
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
INNER = 1.0 - PROJECTION_LAYER


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


PlainErrors = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip
PlainEvaluation = tuple[PlainErrors, Vec3, float, Vec3, PlainHeading, float]
PlainController = tuple[float, float, Vec3, PlainHeading, Vec3]
PlainCommand = tuple[float, Vec3, Vec3, Vec3, int]
PlainParameters = tuple[
    tuple[float, float, float, float, float, float, int, float, float, float],
    tuple[float, float, float, Vec3, Vec3, float],
    tuple[float, float, Vec3, float, float, float],
]
"""What the records hold (see `types.PlainState`)."""


def projected(free: Vec3, b_hat: Vec3, bound: float) -> Vec3:
    """b_hat' (33), projected so that |b_hat| stays within `bound`.

    In the outer PROJECTION_LAYER of the ball the outward part fades out smoothly. As long as the true value lies inside
    that layer (|b/m| <= 0.9 B), the projection only adds a non-positive term to V'.

    Args:
        free: Gamma (e2 + e3 + e4) [m/s^3].
        b_hat: the estimate [m/s^2].
        bound: B [m/s^2].
    """
    b0, b1, b2 = b_hat
    size_sq = b0 * b0 + b1 * b1 + b2 * b2
    inner = INNER * bound
    if size_sq <= inner * inner:
        return free
    x, y, z = free
    outward = b0 * x + b1 * y + b2 * z
    if outward <= 0.0:
        return free
    share = min(1.0, (size_sq - inner * inner) / (bound * bound - inner * inner))
    cut = share * outward / size_sq
    return (x - cut * b0, y - cut * b1, z - cut * b2)


def evaluate(
    state: State, ref: Reference, controller: ControllerState, parameters: Parameters, frozen: bool, dt_s: float
) -> Evaluation:
    """The law at one instant (see `evaluate_plain`)."""
    return evaluation_of(evaluate_plain(state, ref, controller, parameters, frozen, dt_s))


def evaluation_of(out: PlainEvaluation) -> Evaluation:
    """The record of what `evaluate_plain` gives."""
    e, b_hat_rate, thrust_acceleration, tau, heading, heading_error = out
    errors = Errors((e[0], e[1], e[2]), (e[3], e[4], e[5]), (e[6], e[7], e[8]), (e[9], e[10], e[11]), e[12:])
    return Evaluation(errors, b_hat_rate, thrust_acceleration, tau, HeadingState(*heading), heading_error)


def evaluate_plain(
    state: PlainState,
    ref: PlainReference,
    controller: PlainController,
    parameters: PlainParameters,
    frozen: bool,
    dt_s: float,
) -> PlainEvaluation:
    """The law at one instant: errors, derivatives of the controller's state, angular acceleration.

    Written out per axis in one piece: every tuple and call on the way costs plain Python more than what is done in it.
    T'' and tau divide by max(T, thrust_min): below that the law is not defined, and the thrust limit keeps the flight
    away from there.

    Args:
        state: the vehicle at the time for which the command is computed.
        ref: the reference at the same time.
        controller: T, T', b_hat and the heading's memory.
        parameters: gains, model and limits.
        frozen: the estimator stands still (thrust at a limit, on the ground, stale state).
        dt_s: sample interval for the heading's rate limit [s]; 0 for the continuous form, which has none.
    """
    (k1, k2, k3, k4, gamma, p_max, heading_kind, l1, l2, damping), (mass, gravity, d, _, _, _), limits = parameters
    thrust_min, _, _, disturbance_max, turn_max, slow = limits
    thrust, thrust_rate, b_hat, memory, _ = controller
    (p0, p1, p2), (v0, v1, v2), q, w = state
    w1, w2, w3 = w
    (pd0, pd1, pd2), vd, ad, jd, (sd0, sd1, sd2), yaw, yaw_rate, yaw_acceleration = ref
    (vd0, vd1, vd2), (ad0, ad1, ad2), (jd0, jd1, jd2) = vd, ad, jd
    b0, b1, b2 = b_hat
    body = axes(q)
    (r10, r11, r12), (r20, r21, r22), (r30, r31, r32) = body
    per_k1, kk = 1.0 / k1, k1 * k2
    ks = kk + k3
    c0 = per_k1 / kk
    c1 = c0 / ks
    t_m, td_m = thrust / mass, thrust_rate / mass

    # What the reference asks for: F/m = g u3 + b_hat - q2 (41), the force per mass with no error, then q3 and q4
    f0, f1, f2 = b0 - ad0 - d * vd0, b1 - ad1 - d * vd1, b2 - ad2 - d * vd2 + gravity
    j0, j1, j2 = jd0 + d * ad0, jd1 + d * ad1, jd2 + d * ad2
    s0, s1, s2 = sd0 + d * jd0, sd1 + d * jd1, sd2 + d * jd2

    # e1 (8), sigma(e1) (26), e1' and e2 (25)
    e10, e11, e12 = p0 - pd0, p1 - pd1, p2 - pd2
    s10, s11, s12 = e10, e11, e12
    size_sq = e10 * e10 + e11 * e11 + e12 * e12
    outside = size_sq > p_max * p_max
    if outside:
        bound = p_max / sqrt(size_sq)
        s10, s11, s12 = bound * e10, bound * e11, bound * e12
    x1, y1, z1 = v0 - vd0, v1 - vd1, v2 - vd2
    e20, e21, e22 = s10 + per_k1 * x1, s11 + per_k1 * y1, s12 + per_k1 * z1
    # e3 (30): a = F/m - (T/m) r3
    a0, a1, a2 = f0 - t_m * r30, f1 - t_m * r31, f2 - t_m * r32
    e30, e31, e32 = e20 + c0 * a0, e21 + c0 * a1, e22 + c0 * a2
    # e4 (15): j = -(T'/m) r3 - (T/m) R S(w) u3 - q3, with R S(w) u3 = w2 r1 - w1 r2
    x, y = t_m * w1, t_m * w2
    e40 = e30 + c1 * (x * r20 - y * r10 - td_m * r30 - j0)
    e41 = e31 + c1 * (x * r21 - y * r11 - td_m * r31 - j1)
    e42 = e32 + c1 * (x * r22 - y * r12 - td_m * r32 - j2)

    # b_hat' (33), and b_hat'' = Gamma (e2' + e3' + e4') with b_tilde taken as zero, which only the heading needs; it is
    # left out while the projection bends b_hat'
    b_hat_rate = (0.0, 0.0, 0.0)
    b0_rate = b1_rate = b2_rate = 0.0
    x2 = y2 = z2 = 0.0
    if not frozen and gamma > 0.0:
        free = (gamma * (e20 + e30 + e40), gamma * (e21 + e31 + e41), gamma * (e22 + e32 + e42))
        b_hat_rate, inner = free, INNER * disturbance_max
        if b0 * b0 + b1 * b1 + b2 * b2 > inner * inner:
            b_hat_rate = projected(free, b_hat, disturbance_max)
        b0_rate, b1_rate, b2_rate = b_hat_rate
        if heading_kind != DAMPING and b_hat_rate == free:
            of_rate, of_e2, of_e3, of_e4 = 3.0 - 3.0 * d * per_k1, -2.0 * kk, -2.0 * k3, ks - k4
            x2 = of_rate * x1 + of_e2 * e20 + of_e3 * e30 + of_e4 * e40 + c0 * b0_rate
            y2 = of_rate * y1 + of_e2 * e21 + of_e3 * e31 + of_e4 * e41 + c0 * b1_rate
            z2 = of_rate * z1 + of_e2 * e22 + of_e3 * e32 + of_e4 * e42 + c0 * b2_rate
            if outside:  # Ds e1' in place of e1': its tangential part, shrunk by p_max/|e1|
                less = 3.0 * bound
                radial, less = less * (e10 * x1 + e11 * y1 + e12 * z1) / size_sq, less - 3.0
                x2, y2, z2 = x2 + less * x1 - radial * e10, y2 + less * y1 - radial * e11, z2 + less * z1 - radial * e12
            x2, y2, z2 = gamma * x2, gamma * y2, gamma * z2

    # h (19) without its gyroscopic term, plus c0 b_hat' (34); k1 k2 (e3 - e2) is a/k1
    k_sum = ks + k4
    h0 = per_k1 * a0 + k_sum * e40 - c1 * s0 + c0 * b0_rate
    h1 = per_k1 * a1 + k_sum * e41 - c1 * s1 + c0 * b1_rate
    h2 = per_k1 * a2 + k_sum * e42 - c1 * s2 + c0 * b2_rate
    # y (34): S(w) (S(w) T u3 + 2 T' u3) of (19), in body coordinates, where S(w) u3 = (w2, -w1, 0), is added to R'h;
    # its factor c1/m cancels. T'', tau1 and tau2 by (20)
    m_c1 = mass / c1
    x, y = thrust * w3, 2.0 * thrust_rate
    x, y, thrust_acceleration = (
        x * w1 + y * w2 - m_c1 * (r10 * h0 + r11 * h1 + r12 * h2),
        x * w2 - y * w1 - m_c1 * (r20 * h0 + r21 * h1 + r22 * h2),
        thrust * (w1 * w1 + w2 * w2) + m_c1 * (r30 * h0 + r31 * h1 + r32 * h2),
    )
    divisor = thrust if thrust > thrust_min else thrust_min

    # F/m with its derivatives: the direction that the thrust will have with no error
    wanted = yaw, yaw_rate, yaw_acceleration
    force = (f0, f1, f2), (b0_rate - j0, b1_rate - j1, b2_rate - j2), (x2 - s0, y2 - s1, z2 - s2)
    tau3, heading, heading_error = heading_torque(
        w, (vd, ad, jd), wanted, force, memory, heading_kind, l1, l2, damping, turn_max, slow, dt_s, body
    )
    e = (e10, e11, e12, e20, e21, e22, e30, e31, e32, e40, e41, e42, s10, s11, s12)
    return e, b_hat_rate, thrust_acceleration, (y / divisor, -x / divisor, tau3), heading, heading_error


def lead_time(lag_s: float, dt_s: float) -> float:
    """How far ahead a setpoint has to be [s]: w + tau lead, held over dt, takes a first-order rate loop from w to
    w + tau dt (docs/law.md section 8)."""
    return dt_s if lag_s <= 0.0 else -dt_s / expm1(-dt_s / lag_s)


def step(
    state: State, ref: Reference, controller: ControllerState, parameters: Parameters, frozen: bool, dt_s: float
) -> tuple[Command, ControllerState, Evaluation]:
    """One sampled control step (see `step_plain`)."""
    command, after, out = step_plain(state, ref, controller, parameters, frozen, dt_s)
    return Command(*command), controller_of(after), evaluation_of(out)


def controller_of(after: PlainController) -> ControllerState:
    """The record of a controller's state."""
    thrust, thrust_rate, b_hat, heading, lead_integral = after
    return ControllerState(thrust, thrust_rate, b_hat, HeadingState(*heading), lead_integral)


def step_plain(
    state: PlainState,
    ref: PlainReference,
    controller: PlainController,
    parameters: PlainParameters,
    frozen: bool,
    dt_s: float,
) -> tuple[PlainCommand, PlainController, PlainEvaluation]:
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
    _, _, _, (lag_x, lag_y, lag_z), (kx, ky, kz), thrust_lag = model
    thrust_min, thrust_max, (most_x, most_y, most_z), bound, _, _ = limits
    thrust_now, thrust_rate_now, (b0, b1, b2), _, (lead_x, lead_y, lead_z) = controller
    hold = frozen or thrust_now <= thrust_min or thrust_now >= thrust_max
    out = evaluate_plain(state, ref, controller, parameters, hold, dt_s)
    _, (b0_rate, b1_rate, b2_rate), thrust_acceleration, tau, heading, _ = out
    _, _, held = heading
    flags = 0
    if hold:
        flags |= LIMIT_ESTIMATOR_FROZEN
    if held:
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
    inner = INNER * bound
    if size_sq > inner * inner:
        flags |= LIMIT_DISTURBANCE
        if size_sq > bound * bound:  # the last of the discretisation: the smooth projection has done the rest
            shrink = bound / sqrt(size_sq)
            b0, b1, b2 = shrink * b0, shrink * b1, shrink * b2
    _, _, _, (wx, wy, wz) = state
    x, y, z = tau
    ahead_x = lead_time(lag_x, dt_s)
    ahead_y = ahead_x if lag_y == lag_x else lead_time(lag_y, dt_s)  # mostly they are alike
    x, y, z = wx + x * ahead_x, wy + y * ahead_y, wz + z * lead_time(lag_z, dt_s)
    if abs(x) > most_x or abs(y) > most_y:
        over = max(abs(x) / most_x, abs(y) / most_y)
        x, y = x / over, y / over
        flags |= LIMIT_ROLL_PITCH_RATE
    if abs(z) > most_z:
        z = copysign(most_z, z)
        flags |= LIMIT_YAW_RATE
    rx, ry, rz = x - kx * lead_x, y - ky * lead_y, z - kz * lead_z
    # The autopilot integrates every lead w_cmd - w. All of it must not be taken back out: what a constant torque
    # disturbance leaves is the integral's own business, so the memory fades.
    lead = (
        lead_x + dt_s * (rx - wx - LEAD_FADE_1_S * lead_x),
        lead_y + dt_s * (ry - wy - LEAD_FADE_1_S * lead_y),
        lead_z + dt_s * (rz - wz - LEAD_FADE_1_S * lead_z),
    )
    if abs(rx) > most_x:
        rx = copysign(most_x, rx)
    if abs(ry) > most_y:
        ry = copysign(most_y, ry)
    if abs(rz) > most_z:
        rz = copysign(most_z, rz)
    # the same inversion for the rotors' lag: the setpoint that brings the thrust to T at the end of the interval
    ahead = thrust_now + (thrust - thrust_now) / dt_s * lead_time(thrust_lag, dt_s)
    if ahead > thrust_max:
        ahead = thrust_max
        flags |= LIMIT_THRUST_MAX
    elif ahead < thrust_min:
        ahead = thrust_min
        flags |= LIMIT_THRUST_MIN
    return (ahead, (rx, ry, rz), (x, y, z), tau, flags), (thrust, thrust_rate, (b0, b1, b2), heading, lead), out


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
    return lyapunov_plain((*e.e1, *e.e2, *e.e3, *e.e4, *e.sigma), p_max)


def lyapunov_plain(e: PlainErrors, p_max: float) -> float:
    """The same."""
    x, y, z, e20, e21, e22, e30, e31, e32, e40, e41, e42, _, _, _ = e
    size_sq = x * x + y * y + z * z
    potential = 0.5 * size_sq if size_sq <= p_max * p_max else p_max * sqrt(size_sq) - 0.5 * p_max * p_max
    outer = e20 * e20 + e21 * e21 + e22 * e22 + e30 * e30 + e31 * e31 + e32 * e32
    return potential + 0.5 * (outer + e40 * e40 + e41 * e41 + e42 * e42)


def torque(tau: Vec3, w: Vec3, inertia: Vec3) -> Vec3:
    """n = J tau + S(w) J w [N m] (6), J diagonal [kg m^2]."""
    momentum = (inertia[0] * w[0], inertia[1] * w[1], inertia[2] * w[2])
    gyro = cross(w, momentum)
    return (inertia[0] * tau[0] + gyro[0], inertia[1] * tau[1] + gyro[1], inertia[2] * tau[2] + gyro[2])
