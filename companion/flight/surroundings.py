"""What a trajectory comes near to where it is flown: the ground, a fence, other trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.errors import RefusedError
from companion.flight.clearance import own_fence_margins
from companion.flight.course import Course
from companion.trajectory.anchored import Anchored, Trajectory
from companion.trajectory.batch import batch
from companion.trajectory.feasibility import grid
from companion.trajectory.fence import Fence

HEIGHT_MIN_M = 0.5
"""Lowest height above home that a trajectory may ask for, unless told otherwise."""


class Margin(NamedTuple):
    """The nearest that a trajectory comes to something."""

    value_m: float
    at_s: float


class Problem(NamedTuple):
    """One reason not to fly."""

    name: str
    at_s: float | None
    sentence: str


def place_problems(
    path: Anchored, fence: Fence | None, height_min_m: float
) -> tuple[Margin | None, Margin | None, list[Problem]]:
    """Return the margins to ground and fence of a trajectory in its place, and what speaks against it there.

    Args:
        path: in coordinates whose origin is home.
        fence: in the same coordinates, beside the trajectory's own.
        height_min_m: what the path must stay above, over home.
    """
    times_s = grid(path)
    points = batch(path, times_s).p.T
    problems = []
    ground = None if _height_unknown(path.trajectory) else _nearest(times_s, -points[:, 2])
    if ground is not None and not ground.value_m >= height_min_m:
        problems.append(
            Problem(
                "ground",
                ground.at_s,
                f"height above home falls to {ground.value_m:.2f} m at {ground.at_s:.2f} s, at least"
                f" {height_min_m:g} m are required",
            )
        )
    own = own_fence_margins(path, points)
    margins = [found for found in (None if fence is None else fence.margins(points), own) if found is not None]
    nearest = _nearest(times_s, np.min(margins, axis=0)) if margins else None
    if nearest is not None and not nearest.value_m > 0.0:
        sentence = f"leaves the fence by {-nearest.value_m:.2f} m at {nearest.at_s:.2f} s"
        problems.append(Problem("fence", nearest.at_s, sentence))
    return ground, nearest, problems


def _height_unknown(trajectory: Trajectory) -> bool:
    """Whether heights count from sea level while nobody knows how high home is."""
    origin = trajectory.origin
    return origin is not None and not origin.altitude_above_home and origin.point.altitude_m == 0.0


def _nearest(times_s: Sequence[float], margins: NDArray[np.float64]) -> Margin:
    at = int(np.argmin(margins))
    return Margin(float(margins[at]), times_s[at])


def gate_course(course: Course) -> None:
    """A course stays clear of ground and fences with its join and its stop, as far as home says where the ground is.

    Home is the vehicle's own, as the course was given it, wherever the trajectory was planned. Before there is a
    vehicle the planned home is taken for it.

    Raises:
        RefusedError: it does not; with the place where it comes nearest, or goes farthest beyond.
    """
    obstruction = course.obstruction()
    if obstruction is not None:
        raise RefusedError(f"trajectory {course.path.trajectory.name!r}: {obstruction.sentence}")


def separation(paths: Sequence[Anchored], step_s: float = 0.02) -> tuple[Margin, tuple[int, int]] | None:
    """Return the nearest that any two of several trajectories come when all begin at once, and which two.

    One that has ended rests where its path runs out to; None for a single one.
    """
    if len(paths) < 2:
        return None
    end_s = max(path.duration_s for path in paths)
    count = min(50_000, max(2, round(end_s / step_s)))
    times_s = np.linspace(0.0, end_s, count + 1).tolist()
    points = [np.array([path.at(t_s).p for t_s in times_s]) for path in paths]
    nearest, pair = Margin(inf, 0.0), (0, 1)
    for i in range(len(paths)):
        for k in range(i + 1, len(paths)):
            found = _nearest(times_s, np.sqrt(((points[i] - points[k]) ** 2).sum(axis=1)))
            if found.value_m < nearest.value_m:
                nearest, pair = found, (i, k)
    return nearest, pair
