"""What the law's own model of the vehicle does with a command over a short time: the piece that the prediction is made
of.

First-order body rates and thrust behind their setpoints, the rigid body of paper.md section 1 with drag and the
estimated disturbance. A kernel; `companion.flight.prediction` strings the pieces together, and the certificate
linearises the very same function.
"""

from __future__ import annotations

import math

from companion.control.types import Quat, State, Vec3
from companion.control.vectors import axes, quat_exp, quat_multiply, quat_normalise


def lagged(x: float, setpoint: float, lag_s: float, dt_s: float) -> tuple[float, float]:
    """A first-order lag after dt, and its mean over dt."""
    if lag_s <= 0.0:
        return setpoint, setpoint
    decay = math.exp(-dt_s / lag_s)
    gap = x - setpoint
    return setpoint + gap * decay, setpoint + gap * (1.0 - decay) * lag_s / dt_s


def advance(
    state: State,
    thrust: float,
    rates: Vec3,
    thrust_setpoint: float,
    b_hat: Vec3,
    vehicle: tuple[float, float, float],
    lags: tuple[float, float, float, float],
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
        lags: of roll, pitch, yaw rate and thrust [s].
        dt_s: above zero [s].

    Returns:
        the state and the thrust at the end; second order in dt.
    """
    mass, gravity, drag = vehicle
    w, v = state.w, state.v
    x, x_mean = lagged(w[0], rates[0], lags[0], dt_s)
    y, y_mean = lagged(w[1], rates[1], lags[1], dt_s)
    z, z_mean = lagged(w[2], rates[2], lags[2], dt_s)
    end_thrust, mean_thrust = lagged(thrust, thrust_setpoint, lags[3], dt_s)
    q: Quat = quat_normalise(quat_multiply(state.q, quat_exp((x_mean * dt_s, y_mean * dt_s, z_mean * dt_s))))
    before, after = axes(state.q)[2], axes(q)[2]
    half = 0.5 * mean_thrust / mass
    a0 = b_hat[0] - drag * v[0] - half * (before[0] + after[0])
    a1 = b_hat[1] - drag * v[1] - half * (before[1] + after[1])
    a2 = b_hat[2] - drag * v[2] - half * (before[2] + after[2]) + gravity
    h = 0.5 * dt_s * dt_s
    p = state.p
    return (
        State(
            (p[0] + dt_s * v[0] + h * a0, p[1] + dt_s * v[1] + h * a1, p[2] + dt_s * v[2] + h * a2),
            (v[0] + dt_s * a0, v[1] + dt_s * a1, v[2] + dt_s * a2),
            q,
            (x, y, z),
        ),
        end_thrust,
    )
