"""Missions as a list of MAVLink mission items, wherever they come from: which of them are points to fly through.

What PX4 does beside flying from point to point (cameras, grippers, jumps, surveys' triggers) is not part of a
trajectory. Items that only do such things are named in a note; items that would be flown another way are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, isfinite
from typing import NamedTuple

from companion.frames import GeoPoint, ned_from_geo, radians
from companion.trajectory.fence import Circle, Fence, Polygon
from companion.trajectory.formats.contents import Leg, Route
from companion.trajectory.formats.reading import SPEED_MAX_M_S, Source
from companion.trajectory.waypoints import Waypoint

WAYPOINT, RETURN, LAND, TAKEOFF, CHANGE_SPEED = 16, 20, 21, 22, 178
FENCE_RETURN_POINT, POLYGON_INCLUSION, POLYGON_EXCLUSION, CIRCLE_INCLUSION, CIRCLE_EXCLUSION = (
    5000,
    5001,
    5002,
    5003,
    5004,
)
RALLY_POINT = 5100
"""MAV_CMD of items."""
FENCE_COMMANDS = range(FENCE_RETURN_POINT, RALLY_POINT + 1)

DO_COMMANDS_FROM = 90
"""MAV_CMD_NAV_LAST is 95, MAV_CMD_CONDITION_LAST 159: from here on nothing but 93 to 95 is flown."""
DELAY = 93

ABOVE_SEA, ABOVE_HOME = (0, 5), (3, 6)
"""MAV_FRAME of global positions: altitude above mean sea level, and above home."""

ITEMS_MAX = 5000
SAME_POINT_M = 0.01
EXTENT_MAX_M = 20e3
HOLD_MAX_S = 3600.0


GeoFence = tuple[list[GeoPoint], bool] | tuple[GeoPoint, float, bool]
"""A polygon (corners, inclusion) or a circle (centre, radius [m], inclusion)."""


class Item(NamedTuple):
    """One mission item; None where the value is not set (NaN in MAVLink, null in plans)."""

    line: int | None
    """In its file, if it has lines."""
    label: str
    """What to call it in messages, such as "item 3"."""
    command: int
    frame: int
    param1: float | None
    param2: float | None
    param4: float | None
    latitude_deg: float | None
    longitude_deg: float | None
    altitude_m: float | None


class _Place(NamedTuple):
    """A point on the way, with what is asked for there."""

    item: Item
    point: GeoPoint
    yaw_deg: float | None
    hold_s: float


class _Walk:
    """Goes through the items of a mission, one after the other."""

    def __init__(self, source: Source, home: GeoPoint | None) -> None:
        self.source = source
        self.home = home
        self.places: list[_Place] = []
        self.speeds: list[float] = []
        self.ignored: dict[int, int] = {}
        self.notes: list[str] = []
        self.ended = False

    def take(self, item: Item) -> None:
        """Add what an item asks for."""
        if item.command in (WAYPOINT, TAKEOFF, LAND) and self.ended:
            raise self.fault(item, "comes after the landing; a trajectory is one flight")
        if item.command == WAYPOINT:
            self._point(item, _hold(self, item), item.param4)
        elif item.command == TAKEOFF:
            if self.places:
                raise self.fault(item, "takes off in the middle of the flight")
            self._take_off(item)
        elif item.command == LAND:
            if not self.places:
                raise self.fault(item, "lands before there is anything to fly")
            above = item._replace(frame=self.places[-1].item.frame, altitude_m=self.places[-1].point.altitude_m)
            if _coordinates(item) is not None:
                self._point(above, 0.0, None)
            self._end("the landing is not part of the trajectory: it ends at rest above it; --land lands there")
        elif item.command == RETURN:
            self._end("the return (RTL) is not part of the trajectory: it ends at rest before it")
        elif item.command == CHANGE_SPEED:
            self._speed(item)
        elif item.command == DELAY or item.command < DO_COMMANDS_FROM:
            raise self.fault(
                item,
                f"command {item.command} is flown in a way that is not supported; waypoints (16), take-off (22),"
                " landing (21) and return (20) are",
            )
        elif item.command not in FENCE_COMMANDS:
            self.ignored[item.command] = self.ignored.get(item.command, 0) + 1

    def fault(self, item: Item, reason: str) -> Exception:
        """The error that names the item."""
        return self.source.fault(item.line, f"{item.label}: {reason}")

    def _end(self, note: str) -> None:
        self.ended = True
        self.notes.append(note)

    def _take_off(self, item: Item) -> None:
        """Begin where the take-off ends; one without a position goes up from home."""
        if _coordinates(item) is None:
            if self.home is None:
                self.notes.append("the take-off is not part of the trajectory: it begins at the first waypoint")
                return
            latitude, longitude, _ = self.home
            item = item._replace(latitude_deg=latitude, longitude_deg=longitude)
        self._point(item, 0.0, None)

    def _point(self, item: Item, hold_s: float, yaw_deg: float | None) -> None:
        if item.frame not in ABOVE_SEA + ABOVE_HOME:
            raise self.fault(
                item,
                f"frame {item.frame} is not supported; global positions are, with altitudes above sea (0) or home (3)",
            )
        place = _coordinates(item)
        if place is None or item.altitude_m is None:
            raise self.fault(item, "has no position")
        latitude, longitude = place
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise self.fault(item, f"latitude {latitude:.6g}, longitude {longitude:.6g} deg is no place on the Earth")
        if not abs(item.altitude_m) <= 9000.0:
            raise self.fault(item, f"altitude {item.altitude_m:.6g} m is not believed")
        if yaw_deg is not None and not abs(yaw_deg) <= 720.0:
            raise self.fault(item, f"a heading of {yaw_deg:.6g} deg is not believed")
        self.places.append(_Place(item, GeoPoint(latitude, longitude, item.altitude_m), yaw_deg, hold_s))

    def _speed(self, item: Item) -> None:
        """MAV_CMD_DO_CHANGE_SPEED: type in param1 (0, 1: of flight), speed in param2 (-1: unchanged)."""
        if item.param1 not in (None, 0.0, 1.0) or item.param2 is None or item.param2 in (-1.0, -2.0):
            return
        if not 0.0 < item.param2 <= SPEED_MAX_M_S:
            raise self.fault(item, f"a speed of {item.param2:.6g} m/s is not believed")
        self.speeds.append(item.param2)


def _hold(walk: _Walk, item: Item) -> float:
    hold_s = item.param1 or 0.0
    if not 0.0 <= hold_s <= HOLD_MAX_S:
        raise walk.fault(item, f"waits for {hold_s:.6g} s; 0 to {HOLD_MAX_S:g} s can be")
    return hold_s


def _coordinates(item: Item) -> tuple[float, float] | None:
    """Latitude and longitude; None when not set. Zero for both means not set, as PX4 takes it."""
    latitude, longitude = item.latitude_deg, item.longitude_deg
    if latitude is None or longitude is None or (latitude == 0.0 and longitude == 0.0):
        return None
    return latitude, longitude


def route(
    source: Source,
    items: Sequence[Item],
    home: GeoPoint | None,
    *,
    speed_max_m_s: float | None = None,
    fence: Sequence[GeoFence] = (),
) -> Route:
    """Return the points that a mission flies through, relative to its origin, NED.

    Args:
        source: the file, for messages.
        items: of the mission, in order.
        home: the place that the file calls home, altitude above mean sea level; the origin of the coordinates. Without
            one the first point is the origin.
        speed_max_m_s: what the file asks for at most.
        fence: of the mission.

    Raises:
        InputError: an item cannot be flown so, or there are fewer than two points.

    """
    if len(items) > ITEMS_MAX:
        raise source.fault(items[ITEMS_MAX].line, f"more than {ITEMS_MAX} items, the most that are planned")
    walk = _Walk(source, home)
    for item in items:
        walk.take(item)
    if not walk.places:
        raise source.fault(None, "has no waypoints")
    above_home = _altitudes_above_home(walk)
    first = walk.places[0].point
    origin = home if home is not None else first._replace(altitude_m=0.0)
    if above_home:
        origin = origin._replace(altitude_m=0.0)
    legs = _legs(walk, origin)
    slowest = min([*walk.speeds, *([] if speed_max_m_s is None else [speed_max_m_s])], default=None)
    if walk.speeds:
        walk.notes.append(f"the slowest speed that the mission sets, {slowest:g} m/s, is kept throughout")
    if walk.ignored:
        names = ", ".join(f"{command} ({count} x)" for command, count in sorted(walk.ignored.items())[:12])
        walk.notes.append(f"these commands of the mission are not carried out: {names}")
    return Route(
        legs=tuple(legs),
        speed_max_m_s=slowest,
        origin=origin,
        altitude_above_home=above_home,
        fence=local_fence(fence, origin),
        notes=tuple(walk.notes),
    )


def _altitudes_above_home(walk: _Walk) -> bool:
    """Whether altitudes count from home; one level for all, as mixed ones need the home's own altitude to compare."""
    levels = {place.item.frame in ABOVE_HOME: place for place in walk.places}
    if len(levels) > 1:
        raise walk.fault(
            levels[True].item,
            f"its altitude counts from home, that of {levels[False].item.label} from sea level; use one level for all",
        )
    return True in levels


