"""Trajectories from files: from the keys of config/trajectories/*.toml to a reference over time."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from companion.config import Flight, find, read_toml, validate
from companion.errors import InputError
from companion.frames import radians
from companion.trajectory.anchored import Trajectory
from companion.trajectory.definition import Definition


def load(name: str | Path, time_scale: float | None = None) -> Trajectory:
    """Return the trajectory of a file.

    Args:
        name: a path, or the name of a bundled trajectory.
        time_scale: replaces the file's; 2.0 flies it twice as fast, in half the time.

    Raises:
        InputError: no such file, or something in it is wrong; one line with file, key path, value and what is allowed.

    """
    path = find(str(name), "trajectories")
    return build(read_toml(path), path.stem, str(path), time_scale)


def build(data: Mapping[str, Any], name: str, source: str, time_scale: float | None = None) -> Trajectory:
    """Return the trajectory that the contents of a file define.

    Args:
        data: the parsed TOML.
        name: what to call the trajectory.
        source: what to call the file in errors.
        time_scale: replaces the file's.

    Raises:
        InputError: as `load`.

    """
    if time_scale is not None and not (isfinite(time_scale) and time_scale > 0.0):
        raise InputError(
            f"time scale {time_scale!r} for {source}: must be a number above zero (2.0 flies twice as fast)"
        )
    definition = validate(Definition, data, source)
    scale = definition.time_scale if time_scale is None else time_scale
    duration_s = definition.shape_duration_s() / scale
    if not (isfinite(duration_s) and duration_s > 0.0):
        raise InputError(f"{source}: takes {duration_s} s at a time scale of {scale}: must be a finite time above zero")
    return Trajectory(
        name=name,
        shape=definition.built_shape(),
        duration_s=duration_s,
        anchor=definition.anchor,
        anchor_yaw_rad=radians(definition.anchor_yaw_deg),
        join=definition.join,
        time_scale=scale,
    )


def of_flight(flight: Flight) -> Trajectory:
    """Return the trajectory that a flight names, or that stands in its file as a table."""
    if isinstance(flight.trajectory, str):
        return load(flight.trajectory)
    data = dict(flight.trajectory)
    name = str(data.pop("name", "unnamed"))
    return build(data, name, f"flight {flight.name!r}: trajectory {name!r}")


def embedded(flight: Flight, time_scale: float | None = None) -> Flight:
    """Return the flight with its trajectory as a table, so that its file says all that was flown.

    Args:
        flight: names a trajectory, or holds one.
        time_scale: replaces the trajectory's own.
    """
    if isinstance(flight.trajectory, str):
        path = find(flight.trajectory, "trajectories")
        table = {"name": path.stem, **read_toml(path)}
    else:
        table = dict(flight.trajectory)
    if time_scale is not None:
        table["time_scale"] = time_scale
    return flight.model_copy(update={"trajectory": table})
