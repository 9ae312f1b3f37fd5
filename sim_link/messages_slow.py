"""The messages that no control loop waits for: instruments, sensors, battery, sticks, targets, clocks.

One method per message, as in `messages`; ranges are clipped to what the fields hold. Payloads are packed in pymavlink's
own wire order (`unpacker`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import cache
from typing import Any

from .autopilot import Autopilot
from .battery import CHARGE_LOW, Battery
from .codec import mavlink
from .estimator import Estimate
from .geodesy import GEOID_M, HOME_ALTITUDE_M, global_position
from .inner_loops import STOPPED
from .manual_control import Sticks
from .messages import euler, truth_payload
from .outputs import commands, pulse_widths
from .parameters import Parameters
from .physics import RigidState
from .rotation import Vec3, yaw_of
from .sensors import Sample, sample
from .vehicle_file import VehicleFile

SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
"""What this vehicle has; the radio and the geofence come and go."""
_STICKS = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
_FENCE = mavlink.MAV_SYS_STATUS_GEOFENCE

Payload = bytes | Any
BATTERY_PERIOD_US = 100_000
_GLOBAL_INT, _LOCAL_NED = 5, 1
_EPOCH_US = 1_767_225_600_000_000
"""Unix time at boot: 2026-01-01, so that the same flight gives the same bytes whenever it is flown."""
_GPS_SATELLITES, _GPS_FIX_3D = 12, 3
_EPH_M, _EPV_M, _SPEED_ACCURACY_M_S = 0.9, 1.78, 0.4
_ALL_FIELDS = 0x1FFF
"""HIGHRES_IMU.fields_updated"""
_UINT16_MAX = 0xFFFF


class SlowTelemetry:
    """Builds the slower messages from the state of the last tick."""

    def __init__(
        self,
        vehicle: VehicleFile,
        autopilot: Autopilot,
        parameters: Parameters,
        *,
        now: Estimate,
        rigid: RigidState,
        seed: int,
    ) -> None:
        self._autopilot = autopilot
        self._parameters = parameters
        self._estimate = now
        self._vehicle = vehicle
        self._seed = seed
        self._t_us = now.t_us
        self._rigid = self._rigid_before = rigid
        self._rigid_us = self._rigid_before_us = now.t_us
        """The true state of this tick and of the one before, and their times."""
        self._battery_us = now.t_us
        self._ping = 0
        self._sample: Sample | None = None
        self.battery = Battery(parameters, vehicle.mass_kg)
        m = mavlink
        self.builders: dict[int, Callable[[], Payload | None]] = {
            m.MAVLINK_MSG_ID_HIGHRES_IMU: self.highres_imu,
            m.MAVLINK_MSG_ID_SCALED_IMU: self.scaled_imu,
            m.MAVLINK_MSG_ID_SCALED_PRESSURE: self.scaled_pressure,
            m.MAVLINK_MSG_ID_VFR_HUD: self.vfr_hud,
            m.MAVLINK_MSG_ID_ALTITUDE: self.altitude,
            m.MAVLINK_MSG_ID_GPS_RAW_INT: self.gps_raw,
            m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self.global_origin,
            m.MAVLINK_MSG_ID_SYSTEM_TIME: self.system_time,
            m.MAVLINK_MSG_ID_SYS_STATUS: self.sys_status,
            m.MAVLINK_MSG_ID_BATTERY_STATUS: self.battery_status,
            m.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: self.position_target,
            m.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: self.position_target_global,
            m.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: self.nav_controller,
            m.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: self.servo_output,
            m.MAVLINK_MSG_ID_ACTUATOR_OUTPUT_STATUS: self.actuator_output,
            m.MAVLINK_MSG_ID_RC_CHANNELS: self.rc_channels,
            m.MAVLINK_MSG_ID_MANUAL_CONTROL: self.manual_control,
            m.MAVLINK_MSG_ID_WIND_COV: self.wind,
            m.MAVLINK_MSG_ID_VIBRATION: self.vibration,
            m.MAVLINK_MSG_ID_PING: self.ping,
            m.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: self.truth,
        }

    def update(self, t_us: int, estimate: Estimate, rigid: RigidState) -> bool:
        """Take over the state of a tick; returns whether the battery was looked at."""
        self._t_us, self._estimate = t_us, estimate
        self._sample = None
        self._rigid_before, self._rigid_before_us = self._rigid, self._rigid_us
        self._rigid, self._rigid_us = rigid, t_us
        if t_us - self._battery_us < BATTERY_PERIOD_US:
            return False
        self.battery.update(rigid.rotor_n, self._autopilot.armed, (t_us - self._battery_us) * 1e-6)
        self._battery_us = t_us
        self._autopilot.report_battery(self.battery.charge_state)
        return True

    @property
    def _passed_s(self) -> float:
        """Time between the last two ticks; 0 before the first."""
        return (self._rigid_us - self._rigid_before_us) * 1e-6

    def _acceleration(self) -> Vec3:
        """Give the mean acceleration NED [m/s^2] since the tick before."""
        passed_s = self._passed_s
        if passed_s <= 0.0:
            return (0.0, 0.0, 0.0)
        v, before = self._rigid.v, self._rigid_before.v
        return (v[0] - before[0]) / passed_s, (v[1] - before[1]) / passed_s, (v[2] - before[2]) / passed_s

    def _pulse_widths(self) -> tuple[int, int, int, int]:
        before, now = self._rigid_before.rotor_n, self._rigid.rotor_n
        return pulse_widths(commands(self._vehicle, before, now, self._passed_s), self._autopilot.armed)

    # State

    def vfr_hud(self) -> bytes | None:
        """VFR_HUD: there is no airspeed sensor; None while there is no estimate."""
        if not self._autopilot.has_estimate:
            return None
        e = self._estimate
        throttle = self._autopilot.held.thrust if self._autopilot.armed else 0.0
        percent = _whole(100.0 * throttle, 0, 100)
        heading = int(math.degrees(yaw_of(e.q)) % 360.0) if math.isfinite(yaw_of(e.q)) else 0
        ground = math.hypot(e.v[0], e.v[1])
        return _pack("VFR_HUD", 0.0, ground, HOME_ALTITUDE_M - e.p[2], -e.v[2], heading, percent)

    def altitude(self) -> bytes:
        """ALTITUDE: above sea level, above the local origin, above home; the terrain is flat at the origin's height.

        Without an estimate only the barometer's height, which never jumps (altitude_monotonic), is there.
        """
        e = self._estimate
        if not self._autopilot.has_estimate:
            monotonic, none = HOME_ALTITUDE_M - self._rigid.p[2], math.nan
            return _pack("ALTITUDE", self._t_us, monotonic, none, none, none, HOME_ALTITUDE_M, none)
        amsl = HOME_ALTITUDE_M - e.p[2]
        above_home = self._autopilot.guidance.home[2] - e.p[2]
        return _pack("ALTITUDE", self._t_us, amsl, amsl, -e.p[2], above_home, HOME_ALTITUDE_M, -e.p[2])

    def gps_raw(self) -> bytes:
        """GPS_RAW_INT: a 3D fix, as good as PX4's simulated receiver."""
        r = self._rigid
        latitude, longitude, altitude_m = global_position(r.p)
        speed = math.hypot(r.v[0], r.v[1])
        course = math.degrees(math.atan2(r.v[1], r.v[0])) % 360.0 if math.isfinite(speed) else 0.0
        altitude_mm = _int32(1000.0 * altitude_m)
        return _pack(
            "GPS_RAW_INT", self._t_us, latitude, longitude, altitude_mm, _whole(100.0 * _EPH_M, 0, _UINT16_MAX),
            _whole(100.0 * _EPV_M, 0, _UINT16_MAX), _whole(100.0 * speed, 0, _UINT16_MAX),
            int(100.0 * course) % 36000, _GPS_FIX_3D, _GPS_SATELLITES, _int32(1000.0 * (altitude_m + GEOID_M)),
            round(1000.0 * _EPH_M), round(1000.0 * _EPV_M), round(1000.0 * _SPEED_ACCURACY_M_S), 0, 0,
        )  # fmt: skip

    def global_origin(self) -> Any:
        """GPS_GLOBAL_ORIGIN: where the local origin is."""
        latitude, longitude, altitude_m = global_position((0.0, 0.0, 0.0))
        return mavlink.MAVLink_gps_global_origin_message(latitude, longitude, _int32(1000.0 * altitude_m), self._t_us)

    def system_time(self) -> Any:
        """SYSTEM_TIME: a clock that GPS has set; it does not look at the machine's."""
        return mavlink.MAVLink_system_time_message(_EPOCH_US + self._t_us, self._t_us // 1000 & 0xFFFFFFFF)

    def ping(self) -> Any:
        """PING: a request to everybody."""
        self._ping = (self._ping + 1) & 0xFFFFFFFF
        return mavlink.MAVLink_ping_message(self._t_us, self._ping, 0, 0)

    # Sensors

    def _measured(self) -> Sample:
        """Give this tick's sample, the same to everybody who asks."""
        if self._sample is None:
            self._sample = sample(self._seed, self._rigid_us, self._rigid, self._acceleration())
        return self._sample

    def highres_imu(self) -> bytes:
        """HIGHRES_IMU."""
        s = self._measured()
        return _pack(
            "HIGHRES_IMU", self._t_us, *s.acceleration, *s.rates, *s.field, s.pressure_hpa, 0.0, s.pressure_altitude_m,
            s.temperature_c, _ALL_FIELDS, 0,
        )  # fmt: skip

    def scaled_imu(self) -> Any:
        """SCALED_IMU: mG, mrad/s, mgauss."""
        s = self._measured()
        values = [1000.0 * a / 9.80665 for a in s.acceleration]
        values += [1000.0 * x for x in (*s.rates, *s.field)]
        return mavlink.MAVLink_scaled_imu_message(self._t_us // 1000, *(_whole(x, -32768, 32767) for x in values))

    def scaled_pressure(self) -> Any:
        """SCALED_PRESSURE."""
        s = self._measured()
        temperature = round(100.0 * s.temperature_c)
        return mavlink.MAVLink_scaled_pressure_message(self._t_us // 1000, s.pressure_hpa, 0.0, temperature)

    def truth(self) -> bytes:
        """HIL_STATE_QUATERNION: what really happens, for who asks for it on a link."""
        r = self._rigid
        return truth_payload(self._t_us, r.p, r.v, r.q, r.w, self._acceleration())

    def vibration(self) -> Any:
        """VIBRATION: there is none."""
        return mavlink.MAVLink_vibration_message(self._t_us, 0.0, 0.0, 0.0, 0, 0, 0)

    def wind(self) -> bytes | None:
        """WIND_COV: PX4 estimates the wind of a multirotor only from its drag, which is off by default."""
        return None

    # Battery and outputs

    def sys_status(self) -> bytes:
        """SYS_STATUS: the sensors are well; PREARM_CHECK says whether arming would be allowed."""
        autopilot, battery = self._autopilot, self.battery
        present = SENSORS | _FENCE | (_STICKS if autopilot.sticks_ok else 0)
        health = present
        if not autopilot.armed and not autopilot.ready_to_arm:
            health &= ~mavlink.MAV_SYS_STATUS_PREARM_CHECK
        if autopilot.breach is not None:
            health &= ~_FENCE
        if not autopilot.has_estimate:
            health &= ~mavlink.MAV_SYS_STATUS_AHRS
        if battery.charge_state > CHARGE_LOW:
            health &= ~mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
        return _pack(
            "SYS_STATUS", present, present, health, 100, _whole(1000.0 * battery.voltage_v, 0, _UINT16_MAX - 1),
            _whole(100.0 * battery.current_a, 0, 32767), *(0,) * 6, round(100.0 * battery.remaining), 0, 0, 0,
        )  # fmt: skip

    def battery_status(self) -> Any:
        """BATTERY_STATUS."""
        b = self.battery
        cell_mv = _whole(1000.0 * b.voltage_v / b.cells, 0, _UINT16_MAX - 1)
        voltages = [cell_mv] * min(b.cells, 10) + [_UINT16_MAX] * max(0, 10 - b.cells)
        more = [cell_mv if 10 + k < b.cells else 0 for k in range(4)]
        return mavlink.MAVLink_battery_status_message(
            0, 0, 0, 32767, voltages, _whole(100.0 * b.current_a, 0, 32767), _int32(b.consumed_mah),
            _int32(b.consumed_j / 100.0), round(100.0 * b.remaining), b.time_remaining_s, b.charge_state, more, 0, 0,
        )  # fmt: skip

    def servo_output(self) -> bytes:
        """SERVO_OUTPUT_RAW of the four rotors, in PX4's order."""
        pwm = self._pulse_widths()
        return _pack("SERVO_OUTPUT_RAW", self._t_us & 0xFFFFFFFF, *pwm, *(0,) * 4, 0, *(0,) * 8)

    def actuator_output(self) -> Any:
        """ACTUATOR_OUTPUT_STATUS."""
        pwm = [float(x) for x in self._pulse_widths()]
        return mavlink.MAVLink_actuator_output_status_message(self._t_us, 4, pwm + [0.0] * 28)

    # Sticks

    def rc_channels(self) -> bytes | None:
        """RC_CHANNELS: roll, pitch, throttle and yaw [us]; None without a radio."""
        channels = self._autopilot.sticks.channels
        if channels is None:
            return None
        rest = (_UINT16_MAX,) * (18 - len(channels))
        return _pack("RC_CHANNELS", self._t_us // 1000, *channels, *rest, len(channels), 100)

    def manual_control(self) -> Any | None:
        """MANUAL_CONTROL as it is obeyed; None without sticks."""
        sticks: Sticks | None = self._autopilot.sticks.now(self._t_us)
        if sticks is None:
            return None
        pitch, roll, yaw = (_whole(1000.0 * x, -1000, 1000) for x in (sticks.pitch, sticks.roll, sticks.yaw))
        throttle = _whole(500.0 * (sticks.throttle + 1.0), 0, 1000)
        return mavlink.MAVLink_manual_control_message(self._autopilot.system, pitch, roll, throttle, yaw, 0)

    # Targets

    def position_target(self) -> bytes | None:
        """POSITION_TARGET_LOCAL_NED: what the position controller follows; None while it follows nothing."""
        target = self._autopilot.position_setpoint
        if target is None:
            return None
        return _pack(
            "POSITION_TARGET_LOCAL_NED", self._t_us // 1000, *target.p, *target.v, *target.a, target.yaw,
            target.yaw_rate, 0, _LOCAL_NED,
        )  # fmt: skip

    def position_target_global(self) -> bytes | None:
        """POSITION_TARGET_GLOBAL_INT; None while there is no position to fly to."""
        target = self._autopilot.position_setpoint
        if target is None or not all(map(math.isfinite, target.p)):
            return None
        latitude, longitude, altitude_m = global_position(target.p)
        return _pack(
            "POSITION_TARGET_GLOBAL_INT", self._t_us // 1000, latitude, longitude, altitude_m, *target.v, *target.a,
            target.yaw, target.yaw_rate, 0, _GLOBAL_INT,
        )  # fmt: skip

    def nav_controller(self) -> bytes | None:
        """NAV_CONTROLLER_OUTPUT: attitude setpoint, and bearing and distance to where it flies."""
        autopilot, e = self._autopilot, self._estimate
        target = autopilot.position_setpoint
        if target is None or not autopilot.has_estimate or not autopilot.armed or autopilot.held.mode == STOPPED:
            return None
        roll, pitch, yaw = (math.degrees(x) for x in euler(autopilot.held.q))
        north, east = _or_zero(target.p[0] - e.p[0]), _or_zero(target.p[1] - e.p[1])
        bearing = _whole(math.degrees(math.atan2(east, north)), -180, 180)
        distance = _whole(math.hypot(north, east), 0, _UINT16_MAX)
        below = _or_zero(e.p[2] - target.p[2])
        heading = _whole(yaw, -180, 180)
        return _pack("NAV_CONTROLLER_OUTPUT", roll, pitch, below, 0.0, 0.0, heading, bearing, distance)


def _pack(name: str, *fields: float) -> bytes:
    """Pack a payload; fields in wire order."""
    return _layout(name).pack(*fields)


@cache
def _layout(name: str) -> struct.Struct:
    """Give the wire format of a message's payload."""
    return struct.Struct(getattr(mavlink, f"MAVLink_{name.lower()}_message").unpacker.format)


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _whole(value: float, low: int, high: int) -> int:
    """Round to a range; NaN becomes the nearest to 0."""
    if low <= value <= high:
        return round(value)
    if math.isnan(value):
        value = 0.0
    return round(min(float(high), max(float(low), value)))


def _int32(value: float) -> int:
    return _whole(value, -2147483648, 2147483647)
