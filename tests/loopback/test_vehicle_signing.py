"""A vehicle that signs, with pymavlink on the other side as the judge."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from pymavlink import mavutil

from sim_link.codec import mavlink
from sim_link.running import RunningVehicle

KEY = bytes(range(32))
WITHIN_S = 20.0


@pytest.fixture
def signing(make_vehicle) -> RunningVehicle:
    return make_vehicle(key=KEY, state_rate_hz=50.0)


@pytest.fixture
def station(signing) -> Iterator[mavutil.mavfile]:
    connection = mavutil.mavlink_connection(signing.connection, source_system=254, source_component=190)
    yield connection
    connection.close()


def awaited(station, kind: str, condition=lambda message: True, within_s: float = WITHIN_S):
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        station.mav.heartbeat_send(18, 8, 0, 0, 4)
        message = station.recv_match(type=kind, blocking=True, timeout=0.2)
        if message is not None and condition(message):
            return message
    return None


def arm(station, confirmation=0) -> bytes:
    message = mavlink.MAVLink_command_long_message(1, 1, 400, confirmation, 1, 0, 0, 0, 0, 0, 0)
    raw = bytes(message.pack(station.mav))
    station.write(raw)
    return raw


def test_with_the_key_everything_works(signing, station):
    station.setup_signing(KEY)
    heartbeat = awaited(station, "HEARTBEAT")
    assert heartbeat is not None
    assert heartbeat.get_signed()
    signing.wait_until(lambda: signing.t_s > 1.0)
    raw = arm(station)
    ack = awaited(station, "COMMAND_ACK", lambda message: message.command == 400)
    assert ack is not None
    assert ack.get_signed()
    assert awaited(station, "ODOMETRY").get_signed()
    assert station.mav.signing.sig_count > 10
    before = sum(signing.signing_refused.values())
    station.write(raw)  # the same bytes again
    signing.wait_until(lambda: sum(signing.signing_refused.values()) > before)
    assert signing.signing_refused["repeated"] == 1


@pytest.mark.parametrize("key", [None, KEY[::-1]])
def test_without_the_right_key_nothing_is_obeyed(signing, station, key):
    if key is not None:
        station.setup_signing(key)
    awaited(station, "HEARTBEAT", within_s=0.5)
    signing.wait_until(lambda: signing.t_s > 1.0)
    for _ in range(5):
        arm(station)
    kind = "unsigned" if key is None else "wrong signature"
    signing.wait_until(lambda: signing.signing_refused[kind] >= 5)
    assert not signing.armed


def test_a_key_is_set_by_message(make_vehicle):
    vehicle = make_vehicle(state_rate_hz=50.0)
    station = mavutil.mavlink_connection(vehicle.connection, source_system=254, source_component=190)
    try:
        assert not awaited(station, "HEARTBEAT").get_signed()
        station.mav.setup_signing_send(1, 1, list(KEY), 10)
        station.setup_signing(KEY)
        assert awaited(station, "HEARTBEAT", lambda message: message.get_signed()) is not None
    finally:
        station.close()
