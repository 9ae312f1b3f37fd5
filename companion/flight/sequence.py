"""What a flight does in which order: the phases from the first heartbeat to the last, each change with a reason.

The sequence asks the autopilot for things (`link.operations`) and decides what the loop does with a state: nothing,
stream hold setpoints so that OFFBOARD can be entered, or track. It knows vehicle time only and has no sockets, so tests
can step it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from functools import partial

from companion.config import Flight
from companion.control.types import Vec3
from companion.errors import RefusedError
from companion.flight.adaptation import Adaptation
from companion.flight.climb import Climb
from companion.flight.course import Course
from companion.flight.orders import Orders
from companion.flight.phases import Autopilot, Cause, FlightEnded, LandedState, Order, Phase
from companion.flight.planning import Planning
from companion.flight.preflight import Preflight
from companion.flight.surroundings import gate_course
from companion.frames import GeoPoint, yaw_from_quat
from companion.link import modes
from companion.link.modes import Mode
from companion.link.operations import Operation, Operations, Retry
from companion.link.telemetry import VehicleState
from companion.record.summary import PhaseChange
from companion.trajectory.anchored import Trajectory
from companion.trajectory.earth import counts_from

STREAM_BEFORE_OFFBOARD_S = 1.0
"""Hold setpoints go out for this long before OFFBOARD is asked for; PX4 needs one, older versions more."""
OFFBOARD_TIMEOUT_S = 5.0
TAKEOFF_TIMEOUT_S = 60.0
TAKEOFF_SLOWEST_M_S = 1.0
"""A take-off may last that long, and at this speed the time that its height takes."""
LANDING_TIMEOUT_S = 120.0
SETTLED_SPEED_M_S = 0.3
SETTLED_FOR_S = 1.0
HOLD_SETTLE_S = 1.0
HANDOVER_INTERVAL_S = 0.1
HANDOVER_TIMEOUT_S = 3.0
CONFIRM_TIMEOUT_S = 2.5
"""HEARTBEAT comes once per second: the longest a mode change may take to be seen there."""
START_SPEED_MAX_M_S = 1.0
"""Faster, the vehicle does not hold, and there is no hold point to begin from."""
DRIFT_MAX_M = 0.5
"""Moved further while its course was planned, the vehicle would begin with a step."""
START_TIMEOUT_S = 30.0
RETURN_ON_LOSS = 3.0
"""COM_OBL_RC_ACT: what the autopilot does when setpoints cease."""
REFUSALS_MAX = 3
"""One refusal may be of the moment: PX4 judges a mode ten times per second."""
INTENTION_WAIT_S = 0.3
"""What a change of mode was meant to be comes with CURRENT_MODE, at 10 Hz."""
HOLD_CALM_S = 1.0
"""The beginning of a Hold that is watched does not count."""
FRESH_S = 0.5
"""An older state does not say where the vehicle is."""
REASON_WAIT_S = 0.5
"""The autopilot's words about a refusal may come after its answer."""

_FOLLOWS = {Phase.JOIN, Phase.TRACK, Phase.PAUSE, Phase.HOLD}
"""The phases of the course: the controller that flies it does so in OFFBOARD."""
_AWAITED = {Phase.TAKEOFF: modes.TAKEOFF, Phase.JOIN: modes.HOLD, Phase.LAND: modes.LAND}
"""The autopilot's own modes that a phase asks for."""


class Duty(Enum):
    """What is due for a fresh state."""

    NOTHING = "no setpoint is due"
    STREAM = "hold setpoints, so that OFFBOARD can be entered"
    TRACK = "setpoints that follow the course"
    CLIMB = "position setpoints that take off"


