"""Conversions between frames and units: the only place that has them.

Inside the program everything is north-east-down (NED), forward-right-down (FRD), SI and radians; attitudes are Hamilton
quaternions, w first, body to inertial. Files, people and other programs use degrees and other frames; they are
converted here, at the edge.
"""

from __future__ import annotations

import math

from companion.control.types import Quat, Vec3


def radians(degrees: float) -> float:
    """Degrees to radians."""
    return math.radians(degrees)


def degrees(radians_: float) -> float:
    """Radians to degrees."""
    return math.degrees(radians_)


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)


def enu_from_ned(v: Vec3) -> Vec3:
    """North-east-down to east-north-up; its own inverse's form (see `ned_from_enu`)."""
    return (v[1], v[0], -v[2])


def ned_from_enu(v: Vec3) -> Vec3:
    """East-north-up to north-east-down."""
    return (v[1], v[0], -v[2])


def yaw_from_quat(q: Quat) -> float:
    """Heading of the body's x axis [rad], clockwise from north."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def quat_from_yaw(yaw_rad: float) -> Quat:
    """Level attitude with that heading."""
    return (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))


def tilt_from_quat(q: Quat) -> float:
    """Angle between the body's z axis and down [rad]."""
    _, x, y, _ = q
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
