"""Setpoints to the autopilot: commands become messages here, behind one last check that nothing passes by.

PX4 does not look at the numbers: one zero or NaN quaternion spoils its attitude controller until it is rebooted, a
NaN thrust stops the motors in flight, body rates have no limit at all, and a step of a position goes straight to its
position controller. So whatever computed the command, `SetpointSender.send` asserts it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from companion.control.output import ActuatorSetpoint, AttitudeSetpoint, PositionSetpoint, RateSetpoint, Setpoint
from companion.control.types import Quat, Vec3
from companion.link.codec import (
    SET_ACTUATOR_CONTROL_TARGET,
    SET_ATTITUDE_TARGET,
    SET_POSITION_TARGET_LOCAL_NED,
    encode_set_actuator_control_target,
    encode_set_attitude_target,
    encode_set_position_target_local_ned,
)

__all__ = [
    "ActuatorSetpoint",
    "AttitudeSetpoint",
    "PositionSetpoint",
    "RateSetpoint",
    "Setpoint",
    "SetpointSender",
    "UnsendableSetpoint",
    "check",
]

MASK_RATES: Final = 128
"""SET_ATTITUDE_TARGET: ignore the attitude; body rates and thrust."""
MASK_ATTITUDE: Final = 3
"""Ignore roll and pitch rate; attitude, thrust, and the yaw rate as feed-forward about the world's vertical."""
POSITION_IGNORE: Final = 7
"""SET_POSITION_TARGET_LOCAL_NED: the ignore bits of x, y, z; x and y must go together, so all three do."""
ACCELERATION_IGNORE: Final = 7 << 6
YAW_IGNORE: Final = 1024
YAW_RATE_IGNORE: Final = 2048
"""Velocity (56) is always commanded, and 512, force instead of acceleration, PX4 refuses. So 0 is everything."""

RATE_BOUND_RAD_S: Final = 20.0
"""No sane setpoint is beyond this (gyros end at 35 rad/s); the vehicle's own limits are far below."""
POSITION_BOUND_M: Final = 10_000.0
"""Further from the origin of its local frame PX4's single precision is no position any more."""
SPEED_BOUND_M_S: Final = 100.0
ACCELERATION_BOUND_M_S2: Final = 100.0
YAW_BOUND_RAD: Final = math.pi
UNIT_TOLERANCE: Final = 1e-3
"""How far from 1 a quaternion's length may be."""

_IDENTITY: Final[Quat] = (1.0, 0.0, 0.0, 0.0)
_ZERO: Final[Vec3] = (0.0, 0.0, 0.0)
_ATTITUDE_CONTROLS: Final = 0  # actuator group 0: roll, pitch, yaw, thrust, and four that a multirotor leaves at 0
_UINT32 = 0xFFFFFFFF


class UnsendableSetpoint(Exception):  # noqa: N818 - it names the setpoint's state, as the log does
    """A setpoint that must not reach an autopilot. Nothing was sent; the message says which number is wrong."""


