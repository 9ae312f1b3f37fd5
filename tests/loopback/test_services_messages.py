"""Every message that the vehicle has, the rates of both links, the battery, and the commands beyond flying."""

import math
import random
import struct

import pytest
from vehicle_tools import HOLD, IN_AIR, LAND, RETURN, TAKEOFF, Flight, framed, mavlink, vehicle_file

from sim_link.link_rates import GROUND_HZ, ONBOARD_HZ
from sim_link.missions import Item
from sim_link.modes import Mode
from sim_link.outputs import commands
from sim_link.parameter_set import DEFAULTS, READ_ONLY
from sim_link.parameters import INT32, REAL32
from sim_link.sensors import altitude_at_m, pressure_hpa
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load

# Few states and few steps a second: what is looked at here is slow.
QUICK = vehicle_file(25.0, loop_rate_hz=250.0)
ACK, REJECTED, DENIED, UNSUPPORTED, IN_PROGRESS = 0, 1, 2, 3, 5
NAMES = {number: cls.msgname for number, cls in mavlink.mavlink_map.items()}
SILENT = {"WIND_COV", "RC_CHANNELS", "MANUAL_CONTROL"}
"""No wind estimate, no radio and no sticks, so nothing to say."""
ON_ITS_OWN = {"TIMESYNC"}


def test_every_message_of_the_tables_can_be_requested():
    with Flight(start=IN_AIR, file=QUICK) as c:
        c.run(0.1)
        for number in ONBOARD_HZ.keys() | GROUND_HZ.keys():
            name = NAMES[number]
            c.last.pop(name, None)
            wanted = DENIED if name in SILENT | ON_ITS_OWN else ACK
            assert c.request(name) == wanted, name
            assert (name in c.last) or wanted == DENIED, name
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, math.nan) == DENIED
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 65000) == DENIED


def test_rates_of_both_links_are_px4_s():
    flight = Flight(start=IN_AIR, ground=True, file=vehicle_file(250.0))
    with flight as c:
        ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(ground)
        flight.ground_sock.sendto(heartbeat, ("127.0.0.1", flight.peer.ground.port))
        flight.ground_sock.setblocking(False)
        for name in ("ODOMETRY", "CURRENT_MODE", "EXTENDED_SYS_STATE"):
            assert c.interval(name, 0) == ACK
        c.run(0.5)
        drain(flight.ground_sock)
        c.log.clear()
        seen = []
        for _ in range(20):
            c.run(0.1)
            seen += drain(flight.ground_sock)
        for table, names in ((ONBOARD_HZ, [m.get_type() for m in c.log]), (GROUND_HZ, seen)):
            for number, rate in table.items():
                name = NAMES[number]
                if name not in SILENT | ON_ITS_OWN:
                    assert names.count(name) == pytest.approx(2 * rate, abs=1.01), (name, table is GROUND_HZ)


def drain(sock):
    """Names of the messages that are waiting."""
    names, decode = [], mavlink.MAVLink(None)
    try:
        while True:
            names.append(decode.decode(bytearray(sock.recv(2048))).get_type())
    except BlockingIOError:
        return names


