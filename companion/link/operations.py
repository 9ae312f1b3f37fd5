"""What a flight asks of the autopilot besides setpoints: modes, arming, message rates, parameters.

A state machine without threads and without sleeping. The caller passes the time (vehicle or wall, but always the
same), hands in the frames that came, and calls `update` at every turn of its loop; requests are repeated until they
are answered or given up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from companion.link import codec, timesync
from companion.link.commands import CommandQueue, Params
from companion.link.framing import Frame
from companion.link.modes import Mode
from companion.link.parameters import ParameterReader
from companion.link.requests import Operation, Result, Retry
from companion.link.statustext import StatusTexts
from companion.link.version import AutopilotVersion

__all__ = ["Command", "Operation", "Operations", "Result", "Retry"]

DEFAULT_RETRY: Final = Retry()
STOP_MESSAGE: Final = -1
"""Interval that switches a message off."""
DEFAULT_INTERVAL: Final = 0
"""Interval that gives a message its default rate."""
_CUSTOM_MODE_ENABLED = 1.0  # MAV_MODE_FLAG, in param1 of DO_SET_MODE
_NAN = math.nan


class Command(IntEnum):
    """MAV_CMD, the ones used here."""

    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_SET_MODE = 176
    COMPONENT_ARM_DISARM = 400
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512


# A new request of these says that the one before is no longer wanted; it must not wait behind it.
_NEWEST_WINS: Final = {Command.DO_SET_MODE, Command.COMPONENT_ARM_DISARM}
# What moves the vehicle, and must not be repeated once something else is wanted.
_MOVING: Final = (Command.DO_SET_MODE, Command.COMPONENT_ARM_DISARM, Command.NAV_TAKEOFF, Command.NAV_LAND)


class Operations:
    """The requests to one autopilot.

    Every request returns an `Operation` at once; its `result` is PENDING until an answer came or the tries are used up.
    """

    def __init__(
        self,
        send: Callable[[int, bytes], bool],
        target_system: int,
        target_component: int = 1,
        own_system: int | None = None,
        own_component: int = 191,
    ) -> None:
        """Build it over a link.

        Args:
            send: takes a message id and a payload, like `Wire.send`.
            target_system: the autopilot's system id (0, "everybody", would not be answered).
            target_component: its component id.
            own_system: our system id; by default the vehicle's, as PX4 expects of a companion.
            own_component: our component id.
        """
        self.target_system = target_system
        self.target_component = target_component
        self.own_system = target_system if own_system is None else own_system
        self.own_component = own_component
        self.texts = StatusTexts()
        """What the autopilot says in words."""
        self.version: AutopilotVersion | None = None
        """The autopilot's version, once it has sent it (`request_message(codec.AUTOPILOT_VERSION, ...)`)."""
        self._send = send
        self._commands = CommandQueue(self._send_command)
        self._parameters = ParameterReader(self._send_parameter_request)

    def set_mode(self, mode: Mode, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for a flight mode. It replaces an earlier wish at once.

        PX4 takes OFFBOARD only while fresh setpoints come (TEMPORARILY_REJECTED otherwise).
        """
        params = (_CUSTOM_MODE_ENABLED, float(mode.main), float(mode.sub), 0.0, 0.0, 0.0, 0.0)
        return self.command(Command.DO_SET_MODE, params, f"changing to {mode.label}", now_s, retry)

    def arm(self, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for armed motors; the autopilot's own checks decide."""
        params = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return self.command(Command.COMPONENT_ARM_DISARM, params, "arming", now_s, retry)

    def disarm(self, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for disarmed motors; denied in the air. (The forced form, which falls out of the sky, is not offered.)"""
        return self.command(Command.COMPONENT_ARM_DISARM, (0.0,) * 7, "disarming", now_s, retry)

    def takeoff(self, altitude_amsl_m: float | None, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for a take-off here, heading as it is. It does not arm.

        Args:
            altitude_amsl_m: altitude above mean sea level; None for the autopilot's own height above ground
            (MIS_TAKEOFF_ALT). now_s: the caller's time.
            retry: how often to ask.
        """
        altitude = _NAN if altitude_amsl_m is None else altitude_amsl_m
        params = (_NAN, _NAN, _NAN, _NAN, _NAN, _NAN, altitude)
        return self.command(Command.NAV_TAKEOFF, params, "take-off", now_s, retry)

    def land(self, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for a landing here, heading as it is."""
        return self.command(Command.NAV_LAND, (_NAN,) * 7, "landing", now_s, retry)

    def drop_moving(self, now_s: float) -> None:
        """Repeat no request for a mode, arming, a take-off or a landing any more: something else is wanted now."""
        for command in _MOVING:
            self._commands.drop(command, now_s)

    def set_message_interval(
        self, msgid: int, interval_us: int, now_s: float, retry: Retry = DEFAULT_RETRY
    ) -> Operation:
        """Ask for a message every `interval_us` on this link; `STOP_MESSAGE` and `DEFAULT_INTERVAL` are special.

        Several go out one after the other. Ask for a shorter interval than needed: asking for exactly the period of the
        source loses 14-20 % of the messages.
        """
        params = (float(msgid), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0)
        what = f"setting the rate of {codec.message_name(msgid)}"
        return self.command(Command.SET_MESSAGE_INTERVAL, params, what, now_s, retry)

    def request_message(self, msgid: int, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for a message once."""
        params = (float(msgid), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return self.command(Command.REQUEST_MESSAGE, params, f"asking for {codec.message_name(msgid)}", now_s, retry)

    def command(self, command: int, params: Params, what: str, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for any command; `what` names it to people.

        The same mode or arming asked for again while it is pending is the same operation; message rates wait for one
        another.
        """
        operation = Operation(what, now_s, self.texts)
        return self._commands.ask(command, params, operation, retry, command in _NEWEST_WINS)

    def read_parameter(self, name: str, now_s: float, retry: Retry = DEFAULT_RETRY) -> Operation:
        """Ask for a parameter; `Operation.value` is an int or a float by the parameter's own type.

        A name that the autopilot does not have ends UNSUPPORTED (new PX4 says so) or TIMEOUT (old PX4 is silent).

        Raises:
            ValueError: no parameter can have this name.
        """
        return self._parameters.ask(name, Operation(f"reading {name}", now_s, self.texts), retry)

    def ask_time(self, own_ns: int) -> None:
        """Ask for the autopilot's clock (TIMESYNC); the answer, with `own_ns` in ts1, is not taken here."""
        self._send(codec.TIMESYNC, timesync.request(own_ns, self.target_system, self.target_component))

    def on_frame(self, frame: Frame, now_s: float) -> bool:
        """Take a frame; False when it is none of ours (other senders, other messages, answers to others)."""
        if frame.sysid != self.target_system or frame.compid != self.target_component:
            return False
        msgid = frame.msgid
        if msgid == codec.COMMAND_ACK:
            ack = codec.decode_command_ack(frame.payload)
            if not self._for_us(ack.target_system, ack.target_component):
                return False
            self._commands.on_ack(ack, now_s)
        elif msgid == codec.PARAM_VALUE:
            self._parameters.on_value(codec.decode_param_value(frame.payload), now_s)
        elif msgid == codec.PARAM_ERROR:
            error = codec.decode_param_error(frame.payload)
            if not self._for_us(error.target_system, error.target_component):
                return False
            self._parameters.on_error(error, now_s)
        elif msgid == codec.STATUSTEXT:
            self.texts.add(codec.decode_statustext(frame.payload), now_s)
        elif msgid == codec.AUTOPILOT_VERSION:
            self.version = AutopilotVersion.from_message(codec.decode_autopilot_version(frame.payload))
        else:
            return False
        return True

    def update(self, now_s: float) -> None:
        """Repeat what was not answered, give up what was asked often enough, send what waited."""
        if self._commands.busy:  # this comes with every state, and mostly nothing is asked
            self._commands.update(now_s)
        if self._parameters.asked:
            self._parameters.update(now_s)
        if self.texts.partial:
            self.texts.update(now_s)

    def _for_us(self, system: int, component: int) -> bool:
        """Whether an answer's targets are ours or everybody's."""
        return system in {0, self.own_system} and component in {0, self.own_component}

    def _send_command(self, command: int, confirmation: int, params: Params) -> None:
        payload = codec.encode_command_long(self.target_system, self.target_component, command, confirmation, params)
        self._send(codec.COMMAND_LONG, payload)

    def _send_parameter_request(self, name: str) -> None:
        payload = codec.encode_param_request_read(self.target_system, self.target_component, name)
        self._send(codec.PARAM_REQUEST_READ, payload)
