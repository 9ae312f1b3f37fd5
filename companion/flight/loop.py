"""The control loop: one thread, one link, driven by the vehicle's states.

A turn waits for the link, drains it, answers the newest state with a setpoint, and answers TIMESYNC requests after
that. A vehicle in lockstep (its clock waits for those answers, DESIGN "Lockstep") gets exactly one turn per state, so
the same seed gives the same flight. Nothing is sent that is not computed from a fresh state, except the one coast
setpoint when states cease. However the loop ends, a vehicle that may be following its setpoints is handed over to Hold.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time
import traceback
from collections.abc import Callable
from dataclasses import replace

from companion import realtime
from companion.config import Flight
from companion.control.history import Attitude
from companion.control.output import PositionSetpoint, Setpoint
from companion.control.types import State, new_record
from companion.errors import LinkError
from companion.flight.accounting import Accounting, FlownStep, Progress
from companion.flight.adaptation import Adaptation, adapted
from companion.flight.calibration import Calibrator
from companion.flight.clock import VehicleClock
from companion.flight.coast import coast_setpoint
from companion.flight.connect import AUTOPILOT_COMPONENT, explain_no_time, find_autopilot, send_heartbeat
from companion.flight.controller import controller_of
from companion.flight.course import Course, Timed, at_rest
from companion.flight.engines import Kernels
from companion.flight.host import Alone, Host
from companion.flight.last_resort import ask_for_hold
from companion.flight.measure import silence_limit_s
from companion.flight.phases import Autopilot, Cause, Engagement, FlightEnded, Order, Outcome, Phase
from companion.flight.preflight import Preflight
from companion.flight.reflex import ANSWERED, DECLINED, Reflex
from companion.flight.reports import hover_thrust_n, take_heartbeat, take_report, vehicle_facts
from companion.flight.responses import respond
from companion.flight.retuning import ParameterChange, Retuning
from companion.flight.sequence import Duty, Sequence
from companion.flight.streams import Streams
from companion.flight.tracker import Tracker, TrackerStep
from companion.flight.watch import Watch
from companion.frames import yaw_from_quat
from companion.link import codec, timesync
from companion.link.codec import Timesync
from companion.link.framing import Frame
from companion.link.operations import Operations
from companion.link.setpoint import SetpointSender, UnsendableSetpoint
from companion.link.telemetry import StateRejection, Telemetry, VehicleState
from companion.link.timesync import PacedPeer
from companion.link.version import AutopilotVersion
from companion.link.wire import Datagram, Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.anchored import Trajectory

PACED_SILENCE_S = 3.0
"""Wall time after which a vehicle in lockstep, whose clock stands still while it is silent, counts as lost."""
LINK_SILENCE_S = 5.0
"""The same for any other vehicle, while no states are due: five of its heartbeats."""
OFFBOARD_LOSS_S = 1.0
"""COM_OF_LOSS_T where it could not be read."""
PACE_STATES = 15
PACE_WALL_S = 3.0
"""A vehicle in lockstep shows itself within so many states; without any, so long is waited for them."""
FLOWN_ON = frozenset((codec.ODOMETRY, codec.ATTITUDE_QUATERNION))
"""What a setpoint is computed from: what comes behind the newest of them is read when that is answered. So a change of
the mode that came together with a state, and behind it, is known one setpoint later."""
LOCKSTEP_SPIN_S = 0.0005
"""A vehicle in lockstep answers within this: sleeping would cost more than the wait. Elsewhere the loop sleeps."""
HEARTBEAT_INTERVAL_S = 1.0
IDLE_WAIT_S = 0.1
BUSY_WAIT_S = 0.01
WAIT_STEP_S = 0.001
"""A wait is counted in milliseconds."""
_MSGID_AT = 7
_ATTITUDE_LOW = bytes((codec.ATTITUDE_QUATERNION,))
AWAY_NS = 25_000_000
"""A turn that lasts longer while setpoints are due: this process itself was stopped, and not the link silent."""


class FlightLoop:
    """Flies one flight over one link.

    Args:
        flight: the configuration.
        trajectory: what is to be flown.
        wire: the open link; it stays the caller's.
        record: gets one row per control step.
        compiled: the kernels of the control step.
        notify: called with a line for people at every change; must not block.
        progress: called at most ten times per second of wall time; must not block.
        connect_timeout_s: how long to wait for the first heartbeat (wall time).
        connection: what to call the link in explanations.
        system: the vehicle's system id, where it is known already.
        host: the program around it.
        paced: called once when it is known whether the vehicle waits for us (lockstep), with that.
        engaged: called when the controller takes over, again after its course's pace or the law's parameters were
            changed, and with the delays of the whole flight at the end; must not block.
        delayed: called with the delays that were predicted over since the last time; must not block.
        only_gates: nothing is flown: it ends when the gates have judged.
        met: called once with the vehicle's system id, before anything else of it is used; must not block.
    """

    def __init__(
        self,
        flight: Flight,
        trajectory: Trajectory,
        wire: Wire,
        record: FlightRecord,
        compiled: Kernels,
        notify: Callable[[str], None] = lambda line: None,
        progress: Callable[[Progress], None] = lambda progress: None,
        connect_timeout_s: float = 15.0,
        connection: str = "this link",
        system: int | None = None,
        host: Host | None = None,
        engaged: Callable[[Engagement], None] = lambda engagement: None,
        delayed: Callable[[list[tuple[float, float]]], None] = lambda delays: None,
        only_gates: bool = False,
        paced: Callable[[bool], None] = lambda waits: None,
        met: Callable[[int], None] = lambda system: None,
    ) -> None:
        self._flight = flight
        self._trajectory = trajectory
        self._wire = wire
        self._record = record
        self._notify = notify
        self._progress = progress
        self._connect_timeout_s = connect_timeout_s
        self._connection = connection
        self._system = system
        self._host: Host = Alone() if host is None else host
        self._engaged = engaged
        self._delayed = delayed
        self._only_gates = only_gates
        self._paced = paced
        self._tell_met = met
        self._autopilot = Autopilot()
        self._compiled = compiled
        self._adaptation: Adaptation | None = None
        self._tracker = controller_of(flight, compiled, self._autopilot, notify)
        self._retuning = Retuning(self._tracker, notify) if isinstance(self._tracker, Tracker) else None
        self._silence_s = silence_limit_s(flight.vehicle.link.state_rate_hz, calibrates=flight.calibration is not None)
        self._peer = PacedPeer()
        self._clock = VehicleClock(self._peer)
        self._clock.waits = True
        self._interrupted = False
        self._met = False
        """Whether an autopilot was heard: what depends on it exists from then on."""
        # the newest state that was not answered yet, with its arrival
        self._pending: VehicleState | None = None
        self._pending_wall_ns = 0
        self._skipped = 0
        self._lost = 0
        self._last_state: VehicleState | None = None
        self._last_state_s = 0.0
        self._last_arrival_ns = 0
        self._sent_us: int | None = None
        """Stamp of the last state that a setpoint went out for."""
        self._coasted = False
        self._timed: Timed | None = None
        self._reflex: Reflex | None = None
        """Answers ordinary states; None where the step is not compiled."""
        self._reflexed = False
        """Whether this turn has answered a state by reflex."""
        self._unaccounted: FlownStep | None = None
        self._engagement: Engagement | None = None
        self._delays_told = 0
        self._sent_ns = 0
        self._streams: Streams | None = None
        """Once it is known whether the vehicle waits."""
        self._asked_ns: int | None = None
        """The vehicle's time when it last asked for our answer in lockstep [ns]; None elsewhere."""
        self._watch = Watch(flight, self._tracker, self._autopilot, notify)
        self._accounting = self._accounts(flight)
        self._heartbeat_s = -math.inf
        self._requests: list[tuple[Timesync, Frame]] = []
        self._turned_ns = self._begun_ns = self._heard_ns = self._spoken_ns = time.monotonic_ns()
        self._known_ns: int | None = None

    # -- from outside ---------------------------------------------------------------------------------------------

    def interrupt(self) -> None:
        """Asks for the hand-over to Hold; safe to call from a signal handler."""
        self._interrupted = True

    def order(self, order: Order) -> str:
        """Takes an operator's order; returns "" or why it cannot be followed."""
        return self._sequence.orders.give(order) if self._met else "the flight has not begun"

    def retune(self, change: ParameterChange) -> str:
        """Takes a change of the parameters; returns "" or why it cannot be followed."""
        if self._retuning is None:
            return ""
        if self.phase in {Phase.CONNECT, Phase.PREFLIGHT}:  # the loop is measured, and may ask for other gains
            return "the flight is being prepared; try again in a moment"
        if self._adaptation is not None:
            # The ground judges a change over the loop of the vehicle file, and these gains were judged over another.
            return (
                f"this flight has {self._adaptation.gains_share:.0%} of the gains, certified for a loop that is worse"
                " than the vehicle file says; nothing of them changes in it"
            )
        return self._retuning.want(change)

    @property
    def phase(self) -> Phase:
        """Where in the flight it is."""
        return self._sequence.phase if self._met else Phase.CONNECT

    @property
    def paused(self) -> bool:
        """Whether the reference is at rest for a pause."""
        return self._met and self._sequence.orders.resting

    @property
    def autopilot(self) -> Autopilot:
        """What the autopilot has said of itself."""
        return self._autopilot

    @property
    def preflight(self) -> Preflight | None:
        """What the gates found; None while no autopilot was heard."""
        return self._sequence.preflight if self._met else None

    @property
    def version(self) -> AutopilotVersion | None:
        """The autopilot's, once it has told."""
        return self._ops.version if self._met else None

    def run(self) -> Outcome:
        """Flies. Returns how it ended; never raises for anything that the vehicle, the link or the law does."""
        fault = ""
        gc.collect()
        gc.freeze()
        gc.disable()  # a collection would stop the loop for 14 to 92 ms
        try:
            cause, detail = self._fly()
        except KeyboardInterrupt:
            cause, detail = Cause.INTERRUPTED, ""
        except Exception as error:
            cause, detail, fault = Cause.FAULT, f"{type(error).__name__}: {error}", traceback.format_exc()
        try:
            detail = self._leave(detail)
            if self._streams is not None:
                self._streams.leave(self._wire, self._ops.target_system, AUTOPILOT_COMPONENT)
        finally:
            gc.enable()
            gc.unfreeze()
        if not self._met:
            return Outcome(cause, detail, [], 0, {}, fault)
        rejected = {reason.name: n for reason, n in self._telemetry.rejected.items() if n}
        read = dict(self._autopilot.parameters)
        self._keep_changes(ended=True)
        figures = self._watch.delay_figures() if self._engagement is not None else {}
        return Outcome(
            *(cause, detail, self._sequence.changes, self._lost, rejected, fault, read, self._engagement, figures),
            vehicle=vehicle_facts(self._autopilot, self._ops.version) | self._scale_fact(),
        )

    def _scale_fact(self) -> dict[str, float]:
        """What the thrust was found to be, over what the vehicle file says, where that is followed; and how many states
        an attitude newer than they refreshed."""
        if not isinstance(self._tracker, Tracker):
            return {}
        scale = self._tracker.thrust_scale
        return {"refreshed_states": float(self._tracker.refreshed)} | ({} if scale is None else {"thrust_scale": scale})

    def _fly(self) -> tuple[Cause, str]:
        try:
            self._meet()
            while True:
                self._turn()
        except FlightEnded as ended:
            return ended.cause, ended.detail
        except LinkError as error:
            return Cause.LINK_LOST, str(error)

    def _leave(self, detail: str) -> str:
        """However it ended: a vehicle that may still be following setpoints gets the coast setpoint and Hold."""
        self._wire.at_once = None
        with contextlib.suppress(Exception):  # the last step's row
            self._account()
        if not self._met or not self._sequence.owes_hold:
            return detail
        with contextlib.suppress(Exception):  # what failed may fail again; Hold is asked for all the same
            self._coast()
            self._answer_requests()  # a vehicle in lockstep waits
        self._sequence.duty = Duty.NOTHING
        taken = ask_for_hold(self._wire, self._ops.target_system)
        how = "handed over to Hold" if taken else "Hold was not acknowledged, the autopilot's own failsafe acts"
        return f"{detail}; {how}".lstrip("; ")

    # -- connecting -----------------------------------------------------------------------------------------------

    def _meet(self) -> None:
        """Waits for the autopilot's heartbeat.

        Raises:
            FlightEnded: none came.
        """
        self._begun_ns = time.monotonic_ns()
        system = self._system
        if system is None:
            system = find_autopilot(self._wire, self._connection, self._connect_timeout_s, lambda: self._interrupted)
        self._tell_met(system)
        self._heard_ns = self._spoken_ns = time.monotonic_ns()
        self._telemetry = Telemetry(system)
        self._ops = Operations(self._wire.send, system)
        self._sender = SetpointSender(self._wire.send, system)
        self._sequence = Sequence(
            *(self._flight, self._trajectory, self._ops, self._autopilot, self._engage, self._notify),
            only_gates=self._only_gates,
            waits=lambda: self._peer.paced,
            adapt=self._adapt,
        )
        self._met = True
        if self._compiled.engine == "numba":
            self._reflex = Reflex(system, (self._wire.system_id, self._wire.component_id))
            self._wire.at_once = self._use_at_once

    def _adapt(self, adaptation: Adaptation) -> None:
        """The loop as it was measured asks for other setpoints or gains: all that flies is made anew, on the ground or
        while the autopilot holds."""
        self._adaptation = adaptation
        self._flight = flight = adapted(self._flight, adaptation)
        self._tracker = controller_of(flight, self._compiled, self._autopilot, self._notify)
        self._retuning = Retuning(self._tracker, self._notify) if isinstance(self._tracker, Tracker) else None
        offset = self._watch.offset
        self._watch = Watch(flight, self._tracker, self._autopilot, self._notify)
        self._watch.offset = offset
        self._accounting = self._accounts(flight)
        self._silence_s = silence_limit_s(flight.vehicle.link.state_rate_hz)

    def _accounts(self, flight: Flight) -> Accounting:
        parts = (flight, self._record, self._watch, self._autopilot, self._peer, self._clock, self._progress)
        return Accounting(*parts, engine=self._compiled.engine)

    def _begin(self) -> bool:
        """Begins the flight once the vehicle's time is known, and whether it waits for us."""
        if not self._clock.known:
            return False
        wall_ns = time.monotonic_ns()
        if self._known_ns is None:
            self._known_ns = wall_ns
        undecided = self._telemetry.accepted < PACE_STATES and wall_ns - self._known_ns < PACE_WALL_S * 1e9
        if undecided and not self._peer.paced:
            return False
        self._clock.waits = False
        now_s = self._clock.now_s(wall_ns)
        self._heartbeat_s = self._last_state_s = now_s
        self._last_arrival_ns = wall_ns
        in_lockstep = ", in lockstep" if self._peer.paced else ""
        peer = f"system {self._ops.target_system}{in_lockstep}"
        self._sequence.enter(Phase.CONNECT, now_s, f"heard the autopilot ({peer})")
        self._sequence.enter(Phase.PREFLIGHT, now_s, "asking for rates, version and parameters")
        self._paced(self._peer.paced)
        paced = self._peer.paced
        exclusive = self._flight.vehicle.link.exclusive and isinstance(self._host, Alone)
        self._streams = Streams(exclusive=exclusive, paced=paced, predicts=isinstance(self._tracker, Tracker))
        self._sequence.preflight.streams = self._streams.intervals_us
        return True

    # -- one turn -------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._turned_ns = time.monotonic_ns()
        spin_s = LOCKSTEP_SPIN_S if self._peer.paced else 0.0
        hurries_for = frozenset[int]() if self._peer.paced else FLOWN_ON
        for frame in self._wire.receive(self._wait_s(), spin_s, until=hurries_for):
            self._on_frame(frame)
        if not self._peer.paced:
            self._answer_state()
            self._tick()
        elif self._reflexed:
            self._account()
            self._tick()
        self._reflexed = False
        if self._requests:
            self._answer_requests()
        self._account()
        self._host.turn()
        self._look_at_the_wall_clock()

    def _wait_s(self) -> float:
        """How long to wait for the link: while states are answered, until they would have ceased."""
        sequence = self._sequence
        if self._peer.paced or (sequence.duty is Duty.NOTHING and sequence.ending is None):
            return IDLE_WAIT_S
        if sequence.duty is not Duty.TRACK or sequence.ending is not None:
            return BUSY_WAIT_S
        silent_s = (self._turned_ns - self._last_arrival_ns) * 1e-9
        return min(max(self._silence_s - silent_s + WAIT_STEP_S, WAIT_STEP_S), IDLE_WAIT_S)

    def _look_at_the_wall_clock(self) -> None:
        """What does not wait for the vehicle's time: the operator's wish, and a vehicle that says nothing more."""
        wall_ns = time.monotonic_ns()
        if not self._sequence.changes:
            if self._interrupted:
                raise FlightEnded(Cause.INTERRUPTED, "before anything was asked of the vehicle")
            if wall_ns - self._begun_ns > self._connect_timeout_s * 1e9:
                raise FlightEnded(Cause.NO_VEHICLE, explain_no_time(self._connection, self._connect_timeout_s))
            if wall_ns - self._spoken_ns > HEARTBEAT_INTERVAL_S * 1e9:
                self._spoken_ns = wall_ns
                send_heartbeat(self._wire)
            return
        if self._interrupted:
            self._sequence.interrupt(self._clock.now_s(wall_ns))
        limit_s = PACED_SILENCE_S if self._peer.paced else LINK_SILENCE_S
        if wall_ns - self._heard_ns > limit_s * 1e9:
            raise FlightEnded(Cause.LINK_LOST, f"no message for {limit_s:g} s")

    def _on_frame(self, frame: Frame) -> None:
        msgid = frame.msgid
        if frame.sysid != self._ops.target_system or frame.compid != AUTOPILOT_COMPONENT:
            self._wire.counters.other_system += 1
            self._host.on_frame(frame)
            return
        self._heard_ns = frame.arrival_wall_ns
        if msgid == codec.ODOMETRY:
            self._on_odometry(frame)
        elif msgid == codec.TIMESYNC:
            self._on_timesync(frame)
        elif msgid == codec.ATTITUDE_QUATERNION and isinstance(self._tracker, Tracker):
            self._on_attitude(frame, self._tracker)
        else:
            if msgid == codec.HEARTBEAT:
                take_heartbeat(self._autopilot, frame)
            elif not self._ops.on_frame(frame, self._clock.now_s(frame.arrival_wall_ns)):
                take_report(self._autopilot, frame)
            self._host.on_frame(frame)

    def _on_odometry(self, frame: Frame) -> None:
        state = self._telemetry.on_odometry(frame)
        if isinstance(state, StateRejection):
            if state is StateRejection.REBOOTED:
                raise FlightEnded(Cause.REBOOTED, state.sentence)
            self._sequence.preflight.meter.on_rejection(state)
            if self._telemetry.rejected[state] == 1:
                self._notify(f"a state was not used: {state.sentence}")
            return
        if self._pending is not None:
            self._skipped += 1
        self._pending = state
        self._pending_wall_ns = frame.arrival_wall_ns
        self._peer.on_state(state.t_vehicle_us)
        self._clock.on_state(state.t_vehicle_us, frame.arrival_wall_ns)
        if self._streams is not None:
            now_s = self._clock.now_s(frame.arrival_wall_ns)
            self._streams.on_state(state.t_vehicle_us, frame.arrival_wall_ns, self._ops, now_s)
        meter = self._sequence.preflight.meter
        if meter.running:
            meter.on_state(state, self._clock.now_s(frame.arrival_wall_ns), paced=self._peer.paced)

    def _on_attitude(self, frame: Frame, tracker: Tracker) -> None:
        """One that is newer than the state which is answered next refreshes the prediction, and asks for no answer."""
        sample = self._telemetry.on_attitude(frame)
        if not (self._peer.paced or isinstance(sample, StateRejection)):
            if self._streams is not None:
                self._streams.on_attitude(sample.t_vehicle_us, frame.arrival_wall_ns)
            tracker.refresh(Attitude(sample.t_vehicle_us * 1e-6, sample.q, sample.w))

    def _on_timesync(self, frame: Frame) -> None:
        """A request is answered after the setpoint for the state that came before it."""
        message = codec.decode_timesync(frame.payload)
        if not timesync.is_request(message, self._wire.system_id, self._wire.component_id):
            self._on_time_told(message, frame.arrival_wall_ns)
            return
        self._peer.on_request(message.ts1)
        self._clock.on_timesync(message.ts1, frame.arrival_wall_ns)
        self._requests.append((message, frame))
        if self._peer.paced:
            self._asked_ns = message.ts1
            self._sequence.preflight.meter.on_paced_request(message.ts1)
            self._wire.gather()
            try:
                self._answer_state()
                self._answer_requests()
            finally:
                self._wire.release()
            # The vehicle moves on now: what can wait is done meanwhile, and what it sends counts at the next state.
            self._sent_ns = time.monotonic_ns()
            self._account()
            self._tick()

    def _on_time_told(self, message: Timesync, wall_ns: int) -> None:
        """An answer to a request of ours."""
        if timesync.is_response(message, self._wire.system_id, self._wire.component_id):
            if self._watch.offset.on_answer(message, wall_ns) and self._engagement is None:
                self._watch.offset.settle()
            self._sequence.preflight.meter.on_answer(message, self._clock.now_s(wall_ns))

    def _answer_requests(self) -> None:
        wire = self._wire
        for message, frame in self._requests:
            answer = timesync.answer(message, time.monotonic_ns(), frame.sysid, frame.compid)
            wire.send(codec.TIMESYNC, answer)
        self._requests.clear()

    def _tick(self) -> None:
        """What time alone brings: heartbeat, requests, phases, silence."""
        sequence = self._sequence
        if not sequence.changes and not self._begin():
            return
        wall_ns = time.monotonic_ns()
        now_s = self._clock.now_s(wall_ns)
        if now_s - self._heartbeat_s >= HEARTBEAT_INTERVAL_S:
            self._heartbeat_s = now_s
            send_heartbeat(self._wire)
        if self._peer.paced:
            silent_s, away = now_s - self._last_state_s, False
        else:
            if self._watch.asks_time(wall_ns):
                self._ops.ask_time(wall_ns)
            # A better estimate of the vehicle's clock is no silence: only in lockstep it is judged by its own time.
            silent_s = (wall_ns - self._last_arrival_ns) * 1e-9
            away = wall_ns - self._turned_ns > AWAY_NS  # then states wait to be read: look first
        if silent_s > self._silence_s and not away and sequence.duty is not Duty.NOTHING:
            self._stop_answering(Cause.STATE_LOST, f"none for {self._silence_s * 1e3:.0f} ms", now_s)
        sequence.tick(now_s)

    def _stop_answering(self, cause: Cause, detail: str, now_s: float) -> None:
        """The one coast setpoint, then none any more, and Hold."""
        self._coast()
        self._sequence.duty = Duty.NOTHING
        self._sequence.end(cause, detail, now_s)

    # -- the control step -----------------------------------------------------------------------------------------

    def _answer_state(self) -> None:
        """Answers the newest state, if there is one, with the setpoint that is due."""
        state = self._pending
        if state is None:
            return
        self._pending = None
        skipped, self._skipped = self._skipped, 0
        sequence, arrival_ns = self._sequence, self._pending_wall_ns
        now_s = self._clock.now_s(arrival_ns)
        before, self._last_state = self._last_state, state
        self._last_state_s, self._last_arrival_ns = now_s, arrival_ns
        sequence.on_state(state, now_s)
        if sequence.duty is Duty.NOTHING:
            if sequence.phase is Phase.JOIN:  # it holds after a climb of ours: what was sent before has ended
                self._sent_us = None
            return
        if before is not None and before.reset_counter != state.reset_counter and not self._carry(state, now_s):
            return
        if self._silent_too_long(state):
            assert self._sent_us is not None
            sequence.duty = Duty.NOTHING
            detail = f"none for {(state.t_vehicle_us - self._sent_us) * 1e-6:.2f} s of vehicle time"
            sequence.end(Cause.OWN_SILENCE, detail, now_s)
        elif sequence.duty is Duty.TRACK:
            self._lost += skipped
            self._track(state, skipped, arrival_ns)
        elif sequence.duty is Duty.STREAM:
            self._stream(state)
        else:
            assert sequence.climb is not None
            self._send(sequence.climb.setpoint(state.t_vehicle_us * 1e-6), state)

    def _carry(self, state: VehicleState, now_s: float) -> bool:
        """The autopilot's estimate was reset: the reference moves along. False: by too much, the flight ends."""
        course = self._sequence.course
        problem = "during the take-off" if course is None else self._watch.on_reset(state, course)
        if problem:
            detail = f"{problem}, reset counter {state.reset_counter}"
            self._stop_answering(Cause.ESTIMATE_JUMPED, detail, now_s)
        return not problem

    def _silent_too_long(self, state: VehicleState) -> bool:
        """After more than half of COM_OF_LOSS_T PX4 may be about to leave OFFBOARD, and would come back at the next
        setpoint."""
        return self._sent_us is not None and state.t_vehicle_us - self._sent_us > self._own_silence_us()

    def _own_silence_us(self) -> int:
        """Half of COM_OF_LOSS_T."""
        half_us = 0.5e6 * self._autopilot.parameters.get("COM_OF_LOSS_T", OFFBOARD_LOSS_S)
        return int(half_us) if 0.0 <= half_us < 1e12 else int(0.5e6 * OFFBOARD_LOSS_S)

    def _stream(self, state: VehicleState) -> None:
        """A hold setpoint for where the vehicle is; nothing integrates while the autopilot does not follow."""
        now = State(state.p, state.v, state.q, state.w)
        self._tracker.begin(now)
        hold = at_rest(state.p, yaw_from_quat(state.q))
        self._send(self._tracker.command(state.t_vehicle_us * 1e-6, now, lambda t: hold), state)

    def _engage(self, state: VehicleState) -> None:
        """OFFBOARD is confirmed: the controller starts from the hover."""
        thrust_n = hover_thrust_n(self._autopilot, self._flight.vehicle, state.q)
        self._tracker.begin(State(state.p, state.v, state.q, state.w), thrust_n)
        course = self._sequence.course
        assert course is not None
        begin_s = self._sequence.engaged_at_s
        self._watch.begin()
        where = course.hold_point, course.yaw_rad, course.home
        self._engagement = Engagement(
            begin_s, *where, state.q, thrust_n, adaptation=self._adaptation, origin_m=course.origin
        )
        self._engaged(self._engagement)
        if self._streams is not None:
            self._streams.on_engaged(self._ops, self._last_state_s)

    def _keep_changes(self, *, ended: bool = False) -> None:
        """Notes and tells how the course's pace, the law's parameters and the delay were changed.

        Delays become thousands in a long flight: on the way only the new ones are told.
        """
        engagement, course = self._engagement, self._sequence.course
        if engagement is None or course is None:
            return
        law = self._tracker if isinstance(self._tracker, Tracker) else None
        ways, delays = ((), []) if law is None else (tuple(law.transitions), law.delays)
        resets = tuple(self._watch.resets.carried)
        new = delays[self._delays_told :]
        if new:
            self._delays_told = len(delays)
            self._delayed(new)
        before = engagement.ramps, len(engagement.transitions), len(engagement.resets)
        if before != (course.ramps, len(ways), len(resets)) or (ended and delays):
            known = tuple(delays) if ended else ()
            self._engagement = replace(engagement, ramps=course.ramps, transitions=ways, resets=resets, delays=known)
            self._engaged(self._engagement)

    def _track(self, state: VehicleState, skipped: int, arrival_ns: int) -> None:
        sequence = self._sequence
        assert sequence.course is not None
        course, begin_s = sequence.course, sequence.engaged_at_s
        stamp_s = state.t_vehicle_us * 1e-6
        now = State(state.p, state.v, state.q, state.w)
        if not self._send(self._tracker.command(stamp_s, now, self._reference(course, begin_s)), state):
            self._lost += 1
            return
        self._sent_ns = time.monotonic_ns()
        if not self._peer.paced:
            realtime.make_way()
        self._flown(state, self._tracker.last_step(), skipped, arrival_ns)

    def _use_at_once(self, datagrams: list[Datagram]) -> int:
        """Uses what has come as far as it is attitudes and one ordinary state, which is answered; how many it was."""
        tracker = self._tracker
        if self._sequence.duty is not Duty.TRACK or not isinstance(tracker, Tracker):
            return 0
        used = self._use_attitudes(datagrams, 0, tracker)
        if used == len(datagrams):
            return used
        newest_us = -1
        for datagram in datagrams[used + 1 :]:  # what came behind a state may be newer than it
            frame = self._attitude_in(datagram)
            if frame is None or self._peer.paced:
                return used
            sample = self._telemetry.read_attitude(frame)
            if not isinstance(sample, StateRejection) and sample.t_vehicle_us > newest_us:
                newest_us = sample.t_vehicle_us
                tracker.refresh(Attitude(newest_us * 1e-6, sample.q, sample.w))
        if not self._answer_at_once(datagrams[used][0], datagrams[used][2], tracker):
            return used
        return self._use_attitudes(datagrams, used + 1, tracker)

    def _attitude_in(self, datagram: Datagram) -> Frame | None:
        """The autopilot's ATTITUDE_QUATERNION that is all of a datagram; None where it is anything else."""
        if datagram[0][_MSGID_AT : _MSGID_AT + 1] != _ATTITUDE_LOW:
            return None
        frame = self._wire.look(datagram)
        if frame is None or frame.msgid != codec.ATTITUDE_QUATERNION:
            return None
        return frame if (frame.sysid, frame.compid) == (self._ops.target_system, AUTOPILOT_COMPONENT) else None

    def _use_attitudes(self, datagrams: list[Datagram], begin: int, tracker: Tracker) -> int:
        """Uses the attitudes from a place on, none of them lost; returns where they end."""
        for i in range(begin, len(datagrams)):
            frame = self._attitude_in(datagrams[i])
            if frame is None or frame.seq != self._wire.due(frame.sysid, frame.compid)[0]:
                return i
            self._wire.took(frame.raw, frame.arrival_wall_ns, (frame.sysid, frame.compid), 1)
            self._heard_ns = frame.arrival_wall_ns
            self._on_attitude(frame, tracker)
        return len(datagrams)

    def _answer_at_once(self, datagram: bytes, wall_ns: int, tracker: Tracker) -> bool:
        """Answers a datagram with an ordinary state by reflex; False: it is to take the usual way."""
        sequence, telemetry, timed = self._sequence, self._telemetry, self._timed
        last, last_us, sent_us, before = self._last_state, telemetry.last_t_vehicle_us, self._sent_us, telemetry.numbers
        if timed is None or last is None or last_us is None or sent_us is None or before is None:
            return False
        if not telemetry.sound or self._pending is not None or self._requests or sequence.preflight.meter.running:
            return False
        if timed.course is not sequence.course or timed.begin_s != sequence.engaged_at_s or not self._peer.settled:
            return False
        reflex, system, paced = self._reflex, self._ops.target_system, self._peer.paced
        assert reflex is not None
        asked_us = self._peer.asked_us if paced else -1
        if asked_us is None or (paced and asked_us < 0):
            return False
        given = (*self._wire.due(system, AUTOPILOT_COMPONENT), time.monotonic_ns(), last_us, sent_us, asked_us)
        if not reflex.take(datagram, (*given, last.reset_counter, self._own_silence_us()), before):
            return False
        code = tracker.answer(reflex, timed)
        if code == DECLINED:
            return False
        frames = reflex.output if code == ANSWERED else None
        sender = system, AUTOPILOT_COMPONENT
        sent = self._wire.answer(datagram, wall_ns, sender, 2 if paced else 1, frames)
        self._sent_ns = time.monotonic_ns()
        if not paced:
            realtime.make_way()
        self._reflexed = True
        state = self._take_over(reflex, tracker, wall_ns)
        if sent:
            self._sent_us = state.t_vehicle_us
            self._sender.sent += 1
            self._flown(state, None, 0, wall_ns)
            return True
        self._lost += 1
        if frames is None:
            self._send(tracker.last_step().setpoint, state)  # which says what is wrong with it, and ends the flight
            if paced:
                request = Timesync(0, reflex.asked_ns, 0, 0)
                self._wire.send(codec.TIMESYNC, timesync.answer(request, time.monotonic_ns(), *sender))
        return True

    def _take_over(self, reflex: Reflex, tracker: Tracker, wall_ns: int) -> VehicleState:
        """What was answered by reflex becomes known, in the order of the usual way."""
        sequence, peer, clock = self._sequence, self._peer, self._clock
        state, numbers = reflex.told()
        self._heard_ns = wall_ns
        self._telemetry.took(state.t_vehicle_us, numbers)
        paced = peer.paced
        peer.on_state(state.t_vehicle_us)
        clock.on_state(state.t_vehicle_us, wall_ns)
        if paced:
            self._asked_ns = asked_ns = reflex.asked_ns
            peer.on_request(asked_ns)
            clock.on_timesync(asked_ns, wall_ns)
        now_s = clock.now_s(wall_ns)
        if self._streams is not None:
            self._streams.on_state(state.t_vehicle_us, wall_ns, self._ops, now_s)
        self._last_state, self._last_state_s, self._last_arrival_ns = state, now_s, wall_ns
        sequence.on_state(state, now_s)
        tracker.answered(state.t_vehicle_us * 1e-6, new_record(State, state[1:5]))
        return state

    def _flown(self, state: VehicleState, out: TrackerStep | None, skipped: int, arrival_ns: int) -> None:
        """A setpoint is out; what it came from is accounted for later."""
        sequence = self._sequence
        assert sequence.course is not None
        course, stamp_s = sequence.course, state.t_vehicle_us * 1e-6
        step = (state, out, course, stamp_s - sequence.engaged_at_s, sequence.phase, sequence.track_time_s(stamp_s))
        self._unaccounted = new_record(FlownStep, (*step, skipped, arrival_ns))

    def _reference(self, course: Course, begin_s: float) -> Timed:
        """The course on the vehicle's clock; the same as long as neither changes."""
        timed = self._timed
        if timed is None or timed.course is not course or timed.begin_s != begin_s:
            timed = self._timed = Timed(course, begin_s)
        return timed

    def _account(self) -> None:
        """Records and judges the last step: after its setpoint is out, and while a vehicle in lockstep moves on."""
        self._wire.tell()  # the log wants a step's traffic before its row
        step, self._unaccounted = self._unaccounted, None
        if step is None:
            return
        if self._retuning is not None:
            self._retuning.tick()
        if step.out is None:
            assert self._reflex is not None and isinstance(self._tracker, Tracker)
            times = self._sent_ns, self._asked_ns, self._last_state_s
            if self._accounting.reckon(step, self._reflex.numbers, self._tracker.memory, *times):
                return
            step = step._replace(out=self._tracker.last_step())
        measured = self._accounting.measure(step, self._sent_ns, self._asked_ns)
        finding = self._accounting.settle(step, measured, self._last_state_s)
        if finding is not None:
            respond(self._sequence, finding, self._last_state_s)
        if self._accounting.show(step, measured, self._sent_ns):
            self._keep_changes()

    def _send(self, setpoint: Setpoint, state: VehicleState) -> bool:
        try:
            sent = self._sender.send(setpoint, state.t_vehicle_us)
        except UnsendableSetpoint as error:
            self._stop_answering(Cause.UNSENDABLE, str(error), self._clock.now_s(time.monotonic_ns()))
            return False
        if sent:
            self._sent_us = state.t_vehicle_us
        return sent

    def _coast(self) -> None:
        """The one setpoint without a fresh state."""
        state = self._last_state
        if self._coasted or state is None or self._sequence.duty is Duty.NOTHING:
            return
        self._coasted = True
        if self._sequence.duty is Duty.CLIMB:
            self._send(PositionSetpoint(None, (0.0, 0.0, 0.0), None, None, None), state)
            return
        hover = self._tracker.hover_share if isinstance(self._tracker, Calibrator) else None
        scale = self._tracker.thrust_scale if isinstance(self._tracker, Tracker) else None
        self._send(coast_setpoint(self._flight, state.q, hover, scale), state)


__all__ = ["FlightLoop", "Progress"]
