"""Messages, intervals, parameters, commands and the link rules of the simulated vehicle."""

import itertools
import math
import random
import struct

import pytest
from vehicle_tools import HOLD, IN_AIR, Companion, Flight, free_socket, mavlink, vehicle_file

ACK = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
FAILED = mavlink.MAV_RESULT_FAILED


def test_default_rates_are_those_of_an_onboard_link():
    with Flight(file=vehicle_file(250.0)) as c:
        for name in ("ODOMETRY", "CURRENT_MODE", "EXTENDED_SYS_STATE"):
            assert c.interval(name, 0) == ACK
        c.log.clear()
        c.run(4.0)
        expected = {
            "HEARTBEAT": 1,
            "ODOMETRY": 30,
            "ATTITUDE_QUATERNION": 50,
            "LOCAL_POSITION_NED": 30,
            "GLOBAL_POSITION_INT": 50,
            "SYS_STATUS": 5,
            "EXTENDED_SYS_STATE": 5,
            "HOME_POSITION": 0.5,
            "CURRENT_MODE": 0.5,
            "ESTIMATOR_STATUS": 1,
        }
        for name, rate in expected.items():
            assert len(c.of_type(name)) == pytest.approx(4 * rate, abs=1.01), name


def test_intervals_up_to_every_state():
    with Flight(file=vehicle_file(250.0)) as c:
        for interval, rate in ((1, 250), (4000, 250), (3000, 250), (5000, 200), (10_000, 100), (12_345, 81)):
            assert c.interval("ODOMETRY", interval) == ACK
            assert c.count("ODOMETRY", 1.0) == pytest.approx(rate, abs=1.01), interval
        stamps = [m.time_usec for m in c.of_type("ODOMETRY")]
        assert all(b > a for a, b in itertools.pairwise(stamps))
        assert c.interval("ODOMETRY", -1) == ACK
        assert c.count("ODOMETRY", 0.5) == 0
        assert c.interval("ODOMETRY", 0) == ACK
        assert c.count("ODOMETRY", 1.0) == pytest.approx(30, abs=1.01)


def test_what_cannot_be_set_about_intervals():
    with Flight() as c:
        assert c.interval("HEARTBEAT", 100_000) == FAILED
        assert c.count("HEARTBEAT", 3.0) == 3
        assert c.interval("RAW_RPM", 100_000) == FAILED
        for place in (3, 4, 7):
            params = [331.0, 20_000.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            params[place - 1] = 1.0
            assert c.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *params) == FAILED
        params = (331.0, 20_000.0, math.nan, math.nan, 0.0, 0.0, math.nan)
        assert c.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *params) == ACK
        assert c.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 331) == ACK
        assert c.last["MESSAGE_INTERVAL"].interval_us == 20_000


def test_messages_on_request():
    with Flight(start=((1.0, 2.0, -20.0), math.pi / 2)) as c:
        names = ("AUTOPILOT_VERSION", "HOME_POSITION", "ODOMETRY", "SYS_STATUS", "CURRENT_MODE", "ATTITUDE_TARGET")
        for name in names:
            c.last.pop(name, None)
            assert c.request(name) == ACK
            assert name in c.last
        assert c.request("RAW_RPM") == DENIED
        home = c.last["HOME_POSITION"]
        assert (home.x, home.y, home.z) == (1.0, 2.0, 0.0)
        assert c.last["AUTOPILOT_VERSION"].uid2[-1] == 0
    with Flight() as c:
        assert c.request("ATTITUDE_TARGET") == DENIED, "no data before the first setpoint"


