"""The vehicle's signing against pymavlink's, both ways, and its keys."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_link.codec import AUTOPILOT_COMPONENT, ID_ATTITUDE_TARGET, ID_SETUP_SIGNING, Encoder, Frame, frames, mavlink
from sim_link.link import Link
from sim_link.signing import ONE_MINUTE, SETUP_SIGNING, STREAMS_MAX, KeyFileError, Keyring, LinkSigning, load_key
from sim_link.vehicle import Vehicle, VehicleError, VehicleOptions
from sim_link.vehicle_file import load

KEY = bytes(range(32))
TIMES = st.integers(0, 1 << 47)
LIBRARY = mavlink


def library(at, link_id=0, system=1, component=1, key=KEY):
    sender = LIBRARY.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.signing.secret_key = key
    sender.signing.timestamp, sender.signing.link_id, sender.signing.sign_outgoing = at, link_id, True
    return sender


def heartbeat(mav, mode=0) -> Frame:
    (frame,) = frames(bytes(LIBRARY.MAVLink_heartbeat_message(6, 8, 0, mode, 4, 3).pack(mav)))
    return frame


@settings(deadline=None)
@given(at=TIMES, link_id=st.integers(0, 255), system=st.integers(1, 255), payload=st.binary(min_size=37, max_size=37))
def test_hot_and_cold_frames_are_signed_as_the_library_signs_them(at, link_id, system, payload):
    ours = Encoder(system, AUTOPILOT_COMPONENT, LinkSigning(Keyring(KEY, at), link_id))
    theirs = library(at, link_id, system)
    message = LIBRARY.MAVLink_heartbeat_message(2, 12, 81, 7, 3, 3)
    assert ours.cold(message) == bytes(message.pack(theirs))
    theirs.seq = 1
    hot = ours.hot(ID_ATTITUDE_TARGET, payload)
    assert theirs.decode(bytearray(hot)).get_signed()
    assert hot[-13] == link_id
    assert int.from_bytes(hot[-12:-6], "little") == at + 1


@settings(deadline=None)
@given(
    first=TIMES,
    steps=st.lists(st.integers(-3, 3), max_size=5),
    ago=st.integers(-2 * ONE_MINUTE, 2 * ONE_MINUTE) | st.integers(-ONE_MINUTE - 2, -ONE_MINUTE + 2),
)
def test_agrees_with_the_library_on_what_is_too_old(first, steps, ago):
    ours, theirs = LinkSigning(Keyring(KEY, first), 0), library(first, system=9)
    at = max(0, first + ago)
    for step in (0, *steps):
        at = max(0, at + step)
        frame = heartbeat(library(at, 3))
        try:
            theirs.decode(bytearray(frame.raw))
            accepted = True
        except LIBRARY.MAVError:
            accepted = False
        assert ours.accepts(frame) == accepted


@settings(deadline=None)
@given(st.integers(1, 13), st.integers(1, 255))
def test_a_changed_signature_is_refused(byte, change):
    frame = heartbeat(library(5))
    raw = bytearray(frame.raw)
    raw[-byte] ^= change
    signing = LinkSigning(Keyring(KEY), 0)
    assert not signing.accepts(frame._replace(raw=bytes(raw)))
    assert not LinkSigning(Keyring(bytes(31) + b"x"), 0).accepts(frame)
    assert signing.accepts(frame)


def test_streams_are_shared_by_the_links_and_bounded():
    ring = Keyring(KEY)
    a, b = LinkSigning(ring, 0), LinkSigning(ring, 1)
    frame = heartbeat(library(5))
    assert a.accepts(frame)
    assert not b.accepts(frame)
    for link in range(1, STREAMS_MAX):
        assert b.accepts(heartbeat(library(5, link)))
    assert not b.accepts(heartbeat(library(5, 200)))
    ring.boot()
    assert a.accepts(frame)
    assert ring.refused == {"repeated": 1, "too old": 1}


def test_without_a_key_nothing_is_signed_and_everything_accepted():
    link = Link(1, {}, 0)
    link.send(LIBRARY.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
    assert link.outbox[0][2] == 0
    assert link.signing.accepts(heartbeat(LIBRARY.MAVLink(None)))


def vehicle(**options) -> Vehicle:
    return Vehicle(VehicleOptions(vehicle=load("paper"), engine="python", **options))


def setup(vehicle: Vehicle, key: bytes, initial: int, sender) -> list[str]:
    message = LIBRARY.MAVLink_setup_signing_message(1, 1, list(key), initial)
    (frame,) = frames(bytes(message.pack(sender)))
    assert frame.msg_id == ID_SETUP_SIGNING
    if vehicle.companion.signing.accepts(frame):
        vehicle.receive(frame, vehicle.companion)
    said = [sentence for _, sentence in vehicle.autopilot.texts]
    vehicle.autopilot.texts.clear()
    return said


def test_a_key_is_taken_while_disarmed_and_replaced_or_ended_by_signed_messages_only():
    ours = vehicle()
    assert setup(ours, KEY, 100, LIBRARY.MAVLink(None, 254, 190)) == ["signing: new key"]
    assert ours.keyring.key == KEY
    ours.heartbeat()
    (frame,) = frames(ours.companion.outbox[-1])
    assert library(90).decode(bytearray(frame.raw)).get_signed()
    assert setup(ours, bytes(32), 0, LIBRARY.MAVLink(None, 254, 190)) == []
    assert setup(ours, KEY[::-1], 5, LIBRARY.MAVLink(None, 254, 190)) == []
    assert setup(ours, KEY[::-1], 5, library(200, system=254, component=190, key=KEY[::-1])) == []
    assert ours.keyring.key == KEY
    assert setup(ours, KEY[::-1], 300, library(200, system=254, component=190)) == ["signing: new key"]
    assert ours.keyring.key == KEY[::-1]
    end = library(400, system=254, component=190, key=KEY[::-1])
    assert setup(ours, bytes(32), 0, end) == ["signing: off"]
    assert ours.keyring.key is None


def test_no_key_is_taken_while_armed():
    ours = vehicle(start=((0.0, 0.0, -10.0), 0.0))
    assert ours.autopilot.armed
    assert setup(ours, KEY, 100, LIBRARY.MAVLink(None, 254, 190)) == ["signing: no other key while armed"]
    assert ours.keyring.key is None
    signing = vehicle(start=((0.0, 0.0, -10.0), 0.0), signing_key=KEY)
    assert setup(signing, bytes(32), 0, library(10, system=254)) == ["signing: no other key while armed"]
    assert signing.keyring.key == KEY


def test_the_layout_of_the_message_is_the_librarys():
    message = LIBRARY.MAVLink_setup_signing_message(3, 4, list(KEY), 77)
    (frame,) = frames(bytes(message.pack(LIBRARY.MAVLink(None))))
    assert SETUP_SIGNING.unpack(frame.payload) == (77, 3, 4, KEY)


def test_a_boot_sets_the_time_back_to_the_keys():
    ours = vehicle(signing_key=KEY, signing_time=1000)
    assert ours.companion.signing.accepts(heartbeat(library(50_000)))
    ours.heartbeat()
    assert int.from_bytes(ours.companion.outbox[-1][-12:-6], "little") == 50_000
    ours.begin_boot()
    ours.finish_boot(1_000_000)
    ours.heartbeat()
    assert int.from_bytes(ours.companion.outbox[-1][-12:-6], "little") == 1000


def test_px4_1_13_knows_nothing_of_it():
    with pytest.raises(VehicleError, match=r"1\.13"):
        vehicle(px4="1.13", signing_key=KEY)
    assert setup(vehicle(px4="1.13"), KEY, 100, LIBRARY.MAVLink(None, 254, 190)) == []


@pytest.mark.parametrize(("content", "mode"), [(KEY, 0o640), (KEY[1:], 0o600), (bytes(32), 0o600), (b"z" * 64, 0o600)])
def test_key_files_that_are_refused(tmp_path: Path, content: bytes, mode: int):
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(mode)
    with pytest.raises(KeyFileError) as error:
        load_key(path)
    assert KEY.hex() not in str(error.value)
    with pytest.raises(KeyFileError):
        load_key(tmp_path / "none")


@pytest.mark.parametrize("content", [KEY, KEY.hex().encode() + b"\n"])
def test_key_files(tmp_path: Path, content: bytes):
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(0o600)
    key, at = load_key(path)
    assert key == KEY
    assert at > 0
