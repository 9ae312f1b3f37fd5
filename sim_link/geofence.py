"""The geofence: the cylinder of GF_MAX_HOR_DIST and GF_MAX_VER_DIST around home, and uploaded polygons and circles."""

from __future__ import annotations

import math

from . import missions
from .missions import Plans
from .parameters import Parameters
from .rotation import Vec3


class Geofence:
    """Tells whether a position is outside of what is allowed."""

    def __init__(self, parameters: Parameters, plans: Plans) -> None:
        self._parameters = parameters
        self._plans = plans
        self._version = -1
        self._inside: list[_Area] = []
        """Within at least one of these, if there are any."""
        self._outside: list[_Area] = []
        """Within none of these."""

    def breach(self, p: Vec3, home: Vec3) -> str | None:
        """Say which limit a position NED [m] is beyond; None: it is within all."""
        if self._parameters.integer("GF_ACTION") == 0:
            return None
        away_m = math.hypot(p[0] - home[0], p[1] - home[1])
        limit_m = self._parameters.number("GF_MAX_HOR_DIST")
        if limit_m > 0.0 and away_m > limit_m:
            return "maximum distance from home exceeded"
        limit_m = self._parameters.number("GF_MAX_VER_DIST")
        if limit_m > 0.0 and home[2] - p[2] > limit_m:
            return "maximum altitude above home exceeded"
        self._load()
        if any(area.contains(p[0], p[1]) for area in self._outside):
            return "within an exclusion area"
        if self._inside and not any(area.contains(p[0], p[1]) for area in self._inside):
            return "outside of the inclusion areas"
        return None

    def _load(self) -> None:
        """Build the areas anew when another fence was uploaded."""
        if self._version == self._plans.versions[missions.FENCE]:
            return
        self._version = self._plans.versions[missions.FENCE]
        self._inside, self._outside = [], []
        items = self._plans.items[missions.FENCE]
        at = 0
        while at < len(items):
            item = items[at]
            count = 1
            if item.command in (missions.POLYGON_IN, missions.POLYGON_OUT):
                count = round(item.params[0])
            corners = [corner.position((0.0, 0.0, 0.0))[:2] for corner in items[at : at + count]]
            area = _Area(corners, item.params[0] if count == 1 else 0.0)
            if item.command in (missions.POLYGON_IN, missions.CIRCLE_IN):
                self._inside.append(area)
            elif item.command in (missions.POLYGON_OUT, missions.CIRCLE_OUT):
                self._outside.append(area)
            at += count


class _Area:
    """A polygon, or with one corner a circle."""

    def __init__(self, corners: list[tuple[float, float]], radius_m: float) -> None:
        self._corners = corners
        self._radius_m = radius_m

    def contains(self, north_m: float, east_m: float) -> bool:
        """Tell whether a point is within: a ray to the east crosses the border an odd number of times."""
        if len(self._corners) == 1:
            return math.dist(self._corners[0], (north_m, east_m)) <= self._radius_m
        within = False
        last_n, last_e = self._corners[-1]
        for n, e in self._corners:
            crosses = (n > north_m) != (last_n > north_m)
            if crosses and east_m < e + (last_e - e) * (north_m - n) / (last_n - n):
                within = not within
            last_n, last_e = n, e
        return within
