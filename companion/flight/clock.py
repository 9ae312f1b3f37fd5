"""The vehicle's time as the companion knows it.

Vehicle time comes from TIMESYNC requests (the vehicle's clock at sending) and, before there were any, from state
stamps. Between messages it goes on with the companion's monotonic clock, unless the vehicle is in lockstep: then it
stands still until the next message. The time never steps back.
"""

from __future__ import annotations

from companion.link.timesync import PacedPeer

WINDOW_NS = 2_000_000_000
"""The least delayed TIMESYNC of about this long gives the offset: later ones waited somewhere."""


class VehicleClock:
    """Follows the vehicle's clock; one per link."""

    def __init__(self, peer: PacedPeer) -> None:
        self._peer = peer
        self.waits = False
        """Stands still between messages: until it is known whether the vehicle is in lockstep, no wall time may get in
        to what is its time in the end."""
        self._latest_s = 0.0
        self._offset_ns: int | None = None
        self._offset_wall_ns = 0
        self._last_wall_ns = 0

    @property
    def known(self) -> bool:
        """Whether the vehicle has told its time yet."""
        return self._offset_ns is not None

    def on_timesync(self, ts1_ns: int, wall_ns: int) -> None:
        """The vehicle's clock was `ts1_ns` when it sent what arrived at `wall_ns` (monotonic)."""
        offset = ts1_ns - wall_ns
        if (
            self._offset_ns is None
            or self._peer.paced
            or offset > self._offset_ns
            or wall_ns - self._offset_wall_ns > WINDOW_NS
        ):
            self._offset_ns, self._offset_wall_ns = offset, wall_ns
        self._advance(ts1_ns * 1e-9)
        self._last_wall_ns = wall_ns

    def on_state(self, t_vehicle_us: int, wall_ns: int) -> None:
        """A state arrived; its stamp is a lower bound of the time."""
        if self._offset_ns is None:
            self._offset_ns, self._offset_wall_ns = t_vehicle_us * 1000 - wall_ns, wall_ns
        self._advance(t_vehicle_us * 1e-6)
        self._last_wall_ns = wall_ns

    def now_s(self, wall_ns: int) -> float:
        """Vehicle time at a monotonic wall time [s]."""
        if self._offset_ns is not None and not (self._peer.paced or self.waits):
            self._advance((wall_ns + self._offset_ns) * 1e-9)
        return self._latest_s

    def silent_wall_s(self, wall_ns: int) -> float:
        """Wall time since the vehicle last told its time [s]."""
        return (wall_ns - self._last_wall_ns) * 1e-9

    def _advance(self, t_s: float) -> None:
        self._latest_s = t_s if t_s > self._latest_s else self._latest_s
