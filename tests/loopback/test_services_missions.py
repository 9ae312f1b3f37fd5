"""Missions, geofences and rally points: their transfer, and what the vehicle makes of them."""

import math
import struct
import zlib

import pytest
from vehicle_tools import HOLD, IN_AIR, LAND, OFFBOARD, RETURN, Flight, mavlink, vehicle_file

from sim_link.geodesy import local_position

# Few states and few steps a second: what is looked at here is slow.
QUICK = vehicle_file(25.0, loop_rate_hz=250.0)
MISSION_MODE = 4 << 16 | 4 << 24
LATITUDE, LONGITUDE = 473977420, 85455940
METRE = 1e7 * math.degrees(1.0 / 6371000.0)
WIDTH = METRE / math.cos(math.radians(47.397742))
MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255


def item(command, north=0.0, east=0.0, height=0.0, params=(0.0, 0.0, 0.0, math.nan), frame=6):
    return command, frame, params, LATITUDE + round(north * METRE), LONGITUDE + round(east * WIDTH), height


def to_send(c, sequence, entry, kind=MISSION):
    command, frame, params, x, y, z = entry
    return mavlink.MAVLink_mission_item_int_message(
        c.target, 1, sequence, frame, command, int(sequence == 0), 1, *params, x, y, z, kind
    )


def upload(c, entries, kind=MISSION):
    """Upload a plan; gives the result and the opaque id of the acknowledgement."""
    c.last.pop("MISSION_ACK", None)
    c.last.pop("MISSION_REQUEST_INT", None)
    c.send(mavlink.MAVLink_mission_count_message(c.target, 1, len(entries), kind))
    for sequence, entry in enumerate(entries):
        c.until(lambda s=sequence: asked(c) == s or "MISSION_ACK" in c.last, 1.0)
        if "MISSION_ACK" in c.last:
            break
        c.send(to_send(c, sequence, entry, kind))
    c.until(lambda: "MISSION_ACK" in c.last, 1.0)
    return c.last["MISSION_ACK"].type, opaque_id(c.last["MISSION_ACK"], 4)


def asked(c):
    request = c.last.get("MISSION_REQUEST_INT")
    return None if request is None else request.seq


def opaque_id(message, at):
    """The field that pymavlink does not know, from the bytes received."""
    payload = bytes(message.get_msgbuf())[10:-2]
    return struct.unpack("<I", payload.ljust(at + 4, b"\0")[at : at + 4])[0]


def download(c, kind=MISSION):
    c.last.pop("MISSION_COUNT", None)
    c.send(mavlink.MAVLink_mission_request_list_message(c.target, 1, kind))
    c.until(lambda: "MISSION_COUNT" in c.last, 1.0)
    count, found = c.last["MISSION_COUNT"], []
    for sequence in range(count.count):
        c.last.pop("MISSION_ITEM_INT", None)
        c.send(mavlink.MAVLink_mission_request_int_message(c.target, 1, sequence, kind))
        c.until(lambda: "MISSION_ITEM_INT" in c.last, 1.0)
        m = c.last["MISSION_ITEM_INT"]
        found.append((m.command, m.frame, (m.param1, m.param2, m.param3, m.param4), m.x, m.y, m.z))
    c.send(mavlink.MAVLink_mission_ack_message(c.target, 1, 0, kind))
    return found, opaque_id(count, 5)


def clear(c, kind):
    c.last.pop("MISSION_ACK", None)
    c.send(mavlink.MAVLink_mission_clear_all_message(c.target, 1, kind))
    c.until(lambda: "MISSION_ACK" in c.last, 1.0)
    return c.last["MISSION_ACK"].type


def plain(entries):
    return [(a, b, tuple("nan" if x != x else x for x in params), x, y, z) for a, b, params, x, y, z in entries]


SHORT = [item(22, height=4.0), item(16, north=8.0, height=5.0), item(16, north=8.0, east=6.0, height=4.0), item(21)]


