"""MAVLink payloads as bytes: the few messages that matter in flight are packed and unpacked here, without a library
in between.

Decoders take the payload as `wire` hands it out (truncated zeros restored; shorter input is filled up again) and
never raise: what the numbers mean, and whether they can be used, is judged elsewhere. Encoders return the whole
payload; `wire` trims its trailing zeros. Everything else goes through `decode_cold`, which asks pymavlink. Layouts
and CRC seeds are those of the MAVLink message definitions.
"""

from __future__ import annotations

import importlib
import os
import struct
from functools import lru_cache
from typing import Any, Final, NamedTuple, Protocol

from companion.control.types import Quat, Vec3, new_record

# Message ids of the messages that this program names itself.
HEARTBEAT: Final = 0
PARAM_REQUEST_READ: Final = 20
PARAM_VALUE: Final = 22
ATTITUDE_QUATERNION: Final = 31
COMMAND_LONG: Final = 76
COMMAND_ACK: Final = 77
SET_ATTITUDE_TARGET: Final = 82
SET_POSITION_TARGET_LOCAL_NED: Final = 84
TIMESYNC: Final = 111
SET_ACTUATOR_CONTROL_TARGET: Final = 139
AUTOPILOT_VERSION: Final = 148
STATUSTEXT: Final = 253
ODOMETRY: Final = 331
PARAM_ERROR: Final = 345

AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1."""
MAV_TYPE_ONBOARD_CONTROLLER: Final = 18
MAV_AUTOPILOT_PX4: Final = 12
MAV_AUTOPILOT_INVALID: Final = 8
MAV_STATE_ACTIVE: Final = 4
MAV_FRAME_LOCAL_NED: Final = 1
MAV_MODE_FLAG_SAFETY_ARMED: Final = 128

_HEARTBEAT = struct.Struct("<IBBBBB")
COMMAND_LONG_LAYOUT = struct.Struct("<7fHBBB")
COMMAND_ACK_LAYOUT = struct.Struct("<HBBiBB")
TIMESYNC_LAYOUT = struct.Struct("<qqBB")
_ATTITUDE_QUATERNION = struct.Struct("<I7f16x")
_ODOMETRY = struct.Struct("<Q13f168x4Bb")  # 168: two covariances of 21 floats
SET_ATTITUDE_TARGET_LAYOUT = struct.Struct("<I4f3ffBBB")
SET_POSITION_TARGET_LOCAL_NED_LAYOUT = struct.Struct("<I11fHBBB")
SET_ACTUATOR_CONTROL_TARGET_LAYOUT = struct.Struct("<Q8fBBB")
PARAM_REQUEST_READ_LAYOUT = struct.Struct("<hBB16s")
PARAM_VALUE_LAYOUT = struct.Struct("<4sHH16sB")
PARAM_ERROR_LAYOUT = struct.Struct("<hBB16sB")
STATUSTEXT_LAYOUT = struct.Struct("<B50sHB")
_AUTOPILOT_VERSION = struct.Struct("<QQIIIIHH24x18x")

_PARAM_TYPES: Final = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i", 9: "<f"}  # by MAV_PARAM_TYPE


class MessageFormat(NamedTuple):
    """What framing must know of a message."""

    crc_extra: int
    """Seed of the checksum, derived from the message's definition."""
    length: int
    """Payload length [bytes] with all extensions that we know; truncated payloads are filled up to it."""


class RawFrame(Protocol):
    """Anything with the bytes of one whole MAVLink frame."""

    @property
    def raw(self) -> bytes:
        """The frame, from its magic byte to its checksum or signature."""


class Heartbeat(NamedTuple):
    """HEARTBEAT (0)."""

    type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    """PX4: main mode << 16 | sub mode << 24, see `modes`."""
    system_status: int

    @property
    def armed(self) -> bool:
        """Whether the sender says that its motors may turn."""
        return bool(self.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)


