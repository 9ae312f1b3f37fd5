"""Turns what the control process hands over into the bytes of `flight.ulg`: rows, traffic and texts, as they come.

The file begins when the vehicle's time is known, because all its times are the vehicle's; texts and the autopilot's
parameters that come before that wait for it.
"""

from __future__ import annotations

import math
import platform
import struct
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, Final

from companion import __version__
from companion.frames import wrap_angle, yaw_from_quat
from companion.record import topics, ulog
from companion.record.columns import COLUMN_INDEX, COLUMNS, DEFAULT_PHASE_NAMES
from companion.record.rows import RowSeries
from companion.record.tlog import Direction, split_frames
from companion.record.traffic import Traffic
from companion.record.ulog import Level, Number, Series

__all__ = ["Entry", "FlightLog", "Level"]

_SYNC_US: Final = 1_000_000
_HELD_TEXTS: Final = 200
_RELEASE: Final = 255  # FIRMWARE_VERSION_TYPE_OFFICIAL
_ROW = struct.Struct(f"={len(COLUMNS)}d")
_USED: Final = {"t_s", "q_w", "q_x", "q_y", "q_z", "heading_error_rad"}
_USED_OF_ROW = struct.Struct("=" + "".join("d" if name in _USED else "8x" for name in COLUMNS))
_LYAPUNOV: Final = COLUMN_INDEX["lyapunov"]
_B_HAT = slice(COLUMN_INDEX["b_hat_n"], COLUMN_INDEX["b_hat_d"] + 1)


class Entry(IntEnum):
    """Kinds of entries beside the directions of datagrams (`tlog.Direction`)."""

    ROW = 16
    """A row of the flight's record: doubles in the order of `columns.COLUMNS`."""
    TEXT = 17
    """A severity in one byte, and UTF-8."""
    FACT = 18
    """A key, a zero byte, and what is known under it, as UTF-8: the last one of a key counts, of "delays" all."""
    SYSTEM = 19
    """The system id of the autopilot that is flown, in one byte."""


_KIND_ROW: Final = int(Entry.ROW)  # an IntEnum compares slowly
_DIRECTIONS: Final = {int(direction) for direction in Direction}


