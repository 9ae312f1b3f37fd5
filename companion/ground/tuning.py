"""The parameters that ground tools see at component 191: which keys of the vehicle file they are, and their values.

A name is what fits into a MAVLink parameter name (16 characters); value and unit are those of the vehicle file.
`Tuning` is a vehicle file with what was changed of it; it is immutable, a change gives another one. docs/parameters.md
shows the table.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from companion.config import HEADINGS, Vehicle, merged, validate
from companion.errors import InputError
from companion.flight.retuning import ParameterChange

INT32: Final = 6
REAL32: Final = 9
"""MAV_PARAM_TYPE; every value is one of these two, as in PX4."""

RAMPS: Final = "ramps"
NEXT: Final = "next flight"
NAME_MAX: Final = 16

Number = int | float


class Entry(NamedTuple):
    """One parameter."""

    name: str
    section: str
    key: str
    """Of the vehicle file: section and key."""
    element: int | None
    """Of a list's element; None for a plain value."""
    unit: str
    low: float
    high: float
    in_flight: str
    """RAMPS: a flight that is under way follows; NEXT: the next one does."""
    meaning: str
    words: tuple[str, ...] = ()
    """What the whole numbers from 0 stand for in the vehicle file; empty: the value is a REAL32."""

    @property
    def path(self) -> str:
        """The key path in the vehicle file."""
        element = "" if self.element is None else f"[{self.element}]"
        return f"{self.section}.{self.key}{element}"

    @property
    def type(self) -> int:
        """INT32 or REAL32."""
        return INT32 if self.words else REAL32


def _gain(name: str, key: str, unit: str, meaning: str) -> Entry:
    return Entry(name, "controller", key, None, unit, 0.01, 100.0, RAMPS, meaning)


def _limit(name: str, key: str, unit: str, bounds: tuple[float, float], when: str, meaning: str) -> Entry:
    return Entry(name, "limits", key, None, unit, *bounds, when, meaning)


def _rate(axis: str, index: int) -> Entry:
    meaning = f"largest commanded {axis} rate"
    return Entry(f"OC_RATE_MAX_{'XYZ'[index]}", "limits", "rate_max_rad_s", index, "rad/s", 0.1, 35.0, NEXT, meaning)


_KINDS: Final = tuple(sorted(HEADINGS, key=HEADINGS.__getitem__))

ENTRIES: Final = tuple(
    sorted(
        (
            _gain("OC_K1", "k1_1_s", "1/s", "gain k1 of the position"),
            _gain("OC_K2", "k2", "", "gain k2 of the velocity"),
            _gain("OC_K3", "k3_1_s", "1/s", "gain k3 of the acceleration"),
            _gain("OC_K4", "k4_1_s", "1/s", "gain k4 of the jerk"),
            Entry(
                *("OC_GAMMA", "controller", "gamma_1_s3", None, "1/s^3", 0.0, 1000.0, RAMPS),
                "gain of the disturbance estimator; 0 switches it off",
            ),
            Entry(
                *("OC_P_MAX", "controller", "position_error_max_m", None, "m", 0.01, 100.0, RAMPS),
                "the law reacts to no larger position error",
            ),
            Entry(
                *("OC_HDG_KIND", "controller", "heading", None, "", 0, len(_KINDS) - 1, RAMPS),
                "heading: " + ", ".join(f"{number} {word}" for number, word in enumerate(_KINDS)),
                _KINDS,
            ),
            _gain("OC_HDG_L1", "heading_l1_1_s", "1/s", "gain l1 of the heading error"),
            _gain("OC_HDG_L2", "heading_l2_1_s", "1/s", "gain l2 of the heading rate"),
            _gain("OC_HDG_DAMP", "heading_damping_1_s", "1/s", "damping of the yaw rate without a heading"),
            Entry(
                *("OC_HDG_SPD_MIN", "controller", "heading_speed_min_m_s", None, "m/s", 0.01, 20.0, RAMPS),
                "slower than this the last heading is held",
            ),
            _limit("OC_HDG_RATE_MAX", "heading_rate_max_rad_s", "rad/s", (0.05, 20.0), RAMPS, "fastest wanted turn"),
            _limit("OC_DIST_MAX", "disturbance_max_m_s2", "m/s^2", (0.01, 50.0), RAMPS, "largest disturbance estimate"),
            _limit("OC_THR_MIN", "thrust_min_n", "N", (0.01, 10000.0), NEXT, "least collective thrust"),
            _limit("OC_THR_MAX", "thrust_max_n", "N", (0.01, 10000.0), NEXT, "largest collective thrust"),
            _rate("roll", 0),
            _rate("pitch", 1),
            _rate("yaw", 2),
            _limit("OC_TILT_MAX", "tilt_max_rad", "rad", (0.05, 1.57), NEXT, "largest tilt"),
            _limit("OC_SPEED_MAX", "speed_max_m_s", "m/s", (0.1, 100.0), NEXT, "largest speed of a reference"),
            _limit(
                *("OC_ACC_MAX", "acceleration_max_m_s2", "m/s^2", (0.1, 100.0), NEXT),
                "largest acceleration of a reference",
            ),
            _limit(
                *("OC_ERR_ABORT", "position_error_abort_m", "m", (0.1, 1000.0), NEXT),
                "a larger position error ends the flight",
            ),
        )
    )
)
"""All of them, in the order of their names and of their indices."""

