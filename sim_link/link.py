"""One MAVLink link of the vehicle: its encoder, its message intervals, and what waits to be sent on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .codec import AUTOPILOT_COMPONENT, ID_HEARTBEAT, Encoder
from .datagram_faults import LinkFaults
from .link_rates import GROUND_HZ, ONBOARD_HZ
from .signing import Keyring, LinkSigning

__all__ = ["GROUND_HZ", "ONBOARD_HZ", "Link", "Stream"]

_INT32_MAX = 2147483647


@dataclass(slots=True)
class Stream:
    """How often one message is sent."""

    default_us: int
    """PX4's interval on this kind of link; 0: not sent unless asked for."""
    interval_us: int
    """The present interval; 0: not sent."""
    due_us: int
    """Vehicle time of the next one."""


class Link:
    """A link without its socket: whoever owns the socket sends what gathers in `outbox`."""

    def __init__(
        self,
        system: int,
        rates_hz: Mapping[int, float],
        now_us: int,
        *,
        quiet: bool = False,
        keyring: Keyring | None = None,
        link_id: int = 0,
    ) -> None:
        self.signing = LinkSigning(keyring or Keyring(), link_id)
        """Whom of those who send on it to believe."""
        self.encoder = Encoder(system, AUTOPILOT_COMPONENT, self.signing)
        self.outbox: list[bytes] = []
        """Frames to send, one datagram each."""
        self.parameters_to_send: deque[str] = deque()
        """Names of a parameter list under way."""
        self.faults: LinkFaults | None = None
        """What happens to the datagrams on their way, while anything does: whoever owns the socket asks it."""
        self.quiet = quiet
        """Sends its heartbeat only, until somebody has spoken on it."""
        self.next_us = 0
        """Vehicle time before which nothing but the messages of every state is due."""
        self._period_us = 0
        self.every_state: list[int] = []
        """Messages of every state: all that there is to `due` before `next_us`."""
        self._now_and_then: list[tuple[int, Stream]] = []
        self.streams: dict[int, Stream] = {}
        for number, rate in rates_hz.items():
            interval = round(1e6 / rate) if rate > 0.0 else 0
            self.streams[number] = Stream(interval, interval, now_us)

    def send(self, message: Any) -> None:
        """Queue a pymavlink message."""
        self.outbox.append(self.encoder.cold(message))

    def send_hot(self, msg_id: int, payload: bytes) -> None:
        """Queue a message whose payload is packed already."""
        self.outbox.append(self.encoder.hot(msg_id, payload))

    def set_interval(self, msg_id: int, interval_us: int, now_us: int) -> bool:
        """Set a message's interval: above 0 that one, 0 PX4's default, below 0 never. False: no such message.

        HEARTBEAT is known but keeps its rate.
        """
        stream = self.streams.get(msg_id)
        if stream is None:
            return False
        if msg_id != ID_HEARTBEAT:
            stream.interval_us = stream.default_us if interval_us == 0 else min(max(interval_us, 0), _INT32_MAX)
            stream.due_us = now_us
            self.next_us = 0
        return True

    def interval_us(self, msg_id: int) -> int | None:
        """Give a message's interval as MESSAGE_INTERVAL has it: -1 when it is not sent; None: no such message."""
        stream = self.streams.get(msg_id)
        if stream is None:
            return None
        return stream.interval_us or -1

    def due(self, now_us: int, period_us: int) -> Sequence[int]:
        """Give the messages to send now; period_us is the time between two states.

        An interval of at most that period gives every state. A longer one keeps its rate on average, whatever the grid.
        """
        if now_us < self.next_us:
            return self.every_state
        if self.next_us == 0 or period_us != self._period_us:
            self._sort(period_us)
        ids = self.every_state.copy()
        next_us = now_us + _INT32_MAX
        for msg_id, stream in self._now_and_then:
            due_us = stream.due_us
            if now_us >= due_us:
                ids.append(msg_id)
                due_us += stream.interval_us
                if due_us <= now_us:
                    due_us = now_us + stream.interval_us
                stream.due_us = due_us
            if due_us < next_us:  # noqa: PLR1730 (not `min`: this is done for every stream of every state)
                next_us = due_us
        self.next_us = next_us
        return ids

    def _sort(self, period_us: int) -> None:
        """Tell the messages of every state from those that are due now and then."""
        self._period_us = period_us
        sent = [(i, s) for i, s in self.streams.items() if s.interval_us and (i == ID_HEARTBEAT or not self.quiet)]
        self.every_state = [msg_id for msg_id, stream in sent if stream.interval_us <= period_us]
        self._now_and_then = [(msg_id, stream) for msg_id, stream in sent if stream.interval_us > period_us]

    def speak(self) -> None:
        """End the silence of a quiet link: somebody is there."""
        if self.quiet:
            self.quiet = False
            self.next_us = 0
