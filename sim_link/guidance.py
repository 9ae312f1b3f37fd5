"""Where the vehicle flies when it holds its own position: Hold, Takeoff, Mission, Land, Return, Position, Altitude.

Gives position and velocity setpoints to the position controller; velocities follow a limited acceleration, as PX4's do.
Stopping is flown along a way that begins at the present position and speed and ends at rest, so that wind which the
controller has not learned yet does not carry the vehicle off (PX4: PositionSmoothing, started by FlightTaskAuto).
"""

from __future__ import annotations

import math

from .manual_control import Sticks
from .mission_flight import Kind, MissionFlight
from .missions import Plans
from .modes import Mode
from .parameters import Parameters
from .position_loop import PositionSetpoint
from .rotation import Vec3
from .stick_flight import CENTRED, acceleration, descent, turn_rate, velocity

_NOTHING = (math.nan, math.nan, math.nan)
_STOPPED_M_S = 0.3
_NEAR_M = 0.3
_TURN_FROM_M = 2.0
"""Further away than this a mission turns the nose to where it flies."""
_SLIP_LEAST_M = 0.001
_NUMBER_MAX = 1.0e6
_BLIND_DESCENT_M_S2 = 0.3
"""Downwards, when there is no estimate to descend by (FlightTaskDescend.cpp)."""
_RETURN_NEAR_M = 10.0
"""Closer to home than this, Return neither climbs nor cruises (PX4: RTL_MIN_DIST)."""