class Sequence:
    """The phases of one flight.

    Args:
        flight: the configuration.
        trajectory: what is to be flown.
        operations: requests to the autopilot.
        autopilot: what it says of itself; the loop keeps it up to date.
        engage: called with the state at which OFFBOARD was confirmed, before the first tracking step.
        notify: called with a line for people.
        only_gates: the gates judge, and nothing is asked of the vehicle after that.
        waits: whether the vehicle's time stands still while we compute (lockstep).
        adapt: called before anything moves when the measured loop asks for other setpoints or gains.
    """

    def __init__(
        self,
        flight: Flight,
        trajectory: Trajectory,
        operations: Operations,
        autopilot: Autopilot,
        engage: Callable[[VehicleState], None],
        notify: Callable[[str], None],
        *,
        only_gates: bool = False,
        waits: Callable[[], bool] = lambda: True,
        adapt: Callable[[Adaptation], None] = lambda adaptation: None,
    ) -> None:
        self.phase = Phase.CONNECT
        self.changes: list[PhaseChange] = []
        self.duty = Duty.NOTHING
        self.course: Course | None = None
        self.climb: Climb | None = None
        """Of a take-off in Offboard."""
        self.engaged_at_s = 0.0
        """Vehicle time (of state stamps) at which the course begins."""
        self.ending: tuple[Cause, str] | None = None
        self._flight = flight
        self._trajectory = trajectory
        self._ops = operations
        self._autopilot = autopilot
        self._engage = engage
        self._notify = notify
        self.preflight = Preflight(flight, operations, autopilot, notify, adapt)
        self._only_gates = only_gates
        self._waits = waits
        self._planning: Planning | None = None
        self._state: VehicleState | None = None
        self._state_s = 0.0
        self._since_s = 0.0
        self._step_s = 0.0
        self._operation: Operation | None = None
        self._asked = False
        self._leaving = False
        """Whether Hold was asked for at the top of a climb in Offboard."""
        self._settled_since_s: float | None = None
        self._mode_seen = False
        self._mode_at_end: Mode | None = None
        self._mode_at_entry: Mode | None = None
        """Of the phase."""
        self._confirmed_hold_s: float | None = None
        self._rungs: tuple[Mode, ...] = self.ladder
        self._refusals = 0
        self._rest_for: tuple[Cause, str] | None = None
        """Why a guard lets the course come to rest."""
        self._other_mode_s: float | None = None
        self._other_mode: Mode = modes.HOLD
        """A mode that this flight did not ask for, and since when."""
        self._meant: set[Mode] = set()
        self._hold_since_s: float | None = None
        self.orders = Orders(self, autopilot, flight.vehicle.link.state_rate_hz)
        """What the operator wants."""
        self._goes_on: dict[Phase, Callable[[float], None]] = {
            Phase.PREFLIGHT: self._prepare,
            Phase.TAKEOFF: self._take_off,
            Phase.JOIN: self._join,
            Phase.HOLD: self._finish,
            Phase.LAND: self._land,
        }
        """What time brings in the phases that wait for something."""

    @property
    def stamp_s(self) -> float:
        """Vehicle time of the newest state's stamp [s]."""
        return 0.0 if self._state is None else self._state.t_vehicle_us * 1e-6

    @property
    def owes_hold(self) -> bool:
        """Whether the vehicle may be following our setpoints, or was asked for Hold and has not acknowledged it."""
        return self.duty is not Duty.NOTHING or (self.ending is not None and self._confirmed_hold_s is None)

    @property
    def ladder(self) -> tuple[Mode, ...]:
        """What the autopilot is asked for at the end, the next one where it refuses the one before.

        Return only if that is what its owner wants of it when setpoints cease: it climbs, and flies away.
        """
        returns = self._autopilot.parameters.get("COM_OBL_RC_ACT") == RETURN_ON_LOSS
        return (modes.HOLD, modes.RETURN, modes.LAND) if returns else (modes.HOLD, modes.LAND)

    # -- events ---------------------------------------------------------------------------------------------------

    def enter(self, phase: Phase, now_s: float, reason: str) -> None:
        """Changes the phase; the reason goes into the log. What the phase before asked for is asked for no more."""
        self._ops.drop_moving(now_s)
        self._mode_at_entry = self._autopilot.mode
        self.phase = phase
        self.changes.append(PhaseChange(phase.value, now_s, reason))
        self._since_s = now_s
        self._operation = None
        self._asked = False
        self._settled_since_s = None
        self._mode_seen = False
        self._notify(f"{phase.value}: {reason}")

    def on_state(self, state: VehicleState, now_s: float) -> None:
        """A fresh state; called before the setpoint for it is computed."""
        self._state, self._state_s = state, now_s
        if self.ending is None and self.duty is Duty.TRACK:
            self._follow_course(state.t_vehicle_us * 1e-6)
        elif self.climb is not None and self.duty is Duty.CLIMB and self.ending is None:
            astray = self.climb.astray(state)
            if astray:
                self.end(Cause.POSITION_ERROR, astray, now_s)

    def tick(self, now_s: float) -> None:
        """Lets time pass: called at every turn of the loop.

        Raises:
            FlightEnded: there is nothing more to do.
        """
        self._ops.update(now_s)
        if self.ending is None:
            self._watch_mode(now_s)
            if self._other_mode_s is not None:
                return
            self.orders.tick(now_s)
        if self.ending is not None:
            self._hand_over(now_s)
            return
        goes_on = self._goes_on.get(self.phase)
        if goes_on is not None:
            goes_on(now_s)

    def tell(self, line: str) -> None:
        """A line for people."""
        self._notify(line)

    def come_to_rest(self, cause: Cause, detail: str, now_s: float) -> None:
        """Lets the course come to rest on its path and then hands over; where there is no course, at once."""
        if self.ending is not None or self._rest_for is not None:
            return
        sentence = f"{cause.value.sentence}: {detail}"
        if self.orders.come_to_rest(now_s, sentence):
            self._rest_for = cause, detail
        else:
            self.end(cause, detail, now_s)

    def end(self, cause: Cause, detail: str, now_s: float, rungs: tuple[Mode, ...] = ()) -> None:
        """Begins to hand over to the autopilot; the first cause stays.

        Args:
            cause: why.
            detail: figures, for people.
            now_s: vehicle time [s].
            rungs: the modes to ask for, the next one where the autopilot refuses the one before; () for `ladder`.
        """
        if self.ending is not None:
            return
        self.ending = (cause, detail)
        self._ops.drop_moving(now_s)
        self._rungs, self._refusals = rungs or self.ladder, 0
        self._operation = None
        self._step_s = now_s - HANDOVER_INTERVAL_S
        self._since_s = now_s
        allowed, mode = self._allowed_modes(), self._autopilot.mode
        others = self._other_mode_s is not None or (allowed is not None and mode not in allowed)
        self._mode_at_end = None if others else mode
        self._notify(f"ending: {cause.value.sentence}" + (f": {detail}" if detail else ""))
        if self.climb is not None:
            self.climb.stop(self.stamp_s)
        if self.duty not in {Duty.TRACK, Duty.CLIMB}:
            self.duty = Duty.NOTHING

    def interrupt(self, now_s: float) -> None:
        """The operator wants to stop.

        Raises:
            FlightEnded: nothing was asked of the vehicle yet, or it has landed: there is nothing to hand over.
        """
        if self.ending is not None:
            return
        if self.phase in {Phase.CONNECT, Phase.PREFLIGHT}:
            raise FlightEnded(Cause.INTERRUPTED, "before anything was asked of the vehicle")
        if self.phase is Phase.LAND and self._autopilot.landed is LandedState.ON_GROUND:
            raise FlightEnded(Cause.INTERRUPTED, "the vehicle has landed")
        self.end(Cause.INTERRUPTED, "", now_s)

    # -- phases ---------------------------------------------------------------------------------------------------

    def _prepare(self, now_s: float) -> None:
        if not self.preflight.done(now_s):
            return
        if self._only_gates:
            raise FlightEnded(Cause.INSPECTED, "every gate lets it pass")
        landed = self._autopilot.landed
        if landed is LandedState.ON_GROUND or not self._autopilot.armed:
            self.enter(Phase.TAKEOFF, now_s, f"all gates passed; climbing to {self._flight.takeoff_altitude_m:g} m")
        else:
            self.enter(Phase.JOIN, now_s, "all gates passed; the vehicle is in the air already")
            self._hold_first(now_s)

    def _take_off(self, now_s: float) -> None:
        """NAV_TAKEOFF, then arming, then waiting until the autopilot holds up there."""
        if self._flight.takeoff == "offboard":
            self._climb_in_offboard(now_s)
            return
        state = self._state
        if self._operation is None:
            self._operation = self._ops.takeoff(self.preflight.takeoff_amsl_m(state), now_s)
        if self._operation.pending or self._refused(self._operation, now_s):
            return
        if not self._asked:
            self._asked = True
            self._operation = self._ops.arm(now_s)
            return
        if self._takes_too_long(now_s) or self._disarmed(self._operation, now_s):
            return
        steady = (
            self._autopilot.mode == modes.HOLD
            and self._autopilot.landed is LandedState.IN_AIR
            and self._slower_than(SETTLED_SPEED_M_S, now_s)
        )
        if not steady:
            self._settled_since_s = None
        elif self._settled_since_s is None:
            self._settled_since_s = now_s
        elif now_s - self._settled_since_s >= SETTLED_FOR_S:
            self.enter(Phase.JOIN, now_s, "the vehicle holds at its take-off height")
            self._hold_first(now_s)

    def _climb_in_offboard(self, now_s: float) -> None:
        """Setpoints for where it stands, Offboard, arming; then the point rises, and at the top Hold is asked for."""
        state, autopilot = self._state, self._autopilot
        if self._takes_too_long(now_s):
            return
        if self.climb is None:
            if state is not None and now_s - self._state_s < FRESH_S:
                self.climb = Climb(state, self._flight.takeoff_altitude_m)
                self.duty, self._step_s = Duty.CLIMB, now_s
        elif now_s - self._step_s < STREAM_BEFORE_OFFBOARD_S or state is None:
            return
        elif self._operation is None:
            self._operation = self._ops.set_mode(modes.OFFBOARD, now_s, Retry(0.5, 8))
        elif self._operation.pending or self._refused(self._operation, now_s):
            return
        elif not self._asked:
            self._asked = True
            self._operation = self._ops.arm(now_s)
            self._since_s = now_s
        elif not self._leaving:
            self._rise(self.climb, state, self._operation, now_s)
        elif autopilot.mode == modes.HOLD:
            self.duty, self.climb = Duty.NOTHING, None
            self.enter(Phase.JOIN, now_s, "the vehicle holds at its take-off height, climbed to in Offboard")
            self._hold_first(now_s)

    def _rise(self, climb: Climb, state: VehicleState, arming: Operation, now_s: float) -> None:
        """Armed: the point rises once Offboard is reported; at the top Hold is asked for."""
        autopilot = self._autopilot
        if not self._disarmed(arming, now_s) and autopilot.armed and autopilot.mode == modes.OFFBOARD:
            climb.begin(self.stamp_s)
            if climb.arrived(state) and self._slower_than(SETTLED_SPEED_M_S, now_s):
                self._leaving = True
                self._operation = self._ops.set_mode(modes.HOLD, now_s)

    def _takes_too_long(self, now_s: float) -> bool:
        """Whether the take-off should have been over; ends the flight then."""
        limit_s = TAKEOFF_TIMEOUT_S + self._flight.takeoff_altitude_m / TAKEOFF_SLOWEST_M_S
        if now_s - self._since_s <= limit_s:
            return False
        self.end(Cause.REFUSED, f"no steady hold was reached within {limit_s:g} s of take-off", now_s)
        return True

    def _disarmed(self, arming: Operation, now_s: float) -> bool:
        """Whether the vehicle is not armed although it should be told by now that it is; ends the flight then."""
        begun_s = self._since_s if arming.ended_s is None else arming.ended_s
        if self._autopilot.armed or now_s - begun_s <= CONFIRM_TIMEOUT_S + 1.0:
            return False
        self.end(Cause.REFUSED, "the autopilot disarmed before it took off", now_s)
        return True

    def _refused(self, operation: Operation, now_s: float) -> bool:
        """Whether the autopilot refused what was asked; ends the flight with its reason, which may come a little
        later."""
        if operation.pending or operation.accepted:
            return False
        if now_s - (operation.ended_s or now_s) >= REASON_WAIT_S:
            self.end(Cause.REFUSED, operation.sentence, now_s)
        return True

    def _slower_than(self, speed_m_s: float, now_s: float) -> bool:
        state = self._state
        fresh = state is not None and now_s - self._state_s < FRESH_S
        return fresh and state is not None and max(abs(x) for x in state.v) < speed_m_s

    def _join(self, now_s: float) -> None:
        if self.duty is Duty.NOTHING:
            self._hold_first(now_s)
        elif self.duty is Duty.STREAM:
            self._enter_offboard(now_s)

    def _hold_first(self, now_s: float) -> None:
        """The vehicle must hold, and be meant to, before a setpoint is sent: PX4 goes back to OFFBOARD by itself at the
        first one when that was the last mode asked for."""
        autopilot = self._autopilot
        if autopilot.mode == modes.HOLD and autopilot.intended in {None, modes.HOLD}:
            known = autopilot.intended is not None or self._operation is not None
            if known and self._slower_than(START_SPEED_MAX_M_S, now_s):
                if self._watched_hold(now_s):
                    self._plan_course(now_s)
                return
        self._planning = None  # it does not hold where a plan would begin
        if self._operation is None and (autopilot.mode, autopilot.intended) != (modes.HOLD, modes.HOLD):
            self._operation = self._ops.set_mode(modes.HOLD, now_s)
        if self._operation is not None and self._refused(self._operation, now_s):
            return
        if now_s - self._since_s > START_TIMEOUT_S:
            self.end(Cause.REFUSED, f"the vehicle does not hold still in Hold after {START_TIMEOUT_S:g} s", now_s)

    def _watched_hold(self, now_s: float) -> bool:
        """Whether the autopilot's own hover was watched for as long as a calibration asks for."""
        plan, autopilot = self._flight.calibration, self._autopilot
        if plan is None:
            return True
        if autopilot.home is None:
            raise FlightEnded(Cause.REFUSED, "the home position is not known, and so not the height above ground")
        if self._hold_since_s is None:
            self._hold_since_s = now_s
            self._notify(f"join: measuring the thrust of the autopilot's own hover for {plan.hold_s:g} s")
        since_s = now_s - self._hold_since_s
        autopilot.gathers = since_s >= HOLD_CALM_S
        if since_s < HOLD_CALM_S + plan.hold_s:
            return False
        autopilot.gathers = False
        return True

    def _plan_course(self, now_s: float) -> None:
        """Plans join and stop from where the vehicle is held, while the autopilot still has it."""
        if self._planning is None:
            assert self._state is not None
            where, home = self._state.p, self._autopilot.home
            make = partial(self._new_course, where, yaw_from_quat(self._state.q), home, self._autopilot.home_global)
            self._planning = Planning(make, aside=not self._waits())
        try:
            course = self._planning.course()
        except RefusedError as error:
            raise FlightEnded(Cause.REFUSED, str(error)) from None
        if course is None:
            return
        self._planning = None
        assert self._state is not None
        if math.dist(course.hold_point, self._state.p) > DRIFT_MAX_M:
            return  # and again, from where it is now
        self.course = course
        self._operation = None
        self._since_s = now_s
        self.duty = Duty.STREAM

    def _new_course(self, hold: Vec3, yaw_rad: float, home: Vec3 | None, home_global: GeoPoint | None) -> Course:
        """Runs beside the loop: it only uses what it is given and what never changes."""
        trajectory, flight = self._trajectory, self._flight
        origin = counts_from(trajectory, home, home_global)
        course = Course(trajectory, flight.vehicle, hold, yaw_rad, home, flight.height_min_m, origin=origin)
        gate_course(course)
        return course

    def _enter_offboard(self, now_s: float) -> None:
        """Streams, asks for OFFBOARD, and engages when the acknowledgement and the reported mode agree."""
        if now_s - self._since_s < STREAM_BEFORE_OFFBOARD_S:
            return
        if self._operation is None:
            self._operation = self._ops.set_mode(modes.OFFBOARD, now_s, Retry(0.5, 8))
        elif self._refused(self._operation, now_s):
            return
        elif self._autopilot.mode == modes.OFFBOARD and self._operation.accepted and self._state is not None:
            assert self.course is not None
            self.duty = Duty.TRACK
            self.engaged_at_s = self._state.t_vehicle_us * 1e-6
            self._engage(self._state)
            self.orders.follow(self.course)
            if self.course.join_s == 0.0:
                self.enter(Phase.TRACK, self.engaged_at_s, "OFFBOARD confirmed; the controller joins the trajectory")
            else:
                self._notify(f"join: OFFBOARD confirmed, {self.course.join_s:.1f} s to the start of the trajectory")
        elif now_s - self._since_s > STREAM_BEFORE_OFFBOARD_S + OFFBOARD_TIMEOUT_S:
            self.end(Cause.REFUSED, "the autopilot did not report OFFBOARD within 5 s", now_s)

    def _follow_course(self, stamp_s: float) -> None:
        """Track and hold begin on the course's own clock, at the state that reaches them."""
        course = self.course
        assert course is not None
        t = course.course_s(stamp_s - self.engaged_at_s)
        if t < course.join_s:
            return
        if self.phase is Phase.JOIN:
            self.enter(Phase.TRACK, stamp_s, "the join is done")
        elif t >= course.join_s + course.track_s and self.phase is Phase.TRACK:
            self.enter(Phase.HOLD, stamp_s, "the trajectory is flown")

    def track_time_s(self, stamp_s: float) -> float:
        """Time on the trajectory of a state [s]; negative during the join."""
        assert self.course is not None
        return self.course.course_s(stamp_s - self.engaged_at_s) - self.course.join_s

    def phase_on_course(self, t_s: float) -> Phase:
        """The phase that the course is in, `t_s` after engaging."""
        assert self.course is not None
        t = self.course.course_s(t_s)
        if t < self.course.join_s:
            return Phase.JOIN
        return Phase.TRACK if t < self.course.join_s + self.course.track_s else Phase.HOLD

    def _finish(self, now_s: float) -> None:
        """After the stop: back to the autopilot, in Hold or landing."""
        assert self.course is not None
        if now_s - self.engaged_at_s < self.course.over_s + HOLD_SETTLE_S:
            return
        wish = self.orders.ended_by
        if wish is Order.LAND:
            self.land_from_here(now_s)
        elif self._rest_for is not None:
            self.end(*self._rest_for, now_s)
        elif wish is Order.STOP:
            self.end(Cause.STOPPED, "", now_s)
        elif self._flight.after == "land":
            self.enter(Phase.LAND, now_s, "the flight file asks for a landing")
        else:
            self.end(Cause.COMPLETED, "", now_s)

    def land_from_here(self, now_s: float) -> None:
        """The operator wants the vehicle to land, whatever phase this is."""
        if self.duty is not Duty.TRACK:
            self.duty = Duty.NOTHING
        self.enter(Phase.LAND, now_s, "the operator asks for a landing")

    def _land(self, now_s: float) -> None:
        if self._operation is None:
            self._operation = self._ops.land(now_s)
        elif self._operation.accepted or self._autopilot.mode == modes.LAND:
            # The mode may be reported before the acknowledgement, which a lossy link loses: the law must not be judged
            # by a descent that is not its own.
            self.duty = Duty.NOTHING
        elif self._refused(self._operation, now_s):
            return
        down = self._autopilot.landed is LandedState.ON_GROUND and not self._autopilot.armed
        told = now_s - self._since_s > CONFIRM_TIMEOUT_S  # also of an arming that went out just before
        if self.duty is Duty.NOTHING and down and told:
            cause = Cause.COMPLETED if self.orders.ended_by is None else Cause.STOPPED
            raise FlightEnded(cause, "landed and disarmed")
        if now_s - self._since_s > LANDING_TIMEOUT_S:
            raise FlightEnded(Cause.STATE_LOST, f"no landing was reported within {LANDING_TIMEOUT_S:g} s")

    # -- other hands ----------------------------------------------------------------------------------------------

    def _watch_mode(self, now_s: float) -> None:
        """A mode that this flight did not ask for is another hand's, or a failsafe's: it ends the flight at once.

        Raises:
            FlightEnded: nothing more is asked for or sent.
        """
        mode, intended = self._autopilot.mode, self._autopilot.intended
        if mode is None:
            return
        if self._other_mode_s is None:
            if mode == modes.OFFBOARD and self._autopilot.armed and self.phase in _FOLLOWS and self.duty is Duty.TRACK:
                return  # as it is to be for most of a flight
            if self.duty is Duty.TRACK and not self._autopilot.armed:
                self.duty = Duty.NOTHING
                raise FlightEnded(Cause.DISARMED, "nothing more is sent")
            awaited = modes.OFFBOARD if self.duty is Duty.CLIMB else _AWAITED.get(self.phase)
            self._mode_seen = self._mode_seen or mode == awaited
            allowed = self._allowed_modes()
            if allowed is None or mode in allowed:
                return
            self._meant = allowed
            self.duty = Duty.NOTHING
            self._other_mode_s, self._other_mode = now_s, mode
            self._notify(f"the autopilot reports {mode.label}: nothing more is sent")
        if intended in self._meant and now_s - self._other_mode_s < INTENTION_WAIT_S:
            return
        cause = Cause.FAILSAFE if intended in self._meant else Cause.TAKEN_OVER
        said = "; ".join(self._ops.texts.complaints(now_s - 1.0, now_s))
        raise FlightEnded(cause, f"the autopilot reports {self._other_mode.label}" + (f" ({said})" if said else ""))

    def _allowed_modes(self) -> set[Mode] | None:
        """The modes that this flight's own requests lead to now; None for any."""
        if self.duty is Duty.CLIMB:
            rises = self._asked and self._mode_seen and self._autopilot.armed
            return {modes.OFFBOARD, modes.HOLD} if rises and self._leaving else {modes.OFFBOARD} if rises else None
        if self.phase is Phase.TAKEOFF:
            return {modes.TAKEOFF, modes.HOLD} if self._mode_seen and self._autopilot.armed else None
        if self.phase is Phase.LAND:
            # On the ground PX4 goes back to the mode that was meant before, and says so before it says disarmed.
            if not self._autopilot.armed or self._autopilot.landed is LandedState.ON_GROUND:
                return None
            if self._mode_seen:
                return {modes.LAND}
            before = self._mode_at_entry or modes.OFFBOARD
            # a take-off ends in Hold by itself, and Hold may have been asked for just before
            return {modes.OFFBOARD, modes.LAND, before} | ({modes.HOLD} if before != modes.OFFBOARD else set())
        if self.phase is Phase.JOIN and self.duty is Duty.NOTHING:
            # Hold is asked for once, out of the mode that the vehicle was found in; then it is to stay.
            before = self._mode_at_entry or modes.HOLD
            return {modes.HOLD} if self._mode_seen else {modes.HOLD, before}
        if self.duty is Duty.STREAM:
            return {modes.HOLD} if self._operation is None else {modes.HOLD, modes.OFFBOARD}
        return {modes.OFFBOARD} if self.duty is Duty.TRACK else None

    def _hand_over(self, now_s: float) -> None:
        """Asks for Hold every 100 ms until it is acknowledged, then waits until it is reported, then ends; where the
        autopilot refuses it, the same with the next rung."""
        assert self.ending is not None
        cause, detail = self.ending
        operation, mode, wanted = self._operation, self._autopilot.mode, self._rungs[0]
        if self._confirmed_hold_s is not None:
            if mode == wanted or now_s - self._confirmed_hold_s > CONFIRM_TIMEOUT_S:
                label = wanted.label
                where = f"the vehicle is in {label}" if mode == wanted else f"{label} was acknowledged"
                raise FlightEnded(cause, f"{detail}; {where}".lstrip("; "))
        elif mode is not None and mode not in self._modes_to_leave():
            self._give_up(f"the autopilot reports {mode.label} by another hand, nothing more is asked of it")
        elif operation is not None and (operation.accepted or self._autopilot.intended == mode == wanted):
            self._confirmed_hold_s = now_s
            self.duty = Duty.NOTHING
        elif now_s - self._since_s > HANDOVER_TIMEOUT_S:
            self._give_up(f"{wanted.label} was not acknowledged, the autopilot's own failsafe acts")
        elif now_s - self._step_s >= HANDOVER_INTERVAL_S - 1e-9:
            self._step_s = now_s
            if operation is not None and operation.refused:
                self._refusals += 1
                if self._refusals >= REFUSALS_MAX and len(self._rungs) > 1:
                    self._refusals, self._rungs, self._since_s = 0, self._rungs[1:], now_s
                    self._notify(f"{operation.sentence}; asking for {self._rungs[0].label}")
            self._operation = self._ops.set_mode(self._rungs[0], now_s, Retry(HANDOVER_INTERVAL_S, 1))

    def _modes_to_leave(self) -> set[Mode | None]:
        """The modes that Hold may be asked for in; any other was chosen by somebody else, and stays."""
        return {modes.HOLD, modes.OFFBOARD, self._mode_at_end, self._rungs[0], _AWAITED.get(self.phase)}

    def _give_up(self, why: str) -> None:
        assert self.ending is not None
        cause, detail = self.ending
        self.duty = Duty.NOTHING
        self._confirmed_hold_s = self._since_s
        raise FlightEnded(cause, f"{detail}; {why}".lstrip("; "))
