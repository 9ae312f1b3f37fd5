"""References through waypoints: minimum-snap polynomials with times that the vehicle's limits just allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import dist, hypot, inf, isfinite
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.config import Vehicle
from companion.control.types import Vec3
from companion.errors import InputError, RefusedError
from companion.trajectory.allocation import Allocation, Turn, search, settle
from companion.trajectory.demands import Gauge
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.minimum_snap import REFINEMENTS, Knots, Solution, solve
from companion.trajectory.piecewise import PathPiece, Piecewise, coefficients
from companion.trajectory.shapes import Heading
from companion.trajectory.turning import HeadingSource, along_path, given
from companion.trajectory.vehicle_limits import point_mass, reference_limits

Array = NDArray[np.float64]

ORDER = 4
DISTANCE_MIN_M = 0.01
"""Between neighbours: nearer ones are a mistake."""

COORDINATE_MAX_M = 1e6
"""What is further away than this is not in metres."""

REVERSAL = 1e-3
"""A tangent this short, beside the ways to the neighbours, has no meaning."""

SEARCH_SHARE = 0.8
"""Of the work, for the display."""

EXCESS_TOLERANCE = 1e-6
"""As `feasibility.USE_TOLERANCE`."""

HeadingMode = Literal["waypoints", "path"]
"""Where the heading comes from: from the waypoints that give one, or from the direction of flight."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point that the path goes through, and what is asked for there. The first and the last are always at rest."""

    p_m: Vec3
    """Position, NED [m]."""
    yaw_rad: float | None = None
    """Heading there [rad], clockwise from north; None: as the neighbours have it come."""
    speed_m_s: float | None = None
    """Speed there [m/s], above zero, in the direction of the circle through the point and its neighbours; None: free.
    Exclusive with `stop` and `velocity_m_s`, as both say the speed already."""
    stop: bool = False
    """Come to rest there: all derivatives up to the fourth are zero."""
    velocity_m_s: Vec3 | None = None
    """Velocity there, NED [m/s], where the direction matters too."""


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """What a plan keeps to."""

    reference: ReferenceLimits
    """The vehicle's limits, or tighter ones."""
    model: PointMass
    """Mass and drag."""
    wind_m_s: float = 0.0
    """Wind from any direction that thrust, tilt and body rate leave room for; it acts through the drag."""


def plan_limits(vehicle: Vehicle, wind_m_s: float = 0.0) -> PlanLimits:
    """Return the limits of a vehicle file, with room for a wind [m/s]."""
    return PlanLimits(reference_limits(vehicle), point_mass(vehicle), wind_m_s)


