"""Where the local origin lies on the Earth: PX4's simulation home near Zurich, and the flat Earth around it."""

from __future__ import annotations

import math

from .rotation import Vec3

HOME_LATITUDE_DEG = 47.397742
HOME_LONGITUDE_DEG = 8.545594
HOME_ALTITUDE_M = 489.4
"""Height of the local origin above mean sea level."""
_EARTH_RADIUS_M = 6371000.0
_METRES_PER_DEGREE = math.radians(1.0) * _EARTH_RADIUS_M
_LIMIT_M = 1.0e6
"""Beyond this the flat Earth means nothing; keeps the integers in range whatever the vehicle does."""


def global_position(p: Vec3) -> tuple[int, int, float]:
    """Give latitude and longitude [1e-7 deg] and altitude above sea level [m] of a local position NED [m]."""
    north = min(_LIMIT_M, max(-_LIMIT_M, p[0])) if not math.isnan(p[0]) else 0.0
    east = min(_LIMIT_M, max(-_LIMIT_M, p[1])) if not math.isnan(p[1]) else 0.0
    latitude = HOME_LATITUDE_DEG + north / _METRES_PER_DEGREE
    longitude = HOME_LONGITUDE_DEG + east / (_METRES_PER_DEGREE * math.cos(math.radians(HOME_LATITUDE_DEG)))
    return round(1.0e7 * latitude), round(1.0e7 * longitude), HOME_ALTITUDE_M - p[2]
