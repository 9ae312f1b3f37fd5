"""The offset between the autopilot's clock and ours, from TIMESYNC requests of our own.

An exchange with the shortest round trip was held up least, so of the last seconds that one counts. The offset that is
used follows slowly and never steps: with a step, states would seem older or younger from one moment to the next.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from companion.link.codec import Timesync
from companion.link.timesync import ClockOffset, clock_offset

WINDOW_NS: Final = 10_000_000_000
"""Of the exchanges within, the one with the shortest round trip counts."""
RECENT_NS: Final = 1_000_000_000
DRIFT: Final = 5e-5
"""How far two clocks may drift apart: an old exchange counts as longer by as much of its age."""
SLEW: Final = 1e-3
"""The offset follows by no more than this share of the time that passes."""
OUTSTANDING_MAX: Final = 50


class OffsetFilter:
    """Follows the offset of one link."""

    def __init__(self) -> None:
        self.round_trip_ns: int | None = None
        """Of the exchange that counts; the offset is wrong by at most half of it."""
        self.answered_ns: int | None = None
        """Our clock when the last answer came."""
        self.recent_ns: int | None = None
        """The offset by the last second alone, at once: for judging, not for flying by. A simulated autopilot's clock
        stalls with its machine, which the offset that is flown by follows too slowly to tell from old states."""
        self._asked: dict[int, None] = {}
        self._best = _Least(WINDOW_NS)
        self._recent = _Least(RECENT_NS)
        self._used_ns: float | None = None
        self._target_ns = 0
        self._at_ns = 0

    def asked(self, own_ns: int) -> None:
        """A request with this time in ts1 goes out."""
        if len(self._asked) >= OUTSTANDING_MAX:
            del self._asked[next(iter(self._asked))]
        self._asked[own_ns] = None

    def on_answer(self, message: Timesync, received_ns: int) -> bool:
        """Takes an answer; False when it is to none of our requests, or came already."""
        if message.ts1 not in self._asked:
            return False
        del self._asked[message.ts1]
        exchange = clock_offset(message, received_ns)
        # Of two exchanges the difference between what they count stays as they age.
        best = self._best.add(received_ns, exchange.round_trip_ns - DRIFT * received_ns, exchange)
        self.recent_ns = self._recent.add(received_ns, exchange.round_trip_ns, exchange).offset_ns
        self.offset_ns(received_ns)
        self.answered_ns = received_ns
        self.round_trip_ns, self._target_ns = best.round_trip_ns, best.offset_ns
        if self._used_ns is None:
            self._used_ns, self._at_ns = float(best.offset_ns), received_ns
        return True

    def settle(self) -> None:
        """Takes the best offset at once: before a flight, when nothing depends on it yet."""
        if self._used_ns is not None:
            self._used_ns = float(self._target_ns)

    def offset_ns(self, own_ns: int) -> int | None:
        """The autopilot's clock less ours, at a time of ours; None before the first answer."""
        if self._used_ns is None:
            return None
        most = SLEW * max(0, own_ns - self._at_ns)
        self._used_ns += min(max(self._target_ns - self._used_ns, -most), most)
        self._at_ns = max(own_ns, self._at_ns)
        return round(self._used_ns)


class _Least:
    """The least of what came within a window; of equal ones the oldest.

    Args:
        window_ns: how long something counts.
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._kept: deque[tuple[int, float, ClockOffset]] = deque()
        """When it came, what it is judged by, and what it is; each is less than all that came after it."""

    def add(self, at_ns: int, value: float, exchange: ClockOffset) -> ClockOffset:
        """Takes another one; returns the least within the window."""
        kept = self._kept
        while kept and kept[-1][1] > value:
            kept.pop()
        kept.append((at_ns, value, exchange))
        while at_ns - kept[0][0] > self._window_ns:
            kept.popleft()
        return kept[0][2]
