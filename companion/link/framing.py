"""MAVLink frames: finding them in bytes, checking them, building them.

A parser takes whole datagrams or pieces of a serial stream, version 1 and 2, signed or not. It trusts a length only
after the checksum: behind a bad frame the search goes on at the next byte, so one corrupted byte costs one frame. The
length of a message that is unknown can only be judged by what is around it: a datagram has an end, a stream has not.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

from fastcrc.crc16 import mcrf4xx

from companion.control.types import new_record
from companion.link.codec import MessageFormat

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
SIGNED: Final = 0x01
"""Incompatibility flag of a signed frame; a frame with any other flag must not be read (MAVLink 2)."""
SIGNATURE_BYTES: Final = 13

_HEADER_V1 = struct.Struct("<BBBBBB")
_HEADER_V2 = struct.Struct("<BBBBBBBHB")
_ANY_MAGIC = re.compile(b"[\xfd\xfe]")
_UNFINISHED = -1
_CRC_EXTRA = [bytes((value,)) for value in range(256)]
_REORDERED = 128  # a sequence step of this much or more is a late frame or a restarted sender, not a loss


class Frame(NamedTuple):
    """One checked MAVLink frame."""

    msgid: int
    sysid: int
    compid: int
    seq: int
    payload: bytes
    """Truncated zeros restored; longer than our definition when the sender's has more extensions."""
    raw: bytes
    """The frame as it came, magic to checksum or signature."""
    arrival_wall_ns: int
    """`time.monotonic_ns()` after the read that brought it."""


class FrameGuard(Protocol):
    """Message signing: THE place where frames are verified and signed."""

    @property
    def outdated(self) -> int:
        """Frames so far whose signature was right and whose time was not."""

    @property
    def refusals(self) -> dict[str, int]:
        """Frames that were refused, by reason."""

    def verify(self, raw: bytes, msgid: int, signed: bool) -> bool:
        """Whether this frame (its checksum is right) may be used."""

    def sign(self, unsigned: bytes) -> bytes:
        """The 13 bytes of signature for a whole frame that has the signed flag set."""


@dataclass
class LinkCounters:
    """What happened on a link since it was opened."""

    received: int = 0
    """Frames handed out."""
    bad_crc: int = 0
    """Frames with a wrong checksum."""
    unknown: int = 0
    """Frames of messages that our dialect does not have; they cannot be checked and are not used."""
    bad_signature: int = 0
    """Frames that the guard refused."""
    garbage_bytes: int = 0
    """Bytes that belong to no good frame."""
    foreign_address: int = 0
    """Datagrams from others than the peer."""
    early: int = 0
    """Frames that came before the autopilot's signed heartbeat had said who the peer is."""
    other_system: int = 0
    """Frames of systems that have no say on this link."""
    unreachable: int = 0
    """Times the network said that what was sent cannot arrive: nobody listens there, no route, interface down."""
    sent: int = 0
    send_dropped: int = 0
    """Frames that were not sent: no peer yet, or the socket or line would not take them."""
    lost: dict[tuple[int, int], int] = field(default_factory=dict)
    """Frames missing by their sequence numbers, per sender (system, component); every sender seen has an entry.
    A frame that comes late was counted as missing before."""


def refusals(counters: LinkCounters, guard: FrameGuard | None) -> dict[str, int]:
    """What came on a link and was not used because of who sent it, by reason."""
    found = {"other_address": counters.foreign_address, "other_system": counters.other_system}
    return found if guard is None else {**guard.refusals, **found}


def refused_since(now: dict[str, int], before: dict[str, int]) -> dict[str, int]:
    """What was refused meanwhile, without the reasons that there were none for."""
    return {reason: count - before.get(reason, 0) for reason, count in now.items() if count > before.get(reason, 0)}


def _length(data: bytes, at: int, end: int) -> int:
    """Length of the frame that begins at `at`, 0 when none can, `_UNFINISHED` when it would end behind the data."""
    magic = data[at]
    if magic == MAGIC_V2:
        if end - at < 3:
            return _UNFINISHED
        flags = data[at + 2]
        if flags > SIGNED:
            return 0
        length = data[at + 1] + (12 + SIGNATURE_BYTES if flags else 12)
    elif magic == MAGIC_V1:
        if end - at < 2:
            return _UNFINISHED
        length = data[at + 1] + 8
    else:
        return 0
    return length if at + length <= end else _UNFINISHED


def _msgid(data: bytes, at: int) -> int:
    """Number of the message whose whole frame begins at `at`."""
    if data[at] == MAGIC_V2:
        return data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
    return data[at + 5]


