"""Where the local origin lies on the Earth: PX4's simulation home near Zurich, and PX4's map projection around it.

Latitude and longitude are WGS-84's; between them and metres PX4 projects azimuthally and equidistantly on a sphere
(lib/geo, MapProjection). Both directions are here, so that every position the vehicle speaks of fits every other.
"""

from __future__ import annotations

import math

from .rotation import Vec3

HOME_LATITUDE_DEG = 47.397742
HOME_LONGITUDE_DEG = 8.545594
HOME_ALTITUDE_M = 489.4
"""Height of the local origin above mean sea level."""
GEOID_M = 47.4
"""Height of mean sea level over the WGS-84 ellipsoid there."""
_EARTH_RADIUS_M = 6371000.0
_LIMIT_M = 1.0e6
"""Beyond this the projection means nothing; keeps the integers in range whatever the vehicle does."""
_LATITUDE = math.radians(HOME_LATITUDE_DEG)
_LONGITUDE = math.radians(HOME_LONGITUDE_DEG)
_SIN, _COS = math.sin(_LATITUDE), math.cos(_LATITUDE)


def _limited(value: float) -> float:
    return min(_LIMIT_M, max(-_LIMIT_M, value)) if not math.isnan(value) else 0.0


def global_position(p: Vec3) -> tuple[int, int, float]:
    """Give latitude and longitude [1e-7 deg] and altitude above sea level [m] of a local position NED [m]."""
    x, y = _limited(p[0]) / _EARTH_RADIUS_M, _limited(p[1]) / _EARTH_RADIUS_M
    arc = math.hypot(x, y)
    if arc == 0.0:
        return round(1.0e7 * HOME_LATITUDE_DEG), round(1.0e7 * HOME_LONGITUDE_DEG), HOME_ALTITUDE_M - p[2]
    sine, cosine = math.sin(arc), math.cos(arc)
    latitude = math.asin(cosine * _SIN + x * sine * _COS / arc)
    longitude = _LONGITUDE + math.atan2(y * sine, arc * _COS * cosine - x * _SIN * sine)
    return round(1.0e7 * math.degrees(latitude)), round(1.0e7 * math.degrees(longitude)), HOME_ALTITUDE_M - p[2]


def local_position(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
    """Give the local position NED [m] of a place: the inverse of `global_position`."""
    latitude, east = math.radians(latitude_deg), math.radians(longitude_deg) - _LONGITUDE
    sine, cosine = math.sin(latitude), math.cos(latitude)
    arc = math.acos(min(1.0, max(-1.0, _SIN * sine + _COS * cosine * math.cos(east))))
    scale = _EARTH_RADIUS_M * (arc / math.sin(arc) if math.sin(arc) > 0.0 else 1.0)
    north_m = scale * (_COS * sine - _SIN * cosine * math.cos(east))
    return north_m, scale * cosine * math.sin(east), HOME_ALTITUDE_M - altitude_m
