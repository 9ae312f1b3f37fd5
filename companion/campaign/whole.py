"""Whole flights in one call: what a flight is made of (`Case`), made into numbers, flown by `campaign.kernel`.

The same flight as `simulate.fly_sampled` and, in lockstep, as the bundled vehicle over MAVLink, for the same seed; some
hundred times faster than either, because nothing leaves the compiled code between the start and the end.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion import accelerate
from companion.campaign import kernel
from companion.campaign.kernel import Clock, Memory, Setup
from companion.config import Flight, SimulatedWorld, Vehicle
from companion.control.heading import HeadingState
from companion.control.law import ControllerState, start
from companion.control.model import factors, lag_factors
from companion.control.output import thrust_fraction
from companion.control.types import GRAVITY_M_S2, Quat, Reference, Vec3
from companion.control.vectors import axes, quat_exp, quat_multiply, quat_normalise
from companion.errors import InputError
from companion.flight.course import Course
from companion.flight.prediction import PIECE_MAX_S
from companion.flight.tracker import conversion
from companion.frames import quat_from_yaw, radians
from companion.trajectory.anchored import Trajectory
from companion.trajectory.batch import batch
from sim_link import vehicle_file
from sim_link.airframe import START_US, steps_per_gust
from sim_link.estimator import NOISE_ROWS, age_steps, noise_block, noise_of
from sim_link.inner_loops import initial_loops, make_gains
from sim_link.physics import STANDARD_GRAVITY_M_S2, RigidState, make_body
from sim_link.vehicle_file import VehicleFile
from sim_link.wind import DRAWS_PER_PERIOD, Wind, series

FloatArray = NDArray[np.float64]
ZERO: Vec3 = (0.0, 0.0, 0.0)
DIVERGED_M = 1e4
NO_GROUND_M = 1e9
"""Down coordinate of a ground that nobody reaches."""
COURSES_KEPT = 8


@dataclass(frozen=True)
class Throw:
    """A start in motion: what the vehicle has beside its position and heading when the law takes over."""

    velocity_m_s: Vec3 = ZERO
    """NED."""
    tilt_rad: float = 0.0
    tilt_towards_rad: float = 0.0
    """Where the thrust leans to: a direction, clockwise from north."""
    rates_rad_s: Vec3 = ZERO
    """FRD."""

    @property
    def still(self) -> bool:
        """Whether it is a start at rest and level."""
        return self == Throw()

    def attitude(self, yaw_rad: float) -> Quat:
        """Body to inertial, with the nose at `yaw_rad` before the tilt."""
        a, t = self.tilt_towards_rad, self.tilt_rad
        lean = quat_exp((t * math.sin(a), -t * math.cos(a), 0.0))
        return quat_normalise(quat_multiply(lean, quat_from_yaw(yaw_rad)))


@dataclass(frozen=True)
class Case:
    """One flight, complete: what the companion knows, what is really so, and the seed."""

    flight: Flight
    """What the companion is configured with, its [start] and the [world]; `world.seed` is that of noise and gusts."""
    vehicle: Vehicle
    """The vehicle as it really is."""
    trajectory: Trajectory
    throw: Throw = Throw()
    ground: bool = True
    """Whether there is a ground, at the down coordinate 0."""
    duration_s: float = math.inf
    """Of the course, at most this much is flown."""
    diverged_m: float = DIVERGED_M


@dataclass(frozen=True)
class Whole:
    """A flight that was flown."""

    ended: int
    """kernel.FLOWN, DIVERGED or GROUND."""
    rows: FloatArray
    """One per state, shape (n, kernel.ROW)."""
    time_s: FloatArray
    """Of the states' stamps, since the flight was engaged, shape (n,)."""
    course: Course
    rigid: RigidState
    """The vehicle at the end."""
    disturbance_m_s2: Vec3
    """The true one of the mean wind, as `airframe.Truth` has it."""

    @property
    def track_s(self) -> FloatArray:
        """Time on the trajectory, negative while it is being joined."""
        return self.time_s - self.course.join_s


def kernel_of(engine: str) -> tuple[str, Callable[..., Any]]:
    """The engine's name ("python" or "numba") and the kernel as it is to run. Raises InputError."""
    chosen = accelerate.resolve(engine)
    return chosen, accelerate.choose(kernel.fly, chosen)


