"""Looks at a trajectory as a whole before it is flown: what it asks for at most, how it joins, what it comes near to.

`gate_reference` refuses by the very findings that `companion check` shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, hypot, inf, isfinite
from typing import NamedTuple

import numpy as np

from companion.config import Vehicle
from companion.control.types import Reference, Vec3
from companion.errors import RefusedError
from companion.flight.course import Course, Part
from companion.flight.surroundings import HEIGHT_MIN_M, Margin, Problem, place_problems
from companion.trajectory import torque
from companion.trajectory.anchored import Anchored, Trajectory, anchored
from companion.trajectory.batch import Batch, batch, torque_uses, uses
from companion.trajectory.batch import quantities as quantities_of
from companion.trajectory.feasibility import USE_TOLERANCE, ViolationName, check, grid, highest
from companion.trajectory.fence import Fence
from companion.trajectory.flatness import BOUNDS, PointMass, ReferenceLimits, demand, quantities
from companion.trajectory.shapes import Joint
from companion.trajectory.vehicle_limits import point_mass, reference_limits

ORIGIN: Vec3 = (0.0, 0.0, 0.0)
SNAP_FLOOR_M_S4 = 1e-6
"""Smaller jumps of the fourth derivative are rounding."""

JUST_BEFORE_S = 1e-9
JOIN_JUMP_MAX = 1e-3
"""Of position, velocity, acceleration or jerk (SI) between a join and what it leads to."""

PACE_MIN, PACE_MAX = 1e-3, 100.0
PACE_STEPS = 18
PACE_MARGIN = 0.999
"""For what lies between the samples that the time scale is worked out from."""


class Peak(NamedTuple):
    """The largest value (of thrust also the smallest) of a quantity over a trajectory."""

    name: str
    value: float
    unit: str
    at_s: float
    limit: float | None
    """None where the vehicle file sets none."""
    use: float | None
    """Share of the limit; above 1 it is exceeded."""


class End(NamedTuple):
    """One end of a trajectory."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float
    snap_m_s4: float
    step: torque.Step
    """What its fourth derivative would do as a jump from or to rest."""
    joined: str
    """How the flight gets there or away, for people."""


@dataclass(frozen=True)
class Inspection:
    """All that is known of a trajectory before it is flown."""

    trajectory: Trajectory
    path: Anchored
    """In its place, with the hold point that was assumed."""
    peaks: tuple[Peak, ...]
    snap_steps: tuple[torque.Step, ...]
    """Jumps of the fourth derivative inside, the largest first."""
    start: End | None
    end: End | None
    ground: Margin | None
    """Lowest height above home; None where it is not known."""
    fence: Margin | None
    """Nearest to breaking the fence; None without one."""
    time_scale: float | None
    """The fastest pace at which every limit of the reference is kept; None when none keeps them."""
    problems: tuple[Problem, ...]


def reference_problems(trajectory: Trajectory, vehicle: Vehicle) -> list[Problem]:
    """Return what speaks against a reference wherever it is flown: limits, torque, jumps, wrong derivatives."""
    path = anchored(trajectory, ORIGIN, ORIGIN)
    limits, model = reference_limits(vehicle), point_mass(vehicle)
    found = check(path, limits, model)
    problems = [Problem(violation.name.value, violation.at_s, violation.sentence) for violation in found]
    if any(violation.name in (ViolationName.NOT_FINITE, ViolationName.JUMP) for violation in found):
        return problems  # the torque of a jump means nothing
    of = torque.body(vehicle)
    at_s, share = _torque_use(path, model, of)
    if share > 1.0 + USE_TOLERANCE:
        needs = demand(path.at(at_s), model)
        sentence = (
            f"torque reaches {torque.torque_n_m(needs, of):.3g} N m at {at_s:.2f} s, the rotors have"
            f" {torque.limit_n_m(needs, of):.3g} N m there beside the thrust of {needs.thrust_n:.3g} N"
        )
        problems.append(Problem("torque", at_s, sentence))
    return problems


