"""A program with MAVSDK as anybody would write it; prints one line of JSON with what it saw.

Arguments: scenario, UDP port to listen on.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time

import mavsdk as native
from client_tools import mission
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.mission_raw import MissionItem
from mavsdk.plugins.offboard import AttitudeRate, PositionNedYaw, VelocityBodyYawspeed
from mavsdk.plugins.telemetry import FlightMode

PATIENCE_S = 15.0


async def first(stream, condition, what: str):
    """Wait for the first value of a stream that is as wanted."""

    async def search():
        async for value in stream:
            if condition(value):
                return value

    try:
        return await asyncio.wait_for(search(), PATIENCE_S)
    except TimeoutError:
        raise SystemExit(f"not within {PATIENCE_S} s: {what}") from None


async def flight(system) -> dict:
    """Connect, wait for health, arm, take off, go somewhere, hold, land, disarm."""
    action, telemetry = ActionAsync(system), TelemetryAsync(system)
    seen: dict = {}
    await first(telemetry.subscribe_health_all_ok(), bool, "health_all_ok")
    seen["version"] = (await InfoAsync(system).get_version()).flight_sw_major
    for name in (
        "position", "home", "in_air", "landed_state", "attitude_quaternion", "attitude_euler", "velocity_ned",
        "gps_info", "battery", "odometry", "position_velocity_ned", "imu", "scaled_imu", "ground_truth", "altitude",
    ):  # fmt: skip
        setter = getattr(telemetry, f"set_rate_{name}", None)
        if setter is not None:
            await setter(10.0)
    seen["odometry"] = (await first(telemetry.subscribe_odometry(), lambda _: True, "odometry")).time_usec > 0
    imu = await first(telemetry.subscribe_imu(), lambda _: True, "imu")
    seen["down_m_s2"] = imu.acceleration_frd.down_m_s2
    battery = await first(telemetry.subscribe_battery(), lambda _: True, "battery")
    seen["battery_v"] = battery.voltage_v
    gps = await first(telemetry.subscribe_gps_info(), lambda _: True, "gps")
    seen["satellites"] = gps.num_satellites
    home = await first(telemetry.subscribe_home(), lambda _: True, "home")
    await action.set_takeoff_altitude(4.0)
    await action.arm()
    await first(telemetry.subscribe_armed(), bool, "armed")
    await action.takeoff()
    await first(telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 3.7, "takeoff")
    await first(telemetry.subscribe_flight_mode(), lambda m: m == FlightMode.HOLD, "hold after takeoff")
    north_deg = math.degrees(10.0 / 6371000.0)
    goal = home.latitude_deg + north_deg
    await action.goto_location(goal, home.longitude_deg, home.absolute_altitude_m + 6.0, 90.0)
    there = await first(
        telemetry.subscribe_position_velocity_ned(),
        lambda x: math.dist((x.position.north_m, x.position.east_m, x.position.down_m), (10.0, 0.0, -6.0)) < 0.4,
        "goto",
    )
    seen["goto"] = [there.position.north_m, there.position.east_m, there.position.down_m]
    await first(telemetry.subscribe_heading(), lambda h: abs(h.heading_deg - 90.0) < 5.0, "yaw of goto")
    await action.hold()
    await action.land()
    await first(telemetry.subscribe_flight_mode(), lambda m: m == FlightMode.LAND, "land")
    await first(telemetry.subscribe_in_air(), lambda flying: not flying, "landed")
    try:
        await action.disarm()
    except Exception:  # it may have disarmed itself already
        seen["disarmed_itself"] = True
    await first(telemetry.subscribe_armed(), lambda armed: not armed, "disarmed")
    return seen


async def parameters(system) -> dict:
    """List, read and set every parameter."""
    param = ParamAsync(system)
    everything = await param.get_all_params()
    seen: dict = {"ints": len(everything.int_params), "floats": len(everything.float_params), "read_only": []}
    for item in everything.int_params:
        assert await param.get_param_int(item.name) == item.value, item.name
        # The system id stays: this is the one under which the vehicle is known here.
        await set_or_note(param.set_param_int, item.name, item.value, seen)
    for item in everything.float_params:
        value = await param.get_param_float(item.name)
        assert value == item.value or math.isnan(value), item.name
        await set_or_note(param.set_param_float, item.name, item.value, seen)
    await param.set_param_float("MPC_XY_CRUISE", 3.5)
    await param.set_param_int("COM_OBL_RC_ACT", 5)
    seen["changed"] = [await param.get_param_float("MPC_XY_CRUISE"), await param.get_param_int("COM_OBL_RC_ACT")]
    seen["refused"] = []
    for call, name in ((param.get_param_int, "NO_SUCH_PARAM"), (param.get_param_int, "MPC_XY_CRUISE")):
        try:
            await call(name)
        except Exception as error:
            seen["refused"].append(str(error).split(";")[0])
    return seen


async def set_or_note(setter, name, value, seen) -> None:
    try:
        await setter(name, value)
    except Exception:
        seen["read_only"].append(name)


async def plan(system) -> dict:
    """Upload a mission of 50 items, download it, fly a short one."""
    raw, telemetry, action = MissionRawAsync(system), TelemetryAsync(system), ActionAsync(system)
    items = [as_item(k, item) for k, item in enumerate(mission(50))]
    await raw.upload_mission(items)
    back = await raw.download_mission()
    seen: dict = {"same": [fields(item) for item in back] == [fields(item) for item in items], "count": len(back)}
    fence = [fence_corner(k) for k in range(4)]
    await raw.upload_geofence(fence)
    seen["fence"] = [fields(item) for item in await raw.download_geofence()] == [fields(item) for item in fence]
    await raw.clear_mission()
    try:
        seen["cleared"] = len(await raw.download_mission())
    except Exception as error:
        seen["cleared"] = str(error).split(";")[0]
    short = mission(6)
    await raw.upload_mission([as_item(k, item) for k, item in enumerate(short)])
    await first(telemetry.subscribe_health_all_ok(), bool, "health_all_ok")
    await action.arm()
    await raw.start_mission()
    await first(telemetry.subscribe_flight_mode(), lambda m: m == FlightMode.MISSION, "mission")
    progress = await first(raw.subscribe_mission_progress(), lambda p: p.current >= 3, "second waypoint")
    seen["total"] = progress.total
    await first(telemetry.subscribe_armed(), lambda armed: not armed, "landed at the end")
    return seen


def as_item(index: int, item: dict) -> MissionItem:
    return MissionItem(
        index, item.get("frame", 6), item["command"], int(index == 0), 1, *item["params"], item["x"], item["y"],
        item["z"], 0,
    )  # fmt: skip


def fence_corner(index: int) -> MissionItem:
    x = 473977420 + (5000 if index in (0, 1) else -5000)
    y = 85455940 + (5000 if index in (1, 2) else -5000)
    return MissionItem(index, 0, 5001, 0, 1, 4.0, 0.0, 0.0, 0.0, x, y, 0.0, 1)


def fields(item: MissionItem) -> list:
    """What an item says, with NaN written so that it equals itself."""
    values = (item.seq, item.frame, item.command, item.current, item.autocontinue, item.param1, item.param2)
    values += (item.param3, item.param4, item.x, item.y, item.z, item.mission_type)
    return ["nan" if value != value else value for value in values]


async def offboard(system) -> dict:
    """Position control, body velocity and attitude rates in OFFBOARD, from the ground."""
    control, telemetry, action = OffboardAsync(system), TelemetryAsync(system), ActionAsync(system)
    await first(telemetry.subscribe_health_all_ok(), bool, "health_all_ok")
    seen: dict = {}
    try:
        await control.start()
    except Exception as error:
        seen["without_setpoint"] = str(error).split(";")[0]
    await control.set_position_ned(PositionNedYaw(0.0, 0.0, -3.0, 0.0))
    await action.arm()
    await control.start()
    await at(telemetry, (0.0, 0.0, -3.0))
    await control.set_position_ned(PositionNedYaw(4.0, 3.0, -3.0, 90.0))
    await at(telemetry, (4.0, 3.0, -3.0))
    await first(telemetry.subscribe_heading(), lambda h: abs(h.heading_deg - 90.0) < 5.0, "yaw")
    await control.set_velocity_body(VelocityBodyYawspeed(2.0, 0.0, 0.0, 0.0))  # forward is east now
    v = await first(telemetry.subscribe_velocity_ned(), lambda v: v.east_m_s > 1.7, "velocity")
    seen["sideways"] = abs(v.north_m_s)
    hover = 0.981 * 0.5
    begin = time.monotonic()
    while time.monotonic() - begin < 0.6:  # three seconds of the vehicle's time, so that rates are in charge for sure
        await control.set_attitude_rate(AttitudeRate(0.0, 0.0, 30.0, hover))
        await asyncio.sleep(0.02)
    spin = await telemetry.attitude_angular_velocity_body()
    seen["yaw_rate_deg_s"] = math.degrees(spin.yaw_rad_s)
    await control.stop()
    await first(telemetry.subscribe_flight_mode(), lambda m: m == FlightMode.HOLD, "hold")
    await action.kill()
    return seen


async def at(telemetry, place) -> None:
    await first(
        telemetry.subscribe_position_velocity_ned(),
        lambda x: math.dist((x.position.north_m, x.position.east_m, x.position.down_m), place) < 0.3,
        f"position {place}",
    )


async def main(scenario: str, port: int) -> None:
    native.log_subscribe(lambda *_: True)
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as sdk:
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=PATIENCE_S)
        if system is None:
            raise SystemExit("no vehicle")
        scenarios = {"flight": flight, "parameters": parameters, "plan": plan, "offboard": offboard}
        print(json.dumps(await scenarios[scenario](system)), flush=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