def fly(case: Case, engine: str = "auto") -> Whole:
    """Fly a case.

    Raises:
        InputError: it cannot be simulated.
        RefusedError: the course cannot be planned.
    """
    chosen, run = kernel_of(engine)
    flight, sim = case.flight, simulated(case.vehicle)
    clock = check_vehicle(case, sim)
    course, reference, time_s = _reference(case, clock)
    clock = clock._replace(states=len(time_s))
    memory, weights = memory_of(flight.vehicle, clock)
    setup = _setup(case, sim, clock, memory)
    air = _air(flight.world, clock, chosen)
    rigid, controller, setup = _start(case, setup, float(air[2]))
    loops = initial_loops(rigid.w)
    ring = np.tile([*rigid.p, *rigid.v, *rigid.q, *rigid.w], clock.age + 1)
    command = [setup.hover[0], 0.0, 0.0, 0.0, setup.hover[1], *([0.0] * (kernel.COMMAND - 5))]
    sent = np.tile(command, kernel.ring_length(clock, memory))
    rows = np.full(kernel.ROW * clock.states, math.nan)
    arrays: tuple[Any, ...] = (reference, _noise(flight.world.seed, clock), air, weights, ring, sent, rows)
    if chosen == "python":  # numbers of an array are slow one by one
        arrays = tuple(x.tolist() for x in arrays)
    ended, count, last = run(setup, rigid, loops, controller, *arrays)
    table = np.asarray(arrays[-1]).reshape(-1, kernel.ROW)[:count]
    return Whole(ended, table, time_s[:count], course, RigidState(*last), _disturbance(case, setup))


def simulated(vehicle: Vehicle) -> VehicleFile:
    """A vehicle as the simulator builds it. Raises InputError."""
    data = _lists(vehicle.model_dump(exclude_none=True))
    try:
        found = vehicle_file.parse(data, f"vehicle {vehicle.name!r}")
    except vehicle_file.VehicleFileError as error:
        raise InputError(str(error)) from None
    return found


def check_vehicle(case: Case, sim: VehicleFile) -> Clock:
    """The clockwork of a case whose vehicle a campaign can fly. Raises InputError where it cannot, whatever varies."""
    if any((sim.walk_position_m, sim.walk_velocity_m_s, sim.walk_yaw_rad, sim.walk_rate_rad_s)):
        raise InputError(
            f"vehicle {sim.name!r}: noise.*_walk: campaigns fly with white noise alone; set the walks to 0"
        )
    return clock_of(case, sim)


def steps_per_state(sim: VehicleFile) -> int:
    """Loop steps between two states. Raises InputError where no state would come at its time."""
    per_state = sim.loop_rate_hz / sim.state_rate_hz
    if abs(per_state - round(per_state)) > 1e-9 * per_state:
        raise InputError(
            f"vehicle {sim.name!r}: autopilot.loop_rate_hz = {sim.loop_rate_hz:g} must be a whole multiple of"
            f" link.state_rate_hz = {sim.state_rate_hz:g}"
        )
    return round(per_state)


