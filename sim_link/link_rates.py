"""How often each message goes out on a link that was just started, as PX4 starts its links (mavlink_main.cpp).

Rates in Hz; 0: only when asked for, by an interval or once. A message that is in no table cannot be had.
"""

from __future__ import annotations

from collections.abc import Mapping

from .codec import mavlink

UNLIMITED_HZ = 5.0
"""GPS_RAW_INT is sent with every fix; the receiver's rate."""


def _numbers(rates_hz: Mapping[str, float]) -> dict[int, float]:
    """Give the table by message number."""
    return {int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}")): rate for name, rate in rates_hz.items()}


_ON_REQUEST = {
    "AUTOPILOT_VERSION": 0.0,
    "AVAILABLE_MODES": 0.0,
    "ACTUATOR_OUTPUT_STATUS": 0.0,
    "SCALED_IMU": 0.0,
    "HIL_STATE_QUATERNION": 0.0,
    "MANUAL_CONTROL": 0.0,
}

# PX4's ONBOARD set.
ONBOARD_HZ: Mapping[int, float] = _numbers(
    _ON_REQUEST
    | {
        "HEARTBEAT": 1.0,
        "TIMESYNC": 10.0,
        "HIGHRES_IMU": 50.0,
        "ATTITUDE": 100.0,
        "ATTITUDE_QUATERNION": 50.0,
        "ODOMETRY": 30.0,
        "LOCAL_POSITION_NED": 30.0,
        "GLOBAL_POSITION_INT": 50.0,
        "ATTITUDE_TARGET": 10.0,
        "POSITION_TARGET_LOCAL_NED": 10.0,
        "POSITION_TARGET_GLOBAL_INT": 10.0,
        "SERVO_OUTPUT_RAW": 10.0,
        "RC_CHANNELS": 20.0,
        "VFR_HUD": 10.0,
        "NAV_CONTROLLER_OUTPUT": 10.0,
        "ALTITUDE": 10.0,
        "WIND_COV": 10.0,
        "GPS_RAW_INT": UNLIMITED_HZ,
        "SYS_STATUS": 5.0,
        "EXTENDED_SYS_STATE": 5.0,
        "ESTIMATOR_STATUS": 1.0,
        "SYSTEM_TIME": 1.0,
        "SCALED_PRESSURE": 1.0,
        "GPS_GLOBAL_ORIGIN": 1.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "CURRENT_MODE": 0.5,
        "MISSION_CURRENT": 0.5,
        "PING": 1.0,
        "VIBRATION": 0.5,
    }
)

# PX4's NORMAL set, with what the simulation's start script raises to 50 Hz on the ground link.
GROUND_HZ: Mapping[int, float] = _numbers(
    _ON_REQUEST
    | {
        "HEARTBEAT": 1.0,
        "TIMESYNC": 0.0,
        "HIGHRES_IMU": 0.0,
        "ATTITUDE": 50.0,
        "ATTITUDE_QUATERNION": 50.0,
        "ODOMETRY": 0.0,
        "LOCAL_POSITION_NED": 50.0,
        "GLOBAL_POSITION_INT": 50.0,
        "ATTITUDE_TARGET": 50.0,
        "POSITION_TARGET_LOCAL_NED": 50.0,
        "POSITION_TARGET_GLOBAL_INT": 1.0,
        "SERVO_OUTPUT_RAW": 50.0,
        "RC_CHANNELS": 20.0,
        "VFR_HUD": 4.0,
        "NAV_CONTROLLER_OUTPUT": 1.0,
        "ALTITUDE": 1.0,
        "WIND_COV": 0.5,
        "GPS_RAW_INT": 1.0,
        "SYS_STATUS": 1.0,
        "EXTENDED_SYS_STATE": 1.0,
        "ESTIMATOR_STATUS": 0.5,
        "SYSTEM_TIME": 1.0,
        "SCALED_PRESSURE": 1.0,
        "GPS_GLOBAL_ORIGIN": 1.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "CURRENT_MODE": 0.5,
        "MISSION_CURRENT": 0.5,
        "PING": 0.1,
        "VIBRATION": 0.1,
    }
)