def test_plans_of_all_kinds_come_back_as_they_went():
    square = [item(5001, n, e, params=(4.0, 0.0, 0.0, 0.0), frame=0) for n, e in ((9, 9), (9, -9), (-9, -9), (-9, 9))]
    circle = [item(5004, 5.0, 5.0, params=(2.5, 0.0, 0.0, 0.0), frame=0)]
    rally = [item(5100, 20.0, 0.0, 5.0, params=(0.0, 0.0, 0.0, 0.0))]
    with Flight(file=QUICK) as c:
        ids = set()
        for kind, entries in ((MISSION, SHORT), (FENCE, square + circle), (RALLY, rally)):
            result, number = upload(c, entries, kind)
            assert result == 0 and number != 0
            ids.add(number)
            back, same = download(c, kind)
            assert plain(back) == plain(entries)
            assert same == number
        assert len(ids) == 3
        assert upload(c, SHORT)[1] in ids, "the same plan has the same id"
        assert c.request("MISSION_CURRENT") == 0
        current = c.last["MISSION_CURRENT"]
        assert (current.seq, current.total, current.mission_state) == (0, 4, 2)
        assert {opaque_id(current, at) for at in (6, 10, 14)} == ids
        assert clear(c, FENCE) == 0
        assert download(c, FENCE) == ([], 0)
        assert len(download(c)[0]) == 4
        assert clear(c, ALL) == 0
        assert download(c) == ([], 0) and download(c, RALLY) == ([], 0)
        assert clear(c, 7) == 1


def test_the_id_depends_on_every_field():
    with Flight(file=QUICK) as c:
        seen = {upload(c, SHORT)[1]}
        for k, other in enumerate((item(16, 8.0, 0.0, 5.5), item(16, 8.0, 0.1, 5.0), item(17, 8.0, 0.0, 5.0))):
            seen.add(upload(c, [SHORT[0], other, *SHORT[2:]])[1])
            assert len(seen) == k + 2
        assert 0 not in seen and zlib.crc32(b"") == 0


REFUSED = [
    ([item(16, height=5.0, frame=1)], 2, "a local frame"),
    ([item(209, height=5.0)], 3, "no such command in a mission"),
    ([item(5001, params=(4.0, 0.0, 0.0, 0.0))], 3, "a corner of a fence"),
    ([item(16, height=math.nan)], 12, "no height"),
    ([(16, 6, (0.0,) * 4, 2_000_000_000, 0, 5.0)], 10, "beyond the pole"),
    ([item(177, params=(9.0, 1.0, 0.0, 0.0), frame=2)], 5, "a jump to nowhere"),
]


@pytest.mark.parametrize(("entries", "result", "why"), REFUSED)
def test_items_that_are_refused_leave_the_plan_as_it_was(entries, result, why):
    with Flight(file=QUICK) as c:
        assert upload(c, SHORT)[0] == 0
        assert upload(c, entries)[0] == result, why
        assert plain(download(c)[0]) == plain(SHORT)


def test_fences_that_are_none():
    with Flight(file=QUICK) as c:
        triangle = [item(5001, n, e, params=(3.0, 0.0, 0.0, 0.0), frame=0) for n, e in ((0, 0), (9, 0))]
        assert upload(c, triangle, FENCE)[0] == 5, "a corner is missing"
        assert upload(c, [item(5001, params=(2.0, 0.0, 0.0, 0.0), frame=0)], FENCE)[0] == 1
        assert upload(c, [item(5003, params=(0.0, 0.0, 0.0, 0.0), frame=0)], FENCE)[0] == 6
        c.last.pop("MISSION_ACK", None)
        c.send(mavlink.MAVLink_mission_count_message(1, 1, 501, MISSION))
        c.until(lambda: "MISSION_ACK" in c.last, 1.0)
        assert c.last["MISSION_ACK"].type == 4, "no space"


