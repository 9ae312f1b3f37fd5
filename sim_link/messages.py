"""The vehicle's state as MAVLink messages, one method per message.

Frames, stamps, covariances and the staleness of ATTITUDE_TARGET are PX4's. Frequent messages give packed payloads, rare
ones pymavlink objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from . import codec
from .autopilot import Autopilot
from .codec import mavlink
from .estimator import Estimate
from .geodesy import global_position
from .modes import FLAG_ARMED, Mode
from .parameters import Parameters
from .rotation import Vec3, clip, yaw_of
from .vehicle_file import VehicleFile

_LOCAL_NED = 1
_ESTIMATOR_AUTOPILOT = 8
_STANDARD_G = 9.80665
_ESTIMATOR_FLAGS = 1 | 2 | 4 | 8 | 16 | 32 | 64
"""Attitude, velocity and position (horizontal relative and absolute, vertical absolute and above ground) are good."""
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
CAPABILITY_SET_ACTUATOR_TARGET = 1024
"""The bit that said that message 139 is obeyed; today's dialect calls it reserved."""
_VERSIONS = {"1.18": (1, 18, 0), "1.13": (1, 13, 3)}
_ATTITUDE = mavlink.MAVLink_attitude_message.unpacker
_EXTENDED_SYS_STATE = mavlink.MAVLink_extended_sys_state_message.unpacker
_ESTIMATOR_STATUS = mavlink.MAVLink_estimator_status_message.unpacker
_CURRENT_MODE = mavlink.MAVLink_current_mode_message.unpacker
_TEXT_LENGTH = 50
_HEADING_UNKNOWN = 65535
_RELEASE = 255
"""FIRMWARE_VERSION_TYPE_OFFICIAL"""

Payload = bytes | Any