def clock_of(case: Case, sim: VehicleFile) -> Clock:
    """The clockwork of a case; its number of states is not known yet. Raises InputError."""
    dt_us, per_state = round(1.0e6 / sim.loop_rate_hz), steps_per_state(sim)
    delay = -(-round(sim.command_delay_s * 1e6) // dt_us)
    gust = steps_per_gust(dt_us) if case.flight.world.turbulence > 0.0 else 1 << 40
    return Clock(START_US, dt_us, per_state, age_steps(sim, dt_us), delay, gust, 0)


def memory_of(vehicle: Vehicle, clock: Clock) -> tuple[Memory, FloatArray]:
    """The prediction of the companion's vehicle at equal intervals, and its weights."""
    interval_s = clock.per_state * clock.dt_us * 1e-6
    delay_s = vehicle.delay_s if vehicle.controller.prediction else 0.0
    pieces = math.ceil(delay_s / PIECE_MAX_S - 1e-9)
    length_s = delay_s / pieces if pieces else interval_s
    waits = int(delay_s / interval_s + 1e-9)
    part_s = max(0.0, delay_s - waits * interval_s)
    part_s = part_s if part_s > 1e-6 else 0.0
    history = waits + (1 if part_s > 0.0 else 0)
    weights = np.zeros((max(pieces, 1), max(history, 1)))
    for i, j in itertools.product(range(pieces), range(history)):
        # the command computed j + 1 states ago acts for one interval
        begin = delay_s - (j + 1) * interval_s
        overlap = min((i + 1) * length_s, begin + interval_s) - max(i * length_s, begin)
        weights[i, j] = max(0.0, overlap) / length_s
    lag_s = vehicle.rotors.lag_s
    older = lag_factors(lag_s, part_s)[0] if part_s > 0.0 else 1.0
    newer = lag_factors(lag_s, interval_s - part_s)[0]
    return Memory(pieces, length_s, max(history, 1), waits + 2, older, newer), weights.reshape(-1)


def _setup(case: Case, sim: VehicleFile, clock: Clock, memory: Memory) -> Setup:
    flight, vehicle = case.flight, case.flight.vehicle
    world = flight.world
    by_attitude = flight.output.by_law == "attitude"
    if flight.output.controller != "law" or flight.output.by_law == "actuators":
        raise InputError(
            f"flight {flight.name!r}: output: a campaign flies the law, with rates or attitudes; change [output]"
        )
    x, y, z = vehicle.autopilot.rate_lag_s
    body = make_body(sim, STANDARD_GRAVITY_M_S2 * world.gravity_factor)
    return Setup(
        vehicle.parameters(),
        factors((x, y, z, vehicle.rotors.lag_s), memory.length_s),
        conversion(vehicle),
        by_attitude,
        clock,
        memory,
        (0.0, 0.0),
        body,
        make_gains(sim, "1.18"),
        noise_of(sim),
        _three(world.force_n),
        0.0 if case.ground else NO_GROUND_M,
        case.diverged_m,
    )


def _start(case: Case, setup: Setup, air_down_m_s: float) -> tuple[RigidState, ControllerState, Setup]:
    """The vehicle and the controller at the start: what `Airframe` and `Tracker.begin` make of it."""
    flight, throw = case.flight, case.throw
    if flight.start is None:
        raise InputError(f"flight {flight.name!r} has no [start]: a campaign needs start.position_m")
    yaw = radians(flight.start.yaw_deg)
    world, body = flight.world, setup.body
    load = body.mass_kg * (body.gravity_m_s2 + body.drag_1_s * air_down_m_s) + world.force_n[2]
    share = 0.25 * min(max(load, 0.0), 4.0 * body.rotor_thrust_max_n)
    a, b, c, d = setup.gains.mix_thrust
    q = throw.attitude(yaw)
    rotors = (share * a, share * b, share * c, share * d)
    rigid = RigidState(
        _three(flight.start.position_m), _three(throw.velocity_m_s), q, _three(throw.rates_rad_s), rotors
    )
    model, limits = setup.parameters.model, setup.parameters.limits
    r1, r2, r3 = axes(q)
    thrust = model.mass * GRAVITY_M_S2 / max(r3[2], 0.5)
    thrust = min(max(thrust, limits.thrust_min), limits.thrust_max)
    b_hat: Vec3 = ZERO
    if flight.vehicle.controller.disturbance_start == "hover":
        _, b_hat = start(thrust, q, model.mass, model.gravity, limits.disturbance_max)
    controller = ControllerState(thrust, 0.0, b_hat, HeadingState(r2, r1, False), ZERO)
    nominal = flight.vehicle
    weight = nominal.body.mass_kg * GRAVITY_M_S2
    fraction = thrust_fraction(weight, nominal.thrust_full_n, nominal.rotors.curve_factor)
    return rigid, controller, setup._replace(hover=(thrust, fraction))


def _reference(case: Case, clock: Clock) -> tuple[Course, FloatArray, FloatArray]:
    """The course, REFERENCE numbers per state, and the states' times since the flight was engaged."""
    flight, trajectory = case.flight, case.trajectory
    if flight.start is None:
        raise InputError(f"flight {flight.name!r} has no [start]: a campaign needs start.position_m")
    v = flight.vehicle
    delay_s = v.delay_s if v.controller.prediction else 0.0
    clockwork = (clock.dt_us, clock.per_state, clock.age)
    key = (v.limits.model_dump_json(), v.body.model_dump_json(), v.rotors.model_dump_json(), v.controller.heading)
    position, yaw_deg = flight.start.position_m, flight.start.yaw_deg
    if trajectory.join == "law" and trajectory.anchor != "here":  # then it lies where it lies
        position, yaw_deg = ZERO, 0.0
    where = (position, yaw_deg, flight.height_min_m)
    return _table(_Planned(v, key), trajectory, where, delay_s, clockwork, case.duration_s)


def course_of(case: Case, clock: Clock) -> Course:
    """The course of a case."""
    return _reference(case, clock)[0]


class _Planned:
    """A vehicle as far as a course depends on it, for the cache."""

    def __init__(self, vehicle: Vehicle, key: tuple[str, ...]) -> None:
        self.vehicle, self._key = vehicle, key

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Planned) and self._key == other._key


