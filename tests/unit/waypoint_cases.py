"""Paths through waypoints for tests, and an independent quadratic program for their least cost."""

from __future__ import annotations

from dataclasses import replace
from math import perm

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.minimum_snap import Knots
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.torque import Body
from companion.trajectory.waypoints import PlanLimits, Waypoint

Array = NDArray[np.float64]

LIMITS = PlanLimits(ReferenceLimits(6.0, 6.0, 1.0, 2.0, 17.0, 6.0), PointMass(1.0, 0.6), 1.0, Body(0.025, 0.57, 5.0))
"""A vehicle of 1 kg in 1 m/s of wind."""


def turning_limits(rate_rad_s: float) -> PlanLimits:
    """The same for a vehicle that follows the commanded heading."""
    return replace(LIMITS, reference=replace(LIMITS.reference, heading_rate_max_rad_s=rate_rad_s))


def points(seed: int, count: int) -> list[Waypoint]:
    """Random points some metres apart."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(count, 3)) * [5.0, 5.0, 2.0]
    return [Waypoint((float(x), float(y), float(z))) for x, y, z in np.cumsum(steps, axis=0)]


def with_demands(seed: int, waypoints: list[Waypoint]) -> list[Waypoint]:
    """Stops and speeds here and there between the ends."""
    rng = np.random.default_rng(1000 + seed)
    inner = []
    for waypoint in waypoints[1:-1]:
        kind = rng.integers(4)
        if kind == 0:
            inner.append(replace(waypoint, stop=True))
        elif kind == 1:
            inner.append(replace(waypoint, speed_m_s=float(rng.uniform(0.3, 2.0))))
        else:
            inner.append(waypoint)
    return [waypoints[0], *inner, waypoints[-1]]


def cost(shape: Piecewise) -> float:
    """The integral of the squared snap, by Gauss-Legendre quadrature of the pieces' fourth derivatives."""
    x, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for begin, end, piece in zip(shape.knots_s, shape.knots_s[1:], shape.pieces, strict=False):
        for axis in piece:
            snap = np.polynomial.Polynomial(axis).deriv(4)((x + 1.0) / 2.0) / (end - begin) ** 4
            total += float((weights * snap**2).sum()) * (end - begin) / 2.0
    return total


def dense_cost(knots: Knots, durations_s: Array) -> float:
    """The least integral of the squared r-th derivative, by a dense quadratic program over the monomials' coefficients.

    Every condition (values, what is pinned, continuity) is a row; the unknowns are what the rows leave free.
    """
    r, n = knots.order, len(durations_s)
    m = 2 * r + 2
    at = np.concatenate([np.zeros((len(knots.steps), 1)), np.cumsum(knots.steps, axis=1)], axis=1)
    rows: list[Array] = []
    right: list[Array] = []

    def row(piece: int, derivative: int, x: float) -> Array:
        found = np.zeros(n * m)
        for k in range(derivative, m):
            found[piece * m + k] = perm(k, derivative) * x ** (k - derivative) / durations_s[piece] ** derivative
        return found

    for i in range(n):
        rows += [row(i, 0, 0.0), row(i, 0, 1.0)]
        right += [at[:, i], at[:, i + 1]]
    for i in range(n + 1):
        for k in range(1, r + 1):
            here = row(i, k, 0.0) if i < n else row(n - 1, k, 1.0)
            if 0 < i < n:
                rows.append(here - row(i - 1, k, 1.0))
                right.append(np.zeros(len(at)))
            if knots.pinned[k - 1, i]:
                rows.append(here)
                right.append(knots.values[:, k - 1, i])
    quadratic = np.zeros((n * m, n * m))
    for i in range(n):
        for a in range(r, m):
            for b in range(r, m):
                integral = perm(a, r) * perm(b, r) / (a + b - 2 * r + 1)
                quadratic[i * m + a, i * m + b] = integral / durations_s[i] ** (2 * r - 1)
    matrix, values = np.array(rows), np.array(right)
    some = np.linalg.lstsq(matrix, values, rcond=None)[0]
    free = null_space(matrix)
    if free.shape[1]:
        some = some - free @ np.linalg.solve(free.T @ quadratic @ free, free.T @ quadratic @ some)
    return float(np.einsum("ai,ab,bi->", some, quadratic, some))
