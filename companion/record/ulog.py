"""PX4's log format ULog: the bytes of its messages, for a writer that only ever appends.

A file is a header, definitions (formats, information, parameters) and then data, all as messages of size, type and
content, little endian. Nothing is ever patched in place, so that a file that ends anywhere can be read up to there.
Layouts are those of PX4's "ULog File Format".
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Final, NamedTuple

ULOG_FILE: Final = "flight.ulg"
"""Name of the log in a flight's folder."""

Number = int | float

_MAGIC: Final = b"ULog\x01\x12\x35\x01"  # the last byte is the version of the format
_SYNC: Final = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_FLAG_BITS: Final = bytes(40)  # no flags, no appended data
_HEAD = struct.Struct("<HB")
_DATA_HEAD: Final = 5  # size, type, number of the subscription
_LOGGED = struct.Struct("<BQ")
_CODES: Final = {
    **{"bool": "?", "double": "d", "float": "f", "int8_t": "b", "int16_t": "h", "int32_t": "i", "int64_t": "q"},
    **{"uint8_t": "B", "uint16_t": "H", "uint32_t": "I", "uint64_t": "Q"},
}
_ARRAY = re.compile(r"(\w+)\[(\d+)\]")
_NOT_A_KEY = re.compile(r"[^A-Za-z0-9_\-/]")
_CHUNK: Final = 2000  # bytes of a long text in one message
_TEXT_MAX: Final = 4000
_FLOAT_MAX: Final = 3.4028234663852886e38
_INT32: Final = (-(1 << 31), (1 << 31) - 1)


class Level:
    """Severity of a logged text, as in the Linux kernel."""

    ERROR: Final = 3
    WARNING: Final = 4
    NOTICE: Final = 5
    INFO: Final = 6


class Field(NamedTuple):
    """A field of a topic."""

    name: str
    type: str
    """A basic type of ULog, or an array of one: "float[3]"."""
    unit: str
    meaning: str
    columns: tuple[str, ...] = ()
    """What it is filled from, one name per number; empty where it is not filled by name."""

    @property
    def basic_type(self) -> str:
        """The type of one number."""
        array = _ARRAY.fullmatch(self.type)
        return array[1] if array else self.type

    @property
    def size(self) -> int:
        """How many numbers it holds."""
        array = _ARRAY.fullmatch(self.type)
        return int(array[2]) if array else 1


class Topic(NamedTuple):
    """A series of records with the same fields, after the `timestamp` [us] that every topic begins with."""

    name: str
    meaning: str
    fields: tuple[Field, ...]

    @property
    def definition(self) -> str:
        """The content of its format message."""
        fields = "".join(f"{field.type} {field.name};" for field in self.fields)
        return f"{self.name}:uint64_t timestamp;{fields}"

    @property
    def codes(self) -> str:
        """The `struct` code of every number after the timestamp."""
        return "".join(_CODES[field.basic_type] * field.size for field in self.fields)


def _message(kind: str, content: bytes) -> bytes:
    return _HEAD.pack(len(content), ord(kind)) + content


def header(start_us: int) -> bytes:
    """The beginning of a file: magic, vehicle time at which the logging started [us], and the flag bits."""
    return _MAGIC + struct.pack("<Q", start_us) + _message("B", _FLAG_BITS)


def format_definition(topic: Topic) -> bytes:
    """F: the fields of a topic."""
    return _message("F", topic.definition.encode())


def subscription(topic: Topic, number: int) -> bytes:
    """A: the topic's data has this number."""
    return _message("A", struct.pack("<BH", 0, number) + topic.name.encode())


def _keyed(kind: str, basic_type: str, key: str, value: bytes, prefix: bytes = b"") -> bytes:
    name = f"{basic_type} {_NOT_A_KEY.sub('_', key)}".encode()
    return _message(kind, prefix + bytes((len(name),)) + name + value)


def info(key: str, value: str | int, basic_type: str = "uint64_t") -> bytes:
    """I: a fact about the log; a text, or an integer of the basic type."""
    if isinstance(value, str):
        text = _clipped(value, _TEXT_MAX)
        return _keyed("I", f"char[{len(text)}]", key, text)
    return _keyed("I", basic_type, key, struct.pack("<" + _CODES[basic_type], value))


