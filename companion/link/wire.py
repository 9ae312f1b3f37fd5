"""The vehicle link: frames in, frames out, over one socket or line that belongs to the control loop.

`receive` waits, drains and checks; `send` frames and never blocks. One link has one peer: PX4 locks on to the first
sender and so do we, a second voice at the port is counted and not heard. Signing stands in front of everything, at
one place (`framing.FrameGuard`); with it, the peer is whoever sends the autopilot's first signed heartbeat.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final

from companion.link.codec import AUTOPILOT_COMPONENT, HEARTBEAT, encode_heartbeat, message_formats
from companion.link.framing import (
    MAGIC_V2,
    SIGNED,
    Frame,
    FrameGuard,
    FrameParser,
    LinkCounters,
    build_frame,
    refusals,
)
from companion.link.line import LineReader
from companion.link.signing import SETUP_SIGNING
from companion.link.signing_times import KeptSigner, open_signer
from companion.link.transport import Address, Transport, open_transport

Tap = Callable[[int, bytes, int], object]
"""Called with direction, raw frame and `time.monotonic_ns()` for every frame used or sent, and unknown ones; not for
those that carry a key. In the order of the traffic, but only when the wire has nothing to do (`Wire.tell`)."""

Datagram = tuple[bytes, Address | None, int]
"""With its sender and its arrival, `time.monotonic_ns()`."""
TAP_IN: Final = 0
TAP_OUT: Final = 3  # the numbers that a traffic log (.tlog) has for the directions

COMPANION_COMPONENT: Final = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
_READS_MAX = 256
_MSGID = slice(7, 10)
_V2 = bytes((MAGIC_V2,))
_DATAGRAM_MAX = 1400
"""Several frames in one datagram stay within what a network takes whole."""
_UNTOLD_MAX = 1000
"""What waits for the tap is bounded, also for somebody who only sends."""
_UNHEARD_NS: Final = 1_000_000_000
_GREET_NS: Final = 500_000_000


class Wire:
    """One open vehicle link. Not thread-safe: it belongs to one thread."""

    def __init__(
        self,
        transport: Transport,
        system_id: int = 1,
        component_id: int = COMPANION_COMPONENT,
        tap: Tap | None = None,
        guard: FrameGuard | None = None,
        only_system: int | None = None,
    ) -> None:
        self.only_system = only_system
        """System id of the only autopilot that is listened to; None: the first one that is heard."""
        self.system_id = system_id
        """Own system id in what is sent: the vehicle's, as soon as that is known."""
        self.component_id = component_id
        """Own component id."""
        self.counters = LinkCounters()
        """What came, what was bad, what was lost."""
        self.peer: Address | None = transport.fixed_peer
        """Whom we talk to; None until a valid frame came (and always on a serial line)."""
        self.last_foreign: Address | None = None
        """Who else sent to our port, if anybody, for the explanation of a silent vehicle."""
        self.at_once: Callable[[list[Datagram]], int] | None = None
        """Asked about datagrams of the peer that have come, before they are parsed: how many of them, from the first
        one on, were used. For who answers the usual ones without any detour. Never on a serial line, nor where frames
        are signed."""
        self._transport = transport
        self._tap = tap
        self._untold: list[tuple[int, bytes, int]] = []
        """What the tap has not been shown yet."""
        self._guard = guard
        self._formats = message_formats()
        self._parser = FrameParser(self._formats, self.counters, guard)
        self._seq = 0
        self._line = LineReader(self._parser) if transport.stream else None
        self._gathered: list[bytes] | None = None
        self._owned: KeptSigner | None = None
        self._kept: list[Frame] = []
        self._unread: list[Datagram] = []
        """Datagrams that were read and not used yet."""
        self._heard_ns = self._greeted_ns = 0
        self._outdated = 0
        self._poll = select.poll()
        self._poll.register(transport.fileno(), select.POLLIN)

    @classmethod
    def open(
        cls,
        connection: str,
        *,
        system_id: int = 1,
        component_id: int = COMPANION_COMPONENT,
        tap: Tap | None = None,
        guard: FrameGuard | None = None,
        key: str | None = None,
        only_system: int | None = None,
    ) -> Wire:
        """Open a link by its connection string.

        Args:
            connection: `udpin:127.0.0.1:14540` waits for the vehicle at a port, `udpout:host:port` speaks first,
                `serial:/dev/ttyAMA0:921600` is a line.
            system_id: own system id, the vehicle's.
            component_id: own component id.
            tap: sees every frame, for the traffic log; must not raise or block.
            guard: verifies and signs.
            key: file with the key to verify and sign with, in the place of a guard.
            only_system: system id of the only autopilot that is listened to.

        Raises:
            InputError: the connection string, host or device name is wrong, or the key file cannot be used.
            LinkError: the port or line cannot be had.
        """
        signer = open_signer(key)
        try:
            transport = open_transport(connection)
        except BaseException:
            if signer is not None:
                signer.close()
            raise
        wire = cls(transport, system_id, component_id, tap, signer or guard, only_system)
        wire._owned = signer
        return wire

    @property
    def signed(self) -> bool:
        """Whether frames are signed and verified."""
        return self._guard is not None

    @property
    def refusals(self) -> dict[str, int]:
        """What came and was not used because of who sent it, by reason."""
        return refusals(self.counters, self._guard)

    def receive(self, timeout_s: float, spin_s: float = 0.0, until: frozenset[int] = frozenset()) -> list[Frame]:
        """Wait for the link at most this long, then return every good frame that is there, in the order of arrival.

        An empty list may come early (garbage, foreign senders, a line that fell silent): the caller watches the clock
        itself. One call reads a bounded number of datagrams, so that a flood cannot keep it; what is left is there for
        the next call. A timeout is rounded up to milliseconds.

        Args:
            timeout_s: how long to wait for the first datagram.
            spin_s: look without sleeping for this long first: an answer that is due in less is not worth going to sleep
                for, which costs more than the wait itself. For a vehicle in lockstep: what was found this way is one
                datagram, after which nothing comes before it is answered.
            until: messages: datagrams behind the newest one that begins with one of them are left to the next call,
                which does not wait then. For who answers these messages in a hurry; nothing is left on a serial line.

        Raises:
            LinkError: the serial line is gone.
        """
        if self._untold:
            self.tell()
        if self._kept:
            kept, self._kept = self._kept, []
            return kept
        frames: list[Frame] = []
        unknown: list[bytes] = []
        if self._unread:
            self._use(frames, unknown, frozenset())
            return self._noted(frames, unknown)
        if not self._spin(spin_s, frames, unknown):
            if self._line is not None:
                timeout_s = min(timeout_s, self._line.wait_s(time.monotonic_ns()))
            if not self._poll.poll(max(0.0, timeout_s) * 1e3):
                if self._line is None:
                    return frames
                self._rest(self._line, frames, unknown)
            if self._line is None:
                self._read_datagrams()
                self._use(frames, unknown, until)
            else:
                for _ in range(_READS_MAX):
                    if not self._read(frames, unknown):
                        break
        return self._noted(frames, unknown)

    def _noted(self, frames: list[Frame], unknown: list[bytes]) -> list[Frame]:
        if self._tap is not None:
            self._note(frames, unknown)
        return frames

    def _read_datagrams(self) -> None:
        """Read what is there, to be used one after the other."""
        read, unread, now = self._transport.read, self._unread, time.monotonic_ns
        for _ in range(_READS_MAX):
            try:
                got = read()
            except OSError:  # the network's report about something sent earlier; it says nothing about what comes
                self.counters.unreachable += 1
                continue
            if got is None:
                return
            unread.append((*got, now()))

    def _use(self, frames: list[Frame], unknown: list[bytes], until: frozenset[int]) -> None:
        """Use what was read, up to the newest datagram of the peer that begins with one of these messages, if any."""
        unread = self._unread
        end = len(unread)
        if until and end > 1:
            for i in range(end - 1, -1, -1):
                data, address, _ = unread[i]
                if address == self.peer and data[:1] == _V2 and int.from_bytes(data[_MSGID], "little") in until:
                    end = i + 1
                    break
        datagrams = unread[:end]
        del unread[:end]
        self._use_datagrams(datagrams, frames, unknown)

    def keep(self, frames: list[Frame]) -> None:
        """Have frames that were received and not used yet received again, before all others."""
        self._kept = frames + self._kept

    def _read(self, frames: list[Frame], unknown: list[bytes]) -> bool:
        """Use what is there to be read at once; False when there is nothing."""
        try:
            got = self._transport.read()
        except OSError:  # the network's report about something sent earlier; it says nothing about what comes
            self.counters.unreachable += 1
            return True
        if got is None:
            return False
        wall_ns = time.monotonic_ns()
        if self._line is not None:
            self._parse_stream(self._line, got[0], wall_ns, frames, unknown)
        else:
            self._use_datagrams([(*got, wall_ns)], frames, unknown)
        return True

    def _spin(self, spin_s: float, frames: list[Frame], unknown: list[bytes]) -> bool:
        """Look for a datagram without sleeping; True when one was used."""
        if spin_s <= 0.0:
            return False
        read, now = self._read, time.monotonic_ns
        end_ns = now() + int(spin_s * 1e9)
        while now() < end_ns:
            if read(frames, unknown):
                return True
        return False

    def _use_datagrams(self, datagrams: list[Datagram], frames: list[Frame], unknown: list[bytes]) -> None:
        """Use datagrams before which nothing waits to be used."""
        used, peer = 0, self.peer
        if self.at_once is not None and self._guard is None and all([address == peer for _, address, _ in datagrams]):
            used = self.at_once(datagrams)
            if used:
                self._heard_ns = datagrams[used - 1][2]
        for data, address, wall_ns in datagrams[used:]:
            self._parse_datagram(data, address, wall_ns, frames, unknown)

    def _parse_datagram(
        self, data: bytes, address: Address | None, wall_ns: int, frames: list[Frame], unknown: list[bytes]
    ) -> None:
        """Use a datagram of the peer; let the first valid frame, or the autopilot's, decide who that is."""
        if self.peer is not None and address != self.peer:
            self.counters.foreign_address += 1
            self.last_foreign = address
            return
        before = len(frames)
        self._parser.parse(data, wall_ns, frames, unknown)
        if len(frames) > before:
            self._heard_ns = wall_ns
            if self.peer is None:
                self._choose_peer(address, frames, before)
        elif self._guard is not None:
            self._greet(address, wall_ns)

    def _choose_peer(self, address: Address | None, frames: list[Frame], before: int) -> None:
        """Let what has come decide whom we talk to; what does not decide is not used."""
        if self._guard is None or any(self._introduces(frame) for frame in frames[before:]):
            self.peer = address
        else:
            self.counters.early += len(frames) - before
            del frames[before:]

    def _introduces(self, frame: Frame) -> bool:
        """Whether a frame says who is at the other end: for us the autopilot's signed heartbeat, for tools any."""
        if frame.raw[0] != MAGIC_V2 or frame.raw[2] != SIGNED:
            return False
        if self.component_id != COMPANION_COMPONENT:
            return True
        autopilot = frame.msgid == HEARTBEAT and frame.compid == AUTOPILOT_COMPONENT
        return autopilot and self.only_system in {None, frame.sysid}

    def _greet(self, address: Address | None, wall_ns: int) -> None:
        """Tell the time to somebody who has the key and is late: PX4 begins in the past and learns it from us.

        Otherwise both would wait for each other. In a flight there is nothing to learn any more.
        """
        assert self._guard is not None
        outdated, self._outdated = self._outdated, self._guard.outdated
        silent = wall_ns - self._heard_ns > _UNHEARD_NS and wall_ns - self._greeted_ns > _GREET_NS
        if outdated == self._outdated or not silent or self.component_id != COMPANION_COMPONENT:
            return
        self._greeted_ns = wall_ns
        before, self.peer = self.peer, address
        self.send(HEARTBEAT, encode_heartbeat())
        self.peer = before

    def _parse_stream(
        self, line: LineReader, data: bytes, wall_ns: int, frames: list[Frame], unknown: list[bytes]
    ) -> None:
        """Use what a line brought, keeping an unfinished frame for the next time."""
        before = len(frames)
        line.take(data, wall_ns, frames, unknown)
        if len(frames) > before:
            self._heard_ns = wall_ns
        elif self._guard is not None:
            self._greet(None, wall_ns)

    def _rest(self, line: LineReader, frames: list[Frame], unknown: list[bytes]) -> None:
        """Use what waits behind an unfinished frame, if a line is silent now."""
        line.rest(time.monotonic_ns(), frames, unknown)
        if frames:
            self._heard_ns = frames[-1].arrival_wall_ns

    def _note(self, frames: list[Frame], unknown: list[bytes]) -> None:
        """Keep what came for the tap."""
        untold = self._untold
        for frame in frames:
            if frame.msgid != SETUP_SIGNING:  # carries a key
                untold.append((TAP_IN, frame.raw, frame.arrival_wall_ns))
        if unknown:
            wall_ns = time.monotonic_ns()
            untold += [(TAP_IN, raw, wall_ns) for raw in unknown]

    def tell(self) -> None:
        """Show the tap what came and went since the last time.

        Whoever answers in a hurry calls it after the answer; otherwise the next `receive` does, or `close`. What the
        tap raises comes out once; it is shown nothing any more then, as the link is needed for the hand-over.
        """
        tap, untold = self._tap, self._untold
        if not untold:
            return
        try:
            if tap is not None:
                for direction, raw, wall_ns in untold:
                    tap(direction, raw, wall_ns)
        except Exception:
            self._tap = None
            raise
        finally:
            untold.clear()

    def send(self, msgid: int, payload: bytes) -> bool:
        """Frame a payload and hand it to the system without waiting. False, and counted, when it did not go out.

        Raises:
            ValueError: our dialect has no such message (a fault of the caller).
        """
        known = self._formats.get(msgid)
        if known is None:
            raise ValueError(f"message {msgid} is not in the dialect")
        raw = build_frame(msgid, payload, self._seq, self.system_id, self.component_id, known.crc_extra, self._guard)
        if self._gathered is not None:
            self._gathered.append(raw)
        elif not self._write(raw):
            self.counters.send_dropped += 1
            return False
        self._seq = (self._seq + 1) & 0xFF
        self.counters.sent += 1
        if self._tap is not None and msgid != SETUP_SIGNING:
            self._untold.append((TAP_OUT, raw, time.monotonic_ns()))
            if len(self._untold) > _UNTOLD_MAX:
                self.tell()
        return True

    def look(self, datagram: Datagram) -> Frame | None:
        """The one good frame that a datagram is, for `at_once`; None where it is anything else. Nothing is counted."""
        return self._parser.look(datagram[0], datagram[2])

    def took(self, datagram: bytes, wall_ns: int, sender: tuple[int, int], count: int) -> None:
        """Note a datagram that `at_once` was asked about and that was used.

        Args:
            datagram: its frames were checked, are all of the sender, and were due.
            wall_ns: when it arrived.
            sender: its system and component id.
            count: how many frames are in it.
        """
        self._parser.took(*sender, count)
        if self._tap is not None:
            self._untold.append((TAP_IN, datagram, wall_ns))

    def due(self, sysid: int, compid: int) -> tuple[int, int]:
        """The sequence numbers that are due: of a sender's next frame if none is lost (-1 before its first), and of our
        own."""
        return self._parser.due(sysid, compid), self._seq

    def answer(
        self, datagram: bytes, wall_ns: int, sender: tuple[int, int], count: int, frames: memoryview | None
    ) -> bool:
        """Send what answers a datagram that `at_once` was asked about, and note that it was used; see `took`.

        Args:
            datagram: that is answered.
            wall_ns: when it arrived.
            sender: its system and component id.
            count: how many frames are in it, and in the answer.
            frames: the answer, with our own next sequence numbers; None: there is none.

        Returns:
            False, and counted, when it did not go out.
        """
        raw = None if frames is None else frames.tobytes()
        out = raw is not None and self._write(raw)
        self.took(datagram, wall_ns, sender, count)
        if raw is None or not out:
            self.counters.send_dropped += raw is not None
            return False
        self._seq = (self._seq + count) & 0xFF
        self.counters.sent += count
        if self._tap is not None:
            self._untold.append((TAP_OUT, raw, time.monotonic_ns()))
        return True

    def gather(self) -> None:
        """Keep what is sent from now on, for `release`: for a vehicle in lockstep, which waits for the last of it."""
        self._gathered = []

    def release(self) -> None:
        """Send what was kept since `gather`, in datagrams of several frames (MAVLink allows that)."""
        gathered, self._gathered = self._gathered, None
        if not gathered:
            return
        datagram = gathered[0]
        for raw in gathered[1:]:
            if len(datagram) + len(raw) > _DATAGRAM_MAX:
                self._write_gathered(datagram)
                datagram = raw
            else:
                datagram += raw
        self._write_gathered(datagram)

    def _write_gathered(self, datagram: bytes) -> None:
        if not self._write(datagram):
            self.counters.send_dropped += 1

    def _write(self, raw: bytes) -> bool:
        """Write once; once more when what failed was an earlier datagram (that is how UDP reports "nobody listens")."""
        for _ in range(2):
            try:
                return self._transport.write(raw, self.peer)
            except OSError:
                self.counters.unreachable += 1
        return False

    def release_peer(self) -> None:
        """Forget a peer that is not the vehicle: the next valid frame decides again. Not for use in flight."""
        self.peer = self._transport.fixed_peer

    def try_another_peer(self) -> bool:
        """Turn to the other sender at the port, if there is one and it need not prove who it is. Not for use in flight.

        Returns:
            Whether there was one. Where frames are signed, the peer is forgotten in its place.
        """
        if self._guard is not None:
            self.release_peer()
            return True
        if self.last_foreign is None:
            return False
        self.peer, self.last_foreign = self.last_foreign, None
        return True

    def fileno(self) -> int:
        """File descriptor, to wait on it together with others."""
        return self._transport.fileno()

    def close(self) -> None:
        """Close the link; what was read and not used yet is in the log, too."""
        self.at_once = None
        if self._unread:
            frames: list[Frame] = []
            unknown: list[bytes] = []
            self._use(frames, unknown, frozenset())
            self._noted(frames, unknown)
        self.tell()
        self._transport.close()
        if self._owned is not None:
            self._owned.close()

    def __enter__(self) -> Wire:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
