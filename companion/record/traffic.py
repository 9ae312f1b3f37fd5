"""What the link's traffic says about the vehicle and was told it, as records of PX4's topics.

The recorder sees every frame that came in or went out, so that nothing of this costs the control loop anything: states,
setpoints, mode, battery, the autopilot's words, and how much the link carried.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

from companion.control.types import new_record
from companion.frames import yaw_from_quat
from companion.link import codec
from companion.link.framing import Frame
from companion.link.modes import AutoMode, MainMode, Mode
from companion.link.statustext import StatusTexts
from companion.link.telemetry import StateRejection, Telemetry
from companion.record import topics
from companion.record.tlog import Direction
from companion.record.ulog import Level, Number, Topic

Write = Callable[[int, Sequence[Number]], None]
"""Takes vehicle time [us] and the numbers of a record."""
Handler = TypeVar("Handler")
Say = Callable[[int, str], None]
"""Takes a severity and a text."""

AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1
BATTERY_STATUS: Final = 147
HOME_POSITION: Final = 242
EXTENDED_SYS_STATE: Final = 245
CURRENT_MODE: Final = 436

UNKNOWN_MODE: Final = 31
"""NAVIGATION_STATE_MAX."""
NAV_STATES: Final[dict[Mode, int]] = {
    **{Mode(MainMode.MANUAL): 0, Mode(MainMode.ALTITUDE): 1, Mode(MainMode.POSITION): 2, Mode(MainMode.ACRO): 10},
    **{Mode(MainMode.TERMINATION): 13, Mode(MainMode.OFFBOARD): 14, Mode(MainMode.STABILIZED): 15},
    **{Mode(MainMode.POSITION, 1): 21, Mode(MainMode.POSITION, 2): 6},  # orbit, slow
    **{Mode(MainMode.AUTO, AutoMode.MISSION): 3, Mode(MainMode.AUTO, AutoMode.HOLD): 4},
    **{Mode(MainMode.AUTO, AutoMode.RETURN): 5, Mode(MainMode.AUTO, AutoMode.DESCEND): 12},
    **{Mode(MainMode.AUTO, AutoMode.TAKEOFF): 17, Mode(MainMode.AUTO, AutoMode.LAND): 18},
    **{Mode(MainMode.AUTO, 8): 19, Mode(MainMode.AUTO, 9): 20, Mode(MainMode.AUTO, 10): 22},  # follow, precision land
    **{Mode(MainMode.AUTO, 11 + index): 23 + index for index in range(8)},  # external modes
}
"""PX4's nav_state of a mode as the link names it."""
ROTARY_WINGS: Final = {2, 3, 4, 13, 14, 15}  # MAV_TYPE: quadrotor, coaxial, helicopter, hexa-, octo-, tricopter

_OUT: Final = int(Direction.OUT)
_V2: Final = 0xFD  # the first byte of a frame of MAVLink 2
_HEAD_V2 = struct.Struct("4x3B3s").unpack_from  # sequence number, system, component, id of the message
_PAYLOAD_V2: Final = 10  # where its payload begins
_HIGH: Final = bytes(2)  # the rest of a message's id that MAVLink 1 does not have
_SECOND_US: Final = 1_000_000
_FAR_US: Final = 10_000_000
_LOSS_MAX: Final = 128  # a larger step of the sequence number is a late frame, or a restarted sender
_IGNORE_RATES: Final = 7
_IGNORE_ATTITUDE: Final = 128
_NAN3: Final = (math.nan, math.nan, math.nan)