def long_info(key: str, text: str) -> bytes:
    """M: a text of any length in one message after the other."""
    parts = []
    for index, part in enumerate(_chunks(text.encode("utf-8", "replace"))):
        parts.append(_keyed("M", f"char[{len(part)}]", key, part, prefix=bytes((index > 0,))))
    return b"".join(parts)


def _chunks(content: bytes) -> Iterator[bytes]:
    """Pieces that end between characters: readers decode each by itself."""
    while len(content) > _CHUNK:
        at = _CHUNK
        while content[at] & 0xC0 == 0x80:
            at -= 1
        yield content[:at]
        content = content[at:]
    yield content


def _clipped(text: str, most: int) -> bytes:
    content = text.encode("utf-8", "replace")
    return content if len(content) <= most else content[:most].decode("utf-8", "ignore").encode()


def parameter(key: str, value: Number) -> bytes:
    """P: a number of the configuration, as int32 where it is a whole one by type and fits, else as float."""
    if isinstance(value, int) and _INT32[0] <= value <= _INT32[1]:
        return _keyed("P", "int32_t", key, struct.pack("<i", value))
    return _keyed("P", "float", key, struct.pack("<f", _fitting("f", value)))


def logged(level: int, t_us: int, text: str) -> bytes:
    """L: a text with its severity (0 emergency to 7 debug, see `Level`) and vehicle time [us]."""
    return _message("L", _LOGGED.pack(ord("0") + min(max(level, 0), 7), t_us) + _clipped(text, _TEXT_MAX))


def sync() -> bytes:
    """S: a mark that a reader finds its place by after broken bytes."""
    return _message("S", _SYNC)


def dropout(duration_ms: float) -> bytes:
    """O: data is missing here for this long."""
    return _message("O", struct.pack("<H", min(max(round(duration_ms), 0), 0xFFFF)))


class Series:
    """Makes the data messages (D) of one topic; their times never step back."""

    def __init__(self, topic: Topic, number: int) -> None:
        self.topic = topic
        self._codes = topic.codes
        layout = struct.Struct(f"<{_DATA_HEAD}sQ{topic.codes}")
        self._pack = layout.pack
        self.head = struct.pack("<HBH", layout.size - _HEAD.size, ord("D"), number)
        """What a record's message begins with, before the time."""
        self._last_us = 0

    @cached_property
    def size(self) -> int:
        """Bytes of a record on the disk, with everything around it."""
        return _DATA_HEAD + struct.calcsize(f"<Q{self._codes}")

    def encode(self, t_us: int, values: Sequence[Number]) -> bytes:
        """One record.

        Args:
            t_us: vehicle time [us]; where it is before the last record's, that one's is taken.
            values: as many numbers as the fields hold. What a type cannot hold becomes what is nearest to it; NaN in
                an integer becomes 0.
        """
        t_us = max(t_us, self._last_us)
        try:
            content = self._pack(self.head, t_us, *values)
        except (struct.error, OverflowError):
            fitting = [_fitting(code, value) for code, value in zip(self._codes, values, strict=True)]
            content = self._pack(self.head, t_us, *fitting)
        self._last_us = t_us
        return content

    def into(self, out: list[bytes]) -> Callable[[int, Sequence[Number]], None]:
        """What puts a record behind the others in a list: `encode` in one call, where nothing needs care."""
        pack, head, append = self._pack, self.head, out.append

        def write(t_us: int, values: Sequence[Number]) -> None:
            if t_us < self._last_us:
                append(self.encode(t_us, values))
                return
            try:
                append(pack(head, t_us, *values))
                self._last_us = t_us
            except (struct.error, OverflowError):
                append(self.encode(t_us, values))

        return write


def _fitting(code: str, value: Number) -> Number:
    """The number, or the nearest one that the type holds."""
    if code == "d":
        return value
    if code == "f":  # single precision rounds a little beyond its largest number back to it
        return value if not abs(value) > _FLOAT_MAX else (math.inf if value > 0 else -math.inf)
    if code == "?":
        return bool(value)
    if math.isnan(value):
        return 0
    bits = 8 * struct.calcsize(f"<{code}")
    low, high = (0, (1 << bits) - 1) if code.isupper() else (-(1 << (bits - 1)), (1 << (bits - 1)) - 1)
    return int(min(max(value, low), high))
