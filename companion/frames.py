"""Conversions between frames and units: the only place that has them.

Inside the program everything is north-east-down (NED), forward-right-down (FRD), SI and radians; attitudes are Hamilton
quaternions, w first, body to inertial. Files, people and other programs use degrees and other frames; they are
converted here, at the edge.
"""

from __future__ import annotations

import math
from typing import Final, Literal, NamedTuple

from companion.control.types import Quat, Vec3

Frame = Literal["ned", "enu", "nwu"]
"""The frames that positions in files come in."""

FRAMES: Final[dict[Frame, str]] = {
    "ned": "x north, y east, z down",
    "enu": "x east, y north, z up",
    "nwu": "x north, y west, z up",
}
"""Every frame with its axes, for people. "nwu" is also that of a hall whose x axis is taken for north."""

EARTH_RADIUS_M = 6371000.0
"""Of the sphere that PX4 projects with."""


class GeoPoint(NamedTuple):
    """A place on the Earth, WGS-84."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above mean sea level, or above home, as the file says."""


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


def ned_from(frame: Frame, v: Vec3) -> Vec3:
    """A vector of one of the `FRAMES`, as north-east-down."""
    if frame == "enu":
        return ned_from_enu(v)
    return (v[0], -v[1], -v[2]) if frame == "nwu" else v


def yaw_ned_from(frame: Frame, yaw_rad: float) -> float:
    """A heading, counted in that frame from x towards y, as one clockwise from north; affine, so rates change sign with
    it."""
    if frame == "enu":
        return 0.5 * math.pi - yaw_rad
    return -yaw_rad if frame == "nwu" else yaw_rad


def compass_deg(yaw_rad: float, digits: int = 6) -> float:
    """A heading as a compass shows it: degrees clockwise from north, from 0 to below 360, rounded to so many digits."""
    return round(math.degrees(yaw_rad) % 360.0, digits) % 360.0


def ned_from_geo(point: GeoPoint, origin: GeoPoint) -> Vec3:
    """Where a point lies from another one, NED [m]: PX4's azimuthal equidistant projection on a sphere around `origin`.

    Both altitudes count from the same level. Up to some ten kilometres it is as good as the autopilot's own.
    """
    latitude, latitude0 = math.radians(point.latitude_deg), math.radians(origin.latitude_deg)
    turn = math.radians(point.longitude_deg - origin.longitude_deg)
    sin0, cos0 = math.sin(latitude0), math.cos(latitude0)
    north = cos0 * math.sin(latitude) - sin0 * math.cos(latitude) * math.cos(turn)
    east = math.cos(latitude) * math.sin(turn)
    along = sin0 * math.sin(latitude) + cos0 * math.cos(latitude) * math.cos(turn)
    sine = math.hypot(north, east)
    # The angle from its sine and cosine: acos alone loses centimetres near the origin.
    scale = EARTH_RADIUS_M * (math.atan2(sine, along) / sine if sine > 0.0 else 1.0)
    return (scale * north, scale * east, origin.altitude_m - point.altitude_m)


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
