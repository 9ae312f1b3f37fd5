"""MAVLink frames: checking what comes in, building what goes out.

The few messages that travel at the control rate are packed and unpacked with `struct` (about 1 us); all others go
through pymavlink (6 to 17 us). Both give the same bytes, which the tests hold. One frame goes into one datagram;
several in one are read as well.

Not shared with the companion on purpose: an error in one codec must not cancel itself in the other.
"""

from __future__ import annotations

import os
import re
import struct
from typing import Any, NamedTuple, Protocol

from fastcrc.crc16 import mcrf4xx

# pymavlink reads these when its connection helpers are imported; set before, so that they agree with us.
os.environ.setdefault("MAVLINK20", "1")
os.environ.setdefault("MAVLINK_DIALECT", "development")

from pymavlink.dialects.v20 import development as mavlink

__all__ = [
    "AUTOPILOT_COMPONENT",
    "ActuatorControls",
    "AttitudeTarget",
    "Decoder",
    "Encoder",
    "Frame",
    "actuator_controls",
    "attitude_target",
    "exchange",
    "frames",
    "lone_setpoint",
    "mavlink",
    "padded",
    "timesync",
]

MAGIC_V1 = 0xFE
MAGIC_V2 = 0xFD
_MAGIC = re.compile(b"[\xfd\xfe]")
_FALSE_STARTS_MAX = 32
"""In one datagram: to look for messages in nonsense takes time, and a flood of it must cost little."""
SIGNED_FLAG = 0x01
SIGNATURE_LENGTH = 13
AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: what every vehicle's autopilot is."""
_HEADER = struct.Struct("<BBBBBBBHB")
_HEAD = struct.Struct("<BBBB")
"""Length, both flags, sequence number."""
_MAGIC_V2_BYTE = bytes((MAGIC_V2,))
_WHOLE = 12
"""Bytes of a MAVLink 2 frame without its payload."""
_CHECKED: dict[int, tuple[bytes, int]] = {
    number: (bytes((cls.crc_extra,)), cls.unpacker.size) for number, cls in mavlink.mavlink_map.items()
}

ID_HEARTBEAT = 0
ID_SET_MODE = 11
ID_PARAM_REQUEST_READ = 20
ID_PARAM_REQUEST_LIST = 21
ID_PARAM_SET = 23
ID_ATTITUDE_QUATERNION = 31
ID_LOCAL_POSITION_NED = 32
ID_GLOBAL_POSITION_INT = 33
ID_MANUAL_CONTROL = 69
ID_COMMAND_INT = 75
ID_COMMAND_LONG = 76
ID_SET_ATTITUDE_TARGET = 82
ID_ATTITUDE_TARGET = 83
ID_TIMESYNC = 111
ID_HIL_STATE_QUATERNION = 115
ID_SERIAL_CONTROL = 126
ID_SETUP_SIGNING = 256
ID_SET_ACTUATOR_CONTROL_TARGET = 139
ID_ODOMETRY = 331

ODOMETRY_STATE = struct.Struct("<Q13f")
"""time_usec, x, y, z, q, vx, vy, vz, rollspeed, pitchspeed, yawspeed."""
ODOMETRY_REST = struct.Struct("<168sBBBBb")
"""Two covariances; frame_id, child_frame_id, reset_counter, estimator_type, quality."""
COVARIANCE = struct.Struct("<21f")
"""Upper triangle of pose or velocity."""
ATTITUDE_QUATERNION = struct.Struct("<I7f4f")
LOCAL_POSITION_NED = struct.Struct("<I6f")
GLOBAL_POSITION_INT = struct.Struct("<IiiiihhhH")
ATTITUDE_TARGET = struct.Struct("<I8fB")
TIMESYNC = struct.Struct("<qqBB")
HIL_STATE_QUATERNION = struct.Struct("<Q7fiiihhhHHhhh")
SET_ATTITUDE_TARGET = struct.Struct("<I8fBBB3f")
SET_ACTUATOR_CONTROL_TARGET = struct.Struct("<Q8fBBB")
_EXCHANGE = struct.Struct("<4sBBB3s39sH4sBBB3sqqBBH")
"""A SET_ATTITUDE_TARGET without its extension, and a TIMESYNC: two frames of MAVLink 2, checksums included."""
_SETPOINT_BEGIN, _SETPOINT_ID = b"\xfd\x27\0\0", ID_SET_ATTITUDE_TARGET.to_bytes(3, "little")
_ANSWER_BEGIN, _ANSWER_ID = b"\xfd\x12\0\0", ID_TIMESYNC.to_bytes(3, "little")
"""Magic, length and flags (not signed); message id."""
_SETPOINT_BYTES = 51
_SETPOINT_CHECKED, _ANSWER_CHECKED = slice(1, 49), slice(52, 79)
_SETPOINT_EXTRA, _ANSWER_EXTRA = _CHECKED[ID_SET_ATTITUDE_TARGET][0], _CHECKED[ID_TIMESYNC][0]


