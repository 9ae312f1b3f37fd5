"""One flight without sockets: the controller that flies, against the physics of the bundled vehicle, in one process.

`fly_sampled` runs the very `flight.tracker.Tracker` of the MAVLink loop against `sim_link`'s airframe (rotors, inner
loops, estimator delay and noise); `fly_ideal` is the paper's own setting (`campaign.ideal`). Both give a `Trace`: one
row per control step.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from companion.campaign import ideal
from companion.campaign.whole import simulated
from companion.config import Flight
from companion.control import flat
from companion.control.heading import HeadingState
from companion.control.law import ControllerState
from companion.control.output import ActuatorSetpoint, AttitudeSetpoint, PositionSetpoint, Setpoint
from companion.control.types import GRAVITY_M_S2, Reference, State, Vec3
from companion.errors import InputError, RefusedError
from companion.flight.course import Course, Timed
from companion.flight.engines import Kernels
from companion.flight.phases import PHASE_INDEX, PHASE_NAMES, Phase
from companion.flight.rows import StepTiming, control_row
from companion.flight.tracker import Tracker, TrackerStep
from companion.frames import quat_from_yaw, radians
from companion.link.telemetry import VehicleState
from companion.record.flight_record import FlightRecord
from companion.record.summary import FlightMeta, PhaseChange, summarise
from companion.trajectory.anchored import Trajectory
from sim_link import inner_loops, vehicle_file
from sim_link.airframe import Airframe
from sim_link.wind import World

CSV_COLUMNS = (
    *("t_s", "p_n", "p_e", "p_d", "v_n", "v_e", "v_d", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z"),
    *("thrust_n", "thrust_rate_n_s", "tau_x", "tau_y", "tau_z", "b_hat_n", "b_hat_e", "b_hat_d"),
    *(f"e{i}_{axis}" for i in range(1, 5) for axis in "ned"),
)

DIVERGED_M = 1e4
NO_TIMING = StepTiming(math.nan, math.nan, False, 0)


class Row(NamedTuple):
    """One control step; `t_s` counts from the moment of engaging."""

    t_s: float
    state: State
    thrust_n: float
    thrust_rate_n_s: float
    tau: Vec3
    b_hat: Vec3
    errors: tuple[Vec3, Vec3, Vec3, Vec3]
    """e1 to e4 [m]."""

    def numbers(self) -> tuple[float, ...]:
        """The row in the order of CSV_COLUMNS."""
        s, e = self.state, self.errors
        head = (self.t_s, *s.p, *s.v, *s.q, *s.w, self.thrust_n, self.thrust_rate_n_s, *self.tau, *self.b_hat)
        return (*head, *e[0], *e[1], *e[2], *e[3])


@dataclass
class Trace:
    """A simulated flight."""

    rows: list[Row]
    record: FlightRecord
    summary: dict[str, Any]
    truth_disturbance_m_s2: Vec3


def start_of(flight: Flight) -> tuple[Vec3, float]:
    """Position [m] and heading [rad] of [start].

    Raises:
        InputError: the flight file has none.
    """
    if flight.start is None:
        raise InputError(
            f"flight {flight.name!r} has no [start]: a simulation needs start.position_m = [north, east, down]"
        )
    return flight.start.position_m, radians(flight.start.yaw_deg)


def simulated_vehicle(flight: Flight) -> vehicle_file.VehicleFile:
    """The flight's vehicle as the simulator builds it."""
    return simulated(flight.vehicle)


def simulated_world(flight: Flight) -> World:
    """The flight's [world] as the simulator takes it; the ground is far below."""
    w = flight.world
    return World(
        force_n=w.force_n,
        gravity_factor=w.gravity_factor,
        wind_m_s=w.wind_m_s,
        turbulence=w.turbulence,
        ground_d_m=DIVERGED_M,
        seed=w.seed,
    )


def loop_setpoint(setpoint: Setpoint) -> inner_loops.Setpoint:
    """A setpoint of the law as the vehicle's inner loops take it from the wire."""
    assert not isinstance(setpoint, PositionSetpoint)  # not the law's
    level, zero = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if isinstance(setpoint, AttitudeSetpoint):
        return inner_loops.Setpoint(inner_loops.ATTITUDE, setpoint.thrust, zero, setpoint.q, setpoint.yaw_rate, zero)
    if isinstance(setpoint, ActuatorSetpoint):
        return inner_loops.Setpoint(inner_loops.TORQUE, setpoint.thrust, zero, level, 0.0, setpoint.torque)
    return inner_loops.Setpoint(inner_loops.RATES, setpoint.thrust, setpoint.w, level, 0.0, zero)


