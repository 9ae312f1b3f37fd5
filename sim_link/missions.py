"""Plans as they are uploaded: missions, geofences and rally points; what an item may be, and what a plan's id is."""

from __future__ import annotations

import math
import struct
import zlib
from typing import NamedTuple

from .codec import mavlink
from .geodesy import local_position
from .rotation import Vec3

MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255
"""MAV_MISSION_TYPE"""
MAX_ITEMS = {MISSION: 500, FENCE: 64, RALLY: 32}

ACCEPTED, ERROR, UNSUPPORTED_FRAME, UNSUPPORTED, NO_SPACE, INVALID = 0, 1, 2, 3, 4, 5
INVALID_PARAM1, INVALID_PARAM2, INVALID_X, INVALID_Y, INVALID_Z = 6, 7, 10, 11, 12
OPERATION_CANCELLED = 15
"""MAV_MISSION_RESULT"""

FRAME_GLOBAL, FRAME_MISSION, FRAME_RELATIVE, FRAME_GLOBAL_INT, FRAME_RELATIVE_INT = 0, 2, 3, 5, 6
"""MAV_FRAME"""
_GLOBAL_FRAMES = frozenset((FRAME_GLOBAL, FRAME_RELATIVE, FRAME_GLOBAL_INT, FRAME_RELATIVE_INT))
_RELATIVE_FRAMES = frozenset((FRAME_RELATIVE, FRAME_RELATIVE_INT))

WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, RETURN, LAND, TAKEOFF, LOITER_TO_ALT = 16, 17, 19, 20, 21, 22, 31
DELAY, JUMP, CHANGE_SPEED, SET_HOME = 93, 177, 178, 179
_PLACES = frozenset((WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAND, TAKEOFF, LOITER_TO_ALT))
"""Items that fly somewhere."""
_NOT_A_PLACE = frozenset((LAND, TAKEOFF))
"""Of those, the ones that mean "here" with a latitude and longitude of 0."""
# Items that are flown past: what they switch on or point at, this vehicle does not have.
_PASSED_OVER = frozenset(
    (183, 187, 189, 195, 196, 197, 201, 203, 204, 205, 206, 211, 214, 221, 222, 530, 531, 532, 534)
    + (1000, 1001, 2000, 2001, 2003, 2500, 2501, 4501)
)
_MISSION_COMMANDS = _PLACES | _PASSED_OVER | {RETURN, DELAY, JUMP, CHANGE_SPEED, SET_HOME}

RETURN_POINT, POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT = 5000, 5001, 5002, 5003, 5004
RALLY_POINT = 5100
_FENCE_COMMANDS = frozenset((RETURN_POINT, POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT))
_ID = struct.Struct("<BHB4fiif")


class Item(NamedTuple):
    """One item as it came; latitude and longitude in 1e-7 deg for a global frame."""

    frame: int
    command: int
    current: int
    autocontinue: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float

    @property
    def is_place(self) -> bool:
        """Whether the item flies somewhere."""
        return self.command in _PLACES

    @property
    def has_place(self) -> bool:
        """Whether it says where; a takeoff or landing may leave that out."""
        return self.frame in _GLOBAL_FRAMES and not (self.command in _NOT_A_PLACE and self.x == 0 and self.y == 0)

    def position(self, home: Vec3) -> Vec3:
        """Give the local position NED [m]; heights of the relative frames are above home."""
        p = local_position(1e-7 * self.x, 1e-7 * self.y, self.z)
        return (p[0], p[1], home[2] - self.z) if self.frame in _RELATIVE_FRAMES else p