class Odometry(NamedTuple):
    """ODOMETRY (331) without its covariances; numbers as sent, see `telemetry` for what they mean."""

    time_usec: int
    frame_id: int
    """MAV_FRAME of the position and the attitude."""
    child_frame_id: int
    """MAV_FRAME of the velocity."""
    p: Vec3
    q: Quat
    v: Vec3
    w: Vec3
    reset_counter: int
    estimator_type: int
    quality: int
    """Percent; 0 unknown, -1 failed."""


class AttitudeQuaternion(NamedTuple):
    """ATTITUDE_QUATERNION (31)."""

    time_boot_ms: int
    q: Quat
    w: Vec3


class Timesync(NamedTuple):
    """TIMESYNC (111). The targets are 0 for everybody and from senders that do not fill them."""

    tc1: int
    """0 in a request; the answerer's time [ns] in a response."""
    ts1: int
    """The requester's time [ns], echoed."""
    target_system: int
    target_component: int


class CommandAck(NamedTuple):
    """COMMAND_ACK (77)."""

    command: int
    result: int
    progress: int
    result_param2: int
    target_system: int
    target_component: int


class ParamValue(NamedTuple):
    """PARAM_VALUE (22), decoded bytewise as PX4 encodes it."""

    name: str
    value: int | float | None
    """None when the type is none that we know."""
    type: int
    """MAV_PARAM_TYPE: 6 INT32, 9 REAL32."""


class ParamError(NamedTuple):
    """PARAM_ERROR (345)."""

    name: str
    error: int
    """MAV_PARAM_ERROR: 1 does not exist, ..."""
    target_system: int
    target_component: int


class StatusText(NamedTuple):
    """STATUSTEXT (253), or one chunk of a long one."""

    severity: int
    """MAV_SEVERITY: 0 emergency ... 7 debug."""
    text: bytes
    """UTF-8 up to the first NUL; a character may begin in one chunk and end in the next one."""
    complete: bool
    """Whether the text ends in this chunk."""
    id: int
    """0 for a text that fits into one message; otherwise the same in all chunks of a text."""
    chunk_seq: int


class AutopilotVersionMessage(NamedTuple):
    """AUTOPILOT_VERSION (148), the parts of use here."""

    capabilities: int
    uid: int
    flight_sw_version: int
    """Major, minor, patch and release type, one byte each from the highest."""
    vendor_id: int
    product_id: int


# ---- the message table and pymavlink -------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def dialect() -> Any:
    """The pymavlink dialect module, imported on first use (60-90 ms: do it before the flight).

    "development" is what PX4's simulator builds speak: `common` and what is about to enter it, CURRENT_MODE among it.
    The dialect's module is imported directly; mavutil would add 200 ms and sockets that nobody needs.
    """
    os.environ["MAVLINK20"] = "1"
    os.environ["MAVLINK_DIALECT"] = "development"
    return importlib.import_module("pymavlink.dialects.v20.development")


@lru_cache(maxsize=1)
def message_formats() -> dict[int, MessageFormat]:
    """CRC seed and payload length of every message of the dialect, by message id."""
    formats = {
        int(msgid): MessageFormat(int(message.crc_extra), int(message.unpacker.size))
        for msgid, message in dialect().mavlink_map.items()
    }
    # The target ids of TIMESYNC are an extension (no part of the CRC seed) that pymavlink's definition lacks and
    # PX4's has.
    formats[TIMESYNC] = MessageFormat(formats[TIMESYNC].crc_extra, TIMESYNC_LAYOUT.size)
    return formats


def message_name(msgid: int) -> str:
    """The name of a message, or "message 12345" for one that the dialect does not have."""
    message = dialect().mavlink_map.get(msgid)
    return f"message {msgid}" if message is None else str(message.msgname)