class Traffic:
    """Follows one autopilot.

    Args:
        writer: gives, for a topic, what takes its records.
        say: gets what belongs into the log as a text.
        parameter: gets each of the autopilot's parameters that is read, and MAV_TYPE, when it is new or another than
            before.
        epoch_minus_wall_ns: turns monotonic into epoch nanoseconds.
    """

    def __init__(
        self,
        writer: Callable[[Topic], Write],
        say: Say,
        parameter: Callable[[str, Number], None],
        epoch_minus_wall_ns: int,
    ) -> None:
        self.now_us: int | None = None
        """Vehicle time as far as it was heard [us]; never steps back."""
        self.dropped = 0
        """Entries that are missing in the log, as far as somebody told us."""
        self._say, self._parameter = say, parameter
        self._writers = {
            topic.name: writer(topic)
            for topic in (*topics.STATE_TOPICS, *topics.SETPOINT_TOPICS, *topics.REPORT_TOPICS)
        }
        self._write_position, self._write_attitude, self._write_rates = (
            self._writers[topic.name] for topic in topics.STATE_TOPICS
        )
        self._write_rates_setpoint = self._writers[topics.RATES_SETPOINT.name]
        self._write_thrust_setpoint = self._writers[topics.THRUST_SETPOINT.name]
        self._epoch_minus_wall_ns = epoch_minus_wall_ns
        self._telemetry: Telemetry | None = None
        self._system = 0
        self._seq: int | None = None
        self._state_us: int | None = None
        self._resets: int | None = None
        self._texts = StatusTexts()
        self._parameters: dict[str, Number] = {}
        self._kind: int | None = None
        self._mode: Mode | None = None
        self._intended: Mode | None = None
        self._armed = False
        self._received = self._sent = self._lost = 0
        self._bytes_in = self._bytes_out = 0
        self._told_us: int | None = None
        self._told_bytes = (0, 0)
        self._on_in: dict[bytes, Callable[[bytes, int], None]] = _by_id(
            {
                codec.ODOMETRY: self._on_odometry,
                codec.TIMESYNC: self._on_timesync,
            }
        )
        self._on_seldom: dict[bytes, Callable[[Frame], None]] = _by_id(
            {
                codec.HEARTBEAT: self._on_heartbeat,
                codec.STATUSTEXT: self._on_statustext,
                codec.PARAM_VALUE: self._on_param_value,
                CURRENT_MODE: self._on_current_mode,
                EXTENDED_SYS_STATE: self._on_extended_sys_state,
                BATTERY_STATUS: self._on_battery_status,
                HOME_POSITION: self._on_home_position,
            }
        )
        self._on_out: dict[bytes, Callable[[bytes], None]] = _by_id(
            {
                codec.SET_ATTITUDE_TARGET: self._on_attitude_target,
                codec.SET_POSITION_TARGET_LOCAL_NED: self._on_position_target,
                codec.SET_ACTUATOR_CONTROL_TARGET: self._on_actuator_target,
            }
        )

    def _write(self, topic: Topic, t_us: int, values: Sequence[Number]) -> None:
        self._writers[topic.name](t_us, values)

    def take(self, direction: int, frames: Sequence[bytes], wall_ns: int) -> None:
        """One datagram.

        Args:
            direction: a `tlog.Direction`.
            frames: what is in it, see `tlog.split_frames`.
            wall_ns: monotonic time at which they came or went.
        """
        if direction == _OUT:
            for raw in frames:
                self._sent += 1
                self._bytes_out += len(raw)
                on_out = self._on_out.get(raw[7:10] if raw[0] == _V2 else raw[5:6] + _HIGH)
                if on_out is not None:
                    on_out(raw)
            return
        for raw in frames:
            self._received += 1
            self._bytes_in += len(raw)
            if raw[0] == _V2:
                seq, system, component, msgid = _HEAD_V2(raw)
            else:
                seq, system, component, msgid = raw[2], raw[3], raw[4], raw[5:6] + _HIGH
            if component != AUTOPILOT or (system != self._system and self._telemetry is not None):
                continue
            if self._telemetry is None and not self._meet(_frame(raw, wall_ns)):
                continue
            if self._seq is not None and (missing := (seq - self._seq - 1) & 0xFF) < _LOSS_MAX:
                self._lost += missing
            self._seq = seq
            on_in = self._on_in.get(msgid)
            if on_in is not None:
                on_in(raw, wall_ns)
            elif (on_seldom := self._on_seldom.get(msgid)) is not None:
                on_seldom(_frame(raw, wall_ns))

    def _meet(self, frame: Frame) -> bool:
        """Whether this is the first heartbeat of an autopilot; it is the one to follow."""
        if frame.msgid != codec.HEARTBEAT:
            return False
        if codec.decode_heartbeat(frame.payload).autopilot == codec.MAV_AUTOPILOT_INVALID:
            return False
        self.follow(frame.sysid)
        return True

    def follow(self, system: int) -> None:
        """The autopilot is the one with this system id, from now on; without this, the first one with a heartbeat."""
        if self._telemetry is None or system != self._system:
            self._system = system
            self._telemetry = Telemetry(system)
            self._seq = self._state_us = None

    # -- time -----------------------------------------------------------------------------------------------------

    def _advance(self, t_us: int, wall_ns: int) -> None:
        now_us = self.now_us
        if now_us is None or t_us > now_us:
            self.now_us = now_us = t_us
        if self._told_us is None:
            self._told_us, self._told_bytes = now_us, (self._bytes_in, self._bytes_out)
        elif now_us - self._told_us >= _SECOND_US:
            self._tell_link(wall_ns)

    def _tell_link(self, wall_ns: int) -> None:
        now_us, last_us, telemetry = self.now_us, self._told_us, self._telemetry
        assert now_us is not None and last_us is not None and telemetry is not None
        passed_s = (now_us - last_us) * 1e-6
        rates = [(b - a) / passed_s for a, b in zip(self._told_bytes, (self._bytes_in, self._bytes_out), strict=True)]
        epoch_us = (wall_ns + self._epoch_minus_wall_ns) // 1000
        counts = (telemetry.accepted, sum(telemetry.rejected.values()), self.dropped)
        self._write(
            topics.LINK, now_us, (epoch_us, self._received, self._lost, rates[0], self._sent, rates[1], *counts)
        )
        self._told_us, self._told_bytes = now_us, (self._bytes_in, self._bytes_out)
        self._texts.update(now_us * 1e-6)
        self._tell_texts()

    def _on_timesync(self, raw: bytes, wall_ns: int) -> None:
        """A request tells the vehicle's time; one that is far from its states is not believed."""
        tc1, ts1, _, _ = _unpacked(codec.TIMESYNC_LAYOUT, raw)
        t_us = ts1 // 1000
        if tc1 != 0 or t_us <= 0:
            return
        if self._state_us is None or abs(t_us - self._state_us) < _FAR_US:
            self._advance(t_us, wall_ns)

    # -- states ---------------------------------------------------------------------------------------------------

    def _on_odometry(self, raw: bytes, wall_ns: int) -> None:
        assert self._telemetry is not None
        state = self._telemetry.on_odometry(_frame(raw, wall_ns))
        if isinstance(state, StateRejection):
            return
        t_us, p, v, q, w, resets = state
        if self._state_us is None and self.now_us is not None and self.now_us - t_us > _FAR_US:
            self.now_us = None  # what was believed before there were states was wrong
        self._state_us = t_us
        self._advance(t_us, wall_ns)
        self._write_position(t_us, (t_us, 1, 1, 1, 1, *p, *v, yaw_from_quat(q)))
        self._write_attitude(t_us, (t_us, *q))
        self._write_rates(t_us, (t_us, *w))
        if resets != self._resets:
            if self._resets is not None:
                self._say(Level.WARNING, f"the autopilot's estimate was reset (reset counter {resets})")
            self._resets = resets

    # -- setpoints ------------------------------------------------------------------------------------------------

    def _answered_us(self, t_ms: int) -> int:
        """The whole stamp of the state that a setpoint answers: its message has milliseconds."""
        state_us = self._state_us
        return state_us if state_us is not None and state_us // 1000 & 0xFFFFFFFF == t_ms else t_ms * 1000

    def _on_attitude_target(self, raw: bytes) -> None:
        t_ms, q0, q1, q2, q3, x, y, z, thrust, _, _, mask = _unpacked(codec.SET_ATTITUDE_TARGET_LAYOUT, raw)
        t_us, down = self._answered_us(t_ms), (0.0, 0.0, -thrust)
        if not mask & _IGNORE_ATTITUDE:
            self._write(topics.ATTITUDE_SETPOINT, t_us, (z, q0, q1, q2, q3, *down))
        elif not mask & _IGNORE_RATES:
            self._write_rates_setpoint(t_us, (x, y, z, *down))
        self._write_thrust_setpoint(t_us, (t_us, *down))

    def _on_position_target(self, raw: bytes) -> None:
        fields = _unpacked(codec.SET_POSITION_TARGET_LOCAL_NED_LAYOUT, raw)
        t_ms, mask, p, v, a = fields[0], fields[12], fields[1:4], fields[4:7], fields[7:10]
        vectors = (*(_NAN3 if mask & 7 else p), *(_NAN3 if mask & 56 else v), *(_NAN3 if mask & 448 else a))
        turn = (math.nan if mask & 1024 else fields[10], math.nan if mask & 2048 else fields[11])
        self._write(topics.TRAJECTORY_SETPOINT, self._answered_us(t_ms), (*vectors, *turn))

    def _on_actuator_target(self, raw: bytes) -> None:
        fields = _unpacked(codec.SET_ACTUATOR_CONTROL_TARGET_LAYOUT, raw)
        t_us = fields[0]
        self._write(topics.TORQUE_SETPOINT, t_us, (t_us, *fields[1:4]))
        self._write_thrust_setpoint(t_us, (t_us, 0.0, 0.0, -fields[4]))

    # -- what the autopilot says of itself ------------------------------------------------------------------------

    def _on_heartbeat(self, frame: Frame) -> None:
        heartbeat = codec.decode_heartbeat(frame.payload)
        if heartbeat.type != self._kind:
            self._kind = heartbeat.type
            self._parameter("MAV_TYPE", heartbeat.type)
        self._armed = heartbeat.armed
        self._fly(Mode.from_custom_mode(heartbeat.custom_mode))
        self._tell_status()

    def _on_current_mode(self, frame: Frame) -> None:
        message: Any = codec.decode_cold(frame)
        if message is None:
            return
        before = (self._mode, self._intended)
        self._intended = Mode.from_custom_mode(message.intended_custom_mode)
        self._fly(Mode.from_custom_mode(message.custom_mode))
        if (self._mode, self._intended) != before:
            self._tell_status()

    def _fly(self, mode: Mode) -> None:
        if mode != self._mode:
            self._mode = mode
            self._say(Level.INFO, f"the autopilot reports {mode.label}")

    def _tell_status(self) -> None:
        kind = self._kind
        if self.now_us is None or kind is None or self._mode is None:
            return
        flown = NAV_STATES.get(self._mode, UNKNOWN_MODE)
        intended = UNKNOWN_MODE if self._intended is None else NAV_STATES.get(self._intended, UNKNOWN_MODE)
        rotary = int(kind in ROTARY_WINGS)
        self._write(
            topics.STATUS,
            self.now_us,
            (2 if self._armed else 1, intended, flown, rotary, 0, kind, self._system, AUTOPILOT),
        )

    def _on_statustext(self, frame: Frame) -> None:
        self._texts.add(codec.decode_statustext(frame.payload), 1e-6 * (self.now_us or 0))
        self._tell_texts()

    def _tell_texts(self) -> None:
        while self._texts.texts:
            announced = self._texts.texts.popleft()
            self._say(announced.severity, f"autopilot: {announced.text}")

    def _on_param_value(self, frame: Frame) -> None:
        name, value, _ = codec.decode_param_value(frame.payload)
        if value is not None and name and self._parameters.get(name) != value:
            self._parameters[name] = value
            self._parameter(name, value)

    def _on_extended_sys_state(self, frame: Frame) -> None:
        message: Any = codec.decode_cold(frame)
        if message is not None and message.landed_state != 0 and self.now_us is not None:
            self._write(topics.LAND_DETECTED, self.now_us, (message.landed_state == 1,))

    def _on_home_position(self, frame: Frame) -> None:
        message: Any = codec.decode_cold(frame)
        if message is not None and self.now_us is not None:
            where = (1e-7 * message.latitude, 1e-7 * message.longitude, 1e-3 * message.altitude)
            self._write(topics.HOME, self.now_us, (*where, message.x, message.y, message.z))

    def _on_battery_status(self, frame: Frame) -> None:
        message: Any = codec.decode_cold(frame)
        if message is None or message.id != 0 or self.now_us is None:
            return
        cells_mv = [mv for mv in message.voltages if mv != 0xFFFF] + [mv for mv in message.voltages_ext if mv]
        known = bool(cells_mv)
        numbers = (
            known,
            1e-3 * sum(cells_mv),
            -1.0 if message.current_battery == -1 else 1e-2 * message.current_battery,
            float(message.current_consumed),
            -1.0 if message.battery_remaining == -1 else 1e-2 * message.battery_remaining,
            float(message.time_remaining) if message.time_remaining > 0 else math.nan,
            math.nan if message.temperature == 0x7FFF else 1e-2 * message.temperature,
            len(cells_mv),
            1,
            max(message.charge_state - 1, 0) if message.charge_state <= 5 else message.charge_state,
        )
        self._write(topics.BATTERY, self.now_us, numbers)


