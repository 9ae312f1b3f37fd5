"""The parameter server at component 191 behind a UDP port, in a thread, for clients that know nothing of it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.config import load_vehicle
from companion.flight.bundled import free_udp_port
from companion.ground.links import GroundPort
from companion.ground.parameters import ParameterServer
from companion.ground.tuning import Tuning
from companion.link import codec


class Host:
    """A ground process with nothing but parameters in it, and a control process that takes every change."""

    def __init__(self, folder: Path) -> None:
        self.port = free_udp_port()
        self.texts: list[str] = []
        self._ground = GroundPort(f"udpin:127.0.0.1:{self.port}", lambda: 1)
        self._ground.open()
        self.server = ParameterServer(
            Tuning(load_vehicle("bundled")),
            folder / "parameters.toml",
            self,
            lambda text, good: self.texts.append(text),
            lambda: 1,
        )
        self._taken: list[int] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def request(self, number: int, what: str, **content: Any) -> bool:
        """Everything is taken, a moment later."""
        self._taken.append(number)
        return True

    def _run(self) -> None:
        beat_s = 0.0
        while not self._over.wait(0.005):
            now_s = time.monotonic()
            for frame, peer in self._ground.receive():
                self.server.handle(frame, peer, now_s)
            self.server.tick(now_s)
            taken, self._taken = self._taken, []
            for number in taken:
                self.server.on_taken(number, "", now_s)
            if now_s > beat_s:
                beat_s = now_s + 0.5
                for peer in self._ground.peers:
                    peer.send(codec.HEARTBEAT, codec.encode_heartbeat())

    def __enter__(self) -> Host:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self.server.close()
        self._ground.close()


@contextlib.contextmanager
def host(folder: Path) -> Iterator[Host]:
    """Runs one."""
    with Host(folder) as running:
        yield running