def decode_cold(frame: RawFrame) -> Any | None:
    """The pymavlink message of a frame (10-20 us), or None when pymavlink cannot make sense of it. Never raises."""
    library = dialect()
    try:
        message = library.MAVLink(None).decode(bytearray(frame.raw))
    except Exception:  # whatever the library trips over in a stranger's bytes must not end a flight
        return None
    return None if message.get_type().startswith(("UNKNOWN", "BAD_DATA")) else message


# ---- decoders ------------------------------------------------------------------------------------------------------


def filled(payload: bytes, size: int) -> bytes:
    """The payload with its truncated zeros back."""
    return payload if len(payload) >= size else payload + bytes(size - len(payload))


def _text(field: bytes) -> str:
    """A fixed-size text field up to its first NUL; bytes that are no text become replacement characters."""
    return field.split(b"\0", 1)[0].decode("utf-8", errors="replace")


def decode_odometry(payload: bytes) -> Odometry:
    """ODOMETRY."""
    fields = _ODOMETRY.unpack_from(filled(payload, _ODOMETRY.size))
    t, x, y, z, q0, q1, q2, q3, vx, vy, vz, wx, wy, wz, frame, child, resets, estimator, quality = fields
    p, q, v, w = (x, y, z), (q0, q1, q2, q3), (vx, vy, vz), (wx, wy, wz)
    return new_record(Odometry, (t, frame, child, p, q, v, w, resets, estimator, quality))


def decode_attitude_quaternion(payload: bytes) -> AttitudeQuaternion:
    """ATTITUDE_QUATERNION; the display offset `repr_offset_q` is for tail-sitters and left out."""
    t, q0, q1, q2, q3, wx, wy, wz = _ATTITUDE_QUATERNION.unpack_from(filled(payload, _ATTITUDE_QUATERNION.size))
    return AttitudeQuaternion(t, (q0, q1, q2, q3), (wx, wy, wz))


def decode_timesync(payload: bytes) -> Timesync:
    """TIMESYNC."""
    return new_record(Timesync, TIMESYNC_LAYOUT.unpack_from(filled(payload, TIMESYNC_LAYOUT.size)))


def decode_heartbeat(payload: bytes) -> Heartbeat:
    """HEARTBEAT."""
    custom_mode, kind, autopilot, base_mode, status, _ = _HEARTBEAT.unpack_from(filled(payload, _HEARTBEAT.size))
    return Heartbeat(kind, autopilot, base_mode, custom_mode, status)


def decode_command_ack(payload: bytes) -> CommandAck:
    """COMMAND_ACK."""
    return CommandAck._make(COMMAND_ACK_LAYOUT.unpack_from(filled(payload, COMMAND_ACK_LAYOUT.size)))


def decode_param_value(payload: bytes) -> ParamValue:
    """PARAM_VALUE. The value is reinterpreted from its four bytes: a cast through the float would lose integers."""
    raw, _, _, name, kind = PARAM_VALUE_LAYOUT.unpack_from(filled(payload, PARAM_VALUE_LAYOUT.size))
    layout = _PARAM_TYPES.get(kind)
    value = None if layout is None else struct.unpack_from(layout, raw)[0]
    return ParamValue(_text(name), value, kind)


def decode_param_error(payload: bytes) -> ParamError:
    """PARAM_ERROR."""
    _, system, component, name, error = PARAM_ERROR_LAYOUT.unpack_from(filled(payload, PARAM_ERROR_LAYOUT.size))
    return ParamError(_text(name), error, system, component)


def decode_statustext(payload: bytes) -> StatusText:
    """STATUSTEXT."""
    severity, text, identity, chunk = STATUSTEXT_LAYOUT.unpack_from(filled(payload, STATUSTEXT_LAYOUT.size))
    return StatusText(severity, text.split(b"\0", 1)[0], identity == 0 or b"\0" in text, identity, chunk)


