"""Points to fly through, one per row.

Without a header three columns, x, y, z, as uav_trajectories' waypoint files have them. With one the columns may be in
any order: x, y, z of the declared frame, or north, east, down, or east, north, up, or north, west, up; and yaw_deg or
heading_deg, speed_m_s, stop (0, 1).

yaw_deg turns with the frame, from its x axis towards y, as programs with z up count it; heading_deg is what a compass
shows, clockwise from north, whatever the frame is.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.frames import Frame, compass_deg, ned_from, radians, yaw_ned_from
from companion.trajectory.formats.contents import Leg, Route
from companion.trajectory.formats.reading import (
    POSITION_MAX_M,
    SPEED_MAX_M_S,
    Row,
    Source,
    header_of,
    quoted,
    table,
    within,
)
from companion.trajectory.waypoints import Waypoint

PLAIN = ("x", "y", "z")
AXES: dict[tuple[str, str, str], Frame | None] = {
    PLAIN: None,
    ("north", "east", "down"): "ned",
    ("east", "north", "up"): "enu",
    ("north", "west", "up"): "nwu",
}
EXTRAS = ("yaw_deg", "heading_deg", "speed_m_s", "stop")
TURNS: dict[Frame, str] = {"enu": "from east to north", "nwu": "from north to west"}
"""How yaw_deg counts where that is not clockwise from north."""

WAYPOINTS_MAX = 5000
YAW_MAX_DEG = 3600.0


def matches(source: Source) -> bool:
    """Whether it is three numbers a line, or has a header with the columns of some frame."""
    header = header_of(source).names
    if not _is_header(header):
        return len(header) == 3
    return any(set(axes) <= set(header) for axes in AXES)


def frame_of(source: Source) -> Frame | None:
    """The frame that the header itself names; None when it has to be declared."""
    header = header_of(source).names
    return next((frame for axes, frame in AXES.items() if set(axes) <= set(header)), None)


def read(source: Source, frame: Frame) -> Route:
    """Return the points of a file, in north-east-down. Raises InputError."""
    line, header = header_of(source)
    named = _is_header(header)
    columns = header if named else PLAIN
    axes = next((axes for axes in AXES if set(axes) <= set(columns)), PLAIN)
    unknown = [name for name in columns if name not in (*axes, *EXTRAS)]
    if unknown or len(set(columns)) != len(columns):
        what = f"column {quoted(unknown[0])} is not known" if unknown else "a column comes twice"
        raise source.fault(line, f"{what}; allowed are {', '.join(axes)}, {', '.join(EXTRAS)}")
    if {"yaw_deg", "heading_deg"} <= set(columns):
        raise source.fault(
            line,
            "has yaw_deg (from x towards y of its frame) and heading_deg (clockwise from north); keep one of the"
            " columns",
        )
    rows = table(source, columns, header=named)
    if len(rows) > WAYPOINTS_MAX:
        raise source.fault(rows[WAYPOINTS_MAX].line, f"more than {WAYPOINTS_MAX} waypoints, the most that are planned")
    legs: list[Leg] = []
    for row in rows:
        waypoint = _waypoint(source, row, columns, axes, frame)
        if legs and legs[-1].waypoint.p_m == waypoint.p_m:
            raise source.fault(row.line, "the same point as the one before")
        legs.append(Leg(waypoint, line=row.line))
    if len(legs) < 2:
        raise source.fault(rows[-1].line, "the file ends after one point, at least two are needed")
    return Route(legs=tuple(legs), notes=_notes(rows[0], columns, frame))


def _notes(first: Row, columns: Sequence[str], frame: Frame) -> tuple[str, ...]:
    """Say what yaw_deg means where a compass heading in it would be flown mirrored."""
    if "yaw_deg" not in columns or frame not in TURNS:
        return ()
    yaw_deg = first.values[columns.index("yaw_deg")]
    heading_deg = compass_deg(yaw_ned_from(frame, radians(yaw_deg)), 3)
    return (
        f"yaw_deg counts {TURNS[frame]} in this frame: the first point's {yaw_deg:g} is a heading of {heading_deg:g}"
        " deg (clockwise from north)",
    )


def _is_header(cells: Sequence[str]) -> bool:
    """Whether a first line is names and not numbers."""
    return any(cell[:1].isalpha() and cell not in {"nan", "inf", "infinity"} for cell in cells)


def _waypoint(source: Source, row: Row, columns: Sequence[str], axes: Sequence[str], frame: Frame) -> Waypoint:
    values = dict(zip(columns, row.values, strict=True))
    x, y, z = (within(source, row.line, values[axis], POSITION_MAX_M, axis, "m") for axis in axes)
    yaw_deg, heading_deg, speed, stop = (values.get(name) for name in EXTRAS)
    yaw_rad = None
    if yaw_deg is not None:
        yaw_rad = yaw_ned_from(frame, radians(within(source, row.line, yaw_deg, YAW_MAX_DEG, "yaw_deg", "deg")))
    if heading_deg is not None:
        yaw_rad = radians(within(source, row.line, heading_deg, YAW_MAX_DEG, "heading_deg", "deg"))
    if stop not in (None, 0.0, 1.0):
        raise source.fault(row.line, f"stop is {stop:g}; it must be 0 or 1")
    if speed is not None:
        within(source, row.line, speed, SPEED_MAX_M_S, "speed_m_s", "m/s")
        if speed < 0.0:
            raise source.fault(row.line, f"speed_m_s is {speed:g}; it must be above zero, or 0 where it is left open")
    return Waypoint(
        ned_from(frame, (x, y, z)),
        yaw_rad,
        speed_m_s=speed if speed and not stop else None,
        stop=bool(stop),
    )