def refusal(kind: int, item: Item) -> int:
    """Say why an item cannot be in a plan of this kind: a MAV_MISSION_RESULT, ACCEPTED when it can."""
    known = {MISSION: _MISSION_COMMANDS, FENCE: _FENCE_COMMANDS, RALLY: frozenset((RALLY_POINT,))}[kind]
    is_placed = kind != MISSION or item.is_place
    if item.frame not in _GLOBAL_FRAMES and (is_placed or item.frame != FRAME_MISSION):
        return UNSUPPORTED_FRAME
    if item.command not in known:
        return UNSUPPORTED if kind == MISSION else ERROR
    if is_placed:
        if not -900_000_000 <= item.x <= 900_000_000:
            return INVALID_X
        if not -1_800_000_000 <= item.y <= 1_800_000_000:
            return INVALID_Y
        if not math.isfinite(item.z):
            return INVALID_Z
    first = item.params[0]
    if item.command in (POLYGON_IN, POLYGON_OUT) and not (math.isfinite(first) and first >= 3):
        return ERROR
    if item.command in (CIRCLE_IN, CIRCLE_OUT) and not (math.isfinite(first) and first > 0.0):
        return INVALID_PARAM1
    if item.command in (JUMP, DELAY) and not math.isfinite(first):
        return INVALID_PARAM1
    if item.command == JUMP and not math.isfinite(item.params[1]):
        return INVALID_PARAM2
    return ACCEPTED


def consistent(kind: int, items: list[Item]) -> bool:
    """Tell whether a plan is one as a whole: every polygon has as many corners as it says, every jump a goal."""
    if kind == MISSION:
        return all(0 <= item.params[0] < len(items) for item in items if item.command == JUMP)
    at = 0
    while kind == FENCE and at < len(items):
        item = items[at]
        if item.command not in (POLYGON_IN, POLYGON_OUT):
            at += 1
            continue
        count = round(item.params[0])
        corners = items[at : at + count]
        # The command first: what another kind of item says there need not be a number.
        if len(corners) < count or any(c.command != item.command or round(c.params[0]) != count for c in corners):
            return False
        at += count
    return True


class Plans:
    """The three plans that are in force, and their ids."""

    def __init__(self) -> None:
        self.items: dict[int, list[Item]] = {MISSION: [], FENCE: [], RALLY: []}
        self.ids: dict[int, int] = {MISSION: 0, FENCE: 0, RALLY: 0}
        """Opaque ids: a CRC over the items; 0 for none."""
        self.versions: dict[int, int] = {MISSION: 0, FENCE: 0, RALLY: 0}
        """Count the changes of each plan."""

    def replace(self, kind: int, items: list[Item]) -> None:
        """Put a plan in the place of the one before; the same items leave everything as it is."""
        number = plan_id(items)
        if number == self.ids[kind] and len(items) == len(self.items[kind]):
            return
        self.items[kind] = list(items)
        self.ids[kind] = number
        self.versions[kind] += 1

    def clear(self, kind: int) -> bool:
        """Drop a plan, or with ALL every one. False: no such kind."""
        kinds = [MISSION, FENCE, RALLY] if kind == ALL else [kind]
        if any(k not in self.items for k in kinds):
            return False
        for k in kinds:
            self.replace(k, [])
        return True

    @property
    def rally_points(self) -> list[Item]:
        """Where Return may land besides home."""
        return self.items[RALLY]


def plan_id(items: list[Item]) -> int:
    """Give the opaque id of a plan."""
    crc = 0
    for item in items:
        crc = zlib.crc32(
            _ID.pack(item.frame, item.command, item.autocontinue, *item.params, item.x, item.y, item.z), crc
        )
    return crc


def from_message(message: object) -> Item:
    """Read a MISSION_ITEM_INT or MISSION_ITEM (degrees there, in the global frames)."""
    m: mavlink.MAVLink_mission_item_int_message = message
    x, y = m.x, m.y
    if m.get_type() == "MISSION_ITEM":
        scale = 1e7 if m.frame in _GLOBAL_FRAMES else 1.0
        x, y = _whole(scale * x), _whole(scale * y)
    return Item(
        m.frame, m.command, m.current, m.autocontinue, (m.param1, m.param2, m.param3, m.param4), x, y, float(m.z)
    )


def _whole(value: float) -> int:
    """Round to an int32; what is no number is out of every range."""
    return round(min(2147483647.0, max(-2147483648.0, value))) if math.isfinite(value) else 2147483647
