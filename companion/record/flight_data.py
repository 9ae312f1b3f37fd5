"""A flight as the figures of its report need it, and what a figure is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from companion.record.charts import Array, Phase
from companion.record.columns import TRACK_PHASE
from companion.record.flight_record import FlightRecord


@dataclass(frozen=True)
class FlightData:
    """A flight as the figures need it."""

    record: FlightRecord
    summary: Mapping[str, Any]
    truth: Mapping[str, Array]
    """Columns of the simulated vehicle's truth.csv; empty when there is none."""
    mass_kg: float | None
    limits: Mapping[str, Any]
    """The table [limits] that was used."""
    thrust_full_n: float | None = None
    """All rotors at full command; None: unknown."""
    curve_factor: float = 0.0
    """Of the thrust curve: thrust = full (factor u^2 + (1 - factor) u)."""
    missing: Sequence[str] = ()
    """What could not be read, a sentence each."""

    @property
    def start_s(self) -> float:
        """Vehicle time at which the trajectory began, or the record when it never did."""
        on_track = np.flatnonzero(self.record.in_phase(TRACK_PHASE) & np.isfinite(self.record.column("track_s")))
        if len(on_track):
            return float(self.record.column("t_s")[on_track[0]] - self.record.column("track_s")[on_track[0]])
        return float(self.record.column("t_s")[0]) if len(self.record) else 0.0

    @property
    def time_s(self) -> Array:
        """The figures' time axis, shape (len,)."""
        return self.record.column("t_s") - self.start_s

    @property
    def phases(self) -> list[Phase]:
        """The phases within the record."""
        if not len(self.record):
            return []
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        known = [entry for entry in self.summary.get("phases", []) if entry["at_s"] is not None]
        begins = [max(entry["at_s"] - self.start_s, first) for entry in known]
        ends = [*begins[1:], last]
        return [
            Phase(entry["name"], begin, min(end, last), entry["reason"])
            for entry, begin, end in zip(known, begins, ends, strict=True)
            if begin < min(end, last)
        ]


class Figure(NamedTuple):
    """A figure with the text around it."""

    key: str
    title: str
    caption: str
    height_px: int
    build: Callable[[FlightData], dict[str, Any]]
    close: Callable[[FlightData], dict[str, Any] | None] | None = None
    """A second panel beside it, where it adds something."""
    of_law: bool = False
    """Whether it shows numbers that only the law has."""
