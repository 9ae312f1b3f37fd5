"""The heading of a path through waypoints: the smoothest one through headings that are given, or along the path.

A heading is a minimum-acceleration spline of degree five through its own knots, continuous up to the second derivative,
that begins and ends without turning; before the first knot and after the last it stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, remainder, tau

import numpy as np
from numpy.typing import NDArray

from companion.trajectory.minimum_snap import Knots, Solution, basis, solve

Array = NDArray[np.float64]

ORDER = 2
COURSE_SAMPLES = 2
"""Per piece, at which the heading is that of the path."""

COURSE_SPEED_MIN_M_S = 1e-3
"""A path that is never faster than this to the side goes up or down."""

COURSE_SPEED_SHARE = 0.1
"""Of the path's highest level speed: where it is slower its direction is left out."""

RATE_SAMPLES = 33
RATE_ROOM = 1e-4
"""Share of the limit that is left for what lies between the samples."""


@dataclass(frozen=True)
class Turning:
    """A heading over time. n spans."""

    knots_s: Array
    """Shape (n + 1,)."""
    yaw_rad: Array
    """At the knots, shape (n + 1,); not wrapped."""
    solution: Solution

    def coefficients(self) -> Array:
        """Return ascending powers over each span's normalised time, shape (n, 6)."""
        rows: Array = self.solution.coefficients(self.yaw_rad[None, :-1])[0].T
        return rows

    def excess(self, rate_max_rad_s: float, piece_ends_s: Array) -> Array:
        """Return by what share the rate exceeds its limit, for each of the path's pieces the most of the spans that
        it has a part in; shape of `piece_ends_s`."""
        x = np.linspace(0.0, 1.0, RATE_SAMPLES)
        rates = np.abs(basis(ORDER).values(1, x) @ self.solution.local()[0] / self.solution.durations_s)
        by_span = _peaks(rates) / (rate_max_rad_s * (1.0 - RATE_ROOM)) - 1.0
        last = len(piece_ends_s) - 1
        first = np.minimum(np.searchsorted(piece_ends_s, self.knots_s[:-1], side="right"), last)
        final = np.minimum(np.searchsorted(piece_ends_s, self.knots_s[1:], side="left"), last)
        found = np.full(len(piece_ends_s), -1.0)
        counts = final - first + 1
        offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        np.maximum.at(found, np.repeat(first, counts) + offsets, np.repeat(by_span, counts))
        return found


def _peaks(rows: Array) -> Array:
    """Return the maxima over the first axis, those between samples by a parabola through the three around it."""
    best = np.clip(rows.argmax(0), 1, len(rows) - 2)
    columns = np.arange(rows.shape[1])
    before, middle, after = (rows[best + i, columns] for i in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * middle + after, -1e-300)
    vertex: Array = np.where(np.abs(after - before) < -2.0 * bend, middle - (after - before) ** 2 / (8.0 * bend), 0.0)
    peaks: Array = np.maximum(vertex, rows.max(0))
    return peaks


def through(knots_s: Array, yaw_rad: Array) -> Turning:
    """Return the heading through values at instants, at least two."""
    count = len(knots_s)
    pinned = np.zeros((ORDER, count), dtype=bool)
    pinned[:, [0, -1]] = True
    knots = Knots(ORDER, np.diff(yaw_rad)[None], pinned, np.zeros((1, ORDER, count)))
    return Turning(knots_s, yaw_rad, solve(knots, np.diff(knots_s)))


@dataclass(frozen=True)
class GivenHeadings:
    """The headings of the waypoints that have one, at least two, each reached by the shorter turn."""

    indices: NDArray[np.intp]
    yaw_rad: Array

    def turning(self, path: Solution) -> Turning:
        """Return the heading for a path's durations."""
        times = np.concatenate([[0.0], np.cumsum(path.durations_s)])
        return through(times[self.indices], self.yaw_rad)


def given(headings: Sequence[float | None]) -> GivenHeadings | None:
    """Return the waypoints' headings, unwrapped; None where fewer than two have one."""
    indices = [i for i, yaw in enumerate(headings) if yaw is not None]
    if len(indices) < 2:
        return None
    unwrapped: list[float] = []
    for yaw in (yaw for yaw in headings if yaw is not None):
        unwrapped.append(unwrapped[-1] + remainder(yaw - unwrapped[-1], tau) if unwrapped else yaw)
    return GivenHeadings(np.array(indices), np.array(unwrapped))


@dataclass(frozen=True)
class AlongPath:
    """The direction of flight at chosen places of a path, whatever its durations are."""

    piece: NDArray[np.intp]
    x: Array
    """Where in the piece, 0..1."""
    yaw_rad: Array
    """The direction there when the places were chosen, not wrapped: no turn becomes one to the other side later."""

    def turning(self, path: Solution) -> Turning:
        """Return the heading for a path through the same waypoints."""
        north, east, at = _level(path)
        places = (self.piece, np.rint(self.x * COURSE_SAMPLES).astype(int))
        course = np.arctan2(east[places], north[places])
        course = self.yaw_rad + np.remainder(course - self.yaw_rad + pi, tau) - pi
        # The nose stays where it is until there is a direction, and where the last one was.
        times = np.concatenate([[0.0], at[places], [path.durations_s.sum()]])
        return through(times, np.concatenate([course[:1], course, course[-1:]]))


def along_path(path: Solution) -> AlongPath | None:
    """Choose the places of a path where its direction is its heading: at its knots and between them, where it is not
    slow; None where it is never level."""
    north, east, _ = _level(path)
    level = np.hypot(north, east)
    highest = float(level.max())
    if highest < COURSE_SPEED_MIN_M_S:
        return None
    piece, sample = np.nonzero(level > COURSE_SPEED_SHARE * highest)
    course = np.unwrap(np.arctan2(east[piece, sample], north[piece, sample]))
    return AlongPath(piece, sample / COURSE_SAMPLES, course)


def _level(path: Solution) -> tuple[Array, Array, Array]:
    """Return velocity to the north and to the east and the time, each of shape (pieces, COURSE_SAMPLES)."""
    x = np.arange(COURSE_SAMPLES) / COURSE_SAMPLES
    velocity = basis(path.knots.order).values(1, x) @ path.local() / path.durations_s
    starts = np.cumsum(path.durations_s) - path.durations_s
    return velocity[0].T, velocity[1].T, (starts + x[:, None] * path.durations_s).T


HeadingSource = GivenHeadings | AlongPath
