"""What is done about a control step once its setpoint is out: its row in the record, its judgement, what people see.

Nothing here delays a command: the loop comes here while the vehicle is already acting on the answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.config import Flight
from companion.control import flat
from companion.control.types import Quat, Vec3, new_record
from companion.flight.clock import VehicleClock
from companion.flight.course import Course
from companion.flight.guards import Finding
from companion.flight.phases import PHASE_INDEX, Autopilot, Phase
from companion.flight.reckoning import Reckoner
from companion.flight.rows import StepTiming, control_row
from companion.flight.tracker import Target, TrackerStep
from companion.flight.watch import Seen, Watch
from companion.link.telemetry import VehicleState
from companion.link.timesync import PacedPeer
from companion.record.flight_record import FlightRecord

LATE_SHARE = 0.2
"""Of the states' interval: a setpoint that takes longer is late."""
PROGRESS_NS = 100_000_000


class Progress(NamedTuple):
    """What a display may show of a running flight."""

    phase: str
    t_s: float
    """Time on the trajectory [s], negative before."""
    duration_s: float
    error_m: float
    steps: int
    to_go_s: float
    """Of the whole course, at its own pace."""
    lyapunov: float
    disturbance_m_s2: Vec3
    """As estimated, NED; NaN, as the one before, where the law does not fly."""
    position_m: Vec3
    """As received, NED."""
    attitude: Quat
    """As received."""
    reference_m: Vec3
    """NED."""
    thrust_n: float
    """NaN where the law does not fly."""
    state_age_ms: float
    battery: float | None
    """Share that is left; None: unknown."""


class FlownStep(NamedTuple):
    """A control step whose setpoint is out."""

    state: VehicleState
    out: TrackerStep | None
    """None: it was made by reflex, and nobody has looked at it yet."""
    course: Course
    course_s: float
    """Time since engaging [s]."""
    phase: Phase
    track_s: float
    skipped: int
    """States that were not answered before this one."""
    arrival_ns: int


class Measured(NamedTuple):
    """What is worked out of a step once, for its row, its judgement and the display."""

    target: Target
    """The reference at the state's stamp."""
    error: Vec3
    """Position less reference, NED [m]."""
    timing: StepTiming
    age_s: float | None
    """Of the state at its arrival [s]; None where no clock tells it."""


