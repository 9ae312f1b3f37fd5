"""A cautious hover in body rates and thrust that needs to know nothing of a vehicle but the command that holds it up.

It flies while a vehicle is identified, before there is a model that the law could fly with: position and velocity to
acceleration, acceleration to thrust direction, direction to rates, each slower than the one below. The gains leave
room for rate loops of 0.15 s and delays of 0.1 s, and for a thrust that answers half or twice as strongly as assumed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.control.types import GRAVITY_M_S2, Quat, Reference, State, Vec3
from companion.control.vectors import axes, clip, norm, rotate_to_body

POSITION_GAIN_1_S2 = 0.7
VELOCITY_GAIN_1_S = 1.5
INTEGRAL_GAIN_1_S3 = 0.15
ATTITUDE_GAIN_1_S = 3.5
HEADING_GAIN_1_S = 1.0
ERROR_MAX_M = 2.0
"""A larger position error asks for no more."""
INTEGRAL_MAX_M_S2 = 3.0
CLIMB_MAX_M_S2 = 3.0
"""Of the vertical acceleration, either way."""
TILT_MAX_RAD = 0.35
RATE_MAX_RAD_S = 1.5
HEADING_RATE_MAX_RAD_S = 0.4
THRUST_RANGE = (0.4, 1.7)
"""Of the command, as a share of the one that hovers."""
COSINE_MIN = 0.6


class HoverCommand(NamedTuple):
    """What the hover asks for."""

    thrust: float
    """Over the thrust that hovers level, dimensionless."""
    rates: Vec3
    """Body rates, FRD [rad/s]."""
    integral: Vec3
    """The integral's next value, NED [m/s^2]: what a steady force asks for."""


def hover(state: State, ref: Reference, integral: Vec3, dt_s: float) -> HoverCommand:
    """One step.

    Args:
        state: of the vehicle.
        ref: position, velocity, acceleration and yaw are followed; the rest means nothing.
        integral: from the step before, NED [m/s^2].
        dt_s: since then [s]; 0 leaves the integral as it is.
    """
    error, slower = _apart(ref.p, state.p), _apart(ref.v, state.v)
    size = norm(error)
    if size > ERROR_MAX_M:
        error = (error[0] * ERROR_MAX_M / size, error[1] * ERROR_MAX_M / size, error[2] * ERROR_MAX_M / size)
    summed = [
        clip(i + INTEGRAL_GAIN_1_S3 * e * dt_s, -INTEGRAL_MAX_M_S2, INTEGRAL_MAX_M_S2)
        for i, e in zip(integral, error, strict=True)
    ]
    north, east, down = (
        a + i + VELOCITY_GAIN_1_S * dv + POSITION_GAIN_1_S2 * dp
        for a, i, dv, dp in zip(ref.a, summed, slower, error, strict=True)
    )
    down = clip(down, -CLIMB_MAX_M_S2, CLIMB_MAX_M_S2)
    most = (GRAVITY_M_S2 - down) * math.tan(TILT_MAX_RAD)
    aside = math.hypot(north, east)
    if aside > most:
        north, east = north * most / aside, east * most / aside
    lift = (-north, -east, GRAVITY_M_S2 - down)  # the thrust over the mass, opposite to where it pushes
    _, _, r3 = axes(state.q)
    along = lift[0] * r3[0] + lift[1] * r3[1] + lift[2] * r3[2]
    thrust = clip(max(along, GRAVITY_M_S2 * COSINE_MIN) / GRAVITY_M_S2, *THRUST_RANGE)
    rates = turn_to(state.q, lift, ref.yaw)
    return HoverCommand(thrust, rates, (summed[0], summed[1], summed[2]))


def turn_to(q: Quat, down: Vec3, yaw: float) -> Vec3:
    """Body rates that turn body z towards a direction and the nose towards a heading [rad/s].

    Args:
        q: attitude.
        down: where body z is to point, NED, of any length.
        yaw: the heading [rad].
    """
    x, y, z = rotate_to_body(q, down)
    aside = math.hypot(x, y)
    # w x u3 = (w2, -w1, 0) is to point along (x, y), at the gain times the angle
    gain = ATTITUDE_GAIN_1_S * math.atan2(aside, z) / aside if aside > 1e-9 else 0.0
    roll = clip(-gain * y, -RATE_MAX_RAD_S, RATE_MAX_RAD_S)
    pitch = clip(gain * x, -RATE_MAX_RAD_S, RATE_MAX_RAD_S)
    r1, _, _ = axes(q)
    off = yaw - math.atan2(r1[1], r1[0])
    off = math.atan2(math.sin(off), math.cos(off))
    turn = clip(HEADING_GAIN_1_S * off, -HEADING_RATE_MAX_RAD_S, HEADING_RATE_MAX_RAD_S)
    return (roll, pitch, turn)


def _apart(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
