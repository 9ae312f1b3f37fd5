"""Trajectories whose coordinates are places on the Earth: where they lie in the autopilot's local frame."""

from __future__ import annotations

from math import hypot

from companion.control.types import Vec3
from companion.errors import RefusedError
from companion.frames import GeoPoint, ned_from_geo
from companion.trajectory.anchored import Trajectory

APART_MAX_M = 2000.0
"""Farther from the vehicle's home a trajectory's origin may not be: it would be another field, and north differs."""


def counts_from(trajectory: Trajectory, home: Vec3 | None, home_global: GeoPoint | None) -> Vec3 | None:
    """Return the point of the local frame that a trajectory with anchor "home" counts its coordinates from.

    That is the home position, unless the coordinates are places on the Earth: then it is where their origin lies, for
    the mission to be flown where it was planned and not where the vehicle was switched on.

    Args:
        trajectory: any.
        home: the home position in the local frame, NED [m], if known.
        home_global: the same on the Earth, altitude above mean sea level, if known.

    Raises:
        RefusedError: the vehicle's home is not known on the Earth, or too far away.

    """
    origin = trajectory.origin
    if origin is None or trajectory.anchor != "home" or home is None:
        return home
    if home_global is None:
        raise RefusedError(
            f"trajectory {trajectory.name}: its points are places on the Earth, but the vehicle has not told where on"
            ' the Earth its home is; wait until it has a position, or use anchor = "here"'
        )
    north, east, down = ned_from_geo(origin.point, home_global)
    apart = hypot(north, east)
    if apart > APART_MAX_M:
        raise RefusedError(
            f"trajectory {trajectory.name}: it was planned {apart / 1e3:.1f} km away from the vehicle's home, at most"
            f" {APART_MAX_M / 1e3:g} km are flown"
        )
    return home[0] + north, home[1] + east, home[2] + (0.0 if origin.altitude_above_home else down)
