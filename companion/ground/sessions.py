"""What the file server remembers of its clients: open files, bursts that are under way, and answers given."""

from __future__ import annotations

import contextlib
import os
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from companion.ground.checks import Submission
from companion.ground.ftp import Opcode, Packet
from companion.ground.service import GroundLink
from companion.ground.staging import Upload

ANSWERS_MAX: Final = 16
"""Answers that are remembered, per client."""
ANSWER_AGE_MAX_S: Final = 10.0
SAME_WISH_AGE_MAX_S: Final = 6.0
"""A client that repeats a request with a new sequence number does it within this time (MAVSDK: ten times 0.5 s)."""


class Reading:
    """An open file, or the index as it was when it was opened."""

    def __init__(self, fd: int | None, data: bytes, size: int) -> None:
        self.size = size
        """Bytes of the file."""
        self._fd = fd
        self._data = data

    def read(self, offset: int, size: int) -> bytes:
        """The bytes at an offset, as far as there are any.

        Raises:
            OSError: they cannot be read.
        """
        if self._fd is None:
            return self._data[offset : offset + size]
        return os.pread(self._fd, size, offset)

    def close(self) -> None:
        """Close the file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


@dataclass
class Burst:
    """Answers to BurstReadFile that are still to be sent."""

    seq: int
    """Of the next answer."""
    offset: int
    """Of the next answer's data."""
    size: int
    """Bytes of data per answer."""
    left: int
    """Answers until the client is to ask again."""


@dataclass(eq=False)
class Session:
    """One open file of one client."""

    number: int
    opened_by: Packet
    last_s: float
    reading: Reading | None = None
    upload: Upload | None = None
    used: bool = False
    """Whether anything was read or written."""
    burst: Burst | None = None


class Answer(NamedTuple):
    """An answer that was given."""

    request: Packet
    reply: Packet
    at_s: float


@dataclass(eq=False)
class Ending:
    """Uploads whose verdicts a client waits for, with the requests that are to be answered then."""

    opcode: int
    session: int
    submissions: list[Submission]
    answer_by_s: float
    """Then the answer is given without the verdict: the client would take the silence for a lost link."""
    requests: list[Packet] = field(default_factory=list)


@dataclass(eq=False)
class Client:
    """One tool: a system and component on a link."""

    system: int
    component: int
    link: GroundLink
    last_s: float
    sessions: dict[int, Session] = field(default_factory=dict)
    endings: list[Ending] = field(default_factory=list)
    _answers: OrderedDict[tuple[int, int, int, bytes], Answer] = field(default_factory=OrderedDict)

    def remember(self, request: Packet, reply: Packet, now_s: float) -> None:
        """Keep the answer to a request that must not be done twice."""
        key = _wish(request)
        self._answers.pop(key, None)
        self._answers[key] = Answer(request, reply, now_s)
        while len(self._answers) > ANSWERS_MAX:
            self._answers.popitem(last=False)

    def answered(self, request: Packet, now_s: float) -> Packet | None:
        """The answer that this very request got already, or the same wish with a new sequence number a moment ago."""
        found = self._answers.get(_wish(request))
        if found is None:
            return None
        same = found.request.seq == request.seq
        if now_s - found.at_s > (ANSWER_AGE_MAX_S if same else SAME_WISH_AGE_MAX_S):
            return None
        return found.reply._replace(seq=request.seq + 1)

    def last_seq(self, request: Packet) -> int | None:
        """The sequence number with which this was wished before."""
        found = self._answers.get(_wish(request))
        return None if found is None else found.request.seq

    def forget(self, *opcodes: Opcode) -> None:
        """Drop the answers to these operations: what they said is no longer so."""
        for key in [key for key in self._answers if key[0] in opcodes]:
            del self._answers[key]

    def pending(self, request: Packet) -> Ending | None:
        """What this request waits for, when it repeats one that is not answered yet."""
        for ending in self.endings:
            if ending.opcode == request.opcode and ending.session == request.session:
                return ending
        return None


def _wish(request: Packet) -> tuple[int, int, int, bytes]:
    return (request.opcode, request.session, request.offset, request.data)


def close_quietly(reading: Reading) -> None:
    """Close a file that was only read."""
    with contextlib.suppress(OSError):
        reading.close()


def burst_packet(session: Session, burst: Burst, data: bytes, *, failed: bool) -> Packet:
    """One answer of a burst; the last when nothing is left of it."""
    opcode = Opcode.NAK if failed else Opcode.ACK
    last = int(burst.left == 0)
    return Packet(burst.seq, session.number, opcode, len(data), Opcode.BURST_READ_FILE, last, burst.offset, data)
