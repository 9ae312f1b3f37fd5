"""Requests to a file server over a link that loses, repeats and reorders: several under way, each until it is answered.

How many are under way follows the time that answers take: as long as it does not grow, nothing queues up on the way,
and more may go out; loss alone changes nothing. So a fast network is filled, a telemetry radio is not flooded, and one
that loses every fifth message is still used fully.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Protocol

from companion.errors import InputError, LinkError
from companion.ground.ftp import DATA_MAX, FILE_TRANSFER_PROTOCOL, SEQ_MODULUS, Opcode, Packet, decode, encode
from companion.link.framing import Frame
from companion.link.wire import COMPANION_COMPONENT

OWN_SYSTEM: Final = 254
OWN_COMPONENT: Final = 190
"""The command line's place in the network; it sends no heartbeat, which would hide the pilot's loss of link."""

WINDOW_MIN, WINDOW_START, WINDOW_MAX = 2.0, 8.0, 48.0
_FAST_GROWTH = 16.0
_QUEUE_SHARE, _QUEUE_S = 1.5, 0.03
_TIMEOUT_MIN_S, _TIMEOUT_START_S, _TIMEOUT_MAX_S = 0.05, 0.5, 2.0
_OVERTAKEN_BY = 3
_LOOK_S = 0.1
_GRAIN_S = 0.001  # a wait is rounded to milliseconds anyway; just too early would be a turn for nothing
_ASK_AGAIN_S = 0.25


class Connection(Protocol):
    """What a transfer needs of a link; `companion.link.wire.Wire` has it."""

    def send(self, msgid: int, payload: bytes) -> bool:
        """Sends one message without waiting; False when it did not go out."""

    def receive(self, timeout_s: float) -> list[Frame]:
        """The frames that come within this time, or sooner."""


class NakError(Exception):
    """The server refused a request."""

    def __init__(self, request: Packet, reply: Packet) -> None:
        super().__init__(f"operation {request.opcode} was refused: {reply.data.hex()}")
        self.failure = reply.data[0] if reply.data else 0
        """`ftp.Failure`."""
        self.errno = reply.data[1] if len(reply.data) > 1 else 0
        """With FAIL_ERRNO."""


class Pace:
    """How many requests may be under way, and when an answer is overdue, from how long answers take."""

    def __init__(self) -> None:
        self.window = WINDOW_START
        """Requests that may be under way."""
        self._least_s = self._mean_s = self._spread_s = 0.0
        self._cut_s = -1.0

    def sample(self, took_s: float, now_s: float) -> None:
        """An answer came to a request that was sent once."""
        if self._mean_s == 0.0:
            self._least_s, self._mean_s, self._spread_s = took_s, took_s, took_s / 2.0
        self._least_s = min(self._least_s, took_s)
        self._spread_s += (abs(took_s - self._mean_s) - self._spread_s) / 4.0
        self._mean_s += (took_s - self._mean_s) / 8.0
        if took_s < _QUEUE_SHARE * self._least_s + _QUEUE_S:
            growth = 1.0 if self.window < _FAST_GROWTH else 1.0 / self.window
            self.window = min(WINDOW_MAX, self.window + growth)
        elif now_s - self._cut_s > self._mean_s:
            self._cut_s = now_s
            self.window = max(WINDOW_MIN, 0.8 * self.window)

    def overdue(self, now_s: float) -> None:
        """An answer did not come at all, and none after it."""
        if now_s - self._cut_s > self.timeout_s(1):
            self._cut_s = now_s
            self.window = max(WINDOW_MIN, 0.5 * self.window)

    def timeout_s(self, sends: int) -> float:
        """How long to wait for the answer to a request that was sent so often."""
        first = self._mean_s + 4.0 * self._spread_s if self._mean_s else _TIMEOUT_START_S
        return min(_TIMEOUT_MAX_S, max(_TIMEOUT_MIN_S, first) * 2.0 ** min(sends - 1, 8))


@dataclass(eq=False)
class _Sent:
    """A request that has no answer yet."""

    request: Packet
    at_s: float
    order: int
    """Counts all sendings: which answers should have come after this one's."""
    sends: int = 1


