"""What the sticks mean in the modes that they fly, with PX4's scales."""

from __future__ import annotations

import math

from .inner_loops import ATTITUDE, RATES, Setpoint
from .manual_control import Sticks, with_deadzone
from .modes import Mode
from .parameters import Parameters
from .rotation import Quat, from_yaw, multiply, yaw_of

CENTRED = Sticks(0.0, 0.0, 0.0, 0.0)
_GRAVITY_M_S2 = 9.80665
_DEADZONE = 0.1
_NO_TORQUE = (0.0, 0.0, 0.0)


def deadzone(parameters: Parameters) -> float:
    """Give how far a stick may be off its middle and still be in it."""
    return parameters.within("MAN_DEADZONE", 0.0, 0.9) if "MAN_DEADZONE" in parameters else _DEADZONE


class AttitudeSticks:
    """Stabilized and Manual (a tilt and a turn), and Acro (rates): thrust straight from the throttle stick."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._yaw: float | None = None

    def rest(self) -> None:
        """Forget the heading: somebody else is in charge."""
        self._yaw = None

    def turn(self, dyaw_rad: float) -> None:
        """Take note that the heading estimate has jumped: the vehicle shall not turn for it."""
        if self._yaw is not None:
            self._yaw += dyaw_rad

    def setpoint(self, mode: Mode, sticks: Sticks, q: Quat, dt_s: float) -> Setpoint:
        """Give what the inner loops shall follow. Nobody holds position or height."""
        thrust = self._thrust(sticks.throttle)
        if mode is Mode.ACRO:
            self._yaw = None
            roll, pitch, yaw = (math.radians(self._parameters.number(f"MC_ACRO_{axis}_MAX")) for axis in "RPY")
            rates = (roll * sticks.roll, -pitch * sticks.pitch, yaw * sticks.yaw)
            return Setpoint(RATES, thrust, rates, q, math.nan, _NO_TORQUE)
        rate = turn_rate(sticks, self._parameters)
        if self._yaw is None or rate != 0.0:
            self._yaw = (yaw_of(q) if self._yaw is None else self._yaw) + rate * dt_s
        tilt_max = math.radians(self._parameters.within("MPC_MAN_TILT_MAX", 0.0, 85.0))
        size = math.hypot(sticks.roll, sticks.pitch)
        tilt = tilt_max * min(1.0, size)
        level = from_yaw(self._yaw)
        if size > 0.0:
            half, share = math.sin(tilt / 2.0) / size, math.cos(tilt / 2.0)
            level = multiply(level, (share, half * sticks.roll, -half * sticks.pitch, 0.0))
        return Setpoint(ATTITUDE, thrust, (0.0, 0.0, 0.0), level, rate, _NO_TORQUE)

    def _thrust(self, throttle: float) -> float:
        """Give the thrust: the hover thrust in the middle of the stick (MPC_THR_CURVE = 0)."""
        low, high = (self._parameters.within(name, 0.0, 1.0) for name in ("MPC_MANTHR_MIN", "MPC_THR_MAX"))
        if self._parameters.integer("MPC_THR_CURVE") != 0:
            return low + 0.5 * (throttle + 1.0) * (high - low)
        middle = self._parameters.within("MPC_THR_HOVER", 0.0, 1.0)
        return middle + throttle * ((high - middle) if throttle > 0.0 else (middle - low))


def turn_rate(sticks: Sticks, parameters: Parameters) -> float:
    """Give the yaw rate that the yaw stick asks for [rad/s]."""
    turn = with_deadzone(sticks.yaw, deadzone(parameters))
    return turn * math.radians(parameters.within("MPC_MAN_Y_MAX", 0.0, 400.0))


def velocity(sticks: Sticks, yaw: float, parameters: Parameters) -> tuple[float, float]:
    """Give the velocity north and east [m/s] that the sticks ask for in Position."""
    ahead, right = _horizontal(sticks, parameters)
    speed = min(parameters.number("MPC_VEL_MANUAL"), parameters.number("MPC_XY_VEL_MAX"))
    return _turned(speed * ahead, speed * right, yaw)


def acceleration(sticks: Sticks, yaw: float, parameters: Parameters) -> tuple[float, float]:
    """Give the acceleration north and east [m/s^2] of the tilt that the sticks ask for in Altitude."""
    ahead, right = _horizontal(sticks, parameters)
    most = _GRAVITY_M_S2 * math.tan(math.radians(parameters.within("MPC_MAN_TILT_MAX", 0.0, 80.0)))
    return _turned(most * ahead, most * right, yaw)


def descent(sticks: Sticks, parameters: Parameters) -> float:
    """Give the speed downwards [m/s] that the throttle stick asks for in Position and Altitude."""
    up = with_deadzone(sticks.throttle, deadzone(parameters))
    return -up * parameters.number("MPC_Z_VEL_MAX_UP" if up > 0.0 else "MPC_Z_VEL_MAX_DN")


def _horizontal(sticks: Sticks, parameters: Parameters) -> tuple[float, float]:
    """Give the stick's share ahead and to the right, at most 1 together."""
    size = math.hypot(sticks.pitch, sticks.roll)
    if size == 0.0:
        return 0.0, 0.0
    share = with_deadzone(min(size, 1.0), deadzone(parameters)) / size
    return share * sticks.pitch, share * sticks.roll


def _turned(ahead: float, right: float, yaw: float) -> tuple[float, float]:
    return ahead * math.cos(yaw) - right * math.sin(yaw), ahead * math.sin(yaw) + right * math.cos(yaw)