def inspect(
    trajectory: Trajectory,
    vehicle: Vehicle,
    *,
    hold_point: Vec3,
    yaw_rad: float = 0.0,
    fence: Fence | None = None,
    height_min_m: float = HEIGHT_MIN_M,
) -> Inspection:
    """Look at all of a trajectory.

    Args:
        trajectory: what is to be flown.
        vehicle: what is to fly it.
        hold_point: where the vehicle holds before, NED from home [m].
        yaw_rad: its heading there.
        fence: to be kept to beside the trajectory's own, NED from home.
        height_min_m: what it must stay above, over home.
    """
    path = anchored(trajectory, hold_point, ORIGIN)
    limits, model, of = reference_limits(vehicle), point_mass(vehicle), torque.body(vehicle)
    problems = reference_problems(trajectory, vehicle)
    if any(problem.name == ViolationName.NOT_FINITE for problem in problems):
        return Inspection(trajectory, path, (), (), None, None, None, None, None, tuple(problems))
    ground, nearest, in_place = place_problems(path, fence, height_min_m)
    problems += in_place
    start, end, at_ends = _ends(trajectory, vehicle, path, hold_point, yaw_rad, height_min_m)
    problems += at_ends
    return Inspection(
        trajectory,
        path,
        _peaks(path, limits, model, of),
        _snap_steps(path, model, of),
        start,
        end,
        ground,
        nearest,
        _time_scale(path, limits, model, of),
        tuple(problems),
    )


def _peaks(path: Anchored, limits: ReferenceLimits, model: PointMass, of: torque.Body) -> tuple[Peak, ...]:
    """Return the extremes of all quantities, found between the samples as well."""
    times_s = grid(path)
    scan = batch(path, times_s)
    rows = quantities_of(scan, model)
    found = []
    for index, bound in enumerate(BOUNDS):
        limit: float = getattr(limits, bound.key)
        sign = 1.0 if bound.upper else -1.0

        def value(t_s: float, index: int = index, sign: float = sign) -> float:
            return sign * quantities(path.at(t_s), model)[index]

        at_s, most = highest(times_s, sign * rows[index], value)
        most *= sign
        share = (most / limit if bound.upper else limit / most if most > 0.0 else inf) if isfinite(limit) else None
        name = bound.quantity if bound.key != "thrust_min_n" else "thrust, least"
        found.append(Peak(name, most, bound.unit, at_s, limit if isfinite(limit) else None, share))
        if bound.key == "acceleration_max_m_s2":
            at_s, most = highest(times_s, np.sqrt((scan.j**2).sum(0)), lambda t_s: hypot(*path.at(t_s).j))
            found.append(Peak("jerk", most, "m/s^3", at_s, None, None))
    at_s, share = _torque_use(path, model, of)
    needs = demand(path.at(at_s), model)
    found.append(Peak("torque", torque.torque_n_m(needs, of), "N m", at_s, torque.limit_n_m(needs, of), share))
    return tuple(found)


def _torque_use(path: Anchored, model: PointMass, of: torque.Body) -> tuple[float, float]:
    """Return when the largest share of the torque there is is taken [s], and how much; on both sides of joints too."""

    def share(t_s: float) -> float:
        return torque.use(path.at(t_s), model, of)

    times_s = grid(path)
    worst = highest(times_s, torque_uses(batch(path, times_s), model, of), share)
    for at_s, before, after in path.joints():
        if at_s <= times_s[-1]:
            at_joint = max(torque.use(before, model, of), torque.use(after, model, of))
            worst = max(worst, (at_s, at_joint), key=lambda found: found[1])
    return worst


