"""Times for a path through waypoints: near-shortest ones within the limits.

The durations of the pieces are searched for so that their sum plus a penalty on what exceeds the limits at samples of
every piece is least. The path is the minimum-snap one for whatever durations are tried, so the gradient has a part by
way of its derivatives at the knots, which one more solution with the same factor gives (the adjoint). The penalty is
that of the method of multipliers: what it asks for grows from round to round where a limit is still exceeded, so that
the limits are met without the penalty having to be stiff. What is left is settled by stretching locally, and last by
one factor for everything between two rests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt, tan

import numpy as np
from numpy.typing import NDArray

from companion.trajectory.demands import Excess, Gauge
from companion.trajectory.descent import minimise
from companion.trajectory.minimum_snap import Knots, Solution, basis, solve

Array = NDArray[np.float64]
Turn = Callable[[Solution], Array]
"""From a path to how far its heading's rate exceeds the limit, by piece."""

Progress = Callable[[float], object]
"""Told the share that is done."""

SAMPLES = 12
"""Per piece, while searching."""

PENALTY = 20.0
PENALTY_GROWTH = 2.0
ROUNDS = 5
STEPS = 12
"""Steps of a round; its end is where the penalty changes."""

CHANGE_MAX = 2.0
"""By how much a round may change a duration."""

RATIO_MAX = 30.0
"""Of the durations of two neighbours; beyond, rounding gets the better of stiffnesses that go with its 7th power."""

FINE_SAMPLES = 33
ZOOMS = 3
ZOOM_SAMPLES = 9
NEAR = 0.02
"""Peaks that are this close to a limit are looked for between the samples."""

SPREAD = (1.0, 0.8, 0.45, 0.2)
"""What stretching a piece stretches of its neighbours, the first, the second, ..."""

STRETCHES = 40
STRETCH_GAIN = 0.8
STRETCH_MAX = 0.15
"""At a time: the heading along a path follows no simple law."""

STRETCH_ENOUGH = 2e-3
"""Excess that is left to scaling."""

STRETCH_MARGIN = 1e-3
"""Aimed at below the limits where scaling cannot follow."""

SCALINGS = 30
SCALE_ENOUGH = 2e-4
"""Excess below the limits that is not worth another round."""

ROUNDING = 1e-7
"""Left below the limits, for rounding."""


@dataclass(frozen=True)
class Allocation:
    """What came out."""

    durations_s: Array
    excess: Array
    """The largest excess over any limit, by piece; above zero only where nothing was found that keeps the limits."""


def search(points: Array, knots: Knots, gauge: Gauge, progress: Progress) -> Array:
    """Return near-shortest durations of the pieces that meet the limits nearly, at samples; shape (n,).

    Args:
        points: the waypoints, NED [m], shape (3, n + 1).
        knots: the same with what is pinned there.
        gauge: the limits.
        progress: told the share that is done.

    """
    durations_s = _graded(first_guess(points, knots, gauge))
    penalty, multipliers = PENALTY, Excess(*[np.zeros((SAMPLES, len(durations_s)))] * 6)
    for round_ in range(ROUNDS):
        found = _Round(durations_s, knots, gauge, multipliers, penalty)
        durations_s = _graded(found.best())
        excess = gauge.excess(*_derivatives(solve(knots, durations_s), found.maps))[0]
        multipliers = Excess(*(np.maximum(0.0, m + penalty * e) for m, e in zip(multipliers, excess, strict=True)))
        penalty *= PENALTY_GROWTH
        progress((round_ + 1) / ROUNDS)
    return durations_s


def first_guess(points: Array, knots: Knots, gauge: Gauge) -> Array:
    """Return durations of straight ways with constant accelerations that slow down for the corners; shape (n,)."""
    lim, g = gauge.limits, gauge.model.gravity_m_s2
    thrust = lim.thrust_max_n / gauge.model.mass_kg - gauge.disturbance_m_s2
    sideways = sqrt(max(thrust * thrust - g * g, 0.01 * g * g))
    a = 0.5 * min(lim.acceleration_max_m_s2, g * tan(min(lim.tilt_max_rad, 1.4)), sideways)
    way = np.diff(points, axis=1)
    length = np.sqrt((way * way).sum(0))
    cosine = np.clip((way[:, 1:] * way[:, :-1]).sum(0) / (length[1:] * length[:-1]), -1.0, 1.0)
    shorter = np.minimum(length[1:], length[:-1])
    radius = np.maximum(0.5 * shorter / np.maximum(np.tan(0.5 * np.arccos(cosine)), 1e-9), 0.1 * shorter)
    speed = np.concatenate([[0.0], np.minimum(lim.speed_max_m_s, np.sqrt(a * radius)), [0.0]])
    speed = np.where(knots.pinned[0], np.sqrt((knots.values[:, 0] ** 2).sum(0)), speed)
    for i in range(len(length)):
        speed[i + 1] = min(speed[i + 1], sqrt(speed[i] ** 2 + 2.0 * a * length[i]))
    for i in range(len(length) - 1, -1, -1):
        speed[i] = min(speed[i], sqrt(speed[i + 1] ** 2 + 2.0 * a * length[i]))
    first, last = speed[:-1], speed[1:]
    top = np.minimum(lim.speed_max_m_s, np.sqrt(0.5 * (first**2 + last**2) + a * length))
    cruise = np.maximum(length - (top**2 - first**2 + top**2 - last**2) / (2.0 * a), 0.0)
    durations_s: Array = (top - first + top - last) / a + cruise / top
    return durations_s