def test_odometry_says_frames_stamps_and_covariances():
    file = vehicle_file(100.0, state_age_s=0.03, noise_position_m=0.002, noise_rate_rad_s=0.01)
    with Flight(file=file, start=((1.0, 2.0, -20.0), 0.5)) as c:
        c.run(0.5)
        m = c.last["ODOMETRY"]
        assert (m.frame_id, m.child_frame_id, m.estimator_type, m.quality) == (1, 1, 8, 0)
        assert c.t_us - m.time_usec == 30_000
        assert c.position == pytest.approx((1.0, 2.0, -20.0), abs=0.05)
        assert m.q[3] == pytest.approx(math.sin(0.25), abs=0.01)
        assert m.pose_covariance[0] == pytest.approx(4e-6)
        assert m.velocity_covariance[15] == pytest.approx(1e-4)
        assert [i for i, x in enumerate(m.pose_covariance) if x] == [0, 6, 11]
        assert len({x.x for x in c.of_type("ODOMETRY")}) > 20, "noise"


def test_heartbeat_and_system_ids():
    with Flight(start=IN_AIR, instance=4) as c:
        heartbeat = c.last["HEARTBEAT"]
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (5, 1)
        assert (heartbeat.type, heartbeat.autopilot) == (2, 12)
        assert heartbeat.base_mode & 128 and heartbeat.base_mode & 1
        assert heartbeat.custom_mode == HOLD
        assert heartbeat.system_status == mavlink.MAV_STATE_ACTIVE


def test_every_command_is_answered():
    with Flight() as c:
        assert c.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == UNSUPPORTED
        assert c.command(mavlink.MAV_CMD_DO_MOTOR_TEST, 1) == UNSUPPORTED
        assert c.command(54321) == UNSUPPORTED
        assert c.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.5, 0, 1) == DENIED
        assert c.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 3) == UNSUPPORTED
        assert c.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, 1) == DENIED
        assert c.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, *[math.nan] * 7) == ACK
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 3, 1) == DENIED
        assert c.command(mavlink.MAV_CMD_NAV_LAND, 0, 0, 1) == DENIED
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, math.nan, math.nan, math.nan) == 1
        ack = c.last["COMMAND_ACK"]
        assert (ack.target_system, ack.target_component) == (1, 191)
    with Flight(px4="1.13") as c:
        assert c.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == ACK
        assert "AUTOPILOT_VERSION" in c.last
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 3, 1) == ACK, "params were not checked then"


def test_commands_for_others_are_silent():
    with Flight() as c:
        request = (mavlink.MAV_CMD_REQUEST_MESSAGE, 148)
        assert c.command(*request, target=(0, 0)) == ACK
        assert c.command(*request, target=(1, 0)) == ACK
        assert c.command(*request, target=(2, 1)) is None
        assert c.command(*request, target=(1, 191)) is None
        c.mav.srcComponent = 1
        assert c.command(*request) is None, "its own ids"


def test_command_int():
    with Flight() as c:
        c.last.pop("COMMAND_ACK", None)
        fields = (1, 1, 0, mavlink.MAV_CMD_DO_SET_MODE, 0, 0, 1.0, 4.0, 6.0, 0.0)
        c.send(mavlink.MAVLink_command_int_message(*fields, 0, 0, 0.0))
        assert c.acknowledged(mavlink.MAV_CMD_DO_SET_MODE) == ACK
        c.send(mavlink.MAVLink_command_int_message(*fields, 5, 0, 0.0))
        assert c.acknowledged(mavlink.MAV_CMD_DO_SET_MODE) == DENIED
        most = 2147483647  # in both: not given
        c.send(mavlink.MAVLink_command_int_message(*fields, most, most, 0.0))
        assert c.acknowledged(mavlink.MAV_CMD_DO_SET_MODE) == ACK


# Parameters


def read(c, name, index=-1):
    c.last.pop("PARAM_VALUE", None)
    c.last.pop("PARAM_ERROR", None)
    c.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), index))
    c.until(lambda: "PARAM_VALUE" in c.last or "PARAM_ERROR" in c.last, 1.0)
    return c.last.get("PARAM_VALUE"), c.last.get("PARAM_ERROR")


