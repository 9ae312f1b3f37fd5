"""What a trajectory file of ours may say beside closed shapes: points to plan through, or another program's file."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.config import Finite, NotNegative, Positive, Vector, Vehicle
from companion.frames import Frame, GeoPoint, radians
from companion.trajectory.anchored import Anchor, JoinKind
from companion.trajectory.definition import Name, Table
from companion.trajectory.files import Options
from companion.trajectory.formats import NAMES
from companion.trajectory.formats.contents import Leg, Route
from companion.trajectory.waypoints import HeadingMode, PlanLimits, Waypoint, plan_limits

WAYPOINTS_MAX = 5000
LAPS_MAX = 1000
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]
Altitude = Annotated[float, Field(ge=-9000.0, le=9000.0)]


class LimitsTable(Table):
    """[limits]: what a path through points keeps to, as far as it is tighter than the vehicle's own [limits]."""

    speed_max_m_s: Positive | None = None
    acceleration_max_m_s2: Positive | None = None
    tilt_max_rad: Positive | None = None
    thrust_min_n: Positive | None = None
    thrust_max_n: Positive | None = None
    rate_max_rad_s: Positive | None = None
    heading_rate_max_rad_s: Positive | None = None
    wind_m_s: NotNegative = 0.0
    """Wind from any side that is left room for."""

    def within(self, vehicle: Vehicle) -> PlanLimits:
        """Return the tighter ones of these limits and the vehicle's."""
        plain = plan_limits(vehicle, self.wind_m_s)
        limits = plain.reference
        for name, value in self.model_dump(exclude={"wind_m_s"}, exclude_none=True).items():
            tighter = max if name == "thrust_min_n" else min
            limits = replace(limits, **{name: tighter(getattr(limits, name), value)})
        return replace(plain, reference=limits)


class HeadingTable(Table):
    """[heading]: followed where the vehicle's heading is "commanded"."""

    yaw_deg: Finite = 0.0
    """Where the file says none."""
    along_path: bool | None = None
    """Of paths through points: the nose along the path. Default: where no point has a heading."""

    @property
    def mode(self) -> HeadingMode | None:
        """Return where the heading comes from; None: the points decide."""
        if self.along_path is None:
            return None
        return "path" if self.along_path else "waypoints"


class PlacedTable(Table):
    """The keys that every trajectory file has."""

    name: Name | None = None
    anchor: Anchor | None = None
    anchor_yaw_deg: Finite = 0.0
    join: JoinKind = "smooth"
    time_scale: Positive = 1.0
    laps: Annotated[int, Field(ge=1, le=LAPS_MAX)] = 1
    """How often it is flown, with a way from its end back to its start between."""
    heading: HeadingTable = HeadingTable()
    limits: LimitsTable = LimitsTable()


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
            limits=None if vehicle is None else self.limits.within(vehicle),
            heading=self.heading.mode,
            yaw_rad=radians(self.heading.yaw_deg),
            origin=None if self.origin is None else GeoPoint(*self.origin),
        )