def decode_autopilot_version(payload: bytes) -> AutopilotVersionMessage:
    """AUTOPILOT_VERSION."""
    capabilities, uid, flight, _, _, _, vendor, product = _AUTOPILOT_VERSION.unpack_from(
        filled(payload, _AUTOPILOT_VERSION.size)
    )
    return AutopilotVersionMessage(capabilities, uid, flight, vendor, product)


# ---- encoders ------------------------------------------------------------------------------------------------------
# They raise struct.error or OverflowError on numbers that do not fit their field: the caller's fault, caught by
# `setpoint`'s check.


def encode_set_attitude_target(
    time_boot_ms: int, target_system: int, target_component: int, type_mask: int, q: Quat, w: Vec3, thrust: float
) -> bytes:
    """SET_ATTITUDE_TARGET (82): attitude, body rates [rad/s], collective thrust 0..1; mask bits say what to ignore."""
    return SET_ATTITUDE_TARGET_LAYOUT.pack(
        time_boot_ms, q[0], q[1], q[2], q[3], w[0], w[1], w[2], thrust, target_system, target_component, type_mask
    )


def encode_set_position_target_local_ned(
    time_boot_ms: int,
    target_system: int,
    target_component: int,
    type_mask: int,
    vectors: tuple[Vec3, Vec3, Vec3],
    yaw: tuple[float, float],
) -> bytes:
    """SET_POSITION_TARGET_LOCAL_NED (84) in MAV_FRAME_LOCAL_NED; mask bits say what to ignore.

    Args:
        time_boot_ms: the vehicle's time.
        target_system: the autopilot's.
        target_component: the autopilot's.
        type_mask: POSITION_TARGET_TYPEMASK.
        vectors: position [m], velocity [m/s] and acceleration [m/s^2], NED.
        yaw: heading [rad] and its rate [rad/s].
    """
    p, v, a = vectors
    return SET_POSITION_TARGET_LOCAL_NED_LAYOUT.pack(
        time_boot_ms, *p, *v, *a, *yaw, type_mask, target_system, target_component, MAV_FRAME_LOCAL_NED
    )


def encode_set_actuator_control_target(
    time_usec: int, group: int, target_system: int, target_component: int, controls: tuple[float, ...]
) -> bytes:
    """SET_ACTUATOR_CONTROL_TARGET (139): eight controls of a group, -1..1; group 0 starts roll, pitch, yaw, thrust."""
    return SET_ACTUATOR_CONTROL_TARGET_LAYOUT.pack(time_usec, *controls, group, target_system, target_component)


def encode_timesync(tc1: int, ts1: int, target_system: int = 0, target_component: int = 0) -> bytes:
    """TIMESYNC, times in ns."""
    return TIMESYNC_LAYOUT.pack(tc1, ts1, target_system, target_component)


def encode_heartbeat(
    type_: int = MAV_TYPE_ONBOARD_CONTROLLER,
    autopilot: int = MAV_AUTOPILOT_INVALID,
    base_mode: int = 0,
    custom_mode: int = 0,
    system_status: int = MAV_STATE_ACTIVE,
) -> bytes:
    """HEARTBEAT; the defaults are a companion's (PX4 accepts it at component 191 of the vehicle's own system)."""
    return _HEARTBEAT.pack(custom_mode, type_, autopilot, base_mode, system_status, 3)


def encode_command_long(
    target_system: int, target_component: int, command: int, confirmation: int, params: tuple[float, ...]
) -> bytes:
    """COMMAND_LONG with its seven parameters; NaN is "not given"."""
    return COMMAND_LONG_LAYOUT.pack(*params, command, target_system, target_component, confirmation)


def encode_param_request_read(target_system: int, target_component: int, name: str) -> bytes:
    """PARAM_REQUEST_READ by name (at most 16 ASCII characters); PX4 wants its own system id as the target, not 0."""
    return PARAM_REQUEST_READ_LAYOUT.pack(-1, target_system, target_component, name.encode("ascii"))