def as_int(value):
    return struct.unpack("<i", struct.pack("<f", value))[0]


def test_parameters_are_read_and_set_bytewise():
    with Flight() as c:
        value, _ = read(c, "NAV_RCL_ACT")
        assert (value.param_type, as_int(value.param_value)) == (6, 2)
        value, _ = read(c, "COM_OF_LOSS_T")
        assert (value.param_type, value.param_value) == (9, 1.0)
        assert read(c, "", value.param_index)[0].param_id == "COM_OF_LOSS_T"
        c.set_param("NAV_RCL_ACT", 3)
        c.set_param("COM_OF_LOSS_T", 0.5)
        assert as_int(read(c, "NAV_RCL_ACT")[0].param_value) == 3
        assert read(c, "COM_OF_LOSS_T")[0].param_value == 0.5


def test_parameters_that_are_refused():
    with Flight() as c:
        c.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 3.0, 6))
        c.until(lambda: "PARAM_ERROR" in c.last, 1.0)
        assert read(c, "COM_OF_LOSS_T")[0].param_value == 1.0
        _, error = read(c, "NO_SUCH_THING")
        assert (error.param_id, error.error) == ("NO_SUCH_THING", 1)
        assert read(c, "", 9999)[1].error == 1
        c.log.clear()
        c.send(mavlink.MAVLink_param_request_read_message(0, 1, b"COM_OF_LOSS_T", -1))
        c.run(0.2)
        assert not c.of_type("PARAM_VALUE"), "target system 0 is not ours here"


def test_the_list_is_complete_and_begins_with_the_hash():
    with Flight() as c:
        c.log.clear()
        c.send(mavlink.MAVLink_param_request_list_message(1, 1))
        c.run(0.5)
        values = c.of_type("PARAM_VALUE")
        assert values[0].param_id == "_HASH_CHECK"
        names = [v.param_id for v in values[1:]]
        assert names == sorted(names)
        assert len(names) == values[0].param_count == values[-1].param_index + 1
        assert {"COM_OBL_RC_ACT", "MPC_THR_HOVER", "MAV_SYS_ID", "MC_ROLL_P"} <= set(names)
        before = values[0].param_value
        c.set_param("MPC_XY_P", 1.2)
        assert struct.pack("<f", read(c, "_HASH_CHECK")[0].param_value) != struct.pack("<f", before)


def test_attitude_gains_are_obeyed_in_flight():
    def turned(gain):
        with Flight(start=IN_AIR, parameters={"MC_REF_W_N": 200.0}) as c:
            c.set_param("MC_ROLL_P", gain)
            c.enter_offboard(7, q=(math.cos(0.1), math.sin(0.1), 0.0, 0.0))
            return c.until(lambda: c.tilt > 0.12, 5.0)

    assert turned(1.0) > 2.0 * turned(6.0)


@pytest.mark.parametrize(
    "name", ["MPC_THR_HOVER", "MPC_XY_VEL_P_ACC", "MPC_TILTMAX_AIR", "MPC_THR_MIN", "MC_YAW_WEIGHT"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e30])
def test_a_parameter_out_of_range_does_not_end_the_vehicle(name, value):
    with Flight(start=IN_AIR) as c:
        c.set_param(name, value)
        c.run(0.5)


# Links


def test_the_first_sender_is_the_partner_and_later_ones_only_act():
    flight = Flight(start=IN_AIR)
    with flight as c, free_socket() as other:
        stranger = Companion(other, c.vehicle[1], system=7)
        stranger.send(mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1, 4, 6, 0, 0, 0, 0))
        c.until(lambda: c.mode == 100925440, 1.0)
        other.settimeout(0.05)
        with pytest.raises(TimeoutError):
            other.recv(2048)
        assert c.last["COMMAND_ACK"].target_system == 7, "the answer goes to the partner"


