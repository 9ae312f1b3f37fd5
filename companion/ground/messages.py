"""The few messages of the ground side as bytes: commands in, acknowledgements, texts and values out."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final, NamedTuple

from companion.link import codec

COMMAND_INT: Final = 75
DEBUG_VECT: Final = 250
NAMED_VALUE_FLOAT: Final = 251

TEXT_BYTES: Final = 50

_COMMAND_INT = struct.Struct("<4fiifHBBBBB")
_NAMED_VALUE_FLOAT = struct.Struct("<If10s")
_DEBUG_VECT = struct.Struct("<Qfff10s")
_UNKNOWN_PROGRESS = 255


class AckResult(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6


class Severity(IntEnum):
    """MAV_SEVERITY, the ones used here."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class CommandMessage(NamedTuple):
    """COMMAND_LONG or COMMAND_INT."""

    command: int
    """MAV_CMD."""
    params: tuple[float, ...]
    """Seven of them; of COMMAND_INT x and y are integers."""
    target_system: int
    target_component: int
    confirmation: int
    """Above 0: repeated by the sender. COMMAND_INT has none."""


class Targets(NamedTuple):
    """Whom a message is for; 0 is everybody."""

    system: int
    component: int


def decode_command(msgid: int, payload: bytes) -> CommandMessage | None:
    """A command's payload; None for other messages."""
    if msgid == codec.COMMAND_LONG:
        layout = codec.COMMAND_LONG_LAYOUT
        *params, command, system, component, confirmation = layout.unpack_from(codec.filled(payload, layout.size))
        return CommandMessage(command, tuple(params), system, component, confirmation)
    if msgid == COMMAND_INT:
        numbers = _COMMAND_INT.unpack_from(codec.filled(payload, _COMMAND_INT.size))
        return CommandMessage(numbers[7], numbers[:7], numbers[8], numbers[9], 0)
    return None


def encode_ack(
    command: int, result: AckResult, target_system: int, target_component: int, progress: int = _UNKNOWN_PROGRESS
) -> bytes:
    """COMMAND_ACK; the progress [%] counts while the result is IN_PROGRESS."""
    shown = progress if result is AckResult.IN_PROGRESS else 0
    return codec.COMMAND_ACK_LAYOUT.pack(command, result, shown, 0, target_system, target_component)


def encode_texts(severity: int, text: str, identity: int) -> Iterator[bytes]:
    """STATUSTEXT, as many as the text takes. No chunk ends within a character: other readers decode each by itself.

    Args:
        severity: MAV_SEVERITY.
        text: for people.
        identity: 1..65535, another one for every text; a short text goes without.
    """
    chunks = _chunks(text.encode("utf-8", "replace"))
    if len(chunks) == 1:
        yield codec.STATUSTEXT_LAYOUT.pack(severity, chunks[0], 0, 0)
        return
    if len(chunks[-1]) == TEXT_BYTES:
        chunks.append(b"")  # the last one must have a NUL in it
    for number, chunk in enumerate(chunks[:256]):
        yield codec.STATUSTEXT_LAYOUT.pack(severity, chunk, identity, number)


def _chunks(left: bytes) -> list[bytes]:
    """A text in pieces of 50 bytes, the last one of 50 or less, that end with a whole character each.

    A shorter piece would say that the text ends with it. So a character that a border would split is moved behind it by
    more space at the last blank before, and is given up for a "?" where there is no blank.
    """
    chunks = []
    while len(left) > TEXT_BYTES:
        begin, end = TEXT_BYTES, TEXT_BYTES
        while _continues(left[begin]):
            begin -= 1
        while end < len(left) and _continues(left[end]):
            end += 1
        if begin < TEXT_BYTES:
            blank = left.rfind(b" ", 0, begin)
            if blank < 0:
                left = left[:begin] + b"?" + left[end:]
                continue
            left = left[:blank] + b" " * (TEXT_BYTES - begin) + left[blank:]
        chunks.append(left[:TEXT_BYTES])
        left = left[TEXT_BYTES:]
    return [*chunks, left]


def _continues(byte: int) -> bool:
    """Whether a byte of UTF-8 is a further one of its character."""
    return byte & 0xC0 == 0x80


def encode_named_value(time_boot_ms: int, name: str, value: float) -> bytes:
    """NAMED_VALUE_FLOAT; the name has ten characters at most."""
    return _NAMED_VALUE_FLOAT.pack(time_boot_ms & 0xFFFFFFFF, value, name.encode("ascii"))


def encode_debug_vect(time_usec: int, name: str, vector: tuple[float, float, float]) -> bytes:
    """DEBUG_VECT; the name has ten characters at most."""
    return _DEBUG_VECT.pack(time_usec, *vector, name.encode("ascii"))


def decode_named_value(payload: bytes) -> tuple[str, float]:
    """Name and value of NAMED_VALUE_FLOAT."""
    _, value, name = _NAMED_VALUE_FLOAT.unpack_from(codec.filled(payload, _NAMED_VALUE_FLOAT.size))
    return _name(name), value


def decode_debug_vect(payload: bytes) -> tuple[str, tuple[float, float, float]]:
    """Name and vector of DEBUG_VECT."""
    _, x, y, z, name = _DEBUG_VECT.unpack_from(codec.filled(payload, _DEBUG_VECT.size))
    return _name(name), (x, y, z)


def _name(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("ascii", "replace")


def encode_autopilot_version(version: tuple[int, int, int]) -> bytes:
    """AUTOPILOT_VERSION of the companion: what it can do, and its version."""
    library: Any = codec.dialect()
    capabilities = (
        library.MAV_PROTOCOL_CAPABILITY_FTP
        | library.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | library.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | library.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    )
    major, minor, patch = version
    numbers = (capabilities, 0, major << 24 | minor << 16 | patch << 8, 0, 0, 0, 0, 0)
    return struct.pack("<QQIIIIHH", *numbers).ljust(78, b"\0")


# ---- whom a message is for -----------------------------------------------------------------------------------------

_SIZES: Final = {"char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float": 4}


@lru_cache(maxsize=1)
def _target_offsets() -> dict[int, tuple[int | None, int | None]]:
    """Where target_system and target_component stand in the payload, for every message that has one of them."""
    offsets = {}
    for msgid, message in codec.dialect().mavlink_map.items():
        lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=False))
        kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        at, found = 0, {}
        for name in message.ordered_fieldnames:
            found[name] = at
            at += _SIZES.get(kinds[name].removesuffix("_t"), 8) * max(1, lengths.get(name, 1))
        if "target_system" in found or "target_component" in found:
            offsets[int(msgid)] = (found.get("target_system"), found.get("target_component"))
    return offsets


def targets_of(msgid: int, payload: bytes) -> Targets | None:
    """Whom a message is for; None when the message has no target."""
    offsets = _target_offsets().get(msgid)
    if offsets is None:
        return None
    system, component = (0 if at is None or at >= len(payload) else payload[at] for at in offsets)
    return Targets(system, component)
