"""Trajectory files of other programs: one module per format, and the registry that tells them apart by contents."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from companion.frames import FRAMES, Frame
from companion.trajectory.fence import Fence
from companion.trajectory.formats import (
    mavsdk_csv,
    plan,
    polynomial_csv,
    rpg_csv,
    skybrush_csv,
    waypoint_csv,
    wpl,
)
from companion.trajectory.formats.contents import Content
from companion.trajectory.formats.reading import Source, first_line, quoted, read_source

Z_UP: tuple[Frame, ...] = ("enu", "nwu")


class Format(NamedTuple):
    """A format of files."""

    name: str
    """As in a trajectory file's `format`."""
    title: str
    """For people."""
    suffixes: tuple[str, ...]
    """Of file names; what a file holds counts more."""
    matches: Callable[[Source], bool]
    """Whether a text is of this format."""
    read: Callable[[Source, Frame], Content]
    """The contents in north-east-down, or InputError."""
    frames: tuple[Frame, ...]
    """That its positions may come in."""
    frame: Frame | None
    """The one that comes with the format; None: it has to be declared."""


FORMATS = (
    Format(
        "polynomial-csv",
        "polynomial CSV (uav_trajectories, Crazyswarm)",
        (".csv",),
        polynomial_csv.matches,
        polynomial_csv.read,
        Z_UP,
        "enu",
    ),
    Format("rpg-csv", "sampled CSV (RPG, Agilicious)", (".csv",), rpg_csv.matches, rpg_csv.read, Z_UP, None),
    Format("mavsdk-csv", "MAVSDK CSV", (".csv",), mavsdk_csv.matches, mavsdk_csv.read, ("ned",), "ned"),
    Format("skybrush-csv", "Skybrush CSV", (".csv",), skybrush_csv.matches, skybrush_csv.read, Z_UP, "nwu"),
    Format("qgc-plan", "QGroundControl plan", (".plan", ".json"), plan.matches, plan.read, ("ned",), "ned"),
    Format("qgc-wpl", "QGC WPL 110 mission", (".waypoints", ".txt", ".wpl"), wpl.matches, wpl.read, ("ned",), "ned"),
    Format(
        "waypoint-csv",
        "waypoint CSV",
        (".csv", ".txt"),
        waypoint_csv.matches,
        waypoint_csv.read,
        tuple(FRAMES),
        None,
    ),
)
"""All formats; the first that matches counts."""

NAMES = tuple(entry.name for entry in FORMATS)


def read(path: Path, *, frame: Frame | None = None, name: str | None = None, called: str | None = None) -> Content:
    """Return what a file holds, in north-east-down.

    Args:
        path: the file.
        frame: of its positions, as the user declares it; None: the format's own.
        name: of the format; None: it is recognised by what the file holds.
        called: what to call the file in messages; its path when absent.

    Raises:
        InputError: with file, line where there is one, and reason.

    """
    return parse(read_source(path, called), frame=frame, name=name, suffix=path.suffix)


def parse(source: Source, *, frame: Frame | None = None, name: str | None = None, suffix: str = "") -> Content:
    """Return what a text holds, as `read` does."""
    chosen = _by_name(source, name) if name is not None else recognise(source, suffix)
    try:
        return chosen.read(source, _frame(source, chosen, frame))
    except OverflowError:
        raise source.fault(None, "holds numbers that are too large") from None


def read_fence(path: Path) -> Fence:
    """Return the geofence of a mission file, which need not have a mission, in north-east-down from its home.

    Raises:
        InputError: it is of another format, has no fence, or does not say where home is.

    """
    source = read_source(path)
    chosen = recognise(source, path.suffix)
    reader = {"qgc-plan": plan.read_fence, "qgc-wpl": wpl.read_fence}.get(chosen.name)
    if reader is None:
        raise source.fault(None, f"a {chosen.title} file has no geofence; a QGroundControl plan can")
    found = reader(source)
    if found is None:
        raise source.fault(None, "has no geofence, or no home position to count it from")
    return found


def recognise(source: Source, suffix: str = "") -> Format:
    """Return the format of a text. Raises InputError, with what the text begins with and what the suffix says."""
    for entry in FORMATS:
        if entry.matches(source):
            return entry
    expected = [entry.title for entry in FORMATS if suffix.lower() in entry.suffixes] or [f.title for f in FORMATS]
    line, text = first_line(source)
    raise source.fault(line, f"{quoted(text)} does not begin any known format; for this: {', '.join(expected)}")


def _by_name(source: Source, name: str) -> Format:
    for entry in FORMATS:
        if entry.name == name:
            if not entry.matches(source):
                line, text = first_line(source)
                raise source.fault(line, f"{quoted(text)} does not begin a file of the format {name}")
            return entry
    raise source.fault(None, f"format {quoted(name)}: allowed are {', '.join(NAMES)}")


def _frame(source: Source, chosen: Format, declared: Frame | None) -> Frame:
    """Return the frame that counts: the file's own, or the one declared where there is a choice."""
    own = waypoint_csv.frame_of(source) if chosen.name == "waypoint-csv" else None
    allowed = chosen.frames if own is None else (own,)
    if declared is not None and declared not in allowed:
        named = ", ".join(f"{frame} ({FRAMES[frame]})" for frame in allowed)
        raise source.fault(None, f"the frame {declared} does not fit: a {chosen.title} file is in {named}")
    found = declared or own or chosen.frame
    if found is None:
        named = ", ".join(f"{frame} ({FRAMES[frame]})" for frame in allowed)
        raise source.fault(
            None,
            f"a {chosen.title} file does not say which frame it is in; declare it with --frame or frame = ...: {named}",
        )
    return found


__all__ = ["FORMATS", "NAMES", "Format", "parse", "read", "read_fence", "recognise"]
