"""Rotation maths on plain tuples: vectors, unit quaternions, exponential and logarithm.

Quaternions are Hamilton, w first, and rotate body (FRD) vectors to inertial (NED) ones. Everything here is scalar
arithmetic on tuples of floats, so that it runs as plain Python and compiles with numba unchanged.
"""

from __future__ import annotations

import math

Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]
Quat = tuple[float, float, float, float]

_SMALL_ANGLE_SQUARED = 1.0e-8
"""Below this angle^2 [rad^2] series stand in for the quotients with sines: their next term is under 1e-17."""


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Return the vector product a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def dot(a: Vec3, b: Vec3) -> float:
    """Return the scalar product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def norm(a: Vec3) -> float:
    """Return the length |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def clip(value: float, low: float, high: float) -> float:
    """Return value kept within [low, high]; a NaN stays a NaN."""
    if value < low:
        return low
    if value > high:
        return high
    return value


def multiply(a: Quat, b: Quat) -> Quat:
    """Return the quaternion product a b: first b, then a, for vectors that go from body to inertial."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def conjugate(q: Quat) -> Quat:
    """Return the inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def normalised(q: Quat) -> Quat:
    """Return q / |q|; NaN in every element when there is no attitude in q: zero, a NaN or an infinity."""
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if not (square > 0.0 and square < math.inf):
        return (math.nan, math.nan, math.nan, math.nan)
    scale = 1.0 / math.sqrt(square)
    return (q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)


def rotate(q: Quat, a: Vec3) -> Vec3:
    """Return the body vector a in the inertial frame (R a)."""
    w, x, y, z = q
    tx = 2.0 * (y * a[2] - z * a[1])
    ty = 2.0 * (z * a[0] - x * a[2])
    tz = 2.0 * (x * a[1] - y * a[0])
    return (
        a[0] + w * tx + y * tz - z * ty,
        a[1] + w * ty + z * tx - x * tz,
        a[2] + w * tz + x * ty - y * tx,
    )


def rotate_back(q: Quat, a: Vec3) -> Vec3:
    """Return the inertial vector a in the body frame (R' a)."""
    return rotate((q[0], -q[1], -q[2], -q[3]), a)


def body_z(q: Quat) -> Vec3:
    """Return the body's z axis (down through the belly) in the inertial frame: r3 = R u3."""
    w, x, y, z = q
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)


def inertial_z_in_body(q: Quat) -> Vec3:
    """Return the inertial down axis in the body frame: the third row of R."""
    w, x, y, z = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z)


def exponential(a: Vec3) -> Quat:
    """Return the quaternion of a rotation by |a| [rad] about a: exact, and of unit length to rounding."""
    square = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    if square < _SMALL_ANGLE_SQUARED:
        scale = 0.5 - square * (1.0 / 48.0)
        return (1.0 - square * (0.125 - square * (1.0 / 384.0)), a[0] * scale, a[1] * scale, a[2] * scale)
    angle = math.sqrt(square)
    scale = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), a[0] * scale, a[1] * scale, a[2] * scale)


def logarithm(q: Quat) -> Vec3:
    """Return the rotation vector [rad] of a unit quaternion, the short way round (length at most pi)."""
    w, x, y, z = q
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    square = x * x + y * y + z * z
    if square < _SMALL_ANGLE_SQUARED:
        scale = 2.0 / w * (1.0 - square / (3.0 * w * w))
    else:
        sine = math.sqrt(square)
        scale = 2.0 * math.atan2(sine, w) / sine
    return (x * scale, y * scale, z * scale)


def from_yaw(yaw: float) -> Quat:
    """Return the level attitude with the nose at yaw [rad], clockwise from north."""
    return (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))


def yaw_of(q: Quat) -> float:
    """Return the heading [rad] of the nose, -pi..pi, clockwise from north."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