def _legs(walk: _Walk, origin: GeoPoint) -> list[Leg]:
    """Return the points with their stops; one that is flown to twice in a row counts once."""
    legs: list[Leg] = []
    merged = 0
    for place in walk.places:
        p = ned_from_geo(place.point, origin)
        if not dist(p[:2], (0.0, 0.0)) <= EXTENT_MAX_M:
            raise walk.fault(
                place.item, f"lies {dist(p[:2], (0.0, 0.0)) / 1e3:.4g} km from home; {EXTENT_MAX_M / 1e3:g} km can be"
            )
        yaw_rad = None if place.yaw_deg is None else radians(place.yaw_deg)
        if legs and dist(legs[-1].waypoint.p_m, p) < SAME_POINT_M:
            before = legs[-1]
            hold_s = before.hold_s + place.hold_s
            yaw_rad = before.waypoint.yaw_rad if yaw_rad is None else yaw_rad
            legs[-1] = Leg(Waypoint(before.waypoint.p_m, yaw_rad, stop=hold_s > 0.0), hold_s, before.line)
            merged += 1
            continue
        legs.append(Leg(Waypoint(p, yaw_rad, stop=place.hold_s > 0.0), place.hold_s, place.item.line))
    if len(legs) < 2:
        raise walk.source.fault(None, "has only one point to fly to, at least two are needed")
    if merged:
        walk.notes.append(f"{merged} of the points repeat the one before and count once")
    return legs


