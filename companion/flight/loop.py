"""The control loop: one thread, one link, driven by the vehicle's states.

A turn waits for the link, drains it, answers the newest state with a setpoint, and answers TIMESYNC requests after
that. A vehicle in lockstep (its clock waits for those answers, DESIGN "Lockstep") gets exactly one turn per state, so
the same seed gives the same flight. Nothing is sent that is not computed from a fresh state, except the one coast
setpoint when states cease.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.config import Flight
from companion.control.output import ActuatorSetpoint, AttitudeSetpoint, RateSetpoint, Setpoint, thrust_fraction
from companion.control.types import GRAVITY_M_S2, State
from companion.control.vectors import axes
from companion.errors import LinkError
from companion.flight.clock import VehicleClock
from companion.flight.course import at_rest
from companion.flight.phases import PHASE_INDEX, PHASE_NAMES, Autopilot, Cause, FlightEnded, LandedState, Outcome, Phase
from companion.flight.preflight import CURRENT_MODE, EXTENDED_SYS_STATE, HOME_POSITION
from companion.flight.sequence import Duty, Sequence
from companion.flight.tracker import Kernels, Tracker, TrackerStep
from companion.frames import tilt_from_quat, yaw_from_quat
from companion.link import codec, timesync
from companion.link.framing import Frame
from companion.link.modes import Mode
from companion.link.operations import Operations
from companion.link.setpoint import SetpointSender, UnsendableSetpoint
from companion.link.telemetry import StateRejection, Telemetry, VehicleState
from companion.link.timesync import PacedPeer
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.anchored import Trajectory

SILENCE_MIN_S = 0.05
"""A state may be late by three of its periods, and by this at least: at 250 Hz three periods are 12 ms, which a busy
machine takes for itself now and then; the prediction bridges that, and PX4 holds the last rates no longer than this."""
SILENT_PERIODS = 3.0
PACED_SILENCE_S = 5.0
"""Wall time after which a vehicle in lockstep, whose clock stands still while it is silent, counts as lost."""
HEARTBEAT_INTERVAL_S = 1.0
LATE_SHARE = 0.2
TILT_FOR_S = 0.2
AUTOPILOT_COMPONENT = 1
IDLE_WAIT_S = 0.1


class Progress(NamedTuple):
    """What a display may show of a running flight."""

    phase: str
    t_s: float
    """Time on the trajectory [s], negative before."""
    duration_s: float
    error_m: float
    steps: int


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
    ) -> None:
        self._flight = flight
        self._trajectory = trajectory
        self._wire = wire
        self._record = record
        self._notify = notify
        self._progress = progress
        self._connect_timeout_s = connect_timeout_s
        self._tracker = Tracker(flight.vehicle, flight.output.kind, compiled)
        self._interval_s = 1.0 / flight.vehicle.link.state_rate_hz
        self._late_ns = int(LATE_SHARE * self._interval_s * 1e9)
        self._silence_s = max(SILENT_PERIODS * self._interval_s, SILENCE_MIN_S)
        self._peer = PacedPeer()
        self._clock = VehicleClock(self._peer)
        self._autopilot = Autopilot()
        self._interrupted = False
        # known once an autopilot was heard
        self._telemetry: Telemetry | None = None
        self._ops: Operations | None = None
        self._sender: SetpointSender | None = None
        self._sequence: Sequence | None = None
        # the newest state that was not answered yet, with its arrival
        self._pending: VehicleState | None = None
        self._pending_wall_ns = 0
        self._skipped = 0
        self._lost = 0
        self._last_state: VehicleState | None = None
        self._last_state_s = 0.0
        self._coasted = False
        self._tilted_since_s: float | None = None
        self._heartbeat_s = -math.inf
        self._progress_ns = 0
        self._timesync_at_ns: int | None = None

    # -- from outside ---------------------------------------------------------------------------------------------

    def interrupt(self) -> None:
        """Asks for the hand-over to Hold; safe to call from a signal handler."""
        self._interrupted = True

    def run(self) -> Outcome:
        """Flies. Returns how it ended; never raises for anything that the vehicle or the link does."""
        cause, detail = Cause.LINK_LOST, ""
        try:
            self._connect()
            while True:
                self._turn()
        except FlightEnded as ended:
            cause, detail = ended.cause, ended.detail
        except LinkError as error:
            cause, detail = Cause.LINK_LOST, str(error)
        finally:
            gc.enable()
        sequence = self._sequence
        rejected = {} if self._telemetry is None else {r.name: n for r, n in self._telemetry.rejected.items() if n}
        return Outcome(cause, detail, [] if sequence is None else sequence.changes, self._lost, rejected)

    # -- connecting -----------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        """Waits for an autopilot's heartbeat and its time; answers with a heartbeat of its own.

        Raises:
            FlightEnded: none came.
        """
        deadline_ns = time.monotonic_ns() + int(self._connect_timeout_s * 1e9)
        heard_ns: int | None = None
        while True:
            wall_ns = time.monotonic_ns()
            if self._interrupted:
                raise FlightEnded(Cause.INTERRUPTED, "before a vehicle was found")
            if wall_ns > deadline_ns:
                raise FlightEnded(Cause.NO_VEHICLE, self._explain_silence(heard_ns is not None))
            for frame in self._wire.receive(IDLE_WAIT_S):
                if self._ops is None and frame.msgid == codec.HEARTBEAT:
                    self._meet(frame)
                if self._ops is not None:
                    self._on_frame(frame)
            if self._ops is not None and (heard_ns is None or wall_ns - heard_ns > 1_000_000_000):
                heard_ns = wall_ns
                self._send_heartbeat()
            if self._ops is not None and self._clock.known:
                now_s = self._clock.now_s(time.monotonic_ns())
                self._heartbeat_s = now_s
                self._last_state_s = now_s
                assert self._sequence is not None
                peer = f"system {self._ops.target_system}"
                self._sequence.enter(Phase.CONNECT, now_s, f"heard the autopilot ({peer})")
                self._sequence.enter(Phase.PREFLIGHT, now_s, "asking for rates, version and parameters")
                self._sequence.tick(now_s)
                return

    def _meet(self, frame: Frame) -> None:
        heartbeat = codec.decode_heartbeat(frame.payload)
        if frame.compid != AUTOPILOT_COMPONENT or heartbeat.autopilot == codec.MAV_AUTOPILOT_INVALID:
            return
        system = frame.sysid
        self._wire.system_id = system
        self._telemetry = Telemetry(system)
        self._ops = Operations(self._wire.send, system)
        self._sender = SetpointSender(self._wire.send, system)
        self._sequence = Sequence(
            self._flight, self._trajectory, self._ops, self._autopilot, self._engage, self._notify
        )

    def _explain_silence(self, heard: bool) -> str:
        waited = f"within {self._connect_timeout_s:g} s"
        if heard:
            return (
                f"an autopilot's heartbeat came but neither TIMESYNC nor ODOMETRY {waited}: is this its onboard link?"
            )
        c = self._wire.counters
        seen = "nothing came"
        if c.received:
            seen = f"{c.received} MAVLink frames came, none of them an autopilot's heartbeat,"
        return (
            f"{seen} {waited}: check that the vehicle sends to this port (PX4 SITL: 14540; the bundled one: `sim-link"
            " run`) and that no other program holds the vehicle's link"
        )

    # -- one turn -------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        for frame in self._wire.receive(self._wait_s()):
            self._on_frame(frame)
        if not self._peer.paced:
            self._answer_state()
            self._tick()
        elif self._clock.silent_wall_s(time.monotonic_ns()) > PACED_SILENCE_S:
            self._coast()
            raise FlightEnded(Cause.LINK_LOST, f"no message for {PACED_SILENCE_S:g} s")
        if self._interrupted and self._sequence is not None and self._sequence.ending is None:
            self._sequence.end(Cause.INTERRUPTED, "", self._clock.now_s(time.monotonic_ns()))

    def _wait_s(self) -> float:
        assert self._sequence is not None
        if self._peer.paced:
            return IDLE_WAIT_S
        if self._sequence.duty is Duty.NOTHING and self._sequence.ending is None:
            return IDLE_WAIT_S
        return 0.01

    def _on_frame(self, frame: Frame) -> None:
        assert self._ops is not None
        msgid = frame.msgid
        if frame.sysid != self._ops.target_system or frame.compid != AUTOPILOT_COMPONENT:
            return
        if msgid == codec.ODOMETRY:
            self._on_odometry(frame)
        elif msgid == codec.TIMESYNC:
            self._on_timesync(frame)
        elif msgid == codec.HEARTBEAT:
            heartbeat = codec.decode_heartbeat(frame.payload)
            self._autopilot.mode = Mode.from_custom_mode(heartbeat.custom_mode)
            self._autopilot.armed = heartbeat.armed
        elif not self._ops.on_frame(frame, self._clock.now_s(frame.arrival_wall_ns)):
            self._on_cold(frame)

    def _on_cold(self, frame: Frame) -> None:
        if frame.msgid not in {CURRENT_MODE, EXTENDED_SYS_STATE, HOME_POSITION}:
            return
        message: Any = codec.decode_cold(frame)
        if message is None:
            return
        if frame.msgid == CURRENT_MODE:
            self._autopilot.mode = Mode.from_custom_mode(message.custom_mode)
        elif frame.msgid == EXTENDED_SYS_STATE:
            value = message.landed_state
            known = {state.value for state in LandedState}
            self._autopilot.landed = LandedState(value) if value in known else LandedState.UNDEFINED
        elif all(math.isfinite(x) for x in (message.x, message.y, message.z)):
            self._autopilot.home = (message.x, message.y, message.z)
            self._autopilot.home_amsl_m = message.altitude * 1e-3

    def _on_odometry(self, frame: Frame) -> None:
        assert self._telemetry is not None
        state = self._telemetry.on_odometry(frame)
        if isinstance(state, StateRejection):
            if state is StateRejection.REBOOTED:
                raise FlightEnded(Cause.REBOOTED, state.sentence)
            if self._telemetry.rejected[state] == 1:
                self._notify(f"a state was not used: {state.sentence}")
            return
        if self._pending is not None:
            self._skipped += 1
        self._pending = state
        self._pending_wall_ns = frame.arrival_wall_ns
        self._peer.on_state(state.t_vehicle_us)
        self._clock.on_state(state.t_vehicle_us, frame.arrival_wall_ns)

    def _on_timesync(self, frame: Frame) -> None:
        """A request is answered after the setpoint for the state that came before it."""
        assert self._ops is not None
        message = codec.decode_timesync(frame.payload)
        wire = self._wire
        if not timesync.is_request(message, wire.system_id, wire.component_id):
            return
        self._peer.on_request()
        self._clock.on_timesync(message.ts1, frame.arrival_wall_ns)
        if self._peer.paced:
            self._timesync_at_ns = message.ts1
            self._answer_state()
            self._tick()
        wall_ns = time.monotonic_ns()
        wire.send(codec.TIMESYNC, timesync.answer(message, wall_ns, frame.sysid, frame.compid))

    def _tick(self) -> None:
        """What time alone brings: heartbeat, requests, phases, silence."""
        sequence = self._sequence
        if sequence is None or not sequence.changes:
            return
        now_s = self._clock.now_s(time.monotonic_ns())
        if now_s - self._heartbeat_s >= HEARTBEAT_INTERVAL_S:
            self._heartbeat_s = now_s
            self._send_heartbeat()
        if sequence.duty is not Duty.NOTHING and now_s - self._last_state_s > self._silence_s:
            self._coast()
            sequence.duty = Duty.NOTHING
            limit_ms = self._silence_s * 1e3
            sequence.end(Cause.STATE_LOST, f"none for {limit_ms:.0f} ms of vehicle time", now_s)
        sequence.tick(now_s)

    def _send_heartbeat(self) -> None:
        payload = codec.encode_heartbeat(
            codec.MAV_TYPE_ONBOARD_CONTROLLER, codec.MAV_AUTOPILOT_INVALID, 0, 0, codec.MAV_STATE_ACTIVE
        )
        self._wire.send(codec.HEARTBEAT, payload)

    # -- the control step -----------------------------------------------------------------------------------------

    def _answer_state(self) -> None:
        """Answers the newest state, if there is one, with the setpoint that is due."""
        state = self._pending
        sequence = self._sequence
        if state is None or sequence is None:
            return
        self._pending = None
        skipped, self._skipped = self._skipped, 0
        arrival_ns = self._pending_wall_ns
        now_s = self._clock.now_s(arrival_ns)
        before, self._last_state = self._last_state, state
        self._last_state_s = now_s
        sequence.on_state(state, now_s)
        if sequence.duty is Duty.NOTHING:
            return
        if before is not None and before.reset_counter != state.reset_counter and sequence.ending is None:
            moved = math.dist(before.p, state.p)
            sequence.end(Cause.ESTIMATE_JUMPED, f"reset counter {state.reset_counter}, moved by {moved:.2f} m", now_s)
            return
        if sequence.duty is Duty.STREAM:
            self._stream(state)
        else:
            self._lost += skipped
            self._track(state, skipped, arrival_ns)

    def _stream(self, state: VehicleState) -> None:
        """A hold setpoint for where the vehicle is; nothing integrates while the autopilot does not follow."""
        now = State(state.p, state.v, state.q, state.w)
        self._tracker.begin(now)
        hold = at_rest(state.p, yaw_from_quat(state.q))
        self._send(self._tracker.step(state.t_vehicle_us * 1e-6, now, lambda t: hold).setpoint, state)

    def _engage(self, state: VehicleState) -> None:
        """OFFBOARD is confirmed: the controller starts from the hover, the collector stops collecting."""
        self._tracker.begin(State(state.p, state.v, state.q, state.w))
        gc.collect()
        gc.freeze()
        gc.disable()

    def _track(self, state: VehicleState, skipped: int, arrival_ns: int) -> None:
        sequence = self._sequence
        assert sequence is not None and sequence.course is not None
        course, begin_s = sequence.course, sequence.engaged_at_s
        stamp_s = state.t_vehicle_us * 1e-6
        out = self._tracker.step(stamp_s, State(state.p, state.v, state.q, state.w), lambda t: course.at(t - begin_s))
        if not self._send(out.setpoint, state):
            self._lost += 1
            return
        sent_ns = time.monotonic_ns()
        reference = course.at(stamp_s - begin_s)
        error = (state.p[0] - reference.p[0], state.p[1] - reference.p[1], state.p[2] - reference.p[2])
        self._write(state, reference, error, out, skipped, arrival_ns, sent_ns)
        self._guard(state, error, stamp_s)
        if sent_ns - self._progress_ns > 100_000_000:
            self._progress_ns = sent_ns
            t = sequence.track_time_s(stamp_s)
            self._progress(Progress(sequence.phase.value, t, course.track_s, math.hypot(*error), len(self._record)))

    def _send(self, setpoint: Setpoint, state: VehicleState) -> bool:
        assert self._sender is not None and self._sequence is not None
        try:
            return self._sender.send(setpoint, state.t_vehicle_us)
        except UnsendableSetpoint as error:
            self._sequence.end(Cause.UNSENDABLE, str(error), self._clock.now_s(time.monotonic_ns()))
            self._sequence.duty = Duty.NOTHING
            return False

    def _guard(self, state: VehicleState, error: tuple[float, float, float], now_s: float) -> None:
        """The bounds that a flight is ended by."""
        limits = self._flight.vehicle.limits
        sequence = self._sequence
        assert sequence is not None
        size = math.hypot(*error)
        if size > limits.position_error_abort_m:
            detail = f"{size:.2f} m, limit {limits.position_error_abort_m:g} m (limits.position_error_abort_m)"
            sequence.end(Cause.POSITION_ERROR, detail, now_s)
        tilt = tilt_from_quat(state.q)
        if tilt <= limits.tilt_max_rad:
            self._tilted_since_s = None
        elif self._tilted_since_s is None:
            self._tilted_since_s = now_s
        elif now_s - self._tilted_since_s > TILT_FOR_S:
            detail = f"{tilt:.2f} rad for {TILT_FOR_S:g} s, limit {limits.tilt_max_rad:g} rad (limits.tilt_max_rad)"
            sequence.end(Cause.TILT, detail, now_s)

    def _coast(self) -> None:
        """The one setpoint without a fresh state: no rotation, hover thrust over the cosine of the tilt."""
        sequence, state = self._sequence, self._last_state
        if self._coasted or state is None or sequence is None or sequence.duty is Duty.NOTHING:
            return
        self._coasted = True
        vehicle, limits = self._flight.vehicle, self._flight.vehicle.limits
        cosine = max(axes(state.q)[2][2], 0.3)
        thrust_n = min(max(vehicle.body.mass_kg * GRAVITY_M_S2 / cosine, limits.thrust_min_n), limits.thrust_max_n)
        thrust = thrust_fraction(thrust_n, vehicle.thrust_full_n, vehicle.rotors.curve_factor)
        kind = self._flight.output.kind
        setpoint: Setpoint = RateSetpoint(thrust, (0.0, 0.0, 0.0))
        if kind == "attitude":
            setpoint = AttitudeSetpoint(thrust, state.q, 0.0)
        elif kind == "actuators":
            setpoint = ActuatorSetpoint(thrust, (0.0, 0.0, 0.0))
        self._send(setpoint, state)

    def _write(
        self,
        state: VehicleState,
        reference: Any,
        error: tuple[float, float, float],
        out: TrackerStep,
        skipped: int,
        arrival_ns: int,
        sent_ns: int,
    ) -> None:
        """One row of the record (record/columns.py has the order)."""
        sequence = self._sequence
        assert sequence is not None
        stamp_s = state.t_vehicle_us * 1e-6
        track_s = sequence.track_time_s(stamp_s) if sequence.phase is Phase.TRACK else math.nan
        if self._timesync_at_ns is not None:
            age_ms = (self._timesync_at_ns - state.t_vehicle_us * 1000) * 1e-6 + (sent_ns - arrival_ns) * 1e-6
        else:
            age_ms = (self._clock.now_s(sent_ns) - stamp_s) * 1e3
        e, c = out.errors, self._tracker.controller
        took_ns = sent_ns - arrival_ns
        self._record.append(
            (stamp_s, track_s, PHASE_INDEX[sequence.phase], *state.p, *state.v, *state.q, *state.w)
            + (*reference.p, *reference.v, *error, out.heading_error, *e.e1, *e.e2, *e.e3, *e.e4)
            + (self._tracker.lyapunov(e), *c.b_hat, c.thrust, c.thrust_rate, *out.command.tau, *out.command.rates)
            + (out.setpoint.thrust, age_ms, took_ns * 1e-3, float(took_ns > self._late_ns), float(skipped))
            + (float(out.command.limits),)
        )


__all__ = ["PHASE_NAMES", "FlightLoop", "Progress"]
