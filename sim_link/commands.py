"""COMMAND_LONG and COMMAND_INT: every command for this vehicle is answered with a COMMAND_ACK."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from .autopilot import INFO, Autopilot, Result
from .codec import AUTOPILOT_COMPONENT, ID_HEARTBEAT, mavlink
from .geodesy import HOME_ALTITUDE_M, local_position
from .link import Link
from .messages import Telemetry
from .modes import FLAG_CUSTOM_MODE, Mode, available_modes, from_base_mode, from_numbers, from_standard_mode
from .parameters import Parameters
from .rotation import Vec3

FORCE = 21196
"""COMPONENT_ARM_DISARM's param2: disarms in the air. It does not skip the checks when arming."""
_INT32_MAX = 2147483647
_REPOSITION_CHANGE_MODE = 1
_GROUND_SPEED = 1
_HOME_HEIGHT_MAX_M = 1.0e6
_AUTOTUNE_S = 20.0
"""Vehicle time that the simulated autotuning takes."""
_RELATIVE_FRAMES = frozenset((3, 6))
_LOCAL_FRAMES = frozenset((1, 4, 7, 8, 9, 12, 20, 21))
_ALL = frozenset(range(1, 8))

# The parameters that may be other than 0 or NaN (mavlink_command_params.hpp); any other makes 1.18 deny the command.
_ALLOWED: dict[int, frozenset[int]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: frozenset((1, 2)),
    mavlink.MAV_CMD_DO_SET_MODE: frozenset((1, 2, 3)),
    mavlink.MAV_CMD_NAV_TAKEOFF: frozenset((1, 4, 5, 6, 7)),
    mavlink.MAV_CMD_NAV_LAND: frozenset((1, 2, 4, 5, 6, 7)),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: frozenset(),
    mavlink.MAV_CMD_DO_CHANGE_SPEED: frozenset((1, 2, 3)),
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: frozenset((1,)),
}


