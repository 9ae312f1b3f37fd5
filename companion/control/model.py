"""What the law's own model of the vehicle does with a command over a short time: the piece that the prediction is made
of.

First-order body rates and thrust behind their setpoints, the rigid body of docs/law.md section 1 with drag and the
estimated disturbance. A kernel; `companion.control.history` gives the pieces that the steps of a flight run through,
and the certificate linearises the very same function.
"""

from __future__ import annotations

import math

from companion.control.types import State, Vec3
from companion.control.vectors import quat_exp, quat_normalise

Lags = tuple[float, float, float, float]
"""Time constants of roll, pitch, yaw rate and thrust behind their setpoints [s]."""
Factors = tuple[float, float, float, float, float, float, float, float]


def lagged(x: float, setpoint: float, lag_s: float, dt_s: float) -> tuple[float, float]:
    """A first-order lag after dt, and its mean over dt."""
    decay, share = lag_factors(lag_s, dt_s)
    gap = x - setpoint
    return setpoint + gap * decay, setpoint + gap * share


def lag_factors(lag_s: float, dt_s: float) -> tuple[float, float]:
    """What is left of a gap after dt, and on average over dt."""
    if lag_s <= 0.0:
        return 0.0, 0.0
    decay = math.exp(-dt_s / lag_s)
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
    """The vehicle dt later, under one command.

    Args:
        state: where it is.
        thrust: the thrust that acts now [N].
        rates: commanded body rates [rad/s].
        thrust_setpoint: commanded thrust [N].
        b_hat: disturbance estimate, NED [m/s^2].
        vehicle: mass [kg], gravity [m/s^2], drag [1/s].
        lags: `factors` for this dt.
        dt_s: above zero [s].

    Returns:
        the state and the thrust at the end; second order in dt.
    """
    mass, gravity, drag = vehicle
    p, v, (a, b, c, d), (wx, wy, wz) = state
    rx, ry, rz = rates
    x0, x1, y0, y1, z0, z1, t0, t1 = lags
    # body rates and thrust: where the lag brings them, and their means on the way
    x, y, z = wx - rx, wy - ry, wz - rz
    gap = thrust - thrust_setpoint
    w = (rx + x * x0, ry + y * y0, rz + z * z0)
    half = 0.5 * (thrust_setpoint + gap * t1) / mass
    r, i, j, k = quat_exp((dt_s * (rx + x * x1), dt_s * (ry + y * y1), dt_s * (rz + z * z1)))
    e, f, g, h = quat_normalise(
        (
            a * r - b * i - c * j - d * k,
            a * i + b * r + c * k - d * j,
            a * j - b * k + c * r + d * i,
            a * k + b * j - c * i + d * r,
        )
    )
    # the sum of the thrust directions r3 at both ends
    north = 2.0 * (b * d + a * c + f * h + e * g)
    east = 2.0 * (c * d - a * b + g * h - e * f)
    down = 2.0 - 2.0 * (b * b + c * c + f * f + g * g)
    a0 = b_hat[0] - drag * v[0] - half * north
    a1 = b_hat[1] - drag * v[1] - half * east
    a2 = b_hat[2] - drag * v[2] - half * down + gravity
    s = 0.5 * dt_s * dt_s
    position = (p[0] + dt_s * v[0] + s * a0, p[1] + dt_s * v[1] + s * a1, p[2] + dt_s * v[2] + s * a2)
    velocity = (v[0] + dt_s * a0, v[1] + dt_s * a1, v[2] + dt_s * a2)
    return State(position, velocity, (e, f, g, h), w), thrust_setpoint + gap * t0