def test_lost_items_are_asked_for_again_and_a_silent_sender_is_given_up():
    with Flight(file=QUICK) as c:
        c.send(mavlink.MAVLink_mission_count_message(1, 1, 4, MISSION))
        c.until(lambda: asked(c) == 0, 0.2)
        c.log.clear()
        c.run(1.1)
        assert len(c.of_type("MISSION_REQUEST_INT")) == 4, "every 250 ms"
        c.send(to_send(c, 2, SHORT[2]))  # not the one that was asked for: passed over
        c.run(0.1)
        c.send(to_send(c, 0, SHORT[0]))
        c.until(lambda: asked(c) == 1, 0.2)
        c.send(mavlink.MAVLink_mission_count_message(1, 1, 4, MISSION))
        c.until(lambda: "MISSION_ACK" in c.last, 0.2)
        assert c.last["MISSION_ACK"].type == 1, "busy"
        waited = c.until(lambda: "Operation timeout" in c.texts(), 6.0)
        assert waited == pytest.approx(5.0, abs=0.2)
        assert upload(c, SHORT)[0] == 0
        c.last.pop("MISSION_ACK")
        c.send(to_send(c, 3, SHORT[3]))  # its acknowledgement was lost
        c.until(lambda: "MISSION_ACK" in c.last, 0.2)
        assert c.last["MISSION_ACK"].type == 0


def test_an_unexpected_request_ends_a_download_and_requests_out_of_the_blue_are_silent():
    with Flight(file=QUICK) as c:
        upload(c, SHORT)
        c.send(mavlink.MAVLink_mission_request_list_message(1, 1, MISSION))
        c.run(0.1)
        for sequence in (0, 0, 1):  # the last one may be asked for again
            c.last.pop("MISSION_ITEM_INT", None)
            c.send(mavlink.MAVLink_mission_request_int_message(1, 1, sequence, MISSION))
            c.until(lambda: "MISSION_ITEM_INT" in c.last, 0.2)
            assert c.last["MISSION_ITEM_INT"].seq == sequence
        c.last.pop("MISSION_ACK")
        c.send(mavlink.MAVLink_mission_request_int_message(1, 1, 3, MISSION))
        c.until(lambda: "MISSION_ACK" in c.last, 0.2)
        assert c.last["MISSION_ACK"].type == 1
        c.log.clear()
        c.send(mavlink.MAVLink_mission_request_int_message(1, 1, 0, MISSION))
        c.send(mavlink.MAVLink_mission_request_list_message(9, 1, MISSION))
        c.run(0.2)
        assert not c.of_type("MISSION_ITEM_INT") and not c.of_type("MISSION_COUNT")


def test_a_transfer_on_one_link_keeps_the_other_out():
    flight = Flight(ground=True, file=QUICK)
    with flight as c:
        ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        count = mavlink.MAVLink_mission_count_message(1, 1, 2, MISSION).pack(ground)
        flight.ground_sock.sendto(count, ("127.0.0.1", flight.peer.ground.port))
        c.run(0.1)
        c.send(mavlink.MAVLink_mission_count_message(1, 1, 4, MISSION))
        c.until(lambda: "MISSION_ACK" in c.last, 0.3)
        assert c.last["MISSION_ACK"].type == 1


def test_a_mission_is_flown_to_its_end():
    with Flight(file=QUICK) as c:
        assert c.command(mavlink.MAV_CMD_MISSION_START, 0, 0) == 2, "there is none"
        assert c.set_mode(MISSION_MODE) == 0
        assert c.arm() == 1, "no valid mission"
        repeat = item(177, params=(1.0, 1.0, 0.0, 0.0), frame=2)
        faster = item(178, params=(1.0, 3.0, -1.0, 0.0), frame=2)
        assert upload(c, [SHORT[0], SHORT[1], faster, SHORT[2], repeat, SHORT[3]])[0] == 0
        assert c.command(mavlink.MAV_CMD_MISSION_START, 0, 0) == 0
        assert c.armed or c.until(lambda: c.armed, 1.1)
        corners = {(8.0, 0.0, -5.0): 0, (8.0, 6.0, -4.0): 0}
        inside = dict.fromkeys(corners, False)
        fastest = 0.0

        def over():
            nonlocal fastest
            m = c.last["ODOMETRY"]
            fastest = max(fastest, math.hypot(m.vx, m.vy))
            for corner in corners:
                near = math.dist(c.position, corner) < 2.3
                corners[corner] += near and not inside[corner]
                inside[corner] = near
            return not c.armed

        c.until(over, 90.0)
        assert list(corners.values()) == [2, 2], "once more by the jump"
        assert c.position == pytest.approx((0.0, 0.0, 0.0), abs=0.5)
        assert fastest < 5.5
        assert [m.seq for m in c.of_type("MISSION_ITEM_REACHED")][-1] == 5
        assert c.mode == HOLD and "Disarmed by landing" in c.texts()
        assert c.request("MISSION_CURRENT") == 0
        assert c.last["MISSION_CURRENT"].mission_state == 5


