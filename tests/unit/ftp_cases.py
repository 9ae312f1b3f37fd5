"""A file server, clients of it, and a network between them that loses, repeats and reorders, on a clock of its own."""

from __future__ import annotations

import heapq
import random
from pathlib import Path

from companion.errors import RefusedError
from companion.ground.examine import Check, Here
from companion.ground.files import FileServer
from companion.ground.ftp import FILE_TRANSFER_PROTOCOL, Opcode, Packet, decode, encode
from companion.ground.store import DEFAULT_LIMITS, Limits, TrajectoryStore
from companion.link.framing import Frame

VEHICLE = 7
CLIENT = (254, 190)


def accepts(path: Path) -> str:
    """A check that refuses what has the word "bad" in it."""
    if b"bad" in path.read_bytes():
        raise RefusedError(f"{path.name}: asks for too much")
    return "may be flown"


def make_store(folder: Path, check: Check = accepts, limits: Limits = DEFAULT_LIMITS) -> TrajectoryStore:
    return TrajectoryStore(folder, Here(check), limits)


def killed(store: TrajectoryStore) -> None:
    """What the system does when the process of a store is killed: the lock is gone, all else stays as it is."""
    store._lock.release()


class Recorder:
    """A ground link that keeps what is sent."""

    def __init__(self, name: str = "udpin:127.0.0.1:14590") -> None:
        self.name = name
        self.sent: list[Packet] = []
        self.targets: list[tuple[int, int]] = []

    def send(self, msgid: int, payload: bytes) -> None:
        assert msgid == FILE_TRANSFER_PROTOCOL
        system, component, packet = decode(payload)
        assert len(payload) == 254
        self.targets.append((system, component))
        self.sent.append(packet)


def frame(payload: bytes, sender: tuple[int, int] = CLIENT, msgid: int = FILE_TRANSFER_PROTOCOL) -> Frame:
    return Frame(msgid, *sender, 0, payload, b"", 0)


class Raw:
    """A client that does as it is told."""

    def __init__(
        self, server: FileServer, sender: tuple[int, int] = CLIENT, link: Recorder | None = None, seq: int = 0
    ) -> None:
        self.server, self.sender, self.seq = server, sender, seq
        self.link = link or Recorder()
        self.now_s = 100.0

    def request(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        self.seq = fields.pop("seq", self.seq + 1)
        size = fields.pop("size", len(data))
        return Packet(self.seq, fields.get("session", 0), opcode, size, 0, 0, fields.get("offset", 0), data)

    def tell(self, opcode: int, data: bytes = b"", **fields: int) -> list[Packet]:
        """Send a request; gives what comes back at once."""
        before = len(self.link.sent)
        payload = encode(VEHICLE, 191, self.request(opcode, data, **fields))
        assert self.server.handle(frame(payload, self.sender), self.link, self.now_s)
        return self.link.sent[before:]

    def ask(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        (reply,) = self.tell(opcode, data, **fields)
        assert reply.seq == (self.seq + 1) % 65536
        assert reply.req_opcode == opcode
        return reply

    def granted(self, opcode: int, data: bytes = b"", **fields: int) -> Packet:
        reply = self.ask(opcode, data, **fields)
        assert reply.opcode == Opcode.ACK, reply
        return reply

    def refused(self, opcode: int, data: bytes = b"", **fields: int) -> tuple[int, ...]:
        reply = self.ask(opcode, data, **fields)
        assert reply.opcode == Opcode.NAK, reply
        assert reply.size == len(reply.data)
        return tuple(reply.data)

    def tick(self, seconds: float = 0.02) -> list[Packet]:
        before = len(self.link.sent)
        self.now_s += seconds
        self.server.tick(self.now_s)
        return self.link.sent[before:]

    def put(self, name: str, content: bytes, *, block: int = 239, session: int = 0) -> Packet:
        """Upload as MAVSDK does; gives the answer to TerminateSession."""
        self.granted(Opcode.CREATE_FILE, name.encode() + b"\0", session=session)
        for at in range(0, len(content), block):
            self.granted(Opcode.WRITE_FILE, content[at : at + block], session=session, offset=at)
        return self.ask(Opcode.TERMINATE_SESSION, session=session)

    def get(self, name: str, size: int = 239) -> bytes:
        """Download by bursts, as pymavlink does."""
        length = int.from_bytes(self.granted(Opcode.OPEN_FILE_RO, name.encode()).data, "little")
        content = b""
        while True:
            answers = self.tell(Opcode.BURST_READ_FILE, size=size, offset=len(content))
            while answers[-1].opcode == Opcode.ACK and not answers[-1].burst_complete:
                answers += self.tick()
            for i, answer in enumerate(answers):
                assert answer.seq == self.seq + 1 + i
                if answer.opcode == Opcode.NAK:
                    assert answer.data == b"\x06"
                    self.granted(Opcode.TERMINATE_SESSION)
                    assert len(content) == length
                    return content
                assert answer.offset == len(content)
                content += answer.data


class Network:
    """Between a client (`Connection`) and a file server; datagrams take their time, or get lost."""

    def __init__(
        self,
        server: FileServer | None,
        seed: int = 0,
        *,
        loss: float = 0.0,
        repeat: float = 0.0,
        delay_s: float = 0.004,
        jitter_s: float = 0.0,
        link: str = "udpin:127.0.0.1:14590",
    ) -> None:
        self.server = server
        self.name = link
        self.loss, self.repeat, self.delay_s, self.jitter_s = loss, repeat, delay_s, jitter_s
        self.now_s = 50.0
        self.carried = 0
        self.stop_after: int | None = None
        """From then on nothing arrives any more."""
        self._random = random.Random(seed)
        self._under_way: list[tuple[float, int, bool, bytes]] = []
        self._ticked_s = self.now_s
        self._count = 0

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.receive(end_s - self.now_s)

    def _post(self, to_server: bool, payload: bytes) -> None:
        for _ in range(1 + (self._random.random() < self.repeat)):
            self.carried += 1
            if self._random.random() < self.loss or (self.stop_after is not None and self.carried > self.stop_after):
                continue
            self._count += 1
            at_s = self.now_s + self.delay_s + self._random.random() * self.jitter_s
            heapq.heappush(self._under_way, (at_s, self._count, to_server, payload))

    def send(self, msgid: int, payload: bytes) -> bool:
        """The server sends as the link, the client as the connection; the targets tell which."""
        self._post(decode(payload)[1] == 191, payload)
        return True

    def receive(self, timeout_s: float) -> list[Frame]:
        end_s = self.now_s + timeout_s
        while True:
            due_s = min(self._ticked_s + 0.02, self._under_way[0][0] if self._under_way else end_s)
            if due_s > end_s:
                self.now_s = end_s
                return []
            self.now_s = max(self.now_s, due_s)
            if self.now_s >= self._ticked_s + 0.02:
                self._ticked_s = self.now_s
                if self.server is not None:
                    self.server.tick(self.now_s)
            if not self._under_way or self._under_way[0][0] > self.now_s:
                if self.now_s >= end_s:
                    return []
                continue
            _, _, to_server, payload = heapq.heappop(self._under_way)
            if not to_server:
                return [frame(payload, (VEHICLE, 191))]
            if self.server is not None:
                self.server.handle(frame(payload), self, self.now_s)