def _by_id(handlers: dict[int, Handler]) -> dict[bytes, Handler]:
    """By the message's id as it is in a frame of MAVLink 2."""
    return {msgid.to_bytes(3, "little"): handler for msgid, handler in handlers.items()}


def _unpacked(layout: struct.Struct, raw: bytes) -> tuple[Any, ...]:
    """The fields of a frame's payload, its truncated zeros restored."""
    if raw[0] == _V2 and raw[1] >= layout.size:
        return layout.unpack_from(raw, _PAYLOAD_V2)
    return layout.unpack_from(codec.filled(_payload(raw), layout.size))


def _payload(raw: bytes) -> bytes:
    return raw[_PAYLOAD_V2 : _PAYLOAD_V2 + raw[1]] if raw[0] == _V2 else raw[6 : 6 + raw[1]]


def _frame(raw: bytes, wall_ns: int) -> Frame:
    """The frame, which the link has checked already; the truncated zeros are left to the decoders."""
    if raw[0] == _V2:
        msgid = raw[7] | raw[8] << 8 | raw[9] << 16
        payload = raw[_PAYLOAD_V2 : _PAYLOAD_V2 + raw[1]]
        return new_record(Frame, (msgid, raw[5], raw[6], raw[4], payload, raw, wall_ns))
    return Frame(raw[5], raw[3], raw[4], raw[2], _payload(raw), raw, wall_ns)