def _graded(durations_s: Array) -> Array:
    """Return the durations, lengthened where they are too short beside their neighbours."""
    graded = durations_s.copy()
    for i in range(1, len(graded)):
        graded[i] = max(graded[i], graded[i - 1] / RATIO_MAX)
    for i in range(len(graded) - 2, -1, -1):
        graded[i] = max(graded[i], graded[i + 1] / RATIO_MAX)
    return graded


class _Round:
    """One round of the search: multipliers and penalty are fixed.

    The variables are z = sqrt(T0) log(T / T0) with the durations T0 at the beginning: equally stiff for short and long
    pieces.
    """

    def __init__(self, start_s: Array, knots: Knots, gauge: Gauge, multipliers: Excess, penalty: float) -> None:
        self._start_s, self._knots, self._gauge = start_s, knots, gauge
        self._multipliers, self._penalty = multipliers, penalty
        self._stretch = np.sqrt(start_s)
        self._weights = start_s / SAMPLES
        self.maps = _maps(np.linspace(0.0, 1.0, SAMPLES))

    def best(self) -> Array:
        """Return the durations with the least value."""
        start = self._start_s
        around = np.maximum(np.concatenate([[0.0], start[:-1]]), np.concatenate([start[1:], [0.0]]))
        least = np.maximum(start / CHANGE_MAX, np.minimum(start, around / RATIO_MAX))
        low, high = self._stretch * np.log(least / start), self._stretch * np.log(CHANGE_MAX)
        z = minimise(self._value, low, high, np.zeros_like(start), STEPS)
        durations_s: Array = start * np.exp(z / self._stretch)
        return durations_s

    def _value(self, z: Array) -> tuple[float, Array]:
        """Return the sum of durations and penalty, and its gradient over z."""
        t = self._start_s * np.exp(z / self._stretch)
        solution = solve(self._knots, t)
        derivatives = _derivatives(solution, self.maps)
        excess, parts = self._gauge.excess(*derivatives)
        value, active = float(t.sum()), np.zeros((SAMPLES, len(t)), dtype=bool)
        pulls = []
        for m, e in zip(self._multipliers, excess, strict=True):
            pull = np.maximum(0.0, m + self._penalty * e)
            value += float(((pull * pull - m * m) * self._weights).sum()) / (2.0 * self._penalty)
            active |= pull > 0.0
            pulls.append(pull * self._weights)
        at = np.flatnonzero(active)
        few = self._gauge.gradient(parts.at(at), Excess(*(pull.ravel()[at] for pull in pulls)))
        direct, local = np.zeros_like(t), np.zeros((3, 9, len(t)))
        for k, (back, derivative, gradient) in enumerate(zip(self.maps, derivatives, few, strict=True), start=1):
            spread = np.zeros_like(derivative)
            spread.reshape(3, -1)[:, at] = gradient
            local += back.T @ (spread / t**k)
            direct -= k * (spread * derivative).sum((0, 1))
        slope = 1.0 + direct / t + solution.rates(local)
        return value, slope * t / self._stretch


def _maps(x: Array) -> tuple[Array, Array, Array]:
    """Return what maps a piece's local unknowns to velocity, acceleration and jerk over x."""
    b = basis(4)
    return b.values(1, x), b.values(2, x), b.values(3, x)


def _derivatives(solution: Solution, maps: Sequence[Array]) -> list[Array]:
    """Return velocity, acceleration, ... at the samples of all pieces, as many as maps, each of shape
    (3, samples, n)."""
    y, t = solution.local(), solution.durations_s
    return [back @ y / t**k for k, back in enumerate(maps, start=1)]


def _largest(gauge: Gauge, v: Array, a: Array, j: Array, s: Array) -> Array:
    """Return the largest excess over any limit, torque included."""
    return np.maximum(np.maximum.reduce(gauge.excess(v, a, j)[0]), gauge.torque_excess(v, a, j, s))


