"""A signed vehicle link: who becomes the peer, what is refused, and a vehicle whose time is in the past."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from companion.flight.bundled import free_udp_port
from companion.link import codec
from companion.link.framing import build_frame
from companion.link.key_file import new_key
from companion.link.signing import SETUP_SIGNING, Signer, SigningKey, SigningTimes, time_now
from companion.link.wire import TAP_IN, TAP_OUT, Wire

FORMATS = codec.message_formats()


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


@pytest.fixture
def key(tmp_path) -> SigningKey:
    return new_key(tmp_path / "key")


@pytest.fixture
def taped() -> list[tuple[int, bytes]]:
    return []


@pytest.fixture
def wire(tmp_path, key, taped) -> Iterator[Wire]:
    port = free_udp_port()
    with Wire.open(
        f"udpin:127.0.0.1:{port}", key=str(tmp_path / "key"), tap=lambda way, raw, _: taped.append((way, raw))
    ) as wire:
        wire.port = port  # type: ignore[attr-defined]
        yield wire


class Voice:
    """Somebody who sends to the wire."""

    def __init__(self, wire: Wire, key: SigningKey | None, at: int | None = None, system: int = 1) -> None:
        self.wire, self.system = wire, system
        self.signer = None if key is None else Signer(key, SigningTimes(time_now() if at is None else at, {}))
        if at is not None and self.signer is not None:
            self.signer._zero_ns = -(10**18)  # no clock, as PX4
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.3)
        self.address = self.socket.getsockname()

    def frame(self, msgid: int = codec.HEARTBEAT, payload: bytes | None = None, component: int = 1) -> bytes:
        payload = codec.encode_heartbeat(2, 12) if payload is None else payload
        return build_frame(msgid, payload, 0, self.system, component, FORMATS[msgid].crc_extra, self.signer)

    def say(self, *frames: bytes) -> list[int]:
        self.socket.sendto(b"".join(frames), ("127.0.0.1", self.wire.port))  # type: ignore[attr-defined]
        return [frame.msgid for frame in self.wire.receive(1.0)]

    def hears(self) -> bytes | None:
        try:
            return self.socket.recv(2048)
        except TimeoutError:
            return None

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def voice(wire) -> Iterator:
    made: list[Voice] = []

    def make(*args, **options) -> Voice:
        made.append(Voice(wire, *args, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_the_first_signed_heartbeat_of_an_autopilot_decides_who_the_peer_is(wire, voice, key):
    stranger, other, tool, vehicle = voice(None), voice(SigningKey(bytes(range(32)))), voice(key), voice(key)
    assert stranger.say(stranger.frame()) == []
    assert other.say(other.frame()) == []
    assert tool.say(tool.frame(component=191)) == []
    assert vehicle.say(vehicle.frame(codec.TIMESYNC, codec.encode_timesync(0, 5))) == []
    assert wire.peer is None
    heartbeat, state = vehicle.frame(), vehicle.frame(codec.TIMESYNC, codec.encode_timesync(0, 6))
    assert vehicle.say(heartbeat, state) == [codec.HEARTBEAT, codec.TIMESYNC]
    assert wire.peer == vehicle.address
    assert stranger.say(stranger.frame()) == []
    assert tool.say(tool.frame()) == []  # the right key, from elsewhere
    refused = wire.refusals
    assert (refused["unsigned"], refused["wrong_signature"], refused["replayed"]) == (1, 1, 0)
    assert (refused["other_address"], wire.counters.early) == (2, 2)


def test_a_radio_may_speak_unsigned_but_is_no_peer(wire, voice):
    radio = voice(None, system=51)
    assert radio.say(radio.frame(109, bytes(9), 68)) == []
    assert wire.peer is None


def test_only_the_named_vehicle_counts(wire, voice, key):
    wire.only_system = 7
    other, ours = voice(key, system=1), voice(key, system=7)
    assert other.say(other.frame()) == []
    assert ours.say(ours.frame()) == [codec.HEARTBEAT]
    assert wire.peer == ours.address


def test_a_vehicle_in_the_past_is_told_the_time(wire, voice, key):
    vehicle = voice(key, at=1000)
    assert vehicle.say(vehicle.frame()) == []
    assert wire.refusals["stale"] == 1
    greeting = vehicle.hears()
    assert greeting is not None
    assert codec.decode_heartbeat(greeting[10:19]).type == codec.MAV_TYPE_ONBOARD_CONTROLLER
    assert vehicle.signer.verify(greeting, codec.HEARTBEAT, True)  # PX4 takes the time over with this
    assert vehicle.say(vehicle.frame()) == [codec.HEARTBEAT]
    assert wire.peer == vehicle.address


def test_strangers_are_told_nothing(wire, voice, key):
    for stranger in (voice(None), voice(SigningKey(bytes(range(32))), at=1000)):
        assert stranger.say(stranger.frame()) == []
        assert stranger.hears() is None


def test_a_recording_tells_nothing_while_the_vehicle_is_there(wire, voice, key):
    vehicle = voice(key)
    raw = vehicle.frame()
    assert vehicle.say(raw) == [codec.HEARTBEAT]
    sent = wire.counters.sent
    assert vehicle.say(raw) == []
    assert (wire.refusals["replayed"], wire.counters.sent) == (1, sent)


def test_what_is_sent_is_signed_and_a_key_is_never_taped(wire, voice, key, taped):
    vehicle = voice(key)
    secret = bytes(range(100, 132))
    heartbeat, carrier = vehicle.frame(), vehicle.frame(SETUP_SIGNING, bytes(8) + b"\1\1" + secret)
    assert vehicle.say(heartbeat, carrier) == [codec.HEARTBEAT, SETUP_SIGNING]
    wire.send(codec.HEARTBEAT, codec.encode_heartbeat())
    wire.send(SETUP_SIGNING, bytes(8) + b"\1\1" + secret)
    sent = vehicle.hears()
    assert sent is not None
    assert vehicle.signer.verify(sent, codec.HEARTBEAT, True)
    wire.tell()
    assert [way for way, _ in taped] == [TAP_IN, TAP_OUT]
    assert not any(secret in raw for _, raw in taped)


def test_with_signatures_another_sender_at_the_port_gets_no_turn_by_being_there(wire, voice, key):
    vehicle, stranger = voice(key), voice(None)
    vehicle.say(vehicle.frame())
    stranger.say(stranger.frame())
    assert wire.try_another_peer()
    assert wire.peer is None
    assert stranger.say(stranger.frame()) == []
    assert wire.peer is None
