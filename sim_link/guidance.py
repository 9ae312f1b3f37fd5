"""Where the vehicle flies in the modes in which it steers itself: Hold, Takeoff, Land, Return, Position, Altitude.

Gives position and velocity setpoints to the position controller; velocities follow a limited acceleration, as PX4's do.
"""

from __future__ import annotations

import math

from .modes import Mode
from .parameters import Parameters
from .position_loop import PositionSetpoint
from .rotation import Vec3

_NOTHING = (math.nan, math.nan, math.nan)
_STOPPED_M_S = 0.3
_NEAR_M = 0.3
_RETURN_NEAR_M = 10.0
"""Closer to home than this, Return neither climbs nor cruises (PX4: RTL_MIN_DIST)."""


class Guidance:
    """The flight tasks. Positions are NED [m] as the estimator gives them, heights are above home."""

    def __init__(self, parameters: Parameters, home: Vec3) -> None:
        self._parameters = parameters
        self.home = home
        self.takeoff_height_m: float | None = None
        """Height above home that a takeoff command asked for; None: MIS_TAKEOFF_ALT above where it starts."""
        self.takeoff_done = False
        self.descending = False
        """Whether the vehicle is told to go down: the land detector asks."""
        self._mode = Mode.HOLD
        self._anchor: Vec3 | None = None
        self._yaw = 0.0
        self._v: Vec3 = (0.0, 0.0, 0.0)
        self._ramp_s = 0.0
        self._takeoff_d = 0.0
        self._return_d = 0.0
        self._return_stage = 0

    def enter(self, mode: Mode, p: Vec3, v: Vec3, yaw: float, anchor: Vec3 | None = None) -> None:
        """Begin a mode at the present position and velocity; `anchor`: a point to hold, so that nothing moves."""
        self._mode = mode
        self._yaw = yaw
        self._anchor = anchor
        self._v = v
        self._ramp_s = 0.0
        self.descending = False
        self.takeoff_done = False
        self._return_stage = 0
        climb = self._parameters.number("RTL_RETURN_ALT")
        near = math.hypot(p[0] - self.home[0], p[1] - self.home[1]) < _RETURN_NEAR_M
        self._return_d = p[2] if near else min(p[2], self.home[2] - climb)
        if mode is Mode.TAKEOFF:
            self._begin_takeoff(p)

    def _begin_takeoff(self, p: Vec3) -> None:
        """Fix the height of a takeoff; one that would lead down ends where it is."""
        if self.takeoff_height_m is None:
            down = p[2] - self._parameters.number("MIS_TAKEOFF_ALT")
        else:
            # PX4 raises a height that is less than MIS_TAKEOFF_ALT above home.
            down = self.home[2] - max(self.takeoff_height_m, self._parameters.number("MIS_TAKEOFF_ALT"))
        self._takeoff_d = min(down, p[2])
        self._anchor = (p[0], p[1], self._takeoff_d)
        self._v = (0.0, 0.0, 0.0)

    def wants_to_fly(self) -> bool:
        """Tell whether the mode lifts a vehicle that stands on the ground."""
        return self._mode is Mode.TAKEOFF

    def setpoint(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Give the setpoint for the position controller; dt_s is the time since the last call."""
        if self._mode is Mode.TAKEOFF:
            return self._takeoff(p, v, dt_s)
        if self._mode is Mode.LAND:
            return self._land(p, v, dt_s, self._parameters.number("MPC_LAND_SPEED"))
        if self._mode is Mode.RETURN:
            return self._return(p, v, dt_s)
        if self._mode is Mode.ALTITUDE:
            return self._altitude(p, v, dt_s)
        return self._hold(p, v, dt_s)

    def _hold(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Stop, then stay where that was."""
        if self._anchor is None:
            self._slew((0.0, 0.0, 0.0), dt_s)
            if max(math.hypot(*v), math.hypot(*self._v)) > _STOPPED_M_S:
                return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)
            self._anchor = p
        return PositionSetpoint(self._anchor, _NOTHING, _NOTHING, self._yaw, 0.0)

    def _altitude(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Level, and stay at this height; nobody holds the position."""
        if self._anchor is None:
            self._slew((v[0], v[1], 0.0), dt_s)
            if max(abs(v[2]), abs(self._v[2])) > _STOPPED_M_S:
                vertical = (math.nan, math.nan, self._v[2])
                return PositionSetpoint(_NOTHING, vertical, (0.0, 0.0, math.nan), self._yaw, 0.0)
            self._anchor = p
        height = (math.nan, math.nan, self._anchor[2])
        return PositionSetpoint(height, _NOTHING, (0.0, 0.0, math.nan), self._yaw, 0.0)

    def _takeoff(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Climb straight up: a ramp of the speed, then a slower approach to the height."""
        assert self._anchor is not None
        self._ramp_s += dt_s
        ramp = min(1.0, self._ramp_s / max(self._parameters.number("MPC_TKO_RAMP_T"), 1e-3))
        remaining = p[2] - self._takeoff_d
        if remaining < _NEAR_M and abs(v[2]) < _STOPPED_M_S:
            self.takeoff_done = True
            return PositionSetpoint(self._anchor, _NOTHING, _NOTHING, self._yaw, 0.0)
        speed = min(self._parameters.number("MPC_TKO_SPEED") * ramp, self._parameters.number("MPC_Z_P") * remaining)
        horizontal = (self._anchor[0], self._anchor[1], math.nan)
        return PositionSetpoint(horizontal, (math.nan, math.nan, -speed), _NOTHING, self._yaw, 0.0)

    @property
    def takeoff_point(self) -> Vec3 | None:
        """Where Hold goes on after a takeoff."""
        return self._anchor if self._mode is Mode.TAKEOFF else None

    def _land(self, p: Vec3, v: Vec3, dt_s: float, speed_m_s: float) -> PositionSetpoint:
        """Stop over the ground, and go down at a constant speed."""
        self.descending = True
        self._slew((0.0, 0.0, speed_m_s), dt_s)
        if self._anchor is None:
            if max(math.hypot(v[0], v[1]), math.hypot(self._v[0], self._v[1])) > _STOPPED_M_S:
                return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)
            self._anchor = p
        horizontal = (self._anchor[0], self._anchor[1], math.nan)
        return PositionSetpoint(horizontal, (math.nan, math.nan, self._v[2]), _NOTHING, self._yaw, 0.0)

    def _return(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Climb to the return height, fly home at it, go down and land."""
        to_home = math.hypot(self.home[0] - p[0], self.home[1] - p[1])
        if self._return_stage == 0 and p[2] - self._return_d < _NEAR_M:
            self._return_stage = 1
        if self._return_stage == 1 and to_home < _NEAR_M and math.hypot(v[0], v[1]) < _STOPPED_M_S:
            self._return_stage = 2
            self._anchor = (self.home[0], self.home[1], p[2])
        if self._return_stage == 0:
            self._approach((p[0], p[1], self._return_d), p, dt_s)
        elif self._return_stage == 1:
            self._approach((self.home[0], self.home[1], self._return_d), p, dt_s)
        else:
            high = self.home[2] - p[2] > self._parameters.number("RTL_DESCEND_ALT")
            speed = self._parameters.number("MPC_Z_VEL_MAX_DN" if high else "MPC_LAND_SPEED")
            return self._land(p, v, dt_s, speed)
        return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)

    def _approach(self, target: Vec3, p: Vec3, dt_s: float) -> None:
        """Turn the velocity setpoint towards a point, slower when near it."""
        north, east, down = target[0] - p[0], target[1] - p[1], target[2] - p[2]
        distance = math.hypot(north, east)
        cruise = min(self._parameters.number("MPC_XY_CRUISE"), self._parameters.number("MPC_XY_P") * distance)
        share = cruise / distance if distance > 0.0 else 0.0
        vertical = self._parameters.number("MPC_Z_P") * down
        vertical = max(vertical, -self._parameters.number("MPC_Z_VEL_MAX_UP"))
        vertical = min(vertical, self._parameters.number("MPC_Z_VEL_MAX_DN"))
        self._slew((share * north, share * east, vertical), dt_s)

    def _slew(self, wanted: Vec3, dt_s: float) -> None:
        """Move the velocity setpoint towards `wanted` within the acceleration limits."""
        north, east = wanted[0] - self._v[0], wanted[1] - self._v[1]
        change = math.hypot(north, east)
        limit = self._parameters.number("MPC_ACC_HOR") * dt_s
        share = 1.0 if change <= limit else limit / change
        up = self._parameters.number("MPC_ACC_UP_MAX") * dt_s
        down = self._parameters.number("MPC_ACC_DOWN_MAX") * dt_s
        vertical = min(max(wanted[2] - self._v[2], -up), down)
        self._v = (self._v[0] + share * north, self._v[1] + share * east, self._v[2] + vertical)