def test_garbage_does_not_stop_it():
    draw = random.Random(5)
    flight = Flight(start=IN_AIR, ground=True)
    with flight as c, free_socket() as other:
        good = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 128, (1.0, 0.0, 0.0, 0.0), 0, 0, 0, 0.5).pack(c.mav)
        long = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(c.mav)
        ports = [c.vehicle[1], flight.peer.ground.port]
        for round_ in range(400):
            frame = bytearray(good if round_ % 2 else long)
            kind = round_ % 5
            if kind == 0:
                frame = bytearray(draw.randbytes(draw.randrange(300)))
            elif kind == 1:
                frame = frame[: draw.randrange(len(frame))]
            elif kind == 2:
                frame[draw.randrange(len(frame))] ^= 1 << draw.randrange(8)
            elif kind == 3:
                frame = bytearray(draw.randbytes(draw.randrange(1, 40))) + frame[:-1]
            else:
                frame[-1] ^= 0x55
            sock = c.sock if round_ % 3 else other
            sock.sendto(frame, ("127.0.0.1", ports[round_ % 2]))
            if round_ % 20 == 0:
                c.step()
        c.run(0.5)
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148) == ACK
        assert c.mode == HOLD


def test_valid_frames_with_any_content_do_not_stop_it():
    """Every message type that is acted on, with random bytes under a right checksum."""
    from vehicle_tools import framed

    draw = random.Random(6)
    ids = (0, 11, 20, 21, 23, 69, 75, 76, 82, 111, 139)
    with Flight(start=IN_AIR, px4="1.13") as c:
        for _ in range(40):
            for number in ids:
                cls = mavlink.mavlink_map[number]
                payload = bytearray(draw.randbytes(cls.unpacker.size))
                if number in (75, 76):
                    payload[30:32] = b"\x01\x01"
                    payload[28:30] = struct.pack("<H", draw.choice((511, 510, 512, 176, 22, 400)))
                if number == 23:
                    payload[4:6] = b"\x01\x01"
                    payload[6:22] = b"MPC_XY_P".ljust(16, b"\0")
                    payload[22] = 9
                c.sock.sendto(framed(number, bytes(payload), cls.crc_extra, c.mav), c.vehicle)
            c.step()
        c.run(0.1)


def test_messages_one_after_another_in_one_datagram_are_all_read():
    with Flight(start=IN_AIR) as c:
        first = mavlink.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0).pack(c.mav)
        second = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 6, 0, 0, 0, 0).pack(c.mav)
        c.log.clear()
        c.sock.sendto(first + second, c.vehicle)
        c.run(0.1)
        assert [m.command for m in c.of_type("COMMAND_ACK")] == [512, 176]


def test_the_ground_link_has_the_same_services():
    flight = Flight(start=IN_AIR, ground=True)
    with flight as c:
        sock = flight.ground_sock
        c.run(2.0)
        sock.settimeout(1.0)
        decode = mavlink.MAVLink(None)
        assert decode.decode(bytearray(sock.recv(2048))).get_type() == "HEARTBEAT"
        port = flight.peer.ground.port
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        request = mavlink.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
        sock.sendto(request.pack(mav), ("127.0.0.1", port))
        c.run(1.0)
        seen = {}
        sock.setblocking(False)
        try:
            while True:
                message = decode.decode(bytearray(sock.recv(2048)))
                seen[message.get_type()] = message
        except BlockingIOError:
            pass
        assert {"AUTOPILOT_VERSION", "COMMAND_ACK", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"} <= seen.keys()
        assert "ODOMETRY" not in seen


def test_timesync_is_answered():
    with Flight() as c:
        c.send(mavlink.MAVLink_timesync_message(0, 123456789))
        c.run(0.1)
        answers = [m for m in c.of_type("TIMESYNC") if m.ts1 == 123456789]
        assert len(answers) == 1
        assert 0 < answers[0].tc1 <= c.t_us * 1000
