"""Who is taken for a ground tool at a ground link with a key, and who is not."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.flight.bundled import free_udp_port
from companion.ground.links import PEERS_MAX, GroundPort
from companion.ground.settings import GROUND_SYSTEMS
from companion.link import codec
from companion.link.framing import build_frame
from companion.link.signing import Signer, SigningKey, SigningTimes, time_now

KEY = SigningKey(bytes(range(32)))


def signer() -> Signer:
    return Signer(KEY, SigningTimes(time_now(), {}))


def radio_status(magic: int) -> bytes:
    """As anybody can write it, of a ground station's system."""
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    return bytes(mavlink.MAVLink_radio_status_message(*(1,) * 7).pack(station, force_mavlink1=magic == 0xFE))


def heartbeat(guard: Signer | None) -> bytes:
    crc_extra = codec.message_formats()[codec.HEARTBEAT].crc_extra
    return build_frame(codec.HEARTBEAT, codec.encode_heartbeat(), 0, 255, 190, crc_extra, guard)


class Place:
    """A ground link of this machine."""

    def __init__(self, guard: Signer | None) -> None:
        self._number = free_udp_port()
        self.port = GroundPort(f"udpin:127.0.0.1:{self._number}", lambda: 1, guard, frozenset(GROUND_SYSTEMS))
        self.port.open()
        self._socks: list[socket.socket] = []

    def hears(self, raw: bytes) -> list[int]:
        """What it makes of a datagram from an address of its own."""
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socks.append(sock)
        sock.sendto(raw, ("127.0.0.1", self._number))
        time.sleep(0.01)
        return [frame.msgid for frame, _ in self.port.receive()]

    def close(self) -> None:
        self.port.close()
        for sock in self._socks:
            sock.close()


@pytest.fixture
def place() -> Iterator[Place]:
    place = Place(signer())
    yield place
    place.close()


@pytest.mark.parametrize("magic", [0xFD, 0xFE])
def test_an_unsigned_radio_status_makes_no_peer(place: Place, magic: int) -> None:
    raw = radio_status(magic)
    assert raw[0] == magic
    assert place.hears(raw) == []
    assert place.port.peers == []


def test_outsiders_put_no_tool_out(place: Place) -> None:
    operator = signer()
    assert place.hears(heartbeat(operator)) == [codec.HEARTBEAT]
    (tool,) = place.port.peers
    for _ in range(PEERS_MAX + 1):
        place.hears(radio_status(0xFD))
        place.hears(heartbeat(None))
    assert place.port.peers == [tool]


def test_beside_a_signed_frame_an_unsigned_one_is_left_out(place: Place) -> None:
    assert place.hears(radio_status(0xFD) + heartbeat(signer())) == [codec.HEARTBEAT]
    assert len(place.port.peers) == 1


def test_without_a_key_everybody_is_a_peer() -> None:
    open_place = Place(None)
    assert open_place.hears(radio_status(0xFD)) == [109]
    assert open_place.hears(heartbeat(None)) == [codec.HEARTBEAT]
    assert len(open_place.port.peers) == 2
    open_place.close()