class Command(NamedTuple):
    """A command in either form."""

    number: int
    params: tuple[float, ...]
    """param1 to param7; what was not given is NaN or 0."""
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT."""

    def whole(self, number: int) -> int | None:
        """Give a param as a whole number; None when it is none."""
        value = self.params[number - 1]
        return round(value) if math.isfinite(value) else None

    def is_set(self, number: int) -> bool:
        """Tell whether a param is other than 0 and NaN."""
        value = self.params[number - 1]
        return not (math.isnan(value) or value == 0.0)


class Failures(Protocol):
    """What goes wrong on purpose, as far as commands have to do with it."""

    @property
    def refused(self) -> Mapping[int, Result]:
        """Commands that are refused now, and how."""

    def inject_failure(self, unit: int, kind: int, instance: int) -> Result:
        """Obey MAV_CMD_INJECT_FAILURE: FAILURE_UNIT, FAILURE_TYPE, which of them (0: all)."""


class Commands:
    """The commands that this vehicle obeys."""

    def __init__(
        self,
        autopilot: Autopilot,
        parameters: Parameters,
        telemetry: Telemetry,
        *,
        system: int,
        failures: Failures | None = None,
    ) -> None:
        self._autopilot = autopilot
        self._parameters = parameters
        self._telemetry = telemetry
        self._autotune_us: int | None = None
        self._system = system
        self._failures = failures
        self._handlers: dict[int, Callable[[Command], Result]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mavlink.MAV_CMD_NAV_LAND: lambda _: self._autopilot.set_mode(Mode.LAND),
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._autopilot.set_mode(Mode.RETURN),
            mavlink.MAV_CMD_DO_FLIGHTTERMINATION: self._flight_termination,
            mavlink.MAV_CMD_DO_REPOSITION: self._reposition,
            mavlink.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            mavlink.MAV_CMD_DO_SET_STANDARD_MODE: self._set_standard_mode,
            mavlink.MAV_CMD_MISSION_START: self._mission_start,
            mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_mission_current,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: lambda _: self._autopilot.check_arming(),
            mavlink.MAV_CMD_PREFLIGHT_STORAGE: self._storage,
            mavlink.MAV_CMD_INJECT_FAILURE: self._inject_failure,
            # Peripherals that this vehicle has none of: PX4 accepts it whatever is connected.
            mavlink.MAV_CMD_DO_SET_ACTUATOR: lambda _: Result.ACCEPTED,
        }
        self._link_handlers: dict[int, Callable[[Command, Link, int], Result]] = {
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE: self._autotune,
        }
        if autopilot.px4 == "1.13":
            self._link_handlers[mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES] = self._request_capabilities
            self._link_handlers[mavlink.MAV_CMD_GET_HOME_POSITION] = self._request_home

    def handle(self, message: Any, sender: tuple[int, int], link: Link, now_us: int) -> None:
        """Obey a COMMAND_LONG or COMMAND_INT and acknowledge it; one for another target gets no answer."""
        if message.target_system not in (0, self._system) or message.target_component not in (0, AUTOPILOT_COMPONENT):
            return
        if sender == (self._system, AUTOPILOT_COMPONENT):
            return
        command = _read(message)
        result = self._obey(command, link, now_us)
        progress = self._autotune_progress(now_us) if result is Result.IN_PROGRESS else 0
        link.send(mavlink.MAVLink_command_ack_message(command.number, int(result), progress, 0, *sender))

    def _obey(self, command: Command, link: Link, now_us: int) -> Result:
        """Find the command's handler; refuse params that it does not know."""
        if self._failures is not None and command.number in self._failures.refused:
            return self._failures.refused[command.number]
        if self._autopilot.px4 != "1.13":
            forbidden = _ALL - _ALLOWED.get(command.number, _ALL)
            if any(command.is_set(number) for number in forbidden):
                return Result.DENIED
        handler = self._handlers.get(command.number)
        if handler is not None:
            return handler(command)
        link_handler = self._link_handlers.get(command.number)
        if link_handler is not None:
            return link_handler(command, link, now_us)
        return Result.UNSUPPORTED

    def _arm_disarm(self, command: Command) -> Result:
        wanted = command.whole(1)
        if wanted == 1:
            return self._autopilot.arm()
        if wanted == 0:
            return self._autopilot.disarm(force=command.whole(2) == FORCE)
        return Result.UNSUPPORTED

    def _set_mode(self, command: Command) -> Result:
        """DO_SET_MODE: param1 base mode with the custom bit, param2 main, param3 sub mode; not the packed number.

        Without the custom bit the other bits of the base mode choose.
        """
        base, main, sub = command.whole(1), command.whole(2), command.whole(3)
        mode = None
        if base is not None and base & FLAG_CUSTOM_MODE:
            mode = None if main is None else from_numbers(main, sub or 0)
        elif base is not None:
            mode = from_base_mode(base)
        return Result.TEMPORARILY_REJECTED if mode is None else self._autopilot.set_mode(mode)

    def _takeoff(self, command: Command) -> Result:
        """NAV_TAKEOFF: param7 is the height above sea level; without one MIS_TAKEOFF_ALT above here. Does not arm."""
        altitude_m = command.params[6]
        if not math.isfinite(altitude_m):
            return self._autopilot.takeoff(None)
        home_altitude_m = HOME_ALTITUDE_M - self._autopilot.guidance.home[2]
        return self._autopilot.takeoff(altitude_m - home_altitude_m)

    def _place(self, command: Command) -> Vec3:
        """Give the local position NED [m] in params 5 to 7; NaN where none is given."""
        latitude, longitude, altitude_m = command.params[4:]
        if command.frame in _RELATIVE_FRAMES:
            altitude_m += HOME_ALTITUDE_M - self._autopilot.guidance.home[2]
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return math.nan, math.nan, HOME_ALTITUDE_M - altitude_m
        return local_position(latitude, longitude, altitude_m)

    def _reposition(self, command: Command) -> Result:
        """DO_REPOSITION: param1 speed, param2 must ask for the change of mode, param4 yaw [rad], then where to."""
        if command.whole(2) != _REPOSITION_CHANGE_MODE:
            return Result.UNSUPPORTED
        speed = command.params[0]
        return self._autopilot.go_to(self._place(command), command.params[3], speed if speed > 0.0 else None)

    def _change_speed(self, command: Command) -> Result:
        """DO_CHANGE_SPEED: param1 type (air or ground speed are one here), param2 speed [m/s]; below 0: the default."""
        speed = command.params[1]
        if command.whole(1) not in (0, _GROUND_SPEED):
            return Result.UNSUPPORTED
        if math.isfinite(speed):
            guidance = self._autopilot.guidance
            guidance.speed_m_s = guidance.mission.speed_m_s = speed if speed > 0.0 else None
        return Result.ACCEPTED

    def _set_home(self, command: Command) -> Result:
        """DO_SET_HOME: param1 = 1: here; 0: where params 5 to 7 say."""
        if command.whole(1) == 1:
            return self._autopilot.set_home(None)
        home = self._place(command)
        # Heights add up where one is meant above the home before: without a limit they outgrow the messages' fields.
        if not all(map(math.isfinite, home)) or abs(home[2]) > _HOME_HEIGHT_MAX_M:
            return Result.DENIED
        return self._autopilot.set_home(home)

    def _set_standard_mode(self, command: Command) -> Result:
        """DO_SET_STANDARD_MODE: param1 is the MAV_STANDARD_MODE."""
        mode = from_standard_mode(command.whole(1))
        return Result.UNSUPPORTED if mode is None else self._autopilot.set_mode(mode)

    def _mission_start(self, command: Command) -> Result:
        """MISSION_START: param1 first item, -1: the current one. Arms."""
        first = command.whole(1)
        if first is None or first < -1:
            return Result.UNSUPPORTED
        return self._autopilot.start_mission(first)

    def _set_mission_current(self, command: Command) -> Result:
        """DO_SET_MISSION_CURRENT: param1 item."""
        index = command.whole(1)
        selected = index is not None and self._autopilot.guidance.mission.select(index)
        return Result.ACCEPTED if selected else Result.DENIED

    def _storage(self, command: Command) -> Result:
        """PREFLIGHT_STORAGE: param1 = 2 resets the parameters to those of the start; they are not kept anywhere."""
        if self._autopilot.armed:
            return Result.TEMPORARILY_REJECTED
        action = command.whole(1)
        if action not in (0, 1, 2):
            return Result.UNSUPPORTED
        if action == 2:
            self._parameters.reset()
        return Result.ACCEPTED

    def _autotune(self, command: Command, link: Link, now_us: int) -> Result:
        """DO_AUTOTUNE_ENABLE: answered with how far it is, as often as it is asked.

        It takes its time in the air and then is done. The gains stay as they are: they follow from the vehicle file.
        """
        if command.whole(1) != 1:
            return Result.DENIED
        if not self._autopilot.armed or self._autopilot.land.landed:
            self._autotune_us = None
            return Result.TEMPORARILY_REJECTED
        if self._autotune_us is None:
            self._autotune_us = now_us
            self._autopilot.texts.append((INFO, "Autotune initializing"))
        if self._autotune_progress(now_us) < 100:
            return Result.IN_PROGRESS
        self._autotune_us = None
        return Result.ACCEPTED

    def _autotune_progress(self, now_us: int) -> int:
        """Give how far the autotuning is [%]."""
        if self._autotune_us is None:
            return 0
        return min(100, int((now_us - self._autotune_us) * 1e-4 / _AUTOTUNE_S))

    def _inject_failure(self, command: Command) -> Result:
        """INJECT_FAILURE: param1 unit, param2 type, param3 instance, 0 or NaN: all."""
        unit, kind = command.whole(1), command.whole(2)
        if self._failures is None or unit is None or kind is None:
            return Result.UNSUPPORTED
        return self._failures.inject_failure(unit, kind, command.whole(3) or 0)

    def _flight_termination(self, command: Command) -> Result:
        if command.params[0] > 0.5:
            return self._autopilot.terminate()
        return Result.UNSUPPORTED

    def _set_interval(self, command: Command, link: Link, now_us: int) -> Result:
        """SET_MESSAGE_INTERVAL, for the link it came on; params 3, 4 and 7 must be 0 or NaN."""
        msg_id, interval_us = command.whole(1), command.whole(2)
        if msg_id is None or interval_us is None or msg_id == ID_HEARTBEAT:
            return Result.FAILED
        if any(command.is_set(number) for number in (3, 4, 7)):
            return Result.FAILED
        return Result.ACCEPTED if link.set_interval(msg_id, interval_us, now_us) else Result.FAILED

    def _get_interval(self, command: Command, link: Link, now_us: int) -> Result:
        """GET_MESSAGE_INTERVAL: answered with MESSAGE_INTERVAL, 0 for a message that there is not."""
        msg_id = command.whole(1)
        if msg_id is None or not 0 <= msg_id <= 0xFFFF:
            return Result.FAILED
        link.send(mavlink.MAVLink_message_interval_message(msg_id, link.interval_us(msg_id) or 0))
        return Result.ACCEPTED

    def _request_message(self, command: Command, link: Link, now_us: int) -> Result:
        """REQUEST_MESSAGE: denied when there is no such message or no data for it yet."""
        msg_id = command.whole(1)
        if msg_id is None:
            return Result.DENIED
        if msg_id == mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES:
            return self._send_modes(command.whole(2) or 0, link)
        return self._send(msg_id, link)

    @staticmethod
    def _send_modes(wanted: int, link: Link) -> Result:
        """Queue AVAILABLE_MODES: the mode of that number from 1 on, 0: all of them."""
        modes = available_modes()
        if not 0 <= wanted <= len(modes):
            return Result.DENIED
        for index, mode in enumerate(modes, 1):
            if wanted in (0, index):
                link.send(
                    mavlink.MAVLink_available_modes_message(
                        len(modes), index, mode.standard, mode.custom_mode, 0, mode.label.encode()
                    )
                )
        return Result.ACCEPTED

    def _request_home(self, command: Command, link: Link, now_us: int) -> Result:
        """GET_HOME_POSITION, gone in 1.18."""
        return self._send(mavlink.MAVLINK_MSG_ID_HOME_POSITION, link)

    def _request_capabilities(self, command: Command, link: Link, now_us: int) -> Result:
        """REQUEST_AUTOPILOT_CAPABILITIES, gone in 1.18."""
        return self._send(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, link)

    def _send(self, msg_id: int, link: Link) -> Result:
        """Queue one message on a link."""
        content = self._telemetry.build(msg_id)
        if content is None:
            return Result.DENIED
        if isinstance(content, bytes):
            link.send_hot(msg_id, content)
        else:
            link.send(content)
        return Result.ACCEPTED


def _read(message: Any) -> Command:
    """Bring COMMAND_LONG and COMMAND_INT to one form; x and y are scaled, the largest number in both means NaN."""
    frame = None
    if message.get_type() == "COMMAND_INT":
        frame = message.frame
    if frame is None:
        last = (message.param5, message.param6, message.param7)
    elif message.x == _INT32_MAX and message.y == _INT32_MAX:
        last = (math.nan, math.nan, message.z)
    else:
        scale = 1e-4 if message.frame in _LOCAL_FRAMES else 1e-7
        last = (scale * message.x, scale * message.y, message.z)
    return Command(message.command, (message.param1, message.param2, message.param3, message.param4, *last), frame)