class Guidance:
    """The flight tasks. Positions are NED [m] as the estimator gives them, heights are above home."""

    def __init__(self, parameters: Parameters, home: Vec3, plans: Plans | None = None) -> None:
        self._parameters = parameters
        self._plans = Plans() if plans is None else plans
        self.home = home
        self.mission = MissionFlight(parameters, self._plans)
        self.sticks: Sticks | None = None
        """For Position and Altitude; None: nobody has any."""
        self.landed = False
        """What the land detector says."""
        self.speed_m_s: float | None = None
        """Cruise speed asked for by a command; None: MPC_XY_CRUISE."""
        self.takeoff_height_m: float | None = None
        """Height above home that a takeoff command asked for; None: MIS_TAKEOFF_ALT above where it starts."""
        self.takeoff_done = False
        self.descending = False
        """Whether the vehicle is told to go down: the land detector asks."""
        self._mode = Mode.HOLD
        self._anchor: Vec3 | None = None
        self._yaw = 0.0
        self._v: Vec3 = (0.0, 0.0, 0.0)
        self._way: Vec3 | None = None
        """Where the vehicle should be while it stops; None: it does not."""
        self._ramp_s = 0.0
        self._takeoff_d = 0.0
        self._return_d = 0.0
        self._return_to = home
        self._return_stage = 0
        self._target: Vec3 | None = None
        self._target_yaw = math.nan
        self._height: float | None = None
        self._here = home
        self._slip: Vec3 = (0.0, 0.0, 0.0)
        """How far a point that is held is off where it should be: what is left of the estimate's jumps."""
        self._slip_m_s = 0.0

    def enter(self, mode: Mode, p: Vec3, v: Vec3, yaw: float, anchor: Vec3 | None = None) -> None:
        """Begin a mode at the present position and velocity; `anchor`: a point to hold, so that nothing moves."""
        self._mode = mode
        self._yaw = yaw
        self._anchor = anchor
        self._v = v
        self._way = None
        self._ramp_s = 0.0
        self.descending = False
        self.takeoff_done = False
        self._target = None
        self._height = None
        self.speed_m_s = None
        self._return_stage = 0
        self._slip, self._slip_m_s = (0.0, 0.0, 0.0), 0.0
        climb = self._number("RTL_RETURN_ALT")
        self._return_to = self._nearest_return(p)
        near = math.hypot(p[0] - self._return_to[0], p[1] - self._return_to[1]) < _RETURN_NEAR_M
        self._return_d = p[2] if near else min(p[2], self.home[2] - climb)
        if mode is Mode.MISSION:
            self.mission.enter()
        else:
            self.mission.leave()
        if mode is Mode.TAKEOFF:
            self._begin_takeoff(p)

    def go_to(self, target: Vec3, yaw: float, speed_m_s: float | None) -> None:
        """Fly to a position NED [m] and hold there (DO_REPOSITION); yaw [rad], NaN: as it is.

        Only Hold does so: whoever calls this has changed to it.
        """
        self._target, self._target_yaw = target, yaw
        self._anchor = None
        if speed_m_s is not None:
            self.speed_m_s = speed_m_s

    def _nearest_return(self, p: Vec3) -> Vec3:
        """Give where Return lands: home, or a rally point that is nearer."""
        places = [self.home] + [point.position(self.home) for point in self._plans.rally_points]
        return min(places, key=lambda place: math.hypot(place[0] - p[0], place[1] - p[1]))

    def _begin_takeoff(self, p: Vec3) -> None:
        """Fix the height of a takeoff; one that would lead down ends where it is."""
        if self.takeoff_height_m is None:
            down = p[2] - self._number("MIS_TAKEOFF_ALT")
        else:
            # PX4 raises a height that is less than MIS_TAKEOFF_ALT above home.
            down = self.home[2] - max(self.takeoff_height_m, self._number("MIS_TAKEOFF_ALT"))
        self._takeoff_d = min(down, p[2])
        self._anchor = (p[0], p[1], self._takeoff_d)
        self._v = (0.0, 0.0, 0.0)

    def wants_to_fly(self) -> bool:
        """Tell whether the mode lifts a vehicle that stands on the ground."""
        if self._mode is Mode.MISSION:
            return self._mission_leg is Kind.CLIMB or self._mission_leg is Kind.FLY
        if self._mode in (Mode.POSITION, Mode.ALTITUDE):
            return descent(self.sticks or CENTRED, self._parameters) < 0.0
        return self._mode is Mode.TAKEOFF

    def shift(self, dp_m: Vec3, dv_m_s: Vec3, dyaw_rad: float) -> None:
        """Take note that the estimate has jumped.

        Heading and velocity setpoints move along, and so do points that are held with the sticks. Where the vehicle
        flies itself the points are places on the Earth: it goes smoothly to where it now believes them to be.
        """
        self._yaw += dyaw_rad
        self._v = _sum(self._v, dv_m_s)
        if self._mode in (Mode.POSITION, Mode.ALTITUDE):
            if self._anchor is not None:
                self._anchor = _sum(self._anchor, dp_m)
            if self._height is not None:
                self._height += dp_m[2]
        else:
            self._slip = _sum(self._slip, dp_m)

    def setpoint(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Give the setpoint for the position controller; dt_s is the time since the last call."""
        target = self._task(p, v, dt_s)
        if self._slip == (0.0, 0.0, 0.0):
            return target
        if all(map(math.isnan, target.p)):
            self._slip, self._slip_m_s = (0.0, 0.0, 0.0), 0.0  # no point is held that could be off
            return target
        self._slide(dt_s)
        return target._replace(p=_sum(target.p, self._slip))

    def _slide(self, dt_s: float) -> None:
        """Let the slip go: from rest to rest, within MPC_ACC_HOR and MPC_XY_CRUISE."""
        length = math.hypot(*self._slip)
        limit = self._parameters.within("MPC_ACC_HOR", 0.1, 1000.0)
        fastest = min(self._parameters.within("MPC_XY_CRUISE", 0.1, 1000.0), math.sqrt(2.0 * limit * length))
        self._slip_m_s = min(self._slip_m_s + limit * dt_s, fastest)
        share = 1.0 - self._slip_m_s * dt_s / length if length > _SLIP_LEAST_M else 0.0
        if share <= 0.0:
            self._slip, self._slip_m_s = (0.0, 0.0, 0.0), 0.0
        else:
            self._slip = (share * self._slip[0], share * self._slip[1], share * self._slip[2])

    def _task(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Give the setpoint of the mode in charge."""
        if self._mode is Mode.TAKEOFF:
            return self._takeoff(p, v, dt_s)
        if self._mode is Mode.MISSION:
            return self._fly_mission(p, v, dt_s)
        if self._mode is Mode.POSITION:
            return self._position(p, v, dt_s)
        if self._mode is Mode.LAND:
            return self._land(p, v, dt_s, self._number("MPC_LAND_SPEED"))
        if self._mode is Mode.RETURN:
            return self._return(p, v, dt_s)
        if self._mode is Mode.ALTITUDE:
            return self._altitude(p, v, dt_s)
        if self._mode is Mode.DESCEND:
            # Nobody knows position, height and speed: level, with a little less thrust than would hover.
            self.descending = True
            return PositionSetpoint(_NOTHING, _NOTHING, (0.0, 0.0, _BLIND_DESCENT_M_S2), self._yaw, 0.0)
        return self._hold(p, v, dt_s)

    def _hold(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Stop, then stay where the way to it ends; or fly to where it was told to, and stay there."""
        self._turn(self._target_yaw if self._target is not None else math.nan, dt_s)
        if self._target is not None and self._anchor is None:
            self._approach(self._target, p, dt_s)
            if math.dist(p, self._target) < _NEAR_M and math.hypot(*v) < _STOPPED_M_S:
                self._anchor = self._target
            return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)
        if self._anchor is None:
            self._slew((0.0, 0.0, 0.0), dt_s)
            way = self._go_on(p, dt_s)
            if self._v != (0.0, 0.0, 0.0):
                return PositionSetpoint(way, self._v, _NOTHING, self._yaw, 0.0)
            self._anchor = way
        return PositionSetpoint(self._anchor, _NOTHING, _NOTHING, self._yaw, 0.0)

    def _go_on(self, p: Vec3, dt_s: float) -> Vec3:
        """Move the way's point on by the velocity setpoint; it begins at p."""
        n, e, d = p if self._way is None else self._way
        self._way = (n + self._v[0] * dt_s, e + self._v[1] * dt_s, d + self._v[2] * dt_s)
        return self._way

    def _position(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Fly as fast as the sticks say; with centred ones stop, then stay where that was."""
        sticks = self.sticks or CENTRED
        rate = turn_rate(sticks, self._parameters)
        self._yaw += rate * dt_s
        north, east = velocity(sticks, self._yaw, self._parameters)
        down = descent(sticks, self._parameters)
        self.descending = down > 0.0
        if north or east or down or self._anchor is None:
            self._anchor = None
            self._slew((north, east, down), dt_s)
            # PX4 holds as soon as no speed is asked for any more, and a height when the climb is over.
            if north or east or down or self._v != (0.0, 0.0, 0.0) or abs(v[2]) > _STOPPED_M_S:
                return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, rate)
            self._anchor = p
        return PositionSetpoint(self._anchor, _NOTHING, _NOTHING, self._yaw, rate)

    def _altitude(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Tilt and climb as the sticks say; with the throttle centred stay at this height. Nobody holds position."""
        sticks = self.sticks or CENTRED
        rate = turn_rate(sticks, self._parameters)
        self._yaw += rate * dt_s
        north, east = acceleration(sticks, self._yaw, self._parameters)
        down = descent(sticks, self._parameters)
        self.descending = down > 0.0
        if down or self._height is None:
            self._height = None
            self._slew((v[0], v[1], down), dt_s)
            if down or max(abs(v[2]), abs(self._v[2])) > _STOPPED_M_S:
                vertical = (math.nan, math.nan, self._v[2])
                return PositionSetpoint(_NOTHING, vertical, (north, east, math.nan), self._yaw, rate)
            self._height = p[2]
        height = (math.nan, math.nan, self._height)
        return PositionSetpoint(height, _NOTHING, (north, east, math.nan), self._yaw, rate)

    @property
    def _mission_leg(self) -> Kind:
        """What the mission is at."""
        return self.mission.leg(self._here, self.home, self.landed).kind

    def _fly_mission(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Fly the mission's present leg."""
        leg = self.mission.leg(p, self.home, self.landed)
        if leg.kind in (Kind.NOTHING, Kind.RETURN):
            return self._hold(p, v, dt_s)
        if leg.kind is Kind.CLIMB:
            self._takeoff_d = leg.target[2]
            self._anchor = leg.target
            return self._takeoff(p, v, dt_s)
        away = math.hypot(leg.target[0] - p[0], leg.target[1] - p[1])
        if leg.kind is Kind.LAND:
            if away < _NEAR_M or self.descending:
                self._anchor = (leg.target[0], leg.target[1], p[2])
                return self._land(p, v, dt_s, self._landing_speed(p))
            self._anchor = None
            self._approach((leg.target[0], leg.target[1], p[2]), p, dt_s)
            return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)
        self.descending = False
        self._anchor = None
        course = math.atan2(leg.target[1] - p[1], leg.target[0] - p[0]) if away > _TURN_FROM_M else math.nan
        self._turn(course if math.isnan(leg.yaw) else leg.yaw, dt_s)
        self._approach(leg.target, p, dt_s)
        return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)

    @property
    def wants_return(self) -> bool:
        """Whether the mission goes on with Return."""
        return self._mode is Mode.MISSION and self._mission_leg is Kind.RETURN

    def observe(self, p: Vec3, landed: bool, sticks: Sticks | None, dt_s: float) -> None:
        """Take note of where the vehicle is, whether it stands, and of the sticks; dt_s: since the last time."""
        self._here, self.landed, self.sticks = p, landed, sticks
        if self._mode is Mode.MISSION:
            self.mission.update(p, landed, dt_s)

    def _landing_speed(self, p: Vec3) -> float:
        """Give the speed of a descent to home's height: fast while high."""
        high = self.home[2] - p[2] > self._number("RTL_DESCEND_ALT")
        return self._number("MPC_Z_VEL_MAX_DN" if high else "MPC_LAND_SPEED")

    def _turn(self, yaw: float, dt_s: float) -> None:
        """Turn the heading towards `yaw` [rad]; NaN, or what is no direction: it stays."""
        if not math.isfinite(yaw):
            return
        error = math.remainder(yaw - self._yaw, 2.0 * math.pi)
        most = math.radians(self._parameters.within("MPC_YAWRAUTO_MAX", 0.0, 360.0)) * dt_s
        self._yaw += min(max(error, -most), most)

    def _takeoff(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Climb straight up: a ramp of the speed, then a slower approach to the height."""
        assert self._anchor is not None
        self._ramp_s += dt_s
        ramp = min(1.0, self._ramp_s / max(self._number("MPC_TKO_RAMP_T"), 1e-3))
        remaining = p[2] - self._takeoff_d
        if remaining < _NEAR_M and abs(v[2]) < _STOPPED_M_S:
            self.takeoff_done = True
            return PositionSetpoint(self._anchor, _NOTHING, _NOTHING, self._yaw, 0.0)
        speed = min(self._number("MPC_TKO_SPEED") * ramp, self._number("MPC_Z_P") * remaining)
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
            way = self._go_on(p, dt_s)
            if self._v[:2] != (0.0, 0.0):
                return PositionSetpoint((way[0], way[1], math.nan), self._v, _NOTHING, self._yaw, 0.0)
            self._anchor = way
        horizontal = (self._anchor[0], self._anchor[1], math.nan)
        return PositionSetpoint(horizontal, (math.nan, math.nan, self._v[2]), _NOTHING, self._yaw, 0.0)

    def _return(self, p: Vec3, v: Vec3, dt_s: float) -> PositionSetpoint:
        """Climb to the return height, fly home at it, go down and land."""
        goal = self._return_to
        to_home = math.hypot(goal[0] - p[0], goal[1] - p[1])
        if self._return_stage == 0 and p[2] - self._return_d < _NEAR_M:
            self._return_stage = 1
        if self._return_stage == 1 and to_home < _NEAR_M and math.hypot(v[0], v[1]) < _STOPPED_M_S:
            self._return_stage = 2
            self._anchor = (goal[0], goal[1], p[2])
        if self._return_stage == 0:
            self._approach((p[0], p[1], self._return_d), p, dt_s)
        elif self._return_stage == 1:
            self._approach((goal[0], goal[1], self._return_d), p, dt_s)
        else:
            return self._land(p, v, dt_s, self._landing_speed(p))
        return PositionSetpoint(_NOTHING, self._v, _NOTHING, self._yaw, 0.0)

    def _approach(self, target: Vec3, p: Vec3, dt_s: float) -> None:
        """Turn the velocity setpoint towards a point, slower when near it."""
        self._way = None
        north, east, down = target[0] - p[0], target[1] - p[1], target[2] - p[2]
        distance = math.hypot(north, east)
        asked = self.mission.speed_m_s if self._mode is Mode.MISSION else None
        asked = asked or self.speed_m_s or self._number("MPC_XY_CRUISE")
        cruise = min(asked, self._number("MPC_XY_VEL_MAX"), self._number("MPC_XY_P") * distance)
        share = cruise / distance if distance > 0.0 else 0.0
        vertical = self._number("MPC_Z_P") * down
        vertical = max(vertical, -self._number("MPC_Z_VEL_MAX_UP"))
        vertical = min(vertical, self._number("MPC_Z_VEL_MAX_DN"))
        self._slew((share * north, share * east, vertical), dt_s)

    def _number(self, name: str) -> float:
        """Give a parameter as a length, speed or gain that can be reckoned with, whatever somebody has set it to."""
        return self._parameters.within(name, 0.0, _NUMBER_MAX)

    def _slew(self, wanted: Vec3, dt_s: float) -> None:
        """Move the velocity setpoint towards `wanted` within the acceleration limits."""
        north, east = wanted[0] - self._v[0], wanted[1] - self._v[1]
        change = math.hypot(north, east)
        limit = self._parameters.within("MPC_ACC_HOR", 0.1, 1000.0) * dt_s
        share = 1.0 if change <= limit else limit / change
        up = self._parameters.within("MPC_ACC_UP_MAX", 0.1, 1000.0) * dt_s
        down = self._parameters.within("MPC_ACC_DOWN_MAX", 0.1, 1000.0) * dt_s
        vertical = min(max(wanted[2] - self._v[2], -up), down)
        self._v = (self._v[0] + share * north, self._v[1] + share * east, self._v[2] + vertical)


def _sum(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