class Accounting:
    """Keeps the accounts of one flight.

    Args:
        flight: the configuration.
        record: gets one row per step.
        watch: judges the steps.
        autopilot: what it says of itself.
        peer: whether the vehicle waits for us.
        clock: the vehicle's.
        progress: called at most ten times per second of wall time; must not block.
        engine: "python" or "numba".
    """

    def __init__(
        self,
        flight: Flight,
        record: FlightRecord,
        watch: Watch,
        autopilot: Autopilot,
        peer: PacedPeer,
        clock: VehicleClock,
        progress: Callable[[Progress], None],
        engine: str = "python",
    ) -> None:
        self._record, self._watch, self._autopilot = record, watch, autopilot
        self._peer, self._clock = peer, clock
        self._progress = progress
        self._reckoner = None if engine != "numba" else Reckoner()
        self._phase, self._phase_index = Phase.TRACK, PHASE_INDEX[Phase.TRACK]
        self._late_ns = int(LATE_SHARE / flight.vehicle.link.state_rate_hz * 1e9)
        self._shown_ns = 0

    def measure(self, step: FlownStep, sent_ns: int, asked_ns: int | None) -> Measured:
        """Works out how a step went.

        Args:
            step: that was flown.
            sent_ns: when its setpoint went out, `time.monotonic_ns()`.
            asked_ns: the vehicle's time when it asked for our answer in lockstep [ns]; None elsewhere.
        """
        state, took_ns = step.state, sent_ns - step.arrival_ns
        assert step.out is not None
        target = step.out.target
        if target is None:
            reference = step.course.at(step.course_s)
            target = Target(reference.p, reference.v)
        p, d = state.p, target.p
        age_s, sent_age_ms = self._ages(state.t_vehicle_us, step.arrival_ns, sent_ns, asked_ns)
        timing = new_record(StepTiming, (sent_age_ms, took_ns * 1e-3, took_ns > self._late_ns, step.skipped))
        return new_record(Measured, (target, (p[0] - d[0], p[1] - d[1], p[2] - d[2]), timing, age_s))

    def _ages(self, t_us: int, arrival_ns: int, sent_ns: int, asked_ns: int | None) -> tuple[float | None, float]:
        """How old a state was when it arrived [s], None where no clock tells it, and when its answer went out [ms]."""
        if asked_ns is not None:
            age_ns = asked_ns - t_us * 1000
            return age_ns * 1e-9, (age_ns + sent_ns - arrival_ns) * 1e-6
        return self._watch.age_s(t_us, arrival_ns), (self._clock.now_s(sent_ns) - t_us * 1e-6) * 1e3

    def reckon(
        self,
        step: FlownStep,
        z: Any,
        work: tuple[Any, Any] | None,
        sent_ns: int,
        asked_ns: int | None,
        state_s: float,
    ) -> bool:
        """Records a step by reflex, if nothing else is to be done about it; see `flight.reckoning`.

        Args:
            step: that was flown.
            z: of the reflex.
            work: of the step and its curve; None where its reference was not on one.
            sent_ns: when its setpoint went out, `time.monotonic_ns()`.
            asked_ns: the vehicle's time when it asked for our answer in lockstep [ns]; None elsewhere.
            state_s: vehicle time at the arrival of its state [s].
        """
        calm = self._watch.calm(state_s)
        if calm is None or work is None or self._reckoner is None or sent_ns - self._shown_ns > PROGRESS_NS:
            return False
        state, _, _, _, phase, track_s, _, arrival_ns = step
        age_s, sent_age_ms = self._ages(state.t_vehicle_us, arrival_ns, sent_ns, asked_ns)
        took_ns = sent_ns - arrival_ns
        late = took_ns > self._late_ns
        if phase is not self._phase:
            self._phase, self._phase_index = phase, PHASE_INDEX[phase]
        shown_s = track_s if phase is Phase.TRACK else math.nan
        given = (shown_s, self._phase_index, sent_age_ms, took_ns * 1e-3, late, state_s, calm.delay_s, *calm.limits)
        row = self._reckoner.step(z, *work, given, calm.envelope, calm.following)
        if row is None:
            return False
        self._record.append_packed(row)
        self._watch.on_calm_step(age_s, state_s, late=late)
        return True

    def settle(self, step: FlownStep, measured: Measured, state_s: float) -> Finding | None:
        """Records and judges a step; what is to be done about it.

        Args:
            step: that was flown.
            measured: how it went.
            state_s: vehicle time at the arrival of its state [s].
        """
        target, error, timing, age_s = measured
        assert step.out is not None
        shown_s = step.track_s if step.phase is Phase.TRACK else math.nan
        self._record.append(control_row(shown_s, step.phase, step.state, target, error, step.out, timing))
        state, out, course, _, _, _, skipped, arrival_ns = step
        assert out is not None
        seen = new_record(Seen, (state, error, out, skipped, timing.late, age_s, arrival_ns, self._peer.paced))
        return self._watch.on_step(seen, course, state_s)

    def show(self, step: FlownStep, measured: Measured, sent_ns: int) -> bool:
        """Shows people how the flight stands, when it is time for that. Returns whether it was."""
        if sent_ns - self._shown_ns <= PROGRESS_NS:
            return False
        self._shown_ns = sent_ns
        self._progress(self._standing(step, measured))
        return True

    def _standing(self, step: FlownStep, measured: Measured) -> Progress:
        assert step.out is not None
        course, n, state = step.course, step.out.numbers, step.state
        north, east, down = n[flat.B_HAT]
        return Progress(
            phase=step.phase.value,
            t_s=step.track_s,
            duration_s=course.track_s,
            error_m=math.hypot(*measured.error),
            steps=len(self._record),
            to_go_s=max(0.0, course.duration_s - course.course_s(step.course_s)),
            lyapunov=n[flat.LYAPUNOV],
            disturbance_m_s2=(north, east, down),
            position_m=state.p,
            attitude=state.q,
            reference_m=measured.target.p,
            thrust_n=n[flat.TOTAL],
            state_age_ms=measured.timing.age_ms,
            battery=self._autopilot.battery,
        )
