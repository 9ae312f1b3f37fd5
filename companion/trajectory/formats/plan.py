"""Missions as QGroundControl saves them (.plan): JSON with items, the planned home position and the geofence."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import isfinite
from typing import Any, NoReturn

from companion.errors import InputError
from companion.frames import Frame, GeoPoint
from companion.trajectory.fence import Fence
from companion.trajectory.formats.contents import Route
from companion.trajectory.formats.mission import ITEMS_MAX, GeoFence, Item, local_fence, route
from companion.trajectory.formats.reading import SPEED_MAX_M_S, Source, quoted

PARAMETERS = 7
RADIUS_MAX_M = 100e3
CORNERS_MAX = 2000
FENCES_MAX = 200


def matches(source: Source) -> bool:
    """Whether it looks like a plan: an object that names its type."""
    return source.text.lstrip().startswith("{") and '"fileType"' in source.text


def read(source: Source, frame: Frame) -> Route:
    """Return the points of a mission, in north-east-down from its planned home. Raises InputError."""
    reader = _Reader(source)
    plan = reader.table(reader.parsed(), "the file")
    if plan.get("fileType") != "Plan":
        raise source.fault(None, f"fileType is {quoted(str(plan.get('fileType')))}, expected 'Plan'")
    if plan.get("version") != 1:
        raise source.fault(None, f"version is {quoted(str(plan.get('version')))}, expected 1")
    mission = reader.table(plan.get("mission"), "mission")
    home = reader.home(mission.get("plannedHomePosition"))
    speed = mission.get("hoverSpeed")
    speed_max_m_s = None if speed is None else reader.number(speed, "mission.hoverSpeed")
    if speed_max_m_s is not None and not 0.0 < speed_max_m_s <= SPEED_MAX_M_S:
        raise source.fault(None, f"mission.hoverSpeed is {speed_max_m_s:.6g} m/s, which is not believed")
    return route(
        source,
        list(reader.items(mission.get("items"))),
        home,
        speed_max_m_s=speed_max_m_s,
        fence=list(reader.fence(plan.get("geoFence"))),
    )


def read_fence(source: Source) -> Fence | None:
    """Return the geofence alone, from the planned home; None without one or the other. Raises InputError."""
    reader = _Reader(source)
    plan = reader.table(reader.parsed(), "the file")
    home = reader.home(reader.table(plan.get("mission"), "mission").get("plannedHomePosition"))
    return None if home is None else local_fence(list(reader.fence(plan.get("geoFence"))), home)


class _Reader:
    """Takes values out of parsed JSON, each with the path that a message names."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def parsed(self) -> Any:
        """Parse the text; numbers must be numbers and nothing may be nested without end."""

        def refuse(name: str) -> NoReturn:
            raise self._source.fault(None, f"holds {name}, which is no number of JSON")

        try:
            return json.loads(self._source.text, parse_constant=refuse)
        except json.JSONDecodeError as error:
            raise self._source.fault(error.lineno, f"not valid JSON: {error.msg}, column {error.colno}") from None
        except RecursionError:
            raise self._source.fault(None, "is nested too deeply") from None
        except InputError:
            raise
        except ValueError as error:  # a number with thousands of digits
            raise self._source.fault(None, f"not valid JSON: {error}") from None

    def table(self, value: Any, path: str) -> dict[str, Any]:
        """Take an object."""
        if not isinstance(value, dict):
            raise self._source.fault(None, f"{path} is {'missing' if value is None else 'not an object'}")
        return value

    def array(self, value: Any, path: str, most: int) -> list[Any]:
        """Take an array."""
        if not isinstance(value, list):
            raise self._source.fault(None, f"{path} is {'missing' if value is None else 'not an array'}")
        if len(value) > most:
            raise self._source.fault(None, f"{path} has {len(value)} entries, at most {most} are read")
        return value

    def number(self, value: Any, path: str) -> float:
        """Take a finite number."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._source.fault(None, f"{path} is {quoted(str(value))}, not a number")
        try:
            found = float(value)
        except OverflowError:
            found = float("inf")
        if not isfinite(found):
            raise self._source.fault(None, f"{path} must be finite")
        return found

    def whole(self, value: Any, path: str) -> int:
        """Take a whole number."""
        found = self.number(value, path)
        if not (found.is_integer() and 0.0 <= found <= 65535.0):
            raise self._source.fault(None, f"{path} is {found:g}; it must be a whole number from 0 to 65535")
        return int(found)

    def home(self, value: Any) -> GeoPoint | None:
        """Take the planned home position: latitude, longitude, altitude above sea level."""
        if value is None:
            return None
        numbers = self.array(value, "mission.plannedHomePosition", 3)
        if len(numbers) != 3:
            raise self._source.fault(None, "mission.plannedHomePosition needs latitude, longitude and altitude")
        latitude, longitude, altitude = (self.number(x, "mission.plannedHomePosition") for x in numbers)
        return self.place(latitude, longitude, altitude, "mission.plannedHomePosition")

    def place(self, latitude: float, longitude: float, altitude_m: float, path: str) -> GeoPoint:
        """Take a place on the Earth."""
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(altitude_m) <= 9000.0):
            raise self._source.fault(None, f"{path} ({latitude:.6g}, {longitude:.6g}) is no place on the Earth")
        return GeoPoint(latitude, longitude, altitude_m)

    def items(self, value: Any, path: str = "mission.items") -> Iterator[Item]:
        """Take mission items; of a survey and its like those that it has worked out."""
        for index, entry in enumerate(self.array(value, path, ITEMS_MAX)):
            where = f"{path}[{index}]"
            item = self.table(entry, where)
            if item.get("type") == "SimpleItem":
                yield self._simple(item, where)
                continue
            worked_out = item.get("TransectStyleComplexItem")
            if path != "mission.items" or item.get("type") != "ComplexItem" or not isinstance(worked_out, dict):
                raise self._source.fault(
                    None, f"{where} is of a type that is not supported; use waypoints, or a survey with saved items"
                )
            yield from self.items(worked_out.get("Items"), f"{where}.TransectStyleComplexItem.Items")

    def _simple(self, item: dict[str, Any], where: str) -> Item:
        params = self.array(item.get("params"), f"{where}.params", PARAMETERS)
        if len(params) != PARAMETERS:
            raise self._source.fault(None, f"{where}.params has {len(params)} entries, {PARAMETERS} are expected")
        values = [None if x is None else self.number(x, f"{where}.params[{i}]") for i, x in enumerate(params)]
        command = self.whole(item.get("command"), f"{where}.command")
        frame = self.whole(item.get("frame"), f"{where}.frame")
        return Item(None, where, command, frame, values[0], values[1], values[3], values[4], values[5], values[6])

    def fence(self, value: Any) -> Iterator[GeoFence]:
        """Take the fences."""
        if value is None:
            return
        fences = self.table(value, "geoFence")
        if fences.get("version", 2) != 2:
            raise self._source.fault(None, f"geoFence.version is {quoted(str(fences['version']))}, expected 2")
        for index, entry in enumerate(self.array(fences.get("polygons", []), "geoFence.polygons", FENCES_MAX)):
            path = f"geoFence.polygons[{index}]"
            polygon = self.table(entry, path)
            corners = [
                self._pair(corner, f"{path}.polygon[{i}]")
                for i, corner in enumerate(self.array(polygon.get("polygon"), f"{path}.polygon", CORNERS_MAX))
            ]
            if len(corners) < 3:
                raise self._source.fault(None, f"{path} has {len(corners)} corners, at least three are needed")
            yield corners, self._inclusion(polygon, path)
        for index, entry in enumerate(self.array(fences.get("circles", []), "geoFence.circles", FENCES_MAX)):
            path = f"geoFence.circles[{index}]"
            outer = self.table(entry, path)
            circle = self.table(outer.get("circle"), f"{path}.circle")
            radius_m = self.number(circle.get("radius"), f"{path}.circle.radius")
            if not 0.0 < radius_m <= RADIUS_MAX_M:
                raise self._source.fault(None, f"{path}.circle.radius is {radius_m:.6g} m, which is not believed")
            yield self._pair(circle.get("center"), f"{path}.circle.center"), radius_m, self._inclusion(outer, path)

    def _pair(self, value: Any, path: str) -> GeoPoint:
        pair = self.array(value, path, 2)
        if len(pair) != 2:
            raise self._source.fault(None, f"{path} needs latitude and longitude")
        latitude, longitude = (self.number(x, path) for x in pair)
        return self.place(latitude, longitude, 0.0, path)

    def _inclusion(self, table: dict[str, Any], path: str) -> bool:
        inclusion = table.get("inclusion")
        if not isinstance(inclusion, bool):
            raise self._source.fault(None, f"{path}.inclusion must be true or false")
        return inclusion
