"""References through waypoints: what is asked for, and the plan that gives it.

The planner itself (`planner.py`) and with it scipy are imported when something is planned: the types are used where
nothing is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from companion.config import Vehicle
from companion.control.types import Vec3
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.torque import Body, body
from companion.trajectory.vehicle_limits import point_mass, reference_limits

HeadingMode = Literal["waypoints", "path"]
"""Where the heading comes from: from the waypoints that give one, or from the direction of flight."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point that the path goes through, and what is asked for there. The first and the last are always at rest."""

    p_m: Vec3
    """Position, NED [m]."""
    yaw_rad: float | None = None
    """Heading there [rad], clockwise from north; None: as the neighbours have it come."""
    speed_m_s: float | None = None
    """Speed there [m/s], above zero, in the direction of the circle through the point and its neighbours; None: free.
    Exclusive with `stop` and `velocity_m_s`, as both say the speed already."""
    stop: bool = False
    """Come to rest there: all derivatives up to the fourth are zero."""
    velocity_m_s: Vec3 | None = None
    """Velocity there, NED [m/s], where the direction matters too."""


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """What a plan keeps to."""

    reference: ReferenceLimits
    """The vehicle's limits, or tighter ones."""
    model: PointMass
    """Mass and drag."""
    wind_m_s: float = 0.0
    """Wind from any direction that thrust, tilt, body rate and torque leave room for; it acts through the drag."""
    body: Body | None = None
    """What torque depends on; None: it is not looked at."""


def plan_limits(vehicle: Vehicle, wind_m_s: float = 0.0) -> PlanLimits:
    """Return the limits of a vehicle file, with room for a wind [m/s]."""
    return PlanLimits(reference_limits(vehicle), point_mass(vehicle), wind_m_s, body(vehicle))


def plan(
    waypoints: Sequence[Waypoint],
    limits: PlanLimits,
    *,
    heading: HeadingMode = "waypoints",
    yaw_rad: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Piecewise:
    """Return a near-shortest minimum-snap reference through the waypoints, from rest to rest, within the limits.

    Args:
        waypoints: at least two, no two neighbours at the same place.
        limits: kept throughout.
        heading: "waypoints" interpolates the headings that are given; "path" keeps the nose along the path.
        yaw_rad: the heading where "waypoints" are to say and none does [rad].
        progress: told the share that is done, 0..1, now and then.

    Returns:
        A shape: to be put into a `Trajectory` with `duration_s = shape.own_duration_s`.

    Raises:
        InputError: a waypoint is wrong; the message begins with its key, such as "waypoint.3.speed_m_s".
        RefusedError: the limits leave no way to fly it, however slowly.

    """
    from companion.trajectory.planner import planned

    return planned(waypoints, limits, heading, yaw_rad, progress or (lambda _: None))