def _snap_steps(path: Anchored, model: PointMass, of: torque.Body) -> tuple[torque.Step, ...]:
    """Return the jumps of the fourth derivative inside, the largest first."""
    jumps = [joint for joint in path.joints() if dist(joint.before.s, joint.after.s) > SNAP_FLOOR_M_S4]
    steps = [torque.step(joint, model, of) for joint in jumps]
    return tuple(sorted(steps, key=lambda step: step.angular_acceleration_rad_s2, reverse=True))


def _ends(
    trajectory: Trajectory, vehicle: Vehicle, path: Anchored, hold_point: Vec3, yaw_rad: float, height_min_m: float
) -> tuple[End | None, End | None, list[Problem]]:
    """Return both ends with the way that the flight gets there and away, and what speaks against it."""
    model, of = point_mass(vehicle), torque.body(vehicle)
    first, last = path.at(0.0), path.at(path.duration_s)
    try:
        course = Course(trajectory, vehicle, hold_point, yaw_rad, ORIGIN, height_min_m)
    except RefusedError as error:
        joined = "no way to join it or to stop after it"
        ends = (_end(first, 0.0, model, of, joined), _end(last, path.duration_s, model, of, joined))
        return *ends, [Problem("join", None, str(error))]
    by_law = trajectory.join == "law"
    there = "the law's bounded position error" if by_law else f"a join of {course.join_s:.1f} s"
    problems = []
    obstruction = course.obstruction()
    if obstruction is not None and obstruction.part is not Part.TRACK:  # which was looked at before
        problems.append(Problem(obstruction.part.name.lower(), None, obstruction.sentence))
    if not by_law:
        before = course.at(course.join_s - JUST_BEFORE_S)
        jump = max(dist(a, b) for a, b in zip(before[:4], first[:4], strict=True))
        if not jump <= JOIN_JUMP_MAX:
            problems.append(Problem("join", 0.0, f"the join does not meet the trajectory: a jump of {jump:.3g} (SI)"))
    return (
        _end(first, 0.0, model, of, there),
        _end(last, path.duration_s, model, of, f"a stop of {course.stop_s:.1f} s"),
        problems,
    )


def _end(reference: Reference, at_s: float, model: PointMass, of: torque.Body, joined: str) -> End:
    rest = reference._replace(v=ORIGIN, a=ORIGIN, j=ORIGIN, s=ORIGIN)
    step = torque.step(Joint(at_s, rest, reference), model, of)
    return End(hypot(*reference.v), hypot(*reference.a), hypot(*reference.j), hypot(*reference.s), step, joined)


def _time_scale(path: Anchored, limits: ReferenceLimits, model: PointMass, of: torque.Body) -> float | None:
    """Return the fastest time scale that keeps every limit."""
    found = _with_joints(path)

    def fits(pace: float) -> bool:
        p, v, a, j, snap, yaw = found
        powers = np.array([[1.0], [pace], [pace**2]])
        faster = Batch(p, pace * v, pace**2 * a, pace**3 * j, pace**4 * snap, powers * yaw)
        within = uses(quantities_of(faster, model), limits) <= 1.0
        return bool(within.all() and (torque_uses(faster, model, of) <= 1.0).all())

    if not fits(PACE_MIN):
        return None
    low, high = PACE_MIN, PACE_MAX
    for _ in range(PACE_STEPS):
        middle = (low * high) ** 0.5
        if fits(middle):
            low = middle
        else:
            high = middle
    return PACE_MARGIN * low * path.time_scale


def _with_joints(path: Anchored) -> Batch:
    """Return a path over its scan, and both sides of its joints."""
    scan = batch(path, grid(path))
    sides = [side for joint in path.joints() for side in (joint.before, joint.after)]
    if not sides:
        return scan
    vectors = np.array([side[:5] for side in sides]).transpose(1, 2, 0)
    yaw = np.array([side[5:] for side in sides]).T
    return Batch(*(np.concatenate(pair, axis=1) for pair in zip(scan, (*vectors, yaw), strict=True)))