class Telemetry:
    """Builds every message that the vehicle can send from the state of the last tick."""

    def __init__(
        self,
        vehicle: VehicleFile,
        autopilot: Autopilot,
        parameters: Parameters,
        *,
        instance: int,
        now: Estimate,
        rates: Callable[[], Vec3],
    ) -> None:
        """Begin with an estimate; `rates` gives the body rates that the rate loop follows [rad/s]."""
        self._autopilot = autopilot
        self._parameters = parameters
        self._instance = instance
        self._estimate = now
        self._t_us = now.t_us
        self._rates = rates
        self._covariances = self._pack_covariances(vehicle)
        self._odometry_rest = b""
        self._odometry_reset = -1
        """What ends an ODOMETRY message, and the reset counter in it."""
        self.reset_counter = 0
        """Of the estimator: any change tells receivers to start their filters anew."""
        self.stamp_shift_us = 0
        """Added to the stamps of state messages that are stamped with the time of publication."""
        self.builders: dict[int, Callable[[], Payload | None]] = {
            codec.ID_HEARTBEAT: self.heartbeat,
            codec.ID_ODOMETRY: self.odometry,
            codec.ID_ATTITUDE_QUATERNION: self.attitude_quaternion,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self.attitude,
            codec.ID_LOCAL_POSITION_NED: self.local_position,
            codec.ID_GLOBAL_POSITION_INT: self.global_position,
            codec.ID_ATTITUDE_TARGET: self.attitude_target,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self.extended_sys_state,
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self.estimator_status,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: self.home_position,
            mavlink.MAVLINK_MSG_ID_CURRENT_MODE: self.current_mode,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self.autopilot_version,
        }
        """What builds each message that there is (see `build`)."""

    def update(self, t_us: int, estimate: Estimate) -> None:
        """Take over the state of a tick."""
        self._t_us = t_us
        self._estimate = estimate

    def build_ahead(self, t_us: int, estimate: Estimate, ids: Iterable[int]) -> list[tuple[int, Payload | None]]:
        """Build those messages of another time that there are; what is told of the present stays as it is."""
        now_us, now = self._t_us, self._estimate
        self._t_us, self._estimate = t_us, estimate
        built, builders = [], self.builders
        for msg_id in ids:
            if msg_id in builders:
                built.append((msg_id, builders[msg_id]()))
        self._t_us, self._estimate = now_us, now
        return built

    @property
    def sample_us(self) -> int:
        """Stamp of the estimate that is told."""
        return self._estimate.t_us

    def _published_ms(self) -> int:
        """Give the stamp of a state message that tells the time of publication."""
        return max(0, self._t_us + self.stamp_shift_us) // 1000

    def add(self, builders: Mapping[int, Callable[[], Payload | None]]) -> None:
        """Take in messages that are built elsewhere."""
        self.builders.update(builders)

    def knows(self, msg_id: int) -> bool:
        """Tell whether the vehicle has such a message."""
        return msg_id in self.builders

    def build(self, msg_id: int) -> Payload | None:
        """Build a message: packed payload or pymavlink object; None: unknown, or there is no data for it yet."""
        builder = self.builders.get(msg_id)
        return None if builder is None else builder()

    @staticmethod
    def _pack_covariances(vehicle: VehicleFile) -> bytes:
        """Pack ODOMETRY's two covariances: diagonals (0, 6, 11, 15, 18, 20) of the upper triangles, from the noise."""
        diagonal = (0, 6, 11, 15, 18, 20)
        pose, velocity = [0.0] * 21, [0.0] * 21
        for k, index in enumerate(diagonal):
            pose[index] = (vehicle.noise_position_m if k < 3 else vehicle.noise_attitude_rad) ** 2
            velocity[index] = (vehicle.noise_velocity_m_s if k < 3 else vehicle.noise_rate_rad_s) ** 2
        return codec.COVARIANCE.pack(*pose) + codec.COVARIANCE.pack(*velocity)

    def odometry(self) -> bytes | None:
        """ODOMETRY of the present estimate; None while there is none, as for the other messages that tell one."""
        return self.odometry_of(self._estimate) if self._autopilot.has_estimate else None

    def odometry_of(self, estimate: Estimate) -> bytes:
        """ODOMETRY: velocity is NED although PX4 could name a body frame; time_usec is the sample's."""
        if self._odometry_reset != self.reset_counter:
            self._odometry_reset = self.reset_counter
            self._odometry_rest = codec.ODOMETRY_REST.pack(
                self._covariances, _LOCAL_NED, _LOCAL_NED, self.reset_counter, _ESTIMATOR_AUTOPILOT, 0
            )
        t_us, p, v, q, w = estimate
        return codec.ODOMETRY_STATE.pack(t_us, *p, *q, *v, *w) + self._odometry_rest

    def attitude_quaternion(self) -> bytes | None:
        """ATTITUDE_QUATERNION, stamped with the sample's time."""
        if not self._autopilot.has_estimate:
            return None
        e = self._estimate
        return codec.ATTITUDE_QUATERNION.pack(e.t_us // 1000, *e.q, *e.w, 0.0, 0.0, 0.0, 0.0)

    def attitude(self) -> bytes | None:
        """ATTITUDE: Euler angles."""
        if not self._autopilot.has_estimate:
            return None
        e = self._estimate
        return bytes(_ATTITUDE.pack(e.t_us // 1000, *euler(e.q), *e.w))

    def local_position(self) -> bytes | None:
        """LOCAL_POSITION_NED: PX4 stamps it with the time of publication, not of the sample."""
        if not self._autopilot.has_estimate:
            return None
        e = self._estimate
        return codec.LOCAL_POSITION_NED.pack(self._published_ms(), *e.p, *e.v)

    def global_position(self) -> bytes | None:
        """GLOBAL_POSITION_INT; what is no number becomes 0, a heading that is none the value for unknown."""
        if not self._autopilot.has_estimate:
            return None
        e = self._estimate
        latitude, longitude, altitude_m = global_position(e.p)
        yaw = yaw_of(e.q)
        heading = int(100.0 * (math.degrees(yaw) % 360.0)) % 36000 if math.isfinite(yaw) else _HEADING_UNKNOWN
        above_home_m = self._autopilot.guidance.home[2] - e.p[2]
        speeds = [_int16(100.0 * x) for x in e.v]
        return codec.GLOBAL_POSITION_INT.pack(
            self._published_ms(),
            latitude,
            longitude,
            _int32(1000.0 * altitude_m),
            _int32(1000.0 * above_home_m),
            *speeds,
            heading,
        )

    def attitude_target(self) -> bytes | None:
        """ATTITUDE_TARGET: the rates in use; attitude and thrust are of the last ATTITUDE setpoint, stale in rates.

        None before the first setpoint.
        """
        last = self._autopilot.attitude_setpoint
        if last is None:
            if not self._autopilot.armed:
                return None
            return codec.ATTITUDE_TARGET.pack(self._t_us // 1000, 0.0, 0.0, 0.0, 0.0, *self._rates(), 0.0, 0)
        return codec.ATTITUDE_TARGET.pack(self._t_us // 1000, *last.q, *self._rates(), abs(last.thrust), 0)

    def heartbeat(self) -> Any:
        """HEARTBEAT."""
        autopilot = self._autopilot
        flags = autopilot.mode.base_flags | (FLAG_ARMED if autopilot.armed else 0)
        return mavlink.MAVLink_heartbeat_message(
            self._parameters.integer("MAV_TYPE") & 0xFF,
            mavlink.MAV_AUTOPILOT_PX4,
            flags,
            autopilot.mode.custom_mode,
            self._system_status(),
            3,
        )

    def _system_status(self) -> int:
        """Give MAV_STATE as PX4 does."""
        autopilot = self._autopilot
        if autopilot.terminated:
            return int(mavlink.MAV_STATE_FLIGHT_TERMINATION)
        if autopilot.in_failsafe:
            return int(mavlink.MAV_STATE_CRITICAL)
        if autopilot.armed:
            return int(mavlink.MAV_STATE_ACTIVE)
        return int(mavlink.MAV_STATE_STANDBY)

    def extended_sys_state(self) -> bytes:
        """EXTENDED_SYS_STATE: landed state."""
        autopilot = self._autopilot
        state = mavlink.MAV_LANDED_STATE_IN_AIR
        if autopilot.land.landed:
            state = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif autopilot.mode is Mode.LAND:
            state = mavlink.MAV_LANDED_STATE_LANDING
        elif autopilot.mode is Mode.TAKEOFF:
            state = mavlink.MAV_LANDED_STATE_TAKEOFF
        return bytes(_EXTENDED_SYS_STATE.pack(mavlink.MAV_VTOL_STATE_UNDEFINED, state))

    def estimator_status(self) -> bytes:
        """ESTIMATOR_STATUS: all that offboard control needs is valid; nothing is while there is no estimate."""
        flags = _ESTIMATOR_FLAGS if self._autopilot.has_estimate else 0
        return bytes(_ESTIMATOR_STATUS.pack(self._t_us, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.1, flags))

    def home_position(self) -> Any:
        """HOME_POSITION."""
        home = self._autopilot.guidance.home
        latitude, longitude, altitude_m = global_position(home)
        return mavlink.MAVLink_home_position_message(
            latitude,
            longitude,
            _int32(1000.0 * altitude_m),
            *home,
            [1.0, 0.0, 0.0, 0.0],
            0.0,
            0.0,
            0.0,
            self._t_us,
        )

    def current_mode(self) -> bytes:
        """CURRENT_MODE: what is flown, and what was asked for."""
        autopilot = self._autopilot
        mode, intended = autopilot.mode, autopilot.intended
        return bytes(_CURRENT_MODE.pack(mode.custom_mode, intended.custom_mode, mode.standard))

    def autopilot_version(self) -> Any:
        """AUTOPILOT_VERSION: the version tells whether message 139 is obeyed, and so does the capability of old."""
        major, minor, patch = _VERSIONS[self._autopilot.px4]
        version = major << 24 | minor << 16 | patch << 8 | _RELEASE
        capabilities = _CAPABILITIES
        if self._autopilot.px4 == "1.13":
            capabilities |= CAPABILITY_SET_ACTUATOR_TARGET
        uid2 = [0x53, 0x49, 0x4D, *(0,) * 14, self._instance & 0xFF]
        none = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(
            capabilities, version, version, 0, 0, none, none, none, 0, 0, 1 + self._instance, uid2
        )

    @staticmethod
    def status_texts(severity: int, sentence: str, number: int) -> list[Any]:
        """STATUSTEXT: a sentence of more than 50 bytes goes in numbered chunks under one id (1..65535)."""
        text = sentence.encode()
        chunks = [text[at : at + _TEXT_LENGTH] for at in range(0, len(text), _TEXT_LENGTH)]
        if len(chunks) == 1:
            return [mavlink.MAVLink_statustext_message(severity, text)]
        return [mavlink.MAVLink_statustext_message(severity, part, number, k) for k, part in enumerate(chunks)]


def truth_payload(t_us: int, p: Vec3, v: Vec3, q: tuple[float, ...], w: Vec3, acceleration: Vec3) -> bytes:
    """Pack HIL_STATE_QUATERNION: speeds in cm/s, accelerations in mG as the specification says (PX4 sends m/s^2)."""
    latitude, longitude, altitude_m = global_position(p)
    airspeed = min(65535, max(0, round(100.0 * math.hypot(*v)))) if all(map(math.isfinite, v)) else 0
    return codec.HIL_STATE_QUATERNION.pack(
        t_us,
        *q,
        *w,
        latitude,
        longitude,
        _int32(1000.0 * altitude_m),
        *(_int16(100.0 * x) for x in v),
        airspeed,
        airspeed,
        *(_int16(1000.0 * x / _STANDARD_G) for x in acceleration),
    )


def euler(q: tuple[float, float, float, float]) -> Vec3:
    """Give roll, pitch and yaw [rad] of an attitude."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    sine = 2.0 * (w * y - z * x)
    return roll, math.asin(clip(sine, -1.0, 1.0)), yaw_of(q)


def _int16(value: float) -> int:
    """Round to what an int16 field holds; NaN becomes 0."""
    if -32768.0 <= value <= 32767.0:
        return round(value)
    return round(min(32767.0, max(-32768.0, value))) if not math.isnan(value) else 0


def _int32(value: float) -> int:
    """Round to what an int32 field holds; NaN becomes 0."""
    if -2147483648.0 <= value <= 2147483647.0:
        return round(value)
    return round(min(2147483647.0, max(-2147483648.0, value))) if not math.isnan(value) else 0
