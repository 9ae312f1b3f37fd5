"""Waiting for sockets to the microsecond: a poll rounds its timeout up to milliseconds, and a state would be late."""

from __future__ import annotations

import math
import select

_SELECT_MAX = 1024
"""Descriptors from here on `select` cannot take (FD_SETSIZE): for those the poll's milliseconds have to do."""


class Waiter:
    """Some sockets, and the wait for any of them."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._descriptors: set[int] = set()
        self._exact = True

    def register(self, descriptor: int) -> None:
        """Let this one end a wait."""
        self._poll.register(descriptor, select.POLLIN)
        self._descriptors.add(descriptor)
        self._exact = self._exact and descriptor < _SELECT_MAX

    def unregister(self, descriptor: int) -> None:
        """Let this one end no wait any more."""
        self._poll.unregister(descriptor)
        self._descriptors.discard(descriptor)

    def wait(self, timeout_s: float) -> list[int]:
        """Wait until something is received, or for some time; gives the descriptors that have something.

        It may end early with nothing, by less than a millisecond (late, where descriptors are many): who waits for a
        time looks at the clock and waits again.
        """
        if 0.0 < timeout_s < 0.001 and self._exact:
            return select.select(self._descriptors, (), (), timeout_s)[0]
        whole_ms = int(timeout_s * 1e3) if self._exact else math.ceil(timeout_s * 1e3)
        return [descriptor for descriptor, _ in self._poll.poll(max(0, whole_ms))]