def local_fence(fence: Sequence[GeoFence], origin: GeoPoint) -> Fence | None:
    """Return fences in north-east-down from an origin; None when there are none."""
    parts: list[Polygon | Circle] = []
    for part in fence:
        if len(part) == 3:
            center, radius_m, inclusion = part
            parts.append(Circle(ned_from_geo(center, origin)[:2], radius_m, inclusion))
        else:
            corners, inclusion = part
            parts.append(Polygon(tuple(ned_from_geo(corner, origin)[:2] for corner in corners), inclusion))
    return Fence(tuple(parts)) if parts else None


def fence_items(source: Source, items: Sequence[Item]) -> list[GeoFence]:
    """Return the fences among mission items: vertices (param1: how many the polygon has) and circles (param1: radius).

    Raises:
        InputError: a polygon's vertices do not follow each other, or a figure makes no sense.

    """
    found: list[GeoFence] = []
    corners: list[GeoPoint] = []
    for item in items:
        vertex = item.command in (POLYGON_INCLUSION, POLYGON_EXCLUSION)
        if corners and not vertex:
            raise source.fault(item.line, f"{item.label}: the fence's polygon before it is not complete")
        if not vertex and item.command not in (CIRCLE_INCLUSION, CIRCLE_EXCLUSION):
            continue
        place = _coordinates(item)
        if place is None or item.param1 is None or not (isfinite(item.param1) and item.param1 > 0.0):
            raise source.fault(item.line, f"{item.label}: a fence needs a position, and a size in its first parameter")
        point = GeoPoint(*place, 0.0)
        if not vertex:
            found.append((point, item.param1, item.command == CIRCLE_INCLUSION))
            continue
        corners.append(point)
        if len(corners) >= item.param1:
            if len(corners) < 3:
                raise source.fault(item.line, f"{item.label}: a fence's polygon needs at least three corners")
            found.append((corners, item.command == POLYGON_INCLUSION))
            corners = []
    if corners:
        raise source.fault(None, "ends within a fence's polygon; is the file cut off?")
    return found