_BY_NAME: Final = {entry.name: entry for entry in ENTRIES}


def find(name: str) -> Entry | None:
    """The entry of that name."""
    return _BY_NAME.get(name)


def pack(value: Number) -> bytes:
    """A value in the four bytes of its own type, as PARAM_VALUE carries it."""
    return struct.pack("<i" if isinstance(value, int) else "<f", value)


def unpack(kind: int, raw: bytes) -> Number:
    """The value in four bytes: an int of an INT32; of a REAL32 the shortest decimal number that it stands for."""
    if kind == INT32:
        return int(struct.unpack("<i", raw)[0])
    value: float = struct.unpack("<f", raw)[0]
    if not math.isfinite(value):
        return value
    for digits in range(6, 9):
        short = float(f"{value:.{digits}g}")
        if _fits(short) and struct.pack("<f", short) == raw:
            return short
    return float(f"{value:.9g}")


def _fits(value: float) -> bool:
    try:
        struct.pack("<f", value)
    except OverflowError:  # rounded up beyond the largest float
        return False
    return True


@dataclass(frozen=True)
class Tuning:
    """A vehicle file and what was changed of it."""

    base: Vehicle
    """The vehicle file."""
    changes: Mapping[str, Number] = field(default_factory=dict)
    """Values by parameter name; only those that differ from the vehicle file."""

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle with the changes.

        Raises:
            InputError: together they are no valid vehicle.
        """
        return validate(Vehicle, merged(self.base.model_dump(), self.overrides), "changed parameters")

    @property
    def overrides(self) -> dict[str, Any]:
        """The changes as the tables [controller] and [limits] of a flight file."""
        return self._tables(self.changes)

    @property
    def change(self) -> ParameterChange:
        """All parameters, changed or not, as the control process takes them."""
        whole = self._tables({entry.name: self.value(entry) for entry in ENTRIES})
        return ParameterChange(whole["controller"], whole["limits"])

    def value(self, entry: Entry) -> Number:
        """The value of a parameter."""
        changed = self.changes.get(entry.name)
        return self._base_value(entry) if changed is None else changed

    def wire(self, entry: Entry) -> bytes:
        """The same in four bytes."""
        return pack(self.value(entry))

    def changed(self, entry: Entry, value: Number) -> Tuning:
        """With another value of one parameter.

        Raises:
            InputError: the value is out of its bounds.
        """
        if not entry.low <= value <= entry.high:  # NaN is not either
            unit = f" {entry.unit}" if entry.unit else ""
            raise InputError(f"{entry.name} = {value:g} must be between {entry.low:g} and {entry.high:g}{unit}")
        changes = {**self.changes, entry.name: value}
        if pack(value) == pack(self._base_value(entry)):
            del changes[entry.name]
        return Tuning(self.base, changes)

    def _base_value(self, entry: Entry) -> Number:
        value = getattr(getattr(self.base, entry.section), entry.key)
        if entry.words:
            return entry.words.index(value)
        return float(value if entry.element is None else value[entry.element])

    def _tables(self, values: Mapping[str, Number]) -> dict[str, Any]:
        tables: dict[str, Any] = {"controller": {}, "limits": {}}
        for name, value in values.items():
            entry = _BY_NAME[name]
            table = tables[entry.section]
            if entry.element is None:
                table[entry.key] = entry.words[int(value)] if entry.words else value
            else:
                whole = table.get(entry.key) or getattr(getattr(self.base, entry.section), entry.key)
                table[entry.key] = (*whole[: entry.element], value, *whole[entry.element + 1 :])
        return tables
