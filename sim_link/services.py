"""What the vehicle answers: dispatch of received messages, the parameter protocol, mode, stick and heartbeat messages.

Commands are in `commands`, missions in `mission_protocol`. Nothing here knows sockets: a message comes with the link it
came on, and answers go there.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable

from . import codec, file_transfer
from .autopilot import Autopilot
from .codec import AUTOPILOT_COMPONENT, Decoder, Frame, mavlink
from .commands import Commands, Failures
from .link import Link
from .messages import Telemetry
from .mission_protocol import MissionProtocol
from .missions import MISSION
from .modes import Mode, from_custom_mode
from .offboard import PositionTarget
from .parameters import HASH_CHECK, UINT32, ParameterError, Parameters
from .signing import SETUP_SIGNING, Keyring, is_signed

_PARAM_READ = struct.Struct("<hBB16s")
_PARAM_LIST = struct.Struct("<BB")
_PARAM_SET = struct.Struct("<4sBB16sB")
_PARAM_VALUE = struct.Struct("<4sHH16sB")
_ID_PARAM_VALUE = 22
_SET_MODE = struct.Struct("<IBB")
_HEARTBEAT = struct.Struct("<IBBBBB")
_LOCAL_TARGET = mavlink.MAVLink_set_position_target_local_ned_message.unpacker
_GLOBAL_TARGET = mavlink.MAVLink_set_position_target_global_int_message.unpacker
_MISSION_CURRENT = struct.Struct("<HHBBIII")
"""seq, total, mission_state, mission_mode, and the opaque ids of mission, fence and rally points."""
_FTP_TARGET = 3
"""Bytes of network, system and component before FTP's own payload."""
_PING = struct.Struct("<QIBB")
_REACHED_PERIOD_US = 2_000_000
_REACHED_REPEATS = 10
"""PX4 reports an item that was reached again and again: its report may be lost."""
_HASH_INDEX = 0xFFFF
_NAME_LENGTH = 16