class FrameParser:
    """Turns received bytes into frames and counts what is bad."""

    def __init__(
        self, formats: dict[int, MessageFormat], counters: LinkCounters, guard: FrameGuard | None = None
    ) -> None:
        self._formats = formats
        self._counters = counters
        self._guard = guard
        self._last_seq: dict[int, int] = {}
        """By sender: its system id << 8 | its component id."""

    def due(self, sysid: int, compid: int) -> int:
        """The sequence number that a sender's next frame has if none is lost; -1 before the first."""
        last = self._last_seq.get(sysid << 8 | compid)
        return -1 if last is None else (last + 1) & 0xFF

    def look(self, data: bytes, wall_ns: int) -> Frame | None:
        """The one frame that a datagram is, if it is a good, unsigned MAVLink 2 frame of a message that we know; else
        None. Nothing is counted."""
        if len(data) < _HEADER_V2.size + 2 or data[0] != MAGIC_V2 or data[2] != 0:
            return None
        _, length, _, _, seq, sysid, compid, low, high = _HEADER_V2.unpack_from(data)
        known = self._formats.get(low | high << 16)
        stop = _HEADER_V2.size + length
        if known is None or len(data) != stop + 2:
            return None
        if mcrf4xx(data[1:stop] + _CRC_EXTRA[known.crc_extra]) != data[stop] | data[stop + 1] << 8:
            return None
        payload = data[_HEADER_V2.size : stop].ljust(known.length, b"\0")
        return new_record(Frame, (low | high << 16, sysid, compid, seq, payload, data, wall_ns))

    def took(self, sysid: int, compid: int, count: int) -> None:
        """So many frames of a sender, the ones that were due, were checked and used elsewhere."""
        self._counters.received += count
        self._last_seq[sysid << 8 | compid] += count
        self._last_seq[sysid << 8 | compid] &= 0xFF

    def parse(self, data: bytes, wall_ns: int, frames: list[Frame], unknown: list[bytes], final: bool = True) -> int:
        """Append the frames in `data` to `frames`; return how many bytes are done with.

        Args:
            data: one datagram, or what a stream has brought since the last byte that was done with.
            wall_ns: when it arrived, `time.monotonic_ns()`.
            frames: receives the good frames.
            unknown: receives, raw, the frames of messages that we do not know, for the traffic log.
            final: nothing will be added to `data` (a datagram). Otherwise an unfinished frame at its end is left over,
                and one of an unknown message that nothing shows to be one yet.
        """
        if not final:
            return self._parse_stream(data, wall_ns, frames, unknown)
        at = 0
        end = len(data)
        while at < end:
            length = _length(data, at, end)
            if length > 0:
                stop = at + length
                raw = data if length == end else data[at:stop]
                following = data[stop] if stop < end else -1
                if self._take(raw, following, wall_ns, frames, unknown):
                    at = stop
                    continue
            at = self._skip(data, at)
        return at

    def _parse_stream(self, data: bytes, wall_ns: int, frames: list[Frame], unknown: list[bytes]) -> int:
        """The same for a stream, where the data end anywhere."""
        at = 0
        end = len(data)
        while at < end:
            length = _length(data, at, end)
            if length == _UNFINISHED:
                break
            if length > 0:
                following = self._following(data, at, at + length)
                if following == _UNFINISHED:
                    break
                if self._take(data[at : at + length], following, wall_ns, frames, unknown):
                    at += length
                    continue
            at = self._skip(data, at)
        return at

    def _skip(self, data: bytes, at: int) -> int:
        """Where a frame may begin behind the byte at `at`, which begins none; what is between is garbage."""
        found = _ANY_MAGIC.search(data, at + 1)
        to = len(data) if found is None else found.start()
        self._counters.garbage_bytes += to - at
        return to

    def _following(self, data: bytes, at: int, to: int) -> int:
        """The byte behind a candidate, 0 when it is no frame as there is a good one in it or none behind it.

        Only what is unknown is judged so. `_UNFINISHED`: more must come first.
        """
        if _msgid(data, at) in self._formats:
            return 0
        if self._find_good(data, at + 1, to) >= 0:
            return 0
        end = len(data)
        if to == end:
            return _UNFINISHED
        length = _length(data, to, end)
        if length == _UNFINISHED:
            return _UNFINISHED
        good = length > 0 and (_msgid(data, to) not in self._formats or self._find_good(data, to, to + 1) == to)
        return data[to] if good else 0

    def _find_good(self, data: bytes, start: int, to: int) -> int:
        """Where a whole frame with a right checksum begins in this range, -1 when none does. Nothing is counted."""
        end = len(data)
        found = _ANY_MAGIC.search(data, start, to)
        while found is not None:
            at = found.start()
            length = _length(data, at, end)
            if length > 0:
                known = self._formats.get(_msgid(data, at))
                stop = at + (10 if data[at] == MAGIC_V2 else 6) + data[at + 1]
                if known is not None and (
                    mcrf4xx(data[at + 1 : stop] + _CRC_EXTRA[known.crc_extra]) == data[stop] | data[stop + 1] << 8
                ):
                    return at
            found = _ANY_MAGIC.search(data, at + 1, to)
        return -1

    def settle(self, data: bytes, wall_ns: int, frames: list[Frame], unknown: list[bytes]) -> int:
        """A stream has fallen silent: append the good frames behind an unfinished one that was left over.

        An unfinished frame without any behind it stays: it holds nothing back, and its rest may still come.

        Args:
            data: what `parse` has left over.
            wall_ns: when the last of it arrived, `time.monotonic_ns()`.
            frames: receives the good frames.
            unknown: receives the frames of unknown messages.

        Returns:
            How many bytes are done with.
        """
        at = 0
        end = len(data)
        while at < end:
            good = self._find_good(data, at + 1, end)
            if good >= 0:
                self.parse(data[at:good], wall_ns, frames, unknown)
                at = good + self._parse_stream(data[good:], wall_ns, frames, unknown)
                continue
            length = _length(data, at, end)
            if length <= 0:
                break
            at += self.parse(data[at : at + length], wall_ns, frames, unknown)  # of an unknown message that waited
        return at

    def _take(self, raw: bytes, following: int, wall_ns: int, frames: list[Frame], unknown: list[bytes]) -> bool:
        """Check one whole candidate. True: its bytes are dealt with. False: the search must go on inside them."""
        if raw[0] == MAGIC_V2:
            _, length, flags, _, seq, sysid, compid, low, high = _HEADER_V2.unpack_from(raw)
            start, msgid, signed = 10, low | high << 16, flags == SIGNED
        else:
            start, signed = 6, False
            _, length, seq, sysid, compid, msgid = _HEADER_V1.unpack_from(raw)
        known = self._formats.get(msgid)
        if known is None:
            # Cannot be checked. Believe its length only when another frame, or nothing, comes right behind it.
            if following in {MAGIC_V1, MAGIC_V2, -1}:
                self._counters.unknown += 1
                unknown.append(raw)
                return True
            return False
        crc_extra, whole = known
        stop = start + length
        if mcrf4xx(raw[1:stop] + _CRC_EXTRA[crc_extra]) != raw[stop] | raw[stop + 1] << 8:
            self._counters.bad_crc += 1
            return False
        if self._guard is not None and not self._guard.verify(raw, msgid, signed):
            self._counters.bad_signature += 1
            return True
        payload = raw[start:stop].ljust(whole, b"\0")
        self._counters.received += 1
        sender = sysid << 8 | compid
        if self._last_seq.get(sender) == (seq - 1) & 0xFF:
            self._last_seq[sender] = seq
        else:
            self._count_lost(sender, seq)
        frames.append(new_record(Frame, (msgid, sysid, compid, seq, payload, raw, wall_ns)))
        return True

    def _count_lost(self, sender: int, seq: int) -> None:
        """Count what is missing before a good frame that does not follow the one before."""
        ids = sender >> 8, sender & 0xFF
        last = self._last_seq.get(sender)
        if last is None:
            self._counters.lost[ids] = 0
        else:
            step = (seq - last) & 0xFF
            if step == 0 or step >= _REORDERED:
                return
            self._counters.lost[ids] += step - 1
        self._last_seq[sender] = seq


def build_frame(
    msgid: int, payload: bytes, seq: int, sysid: int, compid: int, crc_extra: int, guard: FrameGuard | None = None
) -> bytes:
    """A MAVLink 2 frame around a payload: trailing zeros trimmed but for the first byte, signed by a guard."""
    trimmed = payload.rstrip(b"\0") or payload[:1]
    flags = 0 if guard is None else SIGNED
    body = _HEADER_V2.pack(MAGIC_V2, len(trimmed), flags, 0, seq, sysid, compid, msgid & 0xFFFF, msgid >> 16) + trimmed
    checksum = mcrf4xx(body[1:] + _CRC_EXTRA[crc_extra])
    frame = body + checksum.to_bytes(2, "little")
    return frame if guard is None else frame + guard.sign(frame)
