"""What the law's own model of the vehicle does with a command over a short time: the piece that the prediction is made
of.

First-order body rates and thrust behind their setpoints, the rigid body of docs/law.md section 1 with drag and the
estimated disturbance. A kernel; `companion.control.history` gives the pieces that the steps of a flight run through,
and the certificate linearises the very same function.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, exp, sin, sqrt

from companion.control.types import PlainState, State, Vec3

PIECE = 5
"""Numbers of a piece: mean thrust setpoint [N], mean rate setpoints [rad/s], duration [s]."""

Lags = tuple[float, float, float, float]
"""Time constants of roll, pitch, yaw rate and thrust behind their setpoints [s]."""
Factors = tuple[float, float, float, float, float, float, float, float]


def lag_factors(lag_s: float, dt_s: float) -> tuple[float, float]:
    """What is left of a gap after dt, and on average over dt."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    decay = exp(-dt_s / lag_s)
    return decay, (1.0 - decay) * lag_s / dt_s


def factors(lags: Lags, dt_s: float) -> Factors:
    """`lag_factors` of roll, pitch, yaw rate and thrust, one after the other."""
    x, y, z, t = (
        lag_factors(lags[0], dt_s),
        lag_factors(lags[1], dt_s),
        lag_factors(lags[2], dt_s),
        lag_factors(lags[3], dt_s),
    )
    return (x[0], x[1], y[0], y[1], z[0], z[1], t[0], t[1])


def advance(
    state: State,
    thrust: float,
    rates: Vec3,
    thrust_setpoint: float,
    b_hat: Vec3,
    vehicle: tuple[float, float, float],
    lags: Factors,
    dt_s: float,
) -> tuple[State, float]:
    """The vehicle dt later, under one command: body rates [rad/s] and thrust [N] as they are asked for.

    The rest is as for `through`.
    """
    piece = (thrust_setpoint, rates[0], rates[1], rates[2], dt_s)
    (p, v, q, w), thrust = through(state, thrust, piece, 0, 1, b_hat, vehicle, lags)
    return State(p, v, q, w), thrust


def through(
    state: PlainState,
    thrust: float,
    pieces: Sequence[float],
    at: int,
    count: int,
    b_hat: Vec3,
    vehicle: tuple[float, float, float],
    lags: Factors,
) -> tuple[PlainState, float]:
    """The vehicle after some pieces, one command each.

    Args:
        state: where it is; its quaternion has unit length.
        thrust: the thrust that acts now [N].
        pieces: PIECE numbers each.
        at: where the first one begins.
        count: how many.
        b_hat: disturbance estimate, NED [m/s^2].
        vehicle: mass [kg], gravity [m/s^2], drag [1/s].
        lags: `factors` for the pieces' duration.

    Returns:
        the state and the thrust at the end; second order in the duration of a piece.
    """
    mass, gravity, drag = vehicle
    (px, py, pz), (vx, vy, vz), (a, b, c, d), (wx, wy, wz) = state
    x0, x1, y0, y1, z0, z1, t0, t1 = lags
    b0, b1, b2 = b_hat
    per_mass = 1.0 / mass
    # half of the thrust's direction r3: of two of them the mean is the sum
    north, east, down = b * d + a * c, c * d - a * b, 0.5 - b * b - c * c
    for _ in range(count):
        setpoint, rx, ry, rz, dt_s = pieces[at], pieces[at + 1], pieces[at + 2], pieces[at + 3], pieces[at + 4]
        at += PIECE
        # body rates and thrust: where the lag brings them, and their means on the way
        x, y, z, gap = wx - rx, wy - ry, wz - rz, thrust - setpoint
        i, j, k = rx + x * x1, ry + y * y1, rz + z * z1
        s = 0.5 * dt_s
        half_sq = s * s * (i * i + j * j + k * k)  # of the angle turned, as in `vectors.quat_exp`
        if half_sq < 1e-12:
            by, r = s * (1.0 - half_sq / 6.0), 1.0 - 0.5 * half_sq
        else:
            half = sqrt(half_sq)
            by, r = s * sin(half) / half, cos(half)
        i, j, k = by * i, by * j, by * k
        wx, wy, wz = rx + x * x0, ry + y * y0, rz + z * z0
        a, b, c, d = (
            a * r - b * i - c * j - d * k,
            a * i + b * r + c * k - d * j,
            a * j - b * k + c * r + d * i,
            a * k + b * j - c * i + d * r,
        )
        from_north, from_east, from_down = north, east, down
        north, east, down = b * d + a * c, c * d - a * b, 0.5 - b * b - c * c
        pull = per_mass * (setpoint + gap * t1)
        a0 = b0 - drag * vx - pull * (from_north + north)
        a1 = b1 - drag * vy - pull * (from_east + east)
        a2 = b2 - drag * vz - pull * (from_down + down) + gravity
        from_x, from_y, from_z = vx, vy, vz
        vx, vy, vz = vx + dt_s * a0, vy + dt_s * a1, vz + dt_s * a2
        px, py, pz = px + s * (from_x + vx), py + s * (from_y + vy), pz + s * (from_z + vz)
        thrust = setpoint + gap * t0
    return ((px, py, pz), (vx, vy, vz), (a, b, c, d), (wx, wy, wz)), thrust
