"""What the inner loops get in each mode: from a companion, from the sticks, or from where the vehicle flies itself."""

from __future__ import annotations

import math

from .guidance import Guidance
from .hover_thrust import HoverThrust
from .inner_loops import STOPPED_SETPOINT, Setpoint
from .land_detector import LandDetector
from .manual_control import ManualInput
from .modes import Mode
from .offboard import TRAJECTORY, Offboard, Order
from .parameters import Parameters
from .physics import RigidState
from .position_loop import PositionSetpoint
from .rotation import Vec3
from .steering import IDLE, Steering
from .stick_flight import CENTRED, AttitudeSticks

_RATE_OR_LEVEL = (Mode.STABILIZED, Mode.MANUAL, Mode.ACRO)
_VERTICAL_INTENT_M_S = 0.05
"""Vertical speed that a trajectory must ask for to mean a takeoff or a landing."""


class Orders:
    """Chooses among the sources, and keeps the rotors idling on the ground until somebody wants to fly."""

    def __init__(
        self,
        parameters: Parameters,
        offboard: Offboard,
        guidance: Guidance,
        land: LandDetector,
        sticks: ManualInput,
        hover: HoverThrust,
    ) -> None:
        self._parameters = parameters
        self._offboard = offboard
        self._guidance = guidance
        self._land = land
        self._sticks = sticks
        self._steering = Steering(parameters, hover)
        self._attitude_sticks = AttitudeSticks(parameters)
        self.rests = True
        """Whether neither of these two has anything to forget."""

    @property
    def target(self) -> PositionSetpoint | None:
        """What the position controller flies, or flew last; None: nothing yet."""
        return self._steering.target

    def shift(self, dv_m_s: Vec3, dyaw_rad: float) -> None:
        """Take note that the estimate of velocity and heading has jumped."""
        self._steering.shift(dv_m_s)
        self._attitude_sticks.turn(dyaw_rad)

    def needs_estimate(self, mode: Mode) -> bool:
        """Tell whether the position controller flies."""
        return self._offboard.follows_trajectory if mode is Mode.OFFBOARD else mode.needs_estimate

    def nothing(self) -> Order:
        """Stop the rotors."""
        self._rest()
        return Order(STOPPED_SETPOINT, False)

    def controls_climb(self, mode: Mode) -> bool:
        """Tell whether the autopilot controls the climb rate itself."""
        if mode is Mode.OFFBOARD:
            return self._offboard.follows_trajectory
        return mode not in _RATE_OR_LEVEL

    def descends(self, mode: Mode, now_us: int, p: Vec3) -> bool:
        """Tell whether the autopilot is told to go down, where it controls the climb rate."""
        if mode is Mode.OFFBOARD:
            return self._trajectory_goes(now_us, p) > _VERTICAL_INTENT_M_S
        return self._guidance.descending

    def give(self, mode: Mode, now_us: int, rigid: RigidState, dt_s: float, held: Setpoint, spooled_up: bool) -> Order:
        """Give the order for the next dt_s.

        Args:
            mode: what is flown.
            now_us: vehicle time.
            rigid: state now.
            dt_s: time until the next order [s].
            held: what the loops follow already.
            spooled_up: the rotors have turned for COM_SPOOLUP_TIME.
        """
        if mode is Mode.OFFBOARD:
            offboard = self._offboard
            if now_us >= offboard.look_us:
                offboard.choose(now_us)
            if offboard.follows == TRAJECTORY:
                return self._trajectory(now_us, rigid, dt_s, held, spooled_up)
            order = offboard.order(held)
        elif mode in _RATE_OR_LEVEL:
            return self._stick_order(mode, now_us, rigid, dt_s)
        elif self._stays_on_ground(spooled_up):
            order = Order(IDLE, False)
        else:
            self.rests = False
            self._attitude_sticks.rest()
            return Order(self._steering.guided(self._guidance, rigid, dt_s), True)
        if not self.rests:
            self._rest()
        return order

    def _rest(self) -> None:
        """Let controllers that are not in charge forget."""
        self.rests = True
        self._steering.rest()
        self._attitude_sticks.rest()

    def _stick_order(self, mode: Mode, now_us: int, rigid: RigidState, dt_s: float) -> Order:
        """Give what the sticks fly without the position controller; on the ground with the throttle up only."""
        self.rests = False
        self._steering.rest()
        sticks = self._sticks.now(now_us) or CENTRED
        if self._land.landed and sticks.throttle <= 0.0:
            self._attitude_sticks.rest()
            return Order(IDLE, True)
        return Order(self._attitude_sticks.setpoint(mode, sticks, rigid.q, dt_s), True)

    def _trajectory(self, now_us: int, rigid: RigidState, dt_s: float, held: Setpoint, spooled_up: bool) -> Order:
        """Give what a companion's position, velocity or acceleration flies."""
        self.rests = False
        self._attitude_sticks.rest()
        target = self._offboard.trajectory(now_us)
        landed = self._land.landed
        lifts = self._trajectory_goes(now_us, rigid.p) < -_VERTICAL_INTENT_M_S
        if target is None or (landed and not (lifts and spooled_up)):
            self._steering.rest()
            return Order(IDLE if landed else held, False)
        if landed:
            self._steering.begin_takeoff()
            self._land.lift()
        return Order(self._steering.setpoint(target, rigid, dt_s), True)

    def _trajectory_goes(self, now_us: int, p: Vec3) -> float:
        """Give the vertical speed that a companion's trajectory means [m/s], positive down; only its sign counts."""
        target = self._offboard.trajectory(now_us)
        if target is None:
            return 0.0
        if math.isnan(target.p[2]) and math.isnan(target.v[2]):
            return 0.0 if math.isnan(target.a[2]) else target.a[2]
        speed = 0.0 if math.isnan(target.v[2]) else target.v[2]
        if not math.isnan(target.p[2]):
            speed += self._parameters.number("MPC_Z_P") * (target.p[2] - p[2])
        return speed

    def _stays_on_ground(self, spooled_up: bool) -> bool:
        """Tell whether a mode that steers itself keeps the rotors idling."""
        if self._guidance.wants_to_fly():
            return not spooled_up
        return self._land.landed or (self._guidance.descending and self._land.ground_contact)
