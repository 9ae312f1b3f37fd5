"""The traffic log: written entries, read by our reader and by pymavlink."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import ardupilotmega as mavlink1
from pymavlink.dialects.v20 import common as mavlink2

from companion.record.tlog import Direction, LoggedFrame, encode_datagrams, frame_length, read_tlog, split_frames

EPOCH_US = 1_750_000_000_123_456  # a multiple of four: the lowest bits hold the direction


def encoded(datagram: bytes, epoch_us: int, direction: Direction) -> bytes:
    """Of a datagram that came or went when the monotonic clock stood at 5 s."""
    wall_ns = 5_000_000_000
    return encode_datagrams([(wall_ns, direction, split_frames(datagram))], 1000 * epoch_us - wall_ns)


def sender(module=mavlink2, system: int = 1, component: int = 1):
    return module.MAVLink(None, srcSystem=system, srcComponent=component)


def heartbeat(link, module=mavlink2) -> bytes:
    return module.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link)


def signed_sender():
    link = sender()
    link.signing.secret_key = b"k" * 32
    link.signing.link_id = 1
    link.signing.timestamp = 1000
    link.signing.sign_outgoing = True
    return link


@pytest.mark.parametrize(
    "frame", [heartbeat(sender()), heartbeat(signed_sender()), heartbeat(sender(mavlink1), mavlink1)]
)
def test_frames_have_the_length_that_their_header_says(frame):
    assert frame_length(frame) == len(frame)
    assert split_frames(frame) == [frame]


def test_signed_frames_are_longer():
    assert len(heartbeat(signed_sender())) == len(heartbeat(sender())) + 13


def test_a_datagram_is_split_and_what_is_no_frame_is_left_out():
    first, second = heartbeat(sender()), heartbeat(sender(system=2))
    assert split_frames(b"xx" + first + b"\x00\x01" + second + first[:9]) == [first, second]
    assert split_frames(b"") == split_frames(b"no frame at all") == []
    assert frame_length(b"\xfd\x09") == 0
    assert encoded(b"junk", EPOCH_US, Direction.IN) == b""


@settings(max_examples=300, deadline=None)
@given(st.lists(st.sampled_from([0xFD, 0xFE, 0, 1, 2, 5, 13]), max_size=60).map(bytes))
def test_frames_are_found_by_their_lengths_alone(datagram: bytes):
    found, at = [], 0
    while at < len(datagram):
        length = frame_length(datagram[at:])
        whole = 0 < length <= len(datagram) - at
        if whole:
            found.append(datagram[at : at + length])
        at += length if whole else 1
    assert split_frames(datagram) == found


def test_an_entry_is_the_stamp_in_big_endian_and_the_frame():
    frame = heartbeat(sender())
    assert encoded(frame, EPOCH_US, Direction.IN) == EPOCH_US.to_bytes(8, "big") + frame
    assert encoded(frame, EPOCH_US + 1, Direction.OUT)[:8] == (EPOCH_US | 3).to_bytes(8, "big")


def test_our_reader_gives_back_what_was_written(tmp_path):
    path = tmp_path / "link.tlog"
    one, two = heartbeat(sender()), heartbeat(signed_sender())
    path.write_bytes(encoded(one + two, EPOCH_US, Direction.IN) + encoded(one, EPOCH_US + 40, Direction.OUT))
    assert list(read_tlog(path)) == [
        LoggedFrame(EPOCH_US, Direction.IN, one),
        LoggedFrame(EPOCH_US, Direction.IN, two),
        LoggedFrame(EPOCH_US + 40, Direction.OUT, one),
    ]


@pytest.mark.parametrize("cut", [1, 7, 9, 12, 20])
def test_a_log_that_is_cut_off_reads_up_to_there(tmp_path, cut):
    path = tmp_path / "link.tlog"
    entry = encoded(heartbeat(sender()), EPOCH_US, Direction.IN)
    path.write_bytes(entry * 3 + entry[:cut])
    assert len(list(read_tlog(path))) == 3


def test_pymavlink_reads_the_log(tmp_path):
    path = tmp_path / "link.tlog"
    vehicle, companion = sender(), sender(system=1, component=191)
    odometry = mavlink2.MAVLink_attitude_quaternion_message(1234, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3).pack(vehicle)
    answer = heartbeat(companion)
    with path.open("wb") as file:
        for index in range(50):
            file.write(encoded(b"?" + odometry + heartbeat(vehicle), EPOCH_US + 4000 * index, Direction.IN))
            file.write(encoded(answer, EPOCH_US + 4000 * index + 400, Direction.OUT))
    log = mavutil.mavlink_connection(str(path))
    messages = []
    while (message := log.recv_match()) is not None:
        messages.append(message)
    log.close()
    assert [message.get_type() for message in messages[:3]] == ["ATTITUDE_QUATERNION", "HEARTBEAT", "HEARTBEAT"]
    assert len(messages) == 150
    assert not any(message.get_type() == "BAD_DATA" for message in messages)
    assert messages[0]._timestamp == pytest.approx(EPOCH_US * 1e-6, abs=1e-6)
    assert [message._link for message in messages[:3]] == [0, 0, 3]
    assert messages[-1].get_srcComponent() == 191
    assert messages[-1]._timestamp == pytest.approx((EPOCH_US + 4000 * 49 + 400) * 1e-6, abs=5e-6)
