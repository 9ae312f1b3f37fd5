"""What a trajectory file may say: the keys of config/trajectories/*.toml with their rules, and the shape they
define."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from companion.config import Finite, Positive, Section, Vector
from companion.frames import radians
from companion.trajectory.anchored import Anchor, JoinKind
from companion.trajectory.shapes import Circle, Heading, Helix, Hover, Lemniscate, Line, Lissajous, Shape

ShapeName = Literal["hover", "line", "circle", "lemniscate", "lissajous", "helix"]


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("must not be zero")
    return value


def _printable(value: str) -> str:
    if not value.isprintable() or value != value.strip():
        raise ValueError("must be printable characters, without space around them")
    return value


NotZero = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_not_zero)]
Name = Annotated[str, Field(min_length=1, max_length=80), AfterValidator(_printable)]
"""What a trajectory is called where its file's name is not wanted."""


class Table(Section):
    """A table of a trajectory file; an unknown key is answered with the ones that there are."""

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            raise ValueError(f"must be a table, not {data!r}")
        unknown = [key for key in data if key not in cls.model_fields]
        if unknown:
            raise ValueError(
                f"unknown key {unknown[0]!r} = {data[unknown[0]]!r} (allowed: {', '.join(cls.model_fields)})"
            )
        return data


class HeadingTable(Table):
    """[heading]: followed where the vehicle's heading is "commanded"."""

    yaw_deg: Finite = 0.0
    yaw_rate_deg_s: Finite = 0.0

    def heading(self) -> Heading:
        """Return the heading in radians."""
        return Heading(radians(self.yaw_deg), radians(self.yaw_rate_deg_s))


class ShapeTable(Table):
    """The table with a shape's name."""

    place: ClassVar[str | None] = None
    """The key with a default that says where the shape is; to be given where the anchor does not say it."""

    @abstractmethod
    def shape(self, heading: Heading) -> Shape:
        """Return the shape that the table defines."""


class HoverTable(ShapeTable):
    """[hover]: rest at a point."""

    place = "point_m"
    point_m: Vector = (0.0, 0.0, 0.0)

    def shape(self, heading: Heading) -> Hover:
        """Return the hover."""
        return Hover(heading=heading, point_m=self.point_m)


class LineTable(ShapeTable):
    """[line]: rest to rest."""

    from_m: Vector
    to_m: Vector
    move_s: Positive
    back: bool = False

    @model_validator(mode="after")
    def _some_length(self) -> Self:
        if self.from_m == self.to_m:
            raise ValueError('from_m and to_m are the same point; shape = "hover" rests at one')
        return self

    def shape(self, heading: Heading) -> Line:
        """Return the line."""
        return Line(heading=heading, from_m=self.from_m, to_m=self.to_m, move_s=self.move_s, back=self.back)


class CircleTable(ShapeTable):
    """[circle]: level."""

    place = "center_m"
    center_m: Vector = (0.0, 0.0, 0.0)
    radius_m: Positive
    angular_rate_rad_s: NotZero
    phase_deg: Finite = 0.0

    def shape(self, heading: Heading) -> Circle:
        """Return the circle."""
        return Circle(
            heading=heading,
            center_m=self.center_m,
            radius_m=self.radius_m,
            angular_rate_rad_s=self.angular_rate_rad_s,
            phase_rad=radians(self.phase_deg),
        )


class LemniscateTable(ShapeTable):
    """[lemniscate]: the paper's figure of eight."""

    place = "center_m"
    center_m: Vector = (0.0, 0.0, 0.0)
    amplitude_m: tuple[NotZero, NotZero]
    angular_rate_rad_s: NotZero

    def shape(self, heading: Heading) -> Lemniscate:
        """Return the figure of eight."""
        return Lemniscate(
            heading=heading,
            center_m=self.center_m,
            amplitude_m=self.amplitude_m,
            angular_rate_rad_s=self.angular_rate_rad_s,
        )


