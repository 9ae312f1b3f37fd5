"""What can go wrong with the simulated vehicle: the kinds of faults, their keys, and which cannot be at the same time.

A `Fault` is checked when it is made, by whatever way it comes: from a file (`fault_file`), from Python, or as a live
order (`fault_shell`). `KINDS` is the one list; docs/faults.md explains it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from .fault_keys import (
    FaultError,
    Key,
    choice,
    number,
    read_command,
    read_key,
    read_messages,
    read_mode,
    read_name,
    vector,
    whole,
)
from .modes import available_modes

DIRECTIONS = ("to_vehicle", "from_vehicle", "both")
LINKS = ("companion", "ground", "both")
BAD_NUMBERS = ("nan", "zero_quaternion", "stamp_back")
REFUSALS = ("TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED")
"""MAV_RESULTs that refuse."""
_FOREVER = math.inf
_FLOAT_MAX = 3.0e38


class Kind(NamedTuple):
    """One kind of fault."""

    name: str
    keys: tuple[Key, ...] = ()
    collides: Callable[[Mapping[str, Any], Mapping[str, Any]], bool] = lambda a, b: True
    """Whether two of its group, with these values, cannot be at the same time."""
    group: str = ""
    """Kinds of one group can collide with one another; empty: only with its own kind."""
    lasts: bool = True
    """Whether it has an end; else it happens at its start."""


@dataclass(frozen=True)
class Fault:
    """One fault, checked.

    Raises:
        FaultError: there is no such kind, a value is missing or not allowed, or the times are none.
    """

    kind: str
    start_s: float = 0.0
    """Vehicle time since its start [s]."""
    end_s: float = _FOREVER
    """First moment without it [s]; infinite: it stays."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """The kind's own keys; those with a default may be left out, and are filled in."""

    def __post_init__(self) -> None:
        kind = KINDS.get(self.kind)
        if kind is None:
            raise FaultError("kind", f" = {self.kind!r}: unknown; allowed are {', '.join(KINDS)}")
        object.__setattr__(self, "start_s", read_key(_START, self.start_s))
        if not kind.lasts and self.end_s != _FOREVER:
            raise FaultError("end_s", f"not allowed: {self.kind} happens at start_s")
        if self.end_s != _FOREVER:
            object.__setattr__(self, "end_s", read_key(_END, self.end_s))
            if self.end_s <= self.start_s:
                raise FaultError("end_s", f" = {self.end_s:g}: must be after start_s = {self.start_s:g}")
        object.__setattr__(self, "values", _values(kind, self.values))

    def __getitem__(self, key: str) -> Any:
        return self.values[key]

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        told = [f"{k.name} = {_shown(self.values[k.name])}" for k in kind.keys if self.values[k.name] != k.default]
        return " ".join((self.kind, ", ".join(told))).rstrip()

    @property
    def until(self) -> str:
        """The end for people; empty where there is none."""
        if not KINDS[self.kind].lasts:
            return ""
        return "for good" if self.end_s == _FOREVER else f"until {self.end_s:g} s"

    @property
    def span(self) -> str:
        """When it acts, for people."""
        return f"from {self.start_s:g} s {self.until}".rstrip()


def fault(kind: str, start_s: float = 0.0, end_s: float = _FOREVER, **values: Any) -> Fault:
    """Make a fault: `fault("rotor", 3.0, 5.0, rotor=1, share=0.7)`. Raises FaultError."""
    return Fault(kind, start_s, end_s, values)


def from_table(table: Any) -> Fault:
    """Make a fault of a table of a file or of an order: kind, start_s, end_s and the kind's own keys.

    Raises:
        FaultError: it cannot be one.
    """
    if not isinstance(table, Mapping):
        raise FaultError("", f" = {table!r}: must be a table with kind, start_s, end_s and the kind's keys")
    values = dict(table)
    if "kind" not in values:
        raise FaultError("kind", f"missing; allowed are {', '.join(KINDS)}")
    kind = values.pop("kind")
    if not isinstance(kind, str):
        raise FaultError("kind", f" = {kind!r}: must be one of {', '.join(KINDS)}")
    if "end_s" in values:
        read_key(_END, values["end_s"])
    return Fault(kind, values.pop("start_s", 0.0), values.pop("end_s", _FOREVER), values)


def over_s(item: Fault) -> float:
    """Give when a fault is over [s]: one that happens at its start then, a reboot at the end of the boot."""
    if KINDS[item.kind].lasts:
        return item.end_s
    return item.start_s + float(item.values.get("boot_s", 0.0))


def collide(a: Fault, b: Fault) -> bool:
    """Tell whether two faults cannot be: at the same time, and of a kind that bears only one."""
    first, second = KINDS[a.kind], KINDS[b.kind]
    if (first.group or first.name) != (second.group or second.name):
        return False
    at_once = a.start_s == b.start_s or (over_s(a) > b.start_s and over_s(b) > a.start_s)
    if not at_once:
        return False
    return a.kind != b.kind or first.collides(a.values, b.values)


def check_together(
    faults: Sequence[Fault], name: Callable[[int], str] = lambda i: f"fault[{i}]", *, first: int = 0
) -> None:
    """Raise FaultError when two of the faults collide.

    `name` gives what to call the one of an index; those before `first` are known not to collide with one another.
    """
    for i, late in enumerate(faults[first:], first):
        for j, early in enumerate(faults[:i]):
            if collide(early, late):
                raise FaultError(
                    name(i), f"{late} {late.span} overlaps {name(j)}, {early} {early.span}; only one can be"
                )