def fly_sampled(
    flight: Flight,
    trajectory: Trajectory,
    compiled: Kernels,
    progress: Callable[[float], None] = lambda share: None,
    duration_max_s: float = math.inf,
    real: vehicle_file.VehicleFile | None = None,
) -> Trace:
    """Flies against the bundled physics, from a hover at [start], for the length of the course.

    Args:
        flight: the configuration with [start] and [world].
        trajectory: what is to be flown.
        compiled: the kernels of the control step; the physics runs on the same engine.
        progress: called now and then with the share that is done.
        duration_max_s: simulate no more of the course than this.
        real: the vehicle that flies; None: what the flight's vehicle file says.

    Raises:
        RefusedError: the flight diverges.
    """
    vehicle = flight.vehicle
    position, yaw = start_of(flight)
    sim = simulated_vehicle(flight) if real is None else real
    px4 = "1.13" if flight.output.by_law == "actuators" else "1.18"
    airframe = Airframe(
        sim, simulated_world(flight), seed=flight.world.seed, engine=compiled.engine, start=(position, yaw), px4=px4
    )
    course = Course(trajectory, vehicle, position, yaw, (0.0, 0.0, 0.0), flight.height_min_m)
    tracker = Tracker(vehicle, flight.output.by_law, compiled)
    n_steps = max(1, round(sim.loop_rate_hz / vehicle.link.state_rate_hz))
    interval_us = n_steps * airframe.dt_us
    count = int(min(course.duration_s, duration_max_s) * 1e6 / interval_us)
    record = FlightRecord(count + 1, PHASE_NAMES)
    tracker.begin(State(position, (0.0, 0.0, 0.0), quat_from_yaw(yaw), (0.0, 0.0, 0.0)))
    begin_s = airframe.t_us * 1e-6
    queue: list[tuple[int, inner_loops.Setpoint]] = []
    acting = loop_setpoint(_hover(flight))
    delay_us = round(vehicle.link.command_delay_s * 1e6)
    rows: list[Row] = []
    reference_at = Timed(course, begin_s)
    for i in range(count):
        believed = airframe.believed()
        stamp_s = believed.t_us * 1e-6
        if stamp_s < begin_s:
            airframe.advance(acting, False, n_steps)
            continue
        state = State(believed.p, believed.v, believed.q, believed.w)
        out = tracker.step(stamp_s, state, reference_at)
        queue.append((airframe.t_us + delay_us, loop_setpoint(out.setpoint)))
        _append(record, rows, out, stamp_s, stamp_s - begin_s, state, course)
        size = math.hypot(*out.errors[0])
        if not size < DIVERGED_M:
            at_s = stamp_s - begin_s
            raise RefusedError(f"the simulated flight diverges: position error {size:.3g} m at {at_s:.2f} s")
        acting = _advance(airframe, acting, queue, n_steps)
        if i % 250 == 0:
            progress(i / count)
    progress(1.0)
    phases = [PhaseChange(Phase.TRACK.value, begin_s + course.join_s, "simulated")]
    meta = FlightMeta(trajectory.name, vehicle.name, 0, flight.statistics_from_s, flight.acceptance.thresholds())
    return Trace(rows, record, summarise(record, phases, meta), airframe.truth().disturbance_m_s2)


