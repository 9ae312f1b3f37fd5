"""Missions in the text format QGC WPL 110: index, current, frame, command, four parameters, x, y, z, autocontinue.

Where the first item is absolute while it is also the current one, it is the home position, as ground stations write it.
Nothing tells it from the first waypoint of an absolute mission without a home position: a note says how it is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isnan

from companion.frames import Frame, GeoPoint
from companion.trajectory.fence import Fence
from companion.trajectory.formats.contents import Route
from companion.trajectory.formats.mission import TAKEOFF, WAYPOINT, Item, fence_items, local_fence, route
from companion.trajectory.formats.reading import Row, Source, first_line, lines_of, number

COLUMNS = ("index", "current", "frame", "command", "p1", "p2", "p3", "p4", "x", "y", "z", "autocontinue")
SIGNATURE = "QGC WPL"
VERSION = "110"
INTEGER_MAX = 65535.0
FRAMES_OF_INTEGERS = {5: 0, 6: 3}
"""MAV_FRAME of MISSION_ITEM_INT, as these files have them."""


def matches(source: Source) -> bool:
    """Whether it begins as such a file."""
    return first_line(source)[1].startswith(SIGNATURE)


def read(source: Source, frame: Frame) -> Route:
    """Return the points of a mission, in north-east-down from its home. Raises InputError."""
    items, home = _items(source)
    if home is None:
        return route(source, items, None, fence=fence_items(source, items))
    found = route(source, items[1:], home, fence=fence_items(source, items))
    where = f"{home.latitude_deg:.5f}, {home.longitude_deg:.5f}, {home.altitude_m:.6g} m"
    return replace(found, notes=(f"item 0 ({where}) is taken for the home position, not flown", *found.notes))


def read_fence(source: Source) -> Fence | None:
    """Return the geofence alone, from home; None without one or the other. Raises InputError."""
    items, home = _items(source)
    return None if home is None else local_fence(fence_items(source, items), home)


def _items(source: Source) -> tuple[list[Item], GeoPoint | None]:
    """Return all items, the home position among them, and what it is."""
    line, text = first_line(source)
    if text.split() != [*SIGNATURE.split(), VERSION]:
        raise source.fault(line, f"the first line must be {SIGNATURE} {VERSION}")
    rows = []
    for at, row in list(lines_of(source))[1:]:
        cells = row.split()
        if len(cells) != len(COLUMNS):
            raise source.fault(at, f"{len(cells)} columns, {len(COLUMNS)} are expected; is the file cut off?")
        # Ground stations write NaN for what is not set; zero says the same in these columns, but for the heading.
        values = [_value(source, at, cell, name) for cell, name in zip(cells, COLUMNS, strict=True)]
        rows.append((Row(at, tuple(0.0 if value is None else value for value in values)), values))
    if not rows:
        raise source.fault(line, "has no items")
    return [_item(source, row, values) for row, values in rows], _home(rows[0][0])


def _value(source: Source, line: int, cell: str, name: str) -> float | None:
    if cell.lower() == "nan" and name in {"p1", "p2", "p3", "p4", "x", "y"}:
        return None
    return number(source, line, cell, name)


def _item(source: Source, row: Row, values: list[float | None]) -> Item:
    for name, value in zip(COLUMNS[:4], row.values[:4], strict=True):
        if not (value.is_integer() and 0.0 <= value <= INTEGER_MAX):
            raise source.fault(row.line, f"{name} is {value:g}; it must be a whole number")
    command = int(row.values[3])
    # Zero is how these files leave the heading open: north would be 360.
    yaw_deg = values[7] if values[7] != 0.0 else None
    return Item(
        row.line,
        f"item {row.values[0]:g}",
        command,
        int(row.values[2]),
        values[4],
        values[5],
        yaw_deg if command in (WAYPOINT, TAKEOFF) else values[7],
        values[8],
        values[9],
        values[10],
    )


def _home(row: Row) -> GeoPoint | None:
    """The home position, when the first item is one."""
    index, current, frame, command = row.values[:4]
    latitude, longitude, altitude = row.values[8:11]
    if (index, current, frame, command) != (0.0, 1.0, 0.0, float(WAYPOINT)):
        return None
    if abs(latitude) > 90.0 or abs(longitude) > 180.0 or abs(altitude) > 9000.0 or latitude == longitude == 0.0:
        return None
    return GeoPoint(latitude, longitude, altitude)


def text_of(home: GeoPoint, items: Sequence[tuple[int, int, tuple[float, float, float, float], GeoPoint]]) -> str:
    """Return a mission as such a file.

    Args:
        home: the home position, altitude above mean sea level.
        items: command, frame, parameters (NaN: not set) and place of each, the mission's and the fence's.

    """
    lines = [f"{SIGNATURE} {VERSION}", _line(0, 1, 0, WAYPOINT, (0.0, 0.0, 0.0, 0.0), home)]
    for index, (command, frame, params, place) in enumerate(items, start=1):
        p1, p2, p3, p4 = (0.0 if isnan(value) else value for value in params)
        if command in (WAYPOINT, TAKEOFF) and params[3] == 0.0:
            p4 = 360.0  # zero leaves the heading open in these files
        lines.append(_line(index, 0, FRAMES_OF_INTEGERS.get(frame, frame), command, (p1, p2, p3, p4), place))
    return "\n".join(lines) + "\n"


def _line(
    index: int, current: int, frame: int, command: int, params: tuple[float, float, float, float], place: GeoPoint
) -> str:
    numbers = "\t".join(f"{value:.8g}" for value in params)
    where = f"{place.latitude_deg:.8f}\t{place.longitude_deg:.8f}\t{place.altitude_m:.6f}"
    return f"{index}\t{current}\t{frame}\t{command}\t{numbers}\t{where}\t1"
