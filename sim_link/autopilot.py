"""The autopilot above the inner loops: modes, arming, offboard control, failsafes, automatic disarming.

A state machine with injected time: it reads no clock and owns no socket. Requests come in as methods that answer with a
MAV_RESULT, `update` advances it and gives what the inner loops shall follow.
"""

from __future__ import annotations

import math
from enum import IntEnum

from .arming import arming_obstacle
from .codec import ActuatorControls, AttitudeTarget
from .failsafe import Action, Cause, Decision, Health, decide, without_estimate
from .geofence import Geofence
from .guidance import Guidance
from .hover_thrust import HoverThrust
from .inner_loops import ATTITUDE, STOPPED_SETPOINT, Setpoint
from .land_detector import LandDetector, Motion
from .manual_control import ManualInput
from .missions import Plans
from .modes import Mode
from .offboard import TRAJECTORY, Offboard, Order, PositionTarget
from .orders import Orders
from .parameters import Parameters
from .physics import RigidState
from .position_loop import PositionSetpoint
from .rotation import Vec3, body_z, from_yaw, multiply, yaw_of
from .watch import DisarmTimer, TiltWatch

HEALTH_PERIOD_US = 100_000
WATCH_PERIOD_US = 20_000
FENCE_PERIOD_US = 200_000
ESTIMATE_TIMEOUT_S = 1.0
"""An estimate older than this is none."""
EARLY_FLIGHT_S = 3.0
"""After the spool-up: so long a tilt failure disarms."""
TILT_BREAKER = 121212
_LONG_AGO_US = 60_000_000

EMERGENCY, CRITICAL, WARNING, NOTICE, INFO = 0, 2, 4, 5, 6
"""MAV_SEVERITY"""


class Result(IntEnum):
    """MAV_RESULT"""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