def worst(solution: Solution, gauge: Gauge, zooms: int = ZOOMS) -> Array:
    """Return the largest excess over any limit in each piece, with `zooms` on the peaks between samples; shape (n,)."""
    x = np.linspace(0.0, 1.0, FINE_SAMPLES)
    excess = _largest(gauge, *_derivatives(solution, (*_maps(x), basis(4).values(4, x))))
    rising, falling = np.full_like(excess, True, dtype=bool), np.full_like(excess, True, dtype=bool)
    rising[1:] = excess[1:] >= excess[:-1]
    falling[:-1] = excess[:-1] >= excess[1:]
    found: Array = excess.max(0)
    at, piece = np.nonzero(rising & falling & (excess > -NEAR))
    coefficients = solution.coefficients(np.zeros_like(solution.knots.steps))[:, :, piece]
    middle, reach, t = x[at], 1.0 / (FINE_SAMPLES - 1), solution.durations_s[piece]
    for _ in range(zooms if len(piece) else 0):
        around = np.clip(middle + reach * np.linspace(-1.0, 1.0, ZOOM_SAMPLES)[:, None], 0.0, 1.0)
        values = _largest(gauge, *_horner(coefficients, around, t))
        best = values.argmax(0)
        middle = around[best, np.arange(len(piece))]
        np.maximum.at(found, piece, values.max(0))
        reach *= 2.0 / (ZOOM_SAMPLES - 1)
    return found


def _horner(c: Array, x: Array, t: Array) -> tuple[Array, Array, Array, Array]:
    """Return velocity, acceleration, jerk and snap (3, samples, n) of coefficients (3, 10, n) at x (samples, n)."""
    rows = [np.zeros((3, *x.shape)) for _ in range(5)]
    for k in range(c.shape[1] - 1, -1, -1):
        for i in (4, 3, 2, 1):
            rows[i] = rows[i] * x + rows[i - 1]
        rows[0] = rows[0] * x + c[:, k, None]
    return rows[1] / t, 2.0 * rows[2] / t**2, 6.0 * rows[3] / t**3, 24.0 * rows[4] / t**4


def settle(durations_s: Array, knots: Knots, gauge: Gauge, turn: Turn | None, progress: Progress) -> Allocation:
    """Return durations that keep all limits, near to those that `search` has found.

    Args:
        durations_s: from `search`.
        knots: as there.
        gauge: as there.
        turn: the limit of the heading's rate, if there is one.
        progress: told the share that is done.

    """

    def exceeded(t: Array, zooms: int = ZOOMS) -> Array:
        solution = solve(knots, t)
        found = worst(solution, gauge, zooms) + ROUNDING
        return found if turn is None else np.maximum(found, turn(solution))

    fixed = bool(knots.values.any())  # a velocity that does not change with the durations: scaling does not help
    enough, margin = (0.0, STRETCH_MARGIN) if fixed else (STRETCH_ENOUGH, 0.0)
    best, least = durations_s, inf
    for i in range(STRETCHES):
        excess = exceeded(durations_s, ZOOMS if fixed else 0)
        if excess.max() < least:
            best, least = durations_s, excess.max()
        if excess.max() <= enough:
            break
        stretch = np.minimum(STRETCH_GAIN * _spread(excess + margin), STRETCH_MAX)
        durations_s = _graded(durations_s * (1.0 + stretch))
        progress((i + 1) / STRETCHES)
    durations_s = best
    if not fixed:
        durations_s = _scaled(durations_s, exceeded, knots, turn is not None)
    return Allocation(durations_s, exceeded(durations_s) - ROUNDING)


def _spread(excess: Array) -> Array:
    """Return by how much to stretch each piece where some exceed the limits."""
    above = np.maximum(excess, 0.0)
    stretch = SPREAD[0] * above
    for distance, share in enumerate(SPREAD[1:], start=1):
        if distance < len(above):
            stretch[distance:] = np.maximum(stretch[distance:], share * above[:-distance])
            stretch[:-distance] = np.maximum(stretch[:-distance], share * above[distance:])
    return stretch


def _scaled(durations_s: Array, exceeded: Callable[[Array], Array], knots: Knots, together: bool) -> Array:
    """Return the durations with one factor for every part from rest to rest (or for all), so that the limits just
    hold."""
    rests = np.flatnonzero(knots.pinned.all(0))[:-1]
    starts = rests[:1] if together else rests
    counts = np.diff(np.append(starts, len(durations_s)))
    kept = None
    for _ in range(SCALINGS):
        by_part = np.maximum.reduceat(exceeded(durations_s), starts)
        if by_part.max() <= 0.0:
            kept = durations_s
            if by_part.min() > -SCALE_ENOUGH:
                break
        # What is above -1 falls at least as fast as durations grow, and at most about four times as fast.
        factors = 1.0 + np.where(by_part > 0.0, by_part * (1.0 + 1e-3), 0.25 * by_part)
        durations_s = durations_s * np.repeat(factors, counts)
    return durations_s if kept is None else kept