# Values


def _values(kind: Kind, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check a kind's values and fill in defaults. Raises FaultError."""
    known = [k.name for k in kind.keys]
    for name in given:
        if name not in known:
            allowed = ", ".join(("kind", "start_s", *(("end_s",) if kind.lasts else ()), *known))
            raise FaultError(name, f"unknown; allowed for {kind.name} are {allowed}")
    values = {}
    for key in kind.keys:
        if key.name in given:
            values[key.name] = read_key(key, given[key.name])
        elif key.default is ...:
            raise FaultError(key.name, f"missing; must be {key.allowed}")
        else:
            values[key.name] = key.default
    return values


# Colliding


def _same(*keys: str) -> Callable[[Mapping[str, Any], Mapping[str, Any]], bool]:
    """Two collide when these values are the same."""
    return lambda a, b: all(a[key] == b[key] for key in keys)


def _never(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    return False


def _same_datagrams(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Two collide when a datagram could meet both."""
    for key in ("link", "direction"):
        if key in a and a[key] != b[key] and "both" not in (a[key], b[key]):
            return False
    first, second = a.get("messages", ()), b.get("messages", ())
    return not first or not second or bool(set(first) & set(second))


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(x) for x in value) + "]"
    return str(value)


_TIME_MAX_S = 1.0e6
_HOLD_MAX_S = 60.0
_START = number("start_s", 0.0, _TIME_MAX_S)
_END = number("end_s", 0.0, _TIME_MAX_S)
_LINK = choice("link", LINKS, "companion")
_MESSAGES = Key("messages", "an array of names of MAVLink messages such as ODOMETRY", read_messages, ())
_DATAGRAMS = (choice("direction", DIRECTIONS, "both"), _LINK, _MESSAGES)
_SHARE = number("share", 0.0, 1.0)
_ZERO = (0.0, 0.0, 0.0)
_NED = "north, east, down"


def _datagrams(name: str, *keys: Key) -> Kind:
    return Kind(name, (*keys, *_DATAGRAMS), _same_datagrams)


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        _datagrams("loss", _SHARE),
        _datagrams(
            "burst_loss",
            number("good_s", 0.0, _TIME_MAX_S, above=True),
            number("bad_s", 0.0, _TIME_MAX_S, above=True),
            number("bad_max_s", 0.0, _TIME_MAX_S, None, above=True),
            number("loss_good", 0.0, 1.0, 0.0),
            number("loss_bad", 0.0, 1.0, 1.0),
        ),
        _datagrams("delay", number("delay_s", 0.0, _HOLD_MAX_S, above=True)),
        _datagrams("jitter", number("jitter_s", 0.0, _HOLD_MAX_S, above=True)),
        _datagrams("duplicate", _SHARE, number("late_s", 0.0, _HOLD_MAX_S, 0.0)),
        _datagrams("reorder", _SHARE, number("late_s", 0.0, _HOLD_MAX_S, above=True)),
        _datagrams("corrupt", _SHARE, whole("bits", 1, 64, 8)),
        Kind("silence", (choice("direction", DIRECTIONS, "from_vehicle"), _LINK, _MESSAGES), _same_datagrams),
        Kind("timesync", (number("offset_s", -_TIME_MAX_S, _TIME_MAX_S), _LINK), _same_datagrams),
        Kind("rotor", (whole("rotor", 1, 4), number("share", 0.0, 1.0, 0.0)), _same("rotor")),
        Kind("thrust_scale", (number("factor", 0.0, 4.0, above=True),)),
        Kind("wind", (vector("wind_m_s", _NED, 100.0),), _never),
        Kind("force", (vector("force_n", _NED, 1.0e5),), _never),
        Kind(
            "estimator_reset",
            (
                vector("jump_m", _NED, 1.0e5, _ZERO),
                vector("jump_m_s", _NED, 1.0e3, _ZERO),
                number("yaw_deg", -180.0, 180.0, 0.0),
            ),
            lasts=False,
        ),
        Kind("estimator_outage", group="estimate"),
        Kind("estimator_freeze", group="estimate"),
        Kind("estimator_bad_numbers", (choice("what", BAD_NUMBERS),), group="estimate"),
        Kind("estimator_noise", (number("factor", 0.0, 1.0e4),)),
        Kind("estimator_delay", (number("delay_s", 0.0, 10.0),)),
        Kind("estimator_rate", (number("rate_hz", 0.1, 1.0e4),)),
        Kind("estimator_drift", (vector("drift_m_s", _NED, 1.0e3, _ZERO), number("yaw_deg_s", -360.0, 360.0, 0.0))),
        Kind(
            "pilot_mode",
            (
                Key("mode", f"one of {', '.join(mode.label for mode in available_modes())}", read_mode),
                vector("sticks", "roll, pitch, yaw, throttle", 1.0, (0.0,) * 4, 4),
            ),
        ),
        Kind("reboot", (number("boot_s", 0.1, _HOLD_MAX_S, 3.0),), lasts=False),
        Kind(
            "refuse",
            (
                Key("command", "the name or number of a MAV_CMD such as DO_SET_MODE", read_command),
                choice("result", REFUSALS, "TEMPORARILY_REJECTED"),
            ),
            _same("command"),
        ),
        Kind(
            "parameter",
            (
                Key("name", "the name of an autopilot parameter", read_name),
                number("value", -_FLOAT_MAX, _FLOAT_MAX),
            ),
            _same("name"),
        ),
    )
}
"""Every kind by its name; docs/faults.md says what each does."""
