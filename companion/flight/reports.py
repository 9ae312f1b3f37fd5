"""What the autopilot says of itself between its states: mode, arming, ground contact, home, the thrust of its hover."""

from __future__ import annotations

import math
from typing import Any

from companion.config import Vehicle
from companion.control.types import GRAVITY_M_S2, Quat
from companion.control.vectors import axes
from companion.flight.health import ESTIMATOR_STATUS, SYS_STATUS, EstimatorHealth, SystemHealth
from companion.flight.phases import Autopilot, LandedState
from companion.flight.preflight import (
    ATTITUDE_TARGET,
    CALIBRATION_PARAMETERS,
    CURRENT_MODE,
    EXTENDED_SYS_STATE,
    HOME_POSITION,
)
from companion.frames import GeoPoint
from companion.link import codec
from companion.link.framing import Frame
from companion.link.modes import HOLD, Mode
from companion.link.version import AutopilotVersion

BATTERY_STATUS = 147
VOLTAGE_UNKNOWN = 0xFFFF
"""SYS_STATUS.voltage_battery."""
LOOP_PARAMETERS = (*CALIBRATION_PARAMETERS, "MC_REF_W_N", "MPC_THR_HOVER", "THR_MDL_FAC")
HOLD_THRUST_SHARE = 0.2
"""Of a new value in the smoothed thrust of the autopilot's hover."""
HOLD_THRUST_TRUST = 0.25
"""A measured hover thrust further from the weight is not believed: the vehicle file or the message is wrong."""

_LANDED_STATES = {state.value: state for state in LandedState}
_REPORTS = {
    *(CURRENT_MODE, EXTENDED_SYS_STATE, HOME_POSITION, ATTITUDE_TARGET, BATTERY_STATUS),
    *(SYS_STATUS, ESTIMATOR_STATUS),
}


def take_heartbeat(autopilot: Autopilot, frame: Frame) -> None:
    """HEARTBEAT: the mode that is flown, and whether the motors may turn."""
    heartbeat = codec.decode_heartbeat(frame.payload)
    autopilot.mode = Mode.from_custom_mode(heartbeat.custom_mode)
    autopilot.armed = heartbeat.armed
    autopilot.system_status = heartbeat.system_status


def take_report(autopilot: Autopilot, frame: Frame) -> None:
    """CURRENT_MODE, EXTENDED_SYS_STATE, HOME_POSITION, ATTITUDE_TARGET, BATTERY_STATUS, SYS_STATUS, ESTIMATOR_STATUS;
    others, and what cannot be read, change nothing."""
    if frame.msgid not in _REPORTS or (frame.msgid == ATTITUDE_TARGET and autopilot.mode != HOLD):
        return
    message: Any = codec.decode_cold(frame)
    if message is None:
        return
    if frame.msgid == CURRENT_MODE:
        autopilot.mode = Mode.from_custom_mode(message.custom_mode)
        autopilot.intended = Mode.from_custom_mode(message.intended_custom_mode)
    elif frame.msgid == EXTENDED_SYS_STATE:
        autopilot.landed = _LANDED_STATES.get(message.landed_state, LandedState.UNDEFINED)
    elif frame.msgid == SYS_STATUS:
        autopilot.health = SystemHealth.from_message(message)
        if 0 < message.voltage_battery < VOLTAGE_UNKNOWN:
            autopilot.battery_v = 1e-3 * message.voltage_battery
    elif frame.msgid == ESTIMATOR_STATUS:
        autopilot.estimator = EstimatorHealth.from_message(message)
    elif frame.msgid == BATTERY_STATUS:
        if message.id == 0:
            autopilot.battery = None if message.battery_remaining < 0 else 1e-2 * message.battery_remaining
    elif frame.msgid == ATTITUDE_TARGET:
        if 0.0 < message.thrust < 1.0:  # of the autopilot's own hover, by the mode above
            before = message.thrust if autopilot.hold_thrust is None else autopilot.hold_thrust
            autopilot.hold_thrust = before + HOLD_THRUST_SHARE * (message.thrust - before)
            if autopilot.gathers:
                autopilot.hold_thrusts.append(message.thrust)
    elif all(math.isfinite(x) for x in (message.x, message.y, message.z)):
        autopilot.home = (message.x, message.y, message.z)
        autopilot.home_amsl_m = message.altitude * 1e-3
        autopilot.home_global = _place(message)


def vehicle_facts(autopilot: Autopilot, version: AutopilotVersion | None) -> dict[str, Any]:
    """What the autopilot told of the vehicle and a vehicle file may want to know; JSON types only."""
    thrusts = autopilot.hold_thrusts
    shares = (autopilot.battery, None if autopilot.health is None else autopilot.health.battery)
    return {
        "autopilot": None if version is None else version.label,
        "battery_v": autopilot.battery_v,
        "battery_share": next((share for share in shares if share is not None), None),
        "hold_thrust": sum(thrusts) / len(thrusts) if thrusts else autopilot.hold_thrust,
        "hold_thrust_samples": len(thrusts),
        "parameters": {name: autopilot.parameters[name] for name in LOOP_PARAMETERS if name in autopilot.parameters},
    }


def _place(message: Any) -> GeoPoint | None:
    """The home position on the Earth; zero for both angles is what a vehicle without a global position sends."""
    if (message.latitude, message.longitude) == (0, 0):
        return None
    return GeoPoint(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)


def hover_thrust_n(autopilot: Autopilot, vehicle: Vehicle, q: Quat) -> float | None:
    """The thrust that held the vehicle, by the autopilot's own setpoint [N]; None when unknown or hard to believe.

    Args:
        autopilot: what it said.
        vehicle: weight and thrust curve.
        q: the attitude.
    """
    share = autopilot.hold_thrust
    if share is None:
        return None
    curve = vehicle.rotors.curve_factor
    thrust_n = vehicle.thrust_full_n * share * (curve * share + 1.0 - curve)
    expected_n = vehicle.body.mass_kg * GRAVITY_M_S2 / max(axes(q)[2][2], 0.5)
    return thrust_n if abs(thrust_n - expected_n) < HOLD_THRUST_TRUST * expected_n else None
