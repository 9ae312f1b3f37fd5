"""The messages of every control cycle, read and written in place: bytes in, numbers out, and back.

`framing` and `codec` take every message apart for everybody; what stands here takes the few that come with every state
as kernels do, so that compiled code can answer a state without any detour (`flight.reflex`). It knows MAVLink 2 without
signatures only, and says "no" to whatever is not plainly what it expects: the general parser then looks at that.

Bytes are read from anything that gives integers: an array of uint8 for compiled code, a memoryview for plain Python.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from typing import Final

from companion.link.codec import AUTOPILOT_COMPONENT
from companion.link.framing import MAGIC_V2

AT: Final = 6
"""Where a frame begins in its buffer: the payload of a frame there is aligned for numbers of eight bytes."""
PAYLOAD: Final = AT + 10
ODOMETRY_EXTRA, TIMESYNC_EXTRA, SET_ATTITUDE_TARGET_EXTRA = 91, 34, 49
"""The seeds of their checksums."""
_HEADER = 10
_CHECKSUM = 2

# ODOMETRY: where fields stand in the payload
FRAME_ID = 228
CHILD_FRAME_ID = 229
RESET_COUNTER = 230
QUALITY = 232
ODOMETRY_MIN = CHILD_FRAME_ID + 1
"""Payloads are cut behind their last byte that is not 0; no frame of reference is."""
ODOMETRY_FLOATS = (PAYLOAD + 8) // 4
"""Where its 13 floats begin in the buffer, counted in floats: position, quaternion, velocity, rates."""

TIMESYNC_BYTES = 18
SET_ATTITUDE_TARGET_BYTES = 39
TARGET_FLOATS = (PAYLOAD + 4) // 4
"""Where the eight floats of SET_ATTITUDE_TARGET begin: quaternion, rates, thrust."""


def checksum(d: Sequence[int], begin: int, end: int, extra: int) -> int:
    """CRC-16/MCRF4XX of bytes and of the seed of their message behind them; no table, which would be cold."""
    crc = 0xFFFF
    for i in range(begin, end):
        crc = _checksum_step(crc, d[i])
    return _checksum_step(crc, extra)


def _checksum_step(crc: int, value: int) -> int:
    x = (value ^ crc) & 0xFF
    x = (x ^ x << 4) & 0xFF
    return crc >> 8 ^ x << 8 ^ x << 3 ^ x >> 4


def frame_end(d: Sequence[int], at: int, end: int, system: int, msgid: int, extra: int) -> int:
    """Where the whole, unsigned frame that begins at a byte ends; 0 where no good one of the autopilot's begins there.

    Args:
        d: bytes.
        at: where it is to begin.
        end: of what has come.
        system: the autopilot's system id.
        msgid: the message that is expected, below 65,536.
        extra: its checksum's seed.
    """
    if end - at < _HEADER + _CHECKSUM or d[at] != MAGIC_V2 or d[at + 2] != 0:
        return 0
    stop = at + _HEADER + d[at + 1]
    if stop + _CHECKSUM > end or d[at + 5] != system or d[at + 6] != AUTOPILOT_COMPONENT:
        return 0
    if d[at + 7] != msgid & 0xFF or d[at + 8] != msgid >> 8 or d[at + 9] != 0:
        return 0
    crc = checksum(d, at + 1, stop, extra)
    if d[stop] != crc & 0xFF or d[stop + 1] != crc >> 8:
        return 0
    return stop + _CHECKSUM


def byte_at(d: Sequence[int], at: int, end: int) -> int:
    """A byte of a payload that ends before `end`: 0 where that was cut."""
    return 0 + d[at] if at < end else 0


def long_at(d: Sequence[int], at: int, end: int) -> int:
    """Eight bytes of a payload as a number; -1 where it is beyond 2^63, which no time is."""
    number = 0
    for i in range(8):
        value = byte_at(d, at + i, end)
        if i == 7 and value > 0x7F:
            return -1
        number += value << 8 * i
    return number


def write_long(o: MutableSequence[int], at: int, number: int, size: int) -> None:
    """Writes a number, not negative, as so many bytes."""
    for i in range(size):
        o[at + i] = number >> 8 * i & 0xFF


def close_frame(
    o: MutableSequence[int], at: int, length: int, seq: int, own: tuple[int, int], msgid: int, extra: int
) -> int:
    """Writes header and checksum around a payload that stands in its place, whose last byte is not 0.

    Args:
        o: bytes.
        at: where the frame begins.
        length: of the payload.
        seq: the frame's sequence number.
        own: the sender's system and component id.
        msgid: below 65,536.
        extra: the message's seed.

    Returns:
        where it ends.
    """
    system, component = own
    o[at], o[at + 1], o[at + 2], o[at + 3] = MAGIC_V2, length, 0, 0
    o[at + 4], o[at + 5], o[at + 6] = seq, system, component
    o[at + 7], o[at + 8], o[at + 9] = msgid & 0xFF, msgid >> 8, 0
    stop = at + _HEADER + length
    write_long(o, stop, checksum(o, at + 1, stop, extra), _CHECKSUM)
    return stop + _CHECKSUM


def write_rates(
    o: MutableSequence[int],
    floats: MutableSequence[float],
    time_ms: int,
    rates: tuple[float, float, float],
    thrust: float,
    target: tuple[int, int],
    mask: int,
) -> None:
    """The payload of SET_ATTITUDE_TARGET with body rates in a frame at AT.

    Args:
        o: bytes.
        floats: the same memory as floats.
        time_ms: the vehicle's time.
        rates: FRD [rad/s].
        thrust: 0 to 1.
        target: system and component.
        mask: what is to be ignored, not 0: it is the payload's last byte.
    """
    write_long(o, PAYLOAD, time_ms, 4)
    i = TARGET_FLOATS
    floats[i], floats[i + 1], floats[i + 2], floats[i + 3] = 1.0, 0.0, 0.0, 0.0
    floats[i + 4], floats[i + 5], floats[i + 6], floats[i + 7] = rates[0], rates[1], rates[2], thrust
    o[PAYLOAD + 36], o[PAYLOAD + 37], o[PAYLOAD + 38] = target[0], target[1], mask


def write_time(o: MutableSequence[int], at: int, own_ns: int, asked_ns: int, target: tuple[int, int]) -> None:
    """The payload of a TIMESYNC answer in a frame at `at`; `target` (system and component) ends with no 0."""
    begin = at + _HEADER
    write_long(o, begin, own_ns, 8)
    write_long(o, begin + 8, asked_ns, 8)
    o[begin + 16], o[begin + 17] = target