class FlightLog:
    """The log of one flight. `taken` and `end` return what is to be appended to the file.

    Args:
        configuration: the text of flight.toml.
        epoch_minus_wall_ns: turns monotonic into epoch nanoseconds.
    """

    def __init__(self, configuration: str, epoch_minus_wall_ns: int) -> None:
        self._text = configuration
        self._settings = _read(configuration)
        self._epoch_minus_wall_ns = epoch_minus_wall_ns
        self._series = {topic.name: Series(topic, number) for number, topic in enumerate(topics.TOPICS)}
        self._rows = RowSeries([self._series[topic.name] for topic in topics.STEP_TOPICS], topics.DERIVED)
        self._out: list[bytes] = []
        self._traffic = Traffic(
            lambda topic: self._series[topic.name].into(self._out), self._say, self._set, epoch_minus_wall_ns
        )
        self._held: list[tuple[int, str]] = []
        self._held_parameters: dict[str, Number] = {}
        self._begun = False
        self._due_us = 0  # of the beginning, then of the next sync mark
        self._envelope: float | None = None
        self._row_us: int | None = None
        self._interval_us = 0
        self._gap = False

    def take(self, kind: int, content: bytes, wall_ns: int) -> None:
        """One entry. Of one that raises only a part, or nothing, is in the log.

        Args:
            kind: a `tlog.Direction` or an `Entry`.
            content: the datagram, row or text.
            wall_ns: monotonic time of a datagram.
        """
        if kind == _KIND_ROW:
            self._take_row(content)
        elif kind in _DIRECTIONS:
            self.take_frames(kind, split_frames(content), wall_ns)
        elif kind == Entry.TEXT:
            self._say(content[0], content[1:].decode("utf-8", "replace"))
        elif kind == Entry.FACT:
            key, _, fact = content.decode("utf-8", "replace").partition("\0")
            self._out.append(ulog.long_info(key, fact))
        elif kind == Entry.SYSTEM:
            self._traffic.follow(content[0])

    def take_frames(self, direction: int, frames: Sequence[bytes], wall_ns: int) -> None:
        """One datagram, see `Traffic.take`; as `take`."""
        self._traffic.take(direction, frames, wall_ns)
        now_us = self._traffic.now_us
        if now_us is not None and now_us >= self._due_us:
            self._begin_or_sync(now_us, wall_ns)

    def missed(self, count: int) -> None:
        """So many entries, counted from the beginning, did not get here."""
        self._gap = self._gap or count > self._traffic.dropped
        self._traffic.dropped = count

    def end(self) -> bytes:
        """What is left; a flight without a vehicle's time still gives a log with its texts."""
        if not self._begun:
            self._begin(0, 0)
        self._out.append(ulog.sync())
        return self.taken()

    def taken(self) -> bytes:
        """What has been taken since the last call; nothing before the vehicle's time is known."""
        if not self._begun:
            return b""
        out = b"".join(self._out)
        self._out.clear()
        return out

    # -- the beginning --------------------------------------------------------------------------------------------

    def _begin_or_sync(self, now_us: int, wall_ns: int) -> None:
        """The vehicle's time is known, or has come to where the next sync mark is due."""
        self._due_us = now_us + _SYNC_US
        if self._begun:
            self._out.append(ulog.sync())
        else:
            self._begin(now_us, wall_ns)

    def _begin(self, start_us: int, wall_ns: int) -> None:
        """The header and all definitions, before what has come already."""
        self._begun = True
        parts = [ulog.header(start_us)]
        parts += [ulog.format_definition(topic) for topic in topics.TOPICS]
        parts += self._facts((wall_ns + self._epoch_minus_wall_ns) // 1000 if wall_ns else None)
        read = self._held_parameters
        numbers = {"MAV_TYPE": read.pop("MAV_TYPE", None), **dict(_numbers(self._settings))}
        parts += [ulog.parameter(key, value) for key, value in numbers.items() if value is not None]
        parts += [ulog.subscription(topic, number) for number, topic in enumerate(topics.TOPICS)]
        parts += [ulog.logged(level, start_us, text) for level, text in self._held]
        self._held.clear()
        parts += [ulog.parameter(name, value) for name, value in read.items()]
        read.clear()
        self._out[:0] = parts

    def _facts(self, epoch_us: int | None) -> Iterator[bytes]:
        yield ulog.info("sys_name", "companion")
        yield ulog.info("ver_sw", __version__)
        yield ulog.info("ver_sw_release", _release(__version__), "uint32_t")
        yield ulog.info("sys_os_name", platform.system())
        yield ulog.info("sys_os_ver", platform.release())
        for key, name in (("flight", self._settings.get("name")), ("vehicle", _name(self._settings, "vehicle")),
                          ("trajectory", _name(self._settings, "trajectory"))):  # fmt: skip
            if isinstance(name, str):
                yield ulog.info(key, name)
        yield ulog.info("phase_names", ", ".join(DEFAULT_PHASE_NAMES))
        yield ulog.info("time_ref_utc", 0, "int32_t")
        if epoch_us is not None:
            yield ulog.info("time_utc_usec", epoch_us)
        if self._text:
            yield ulog.long_info("flight_toml", self._text)

    # -- what comes -----------------------------------------------------------------------------------------------

    def _say(self, level: int, text: str) -> None:
        now_us = self._traffic.now_us
        if self._begun:
            self._out.append(ulog.logged(level, now_us or 0, text))
        elif len(self._held) < _HELD_TEXTS:
            self._held.append((level, text))

    def _set(self, name: str, value: Number) -> None:
        """A parameter of the autopilot: behind the definitions a change, as its value was not known there."""
        if self._begun:
            self._out.append(ulog.parameter(name, value))
        else:
            self._held_parameters[name] = value

    def _take_row(self, content: bytes) -> None:
        t_s, q_w, q_x, q_y, q_z, heading_error = _USED_OF_ROW.unpack(content)
        t_us = round(t_s * 1e6)
        self._mark_gap(t_us)
        yaw = yaw_from_quat((q_w, q_x, q_y, q_z)) - heading_error
        if self._envelope is None:
            row = _ROW.unpack(content)
            self._envelope = envelope(self._settings, row[_LYAPUNOV], row[_B_HAT])
        derived = (wrap_angle(yaw) if math.isfinite(yaw) else math.nan, self._envelope)
        self._out.append(self._rows.encode(t_us, content, derived))

    def _mark_gap(self, t_us: int) -> None:
        """After entries were lost: where rows are missing, for how long."""
        last_us, self._row_us = self._row_us, t_us
        if last_us is None:
            return
        passed_us = t_us - last_us
        if self._gap and passed_us > 1.5 * self._interval_us:
            self._gap = False
            self._out.append(ulog.dropout(1e-3 * passed_us))
        else:
            self._interval_us = passed_us


def envelope(settings: Mapping[str, Any], value: float, b_hat: Sequence[float]) -> float:
    """What V_H without its b_tilde term does not rise above by the proof of docs/law.md section 4 [m^2].

    V_H(0) + (B + |b_hat(0)|)^2 / (2 k1 Gamma), with the largest disturbance B for the unknown one. NaN where nothing
    is promised: without an estimator, or without its settings.

    Args:
        settings: the flight's configuration.
        value: V_H without its b_tilde term at the first step [m^2].
        b_hat: the estimate there, NED [m/s^2].
    """
    vehicle = settings.get("vehicle", {})
    try:
        k1, gamma = float(vehicle["controller"]["k1_1_s"]), float(vehicle["controller"]["gamma_1_s3"])
        most = float(vehicle["limits"]["disturbance_max_m_s2"])
    except (KeyError, TypeError, ValueError):
        return math.nan
    if not k1 * gamma > 0.0:
        return math.nan
    return value + (most + math.hypot(*b_hat)) ** 2 / (2.0 * k1 * gamma)


# ---- the configuration ----------------------------------------------------------------------------------------------


def _read(text: str) -> dict[str, Any]:
    """The flight's configuration; empty when it cannot be read: the text is in the log all the same."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _name(settings: Mapping[str, Any], key: str) -> object:
    """The name in a table, or the name that stands in its place."""
    table = settings.get(key)
    return table.get("name") if isinstance(table, Mapping) else table


def _numbers(settings: Mapping[str, Any]) -> Iterator[tuple[str, Number]]:
    """Every number of the configuration by its path; the vehicle's tables stand beside the flight's. Trajectories can
    be long, and are left to the text."""
    for key, value in settings.items():
        if key == "vehicle" and isinstance(value, Mapping):
            for inner, below in value.items():
                yield from _flat(inner, below)
        elif key != "trajectory":
            yield from _flat(key, value)


def _flat(path: str, value: object) -> Iterator[tuple[str, Number]]:
    if isinstance(value, Mapping):
        for key, below in value.items():
            yield from _flat(f"{path}/{key}", below)
    elif isinstance(value, list):
        for index, below in enumerate(value):
            yield from _flat(f"{path}/{index}", below)
    elif isinstance(value, bool):
        yield path, int(value)
    elif isinstance(value, int | float):
        yield path, value


def _release(version: str) -> int:
    """The version as PX4 packs one: major, minor, patch, and "release"."""
    parts = [int("".join(c for c in part if c.isdigit()) or 0) & 0xFF for part in version.split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    return major << 24 | minor << 16 | patch << 8 | _RELEASE
