"""The simulated vehicle's own codec against pymavlink, byte for byte."""

import math
import random
import struct

import pytest
from pymavlink.dialects.v20 import development as mavlink

from sim_link import codec

ODOMETRY = (123456789, 1, 1, 1.5, -2.5, -20.25, [1.0, 0.0, 0.0, 0.0], 0.1, 0.2, 0.3, 0.0, -0.5, 0.25)


def covariance(value):
    return [value if i in (0, 6, 11, 15, 18, 20) else 0.0 for i in range(21)]


def odometry_payload(reset, quality):
    matrices = codec.COVARIANCE.pack(*covariance(4e-6)) + codec.COVARIANCE.pack(*covariance(2.5e-5))
    numbers = (ODOMETRY[0], *ODOMETRY[3:6], *ODOMETRY[6], *ODOMETRY[7:])
    return codec.ODOMETRY_STATE.pack(*numbers) + codec.ODOMETRY_REST.pack(matrices, 1, 1, reset, 8, quality)


def cases():
    zero = (0.0, 0.0, 0.0, 0.0)
    yield (
        331,
        odometry_payload(0, 0),
        mavlink.MAVLink_odometry_message(*ODOMETRY, covariance(4e-6), covariance(2.5e-5), 0, 8),
    )
    yield (
        331,
        odometry_payload(3, 50),
        mavlink.MAVLink_odometry_message(*ODOMETRY, covariance(4e-6), covariance(2.5e-5), 3, 8, 50),
    )
    q = (0.5, -0.5, 0.5, 0.5)
    yield (
        31,
        codec.ATTITUDE_QUATERNION.pack(7, *q, 0.1, 0.2, 0.3, *zero),
        mavlink.MAVLink_attitude_quaternion_message(7, *q, 0.1, 0.2, 0.3),
    )
    for last in (0.0, 0.5):  # a trailing zero is cut off
        yield (
            32,
            codec.LOCAL_POSITION_NED.pack(7, 1.0, 2.0, -3.0, 0.1, 0.2, last),
            mavlink.MAVLink_local_position_ned_message(7, 1.0, 2.0, -3.0, 0.1, 0.2, last),
        )
    yield 111, codec.TIMESYNC.pack(0, 0, 0, 0), mavlink.MAVLink_timesync_message(0, 0)
    yield 111, codec.TIMESYNC.pack(0, 4000000, 0, 0), mavlink.MAVLink_timesync_message(0, 4000000)
    yield 111, codec.TIMESYNC.pack(5, -1, 0, 0), mavlink.MAVLink_timesync_message(5, -1)
    yield (
        83,
        codec.ATTITUDE_TARGET.pack(9, *q, 0.1, 0.2, 0.3, 0.5, 0),
        mavlink.MAVLink_attitude_target_message(9, 0, q, 0.1, 0.2, 0.3, 0.5),
    )
    yield (
        33,
        codec.GLOBAL_POSITION_INT.pack(9, 473977420, 85455940, 489400, 20000, 1, -2, 3, 35999),
        mavlink.MAVLink_global_position_int_message(9, 473977420, 85455940, 489400, 20000, 1, -2, 3, 35999),
    )
    yield (
        115,
        codec.HIL_STATE_QUATERNION.pack(9, *q, 0.1, 0.2, 0.3, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, -1000),
        mavlink.MAVLink_hil_state_quaternion_message(9, q, 0.1, 0.2, 0.3, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, -1000),
    )


@pytest.mark.parametrize(("msg_id", "payload", "message"), list(cases()))
def test_hot_messages_are_pymavlink_s_bytes(msg_id, payload, message):
    ours, theirs = codec.Encoder(3, 1), mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
    for sequence in (0, 1):
        theirs.seq = sequence
        assert ours.hot(msg_id, payload) == bytes(message.pack(theirs))
    theirs.seq = 2
    assert ours.cold(message) == bytes(message.pack(theirs)), "one sequence for both kinds"


def test_the_sequence_wraps():
    ours = codec.Encoder(1, 1)
    for _ in range(256):
        ours.hot(111, codec.TIMESYNC.pack(1, 1, 0, 0))
    assert ours.sequence == 0


def setpoint(mask, sequence=0, **fields):
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    mav.seq = sequence
    values = {"q": (1.0, 0.0, 0.0, 0.0), "rates": (0.1, 0.2, 0.3), "thrust": 0.5} | fields
    message = mavlink.MAVLink_set_attitude_target_message(
        11, 1, 1, mask, values["q"], *values["rates"], values["thrust"]
    )
    return bytes(message.pack(mav))


def test_set_attitude_target_is_read():
    (frame,) = codec.frames(setpoint(132, rates=(0.5, -0.25, math.inf)))
    assert (frame.msg_id, frame.system, frame.component) == (82, 1, 191)
    message = codec.attitude_target(frame.payload)
    assert (message.target_system, message.target_component, message.type_mask) == (1, 1, 132)
    assert message.rates == (0.5, -0.25, math.inf)
    assert message.thrust == 0.5
    assert message.thrust_body == (0.0, 0.0, 0.0)


