"""TIMESYNC: answering the autopilot, measuring the offset to its clock, and noticing a vehicle that waits for us.

PX4 asks at 10 Hz with tc1 = 0 and ts1 = its time; the answer carries our time in tc1 and ts1 unchanged. Any tc1 above
0 is an answer. A vehicle in lockstep asks after every state and holds its clock until the answer comes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from companion.link.codec import Timesync, encode_timesync

PACED_STATES: Final = 10
"""Requests in a row that must have come, one after each state."""
PACED_INTERVAL_MAX_US: Final = 50_000
"""Requests further apart in the vehicle's time do not count: PX4's own come at 10 Hz."""


def is_request(message: Timesync, own_system: int, own_component: int) -> bool:
    """Whether this asks us for our time (requests without targets ask everybody)."""
    return message.tc1 == 0 and _for_us(message, own_system, own_component)


def is_response(message: Timesync, own_system: int, own_component: int) -> bool:
    """Whether this answers one of our requests, as far as its targets tell; compare ts1 with what was sent."""
    return message.tc1 > 0 and _for_us(message, own_system, own_component)


def _for_us(message: Timesync, own_system: int, own_component: int) -> bool:
    """Whether the targets are ours or everybody's."""
    _, _, system, component = message
    return (not system or system == own_system) and (not component or component == own_component)


def answer(request: Timesync, own_time_ns: int, requester_system: int, requester_component: int) -> bytes:
    """The payload that answers a request.

    Args:
        request: what was asked.
        own_time_ns: our clock now; must not be 0, which would be a request.
        requester_system: system id of the request's sender.
        requester_component: its component id.
    """
    return encode_timesync(own_time_ns if own_time_ns > 1 else 1, request.ts1, requester_system, requester_component)


def request(own_time_ns: int, target_system: int, target_component: int) -> bytes:
    """The payload that asks a vehicle for its time."""
    return encode_timesync(0, own_time_ns, target_system, target_component)


class ClockOffset(NamedTuple):
    """What one exchange says about the vehicle's clock."""

    offset_ns: int
    """Vehicle clock minus our clock, if both ways take equally long."""
    round_trip_ns: int
    """The offset is wrong by at most half of this."""


def clock_offset(response: Timesync, received_ns: int) -> ClockOffset:
    """Offset from an answer to our request; ts1 is our own time of sending, `received_ns` the same clock on its
    arrival."""
    round_trip_ns = received_ns - response.ts1
    return ClockOffset(response.tc1 - (response.ts1 + round_trip_ns // 2), round_trip_ns)


class PacedPeer:
    """Notices a vehicle in lockstep: it asks for our time after every state, far more often than PX4 does.

    Such a vehicle's clock stands still while we compute, so limits on silence in wall time may be generous. The
    requests alone are counted: their states may be lost, late or bunched on the way, the exchange that moves the clock
    is not. Once paced, a state from beyond the last request, or a gap between two requests, ends it.
    """

    def __init__(self, states: int = PACED_STATES) -> None:
        self._needed = states
        self._streak = 0
        self._asked_us: int | None = None
        self.paced = False
        """Whether the vehicle waits for our answers."""

    @property
    def asked_us(self) -> int | None:
        """The vehicle's time when it asked last [us]."""
        return self._asked_us

    @property
    def settled(self) -> bool:
        """Whether the next state changes nothing about it, if it comes in time."""
        return self.paced or self._streak < self._needed

    def on_state(self, t_vehicle_us: int) -> None:
        """A new state came, with its own stamp."""
        if self._asked_us is not None and t_vehicle_us - self._asked_us > PACED_INTERVAL_MAX_US:
            self._begin_anew()
        elif self._streak >= self._needed:
            self.paced = True  # with a state, before its time is mixed with that of the wall clock

    def on_request(self, ts1_ns: int) -> None:
        """A TIMESYNC request came from the vehicle, whose clock was `ts1_ns`."""
        asked_us = ts1_ns // 1000
        last_us, self._asked_us = self._asked_us, asked_us
        if last_us is not None and not 0 < asked_us - last_us <= PACED_INTERVAL_MAX_US:
            self._begin_anew()
        self._streak += 1

    def _begin_anew(self) -> None:
        self._streak = 0
        self.paced = False