def test_instruments_agree_with_the_state():
    tilted = (math.cos(0.1), math.sin(0.1), 0.0, 0.0)
    flight = Flight(start=((0.0, 0.0, -20.0), 0.4), file=vehicle_file(100.0))
    with flight as c:
        c.run(1.0)
        for name in ("ATTITUDE", "VFR_HUD", "ALTITUDE", "HIGHRES_IMU", "SCALED_IMU", "SERVO_OUTPUT_RAW", "SYSTEM_TIME"):
            assert c.request(name) == ACK
        assert c.last["ATTITUDE"].yaw == pytest.approx(0.4, abs=0.01)
        assert c.last["VFR_HUD"].heading == pytest.approx(math.degrees(0.4), abs=1.1)
        assert c.last["VFR_HUD"].throttle == pytest.approx(49, abs=3)
        assert c.last["ALTITUDE"].altitude_relative == pytest.approx(20.0, abs=0.1)
        assert c.last["ALTITUDE"].altitude_amsl == pytest.approx(509.4, abs=0.1)
        imu = c.last["HIGHRES_IMU"]
        assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((0.0, 0.0, -9.81), abs=0.4)
        assert math.atan2(-imu.ymag, imu.xmag) == pytest.approx(0.4 - math.atan2(0.010, 0.215), abs=0.05)
        assert imu.pressure_alt == pytest.approx(509.4, abs=2.0)
        assert c.last["SCALED_IMU"].zacc == pytest.approx(-1000, abs=40)
        hover = round(1000 + 1000 * load("paper").mass_kg * 9.81 / (4.0 * load("paper").rotor_thrust_max_n))
        assert c.last["SERVO_OUTPUT_RAW"].servo1_raw == pytest.approx(hover, abs=30)
        assert c.last["SERVO_OUTPUT_RAW"].servo5_raw == 0
        assert c.last["SYSTEM_TIME"].time_boot_ms == pytest.approx(c.t_us / 1000, abs=100)
        c.enter_offboard(7, q=tilted, thrust=0.8)
        c.run(0.5)
        assert c.request("HIGHRES_IMU") == ACK
        lift = 0.8 * 4.0 * load("paper").rotor_thrust_max_n / load("paper").mass_kg
        assert c.last["HIGHRES_IMU"].zacc == pytest.approx(-lift, rel=0.06), "specific force is thrust over mass"
        assert c.request("HIL_STATE_QUATERNION") == ACK


def test_disarmed_outputs_and_prearm_health():
    with Flight(file=QUICK) as c:
        c.run(0.3)
        assert c.request("SERVO_OUTPUT_RAW") == ACK
        assert c.last["SERVO_OUTPUT_RAW"].servo2_raw == 900
        prearm = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        assert c.request("SYS_STATUS") == ACK
        assert c.last["SYS_STATUS"].onboard_control_sensors_health & prearm
        assert c.set_mode(LAND) == 0
        assert c.request("SYS_STATUS") == ACK
        assert not c.last["SYS_STATUS"].onboard_control_sensors_health & prearm
        assert c.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == ACK
        assert any(text.startswith("Preflight Fail: mode Land") for text in c.texts())


def test_ping_is_answered_to_whoever_sent_it():
    with Flight(file=QUICK) as c:
        c.log.clear()
        c.send(mavlink.MAVLink_ping_message(123, 7, 0, 0))
        c.send(mavlink.MAVLink_ping_message(456, 8, 1, 1))
        c.run(0.2)
        answers = [m for m in c.of_type("PING") if m.target_system]
        assert [(m.time_usec, m.seq, m.target_system, m.target_component) for m in answers] == [(123, 7, 1, 191)]


def test_file_transfer_is_answered_with_nothing():
    def ask(c, opcode, path=b""):
        c.last.pop("FILE_TRANSFER_PROTOCOL", None)
        head = struct.pack("<HBBBBBxI", 41, 0, opcode, len(path), 0, 0, 0)
        c.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list((head + path).ljust(251, b"\0"))))
        c.until(lambda: "FILE_TRANSFER_PROTOCOL" in c.last, 0.5)
        content = bytes(c.last["FILE_TRANSFER_PROTOCOL"].payload)
        assert struct.unpack_from("<H", content)[0] == 42
        assert content[5] == opcode
        return content[3], content[12] if content[4] else None

    with Flight(file=QUICK) as c:
        assert ask(c, 2) == (128, None)
        assert ask(c, 3, b"/") == (129, 6), "end of an empty directory"
        assert ask(c, 4, b"/no/such/file") == (129, 10)
        assert ask(c, 6, b"/new") == (129, 9)
        assert ask(c, 99) == (129, 7)


