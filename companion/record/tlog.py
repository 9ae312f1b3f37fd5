"""MAVLink telemetry logs (`.tlog`): big-endian microseconds since the epoch in eight bytes and one raw frame, repeated.

The format of QGroundControl, MAVProxy and pymavlink. The lowest two bits of a stamp name the link, as MAVProxy writes
and pymavlink reads them: 0 for what came in, 3 for what went out.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

TLOG_FILE: Final = "link.tlog"
"""Name of the traffic log in a flight's folder."""

_STAMP = struct.Struct(">Q")
_MAGIC_V1: Final = 0xFE
_MAGIC_V2: Final = 0xFD
_OVERHEAD_V1: Final = 8  # magic, length, sequence, system, component, message id, 2 checksum
_OVERHEAD_V2: Final = 12  # the same with two flag bytes and a message id of three
_SIGNED: Final = 0x01  # incompatibility flag of MAVLink 2
_SIGNATURE: Final = 13
_HEADER: Final = 3  # magic, length and incompatibility flags say how long a frame is
_LINK_BITS: Final = 3


class Direction(IntEnum):
    """Which way a datagram went; the value is what a stamp's lowest two bits say."""

    IN = 0
    OUT = 3


class LoggedFrame(NamedTuple):
    """One entry of a log."""

    epoch_us: int
    """When, in microseconds since the epoch, to 4 us."""
    direction: Direction
    """Towards us or away from us."""
    raw: bytes
    """The frame as it was on the link, signature included."""


def frame_length(header: bytes) -> int:
    """Length [bytes] of the frame that begins like this, or 0 when no frame does. Needs the first three bytes of it."""
    if len(header) < _HEADER:
        return 0
    if header[0] == _MAGIC_V2:
        return _OVERHEAD_V2 + header[1] + (_SIGNATURE if header[2] & _SIGNED else 0)
    if header[0] == _MAGIC_V1:
        return _OVERHEAD_V1 + header[1]
    return 0


def split_frames(datagram: bytes) -> list[bytes]:
    """The whole frames in a datagram, by their lengths; the rest is left out, or readers would lose their place."""
    end = len(datagram)
    if end > _HEADER and datagram[0] == _MAGIC_V2 and datagram[1] == end - _OVERHEAD_V2 and not datagram[2] & _SIGNED:
        return [datagram]  # as most are
    frames = []
    at = 0
    while at + _OVERHEAD_V1 <= end:
        if datagram[at] == _MAGIC_V2 and not datagram[at + 2] & _SIGNED:  # as `frame_length`, at half its price
            length = _OVERHEAD_V2 + datagram[at + 1]
        else:
            length = frame_length(datagram[at : at + _HEADER])
        if length and at + length <= end:
            frames.append(datagram[at : at + length])
            at += length
        else:
            at += 1
    return frames


def encode_datagrams(datagrams: Iterable[tuple[int, int, Sequence[bytes]]], epoch_minus_wall_ns: int) -> bytes:
    """The entries of datagrams' frames: those of one all with the same stamp, nothing for one without a frame.

    Args:
        datagrams: of each when it came or went [ns], a `Direction`, and its frames, see `split_frames`.
        epoch_minus_wall_ns: turns these times into nanoseconds since the epoch. In microseconds, the lowest two bits
            give way to the direction.
    """
    parts: list[bytes] = []
    for wall_ns, direction, frames in datagrams:
        stamp = _STAMP.pack(((wall_ns + epoch_minus_wall_ns) // 1000 & ~_LINK_BITS) | direction)
        for frame in frames:
            parts += (stamp, frame)
    return b"".join(parts)


def read_tlog(path: Path) -> Iterator[LoggedFrame]:
    """The entries of a log in their order, up to the end or to an entry that is cut off or broken."""
    with path.open("rb") as file:
        while len(start := file.read(_STAMP.size + _HEADER)) == _STAMP.size + _HEADER:
            header = start[_STAMP.size :]
            length = frame_length(header)
            rest = file.read(length - _HEADER) if length else b""
            if not length or len(rest) != length - _HEADER:
                return
            (stamp,) = _STAMP.unpack(start[: _STAMP.size])
            direction = Direction.OUT if stamp & _LINK_BITS == Direction.OUT else Direction.IN
            yield LoggedFrame(stamp & ~_LINK_BITS, direction, header + rest)