def plan(
    waypoints: Sequence[Waypoint],
    limits: PlanLimits,
    *,
    heading: HeadingMode = "waypoints",
    yaw_rad: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Piecewise:
    """Return a near-shortest minimum-snap reference through the waypoints, from rest to rest, within the limits.

    Args:
        waypoints: at least two, no two neighbours at the same place.
        limits: kept throughout.
        heading: "waypoints" interpolates the headings that are given; "path" keeps the nose along the path.
        yaw_rad: the heading where "waypoints" are to say and none does [rad].
        progress: told the share that is done, 0..1, now and then.

    Returns:
        A shape: to be put into a `Trajectory` with `duration_s = shape.own_duration_s`.

    Raises:
        InputError: a waypoint is wrong; the message begins with its key, such as "waypoint.3.speed_m_s".
        RefusedError: the limits leave no way to fly it, however slowly.

    """
    _checked(waypoints, limits)
    points = np.array([waypoint.p_m for waypoint in waypoints]).T
    knots = _knots(waypoints, points)
    gauge = Gauge(limits.reference, limits.model, limits.wind_m_s * limits.model.drag_1_s)
    _hovers(gauge, limits)
    tell = progress or (lambda _: None)
    durations_s = search(points, knots, gauge, lambda share: tell(SEARCH_SHARE * share))
    source: HeadingSource | None = (
        along_path(solve(knots, durations_s)) if heading == "path" else given([w.yaw_rad for w in waypoints])
    )
    found = settle(
        durations_s,
        knots,
        gauge,
        _turn(source, limits.reference.heading_rate_max_rad_s),
        lambda share: tell(SEARCH_SHARE + (1.0 - SEARCH_SHARE) * share),
    )
    _refuse_excess(found, waypoints)
    tell(1.0)
    knots_s = np.concatenate([[0.0], np.cumsum(found.durations_s)])
    solution = solve(knots, np.diff(knots_s), REFINEMENTS)
    return _shape(points, knots_s, solution, source, _first_heading(waypoints, yaw_rad))


def _turn(source: HeadingSource | None, rate_max_rad_s: float) -> Turn | None:
    """Return what the heading's rate asks of the durations; None where it asks for nothing."""
    if source is None or rate_max_rad_s == inf:
        return None
    return lambda path: source.turning(path).excess(rate_max_rad_s, np.cumsum(path.durations_s))


def _checked(waypoints: Sequence[Waypoint], limits: PlanLimits) -> None:
    """Refuse what cannot be planned.

    Raises:
        InputError: the first thing that is wrong.
    """
    if len(waypoints) < 2:
        raise InputError(f"waypoint: {len(waypoints)} given, a path takes at least 2")
    if not (isfinite(limits.wind_m_s) and limits.wind_m_s >= 0.0):
        raise InputError(f"limits.wind_m_s = {limits.wind_m_s}: must be a number not below zero")
    for i, waypoint in enumerate(waypoints):
        _check_one(f"waypoint.{i}", waypoint, limits, end=i in (0, len(waypoints) - 1))
    for i, (before, after) in enumerate(pairwise(waypoints)):
        if dist(before.p_m, after.p_m) < DISTANCE_MIN_M:
            raise InputError(
                f"waypoint.{i + 1}.p_m = {list(after.p_m)}: the same point as waypoint.{i}, or nearer than"
                f" {DISTANCE_MIN_M} m; leave one of them out"
            )


def _check_one(key: str, waypoint: Waypoint, limits: PlanLimits, *, end: bool) -> None:
    if not all(isfinite(x) and abs(x) <= COORDINATE_MAX_M for x in waypoint.p_m):
        raise InputError(f"{key}.p_m = {list(waypoint.p_m)}: must be three numbers within {COORDINATE_MAX_M:.0f} m")
    if waypoint.yaw_rad is not None and not isfinite(waypoint.yaw_rad):
        raise InputError(f"{key}.yaw_rad = {waypoint.yaw_rad}: must be a number")
    asked = [name for name in ("speed_m_s", "velocity_m_s") if getattr(waypoint, name) is not None]
    asked += ["stop"] if waypoint.stop else []
    if len(asked) > 1:
        raise InputError(f"{key}: {' and '.join(asked)} exclude each other; give one of them")
    if waypoint.stop or not asked:
        return
    value = getattr(waypoint, asked[0])
    speed = hypot(*value) if isinstance(value, tuple) else value
    shown = list(value) if isinstance(value, tuple) else value
    if end:
        raise InputError(f"{key}.{asked[0]} = {shown}: a path begins and ends at rest; leave it out")
    if not (isfinite(speed) and speed > 0.0):
        raise InputError(f"{key}.{asked[0]} = {shown}: must be above zero (stop = true rests there)")
    if speed > limits.reference.speed_max_m_s:
        raise InputError(
            f"{key}.{asked[0]} = {shown}: faster than the limit of {limits.reference.speed_max_m_s:g} m/s"
            " (limits.speed_max_m_s)"
        )


def _knots(waypoints: Sequence[Waypoint], points: Array) -> Knots:
    """Return what is pinned where: everything at rests, the velocity where it is prescribed."""
    count = len(waypoints)
    pinned = np.zeros((ORDER, count), dtype=bool)
    values = np.zeros((3, ORDER, count))
    for i, waypoint in enumerate(waypoints):
        if waypoint.stop or i in (0, count - 1):
            pinned[:, i] = True
        elif waypoint.velocity_m_s is not None:
            pinned[0, i], values[:, 0, i] = True, waypoint.velocity_m_s
        elif waypoint.speed_m_s is not None:
            pinned[0, i], values[:, 0, i] = True, waypoint.speed_m_s * _direction(points, i)
    return Knots(ORDER, np.diff(points, axis=1), pinned, values)


def _direction(points: Array, i: int) -> Array:
    """Return the unit tangent at a waypoint of the circle through it and its neighbours."""
    before, after = points[:, i] - points[:, i - 1], points[:, i + 1] - points[:, i]
    in_m, out_m = float(np.linalg.norm(before)), float(np.linalg.norm(after))
    tangent = before / in_m * out_m + after / out_m * in_m
    length = float(np.linalg.norm(tangent))
    if length < REVERSAL * (in_m + out_m):
        raise InputError(
            f"waypoint.{i}.speed_m_s: the path turns back there, so that a speed has no direction; use stop = true, or"
            " velocity_m_s = [north, east, down]"
        )
    direction: Array = tangent / length
    return direction


def _hovers(gauge: Gauge, limits: PlanLimits) -> None:
    """Refuse limits that do not even let the vehicle rest."""
    rest = np.zeros((3, 1))
    excess = gauge.excess(rest, rest, rest)[0]
    beyond = [name for name, value in excess._asdict().items() if value.max() > 0.0]
    if beyond:
        raise RefusedError(
            f"no path keeps the limits: resting in a wind of {limits.wind_m_s:g} m/s alone exceeds that of"
            f" {' and '.join(name.replace('_', ' ') for name in beyond)}; lower limits.wind_m_s"
        )


def _refuse_excess(found: Allocation, waypoints: Sequence[Waypoint]) -> None:
    """Refuse a plan that exceeds a limit: prescribed speeds can ask for what no durations give."""
    worst = int(found.excess.argmax())
    if found.excess[worst] <= EXCESS_TOLERANCE:
        return
    moving = [i for i, w in enumerate(waypoints) if w.speed_m_s is not None or w.velocity_m_s is not None]
    near = min(moving, key=lambda i: abs(i - worst - 0.5), default=worst)
    raise RefusedError(
        f"waypoint.{near}: no durations keep the limits between waypoint.{worst} and waypoint.{worst + 1}: the best"
        f" exceed them by {100.0 * found.excess[worst]:.2g} %; ask for less speed there, or put waypoints further apart"
    )


def _first_heading(waypoints: Sequence[Waypoint], yaw_rad: float) -> float:
    """Return the heading where there is but one."""
    return next((w.yaw_rad for w in waypoints if w.yaw_rad is not None), yaw_rad)


def _shape(
    points: Array, knots_s: Array, solution: Solution, source: HeadingSource | None, yaw_rad: float
) -> Piecewise:
    """Return what was found as a shape."""
    rows = solution.coefficients(points[:, :-1]).transpose(2, 0, 1).tolist()
    pieces = tuple(PathPiece(*(coefficients(axis) for axis in piece)) for piece in rows)
    if source is None:
        return Piecewise(heading=Heading(yaw_rad), knots_s=tuple(knots_s.tolist()), pieces=pieces)
    turning = source.turning(solution)
    return Piecewise(
        knots_s=tuple(knots_s.tolist()),
        pieces=pieces,
        yaw_knots_s=tuple(turning.knots_s.tolist()),
        yaw_pieces=tuple(coefficients(row) for row in turning.coefficients().tolist()),
    )
