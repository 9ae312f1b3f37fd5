"""The parameter protocol as bytes: PARAM_REQUEST_READ, PARAM_REQUEST_LIST and PARAM_SET in, PARAM_VALUE and PARAM_ERROR
out. Values travel bytewise in the place of a float, as with PX4."""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from companion.link.codec import PARAM_ERROR_LAYOUT, PARAM_REQUEST_READ_LAYOUT, PARAM_VALUE_LAYOUT, filled

PARAM_REQUEST_LIST: Final = 21
PARAM_SET: Final = 23

NO_INDEX: Final = 0xFFFF
"""PARAM_VALUE.param_index of what is not in the list."""

_LIST = struct.Struct("<BB")
_SET = struct.Struct("<4sBB16sB")


class ParameterError(IntEnum):
    """MAV_PARAM_ERROR."""

    DOES_NOT_EXIST = 1
    VALUE_OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    READ_ONLY = 5
    TYPE_MISMATCH = 7


class ReadRequest(NamedTuple):
    """PARAM_REQUEST_READ."""

    system: int
    component: int
    id: bytes
    """The name as it came, 16 bytes."""
    number: int
    """The index in our list; below 0: by name."""


class SetRequest(NamedTuple):
    """PARAM_SET."""

    system: int
    component: int
    id: bytes
    type: int
    """MAV_PARAM_TYPE."""
    raw: bytes
    """The value's four bytes."""


def name_of(id_: bytes) -> str:
    """The name in a parameter id; "" when it is none that a parameter could have."""
    try:
        return id_.split(b"\0", 1)[0].decode("ascii")
    except UnicodeDecodeError:
        return ""


def decode_read(payload: bytes) -> ReadRequest:
    """PARAM_REQUEST_READ."""
    layout = PARAM_REQUEST_READ_LAYOUT
    index, system, component, id_ = layout.unpack_from(filled(payload, layout.size))
    return ReadRequest(system, component, id_, index)


def decode_list(payload: bytes) -> tuple[int, int]:
    """Whom PARAM_REQUEST_LIST is for: system and component."""
    system, component = _LIST.unpack_from(filled(payload, _LIST.size))
    return system, component


def decode_set(payload: bytes) -> SetRequest:
    """PARAM_SET."""
    raw, system, component, id_, kind = _SET.unpack_from(filled(payload, _SET.size))
    return SetRequest(system, component, id_, kind, raw)


def encode_value(name: str, raw: bytes, kind: int, index: int, count: int) -> bytes:
    """PARAM_VALUE."""
    return PARAM_VALUE_LAYOUT.pack(raw, count, index, name.encode("ascii"), kind)


def encode_error(asker: tuple[int, int], id_: bytes, index: int, error: ParameterError) -> bytes:
    """PARAM_ERROR for a request from (system, component), with the id or index that it had."""
    return PARAM_ERROR_LAYOUT.pack(index, *asker, id_, error)