def test_the_list_of_modes():
    with Flight(file=QUICK) as c:
        c.log.clear()
        assert c.request("AVAILABLE_MODES") == ACK
        modes = c.of_type("AVAILABLE_MODES")
        assert [m.mode_index for m in modes] == list(range(1, modes[0].number_modes + 1))
        assert {m.custom_mode for m in modes} >= {HOLD, RETURN, LAND, TAKEOFF}
        c.log.clear()
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 435, 2) == ACK
        assert [m.mode_index for m in c.of_type("AVAILABLE_MODES")] == [2]
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 435, 99) == DENIED
        assert c.command(mavlink.MAV_CMD_DO_SET_STANDARD_MODE, mavlink.MAV_STANDARD_MODE_SAFE_RECOVERY) == ACK
        c.run(0.1)
        assert c.mode == RETURN
        assert c.command(mavlink.MAV_CMD_DO_SET_STANDARD_MODE, 77) == UNSUPPORTED


# Commands


def test_reposition_flies_there_and_holds():
    with Flight(start=IN_AIR, file=QUICK) as c:
        place = (473977420 + 899, 85455940, 489.4 + 22.0)  # 10 m north
        int_command = mavlink.MAVLink_command_int_message
        number = mavlink.MAV_CMD_DO_REPOSITION
        c.send(int_command(1, 1, 5, number, 0, 0, -1.0, 0.0, 0.0, math.nan, *place))
        assert c.acknowledged(number) == UNSUPPORTED, "the flag to change the mode is missing"
        c.send(int_command(1, 1, 5, number, 0, 0, 2.0, 1.0, 0.0, 1.5, *place))
        assert c.acknowledged(number) == ACK
        fastest = 0.0

        def there():
            nonlocal fastest
            fastest = max(fastest, c.last["ODOMETRY"].vx)
            return math.dist(c.position, (10.0, 0.0, -22.0)) < 0.3

        c.until(there, 20.0)
        assert 1.5 < fastest < 2.4, "param1 is the speed"
        c.run(2.0)
        assert 2.0 * math.asin(c.last["ODOMETRY"].q[3]) == pytest.approx(1.5, abs=0.05)
        assert c.mode == HOLD
        c.send(int_command(1, 1, 6, number, 0, 0, -1.0, 1.0, 0.0, math.nan, 2147483647, 2147483647, 15.0))
        assert c.acknowledged(number) == ACK
        c.until(lambda: abs(c.position[2] + 15.0) < 0.2, 15.0)
        assert c.position[0] == pytest.approx(10.0, abs=0.3), "without a place it climbs or sinks only"
        assert c.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 3.0, -1) == ACK
        assert c.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 3.0, -1, 9.0) == DENIED
        assert c.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 3, 3.0, -1) == UNSUPPORTED


def test_autotuning_is_in_progress_until_it_is_done():
    with Flight(start=IN_AIR, file=QUICK) as c:
        number = mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE
        progress = []
        while c.command(number, 1) == IN_PROGRESS:
            progress.append(c.last["COMMAND_ACK"].progress)
            c.run(4.0)
        assert progress == sorted(progress) and 5 <= len(progress) < 8
        assert c.last["COMMAND_ACK"].result == ACK
        assert c.command(number, 0) == DENIED
    with Flight(file=QUICK) as c:
        assert c.command(mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE, 1) == REJECTED


def test_parameters_can_be_reset_and_the_rotors_geometry_is_read_only():
    with Flight(file=QUICK) as c:
        c.set_param("MPC_XY_P", 1.5)
        assert c.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 9) == UNSUPPORTED
        assert c.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2) == ACK
        c.send(mavlink.MAVLink_param_request_read_message(1, 1, b"MPC_XY_P", -1))
        c.run(0.1)
        assert c.last["PARAM_VALUE"].param_value == pytest.approx(0.95)
        c.send(mavlink.MAVLink_param_request_read_message(1, 1, b"CA_ROTOR0_PX", -1))
        c.run(0.1)
        assert c.last["PARAM_VALUE"].param_value == pytest.approx(load("paper").rotor_x_m[0])
        c.send(mavlink.MAVLink_param_set_message(1, 1, b"CA_ROTOR0_PX", 9.0, 9))
        c.run(0.1)
        assert (c.last["PARAM_ERROR"].param_id, c.last["PARAM_ERROR"].error) == ("CA_ROTOR0_PX", 5)
    with Flight(start=IN_AIR, file=QUICK) as c:
        assert c.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2) == REJECTED


