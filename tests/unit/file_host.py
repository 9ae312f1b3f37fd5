"""A file server at component 191 behind a UDP socket, in a process of its own, for clients that know nothing of it.

    python file_host.py FOLDER [LOSS SEED]

prints the port that it listens at. Files with the word "bad" in them are refused.
"""

from __future__ import annotations

import contextlib
import json
import random
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ftp_cases import accepts

from companion.ground.examine import Here
from companion.ground.files import FileServer
from companion.ground.store import TrajectoryStore
from companion.link import codec
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame

SYSTEM = 1
STATUSTEXT = 253


class Peer:
    """A ground link to one address."""

    def __init__(self, sock: socket.socket, address: tuple[str, int], loss: float, chance: random.Random) -> None:
        self.name = f"{address[0]}:{address[1]}"
        self._socket, self._address = sock, address
        self._loss, self._chance = loss, chance
        self._seq = 0

    def send(self, msgid: int, payload: bytes) -> None:
        if self._loss and self._chance.random() < self._loss:
            return
        extra = codec.message_formats()[msgid].crc_extra
        with contextlib.suppress(OSError):
            self._socket.sendto(build_frame(msgid, payload, self._seq, SYSTEM, 191, extra), self._address)
        self._seq = (self._seq + 1) & 0xFF


def serve(folder: Path, loss: float, seed: int) -> None:
    """Serves until it is killed."""
    chance = random.Random(seed)
    peers: dict[tuple[str, int], Peer] = {}

    def say(text: str, accepted: bool) -> None:
        for peer in peers.values():
            peer.send(STATUSTEXT, bytes([6 if accepted else 4]) + text.encode()[:50].ljust(50, b"\0"))

    server = FileServer(TrajectoryStore(folder, Here(accepts)), say)
    parser = FrameParser(codec.message_formats(), LinkCounters())
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    print(json.dumps({"port": sock.getsockname()[1]}), flush=True)
    beat_s = 0.0
    while True:
        select.select([sock], [], [], 0.01)
        for _ in range(64):
            try:
                data, address = sock.recvfrom(2048)
            except OSError:
                break
            peer = peers.setdefault(address, Peer(sock, address, loss, chance))
            frames: list[Frame] = []
            parser.parse(data, 0, frames, [])
            for frame in frames:
                if not (loss and chance.random() < loss):
                    server.handle(frame, peer, time.monotonic())
        server.tick(time.monotonic())
        if time.monotonic() > beat_s:
            beat_s = time.monotonic() + 0.5
            for peer in peers.values():
                peer.send(codec.HEARTBEAT, codec.encode_heartbeat())


@contextlib.contextmanager
def host(folder: Path, loss: float = 0.0, seed: int = 0) -> Iterator[int]:
    """Runs one; gives its port."""
    command = [sys.executable, __file__, str(folder), str(loss), str(seed)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["port"]
        assert process.poll() is None, "the host ended by itself"
    finally:
        process.kill()
        _, errors = process.communicate(timeout=10)
    assert errors == ""


if __name__ == "__main__":
    serve(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
