"""Vector and rotation helpers on tuples of floats, so that the law reads like the paper.

Every function is a kernel: it runs as plain Python and compiles with numba from the same source.
"""

from __future__ import annotations

import math

from companion.control.types import Quat, Vec3


def add(a: Vec3, b: Vec3) -> Vec3:
    """The sum a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vec3, b: Vec3) -> Vec3:
    """The difference a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s: float, a: Vec3) -> Vec3:
    """The multiple s a."""
    return (s * a[0], s * a[1], s * a[2])


def dot(a: Vec3, b: Vec3) -> float:
    """The scalar product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    """S(a) b = a x b."""
    (x, y, z), (u, v, w) = a, b
    return (y * w - z * v, z * u - x * w, x * v - y * u)


def norm(a: Vec3) -> float:
    """The length |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def axes(q: Quat) -> tuple[Vec3, Vec3, Vec3]:
    """The columns r1, r2, r3 of R(q): the body's axes in inertial coordinates."""
    w, x, y, z = q
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        (1.0 - yy - zz, xy + wz, xz - wy),
        (xy - wz, 1.0 - xx - zz, yz + wx),
        (xz + wy, yz - wx, 1.0 - xx - yy),
    )


def rotate_to_body(q: Quat, a: Vec3) -> Vec3:
    """R' a: an inertial vector in body coordinates."""
    r1, r2, r3 = axes(q)
    return (dot(r1, a), dot(r2, a), dot(r3, a))


def rotate_to_inertial(q: Quat, a: Vec3) -> Vec3:
    """R a: a body vector in inertial coordinates."""
    r1, r2, r3 = axes(q)
    return (
        r1[0] * a[0] + r2[0] * a[1] + r3[0] * a[2],
        r1[1] * a[0] + r2[1] * a[1] + r3[1] * a[2],
        r1[2] * a[0] + r2[2] * a[1] + r3[2] * a[2],
    )


def quat_multiply(a: Quat, b: Quat) -> Quat:
    """The Hamilton product a b."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def quat_exp(rotation: Vec3) -> Quat:
    """The unit quaternion of a rotation vector [rad]; exact, with the series near zero."""
    x, y, z = rotation
    half_sq = 0.25 * (x * x + y * y + z * z)
    if half_sq < 1e-12:
        s = 0.5 * (1.0 - half_sq / 6.0)
        c = 1.0 - 0.5 * half_sq
    else:
        half = math.sqrt(half_sq)
        s = 0.5 * math.sin(half) / half
        c = math.cos(half)
    return (c, s * x, s * y, s * z)


def quat_normalise(q: Quat) -> Quat:
    """The unit quaternion in the direction of q; q must not be zero."""
    w, x, y, z = q
    s = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return (s * w, s * x, s * y, s * z)


def clip(x: float, low: float, high: float) -> float:
    """The value x, held within [low, high]."""
    return low if x < low else high if x > high else x