class SetpointSender:
    """The only way for a setpoint to the vehicle."""

    def __init__(self, send: Callable[[int, bytes], bool], target_system: int, target_component: int = 1) -> None:
        """`send` takes a message id and a payload (`Wire.send`); the targets are the autopilot's ids."""
        self._send = send
        self.target_system = target_system
        self.target_component = target_component
        self.sent = 0
        """Setpoints that went out."""

    def send(self, setpoint: Setpoint, t_vehicle_us: int) -> bool:
        """Check a setpoint and send it. False when the link would not take it.

        Args:
            setpoint: what to send.
            t_vehicle_us: the vehicle's clock (the stamp of the state that this answers); PX4 ignores it, logs keep it.

        Raises:
            UnsendableSetpoint: the setpoint must not be sent, and was not.
        """
        check(setpoint)
        msgid, payload = self._encode(setpoint, t_vehicle_us)
        out = self._send(msgid, payload)
        if out:
            self.sent += 1
        return out

    def _encode(self, setpoint: Setpoint, t_vehicle_us: int) -> tuple[int, bytes]:
        """Message id and payload of a checked setpoint."""
        system, component = self.target_system, self.target_component
        t_ms = t_vehicle_us // 1000 & _UINT32
        if isinstance(setpoint, RateSetpoint):
            return SET_ATTITUDE_TARGET, encode_set_attitude_target(
                t_ms, system, component, MASK_RATES, _IDENTITY, setpoint.w, setpoint.thrust
            )
        if isinstance(setpoint, AttitudeSetpoint):
            return SET_ATTITUDE_TARGET, encode_set_attitude_target(
                t_ms, system, component, MASK_ATTITUDE, setpoint.q, (0.0, 0.0, setpoint.yaw_rate), setpoint.thrust
            )
        if isinstance(setpoint, PositionSetpoint):
            vectors = (setpoint.p or _ZERO, setpoint.v, setpoint.a or _ZERO)
            turn = (setpoint.yaw or 0.0, setpoint.yaw_rate or 0.0)
            return SET_POSITION_TARGET_LOCAL_NED, encode_set_position_target_local_ned(
                t_ms, system, component, position_mask(setpoint), vectors, turn
            )
        controls = (*setpoint.torque, setpoint.thrust, 0.0, 0.0, 0.0, 0.0)
        return SET_ACTUATOR_CONTROL_TARGET, encode_set_actuator_control_target(
            t_vehicle_us, _ATTITUDE_CONTROLS, system, component, controls
        )


def position_mask(setpoint: PositionSetpoint) -> int:
    """The type mask: the ignore bits of what is not commanded."""
    return (
        (POSITION_IGNORE if setpoint.p is None else 0)
        | (ACCELERATION_IGNORE if setpoint.a is None else 0)
        | (YAW_IGNORE if setpoint.yaw is None else 0)
        | (YAW_RATE_IGNORE if setpoint.yaw_rate is None else 0)
    )


def check(setpoint: Setpoint) -> None:
    """Assert that a setpoint is one: finite, thrust 0..1, unit quaternion, everything else within its bound.

    Comparisons are written so that NaN fails them.

    Raises:
        UnsendableSetpoint: it is not.
    """
    if isinstance(setpoint, PositionSetpoint):
        _check_position(setpoint)
        return
    if not 0.0 <= setpoint.thrust <= 1.0:
        raise UnsendableSetpoint(f"thrust {setpoint.thrust} is not within 0..1")
    if isinstance(setpoint, RateSetpoint):
        _check_bounds("body rates", setpoint.w, RATE_BOUND_RAD_S, "rad/s")
    elif isinstance(setpoint, AttitudeSetpoint):
        length = math.sqrt(sum(part * part for part in setpoint.q))
        if not abs(length - 1.0) <= UNIT_TOLERANCE:
            raise UnsendableSetpoint(f"quaternion {setpoint.q} has length {length}, not 1")
        _check_bounds("yaw rate", (setpoint.yaw_rate,), RATE_BOUND_RAD_S, "rad/s")
    elif isinstance(setpoint, ActuatorSetpoint):
        _check_bounds("torques", setpoint.torque, 1.0, "of full")
    else:
        raise UnsendableSetpoint(f"{setpoint!r} is no kind of setpoint")


def _check_position(setpoint: PositionSetpoint) -> None:
    """Raise unless what is commanded is within its bounds."""
    p, v, a, yaw, yaw_rate = setpoint
    _check_bounds("velocity", v, SPEED_BOUND_M_S, "m/s")
    if p is not None:
        _check_bounds("position", p, POSITION_BOUND_M, "m")
    if a is not None:
        _check_bounds("acceleration", a, ACCELERATION_BOUND_M_S2, "m/s^2")
    if yaw is not None:
        _check_bounds("yaw", (yaw,), YAW_BOUND_RAD, "rad")
    if yaw_rate is not None:
        _check_bounds("yaw rate", (yaw_rate,), RATE_BOUND_RAD_S, "rad/s")


def _check_bounds(what: str, values: tuple[float, ...], bound: float, unit: str) -> None:
    """Raise unless every value is within +-bound."""
    for value in values:
        if not -bound <= value <= bound:
            raise UnsendableSetpoint(f"{what} {values}: {value} is not within +-{bound} {unit}")
