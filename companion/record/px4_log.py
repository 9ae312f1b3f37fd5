"""PX4's own log of a flight, on the flight's clock: what a page lays over the companion's record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from companion.errors import InputError
from companion.record.alignment import Fit, Motion, align
from companion.record.flight_record import FlightRecord
from companion.record.traffic import NAV_STATES
from companion.record.ulog_file import Array, LogFile, read_ulog

POSITION: Final = "vehicle_local_position"
_MOTORS_MOST: Final = 12
_WANTED: Final = {
    "vehicle_attitude": "attitude",
    "vehicle_attitude_setpoint": "attitude setpoints",
    "vehicle_angular_velocity": "body rates",
    "vehicle_rates_setpoint": "rate setpoints",
    "battery_status": "battery",
    "vehicle_status": "mode and arming",
}
_MOTORS: Final = ("actuator_motors", "actuator_outputs")
_MARGIN_S: Final = 5.0
"""Of PX4's log so much is shown before and after the flight's record."""
_MISSING: Final = 1.8
"""Between samples further apart than so many median intervals nothing is compared."""
_GAP_MEDIANS: Final = 5.0
_GAP_S: Final = 0.25
_DELAY_MOST_S: Final = 0.25
_DELAY_STEP_S: Final = 0.0005
_DELAY_AGREEMENT: Final = 0.9
_MODE_NAMES: Final = {number: mode.label for mode, number in NAV_STATES.items()}


class Series(NamedTuple):
    """Numbers over the flight's time."""

    t_s: Array
    """Shape (len,), increasing."""
    values: Array
    """Shape (len, columns)."""


@dataclass(frozen=True)
class Px4Log:
    """PX4's log of a flight, its times moved onto the companion's clock (the record's `t_s`)."""

    fit: Fit
    log: LogFile
    missing: tuple[str, ...]

    def series(self, topic: str, *fields: str) -> Series | None:
        """A topic's fields; None where the log has none of it."""
        if topic not in self.log.topics or any(field not in self.log.topics[topic] for field in fields):
            return None
        t_s, values = _ordered(self.log.time_s(topic), self.log.vector(topic, fields))
        return Series(t_s + self.fit.offset_s, values)

    @property
    def motors(self) -> tuple[str, Series] | None:
        """What went to the motors and under which name; None where the log has nothing of it."""
        for topic, field in zip(_MOTORS, ("control", "output"), strict=True):
            names = [f"{field}[{index}]" for index in range(_MOTORS_MOST)]
            found = self.series(topic, *[name for name in names if name in self.log.topics.get(topic, {})])
            if found is not None and found.values.shape[1]:
                used = np.any(np.isfinite(found.values) & (found.values != 0.0), axis=0)
                if used.any():
                    return topic, Series(found.t_s, found.values[:, used])
        return None

    @property
    def modes(self) -> list[tuple[str, float, float]]:
        """Modes with the times from and to which they were flown [s]."""
        status = self.series("vehicle_status", "nav_state")
        if status is None or not len(status.t_s):
            return []
        states = status.values[:, 0]
        begins = np.concatenate(([0], np.flatnonzero(np.diff(states)) + 1))
        ends_s = [*status.t_s[begins[1:]], status.t_s[-1]]
        return [
            (_MODE_NAMES.get(int(states[at]), f"mode {states[at]:.0f}"), float(status.t_s[at]), float(end_s))
            for at, end_s in zip(begins, ends_s, strict=True)
        ]

    @property
    def texts(self) -> list[tuple[float, int, str]]:
        """What PX4 said: time [s], severity, text."""
        return [(1e-6 * t_us + self.fit.offset_s, level, text) for level, t_us, text in self.log.texts]

    def delay_s(self, record: FlightRecord) -> float | None:
        """From a state's stamp to the rate setpoint that answers it in PX4; None where it had others.

        The delay at which PX4's setpoints are most like the recorded commands, each held until the next.
        """
        wanted = self.series("vehicle_rates_setpoint", "roll", "pitch", "yaw")
        t_s, sent = record.column("t_s"), record.columns("rate_cmd_x", "rate_cmd_y", "rate_cmd_z")
        known = np.isfinite(sent).all(axis=1)
        if wanted is None or np.count_nonzero(known) < 2:
            return None
        t_s, sent = t_s[known], sent[known]
        inside = (wanted.t_s > t_s[0] + _DELAY_MOST_S) & (wanted.t_s < t_s[-1])
        inside &= np.isfinite(wanted.values).all(axis=1)
        if np.count_nonzero(inside) < 10:
            return None
        times, values = wanted.t_s[inside], wanted.values[inside]
        delays = np.arange(0.0, _DELAY_MOST_S, _DELAY_STEP_S)
        squares = [((sent[np.searchsorted(t_s, times - d, side="right") - 1] - values) ** 2).mean() for d in delays]
        best = int(np.argmin(squares))
        fits = squares[best] < (1.0 - _DELAY_AGREEMENT) * float(values.var(axis=0).mean())
        return float(delays[best]) if fits else None