@lru_cache(maxsize=COURSES_KEPT)
def _table(
    planned: _Planned,
    trajectory: Trajectory,
    where: tuple[Vec3, float, float],
    delay_s: float,
    clockwork: tuple[int, int, int],
    duration_max_s: float,
) -> tuple[Course, FloatArray, FloatArray]:
    """See `_reference`; kept, because the flights of a study often share it."""
    dt_us, per_state, age = clockwork
    position_m, yaw_deg, height_min_m = where
    course = Course(trajectory, planned.vehicle, position_m, radians(yaw_deg), ZERO, height_min_m)
    wait = -(-age // per_state)
    count = int(min(course.duration_s, duration_max_s) * 1e6 / (per_state * dt_us)) - wait
    if count < 1:
        raise InputError(f"trajectory {trajectory.name!r}: shorter than the age of the states; nothing can be flown")
    stamps_s = [(START_US + (wait * per_state - age + k * per_state) * dt_us) * 1e-6 for k in range(count)]
    begin_s = START_US * 1e-6
    times_s = np.array(stamps_s) - begin_s
    effect = tabulated(course, times_s + delay_s)
    stamp = tabulated(course, times_s)[:, :3] if delay_s > 0.0 else effect[:, :3]
    return course, np.hstack([effect, stamp]).reshape(-1), times_s


def tabulated(course: Course, times_s: FloatArray) -> FloatArray:
    """A course at many instants: p, v, a, j, s and heading with two derivatives, shape (n, 18)."""
    found = np.empty((len(times_s), 18))
    pieces = course.pieces
    starts = np.array([start_s for start_s, _ in pieces])
    which = np.searchsorted(starts, times_s, side="right") - 1
    for index, (start_s, piece) in enumerate(pieces):
        at = np.flatnonzero(which == index)
        inside = at[times_s[at] - start_s <= piece.duration_s]
        if len(inside):
            parts = batch(piece, times_s[inside] - start_s)
            found[inside] = np.concatenate(parts).T
        for row in np.setdiff1d(at, inside):
            found[row] = _numbers(course.at(float(times_s[row])))
    for row in np.flatnonzero(which < 0):
        found[row] = _numbers(course.at(float(times_s[row])))
    return found


def _numbers(r: Reference) -> list[float]:
    return [*r.p, *r.v, *r.a, *r.j, *r.s, r.yaw, r.yaw_rate, r.yaw_acceleration]


def _noise(seed: int, clock: Clock) -> FloatArray:
    """NOISE numbers per state: those of its sample, as `sim_link.estimator` draws them."""
    wait = -(-clock.age // clock.per_state)
    first = clock.start_us // clock.dt_us + wait * clock.per_state - clock.age
    samples = first + clock.per_state * np.arange(clock.states)
    found = np.empty((clock.states, kernel.NOISE))
    blocks = samples // NOISE_ROWS
    edges = np.flatnonzero(np.diff(blocks)) + 1
    for begin, end in itertools.pairwise([0, *edges.tolist(), clock.states]):
        found[begin:end] = noise_block(seed, int(blocks[begin]))[samples[begin:end] % NOISE_ROWS]
    return found.reshape(-1)


def _air(world: SimulatedWorld, clock: Clock, engine: str) -> FloatArray:
    """AIR numbers per gust period, as `sim_link.airframe` has them."""
    period_s = steps_per_gust(clock.dt_us) * (clock.dt_us * 1.0e-6)
    wind = Wind(world.wind_m_s, world.turbulence, seed=world.seed, period_s=period_s)
    if not wind.gusty:
        return np.array(wind.air_m_s)
    steps = (clock.states + -(-clock.age // clock.per_state)) * clock.per_state
    periods = steps // clock.per_gust + 1
    filters, draws = np.array(wind.filters()), np.array(wind.draws(DRAWS_PER_PERIOD * (periods - 1)))
    air = np.empty(kernel.AIR * periods)
    accelerate.choose(series, engine)(filters, draws, air)
    return air


def _disturbance(case: Case, setup: Setup) -> Vec3:
    world, body = case.flight.world, setup.body
    m, d = body.mass_kg, body.drag_1_s
    f, a = world.force_n, world.wind_m_s
    excess = body.gravity_m_s2 - STANDARD_GRAVITY_M_S2
    return (d * a[0] + f[0] / m, d * a[1] + f[1] / m, d * a[2] + f[2] / m + excess)


def _three(v: Vec3) -> Vec3:
    """The same with floats: what is compiled must not depend on how a number was written."""
    return (float(v[0]), float(v[1]), float(v[2]))


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lists(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return list(value)
    return value
