"""The parameters of the simulated autopilot: PX4's names, types and defaults (`parameter_set`).

Values are kept as the 32-bit types that MAVLink carries, so that what is read back is what was set.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

from .parameter_set import DEFAULTS, NOT_IN_1_13, ONLY_IN_1_13, READ_ONLY

INT32 = 6
"""MAV_PARAM_TYPE_INT32"""
REAL32 = 9
"""MAV_PARAM_TYPE_REAL32"""
UINT32 = 5
"""MAV_PARAM_TYPE_UINT32, of _HASH_CHECK only"""

HASH_CHECK = "_HASH_CHECK"


class ParameterError(ValueError):
    """A parameter that cannot be set; `code` is the MAV_PARAM_ERROR that says why."""

    DOES_NOT_EXIST = 1
    OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    READ_ONLY = 5
    TYPE_MISMATCH = 7

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class Parameters:
    """Named 32-bit values in the order of their names, as PX4 lists them."""

    def __init__(self, px4: str = "1.18", overrides: Mapping[str, int | float] | None = None) -> None:
        self.px4 = px4
        """The version whose set this is."""
        values = dict(DEFAULTS)
        if px4 == "1.13":
            for name in NOT_IN_1_13:
                del values[name]
            values |= ONLY_IN_1_13
        self._values = {name: _as_32_bit(values[name]) for name in sorted(values)}
        self._names = list(self._values)
        self._index = {name: index for index, name in enumerate(self._names)}
        self.version = 0
        """Counts the changes, so that users of a value can cache it."""
        for name, value in (overrides or {}).items():
            self.set(name, value)
        self._at_start = dict(self._values)

    def __len__(self) -> int:
        return len(self._names)

    @property
    def names(self) -> list[str]:
        """All names, in the order of their indices."""
        return list(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __getitem__(self, name: str) -> int | float:
        return self._values[name]

    def number(self, name: str) -> float:
        """Give a value as a float."""
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Give a value as an int."""
        return int(self._values[name])

    def name_at(self, index: int) -> str | None:
        """Give the name at a MAVLink parameter index; None beyond the end."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def within(self, name: str, low: float, high: float) -> float:
        """Give a value as a float, limited as the module that uses it limits it; NaN becomes the lower limit."""
        value = self.number(name)
        return min(value, high) if value >= low else low

    def index_of(self, name: str) -> int:
        """Give the MAVLink parameter index of a name."""
        return self._index[name]

    def type_of(self, name: str) -> int:
        """Give INT32 or REAL32."""
        return INT32 if isinstance(self._values[name], int) else REAL32

    def set(self, name: str, value: int | float) -> None:
        """Set a value and keep its type. PX4 checks no range, and neither is one checked here.

        Raises:
            ParameterError: there is no such parameter, or a whole number was expected.
        """
        if name not in self._values:
            raise ParameterError(ParameterError.DOES_NOT_EXIST, f"there is no parameter {name}")
        if isinstance(self._values[name], int):
            if not float(value).is_integer() or not -(2**31) <= value < 2**31:
                raise ParameterError(ParameterError.TYPE_MISMATCH, f"{name} takes a whole number, not {value}")
            self._values[name] = int(value)
        else:
            self._values[name] = _as_32_bit(float(value))
        self.version += 1

    def reset(self) -> None:
        """Bring back the values of the start, but for what is the vehicle file's (PREFLIGHT_STORAGE)."""
        for name, value in self._at_start.items():
            self._values[name] = value
        self.version += 1

    def set_text(self, name: str, text: str) -> None:
        """Set a value written as text (a command line's NAME=VALUE).

        Raises:
            ParameterError: no such parameter, or no number of its type.
        """
        try:
            value: int | float = int(text)
        except ValueError:
            try:
                value = float(text)
            except ValueError:
                raise ParameterError(ParameterError.TYPE_MISMATCH, f"{name} takes a number, not {text!r}") from None
        self.set(name, value)

    def set_wire(self, name: str, kind: int, value: bytes) -> None:
        """Set a value as PARAM_SET carries it: four little-endian bytes, and only with the right type.

        Raises:
            ParameterError: there is no such parameter, its type is another, or it is read-only.
        """
        if name not in self._values:
            raise ParameterError(ParameterError.DOES_NOT_EXIST, f"there is no parameter {name}")
        if kind != self.type_of(name):
            raise ParameterError(
                ParameterError.TYPE_MISMATCH, f"{name} is of MAVLink type {self.type_of(name)}, not {kind}"
            )
        if name in READ_ONLY and value != self.wire(name):
            raise ParameterError(ParameterError.READ_ONLY, f"{name} is fixed by the vehicle file")
        self._values[name] = struct.unpack("<i" if kind == INT32 else "<f", value)[0]
        self.version += 1

    def wire(self, name: str) -> bytes:
        """Give a value as PARAM_VALUE carries it: the four bytes of its own type in the place of a float."""
        value = self._values[name]
        return struct.pack("<i" if isinstance(value, int) else "<f", value)

    def hash_wire(self) -> bytes:
        """Give the pseudo parameter _HASH_CHECK (uint32 over names and values) as PARAM_VALUE carries it."""
        crc = 0
        for name in self._names:
            crc = zlib.crc32(self.wire(name), zlib.crc32(name.encode(), crc))
        return crc.to_bytes(4, "little")


def _as_32_bit(value: int | float) -> int | float:
    """Round a float to what 32 bits hold; overflow becomes infinite as in C."""
    if isinstance(value, int):
        return value
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return float("inf") if value > 0.0 else float("-inf")
