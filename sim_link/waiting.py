"""Waiting for sockets to the microsecond: a poll's timeout are whole milliseconds, and a state would be late."""

from __future__ import annotations

import math
import select

_SELECT_MAX = 1024
"""Descriptors from here on `select` cannot take (FD_SETSIZE): for those the poll's milliseconds have to do."""


class Waiter:
    """Some sockets, and the wait for any of them."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._descriptors: list[int] = []
        self._exact = True

    def register(self, descriptor: int) -> None:
        """Let this one end a wait."""
        self._poll.register(descriptor, select.POLLIN)
        self._descriptors.append(descriptor)
        self._exact = self._exact and descriptor < _SELECT_MAX

    def unregister(self, descriptor: int) -> None:
        """Let this one end no wait any more."""
        self._poll.unregister(descriptor)
        self._descriptors.remove(descriptor)

    def wait(self, timeout_s: float) -> list[int]:
        """Wait until something is received, or for some time; gives the descriptors that have something.

        Where descriptors are many it may end late, by less than a millisecond.
        """
        timeout_s = max(0.0, timeout_s)
        if self._exact:
            return select.select(self._descriptors, (), (), timeout_s)[0]
        return [descriptor for descriptor, _ in self._poll.poll(math.ceil(timeout_s * 1e3))]