def read_px4_log(path: Path, record: FlightRecord) -> Px4Log:
    """Read PX4's log and find its time offset to a flight's record.

    Raises:
        InputError: it cannot be read, is not PX4's, or does not show the flight.
    """
    log = read_ulog(path, [POSITION, *_WANTED, *_MOTORS])
    if log.is_ours:
        raise InputError(f"{path}: is a log of this program; --from-px4 takes the autopilot's own")
    needed = ("x", "y", "z", "vx", "vy", "vz")
    if POSITION not in log.topics or any(name not in log.topics[POSITION] for name in needed):
        raise InputError(f"{path}: has no {POSITION}; the time offset to the flight is found from that")
    if len(record) < 2:
        raise InputError("the flight has no control steps; nothing can be laid over the autopilot's log")
    t_s, numbers = _ordered(log.time_s(POSITION), log.vector(POSITION, needed))
    good = np.isfinite(numbers).all(axis=1)
    theirs = Motion(t_s[good], numbers[good, :3], numbers[good, 3:])
    states = record.columns("p_n", "p_e", "p_d", "v_n", "v_e", "v_d")
    whole = np.isfinite(states).all(axis=1)
    ours = Motion(record.column("t_s")[whole], states[whole, :3], states[whole, 3:])
    fit = align(ours, theirs)
    absent = [f"the autopilot's log has no {topic} ({what})" for topic, what in _WANTED.items()
              if topic not in log.topics]  # fmt: skip
    if not any(topic in log.topics for topic in _MOTORS):
        absent.append(f"the autopilot's log has no {' and no '.join(_MOTORS)} (motor commands)")
    return Px4Log(fit, log, tuple(f"the autopilot's log: {said}" for said in log.missing) + tuple(absent))


def _ordered(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Rows with times that increase, as they should; damaged ones are left out."""
    good = np.isfinite(t_s) & (t_s > np.concatenate(([-math.inf], np.maximum.accumulate(t_s)[:-1])))
    return t_s[good], values[good]


def clipped(series: Series, from_s: float, to_s: float) -> Series:
    """The part from one time to another, with a margin."""
    inside = (series.t_s >= from_s - _MARGIN_S) & (series.t_s <= to_s + _MARGIN_S)
    return Series(series.t_s[inside], series.values[inside])


def at(series: Series, t_s: Sequence[float] | Array) -> Array:
    """The values between the samples, shape (len(t_s), columns); NaN outside, and where samples are missing."""
    after = np.searchsorted(series.t_s, t_s).clip(1, max(len(series.t_s) - 1, 1))
    if len(series.t_s) < 2:
        return np.full((len(t_s), series.values.shape[1]), np.nan)
    gaps_s = np.diff(series.t_s)
    columns = [np.interp(t_s, series.t_s, column, left=np.nan, right=np.nan) for column in series.values.T]
    missing = gaps_s[after - 1] > _MISSING * float(np.median(gaps_s))
    return np.where(missing[:, None], np.nan, np.column_stack(columns))


def broken(series: Series) -> Series:
    """The same with NaN where PX4 logged nothing for a while: a line must not cross that."""
    if len(series.t_s) < 2:
        return series
    gaps_s = np.diff(series.t_s)
    ends = np.flatnonzero(gaps_s > max(_GAP_MEDIANS * float(np.median(gaps_s)), _GAP_S)) + 1
    middle_s = 0.5 * (series.t_s[ends - 1] + series.t_s[ends])
    return Series(np.insert(series.t_s, ends, middle_s), np.insert(series.values, ends, np.nan, axis=0))