class Frame(NamedTuple):
    """One MAVLink message whose checksum is right."""

    msg_id: int
    system: int
    component: int
    payload: bytes
    """As received: MAVLink 2 has cut trailing zero bytes off."""
    raw: bytes


class AttitudeTarget(NamedTuple):
    """SET_ATTITUDE_TARGET (82) as received; nothing is checked but the length."""

    target_system: int
    target_component: int
    type_mask: int
    q: tuple[float, float, float, float]
    rates: tuple[float, float, float]
    """Body rates [rad/s], FRD."""
    thrust: float
    thrust_body: tuple[float, float, float]
    """Normalised thrust in body axes, FRD: up is negative z."""


class ActuatorControls(NamedTuple):
    """SET_ACTUATOR_CONTROL_TARGET (139) as received."""

    target_system: int
    target_component: int
    group: int
    controls: tuple[float, ...]


def frames(datagram: bytes) -> list[Frame]:
    """Give every valid MAVLink message in `datagram`; whatever is no message, or fails its checksum, is passed over.

    After too many beginnings of a message that is none, so is the rest of the datagram.
    """
    found: list[Frame] = []
    at = 0
    end = len(datagram)
    while end - at >= _WHOLE:
        # Nearly every datagram: frames of MAVLink 2, not signed, one after the other. The rest is sorted out below.
        magic, length, flags, _, _, system, component, low, high = _HEADER.unpack_from(datagram, at)
        frame_end = at + length + _WHOLE
        if magic != MAGIC_V2 or flags != 0 or frame_end > end:
            break
        msg_id = low | high << 16
        known = _CHECKED.get(msg_id)
        body_end = frame_end - 2
        if known is None or mcrf4xx(datagram[at + 1 : body_end] + known[0]) != (
            datagram[body_end] | datagram[body_end + 1] << 8
        ):
            break
        found.append(Frame(msg_id, system, component, datagram[at + 10 : body_end], datagram[at:frame_end]))
        at = frame_end
    false_starts = 0
    while at < end and false_starts <= _FALSE_STARTS_MAX:
        start = _MAGIC.search(datagram, at)
        if start is None:
            break
        length = _frame_at(datagram, start.start(), end, found)
        false_starts += length == 0
        at = start.start() + max(length, 1)
    return found


def _frame_at(datagram: bytes, at: int, end: int, found: list[Frame]) -> int:
    """Append the frame that begins at `at` to `found` and return its length; 0 when there is none."""
    version_2 = datagram[at] == MAGIC_V2
    header = 10 if version_2 else 6
    if at + header + 2 > end:
        return 0
    body_end = at + header + datagram[at + 1]
    frame_end = body_end + 2
    if version_2:
        flags = datagram[at + 2]
        if flags & ~SIGNED_FLAG:
            return 0
        if flags & SIGNED_FLAG:
            frame_end += SIGNATURE_LENGTH
        msg_id = datagram[at + 7] | datagram[at + 8] << 8 | datagram[at + 9] << 16
        system, component = datagram[at + 5], datagram[at + 6]
    else:
        msg_id = datagram[at + 5]
        system, component = datagram[at + 3], datagram[at + 4]
    known = _CHECKED.get(msg_id)
    if known is None or frame_end > end:
        return 0
    if mcrf4xx(datagram[at + 1 : body_end] + known[0]) != datagram[body_end] | datagram[body_end + 1] << 8:
        return 0
    found.append(Frame(msg_id, system, component, datagram[at + header : body_end], datagram[at:frame_end]))
    return frame_end - at


def padded(payload: bytes, size: int) -> bytes:
    """Restore the zero bytes that MAVLink 2 cuts off; a longer payload (newer extensions) is cut to `size`."""
    return payload[:size].ljust(size, b"\0")


def attitude_target(payload: bytes) -> AttitudeTarget:
    """Read SET_ATTITUDE_TARGET."""
    _, w, x, y, z, p, q, r, thrust, system, component, mask, bx, by, bz = SET_ATTITUDE_TARGET.unpack_from(
        payload.ljust(SET_ATTITUDE_TARGET.size, b"\0")
    )
    # As its constructor does, without the call of it: this is done for every state.
    return tuple.__new__(AttitudeTarget, (system, component, mask, (w, x, y, z), (p, q, r), thrust, (bx, by, bz)))


