"""A flight as the figures of its report need it, and what a figure is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from companion.record.charts import ALARM, RESET, Array, Mark, Phase
from companion.record.columns import TRACK_PHASE
from companion.record.flight_record import FlightRecord


class Message(NamedTuple):
    """Something that was said during a flight."""

    at_s: float
    """Vehicle time [s]."""
    level: int
    """Severity, 0 emergency to 7 debug."""
    text: str


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
    gains: Mapping[str, Any] = field(default_factory=dict)
    """The table [controller] that was used."""
    envelope_m2: float = math.nan
    """What the Lyapunov function does not rise above by the proof (docs/log.md); NaN: nothing is promised."""
    battery: Mapping[str, Array] = field(default_factory=dict)
    """The topic battery_status of the flight's log, with `t_s`; empty without one."""
    messages: Sequence[Message] = ()
    """What was said during the flight."""
    guards: frozenset[str] = frozenset()
    """The sentences of the guards: a message with one of them tells of a guard that acted."""

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
    def marks(self) -> list[Mark]:
        """Guards that acted and resets of the autopilot's estimate, as all figures over time show them."""
        kinds = {"guards": ALARM, "resets": RESET}
        told = [(message.at_s - self.start_s, self.kind_of(message), message.text) for message in self.messages]
        return [Mark(at_s, kinds[kind], text) for at_s, kind, text in told if kind in kinds]

    def kind_of(self, message: Message) -> str:
        """The row of the events' figure that a message belongs to; "" for a change of phase, which has its own."""
        text = message.text
        if "estimate was reset" in text:
            return "resets"
        if any(sentence in text for sentence in self.guards):
            return "guards"
        if text.startswith("autopilot: "):
            return "autopilot's words"
        return "" if text.partition(": ")[0] in self.record.phase_names else "messages"

    @property
    def phases(self) -> list[Phase]:
        """The phases within the record."""
        if not len(self.record):
            return []
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        known = [entry for entry in self.summary.get("phases", []) if entry["at_s"] is not None]
        begins = [max(entry["at_s"] - self.start_s, first) for entry in known]
        ends = [*begins[1:], last][: len(begins)]
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
    shown: Callable[[FlightData], bool] = lambda flight: True
    """Whether there is anything to show of a flight."""