class LissajousTable(ShapeTable):
    """[lissajous]: a sine on each axis."""

    place = "center_m"
    center_m: Vector = (0.0, 0.0, 0.0)
    amplitude_m: Vector
    angular_rate_rad_s: Vector
    phase_deg: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if not any(self.amplitude_m):
            raise ValueError(f'amplitude_m = {self.amplitude_m}: nothing moves; shape = "hover" rests at a point')
        for axis, amplitude, rate in zip((0, 1, 2), self.amplitude_m, self.angular_rate_rad_s, strict=True):
            if amplitude != 0.0 and rate == 0.0:
                raise ValueError(
                    f"angular_rate_rad_s.{axis} = 0.0: must not be zero on an axis with an amplitude ({amplitude} m); "
                    "center_m moves an axis that stands still"
                )
        return self

    def shape(self, heading: Heading) -> Lissajous:
        """Return the figure."""
        x, y, z = self.phase_deg
        return Lissajous(
            heading=heading,
            center_m=self.center_m,
            amplitude_m=self.amplitude_m,
            angular_rate_rad_s=self.angular_rate_rad_s,
            phase_rad=(radians(x), radians(y), radians(z)),
        )


class HelixTable(ShapeTable):
    """[helix]: a circle that climbs."""

    place = "center_m"
    center_m: Vector = (0.0, 0.0, 0.0)
    radius_m: Positive
    angular_rate_rad_s: NotZero
    climb_m_s: NotZero
    phase_deg: Finite = 0.0

    def shape(self, heading: Heading) -> Helix:
        """Return the helix."""
        return Helix(
            heading=heading,
            center_m=self.center_m,
            radius_m=self.radius_m,
            angular_rate_rad_s=self.angular_rate_rad_s,
            climb_m_s=self.climb_m_s,
            phase_rad=radians(self.phase_deg),
        )


class Definition(Table):
    """A trajectory file as a whole."""

    name: Name | None = None
    shape: ShapeName
    anchor: Anchor = "here"
    anchor_yaw_deg: Finite = 0.0
    join: JoinKind = "smooth"
    duration_s: Positive | None = None
    laps: Positive | None = None
    time_scale: Positive = 1.0
    heading: HeadingTable = HeadingTable()
    hover: HoverTable | None = None
    line: LineTable | None = None
    circle: CircleTable | None = None
    lemniscate: LemniscateTable | None = None
    lissajous: LissajousTable | None = None
    helix: HelixTable | None = None

    @property
    def table(self) -> ShapeTable:
        """The table of the shape."""
        table: ShapeTable = getattr(self, self.shape)
        return table

    def built_shape(self) -> Shape:
        """Return the shape that the file defines."""
        return self.table.shape(self.heading.heading())

    def shape_duration_s(self) -> float:
        """Return how long the trajectory takes at a time scale of 1 [s]."""
        if self.duration_s is not None:
            return self.duration_s
        shape = self.built_shape()
        period_s, own_s = shape.period_s, shape.own_duration_s
        if self.laps is not None and period_s is not None:
            return self.laps * period_s
        if own_s is None:
            raise ValueError(_without_end(self.shape, period_s))
        return own_s

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        for name in ("hover", "line", "circle", "lemniscate", "lissajous", "helix"):
            if name == self.shape and getattr(self, name) is None:
                raise ValueError(f'table [{name}] is missing: shape = "{name}" needs it')
            if name != self.shape and getattr(self, name) is not None:
                raise ValueError(f'table [{name}] does not belong here: shape = "{self.shape}"')
        place = self.table.place
        if self.anchor != "here" and place is not None and place not in self.table.model_fields_set:
            raise ValueError(f'{self.shape}.{place} is missing: anchor = "{self.anchor}" needs it (north, east, down)')
        return self

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if self.duration_s is not None and self.laps is not None:
            raise ValueError(
                f"duration_s = {self.duration_s} and laps = {self.laps} exclude each other; give one of them"
            )
        if self.laps is not None and self.built_shape().period_s is None:
            hint = "; line.back = true makes it go there and back" if self.shape == "line" else ""
            raise ValueError(f"laps = {self.laps}: this {self.shape} does not repeat; give duration_s instead{hint}")
        self.shape_duration_s()
        return self


def _without_end(shape: str, period_s: float | None) -> str:
    allowed = "duration_s" if period_s is None else "duration_s or laps"
    return f"{allowed} is missing: a {shape} has no end of its own"