def test_what_a_companion_reads_is_there_at_px4_s_defaults():
    wanted = {
        "COM_OBL_RC_ACT": 0, "COM_OF_LOSS_T": 1.0, "NAV_RCL_ACT": 2, "NAV_DLL_ACT": 0, "COM_RCL_EXCEPT": 0,
        "COM_DLL_EXCEPT": 0, "COM_RC_LOSS_T": 0.5, "COM_FAIL_ACT_T": 5.0, "MAN_OVERRIDE_SPD": 1.0,
        "COM_LOW_BAT_ACT": 0, "COM_QC_ACT": 0, "COM_DISARM_PRFLT": 10.0, "COM_DISARM_LAND": 2.0,
        "COM_SPOOLUP_TIME": 1.0, "COM_POS_FS_ACT": 0, "COM_POS_FS_EPH": 5.0, "COM_VEL_FS_EVH": 1.0,
        "COM_ARM_WO_GPS": 1, "COM_ARMABLE": 1, "COM_FLTMODE_BOOT": 4, "GF_ACTION": 2, "GF_SOURCE": 0,
        "GF_MAX_HOR_DIST": 0.0, "GF_MAX_VER_DIST": 0.0, "RTL_RETURN_ALT": 30.0, "FD_FAIL_R": 60, "FD_FAIL_P": 60,
        "FD_FAIL_R_TTRI": 0.3, "FD_FAIL_P_TTRI": 0.3, "FD_ALT_LOSS": 0.0, "CBRK_FLIGHTTERM": 121212,
        "CBRK_SUPPLY_CHK": 0, "MAV_TYPE": 2, "MAV_FWDEXTSP": 1, "MC_ROLLRATE_MAX": 220.0, "MC_PITCHRATE_MAX": 220.0,
        "MC_YAWRATE_MAX": 200.0, "MC_REF_W_N": 50.0, "MC_REF_FF": 0.0, "MC_AIRMODE": 0, "MC_BAT_SCALE_EN": 0,
        "THR_MDL_FAC": 0.0, "MPC_THR_HOVER": 0.5, "MPC_TILTMAX_AIR": 45.0, "IMU_GYRO_CUTOFF": 40.0,
        "IMU_DGYRO_CUTOFF": 20.0, "EKF2_HGT_REF": 1, "SYS_FAILURE_EN": 1,
    }  # fmt: skip
    for name, value in wanted.items():
        assert DEFAULTS[name] == value and type(DEFAULTS[name]) is type(value), name


# Battery


def flown(**parameters):
    """Hover for 20 s; gives the battery and the thrust commanded at the end."""
    flight = Flight(start=IN_AIR, parameters=parameters, file=QUICK)
    with flight as c:
        c.run(20.0)
        assert c.request("BATTERY_STATUS") == ACK
        assert c.request("SYS_STATUS") == ACK
        return c.last["BATTERY_STATUS"], flight.vehicle.autopilot.held.thrust, c.texts(), c.mode


def test_a_battery_of_a_size_drains_with_power_and_sags_thrust():
    ideal, thrust, _, _ = flown()
    assert ideal.battery_remaining == pytest.approx(67, abs=3), "PX4's simulated battery: a minute for all of it"
    assert ideal.current_battery > 100
    mass = load("paper").mass_kg
    small = {"BAT1_CAPACITY": 300.0 * mass, "BAT1_R_INTERNAL": 0.003}
    sized, more, _, _ = flown(**small)
    used = 170.0 * mass / 15.0 * 20.0 / 3.6
    assert sized.current_consumed == pytest.approx(used, rel=0.15)
    assert sized.battery_remaining == pytest.approx(100.0 * (1.0 - used / (300.0 * mass)), abs=5.0)
    assert sized.voltages[0] < ideal.voltages[0]
    assert more > 1.05 * thrust, "less thrust at the same command"
    _, compensated, _, _ = flown(MC_BAT_SCALE_EN=1, **small)
    assert compensated == pytest.approx(thrust, rel=0.03)


