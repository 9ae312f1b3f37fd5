"""Trajectories by name: from a file of ours (config/trajectories/*.toml) or of another program to a reference in time.

A file of ours defines a closed shape, points to plan a path through (shape = "waypoints"), or names another program's
file (file = "lap.csv"). Another program's file can also be named directly.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any

from companion.config import Flight, Vehicle, find, read_toml, validate
from companion.errors import InputError, RefusedError
from companion.frames import Frame, radians
from companion.trajectory.anchored import Trajectory
from companion.trajectory.definition import Definition
from companion.trajectory.file_definition import FileDefinition, PlacedTable, WaypointsDefinition
from companion.trajectory.files import Made, shape_of
from companion.trajectory.formats import FORMATS, parse
from companion.trajectory.formats.reading import FILE_MAX_BYTES, Source, decoded, quoted, read_bytes, shown
from companion.trajectory.laps import repeated
from companion.trajectory.route import planned

STORED_NAME = "trajectory"
"""Of the copy of another program's file in a flight's folder."""


def load(
    name: str | Path,
    time_scale: float | None = None,
    *,
    vehicle: Vehicle | None = None,
    frame: Frame | None = None,
    laps: int | None = None,
    confined: bool = False,
) -> Trajectory:
    """Return the trajectory of a file.

    Args:
        name: a path, or the name of a bundled trajectory.
        time_scale: replaces the file's; 2.0 flies it twice as fast, in half the time.
        vehicle: what paths through points are planned for; needed for these alone.
        frame: of another program's file, where its format leaves that open.
        laps: replaces the file's, and its duration_s.
        confined: a file of ours may only name files in its own folder: for files that came from somewhere else.

    Raises:
        InputError: no such file, or something in it is wrong; one line with file, place and what is allowed.
        RefusedError: points between which the vehicle's limits leave no way.

    """
    path = find(str(name), "trajectories")
    table = changed(_table_of(path, frame), None, laps)
    called = shown(str(path))
    other = table.get("file") if path.suffix.lower() == ".toml" else None
    if confined and isinstance(other, str) and Path(other).parent != path.parent.absolute():
        raise InputError(f"{called}: file = {quoted(other)}: must be the name of a file in the same folder")
    return build(table, shown(path.stem), called, time_scale, vehicle=vehicle)


def build(
    data: Mapping[str, Any],
    name: str,
    source: str,
    time_scale: float | None = None,
    *,
    vehicle: Vehicle | None = None,
) -> Trajectory:
    """Return the trajectory that the contents of a file of ours define.

    Args:
        data: the parsed TOML.
        name: what to call the trajectory, unless it has a name of its own.
        source: what to call the file in errors.
        time_scale: replaces the file's.
        vehicle: as in `load`.

    Raises:
        InputError, RefusedError: as `load`.

    """
    if time_scale is not None and not (isfinite(time_scale) and time_scale > 0.0):
        raise InputError(
            f"time scale {time_scale!r} for {source}: must be a number above zero (2.0 flies twice as fast)"
        )
    if "file" in data or "text" in data:
        return _from_file(validate(FileDefinition, data, source), name, source, time_scale, vehicle)
    if data.get("shape") == "waypoints":
        return _through_waypoints(validate(WaypointsDefinition, data, source), name, source, time_scale, vehicle)
    definition = validate(Definition, data, source)
    scale = definition.time_scale if time_scale is None else time_scale
    return Trajectory(
        name=definition.name or name,
        shape=definition.built_shape(),
        duration_s=_duration_s(definition.shape_duration_s(), scale, source),
        anchor=definition.anchor,
        anchor_yaw_rad=radians(definition.anchor_yaw_deg),
        join=definition.join,
        time_scale=scale,
    )


def _duration_s(shape_s: float, scale: float, source: str) -> float:
    duration_s = shape_s / scale
    if not (isfinite(duration_s) and duration_s > 0.0):
        raise InputError(f"{source}: takes {duration_s} s at a time scale of {scale}: must be a finite time above zero")
    return duration_s


def _from_file(
    definition: FileDefinition,
    name: str,
    source: str,
    time_scale: float | None,
    vehicle: Vehicle | None,
) -> Trajectory:
    text, suffix = _text_of(definition, source)
    made = shape_of(text, suffix, definition.options(vehicle))
    return _placed(definition, made, name, source, time_scale, vehicle)


def reader_notes(data: Mapping[str, Any], source: str) -> tuple[str, ...]:
    """Return what the reader of another program's file says about it, without making a path: that takes a vehicle.

    Args:
        data: the table of a trajectory file; one that names no other program's file has no such notes.
        source: what to call the file in errors.

    Raises:
        InputError: the other program's file cannot be read.

    """
    if not {"file", "text"} & set(data):
        return ()
    definition = validate(FileDefinition, data, source)
    text, suffix = _text_of(definition, source)
    return parse(text, frame=definition.frame, name=definition.format, suffix=suffix).notes


def _text_of(definition: FileDefinition, source: str) -> tuple[Source, str]:
    """Return the other program's text, and its file's suffix."""
    if definition.text is not None:
        return decoded(definition.text.encode("utf-8", "replace"), f"{source}: text"), ""
    assert definition.file is not None
    path = Path(definition.file)
    data = read_bytes(path, _called(path))
    if definition.sha256 is not None and sha256(data).hexdigest() != definition.sha256:
        raise InputError(f"{_called(path)}: is not the file any more that {source} was written for (sha256)")
    return decoded(data, _called(path)), path.suffix


def _called(path: Path) -> str:
    """Return a path as messages name it: from here on where it is below the current folder."""
    with suppress(ValueError, OSError):
        return shown(str(path.relative_to(Path.cwd())))
    return shown(str(path))


def _through_waypoints(
    definition: WaypointsDefinition, name: str, source: str, time_scale: float | None, vehicle: Vehicle | None
) -> Trajectory:
    if vehicle is None:
        raise InputError(f"{source}: a path through waypoints takes a vehicle's limits to plan: name a vehicle")
    try:
        shape, notes = planned(
            definition.route(),
            definition.limits.within(vehicle),
            definition.heading.mode,
            radians(definition.heading.yaw_deg),
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    except RefusedError as error:
        raise RefusedError(f"{source}: {error}") from None
    return _placed(definition, Made(shape, shape.own_duration_s, notes), name, source, time_scale, vehicle)


def _placed(
    definition: PlacedTable, made: Made, name: str, source: str, time_scale: float | None, vehicle: Vehicle | None
) -> Trajectory:
    """Return the trajectory of a shape that has its own duration."""
    scale = definition.time_scale if time_scale is None else time_scale
    if definition.laps > 1:
        made = _repeated(made, definition, scale, source, vehicle)
    return Trajectory(
        name=definition.name or name,
        shape=made.shape,
        duration_s=_duration_s(made.duration_s, scale, source),
        anchor=definition.anchor or ("here" if made.origin is None else "home"),
        anchor_yaw_rad=radians(definition.anchor_yaw_deg),
        join=definition.join,
        time_scale=scale,
        origin=made.origin,
        fence=made.fence,
        notes=made.notes,
    )


def _repeated(made: Made, definition: PlacedTable, scale: float, source: str, vehicle: Vehicle | None) -> Made:
    if vehicle is None:
        raise InputError(f"{source}: laps = {definition.laps}: the way back takes a vehicle's limits: name a vehicle")
    try:
        shape = repeated(made.shape, made.duration_s, definition.laps, definition.limits.within(vehicle), scale)
    except RefusedError as error:
        raise RefusedError(f"{source}: {error}") from None
    how = f"{shape.back_s / scale:.1f} s from the end back to the start between two" if shape.back_s else "closed"
    return made._replace(
        shape=shape, duration_s=shape.own_duration_s, notes=(*made.notes, f"{definition.laps} laps, {how}")
    )


def of_flight(flight: Flight) -> Trajectory:
    """Return the trajectory that a flight names, or that stands in its file as a table."""
    if isinstance(flight.trajectory, str):
        return load(flight.trajectory, vehicle=flight.vehicle)
    data = flight.trajectory
    source = f"flight {flight.name!r}: trajectory {data.get('name', 'unnamed')!r}"
    return build(data, "unnamed", source, vehicle=flight.vehicle)


def table_of(name: str, frame: Frame | None = None) -> dict[str, Any]:
    """Return the table that stands for a trajectory file in a flight: its own keys, or where another program's file is.

    A path in it is absolute and comes with the file's checksum, so that what is flown is what was checked.

    Args:
        name: a path, or the name of a bundled trajectory.
        frame: of another program's file, where its format leaves that open.

    Raises:
        InputError: no such file, or it cannot be read.

    """
    path = find(name, "trajectories")
    return _pinned({"name": shown(path.stem), **_table_of(path, frame)})


def embedded(flight: Flight, time_scale: float | None = None, laps: int | None = None) -> Flight:
    """Return the flight with its trajectory as a table, so that its file says all that was flown.

    Args:
        flight: names a trajectory, or holds one.
        time_scale: replaces the trajectory's own.
        laps: replaces the trajectory's own, and its duration_s.
    """
    named = flight.trajectory
    table = table_of(named) if isinstance(named, str) else _pinned(dict(named))
    return flight.model_copy(update={"trajectory": changed(table, time_scale, laps)})


def changed(table: dict[str, Any], time_scale: float | None, laps: int | None) -> dict[str, Any]:
    """Return the table with another pace and number of laps; None leaves what it says."""
    if time_scale is not None:
        table = {**table, "time_scale": time_scale}
    if laps is not None:
        table = {key: value for key, value in table.items() if key != "duration_s"} | {"laps": laps}
    return table


def stored(flight: Flight, folder: Path) -> Flight:
    """Copy the other program's file that a flight's trajectory comes from into the flight's folder, and name it there.

    The folder then holds all that was flown. A flight without such a file is returned as it is.

    Raises:
        InputError: the file cannot be read or copied, or is not the one that was checked.

    """
    if isinstance(flight.trajectory, str) or "file" not in flight.trajectory:
        return flight
    table = _pinned(dict(flight.trajectory))
    path = Path(table["file"])
    data = read_bytes(path)
    if sha256(data).hexdigest() != table["sha256"]:
        raise InputError(f"{shown(str(path))}: has changed while the flight was prepared; try again")
    known = {suffix for entry in FORMATS for suffix in entry.suffixes}
    copy = folder / f"{STORED_NAME}{path.suffix.lower() if path.suffix.lower() in known else '.txt'}"
    try:
        copy.write_bytes(data)
    except OSError as error:
        raise InputError(f"{copy}: cannot be written: {error.strerror}") from None
    return flight.model_copy(update={"trajectory": {**table, "file": copy.name}})


def _table_of(path: Path, frame: Frame | None) -> dict[str, Any]:
    """Return the keys of a file of ours, or those that name another program's file."""
    if path.suffix.lower() != ".toml":
        table: dict[str, Any] = {"file": str(path)}
    else:
        if path.stat().st_size > FILE_MAX_BYTES:
            raise InputError(
                f"{shown(str(path))}: longer than {FILE_MAX_BYTES // 2**20} MB, which is the most that is read"
            )
        table = read_toml(path)
        if frame is not None and not {"file", "text"} & set(table):
            raise InputError(f"{shown(str(path))}: --frame is for other programs' files; this one is north, east, down")
    return table if frame is None else {**table, "frame": frame}


def _pinned(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table with the path of another program's file made absolute, and its checksum."""
    if not isinstance(table.get("file"), str):
        return table
    path = Path(table["file"])
    absolute = path.absolute()
    digest = sha256(read_bytes(absolute, _called(absolute))).hexdigest()
    if table.get("sha256", digest) != digest:
        raise InputError(f"{_called(absolute)}: is not the file any more that its checksum (sha256) was written for")
    return {**table, "file": str(absolute), "sha256": digest}