def test_a_mission_can_be_left_and_taken_up_again_at_any_item():
    with Flight(start=IN_AIR, file=QUICK) as c:
        far = [item(16, 30.0, 0.0, 20.0), item(16, 30.0, 30.0, 20.0), item(20, frame=2)]
        assert upload(c, far)[0] == 0
        assert c.set_mode(MISSION_MODE) == 0
        c.until(lambda: c.position[0] > 5.0, 15.0)
        assert c.set_mode(HOLD) == 0
        c.run(4.0)
        assert c.request("MISSION_CURRENT") == 0
        assert c.last["MISSION_CURRENT"].mission_state == 2  # nothing was reached yet
        assert c.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 7) == 2
        c.send(mavlink.MAVLink_mission_set_current_message(1, 1, 1))
        c.until(lambda: c.last["MISSION_CURRENT"].seq == 1, 1.0)
        assert c.set_mode(MISSION_MODE) == 0
        c.until(lambda: math.dist(c.position, (30.0, 30.0, -20.0)) < 2.5, 30.0)
        c.until(lambda: c.mode == RETURN, 5.0)


# Geofence


def breach(action, **parameters):
    """Fly north in OFFBOARD beyond 10 m from home."""
    parameters = {"GF_MAX_HOR_DIST": 10.0, "GF_ACTION": action, "COM_OBL_RC_ACT": 4} | parameters
    return Flight(start=IN_AIR, parameters=parameters, file=QUICK)


NORTH = {"q": (math.cos(0.1), 0.0, -math.sin(0.1), 0.0), "thrust": 0.5}


@pytest.mark.parametrize(("action", "mode"), [(2, HOLD), (3, RETURN), (5, LAND)])
def test_a_breach_of_the_largest_distance_acts_and_can_be_overruled(action, mode):
    with breach(action) as c:
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.mode == mode, 15.0)
        assert 9.5 < c.position[0] < 12.0
        assert c.intended == OFFBOARD
        assert any(text.startswith("Geofence violation") for text in c.texts())
        c.run(0.5)
        assert c.last["HEARTBEAT"].system_status == mavlink.MAV_STATE_CRITICAL or c.run(1.0) is None
        assert c.set_mode(HOLD) == 0
        assert c.mode == HOLD
        c.run(1.0)
        assert c.mode == HOLD, "whoever changes the mode takes over"


def test_a_fence_that_terminates_and_one_that_only_warns():
    flight = breach(4)
    with flight as c:
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.mode == 10 << 16, 15.0)
        c.run(0.5)
        assert sum(flight.vehicle.airframe.rigid.rotor_n) < 0.1
    with breach(1) as c:
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.position[0] > 13.0, 15.0)
        assert c.mode == OFFBOARD
        assert any(text.startswith("Geofence violation") for text in c.texts())
    with breach(0) as c:
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.position[0] > 13.0, 15.0)
        assert not any(text.startswith("Geofence") for text in c.texts())