def _advance(
    airframe: Airframe, acting: inner_loops.Setpoint, queue: list[tuple[int, inner_loops.Setpoint]], n_steps: int
) -> inner_loops.Setpoint:
    """Run n_steps physics steps, each setpoint of the queue from the step on at which it is due; what acts in the end.

    The queue has vehicle times [us], in order; what is due between two steps acts from the later one on.
    """
    fresh = False
    while True:
        while queue and queue[0][0] <= airframe.t_us:
            acting, fresh = queue.pop(0)[1], True
        until_due = -((airframe.t_us - queue[0][0]) // airframe.dt_us) if queue else n_steps
        steps = min(n_steps, until_due)
        airframe.advance(acting, fresh, steps)
        n_steps -= steps
        if n_steps == 0:
            return acting
        fresh = False


def _hover(flight: Flight) -> Setpoint:
    from companion.control.output import RateSetpoint, thrust_fraction

    vehicle = flight.vehicle
    weight = vehicle.body.mass_kg * GRAVITY_M_S2
    return RateSetpoint(thrust_fraction(weight, vehicle.thrust_full_n, vehicle.rotors.curve_factor), (0.0, 0.0, 0.0))


def _append(
    record: FlightRecord,
    rows: list[Row],
    out: TrackerStep,
    stamp_s: float,
    t: float,
    state: State,
    course: Course,
) -> None:
    reference = course.at(t)
    error = (state.p[0] - reference.p[0], state.p[1] - reference.p[1], state.p[2] - reference.p[2])
    track = t - course.join_s
    on_track = 0.0 <= track <= course.track_s
    phase = Phase.TRACK if on_track else (Phase.JOIN if track < 0.0 else Phase.HOLD)
    n = out.numbers
    rows.append(Row(t, state, n[flat.TOTAL], n[flat.TOTAL_RATE], out.tau, out.b_hat, out.errors))
    seen = VehicleState(round(stamp_s * 1e6), *state, 0)
    record.append(control_row(track if on_track else math.nan, phase, seen, reference, error, out, NO_TIMING))


def fly_ideal(flight: Flight, trajectory: Trajectory, progress: Callable[[float], None] = lambda share: None) -> Trace:
    """The paper's own setting: perfect state, law inside the integrator, torque realised exactly, no limits.

    The mean wind acts through the drag, as a constant force; there are no gusts.
    """
    vehicle = flight.vehicle
    position, yaw = start_of(flight)
    base = vehicle.parameters()
    unlimited = base.limits._replace(
        thrust_min=1e-3, thrust_max=1e9, rate_max=(1e9, 1e9, 1e9), disturbance_max=1e9, heading_rate_max=1e9
    )
    parameters = base._replace(limits=unlimited)
    course = Course(trajectory, vehicle, position, yaw, (0.0, 0.0, 0.0), flight.height_min_m)
    interval = 1.0 / vehicle.link.state_rate_hz
    times = np.arange(int(course.duration_s / interval) + 1, dtype=np.float64) * interval
    r2 = (-math.sin(yaw), math.cos(yaw), 0.0)
    controller = ControllerState(
        vehicle.body.mass_kg * GRAVITY_M_S2,
        0.0,
        (0.0, 0.0, 0.0),
        HeadingState(r2, (math.cos(yaw), math.sin(yaw), 0.0), False),
        (0.0, 0.0, 0.0),
    )
    mass, drag = vehicle.body.mass_kg, vehicle.body.drag_1_s
    (fn, fe, fd), (wn, we, wd) = flight.world.force_n, flight.world.wind_m_s
    force = (fn + mass * drag * wn, fe + mass * drag * we, fd + mass * drag * wd)
    world = ideal.World(force, GRAVITY_M_S2 * flight.world.gravity_factor, drag)
    start = State(position, (0.0, 0.0, 0.0), quat_from_yaw(yaw), (0.0, 0.0, 0.0))

    def reference(t: float) -> Reference:
        progress(t / course.duration_s)
        return course.at(t)

    try:
        samples = ideal.fly(reference, start, controller, parameters, world, times)
    except FloatingPointError as error:
        raise RefusedError(str(error)) from None
    record = FlightRecord(len(samples), PHASE_NAMES)
    rows = []
    for s in samples:
        c, ev, ref = s.controller, s.evaluation, s.reference
        rows.append(Row(s.t_s, s.state, c.thrust, c.thrust_rate, ev.tau, c.b_hat, ev.errors[:4]))
        record.append(_ideal_row(s, ref, course, parameters))
    phases = [PhaseChange(Phase.TRACK.value, course.join_s, "simulated in the paper's ideal setting")]
    meta = FlightMeta(trajectory.name, vehicle.name, 0, flight.statistics_from_s, flight.acceptance.thresholds())
    excess = GRAVITY_M_S2 * (flight.world.gravity_factor - 1.0)
    truth = (force[0] / mass, force[1] / mass, force[2] / mass + excess)
    return Trace(rows, record, summarise(record, phases, meta), truth)


def _ideal_row(sample: ideal.Sample, ref: Reference, course: Course, parameters: Any) -> tuple[float, ...]:
    from companion.control.law import lyapunov

    s, e, c = sample.state, sample.evaluation.errors, sample.controller
    track = sample.t_s - course.join_s
    on_track = 0.0 <= track <= course.track_s
    phase = Phase.TRACK if on_track else (Phase.JOIN if track < 0.0 else Phase.HOLD)
    error = (s.p[0] - ref.p[0], s.p[1] - ref.p[1], s.p[2] - ref.p[2])
    return (
        (
            sample.t_s,
            track if on_track else math.nan,
            PHASE_INDEX[phase],
            *s.p,
            *s.v,
            *s.q,
            *s.w,
            *ref.p,
            *ref.v,
            *error,
        )
        + (sample.evaluation.heading_error, *e.e1, *e.e2, *e.e3, *e.e4, lyapunov(e, parameters.gains.p_max), *c.b_hat)
        + (c.thrust, c.thrust_rate, *sample.evaluation.tau, *s.w, math.nan, math.nan, math.nan, 0.0, 0.0, 0.0)
        + (*s.q, *s.w)
    )


def write_csv(trace: Trace, path: Path) -> None:
    """One row per control step with CSV_COLUMNS; numbers in full precision."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(CSV_COLUMNS)
            writer.writerows([repr(x) for x in row.numbers()] for row in trace.rows)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


__all__ = ["CSV_COLUMNS", "Row", "Trace", "fly_ideal", "fly_sampled", "write_csv"]
