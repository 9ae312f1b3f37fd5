"""The keys of faults: what each may be, and how it is read. A value that is not allowed is refused with its key."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .codec import mavlink
from .modes import Mode, available_modes


class FaultError(ValueError):
    """A fault that cannot be; one line for people. `key` is where, empty for the fault as a whole."""

    def __init__(self, key: str, sentence: str) -> None:
        separator = "" if not key or sentence.startswith(" =") else ": "
        super().__init__(f"{key}{separator}{sentence}".strip())
        self.key = key
        self.sentence = sentence

    def inside(self, place: str) -> FaultError:
        """Give the same error as seen from outside the fault: `place` is its path."""
        return FaultError(f"{place}.{self.key}" if self.key else place, self.sentence)


class Key(NamedTuple):
    """One key of a kind."""

    name: str
    allowed: str
    """What it may be, for people."""
    read: Callable[[Any], Any]
    """Gives the value as it is used; raises ValueError for what is not allowed."""
    default: Any = ...
    """Without one the key must be there."""


def read_key(key: Key, raw: Any) -> Any:
    """Give the value of a key as it is used. Raises FaultError."""
    try:
        return key.read(raw)
    except (ValueError, OverflowError):
        raise FaultError(key.name, f" = {raw!r}: must be {key.allowed}") from None


def _finite(raw: Any) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float) or not math.isfinite(raw):
        raise ValueError
    return float(raw)


def number(name: str, low: float, high: float, default: Any = ..., *, above: bool = False) -> Key:
    """Make the key of a number within bounds; `above`: the lower one is not allowed itself."""

    def read(raw: Any) -> float:
        value = _finite(raw)
        if not low <= value <= high or (above and value == low):
            raise ValueError
        return value

    allowed = f"a number above {low:g}, at most {high:g}" if above else f"a number from {low:g} to {high:g}"
    return Key(name, allowed, read, default)


def whole(name: str, low: int, high: int, default: Any = ...) -> Key:
    """Make the key of a whole number."""

    def read(raw: Any) -> int:
        if isinstance(raw, bool) or not isinstance(raw, int) or not low <= raw <= high:
            raise ValueError
        return raw

    return Key(name, f"a whole number from {low} to {high}", read, default)


def vector(name: str, what: str, high: float, default: Any = ..., length: int = 3) -> Key:
    """Make the key of an array of numbers, none beyond `high` either way."""

    def read(raw: Any) -> tuple[float, ...]:
        if not isinstance(raw, list | tuple) or len(raw) != length:
            raise ValueError
        values = tuple(_finite(x) for x in raw)
        if any(abs(x) > high for x in values):
            raise ValueError
        return values

    return Key(name, f"an array of {length} numbers from -{high:g} to {high:g}: {what}", read, default)


def choice(name: str, allowed: tuple[str, ...], default: Any = ...) -> Key:
    """Make the key of a word."""

    def read(raw: Any) -> str:
        if not isinstance(raw, str) or raw not in allowed:
            raise ValueError
        return raw

    return Key(name, f"one of {', '.join(allowed)}", read, default)


def _named(names: Mapping[str, int], prefix: str, raw: Any) -> int:
    """Give the number of an enum's entry from its name, with or without prefix, or from the number itself."""
    if isinstance(raw, str):
        found = names.get(raw.upper().removeprefix(prefix))
    else:
        found = raw if isinstance(raw, int) and not isinstance(raw, bool) else None
    if found is None:
        raise ValueError
    return found


_MESSAGES: dict[str, int] = {cls.msgname: msg_id for msg_id, cls in mavlink.mavlink_map.items()}
_COMMANDS = {entry.name.removeprefix("MAV_CMD_"): value for value, entry in mavlink.enums["MAV_CMD"].items()}


def read_command(raw: Any) -> int:
    """Read a MAV_CMD: its name, with or without MAV_CMD_, or its number. Raises ValueError."""
    command = _named(_COMMANDS, "MAV_CMD_", raw)
    if not 0 <= command <= 0xFFFF:
        raise ValueError
    return command


def message_ids(names: tuple[str, ...]) -> frozenset[int]:
    """Give the numbers of messages."""
    return frozenset(_MESSAGES[name] for name in names)


def read_messages(raw: Any) -> tuple[str, ...]:
    """Read names of messages, one at least. Raises ValueError."""
    if not isinstance(raw, list | tuple) or not raw or not all(isinstance(x, str) and x in _MESSAGES for x in raw):
        raise ValueError
    return tuple(dict.fromkeys(raw))


def read_mode(raw: Any) -> str:
    """Read a flight mode: the name that a pilot knows it by, in any case. Gives that name. Raises ValueError."""
    for mode in available_modes():
        if isinstance(raw, str) and raw.upper() in (mode.name, mode.label.upper()):
            return mode.label
    raise ValueError


def mode_called(label: str) -> Mode:
    """Give the mode of a label."""
    return next(mode for mode in Mode if mode.label == label)


def read_name(raw: Any) -> str:
    """Read what can be a parameter's name. Raises ValueError."""
    if not isinstance(raw, str) or not 0 < len(raw) <= 16:
        raise ValueError
    return raw