def test_uploaded_areas_and_the_height_count_too():
    square = [item(5001, n, e, params=(4.0, 0.0, 0.0, 0.0), frame=0) for n, e in ((9, 9), (9, -9), (-9, -9), (-9, 9))]
    hole = [item(5004, 6.0, 0.0, params=(2.0, 0.0, 0.0, 0.0), frame=0)]
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 4}, file=QUICK) as c:
        assert upload(c, square, FENCE)[0] == 0
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.mode == HOLD, 15.0)
        assert 8.5 < c.position[0] < 11.0
    with Flight(start=IN_AIR, file=QUICK) as c:
        assert upload(c, square + hole, FENCE)[0] == 0
        c.enter_offboard(7, **NORTH)
        c.until(lambda: c.mode == HOLD, 15.0)
        assert 3.5 < c.position[0] < 6.0
    with Flight(start=IN_AIR, parameters={"GF_MAX_VER_DIST": 15.0}, file=QUICK) as c:
        c.run(0.5)
        assert c.mode == HOLD and any("altitude" in text for text in c.texts())


def test_a_fence_that_holds_stops_who_is_sent_out_of_it_in_hold():
    with breach(2) as c:
        place = (47.397742 + 60.0 * METRE * 1e-7, 8.545594, 489.4 + 20.0)
        assert c.command(mavlink.MAV_CMD_DO_REPOSITION, -1.0, 1.0, 0.0, math.nan, *place) == 0
        c.until(lambda: any(text.startswith("Geofence violation") for text in c.texts()), 15.0)
        c.run(8.0)
        assert c.mode == HOLD
        assert 10.0 < c.position[0] < 18.0, "it stops there and then"
        assert c.command(mavlink.MAV_CMD_DO_REPOSITION, -1.0, 1.0, 0.0, math.nan, *place) == 0
        c.until(lambda: c.position[0] > 50.0, 30.0)  # who orders it again means it


def test_outside_of_the_fence_nobody_arms():
    far = [item(5003, 100.0, 0.0, params=(5.0, 0.0, 0.0, 0.0), frame=0)]
    with Flight(file=QUICK) as c:
        assert upload(c, far, FENCE)[0] == 0
        c.run(0.5)
        assert c.arm() == 1
        assert any(text.startswith("Arming denied: geofence") for text in c.texts())
        assert clear(c, FENCE) == 0
        c.run(0.5)
        assert c.arm() == 0


def test_return_goes_to_the_nearest_of_home_and_the_rally_points():
    start = ((25.0, 0.0, -12.0), 0.0)
    with Flight(start=start, parameters={"RTL_RETURN_ALT": 12.0}, file=QUICK) as c:
        assert c.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, math.nan, 8.5, 480.0) == 2, "no place"
        home = (1, 1, 0, mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0.0, 0.0, 0.0, 0.0, LATITUDE, LONGITUDE, 489.4)
        c.send(mavlink.MAVLink_command_int_message(*home))
        assert c.acknowledged(mavlink.MAV_CMD_DO_SET_HOME) == 0
        assert upload(c, [item(5100, 22.0, 14.0, 0.0, params=(0.0,) * 4)], RALLY)[0] == 0
        assert c.set_mode(RETURN) == 0
        c.until(lambda: not c.armed, 60.0)
        assert c.position == pytest.approx((22.0, 14.0, 0.0), abs=0.6)


def test_positions_on_the_earth_are_consistent():
    with Flight(start=((120.0, -80.0, -30.0), 0.0), file=QUICK) as c:
        for name in ("HOME_POSITION", "GPS_GLOBAL_ORIGIN", "GLOBAL_POSITION_INT", "GPS_RAW_INT"):
            assert c.request(name) == 0
        origin = c.last["GPS_GLOBAL_ORIGIN"]
        assert local_position(1e-7 * origin.latitude, 1e-7 * origin.longitude, 1e-3 * origin.altitude) == pytest.approx(
            (0.0, 0.0, 0.0), abs=0.01
        )
        home = c.last["HOME_POSITION"]
        place = local_position(1e-7 * home.latitude, 1e-7 * home.longitude, 1e-3 * home.altitude)
        assert place == pytest.approx((home.x, home.y, home.z), abs=0.02)
        here = c.last["GLOBAL_POSITION_INT"]
        place = local_position(1e-7 * here.lat, 1e-7 * here.lon, 1e-3 * here.alt)
        assert place == pytest.approx(c.position, abs=0.05)
        assert here.relative_alt == pytest.approx(30_000, abs=50)
        assert c.last["GPS_RAW_INT"].fix_type == 3
