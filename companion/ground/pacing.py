"""How fast bursts go out: a bucket of messages per link, so that a transfer leaves room for the rest."""

from __future__ import annotations

from typing import Final

MESSAGE_BYTES: Final = 280
"""Of one full FTP message with its framing and the network's."""
FAST_BYTES_S: Final = 400_000.0
"""Networks."""
SLOW_BYTES_S: Final = 3_000.0
"""The way through the autopilot's radio: half of a telemetry radio of 57600 baud."""
DEPTH: Final = 8.0
"""Messages that may go out at once."""
THROUGH_AUTOPILOT: Final = "vehicle"
"""Name of the link that ends in the autopilot's radio (`service.GroundLink.name`)."""
_LINKS_MAX = 64


class Pace:
    """A token bucket for every link."""

    def __init__(self) -> None:
        self._buckets: dict[str, tuple[float, float]] = {}
        """Messages that may go out, and when that was computed [s], by link."""

    def take(self, link: str, now_s: float) -> bool:
        """Whether one more message may go out on a link now."""
        per_s = (SLOW_BYTES_S if link == THROUGH_AUTOPILOT else FAST_BYTES_S) / MESSAGE_BYTES
        left, since_s = self._buckets.get(link, (DEPTH, now_s))
        left = min(DEPTH, left + max(0.0, now_s - since_s) * per_s)
        if left < 1.0:
            self._buckets[link] = (left, now_s)
            return False
        if link not in self._buckets and len(self._buckets) >= _LINKS_MAX:
            self._buckets.clear()
        self._buckets[link] = (left - 1.0, now_s)
        return True