class Exchange:
    """Requests to the file server of one vehicle."""

    def __init__(
        self, connection: Connection, system: int, patience_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Prepare it.

        Args:
            connection: the link.
            system: the vehicle's system id.
            patience_s: how long nothing may come before the link counts as lost.
            clock: monotonic time [s].
        """
        self.system = system
        self._connection = connection
        self._patience_s = patience_s
        self._clock = clock
        self._pace = Pace()
        self._seq = random.randrange(SEQ_MODULUS)  # answers to an earlier run are not taken for ours
        self._order = 0

    def ask(self, opcode: Opcode, data: bytes = b"", *, session: int = 0, offset: int = 0) -> Packet:
        """One request, and its answer.

        Raises:
            NakError: it was refused.
            LinkError: no answer.
        """
        answers: list[Packet] = []
        request = Packet(0, session, opcode, len(data), 0, 0, offset, data)
        self.run([request], lambda _, reply: answers.append(reply))
        return answers[0]

    def run(self, requests: Iterable[Packet], answered: Callable[[Packet, Packet], object]) -> None:
        """Many requests, several at a time; the order in which they arrive must not matter.

        Args:
            requests: taken as there is room; their sequence numbers are set here.
            answered: told of every request that was granted, with its answer.

        Raises:
            NakError: one was refused.
            LinkError: no answers any more.
        """
        source = iter(requests)
        pending: dict[int, _Sent] = {}
        more = True
        newest = 0
        heard_s = self._clock()
        while more or pending:
            while more and len(pending) < self._pace.window:
                request = next(source, None)
                more = request is not None
                if request is not None:
                    self._send_new(request, pending)
            for frame in self._connection.receive(self._wait_s(pending)):
                reply = self._reply(frame)
                sent = None if reply is None else pending.get((reply.seq - 1) % SEQ_MODULUS)
                if reply is None or sent is None or reply.req_opcode != sent.request.opcode:
                    continue
                del pending[sent.request.seq]
                heard_s = self._clock()
                newest = max(newest, sent.order)
                if sent.sends == 1:
                    self._pace.sample(heard_s - sent.at_s, heard_s)
                if reply.opcode == Opcode.NAK:
                    raise NakError(sent.request, reply)
                answered(sent.request, reply)
            self._repeat(pending, newest)
            if self._clock() - heard_s > self._patience_s:
                raise LinkError(f"no answer from system {self.system} for {self._patience_s:.0f} s")

    def _send_new(self, request: Packet, pending: dict[int, _Sent]) -> None:
        self._seq = (self._seq + 1) % SEQ_MODULUS
        request = request._replace(seq=self._seq)
        self._order += 1
        pending[request.seq] = _Sent(request, self._clock(), self._order)
        self._send(request)

    def _send(self, request: Packet) -> None:
        self._connection.send(FILE_TRANSFER_PROTOCOL, encode(self.system, COMPANION_COMPONENT, request))

    def _wait_s(self, pending: dict[int, _Sent]) -> float:
        """Until the first answer is overdue."""
        due_s = min((sent.at_s + self._pace.timeout_s(sent.sends) for sent in pending.values()), default=0.0)
        return min(_LOOK_S, max(0.0, due_s - self._clock()) + _GRAIN_S)

    def _repeat(self, pending: dict[int, _Sent], newest: int) -> None:
        """Send again what is overdue, or was overtaken by the answers to several later ones."""
        now_s = self._clock()
        for sent in pending.values():
            overtaken = sent.order + _OVERTAKEN_BY < newest
            if not overtaken:
                if now_s - sent.at_s < self._pace.timeout_s(sent.sends):
                    continue
                self._pace.overdue(now_s)
            self._order += 1
            sent.order = self._order
            sent.at_s = now_s
            sent.sends = sent.sends if overtaken else sent.sends + 1
            sent.sends = max(2, sent.sends)
            self._send(sent.request)

    def _reply(self, frame: Frame) -> Packet | None:
        """The answer in a frame, if it is one to us."""
        if frame.msgid != FILE_TRANSFER_PROTOCOL or (frame.sysid, frame.compid) != (self.system, COMPANION_COMPONENT):
            return None
        system, component, packet = decode(frame.payload)
        if (system, component) != (OWN_SYSTEM, OWN_COMPONENT) or packet.opcode not in {Opcode.ACK, Opcode.NAK}:
            return None
        return None if packet.size > DATA_MAX else packet


def find_system(
    connection: Connection, system: int | None, patience_s: float, clock: Callable[[], float] = time.monotonic
) -> int:
    """The system id of the vehicle whose companion answers.

    Args:
        connection: the link.
        system: the one that is wanted; None for the only one that there is.
        patience_s: how long to wait.
        clock: monotonic time [s].

    Raises:
        LinkError: nobody answers.
        InputError: several do.
    """
    request = Packet(random.randrange(SEQ_MODULUS), 0, Opcode.NONE, 0, 0, 0, 0, b"")
    payload = encode(system or 0, COMPANION_COMPONENT, request)
    begin_s = clock()
    asked_s = begin_s - _ASK_AGAIN_S
    end_s = begin_s + patience_s
    found: set[int] = set()
    while clock() < end_s:
        if clock() - asked_s >= _ASK_AGAIN_S:
            asked_s = clock()
            connection.send(FILE_TRANSFER_PROTOCOL, payload)
        for frame in connection.receive(min(_LOOK_S, max(0.0, end_s - clock()))):
            if frame.msgid != FILE_TRANSFER_PROTOCOL or frame.compid != COMPANION_COMPONENT:
                continue
            if decode(frame.payload)[:2] == (OWN_SYSTEM, OWN_COMPONENT) and (system or frame.sysid) == frame.sysid:
                if not found and system is None:  # another vehicle on the same link would answer about now
                    end_s = min(end_s, clock() + _LOOK_S)
                found.add(frame.sysid)
        if found and system is not None:
            break
    if len(found) > 1:
        names = ", ".join(str(number) for number in sorted(found))
        raise InputError(f"several vehicles answer (systems {names}): say which with --system")
    if not found:
        whom = "no companion" if system is None else f"no companion of system {system}"
        raise LinkError(f"{whom} answers within {patience_s:.0f} s; does `companion serve` run, and listen there?")
    return found.pop()
