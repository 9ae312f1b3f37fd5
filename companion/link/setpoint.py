"""Setpoints to the autopilot: commands become messages here, behind one last check that nothing passes by.

PX4 does not look at the numbers: one zero or NaN quaternion spoils its attitude controller until it is rebooted, a
NaN thrust stops the motors in flight, and body rates have no limit at all. So whatever computed the command,
`SetpointSender.send` asserts it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from companion.control.output import ActuatorSetpoint, AttitudeSetpoint, RateSetpoint, Setpoint
from companion.control.types import Quat
from companion.link.codec import (
    SET_ACTUATOR_CONTROL_TARGET,
    SET_ATTITUDE_TARGET,
    encode_set_actuator_control_target,
    encode_set_attitude_target,
)

__all__ = [
    "ActuatorSetpoint",
    "AttitudeSetpoint",
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

RATE_BOUND_RAD_S: Final = 20.0
"""No sane setpoint is beyond this (gyros end at 35 rad/s); the vehicle's own limits are far below."""
UNIT_TOLERANCE: Final = 1e-3
"""How far from 1 a quaternion's length may be."""

_IDENTITY: Final[Quat] = (1.0, 0.0, 0.0, 0.0)
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
        controls = (*setpoint.torque, setpoint.thrust, 0.0, 0.0, 0.0, 0.0)
        return SET_ACTUATOR_CONTROL_TARGET, encode_set_actuator_control_target(
            t_vehicle_us, _ATTITUDE_CONTROLS, system, component, controls
        )


def check(setpoint: Setpoint) -> None:
    """Assert that a setpoint is one: finite, thrust 0..1, unit quaternion, rates and torques within bounds.

    Comparisons are written so that NaN fails them.

    Raises:
        UnsendableSetpoint: it is not.
    """
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


def _check_bounds(what: str, values: tuple[float, ...], bound: float, unit: str) -> None:
    """Raise unless every value is within +-bound."""
    for value in values:
        if not -bound <= value <= bound:
            raise UnsendableSetpoint(f"{what} {values}: {value} is not within +-{bound} {unit}")