@pytest.mark.parametrize(("act", "mode"), [(0, HOLD), (2, LAND), (3, RETURN)])
def test_a_critical_battery_acts_as_asked(act, mode):
    drained = {"COM_LOW_BAT_ACT": act, "BAT_CRIT_THR": 0.95, "BAT_LOW_THR": 0.97, "BAT_EMERGEN_THR": 0.1}
    with Flight(start=((30.0, 0.0, -20.0), 0.0), parameters={**drained, "COM_FAIL_ACT_T": 1.0}, file=QUICK) as c:
        c.until(lambda: "Critical battery" in c.texts(), 10.0)
        assert "Low battery" in c.texts()
        c.run(2.0)
        assert c.mode == mode
        assert c.last["SYS_STATUS"].onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_BATTERY == 0


def test_rotor_commands_are_found_from_the_thrusts_they_made():
    file = load("paper")
    for u in (0.0, 0.3, 1.0):
        full = file.rotor_thrust_max_n
        target = full * (file.curve_factor * u * u + (1.0 - file.curve_factor) * u)
        left = math.exp(-0.004 / file.rotor_lag_s)
        after = target + left * (0.4 * full - target)
        found = commands(file, (0.4 * full,) * 4, (after,) * 4, 0.004)
        assert found == pytest.approx((u,) * 4, abs=1e-9)


def test_pressure_and_altitude_are_inverse():
    for altitude in (-100.0, 0.0, 489.4, 3000.0):
        assert altitude_at_m(pressure_hpa(altitude)) == pytest.approx(altitude, abs=1e-6)
    assert pressure_hpa(0.0) == 1013.25
    assert struct.pack("<f", pressure_hpa(math.nan)) == struct.pack("<f", 1013.25)


def test_valid_frames_with_any_content_do_not_end_the_vehicle():
    """Every message that these services take, with random bytes under a right checksum."""
    draw = random.Random(8)
    ids = (4, 39, 40, 41, 43, 44, 45, 47, 51, 69, 70, 73, 75, 76, 84, 86, 110)
    numbers = (178, 179, 187, 192, 212, 224, 245, 262, 300, 401, 512)
    with Flight(start=IN_AIR, file=QUICK) as c:
        for _ in range(60):
            for number in ids:
                cls = mavlink.mavlink_map[number]
                fields = list(cls.unpacker.unpack(draw.randbytes(cls.unpacker.size)))
                names = [*cls.ordered_fieldnames]
                for name, value in (("target_system", 1), ("target", 1), ("target_component", 1), ("mission_type", 0)):
                    if name in names and draw.random() < 0.8:
                        fields[names.index(name)] = value
                if "command" in names:
                    fields[names.index("command")] = draw.choice(numbers)
                payload = cls.unpacker.pack(*fields)
                c.sock.sendto(framed(number, payload, cls.crc_extra, c.mav), c.vehicle)
            c.step()
        c.run(1.0)
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148) == ACK


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1e30, 0.0, 1e30, -1, 2**31 - 1, -(2**31), 7])
def test_no_value_of_any_parameter_ends_the_vehicle(value):
    vehicle = Vehicle(VehicleOptions(vehicle=QUICK, start=IN_AIR, engine="python"))
    autopilot, parameters = vehicle.autopilot, vehicle.parameters
    kind, form = (INT32, "<i") if isinstance(value, int) else (REAL32, "<f")
    for name in parameters.names:
        if parameters.type_of(name) == kind and name not in READ_ONLY:
            parameters.set_wire(name, kind, struct.pack(form, value))
    place = (473977420, 85455940, 25.0)
    autopilot.plans.replace(0, [Item(6, 16, 0, 1, (0.0, 0.0, 0.0, math.nan), *place)])
    for mode in Mode:
        autopilot.set_mode(mode)
        for _ in range(6):
            autopilot.manual_control(300, 200, 700, 400)
            vehicle.tick()
            for link in vehicle.links:
                link.outbox.clear()
        for number in vehicle.companion.streams:
            vehicle.telemetry.build(number)
    assert vehicle.t_us > vehicle.start_us
