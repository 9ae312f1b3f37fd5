"""The planner of paths through waypoints: checks what is asked, finds durations, and makes a shape of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import dist, hypot, inf, isfinite

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError, RefusedError
from companion.trajectory.allocation import Allocation, Progress, Turn, search, settle
from companion.trajectory.demands import Gauge, eased
from companion.trajectory.minimum_snap import REFINEMENTS, Knots, Solution, solve
from companion.trajectory.piecewise import PathPiece, Piecewise, coefficients
from companion.trajectory.shapes import Heading
from companion.trajectory.turning import HeadingSource, along_path, given
from companion.trajectory.waypoints import HeadingMode, PlanLimits, Waypoint

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

TRIED_SHARES = (1.0, 0.97, 0.9)
"""Of the limits that the search aims at, one after the other until the limits are kept."""

EXCESS_TOLERANCE = 1e-6
"""As `feasibility.USE_TOLERANCE`."""


def planned(
    waypoints: Sequence[Waypoint], limits: PlanLimits, heading: HeadingMode, yaw_rad: float, progress: Progress
) -> Piecewise:
    """Return the plan; see `waypoints.plan`."""
    _checked(waypoints, limits)
    points = np.array([waypoint.p_m for waypoint in waypoints]).T
    knots = _knots(waypoints, points)
    gauge = Gauge(limits.reference, limits.model, limits.wind_m_s * limits.model.drag_1_s, limits.body)
    _hovers(gauge, limits)
    source, found = _allocated(points, knots, gauge, _source_of(waypoints, heading), progress)
    _refuse_excess(found, waypoints)
    progress(1.0)
    knots_s = np.concatenate([[0.0], np.cumsum(found.durations_s)])
    solution = solve(knots, np.diff(knots_s), REFINEMENTS)
    return _shape(points, knots_s, solution, source, _first_heading(waypoints, yaw_rad))


def _source_of(waypoints: Sequence[Waypoint], heading: HeadingMode) -> Callable[[Solution], HeadingSource | None]:
    """Return how the heading follows from a first path."""
    if heading == "path":
        return along_path
    headings = given([waypoint.yaw_rad for waypoint in waypoints])
    return lambda _: headings


def _allocated(
    points: Array,
    knots: Knots,
    gauge: Gauge,
    source_of: Callable[[Solution], HeadingSource | None],
    progress: Progress,
) -> tuple[HeadingSource | None, Allocation]:
    """Return the durations, and the heading that goes with them.

    Prescribed speeds stay when durations grow, so that what exceeds a limit cannot always be stretched away; then the
    search aims lower.
    """
    for share in TRIED_SHARES if knots.values.any() else TRIED_SHARES[:1]:
        durations_s = search(points, knots, eased(gauge, share), _part(progress, 0.0, SEARCH_SHARE))
        source = source_of(solve(knots, durations_s))
        turn = _turn(source, gauge.limits.heading_rate_max_rad_s)
        found = settle(durations_s, knots, gauge, turn, _part(progress, SEARCH_SHARE, 1.0))
        if found.excess.max() <= EXCESS_TOLERANCE:
            break
        progress = _silent
    return source, found


def _part(progress: Progress, begin: float, end: float) -> Progress:
    """Return what tells the share of a part of the work."""
    return lambda share: progress(begin + (end - begin) * share)


def _silent(_: float) -> None:
    """Tell nothing: a second trial has no end that could be foreseen."""


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
    beyond = [name for name, left in gauge.left_at_rest().items() if left <= 0.0]
    if beyond:
        raise RefusedError(
            f"no path keeps the limits: resting in a wind of {limits.wind_m_s:g} m/s alone exceeds that of"
            f" {' and '.join(beyond)}; lower limits.wind_m_s"
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
