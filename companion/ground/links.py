"""The ground links: ports and lines at which ground tools find the companion.

A `udpin` port talks to everybody who sent a valid frame to it lately, with a key a signed one; `udpout` and `serial`
have one peer each. Every peer is a `GroundLink` of its own, so that an answer goes where the question came from.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from companion.errors import LinkError
from companion.link import codec
from companion.link.codec import message_formats
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
from companion.link.transport import Address, Transport, open_transport
from companion.link.wire import COMPANION_COMPONENT

PEERS_MAX: Final = 16
"""Ground tools at one port; when a further one comes, the one that was silent for longest is forgotten."""
PEER_SILENCE_S: Final = 30.0
"""After which a tool at a `udpin` port gets no more reports."""
_READS_MAX: Final = 64
_GREET_S: Final = 0.2


class Peer:
    """The way to one ground tool; implements `service.GroundLink`."""

    def __init__(self, port: GroundPort, address: Address | None) -> None:
        self.heard_s = time.monotonic()
        """When it last sent something."""
        self._port = port
        self._address = address

    @property
    def name(self) -> str:
        """The connection, and the tool's address where there may be several."""
        return self._port.connection if self._address is None else f"{self._port.connection} {_shown(self._address)}"

    def send(self, msgid: int, payload: bytes) -> None:
        """Sends one message to this tool alone."""
        self._port.send_to(msgid, payload, self._address)


class GroundPort:
    """One socket or line; nothing comes and nothing goes until it is opened.

    Args:
        connection: `udpin:127.0.0.1:14590`, `udpout:host:port` or `serial:/dev/ttyUSB0:57600`.
        system: asked for the system id that we send with.
        guard: verifies and signs.
        systems: system ids of the tools that are listened to; None: all.
    """

    def __init__(
        self,
        connection: str,
        system: Callable[[], int],
        guard: FrameGuard | None = None,
        systems: frozenset[int] | None = None,
    ) -> None:
        self.connection = connection
        self.counters = LinkCounters()
        self.greeting: Callable[[], bytes] = codec.encode_heartbeat
        """Makes the heartbeat that a tool gets whose signatures are right and late: it learns the time from that."""
        self._systems = systems
        self._outdated = 0
        self._greeted_s = 0.0
        self._transport: Transport | None = None
        self._system = system
        self._guard = guard
        self._formats = message_formats()
        self._parser = FrameParser(self._formats, self.counters, guard)
        self._line: LineReader | None = None
        """Of a serial line, while it is open."""
        self._seq = 0
        self._peers: dict[Address | None, Peer] = {}

    def open(self) -> None:
        """Opens it, for the first time or again.

        Raises:
            InputError, LinkError: it cannot be opened.
        """
        self._transport = transport = open_transport(self.connection)
        self._line = LineReader(self._parser) if transport.stream else None
        if transport.stream or transport.fixed_peer is not None:
            self._peers[transport.fixed_peer] = Peer(self, transport.fixed_peer)

    def fileno(self) -> int:
        """File descriptor to wait on; -1 when it is not open."""
        return -1 if self._transport is None else self._transport.fileno()

    @property
    def refusals(self) -> dict[str, int]:
        """What came and was not used because of who sent it, by reason."""
        return refusals(self.counters, self._guard)

    @property
    def peers(self) -> list[Peer]:
        """Who gets reports."""
        return list(self._peers.values())

    def receive(self) -> list[tuple[Frame, Peer]]:
        """Every good frame that is there; a bounded number of reads, so that a flood cannot keep it.

        Raises:
            LinkError: the line is gone.
        """
        found: list[tuple[Frame, Peer]] = []
        transport = self._transport
        if transport is None:
            return found
        for _ in range(_READS_MAX):
            try:
                got = transport.read()
            except OSError:  # the network's report about something sent earlier
                self.counters.unreachable += 1
                continue
            if got is None:
                if self._line is not None:
                    found += self._rested(self._line)
                break
            found += self._parsed(*got)
        return found

    def _parsed(self, data: bytes, address: Address | None) -> list[tuple[Frame, Peer]]:
        frames: list[Frame] = []
        if self._line is None:
            self._parser.parse(data, time.monotonic_ns(), frames, [])
        else:
            self._line.take(data, time.monotonic_ns(), frames, [])
        return self._heard(frames, address)

    def _rested(self, line: LineReader) -> list[tuple[Frame, Peer]]:
        """What waited behind an unfinished frame, if a line is silent now."""
        frames: list[Frame] = []
        line.rest(time.monotonic_ns(), frames, [])
        return self._heard(frames, None) if frames else []

    def _heard(self, frames: list[Frame], address: Address | None) -> list[tuple[Frame, Peer]]:
        if self._guard is not None:
            # What may come unsigned (a radio's own report) is of no use here, and anybody may have sent it.
            frames = [frame for frame in frames if frame.raw[0] == MAGIC_V2 and frame.raw[2] == SIGNED]
        if self._systems is not None and frames:
            heard = len(frames)
            frames = [frame for frame in frames if frame.sysid in self._systems]
            self.counters.other_system += heard - len(frames)
        if not frames:
            if self._guard is not None:
                self._greet(self._guard, address)
            return []
        transport = self._transport
        fixed = None if transport is None else transport.fixed_peer
        peer = self._peer(address if fixed is None else fixed)
        return [(frame, peer) for frame in frames]

    def _greet(self, guard: FrameGuard, address: Address | None) -> None:
        """Tells the time to a tool that has the key and is late, now and then; it becomes no peer by that."""
        outdated, self._outdated = self._outdated, guard.outdated
        now_s = time.monotonic()
        if outdated != self._outdated and now_s - self._greeted_s > _GREET_S:
            self._greeted_s = now_s
            self.send_to(codec.HEARTBEAT, self.greeting(), address)

    def _peer(self, address: Address | None) -> Peer:
        peer = self._peers.get(address)
        if peer is None:
            if len(self._peers) >= PEERS_MAX:
                oldest = min(self._peers, key=lambda known: self._peers[known].heard_s)
                del self._peers[oldest]
            peer = self._peers[address] = Peer(self, address)
        peer.heard_s = time.monotonic()
        return peer

    def forget_silent(self, now_s: float) -> None:
        """Ends the reports to tools that have gone; those with a fixed address stay."""
        if self._transport is None or self._transport.stream or self._transport.fixed_peer is not None:
            return
        for address, peer in list(self._peers.items()):
            if now_s - peer.heard_s > PEER_SILENCE_S:
                del self._peers[address]

    def send_to(self, msgid: int, payload: bytes, address: Address | None) -> None:
        """Sends one message to one peer; lost when it is not open."""
        if self._transport is None:
            self.counters.unreachable += 1
            return
        crc_extra = self._formats[msgid].crc_extra
        raw = build_frame(msgid, payload, self._seq, self._system(), COMPANION_COMPONENT, crc_extra, self._guard)
        self._seq = (self._seq + 1) & 0xFF
        try:
            sent = self._transport.write(raw, address)
        except (OSError, LinkError):
            self.counters.unreachable += 1
            return
        self.counters.sent += sent
        self.counters.send_dropped += not sent

    def close(self) -> None:
        """Closes the socket or line, and forgets who was there and what had come in part; it may be opened again."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._peers.clear()
        self._line = None


def _shown(address: Address) -> str:
    return f"{address[0]}:{address[1]}"
