"""What comes in on one socket, message by message, and how much of it is acted on before the next state.

A flood of requests must not hold up the vehicle's own time. So every state has an allowance: a datagram, a message and
an answer count one each, and what is beyond waits in the socket until the next state, or is lost there, as with any
receiver that is asked too much.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from .codec import Frame
from .datagram_faults import LinkFaults
from .udp import Address, UdpEndpoint
from .waiting import Waiter

ALLOWANCE_PER_S = 5000.0
"""Of each socket, in wall time. A companion with setpoints at 250 Hz uses about 800 of it."""
ALLOWANCE_LEAST = 8
"""Per state, however fast they follow one another."""


def allowance(state_period_s: float, sharers: int = 1) -> int:
    """Give the allowance of one state; state_period_s: wall time between two, sharers: vehicles on the same core."""
    return max(ALLOWANCE_LEAST, round(ALLOWANCE_PER_S * state_period_s / sharers))


def _other(datagram: bytes) -> bool:
    """Obey nothing."""
    return False


class Intake:
    """The messages of one socket, which is waited for while more of them may be acted on."""

    def __init__(self, endpoint: UdpEndpoint, waiter: Waiter, per_state: int) -> None:
        self._endpoint = endpoint
        self._waiter = waiter
        self._listens = False
        self._per_state = per_state
        self.left = per_state
        """What is left of it; whoever acts on a message takes its answers off."""
        self._pending: deque[Frame] = deque()
        """Of a datagram that was begun."""
        self._sender: Address = ("", 0)

        self.listen()

    def listen(self) -> None:
        """Let the socket end a wait."""
        if not self._listens:
            self._listens = True
            self._waiter.register(self._endpoint.descriptor)

    def ignore(self) -> None:
        """Let the socket end no wait."""
        if self._listens:
            self._listens = False
            self._waiter.unregister(self._endpoint.descriptor)

    def refill(self) -> None:
        """Begin a new state."""
        self.left = self._per_state
        if not self._listens:
            self.listen()

    def rest(self) -> None:
        """Ignore the socket until the next state, if the allowance is used up."""
        if self.left <= 0:
            self.ignore()

    def next(
        self, faults: LinkFaults | None, obeyed: Callable[[bytes], bool] = _other, *, once: bool = False
    ) -> tuple[Frame, Address] | None:
        """Give the next message and its sender; None when nothing is there, or the allowance is used up. Never blocks.

        Args:
            faults: what happens to datagrams on their way in.
            obeyed: is shown a datagram as it came, and may act on the one message in it itself: then it says so.
            once: leave it at the first that was obeyed. Seldom is there another one, the next wait tells of it, and to
                look in vain costs more than that.
        """
        pending, left = self._pending, self.left
        while not pending:
            if left <= 0:
                return None
            taken = self._endpoint.take()
            if taken is None:
                return None
            left = self.left = left - 1
            if left > 0 and obeyed(taken[0]):
                left = self.left = left - 1
                if once:
                    return None
                continue
            found, self._sender = self._endpoint.read(*taken)
            pending.extend(found if faults is None else faults.incoming(found))
        if left <= 0:
            return None
        self.left = left - 1
        return pending.popleft(), self._sender

    def take_pending(self) -> tuple[list[Frame], Address] | None:
        """Give what is left of the datagram that was begun; None: nothing."""
        if not self._pending:
            return None
        found = list(self._pending)
        self._pending.clear()
        return found, self._sender
