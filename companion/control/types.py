"""The values that cross the control law's border: plain tuples of floats.

Everything is SI, north-east-down (NED) and forward-right-down (FRD), radians. Quaternions are Hamilton, w first, and
rotate body to inertial vectors. The tuples are what numba compiles and what plain Python handles fastest; nothing here
allocates an array.
"""

from __future__ import annotations

from typing import Final, NamedTuple

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

GRAVITY_M_S2 = 9.81
"""The gravity that the law assumes; what the world has more or less of it is part of the disturbance."""


new_record: Final = tuple.__new__
"""Makes a NamedTuple of a tuple of all its fields: for what comes with every state, as its own constructor takes three
times as long."""


PlainState = tuple[Vec3, Vec3, Quat, Vec3]
"""What a State holds. Kernels on the way of a control step hand on plain tuples: plain Python makes and unpacks them
several times as fast as it does a NamedTuple."""
PlainReference = tuple[Vec3, Vec3, Vec3, Vec3, Vec3, float, float, float]
"""What a Reference holds."""


class State(NamedTuple):
    """What the vehicle is known to do at one instant."""

    p: Vec3
    """Position, NED [m]."""
    v: Vec3
    """Velocity, NED [m/s] (the paper writes R v for it)."""
    q: Quat
    """Attitude, body to inertial."""
    w: Vec3
    """Body rates, FRD [rad/s]."""


class Reference(NamedTuple):
    """The trajectory at one instant: position with its first four derivatives, and a heading with its first two."""

    p: Vec3
    """Position p_d, NED [m]."""
    v: Vec3
    """First derivative [m/s]."""
    a: Vec3
    """Second derivative [m/s^2]."""
    j: Vec3
    """Third derivative [m/s^3]."""
    s: Vec3
    """Fourth derivative [m/s^4]."""
    yaw: float
    """Commanded heading [rad], clockwise from north; used when the heading choice is "commanded"."""
    yaw_rate: float
    """Its first derivative [rad/s]."""
    yaw_acceleration: float
    """Its second derivative [rad/s^2]."""