def test_thrust_body_and_fields_of_the_future_are_read():
    payload = codec.SET_ATTITUDE_TARGET.pack(0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 1, 160, 0.0, 0.0, -0.5)
    assert codec.attitude_target(payload).thrust_body == (0.0, 0.0, -0.5)
    assert codec.attitude_target(payload + b"\1\2\3").thrust_body == (0.0, 0.0, -0.5)
    assert codec.timesync(struct.pack("<qqBB", 5, 6, 1, 191)) == (5, 6)


def test_actuator_controls_are_read():
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    sent = [0.5, -0.25, 0.125, 0.75, 0.0, 0.0, 0.0, 0.0]
    (frame,) = codec.frames(bytes(mavlink.MAVLink_set_actuator_control_target_message(0, 2, 1, 1, sent).pack(mav)))
    message = codec.actuator_controls(frame.payload)
    assert (message.group, message.controls) == (2, tuple(sent))


def test_mavlink_1_and_signed_frames_are_read():
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    heartbeat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    assert [f.msg_id for f in codec.frames(bytes(heartbeat.pack(mav, force_mavlink1=True)))] == [0]
    mav.signing.secret_key = b"k" * 32
    mav.signing.sign_outgoing = True
    signed = bytes(heartbeat.pack(mav))
    found = codec.frames(signed + setpoint(7))
    assert [f.msg_id for f in found] == [0, 82]
    assert codec.Decoder().message(found[0]).type == 18


def test_frames_one_after_the_other_are_read_whatever_stands_between_them():
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    heartbeat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    plain, version_1 = bytes(heartbeat.pack(mav)), bytes(heartbeat.pack(mav, force_mavlink1=True))
    mav.signing.secret_key = b"k" * 32
    mav.signing.sign_outgoing = True
    signed = bytes(heartbeat.pack(mav))
    broken = bytes((*plain[:-1], plain[-1] ^ 1))
    good = (setpoint(7), plain, version_1, signed)
    for between in (b"", b"\xfd", b"noise", broken, broken + signed[:9]):
        for first in good:
            for second in good:
                found = codec.frames(plain + first + between + second + setpoint(128) + between)
                assert [f.raw for f in found] == [plain, first, second, setpoint(128)]
                assert all(f.raw[-2:] == f.raw[10 + len(f.payload) :] for f in found if f.raw in (plain, setpoint(7)))


def test_what_is_no_message_is_passed_over():
    good = setpoint(128)
    assert codec.frames(b"") == []
    for length in range(len(good)):
        assert codec.frames(good[:length]) == []
    for at in range(len(good)):
        broken = bytearray(good)
        broken[at] ^= 0x10
        assert codec.frames(bytes(broken)) == []
    assert len(codec.frames(b"\xfd\x05noise" + good + b"\xfe" + good)) == 2
    unknown = bytearray(good)
    unknown[7:10] = b"\xff\xff\xff"
    assert codec.frames(bytes(unknown)) == []


def test_random_bytes_never_raise():
    draw = random.Random(1)
    for _ in range(2000):
        codec.frames(bytes(draw.choices((0xFD, 0xFE, 0, 1, 9, 82, 255), k=draw.randrange(60))))


def usual_datagrams():
    encoder = codec.Encoder(1, 191)
    fields = (7, 1.0, 0.0, 0.0, 0.0, 0.1, -0.2, 0.3, 0.5, 1, 1, 128, 0.0, 0.0, 0.0)
    setpoint = encoder.hot(codec.ID_SET_ATTITUDE_TARGET, codec.SET_ATTITUDE_TARGET.pack(*fields))
    return setpoint, encoder.hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(10**18, 123456789000, 1, 1))


def test_usual_datagrams_are_read_at_once_and_as_frame_by_frame():
    setpoint, answer = usual_datagrams()
    payload = codec.frames(setpoint)[0].payload
    assert codec.lone_setpoint(setpoint) == payload
    assert codec.exchange(setpoint + answer) == (payload, codec.timesync(codec.frames(answer)[0].payload)[1])


def test_whatever_is_not_quite_the_usual_datagram_goes_the_general_way():
    setpoint, answer = usual_datagrams()
    both = setpoint + answer
    for at in range(len(both)):
        broken = both[:at] + bytes((both[at] ^ 4,)) + both[at + 1 :]
        assert codec.exchange(broken) is None
        if at < len(setpoint):
            assert codec.lone_setpoint(broken[: len(setpoint)]) is None
    asked = codec.Encoder(1, 191).hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(0, 123456789000, 1, 1))
    for other in (b"", setpoint, answer, answer + setpoint, both + answer, both[:-1], setpoint + asked):
        assert codec.exchange(other) is None
    for other in (b"", answer, both, setpoint[:-1]):
        assert codec.lone_setpoint(other) is None