class Services:
    """Acts on what is received. One object serves all links of a vehicle."""

    def __init__(
        self,
        autopilot: Autopilot,
        parameters: Parameters,
        telemetry: Telemetry,
        *,
        system: int,
        failures: Failures | None = None,
        keyring: Keyring | None = None,
    ) -> None:
        """Serve one vehicle; `failures`: who knows which commands are refused, and lets units fail; `keyring`: its key.

        Without a keyring, or where PX4 does not know SETUP_SIGNING yet, none can be set.
        """
        self._autopilot = autopilot
        self._parameters = parameters
        self._system = system
        self._decoder = Decoder()
        self._commands = Commands(autopilot, parameters, telemetry, system=system, failures=failures)
        flight = autopilot.guidance.mission
        self._missions = MissionProtocol(autopilot.plans, self._say, system=system, select=flight.select)
        self._missions.current = lambda: flight.current
        self._flight = flight
        self._current = 0
        self._plans_version = 0
        self._reached: int | None = None
        self._reached_left = 0
        self._reached_us = 0
        self._handlers: dict[int, Callable[[Frame, Link, int], None]] = {
            codec.ID_SET_ATTITUDE_TARGET: self._attitude_target,
            codec.ID_SET_ACTUATOR_CONTROL_TARGET: self._actuator_controls,
            codec.ID_HEARTBEAT: self._heartbeat,
            codec.ID_MANUAL_CONTROL: self._manual_control,
            codec.ID_SET_MODE: self._set_mode,
            codec.ID_COMMAND_LONG: self._command,
            codec.ID_COMMAND_INT: self._command,
            codec.ID_PARAM_REQUEST_READ: self._parameter_read,
            codec.ID_PARAM_REQUEST_LIST: self._parameter_list,
            codec.ID_PARAM_SET: self._parameter_set,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: self._local_target,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT: self._global_target,
            mavlink.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE: self._radio,
            mavlink.MAVLINK_MSG_ID_PING: self._ping,
            mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: self._file_transfer,
        }
        self._handlers |= dict.fromkeys(self._missions.message_ids, self._mission)
        if keyring is not None and autopilot.px4 != "1.13":
            self._keyring = keyring
            self._handlers[codec.ID_SETUP_SIGNING] = self._setup_signing

    def handle(self, frame: Frame, link: Link, now_us: int) -> None:
        """Act on one message; one that this vehicle has no use for is passed over."""
        handler = self._handlers.get(frame.msg_id)
        if handler is not None:
            handler(frame, link, now_us)

    def update(self, links: Iterable[Link], now_us: int) -> None:
        """Go on with what takes time: mission transfers, and the reports of a mission's progress."""
        if self._missions.is_busy:
            self._missions.update(now_us)
        flight = self._flight
        version = self._autopilot.plans.versions[MISSION]
        if version != self._plans_version or flight.current != self._current:
            if version != self._plans_version:
                self._reached, self._reached_left = None, 0
            self._plans_version, self._current = version, flight.current
            for link in links:
                link.send_hot(mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, self.mission_current())
        if flight.reached is not None:
            self._reached, self._reached_left, self._reached_us = flight.reached, _REACHED_REPEATS + 1, now_us
            flight.reached = None
        if self._reached is not None and self._reached_left > 0 and now_us >= self._reached_us:
            self._reached_left -= 1
            self._reached_us = now_us + _REACHED_PERIOD_US
            for link in links:
                link.send(mavlink.MAVLink_mission_item_reached_message(self._reached))

    def mission_current(self) -> bytes:
        """MISSION_CURRENT, with the ids of the plans in force."""
        flight, plans = self._flight, self._autopilot.plans
        flying = 1 if self._autopilot.mode is Mode.MISSION else 2
        total = len(flight.items) or 0xFFFF
        ids = [plans.ids[kind] for kind in sorted(plans.ids)]
        return _MISSION_CURRENT.pack(flight.current, total, flight.state, flying if flight.items else 0, *ids)

    def _say(self, severity: int, sentence: str) -> None:
        self._autopilot.texts.append((severity, sentence))

    def send_parameters(self, link: Link, count: int) -> None:
        """Go on with a parameter list that was asked for on a link."""
        for _ in range(min(count, len(link.parameters_to_send))):
            self._send_value(link, link.parameters_to_send.popleft())

    # Setpoints, sticks, heartbeats

    def _attitude_target(self, frame: Frame, link: Link, now_us: int) -> None:
        self._autopilot.attitude_target(codec.attitude_target(frame.payload))

    def _actuator_controls(self, frame: Frame, link: Link, now_us: int) -> None:
        self._autopilot.actuator_controls(codec.actuator_controls(frame.payload))

    def _heartbeat(self, frame: Frame, link: Link, now_us: int) -> None:
        kind = _HEARTBEAT.unpack(codec.padded(frame.payload, _HEARTBEAT.size))[1]
        if kind == mavlink.MAV_TYPE_GCS:
            self._autopilot.ground_heartbeat()

    def _manual_control(self, frame: Frame, link: Link, now_us: int) -> None:
        message = self._decoder.message(frame)
        if message is not None and message.target == self._system:
            self._autopilot.manual_control(message.x, message.y, message.z, message.r)

    def _radio(self, frame: Frame, link: Link, now_us: int) -> None:
        """RC_CHANNELS_OVERRIDE: a radio; 0 and 65535 end the list of channels that are given."""
        message = self._decoder.message(frame)
        if message is None or message.target_system not in (0, self._system):
            return
        values = [getattr(message, f"chan{k}_raw") for k in range(1, 19)]
        count = next((k for k, value in enumerate(values) if value in (0, 0xFFFF)), len(values))
        self._autopilot.radio(tuple(values[:count]))

    def _local_target(self, frame: Frame, link: Link, now_us: int) -> None:
        """SET_POSITION_TARGET_LOCAL_NED."""
        f = _LOCAL_TARGET.unpack(codec.padded(frame.payload, _LOCAL_TARGET.size))
        self._autopilot.position_target(
            PositionTarget(f[12], f[13], f[14], f[15], f[1:4], f[4:7], f[7:10], f[10], f[11])
        )

    def _global_target(self, frame: Frame, link: Link, now_us: int) -> None:
        """SET_POSITION_TARGET_GLOBAL_INT."""
        f = _GLOBAL_TARGET.unpack(codec.padded(frame.payload, _GLOBAL_TARGET.size))
        place = (1e-7 * f[1], 1e-7 * f[2], f[3])
        self._autopilot.position_target(
            PositionTarget(f[12], f[13], f[14], f[15], place, f[4:7], f[7:10], f[10], f[11]), is_global=True
        )

    def _mission(self, frame: Frame, link: Link, now_us: int) -> None:
        message = self._decoder.message(frame)
        if message is not None:
            self._missions.handle(frame, message, link, now_us)

    def _file_transfer(self, frame: Frame, link: Link, now_us: int) -> None:
        """FILE_TRANSFER_PROTOCOL: there are no files."""
        payload = codec.padded(frame.payload, _FTP_TARGET + file_transfer.PAYLOAD_BYTES)
        if payload[1] == self._system and payload[2] in (0, AUTOPILOT_COMPONENT):
            content = file_transfer.answer(payload[_FTP_TARGET:])
            head = bytes((0, frame.system, frame.component))
            link.send_hot(mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL, head + content)

    def _setup_signing(self, frame: Frame, link: Link, now_us: int) -> None:
        """SETUP_SIGNING: on any link and for any target, but not while armed; zeros, if they are signed, end it."""
        initial, _, _, key = SETUP_SIGNING.unpack(codec.padded(frame.payload, SETUP_SIGNING.size))
        if self._autopilot.armed:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "signing: no other key while armed")
        elif initial or any(key):
            self._keyring.change(key, initial)
            self._say(mavlink.MAV_SEVERITY_INFO, "signing: new key")
        elif self._keyring.key is None or is_signed(frame):
            self._keyring.change(None, 0)
            self._say(mavlink.MAV_SEVERITY_INFO, "signing: off")
        else:
            self._say(mavlink.MAV_SEVERITY_WARNING, "signing: only a signed message ends it")

    def _ping(self, frame: Frame, link: Link, now_us: int) -> None:
        """PING: a request to everybody is answered as it came."""
        time_us, sequence, system, component = _PING.unpack(codec.padded(frame.payload, _PING.size))
        if (system, component) == (0, 0):
            link.send(mavlink.MAVLink_ping_message(time_us, sequence, frame.system, frame.component))

    def _set_mode(self, frame: Frame, link: Link, now_us: int) -> None:
        """SET_MODE (11): packed custom_mode, never acknowledged."""
        custom_mode, target, _ = _SET_MODE.unpack(codec.padded(frame.payload, _SET_MODE.size))
        mode = from_custom_mode(custom_mode)
        if target in (0, self._system) and mode is not None:
            self._autopilot.set_mode(mode)

    def _command(self, frame: Frame, link: Link, now_us: int) -> None:
        message = self._decoder.message(frame)
        if message is not None:
            self._commands.handle(message, (frame.system, frame.component), link, now_us)

    # Parameters (mavlink_parameters.cpp): the target system must be ours, 0 does not count

    def _is_for_us(self, system: int, component: int) -> bool:
        return system == self._system and component in (0, AUTOPILOT_COMPONENT)

    def _parameter_list(self, frame: Frame, link: Link, now_us: int) -> None:
        """PARAM_REQUEST_LIST: the list begins with _HASH_CHECK and goes out bit by bit; asking again begins anew."""
        if self._is_for_us(*_PARAM_LIST.unpack(codec.padded(frame.payload, _PARAM_LIST.size))):
            link.parameters_to_send.clear()
            link.parameters_to_send.append(HASH_CHECK)
            link.parameters_to_send.extend(self._parameters.names)

    def _parameter_read(self, frame: Frame, link: Link, now_us: int) -> None:
        """PARAM_REQUEST_READ: by index, or with index -1 by name."""
        index, system, component, raw = _PARAM_READ.unpack(codec.padded(frame.payload, _PARAM_READ.size))
        if not self._is_for_us(system, component):
            return
        name = _name(raw) if index < 0 else self._parameters.name_at(index)
        if name is not None and (name == HASH_CHECK or name in self._parameters):
            self._send_value(link, name)
        else:
            self._send_error(frame, link, _name(raw), index, ParameterError.DOES_NOT_EXIST)

    def _parameter_set(self, frame: Frame, link: Link, now_us: int) -> None:
        """PARAM_SET: bytewise, the type must match; answered with the value as it is now, or with PARAM_ERROR."""
        value, system, component, raw, kind = _PARAM_SET.unpack(codec.padded(frame.payload, _PARAM_SET.size))
        if not self._is_for_us(system, component):
            return
        name = _name(raw)
        if name == HASH_CHECK:
            link.parameters_to_send.clear()  # PX4: the client knows the values already
            return
        try:
            self._parameters.set_wire(name, kind, value)
        except ParameterError as error:
            self._send_error(frame, link, name, -1, error.code)
            return
        self._send_value(link, name)

    def _send_value(self, link: Link, name: str) -> None:
        """Queue a PARAM_VALUE."""
        if name == HASH_CHECK:
            value, index, kind = self._parameters.hash_wire(), _HASH_INDEX, UINT32
        else:
            value, index = self._parameters.wire(name), self._parameters.index_of(name)
            kind = self._parameters.type_of(name)
        count = len(self._parameters)
        link.send_hot(_ID_PARAM_VALUE, _PARAM_VALUE.pack(value, count, index, name.encode(), kind))

    def _send_error(self, frame: Frame, link: Link, name: str, index: int, code: int) -> None:
        """Queue a PARAM_ERROR; PX4 1.13 did not know that message and kept silent."""
        if self._autopilot.px4 == "1.13":
            return
        text = name.encode("ascii", "replace")[:_NAME_LENGTH]
        link.send(mavlink.MAVLink_param_error_message(frame.system, frame.component, text, index, code))


def _name(raw: bytes) -> str:
    """Read a parameter's name: 16 bytes, ended by a zero byte when shorter."""
    return raw.split(b"\0", 1)[0].decode("ascii", "replace")
