"""The ground links of one process, waited on together; one that is gone is opened again and takes no other one along.

An adapter is unplugged, a network goes down: what is left must go on, and what comes back must be heard again.
"""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Iterator
from typing import Final

from companion.errors import CompanionError, LinkError
from companion.ground.links import GroundPort, Peer
from companion.link.framing import Frame

RETRY_S: Final = 2.0
_TRYING_SHARE: Final = 0.1
"""Of the time at most: a host name that nobody knows any more can take seconds to find that out."""


class Ports:
    """The ports, open or gone for now.

    Args:
        ports: not opened yet.
        poll: gets those that are open, and loses those that are gone.
        say: gets a sentence for people and whether it is a good one.
    """

    def __init__(self, ports: list[GroundPort], poll: select.poll, say: Callable[[str, bool], None]) -> None:
        self._ports = ports
        self._poll = poll
        self._say = say
        self._open: list[GroundPort] = []
        self._retry_s = 0.0

    def open(self, *, all_of_them: bool) -> None:
        """Opens them for the first time.

        Args:
            all_of_them: one that cannot be opened ends it: somebody may have mistyped its name. Otherwise it is tried
                again and again.

        Raises:
            InputError, LinkError: one cannot be opened.
        """
        for port in self._ports:
            try:
                self._begin(port)
            except CompanionError as error:
                if all_of_them:
                    raise
                self._say_gone(port, error)

    def receive(self) -> Iterator[tuple[Frame, Peer]]:
        """Every good frame that is there."""
        for port in list(self._open):
            try:
                found = port.receive()
            except LinkError as error:
                self._open.remove(port)
                with contextlib.suppress(KeyError, ValueError, OSError):
                    self._poll.unregister(port.fileno())
                port.close()
                self._say_gone(port, error)
                continue
            yield from found

    def tick(self, now_s: float) -> None:
        """Forgets tools that have gone, and tries now and then to open what is gone."""
        for port in self._open:
            port.forget_silent(now_s)
        if len(self._open) == len(self._ports) or now_s < self._retry_s:
            return
        begun_s = time.monotonic()
        for port in self._ports:
            if port not in self._open:
                with contextlib.suppress(CompanionError, OSError):  # why was said when it went
                    self._begin(port)
                    self._say(f"the ground link {port.connection} is back", True)
        self._retry_s = now_s + max(RETRY_S, (time.monotonic() - begun_s) / _TRYING_SHARE)

    def close(self) -> None:
        """Closes all of them."""
        for port in self._open:
            port.close()

    def _begin(self, port: GroundPort) -> None:
        port.open()
        self._poll.register(port.fileno(), select.POLLIN)
        self._open.append(port)

    def _say_gone(self, port: GroundPort, error: CompanionError) -> None:
        self._say(f"the ground link {port.connection} is gone and is tried again: {error}", False)
