"""From a flight task to the attitude setpoint: the position controller with the autopilot's parameters."""

from __future__ import annotations

import math

from .guidance import Guidance
from .inner_loops import ATTITUDE, RATES, Setpoint
from .modes import Mode
from .parameters import Parameters
from .physics import RigidState
from .position_loop import PositionParameters, PositionState, initial_position_state, position_control
from .rotation import Quat, yaw_of

IDLE = Setpoint(RATES, 0.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), math.nan, (0.0, 0.0, 0.0))
"""Armed on the ground: rotors turning, no thrust."""

_RANGES = {
    "MPC_XY_VEL_P_ACC": (0.1, 20.0),
    "MPC_TILTMAX_AIR": (1.0, 85.0),
    "MPC_THR_MIN": (0.01, 0.5),
    "MPC_THR_MAX": (0.5, 1.0),
    "MPC_THR_HOVER": (0.1, 0.8),
}
"""Nobody checks the range of a PARAM_SET; the controller limits what it could not compute with. Others: 0 to 1000."""


class Steering:
    """The position controller and what it remembers while it is in charge."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._values = PositionParameters()
        self._version = -1
        self._state: PositionState | None = None

    def rest(self) -> None:
        """Forget: somebody else is in charge, and the controller begins anew."""
        self._state = None

    def setpoint(self, guidance: Guidance, rigid: RigidState, dt_s: float) -> Setpoint:
        """Give the attitude setpoint of a flight task; dt_s is the time since the last call."""
        if self._version != self._parameters.version:
            self._version = self._parameters.version
            self._values = position_parameters(self._parameters)
        state = initial_position_state(rigid.v) if self._state is None else self._state
        target = guidance.setpoint(rigid.p, rigid.v, dt_s)
        setpoint, self._state = position_control(rigid.p, rigid.v, rigid.q, target, state, self._values, dt_s)
        return setpoint


def position_parameters(parameters: Parameters) -> PositionParameters:
    """Give the position controller's parameters, limited to what it can compute with."""
    names = PositionParameters._fields
    return PositionParameters(*(parameters.within(name, *_RANGES.get(name, (0.0, 1000.0))) for name in names))


def centred(mode: Mode, q: Quat, parameters: Parameters) -> Setpoint:
    """Give what centred sticks mean in Stabilized, Manual and Acro: level, or no rotation, at the hover thrust.

    Nobody holds position or height then.
    """
    thrust = parameters.number("MPC_THR_HOVER")
    if mode is Mode.ACRO:
        return Setpoint(RATES, thrust, (0.0, 0.0, 0.0), q, math.nan, (0.0, 0.0, 0.0))
    half = yaw_of(q) / 2.0
    return Setpoint(
        ATTITUDE, thrust, (0.0, 0.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half)), math.nan, (0.0, 0.0, 0.0)
    )