class Autopilot:
    """One vehicle's autopilot. Positions are NED [m], times vehicle time [us]."""

    def __init__(
        self,
        parameters: Parameters,
        *,
        px4: str,
        system: int,
        rigid: RigidState,
        in_air: bool,
        now_us: int,
        home: Vec3,
        setpoint_delay_us: int = 0,
        plans: Plans | None = None,
    ) -> None:
        self.parameters = parameters
        self.px4 = px4
        self.system = system
        self.plans = Plans() if plans is None else plans
        """Missions, geofence, rally points: they are kept through a reboot."""
        self.sticks = ManualInput(parameters)
        self.fence = Geofence(parameters, self.plans)
        self.battery_charge = 1
        """MAV_BATTERY_CHARGE_STATE, as whoever watches the battery reports it."""
        self.offboard = Offboard(parameters, px4, system, setpoint_delay_us)
        self.guidance = Guidance(parameters, home, self.plans)
        self.land = LandDetector(parameters, landed=not in_air)
        self._hover = HoverThrust(parameters, home[2] if in_air else rigid.p[2])
        self.armed = in_air
        self.mode = Mode.HOLD
        """What is flown (nav_state)."""
        self.intended = Mode.HOLD
        """What was asked for; differs from `mode` during a failsafe."""
        self.failsafe: Decision | None = None
        self.terminated = False
        self.texts: list[tuple[int, str]] = []
        """STATUSTEXTs to send: severity, sentence. Whoever sends them empties the list."""
        self.held = STOPPED_SETPOINT
        """What the inner loops follow."""
        self.attitude_setpoint: Setpoint | None = None
        """The last attitude setpoint of any source, which ATTITUDE_TARGET goes on reporting."""
        self._rigid = rigid
        self._now_us = now_us
        self._look_us = self._health_us = self._watch_us = now_us
        """When something is due next, and what it is (see `_look`)."""
        self._armed_us = now_us - _LONG_AGO_US
        self._spool_up_s = 0.0
        self._parameters_version = -1
        self._took_off = in_air
        self.offboard_ok = False
        """Whether a companion's setpoints come, as it was at the last check."""
        self._ground_us: int | None = None
        self._blind_us: int | None = None
        """Since when there is no estimate."""
        self._sticks_at_arming = False
        self._lost_us: dict[Cause, int] = {}
        self._disarm_timer = DisarmTimer(parameters)
        self._tilt = TiltWatch(parameters)
        self._orders = Orders(parameters, self.offboard, self.guidance, self.land, self.sticks, self._hover)
        self._fence_us = now_us
        self._breach: str | None = None
        self._fence_overruled = False
        self._home_is_set = False
        self.guidance.enter(Mode.HOLD, rigid.p, rigid.v, yaw_of(rigid.q), rigid.p)

    # Requests

    def set_mode(self, mode: Mode) -> Result:
        """Ask for a mode. While disarmed any can be chosen, in flight only one that can run."""
        if self.terminated or mode is Mode.TERMINATION or (self.armed and not self._can_run(mode)):
            self._say(CRITICAL, f"Switching to mode '{mode.label}' is currently not possible")
            return Result.TEMPORARILY_REJECTED
        self._fence_overruled = self._breach is not None
        if mode is not self.intended:
            self.intended = mode
            if mode is not Mode.TAKEOFF:
                self.guidance.takeoff_height_m = None
        self._evaluate()
        return Result.ACCEPTED

    def takeoff(self, height_m: float | None) -> Result:
        """Ask for Takeoff to a height above home [m], None: MIS_TAKEOFF_ALT above here. Does not arm."""
        self.guidance.takeoff_height_m = height_m
        return self.set_mode(Mode.TAKEOFF)

    def arm(self) -> Result:
        """Arm, if the mode in charge allows it and what it needs is there."""
        if self.armed:
            return Result.ACCEPTED
        reason = arming_obstacle(self)
        if reason is not None:
            self._say(CRITICAL, f"Arming denied: {reason}")
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self._armed_us = self._now_us
        self._took_off = False
        self._sticks_at_arming = self.sticks_ok
        if not self._home_is_set:
            self.guidance.home = self._rigid.p
        self.guidance.enter(self.mode, self._rigid.p, self._rigid.v, yaw_of(self._rigid.q))
        self.offboard.evaluate(self._now_us)
        self._say(INFO, "Armed by external command")
        return Result.ACCEPTED

    def disarm(self, *, force: bool) -> Result:
        """Disarm; in the air only by force."""
        if self.armed and not force and not self.land.landed:
            self._say(CRITICAL, "Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        self._disarm("Disarmed by external command")
        return Result.ACCEPTED

    def terminate(self) -> Result:
        """Stop the rotors for good (flight termination)."""
        self._terminate("Flight termination commanded")
        return Result.ACCEPTED

    def start_mission(self, first: int) -> Result:
        """Fly the mission from an item on, arming if need be (MISSION_START); -1: from the current one."""
        if not self.guidance.mission.can_run:
            self._say(CRITICAL, "Mission start denied! No valid mission")
            return Result.DENIED
        if first >= 0 and not self.guidance.mission.select(first):
            return Result.UNSUPPORTED
        result = self.set_mode(Mode.MISSION)
        return self.arm() if result is Result.ACCEPTED else result

    def go_to(self, target: Vec3, yaw: float, speed_m_s: float | None) -> Result:
        """Fly to a position NED [m] and hold there; NaN: as it is now (DO_REPOSITION)."""
        result = self.set_mode(Mode.HOLD)
        if result is Result.ACCEPTED:
            here = self._rigid.p
            n, e, d = (there if math.isfinite(there) else now for there, now in zip(target, here, strict=True))
            self.guidance.go_to((n, e, d), yaw, speed_m_s)
        return result

    def set_home(self, home: Vec3 | None) -> Result:
        """Put home somewhere, NED [m]; None: here. It then stays there when the vehicle is armed."""
        self.guidance.home = self._rigid.p if home is None else home
        self._home_is_set = True
        return Result.ACCEPTED

    def check_arming(self) -> Result:
        """Say what stands in the way of arming (RUN_PREARM_CHECKS)."""
        if self.armed:
            return Result.TEMPORARILY_REJECTED
        reason = arming_obstacle(self)
        if reason is not None:
            self._say(CRITICAL, f"Preflight Fail: {reason}")
        return Result.ACCEPTED

    def attitude_target(self, message: AttitudeTarget) -> bool:
        """Take a SET_ATTITUDE_TARGET; returns whether it was accepted."""
        taken = self.offboard.take_attitude_target(message, self._now_us, self.mode is Mode.OFFBOARD)
        if taken and not self.offboard_ok:
            self._check()
        return taken

    def actuator_controls(self, message: ActuatorControls) -> bool:
        """Take a SET_ACTUATOR_CONTROL_TARGET; returns whether it was accepted."""
        taken = self.offboard.take_actuator_controls(message, self._now_us, self.mode is Mode.OFFBOARD)
        if taken and not self.offboard_ok:
            self._check()
        return taken

    def position_target(self, message: PositionTarget, *, is_global: bool = False) -> None:
        """Take a SET_POSITION_TARGET_LOCAL_NED or _GLOBAL_INT."""
        active, before = self.mode is Mode.OFFBOARD, self.offboard.accepted
        if is_global:
            wrong = self.offboard.take_global_target(message, self._now_us, active, self.guidance.home)
        else:
            wrong = self.offboard.take_position_target(message, self._now_us, active, self._rigid.q)
        if wrong is not None:
            self._say(CRITICAL, wrong)
        if self.offboard.accepted > before and not self.offboard_ok:
            self._check()

    def manual_control(self, x: int = 0, y: int = 0, z: int = 500, r: int = 0) -> None:
        """Take a MANUAL_CONTROL: pitch, roll and yaw -1000..1000, throttle 0..1000; sticks are centred without."""
        if self.sticks.joystick(x, y, z, r, self._now_us):
            self._take_over()

    def radio(self, channels: tuple[int, ...]) -> None:
        """Take a RC_CHANNELS_OVERRIDE [us]."""
        if self.sticks.radio(channels, self._now_us):
            self._take_over()

    def _take_over(self) -> None:
        """Give the pilot, who moves the sticks, the vehicle: Position, or what can run of the others."""
        if not self.armed or self.mode.needs_sticks or self.land.landed or self.terminated:
            return
        if self.set_mode(Mode.POSITION if self.estimate_ok else Mode.STABILIZED) is Result.ACCEPTED:
            self._say(INFO, "Pilot took over using sticks")

    def ground_heartbeat(self) -> None:
        """Take note of a ground station's heartbeat."""
        self._ground_us = self._now_us

    def see_estimate(self, available: bool) -> None:
        """Take note whether there is an estimate of attitude and position."""
        if available:
            self._blind_us = None
        elif self._blind_us is None:
            self._blind_us = self._now_us

    def estimate_reset(self, dp_m: Vec3, dv_m_s: Vec3, dyaw_rad: float) -> None:
        """Take note that the estimate has jumped: NED [m], [m/s], and heading [rad]."""
        self.guidance.shift(dp_m, dv_m_s, dyaw_rad)
        self.offboard.shift(dp_m, dv_m_s, dyaw_rad)
        self._orders.shift(dv_m_s, dyaw_rad)
        self._hover.shift(dp_m, dv_m_s)
        if self.held.mode == ATTITUDE and dyaw_rad != 0.0:
            self.held = self.held._replace(q=multiply(from_yaw(dyaw_rad), self.held.q))

    # What there is to report

    @property
    def has_estimate(self) -> bool:
        """Whether there is an estimate of attitude and position at this moment."""
        return self._blind_us is None

    @property
    def estimate_ok(self) -> bool:
        """Whether the last estimate is not too old."""
        return self._blind_us is None or (self._now_us - self._blind_us) * 1e-6 <= ESTIMATE_TIMEOUT_S

    @property
    def sticks_ok(self) -> bool:
        """Whether a source of manual control is there."""
        return self.sticks.now(self._now_us) is not None

    @property
    def ground_ok(self) -> bool:
        """Whether a ground station is there, or none is asked for (NAV_DLL_ACT = 0)."""
        if self.parameters.integer("NAV_DLL_ACT") <= 0:
            return True
        limit_s = self.parameters.number("COM_DL_LOSS_T")
        return self._ground_us is not None and (self._now_us - self._ground_us) * 1e-6 <= limit_s

    @property
    def in_failsafe(self) -> bool:
        """Whether a failsafe acts. One without an action does not count: PX4 shows nothing of it either."""
        return self.failsafe is not None and self.failsafe.action is not Action.NONE

    @property
    def position_setpoint(self) -> PositionSetpoint | None:
        """What the position controller flies, or flew last; None: nothing yet."""
        return self._orders.target

    @property
    def breach(self) -> str | None:
        """Which limit of the geofence the vehicle is beyond."""
        return self._breach

    @property
    def ready_to_arm(self) -> bool:
        """Whether arming would be allowed now."""
        return arming_obstacle(self) is None

    # Time

    def update(self, now_us: int, rigid: RigidState, dt_s: float) -> Order:
        """Advance to `now_us`, where the vehicle is in state `rigid`; gives the order for the next dt_s."""
        self._now_us = now_us
        self._rigid = rigid
        if now_us >= self._look_us:
            self._look(now_us, rigid)
        offboard = self.offboard
        if (
            self.mode is Mode.OFFBOARD
            and now_us < offboard.look_us
            and offboard.follows != TRAJECTORY
            and self._orders.rests
            and self.armed
            and not self.terminated
        ):
            # Which is what `_order` comes to in nearly all states of a flight with a companion.
            order = offboard.order(self.held)
        else:
            order = self._order(rigid, dt_s)
        setpoint = self.held = order.setpoint
        if setpoint.mode == ATTITUDE:
            self.attitude_setpoint = setpoint
        return order

    def _look(self, now_us: int, rigid: RigidState) -> None:
        """Do what is due now and then, and find out when something will be again."""
        if now_us >= self._health_us:
            self._health_us += HEALTH_PERIOD_US
            self._check()
        if now_us >= self._watch_us:
            self._watch_us += WATCH_PERIOD_US
            self._watch(now_us, rigid)
        if now_us >= self._fence_us:
            self._fence_us += FENCE_PERIOD_US
            self._watch_fence(rigid.p)
        self._look_us = min(self._health_us, self._watch_us, self._fence_us)

    def observe(self, now_us: int, rigid: RigidState) -> None:
        """Take note of the time and the state at which the next requests come in."""
        self._now_us = now_us
        self._rigid = rigid

    def _watch(self, now_us: int, rigid: RigidState) -> None:
        """Run the land and tilt detectors and act on what they say."""
        thrust = self.held.thrust
        climb_controlled = self._orders.controls_climb(self.mode)
        motion = Motion(
            rigid.v,
            rigid.w,
            0.0 if math.isnan(thrust) else thrust,
            climb_controlled,
            climb_controlled and self._orders.descends(self.mode, now_us, rigid.p),
            self.armed,
            self._hover.value,
        )
        self.land.update(motion, now_us)
        if self.estimate_ok:
            up = thrust * body_z(rigid.q)[2]
            self._hover.update(now_us, rigid.p, rigid.v, up, armed=self.armed, landed=self.land.landed)
        if not self.armed:
            return
        self._took_off = self._took_off or not self.land.landed
        self.guidance.observe(rigid.p, self.land.landed, self.sticks.now(now_us), WATCH_PERIOD_US * 1e-6)
        self._follow_mission()
        if self.mode is Mode.TAKEOFF and self.guidance.takeoff_done:
            self.intended = Mode.HOLD
            self._evaluate()
        reason = self._disarm_timer.update(now_us, self.land.landed, self._took_off)
        if reason is not None:
            self._disarm(reason)
            return
        attitude_controlled = (
            self.offboard.controls_attitude if self.mode is Mode.OFFBOARD else self.mode is not Mode.ACRO
        )
        if self._tilt.failed(now_us, rigid.q, attitude_controlled):
            self._tilt_failure(now_us)

    def _follow_mission(self) -> None:
        """Do what the mission wants of the autopilot: home, Return, or Hold at its end."""
        if self.mode is not Mode.MISSION:
            return
        mission = self.guidance.mission
        if mission.home_here:
            mission.home_here = False
            self.set_home(None)
        if mission.finished or self.guidance.wants_return:
            self.intended = Mode.HOLD if mission.finished else Mode.RETURN
            self._evaluate()

    def _watch_fence(self, p: Vec3) -> None:
        """Look whether the vehicle is within the geofence, and act when it is not."""
        before, self._breach = self._breach, self.fence.breach(p, self.guidance.home)
        if self._breach is None:
            self._fence_overruled = False
        if (self._breach is None) != (before is None):
            if self._breach is not None:
                self._say(CRITICAL, f"Geofence violation: {self._breach}")
            before_mode = self.mode
            self._evaluate()
            acts = self.failsafe is not None and self.failsafe.cause is Cause.FENCE
            if acts and self.mode is Mode.HOLD is before_mode:
                # It may be on its way to somewhere outside (DO_REPOSITION): PX4's navigator moves that to here.
                self.guidance.enter(Mode.HOLD, self._rigid.p, self._rigid.v, yaw_of(self._rigid.q))

    def report_battery(self, charge: int) -> None:
        """Take note of the battery's MAV_BATTERY_CHARGE_STATE."""
        if charge > self.battery_charge:
            word = {2: "Low battery", 3: "Critical battery", 4: "Emergency battery level"}[charge]
            self._say(CRITICAL if charge > 2 else WARNING, word)
        if charge != self.battery_charge:
            self.battery_charge = charge
            self._evaluate()

    def _tilt_failure(self, now_us: int) -> None:
        """Answer a tilt beyond FD_FAIL_R or FD_FAIL_P: early in a flight disarm, later terminate if that is enabled."""
        early_s = self.parameters.number("COM_SPOOLUP_TIME") + EARLY_FLIGHT_S
        if (now_us - self._armed_us) * 1e-6 < early_s:
            self._disarm("Disarmed by failure detector: attitude")
        elif self.parameters.integer("CBRK_FLIGHTTERM") != TILT_BREAKER:
            self._terminate("Attitude failure: flight terminated")
        elif self._tilt.first_report():
            self._say(CRITICAL, "Attitude failure detected")

    def _order(self, rigid: RigidState, dt_s: float) -> Order:
        """Give the setpoint of the mode in charge."""
        if not self.armed or self.terminated:
            return self._orders.nothing()
        blind = self._blind_us is not None and self._orders.needs_estimate(self.mode)
        if blind and self.held is not STOPPED_SETPOINT:
            return Order(self.held, False)  # the position controller runs with estimates only
        parameters = self.parameters
        if parameters.version != self._parameters_version:
            self._parameters_version = parameters.version
            self._spool_up_s = parameters.number("COM_SPOOLUP_TIME")
        spooled_up = (self._now_us - self._armed_us) * 1e-6 >= self._spool_up_s
        return self._orders.give(self.mode, self._now_us, rigid, dt_s, self.held, spooled_up)

    # Failsafe and arming

    def _check(self) -> None:
        """Look at the offboard signal and the links again, and act on it.

        PX4 does so at 10 Hz, and at once when a lost signal returns.
        """
        blind = self.offboard.wants_trajectory and not self.estimate_ok
        self.offboard_ok = self.offboard.signal_ok(self._now_us) and not blind
        self._evaluate()

    def _evaluate(self) -> None:
        """Choose what is flown: the mode that was asked for, or a failsafe's."""
        decision = None
        if self.armed and not self.terminated:
            health = Health(
                self.offboard_ok,
                self.sticks_ok,
                self._sticks_at_arming,
                self.ground_ok,
                self._breach is None or self._fence_overruled,
                self.battery_charge,
            )
            decision = self._delayed(decide(self.intended, health, self.parameters))
            if not self.estimate_ok:
                decision = without_estimate(self.intended, decision, health.sticks_ok)
        changed = decision != self.failsafe
        self.failsafe = decision
        if self.in_failsafe and decision is not None and changed:
            self._say(CRITICAL, f"{decision.cause.value}: {decision.action.label}")
        if decision is not None and decision.action is Action.DISARM:
            self._disarm(f"{decision.cause.value}: disarmed")
        elif decision is not None and decision.action is Action.TERMINATE:
            self._terminate(f"{decision.cause.value}: flight terminated")
        elif not self.terminated:
            mode = decision.action.mode if decision is not None else None
            self._fly(mode or self.intended)

    def _delayed(self, decision: Decision | None) -> Decision | None:
        """Hold for COM_FAIL_ACT_T before a link loss acts. The loss of the offboard signal acts at once."""
        at_once = (Cause.OFFBOARD_LOST, Cause.FENCE)
        if decision is None or decision.cause in at_once or decision.action is Action.NONE:
            self._lost_us.clear()
            return decision
        since = self._lost_us.setdefault(decision.cause, self._now_us)
        if (self._now_us - since) * 1e-6 < self.parameters.number("COM_FAIL_ACT_T"):
            return Decision(Action.HOLD, decision.cause)
        return decision

    def _fly(self, mode: Mode) -> None:
        """Change what is flown."""
        if mode is self.mode:
            return
        point = self.guidance.takeoff_point if mode is Mode.HOLD and self.guidance.takeoff_done else None
        self.mode = mode
        if mode is Mode.OFFBOARD:
            self.offboard.enter(self._now_us)
        else:
            self.guidance.enter(mode, self._rigid.p, self._rigid.v, yaw_of(self._rigid.q), point)

    def _can_run(self, mode: Mode) -> bool:
        """Tell whether a mode has what it needs."""
        if mode is Mode.OFFBOARD:
            return self.offboard_ok
        if mode is Mode.MISSION:
            return self.guidance.mission.can_run and self.estimate_ok
        return (self.sticks_ok or not mode.needs_sticks) and (self.estimate_ok or not mode.needs_estimate)

    def _disarm(self, sentence: str) -> None:
        """Stop the rotors."""
        if not self.armed:
            return
        self.armed = False
        self._say(NOTICE, sentence)
        self._disarm_timer.reset()
        self._evaluate()

    def _terminate(self, sentence: str) -> None:
        """Stop the rotors until the vehicle is started anew."""
        if not self.terminated:
            self.terminated = True
            self.mode = Mode.TERMINATION
            self._say(EMERGENCY, sentence)

    def _say(self, severity: int, sentence: str) -> None:
        """Queue a STATUSTEXT."""
        self.texts.append((severity, sentence))
