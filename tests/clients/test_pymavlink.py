"""pymavlink's own helpers for parameters and missions, and its connection, against the vehicle's ground link."""

import time

import pytest
from client_tools import mission, vehicle

mavparm = pytest.importorskip("pymavlink.mavparm", reason="pymavlink is not installed")
mavutil = pytest.importorskip("pymavlink.mavutil")
mavwp = pytest.importorskip("pymavlink.mavwp")


@pytest.fixture(scope="module")
def link():
    with vehicle() as ready:
        connection = mavutil.mavlink_connection(f"udpin:127.0.0.1:{ready['ground_remote_port']}")
        try:
            assert connection.wait_heartbeat(timeout=10) is not None
            connection.mav.heartbeat_send(mavutil.mavlink.MAV_TYPE_GCS, 8, 0, 0, 4)
            yield connection
        finally:
            connection.close()


def until(link, kind, condition=lambda _: True, seconds=10.0):
    """Wait for a message that is as wanted."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        message = link.recv_match(type=kind, blocking=True, timeout=0.5)
        if message is not None and condition(message):
            return message
    pytest.fail(f"no {kind}")


def test_mavparm_fetches_saves_and_sets(link, tmp_path):
    link.param_fetch_all()
    last = until(link, "PARAM_VALUE", lambda m: m.param_index == m.param_count - 1)
    parameters = mavparm.MAVParmDict()
    for name, value in link.params.items():
        parameters[name] = value
    assert len([name for name in parameters if name != "_HASH_CHECK"]) == last.param_count
    path = tmp_path / "all.parm"
    parameters.save(str(path))
    again = mavparm.MAVParmDict()
    assert again.load(str(path))
    assert again["MPC_XY_P"] == pytest.approx(0.95, abs=1e-6)
    assert parameters.mavset(link, "MPC_XY_CRUISE", 3.25, parm_type=mavutil.mavlink.MAV_PARAM_TYPE_REAL32)
    assert parameters.mavset(link, "COM_OBL_RC_ACT", 4, parm_type=mavutil.mavlink.MAV_PARAM_TYPE_INT32)
    link.param_fetch_one("MPC_XY_CRUISE")
    assert until(link, "PARAM_VALUE", lambda m: m.param_id == "MPC_XY_CRUISE").param_value == 3.25


def test_mavwp_sends_a_plan_in_floats_and_gets_it_back(link, tmp_path):
    loader = mavwp.MAVWPLoader(link.target_system, link.target_component)
    for k, item in enumerate(mission(12)):
        degrees = (1e-7 * item["x"], 1e-7 * item["y"])
        params = [0.0 if value != value else value for value in item["params"]]
        loader.add(
            mavutil.mavlink.MAVLink_mission_item_message(
                link.target_system, link.target_component, k, item.get("frame", 3), item["command"], int(k == 0), 1,
                *params, *degrees, item["z"],
            )
        )  # fmt: skip
    path = tmp_path / "plan.txt"
    loader.save(str(path))
    assert loader.load(str(path)) == 12
    link.waypoint_clear_all_send()
    assert until(link, "MISSION_ACK").type == 0
    link.waypoint_count_send(loader.count())
    for _ in range(loader.count()):
        request = until(link, ["MISSION_REQUEST", "MISSION_REQUEST_INT"])
        link.mav.send(loader.wp(request.seq))
    assert until(link, "MISSION_ACK").type == 0
    link.waypoint_request_list_send()
    assert until(link, "MISSION_COUNT").count == 12
    back = mavwp.MAVWPLoader(link.target_system, link.target_component)
    for k in range(12):
        link.waypoint_request_send(k)
        back.add(until(link, ["MISSION_ITEM", "MISSION_ITEM_INT"]))
    link.mav.mission_ack_send(link.target_system, link.target_component, 0)
    for sent, got in zip(loader.wpoints, back.wpoints, strict=True):
        scale = 1e-7 if got.get_type() == "MISSION_ITEM_INT" and got.frame != 2 else 1.0
        assert (got.command, got.frame, got.param1, got.param2) == (sent.command, sent.frame, sent.param1, sent.param2)
        assert scale * got.x == pytest.approx(sent.x, abs=1e-5)  # a float of degrees is as coarse as that
        assert got.z == pytest.approx(sent.z)


def test_arming_and_modes_by_name(link):
    until(link, "SYS_STATUS", lambda m: m.onboard_control_sensors_health & mavutil.mavlink.MAV_SYS_STATUS_PREARM_CHECK)
    link.set_mode("TAKEOFF")
    until(link, "HEARTBEAT", lambda m: link.flightmode == "TAKEOFF")
    link.arducopter_arm()
    assert until(link, "COMMAND_ACK", lambda m: m.command == 400).result == 0
    until(link, "EXTENDED_SYS_STATE", lambda m: m.landed_state == mavutil.mavlink.MAV_LANDED_STATE_IN_AIR)
    link.set_mode("LAND")
    until(link, "HEARTBEAT", lambda m: link.flightmode == "LAND")
    until(link, "EXTENDED_SYS_STATE", lambda m: m.landed_state == mavutil.mavlink.MAV_LANDED_STATE_ON_GROUND)
