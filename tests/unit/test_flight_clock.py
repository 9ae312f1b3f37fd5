"""The vehicle's time as the companion knows it."""

from __future__ import annotations

import pytest

from companion.flight.clock import VehicleClock
from companion.link.timesync import PacedPeer

MS = 1_000_000
S = 1_000_000_000


def paced() -> PacedPeer:
    peer = PacedPeer()
    peer.paced = True
    return peer


def test_unknown_until_told() -> None:
    clock = VehicleClock(PacedPeer())
    assert not clock.known
    clock.on_state(3_000_000, 100 * S)
    assert clock.known
    assert clock.now_s(100 * S) == pytest.approx(3.0)


def test_goes_on_between_messages() -> None:
    clock = VehicleClock(PacedPeer())
    clock.on_timesync(10 * S, 100 * S)
    assert clock.now_s(100 * S + 70 * MS) == pytest.approx(10.07)


def test_least_delayed_request_counts() -> None:
    """A request that waited on the way says less than one that came at once."""
    clock = VehicleClock(PacedPeer())
    clock.on_timesync(10 * S, 100 * S + 1 * MS)
    clock.on_timesync(10 * S + 100 * MS, 100 * S + 140 * MS)  # 40 ms late
    assert clock.now_s(100 * S + 201 * MS) == pytest.approx(10.2)
    clock.on_timesync(10 * S + 300 * MS, 100 * S + 300 * MS)  # 1 ms quicker than the first
    assert clock.now_s(100 * S + 400 * MS) == pytest.approx(10.4)


def test_clocks_that_drift_apart_are_followed() -> None:
    """After the window an offset counts although it is smaller: the companion's clock runs faster."""
    clock = VehicleClock(PacedPeer())
    for i in range(100):
        clock.on_timesync(10 * S + i * 100 * MS, 100 * S + i * 101 * MS)
    assert clock.now_s(100 * S + 99 * 101 * MS) - 19.9 < 0.025


def test_never_steps_back() -> None:
    clock = VehicleClock(PacedPeer())
    clock.on_timesync(10 * S, 100 * S)
    late = clock.now_s(101 * S)
    clock.on_timesync(2 * S, 104 * S)  # it was restarted
    assert clock.now_s(104 * S) >= late


def test_stands_still_with_a_vehicle_in_lockstep() -> None:
    clock = VehicleClock(paced())
    clock.on_timesync(10 * S, 100 * S)
    assert clock.now_s(103 * S) == 10.0
    assert clock.silent_wall_s(103 * S) == pytest.approx(3.0)
    clock.on_state(9_980_000, 103 * S)  # a state is older than the request after it
    assert clock.now_s(103 * S) == 10.0


def test_waits_for_the_vehicle_until_it_is_known_whether_that_is_in_lockstep() -> None:
    clock = VehicleClock(PacedPeer())
    clock.waits = True
    clock.on_state(10_000_000, 100 * S)
    assert clock.now_s(103 * S) == 10.0
    clock.waits = False
    assert clock.now_s(103 * S) == pytest.approx(13.0)