def lone_setpoint(datagram: bytes) -> bytes | None:
    """Read the datagram that nearly all of a companion's are in real time: gives SET_ATTITUDE_TARGET's payload.

    None: it is another one, which `frames` sorts out.
    """
    if (
        len(datagram) == _SETPOINT_BYTES
        and datagram[:4] == _SETPOINT_BEGIN
        and datagram[7:10] == _SETPOINT_ID
        and mcrf4xx(datagram[_SETPOINT_CHECKED] + _SETPOINT_EXTRA) == datagram[-2] | datagram[-1] << 8
    ):
        return datagram[10:-2]
    return None


def exchange(datagram: bytes) -> tuple[bytes, int] | None:
    """Read the datagram that nearly all of a companion's are in lockstep: a setpoint, then an answer to TIMESYNC.

    Gives SET_ATTITUDE_TARGET's payload and TIMESYNC's ts1 [ns]. None: it is another one, which `frames` sorts out.
    """
    if len(datagram) != _EXCHANGE.size:
        return None
    begin, _, _, _, number, payload, crc, answer, _, _, _, answer_number, tc1, ts1, _, _, answer_crc = _EXCHANGE.unpack(
        datagram
    )
    if (
        begin == _SETPOINT_BEGIN
        and number == _SETPOINT_ID
        and answer == _ANSWER_BEGIN
        and answer_number == _ANSWER_ID
        and tc1 != 0
        and mcrf4xx(datagram[_SETPOINT_CHECKED] + _SETPOINT_EXTRA) == crc
        and mcrf4xx(datagram[_ANSWER_CHECKED] + _ANSWER_EXTRA) == answer_crc
    ):
        return payload, ts1
    return None


def actuator_controls(payload: bytes) -> ActuatorControls:
    """Read SET_ACTUATOR_CONTROL_TARGET."""
    fields = SET_ACTUATOR_CONTROL_TARGET.unpack(padded(payload, SET_ACTUATOR_CONTROL_TARGET.size))
    return ActuatorControls(fields[10], fields[11], fields[9], fields[1:9])


def timesync(payload: bytes) -> tuple[int, int]:
    """Read TIMESYNC: (tc1, ts1) [ns]."""
    tc1, ts1, _, _ = TIMESYNC.unpack_from(payload.ljust(TIMESYNC.size, b"\0"))
    return tc1, ts1


class Key(Protocol):
    """The key of a vehicle."""

    key: bytes | None
    """None: nothing is signed."""


class Signatures(Protocol):
    """What an encoder needs to sign."""

    @property
    def keyring(self) -> Key:
        """Holds the key that is in force."""
        ...

    def tail(self, frame: bytes) -> bytes:
        """Give the signature of a frame that has the signed flag set."""
        ...


class Encoder:
    """Builds the frames of one link; every link counts its own sequence numbers."""

    def __init__(self, system: int, component: int, signatures: Signatures | None = None) -> None:
        self.system = system
        self.component = component
        self.sequence = 0
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._signatures = signatures
        self._known: dict[int, tuple[bytes, bytes]] = {}
        """Of each message that was framed: what stands between its sequence number and its payload; extra byte."""

    def hot(self, msg_id: int, payload: bytes) -> bytes:
        """Frame a payload packed with one of the structs above."""
        body = payload if payload[-1] else payload.rstrip(b"\0") or payload[:1]
        signatures = self._signatures
        signed = signatures is not None and signatures.keyring.key is not None
        known = self._known.get(msg_id)
        if known is None:
            sender = bytes((self.system, self.component)) + msg_id.to_bytes(3, "little")
            known = self._known[msg_id] = sender, _CHECKED[msg_id][0]
        sequence = self.sequence
        self.sequence = (sequence + 1) & 0xFF
        checked = _HEAD.pack(len(body), signed, 0, sequence) + known[0] + body
        frame = _MAGIC_V2_BYTE + checked + mcrf4xx(checked + known[1]).to_bytes(2, "little")
        return frame + signatures.tail(frame) if signed and signatures is not None else frame

    def cold(self, message: Any) -> bytes:
        """Frame a pymavlink message."""
        self._mav.seq = self.sequence
        self.sequence = (self.sequence + 1) & 0xFF
        raw = bytes(message.pack(self._mav))
        if self._signatures is None or self._signatures.keyring.key is None:
            return raw
        body = raw[:2] + bytes((raw[2] | SIGNED_FLAG,)) + raw[3:-2]
        body += mcrf4xx(body[1:] + _CHECKED[message.get_msgId()][0]).to_bytes(2, "little")
        return body + self._signatures.tail(body)


class Decoder:
    """Reads the messages that are too rare to deserve a struct of their own."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None)

    def message(self, frame: Frame) -> Any | None:
        """Decode a frame with pymavlink; None when it cannot."""
        try:
            return self._mav.decode(bytearray(frame.raw))
        except mavlink.MAVError:
            return None
