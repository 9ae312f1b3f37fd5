"""From a flight task to the attitude setpoint: the position controller with the autopilot's parameters."""

from __future__ import annotations

import math

from .guidance import Guidance
from .hover_thrust import HoverThrust
from .inner_loops import RATES, Setpoint
from .parameters import Parameters
from .physics import RigidState
from .position_loop import (
    PositionParameters,
    PositionSetpoint,
    PositionState,
    initial_position_state,
    position_control,
)
from .rotation import Vec3, body_z

_GRAVITY_M_S2 = 9.80665
IDLE = Setpoint(RATES, 0.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), math.nan, (0.0, 0.0, 0.0))
"""Armed on the ground: rotors turning, no thrust."""

_RANGES = {
    "MPC_XY_VEL_P_ACC": (0.1, 20.0),
    "MPC_XY_VEL_MAX": (0.1, 1000.0),
    "MPC_TILTMAX_AIR": (1.0, 85.0),
    "MPC_THR_MIN": (0.01, 0.5),
    "MPC_THR_MAX": (0.5, 1.0),
    "MPC_THR_HOVER": (0.1, 0.8),
}
"""Nobody checks the range of a PARAM_SET; the controller limits what it could not compute with. Others: 0 to 1000."""


class Steering:
    """The position controller and what it remembers while it is in charge."""

    def __init__(self, parameters: Parameters, hover: HoverThrust) -> None:
        self._parameters = parameters
        self._hover = hover
        self._hover_share: float | None = None
        """The estimate of the hover thrust that came last, which goes on when it is valid no more."""
        self._up = 0.0
        """The upward part of the thrust that was given last."""
        self._values = PositionParameters()
        self._version = -1
        self._state: PositionState | None = None
        self._ramp_s: float | None = None
        self.target: PositionSetpoint | None = None
        """What is flown, or was flown last."""

    def rest(self) -> None:
        """Forget: somebody else is in charge, and the controller begins anew."""
        self._state = None
        self._ramp_s = None

    def shift(self, dv_m_s: Vec3) -> None:
        """Take note that the velocity estimate has jumped: that is no acceleration."""
        if self._state is not None:
            a, b = self._state.v_previous, dv_m_s
            self._state = self._state._replace(v_previous=(a[0] + b[0], a[1] + b[1], a[2] + b[2]))

    def begin_takeoff(self) -> None:
        """Let the climb speed grow from nothing: a trajectory takes the vehicle off."""
        if self._ramp_s is None:
            self._ramp_s = 0.0

    def guided(self, guidance: Guidance, rigid: RigidState, dt_s: float) -> Setpoint:
        """Give the attitude setpoint of a flight task; dt_s is the time since the last call."""
        return self.setpoint(guidance.setpoint(rigid.p, rigid.v, dt_s), rigid, dt_s)

    def setpoint(self, target: PositionSetpoint, rigid: RigidState, dt_s: float) -> Setpoint:
        """Give the attitude setpoint that flies `target`; dt_s is the time since the last call."""
        if self._version != self._parameters.version:
            self._version = self._parameters.version
            self._values = position_parameters(self._parameters)
            if self._hover_share is not None:
                self._values = self._values._replace(MPC_THR_HOVER=self._hover_share)
        self._take_hover_thrust()
        state = initial_position_state(rigid.v) if self._state is None else self._state
        values = self._values
        if self._ramp_s is not None:
            self._ramp_s += dt_s
            share = self._ramp_s / max(self._parameters.number("MPC_TKO_RAMP_T"), 1e-3)
            if share < 1.0:
                values = values._replace(MPC_Z_VEL_MAX_UP=share * values.MPC_Z_VEL_MAX_UP)
                target = target._replace(a=(target.a[0], target.a[1], math.nan))
            else:
                self._ramp_s = None
        self.target = target
        setpoint, self._state = position_control(rigid.p, rigid.v, rigid.q, target, state, values, dt_s)
        self._up = setpoint.thrust * body_z(setpoint.q)[2]
        return setpoint

    def _take_hover_thrust(self) -> None:
        """Reckon with the hover thrust as it is estimated now; the integral makes up for it, and the thrust stays."""
        share, before = self._hover.value, self._values.MPC_THR_HOVER
        if share is None or share == before:
            return
        self._hover_share = share
        self._values = self._values._replace(MPC_THR_HOVER=share)
        if self._state is not None:
            north, east, down = self._state.integral
            down += _GRAVITY_M_S2 * self._up * (1.0 / before - 1.0 / share)
            self._state = self._state._replace(integral=(north, east, down))


def position_parameters(parameters: Parameters) -> PositionParameters:
    """Give the position controller's parameters, limited to what it can compute with."""
    names = PositionParameters._fields
    return PositionParameters(*(parameters.within(name, *_RANGES.get(name, (0.0, 1000.0))) for name in names))
