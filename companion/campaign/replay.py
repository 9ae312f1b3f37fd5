"""A recorded flight's states through today's controller: what it would have commanded, beside what was sent.

The states, their stamps and how the flight was engaged come from the flight's folder or log; the reference is planned
anew from them. With the flight's own configuration and the same program the commands are the recorded ones to the last
bit, so every difference is one of gains, vehicle file or code. The states are those of the old commands: a replay says
how two controllers answer the same states, not how the new one would have flown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from companion.config import Flight, build_flight, with_paths
from companion.control import flat
from companion.control.output import thrust_of
from companion.control.types import State
from companion.errors import InputError
from companion.flight.adaptation import adapted
from companion.flight.controller import controller_of
from companion.flight.course import ZERO, Course, Timed
from companion.flight.engines import Kernels
from companion.flight.phases import Engagement
from companion.flight.tracker import Tracker
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import FlightSource, read_source
from companion.trajectory.load import of_flight

Array = npt.NDArray[np.float64]

COMMANDS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "thrust sent": ("of full", ("thrust_cmd",)),
    "thrust": ("N", ("thrust_n",)),
    "body rates": ("rad/s", ("rate_cmd_x", "rate_cmd_y", "rate_cmd_z")),
    "angular acceleration": ("rad/s^2", ("tau_x", "tau_y", "tau_z")),
    "disturbance estimate": ("m/s^2", ("b_hat_n", "b_hat_e", "b_hat_d")),
}
"""What is compared: unit, and the record's columns."""
_PROGRESS_ROWS: Final = 500


@dataclass(frozen=True)
class Difference:
    """How far a command of the replay is from the recorded one."""

    name: str
    unit: str
    largest: float
    rms: float
    first_s: float | None
    """Vehicle time since the flight was engaged at which the two differ first; None: never."""


@dataclass(frozen=True)
class Replay:
    """Recorded and replayed commands, row by row."""

    flight: Flight
    recorded: FlightRecord
    replayed: dict[str, Array]
    """By column of the record, shape (rows,)."""
    time_s: Array
    """Since the flight was engaged, shape (rows,)."""

    @property
    def differences(self) -> list[Difference]:
        """One per entry of COMMANDS."""
        return [self._difference(name, unit, columns) for name, (unit, columns) in COMMANDS.items()]

    @property
    def identical(self) -> bool:
        """Whether every command is the recorded one to the last bit."""
        return all(found.first_s is None for found in self.differences)

    def _difference(self, name: str, unit: str, columns: tuple[str, ...]) -> Difference:
        before = self.recorded.columns(*columns)
        after = np.column_stack([self.replayed[column] for column in columns])
        both_nan = np.isnan(before) & np.isnan(after)
        apart = np.linalg.norm(np.where(both_nan, 0.0, after - before), axis=1)
        differs = np.flatnonzero(np.any((before != after) & ~both_nan, axis=1))
        first_s = float(self.time_s[differs[0]]) if len(differs) else None
        return Difference(name, unit, float(np.max(apart)), float(np.sqrt(np.mean(apart * apart))), first_s)


def replay(
    flown: FlightSource | Path,
    engine: Kernels,
    changed: Flight | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Replay:
    """Compute the commands of a recorded flight again.

    Args:
        flown: the flight, or its folder or log.
        engine: the arithmetic.
        changed: another configuration (gains, vehicle); None: the flight's own.
        progress: called now and then with the share that is done.

    Raises:
        InputError: it is no flight that can be replayed.
        RefusedError: with the changed configuration the course cannot be flown.
    """
    source = flown if isinstance(flown, FlightSource) else read_source(flown)
    flight = changed or build_flight(configuration_of(source), source.configuration_name)
    if flight.output.controller != "law":
        raise InputError(f"{source.path}: PX4's own controller flew; a replay computes the law's commands")
    record = source.record
    engagement = _engagement(source)
    if not len(record):
        raise InputError(f"{source.path}: the record is empty, the flight was never engaged")
    if changed is None:
        flight = adapted(flight, engagement.adaptation)
    trajectory = of_flight(flight)
    where = engagement.hold_point_m, engagement.yaw_rad, engagement.home_m
    course = Course(trajectory, flight.vehicle, *where, flight.height_min_m, origin=engagement.origin_m)
    for ramp in engagement.ramps:
        course.change_pace(ramp)
    tracker = controller_of(flight, engine)
    ways = list(engagement.transitions) if changed is None else []  # other gains are compared as they stand
    delays = list(engagement.delays) if changed is None else []
    resets = list(engagement.resets)
    rows = record.rows
    reference_at = Timed(course, engagement.at_s)
    tracker.begin(State(ZERO, ZERO, engagement.attitude, ZERO), engagement.thrust_n)
    replayed = {column: np.full(len(rows), np.nan) for _, columns in COMMANDS.values() for column in columns}
    table = np.column_stack([rows[:, 0], record.columns(*_STATE)])
    for index, (stamp_s, *x) in enumerate(table.tolist()):
        state = State((x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8], x[9]), (x[10], x[11], x[12]))
        if ways and stamp_s >= ways[0].begin_s and isinstance(tracker, Tracker):
            way = ways.pop(0)
            tracker.retune(way.new, way.duration_s)
        if delays and stamp_s >= delays[0][0] and isinstance(tracker, Tracker):
            tracker.retime(delays.pop(0)[1])
        while resets and stamp_s >= resets[0].at_s:
            course.shift(resets[0].moved_m)
            tracker.carry(resets.pop(0))
        out = tracker.step(stamp_s, state, reference_at)
        n = out.numbers
        values = (thrust_of(out.setpoint), n[flat.TOTAL], *n[flat.RATES], *n[flat.TAU], *n[flat.B_HAT])
        for column, value in zip(replayed, values, strict=True):
            replayed[column][index] = value
        if index % _PROGRESS_ROWS == 0:
            progress(index / len(rows))
    return Replay(flight, record, replayed, rows[:, 0] - engagement.at_s)


_STATE: Final = ("p_n", "p_e", "p_d", "v_n", "v_e", "v_d", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z")


def configuration_of(source: FlightSource) -> dict[str, Any]:
    """The contents of the flight's flight.toml, with the paths in it made absolute. Raises InputError."""
    if not source.configuration:
        raise InputError(f"{source.configuration_name}: there is no configuration, which a replay needs")
    return with_paths(source.configuration, source.folder)


def _engagement(source: FlightSource) -> Engagement:
    """How the flight began. Raises InputError."""
    entry = source.summary.get("engagement")
    if entry is None:
        raise InputError(f"{source.path}: does not say how the flight was engaged; it never was, or is too old")
    try:
        return Engagement.from_numbers(entry)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(f"{source.path}: engagement: {error}; it cannot be replayed") from None
