"""What a trajectory file of ours may say beside closed shapes: points to plan through, or another program's file."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.config import Finite, NotNegative, Positive, Vector, Vehicle
from companion.frames import Frame, GeoPoint, radians
from companion.trajectory.anchored import Anchor, JoinKind
from companion.trajectory.definition import Table
from companion.trajectory.files import Options
from companion.trajectory.formats import NAMES
from companion.trajectory.formats.contents import Leg, Route
from companion.trajectory.vehicle_limits import point_mass, reference_limits
from companion.trajectory.waypoints import HeadingMode, PlanLimits, Waypoint

WAYPOINTS_MAX = 5000
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]
Altitude = Annotated[float, Field(ge=-9000.0, le=9000.0)]


class PlanTable(Table):
    """[plan]: how a path through points is planned."""

    heading: HeadingMode | None = None
    """"waypoints": as they say; "path": nose along the path. Default: as they say if one does, else along the path."""
    speed_max_m_s: Positive | None = None
    """Less than the vehicle's limit."""
    acceleration_max_m_s2: Positive | None = None
    """Less than the vehicle's limit."""
    wind_m_s: NotNegative = 0.0
    """Wind from any side that is left room for."""

    def limits(self, vehicle: Vehicle) -> PlanLimits:
        """Return what is planned within: the vehicle's limits, and these."""
        limits = reference_limits(vehicle)
        speed, acceleration = self.speed_max_m_s, self.acceleration_max_m_s2
        if speed is not None:
            limits = replace(limits, speed_max_m_s=min(limits.speed_max_m_s, speed))
        if acceleration is not None:
            limits = replace(limits, acceleration_max_m_s2=min(limits.acceleration_max_m_s2, acceleration))
        return PlanLimits(limits, point_mass(vehicle), self.wind_m_s)


class PlacedTable(Table):
    """The keys that every trajectory file has."""

    anchor: Anchor | None = None
    anchor_yaw_deg: Finite = 0.0
    join: JoinKind = "smooth"
    time_scale: Positive = 1.0
    plan: PlanTable = PlanTable()


class WaypointTable(Table):
    """One [[waypoint]]."""

    p_m: Vector
    """North, east, down."""
    yaw_deg: Finite | None = None
    speed_m_s: Positive | None = None
    velocity_m_s: Vector | None = None
    stop: bool = False
    hold_s: NotNegative = 0.0
    """Rest there for this long."""

    def leg(self) -> Leg:
        """Return the point as it is planned through."""
        return Leg(
            Waypoint(
                self.p_m,
                None if self.yaw_deg is None else radians(self.yaw_deg),
                self.speed_m_s,
                self.stop or self.hold_s > 0.0,
                self.velocity_m_s,
            ),
            self.hold_s,
        )


class WaypointsDefinition(PlacedTable):
    """A trajectory file with shape = "waypoints"."""

    shape: Literal["waypoints"]
    waypoint: Annotated[tuple[WaypointTable, ...], Field(min_length=2, max_length=WAYPOINTS_MAX)]

    def route(self) -> Route:
        """Return the points."""
        return Route(legs=tuple(entry.leg() for entry in self.waypoint))


class FileDefinition(PlacedTable):
    """A trajectory file that names another program's file, or holds its text."""

    file: str | None = None
    """Its path; relative to the file that names it."""
    text: str | None = None
    """What it holds, instead of its path."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    """Of the file's bytes: it must still be the same file."""
    format: str | None = None
    frame: Frame | None = None
    smooth_m: Positive | None = None
    origin: tuple[Latitude, Longitude, Altitude] | None = None
    """Of a mission: latitude, longitude [deg], altitude above sea level [m] that coordinates count from."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.file is None) == (self.text is None):
            raise ValueError("give either file or text")
        if self.format is not None and self.format not in NAMES:
            raise ValueError(f"format = {self.format!r}: allowed are {', '.join(NAMES)}")
        return self

    def options(self, vehicle: Vehicle | None) -> Options:
        """Return how the file is to be taken."""
        return Options(
            frame=self.frame,
            format=self.format,
            smooth_m=self.smooth_m,
            limits=None if vehicle is None else self.plan.limits(vehicle),
            heading=self.plan.heading,
            origin=None if self.origin is None else GeoPoint(*self.origin),
        )
