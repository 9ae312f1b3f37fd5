"""Minimum-snap paths: the piecewise polynomials through given points at given times with the least integral of the
squared fourth derivative (or, for a heading, of the squared second one).

A piece is a polynomial of degree 2 r + 1 (r = 4: nine), given by the values and the first r derivatives at its ends, so
that pieces which share them at a knot are continuous up to the r-th derivative by construction. The derivatives at the
knots are the unknowns; those that a stop or a velocity pins are known. The integral is a quadratic form in them whose
matrix is banded, with 2 r - 1 diagonals on either side, and positive definite: one Cholesky factorisation solves all
axes in a time proportional to the number of pieces. Where no fourth derivative is pinned the result is of degree
seven, the natural minimum; beside a knot that pins it the two more degrees are what makes it continuous there.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import factorial, perm
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]

REFINEMENTS = 3
"""Rounds of iterative refinement with residuals in extended precision: pieces whose durations differ by a factor of
thirty have stiffnesses that differ by 30^7."""


@dataclass(frozen=True)
class Basis:
    """Constant matrices of one piece of order r, in the normalised time x = t / duration.

    Local unknowns, 2 r + 1 of them: the step from the piece's start to its end, then the derivatives 1..r over x at the
    start, then those at the end.
    """

    order: int
    powers: Array
    """Local unknowns to ascending coefficients, the constant left out as zero; shape (2 r + 2, 2 r + 1)."""
    energy: Array
    """Integral of the squared r-th derivative over x as a quadratic form; shape (2 r + 1, 2 r + 1)."""

    def values(self, derivative: int, x: Array) -> Array:
        """Return what maps local unknowns to a derivative over x at instants x (n,); shape (n, 2 r + 1)."""
        terms = len(self.powers)
        rows = [
            perm(k, derivative) * x ** (k - derivative) if k >= derivative else np.zeros_like(x) for k in range(terms)
        ]
        return np.stack(rows, axis=1) @ self.powers


@cache
def basis(order: int) -> Basis:
    """Return the matrices of order 2 or 4, worked out in fractions."""
    terms = 2 * order + 2
    conditions = [[Fraction(0)] * terms for _ in range(terms)]
    for k in range(order + 1):
        conditions[k][k] = Fraction(factorial(k))
        for power in range(k, terms):
            conditions[order + 1 + k][power] = Fraction(perm(power, k))
    inverse = _inverse(conditions)
    columns = [order + 1, *range(1, order + 1), *range(order + 2, terms)]
    powers = [[row[column] for column in columns] for row in inverse]
    products = [
        [
            Fraction(perm(a, order) * perm(b, order), a + b - 2 * order + 1) if min(a, b) >= order else Fraction(0)
            for b in range(terms)
        ]
        for a in range(terms)
    ]
    energy = _times(_times([list(column) for column in zip(*powers, strict=True)], products), powers)
    return Basis(order, np.array(powers, dtype=float), np.array(energy, dtype=float))


@dataclass(frozen=True)
class Knots:
    """What is known of a path before its times are: all that `solve` needs beside them. n pieces, `axes` axes."""

    order: int
    steps: Array
    """From each knot to the next, shape (axes, n)."""
    pinned: NDArray[np.bool_]
    """Which derivatives 1..r are known at the knots, for all axes alike; shape (r, n + 1)."""
    values: Array
    """What they are there, zero elsewhere; shape (axes, r, n + 1)."""


@dataclass(frozen=True)
class Solution:
    """The path of least integral for given durations."""

    knots: Knots
    durations_s: Array
    """Shape (n,)."""
    derivatives: Array
    """Of order 1..r at the knots, over time; shape (axes, r, n + 1)."""
    _factor: Array
    """Banded Cholesky factor of the scaled matrix."""
    _scale: Array
    """Of the unknowns, zero where they are pinned; shape (r, n + 1)."""

    def local(self) -> Array:
        """Return the local unknowns of the pieces (see `Basis`); shape (axes, 2 r + 1, n)."""
        return _local(self.knots.steps, _powers(self.knots.order, self.durations_s), self.derivatives)

    def cost(self) -> float:
        """Return the integral of the squared r-th derivative, all axes together."""
        r, y = self.knots.order, self.local()
        by_piece = (y * (basis(r).energy @ y)).sum((0, 1)) / self.durations_s ** (2 * r - 1)
        return float(by_piece.sum())

    def coefficients(self, starts: Array) -> Array:
        """Return ascending coefficients over x of the pieces that begin at `starts` (axes, n); shape
        (axes, 2 r + 2, n)."""
        c: Array = basis(self.knots.order).powers @ self.local()
        c[:, 0] = starts
        return c

    def rates(self, local_gradient: Array) -> Array:
        """Return how a quantity of the path changes with the durations, by way of the local unknowns.

        Args:
            local_gradient: of the quantity over `local()`, same shape.

        Returns:
            Shape (n,); how the quantity changes with the durations for given local unknowns is to be added.

        """
        r, t = self.knots.order, self.durations_s
        s, y = _powers(r, t), self.local()
        multipliers = _solved(self._factor, self._scale, _scattered(s, local_gradient))
        moved = _local(np.zeros_like(self.knots.steps), s, multipliers)
        # A piece's stiffness is S E S / T^(2 r - 1) with S = diag(T^exponents): its rate of change term by term.
        exponents = np.array([0, *range(1, r + 1), *range(1, r + 1)])[:, None]
        pull, stiff = basis(r).energy @ y, basis(r).energy @ moved
        direct = exponents * (local_gradient * y - (moved * pull + y * stiff) / t ** (2 * r - 1))
        through = (2 * r - 1) * (moved * pull) / t ** (2 * r - 1)
        rates: Array = (direct + through).sum((0, 1)) / t
        return rates


def solve(knots: Knots, durations_s: Array, refinements: int = 0) -> Solution:
    """Return the path of least integral for given durations.

    Args:
        knots: what is known.
        durations_s: of the pieces, above zero, shape (n,).
        refinements: rounds that make the derivatives exact to rounding even where durations differ much.

    """
    factor, scale = _factorised(knots, durations_s)
    precision = np.longdouble if refinements else np.float64
    derivatives = knots.values
    for _ in range(1 + refinements):
        gradient = _energy_gradient(knots, durations_s, derivatives, precision)
        derivatives = derivatives - _solved(factor, scale, gradient)
    return Solution(knots, durations_s, derivatives, factor, scale)


def _powers(order: int, durations_s: NDArray[Any]) -> NDArray[Any]:
    """Return durations to the powers 1..order, shape (order, n)."""
    rows = [durations_s]
    for _ in range(order - 1):
        rows.append(rows[-1] * durations_s)
    return np.stack(rows)


def _local(steps: NDArray[Any], scale: NDArray[Any], derivatives: NDArray[Any]) -> NDArray[Any]:
    """Return local unknowns (axes, 2 r + 1, n) of steps (axes, n) and derivatives over time (axes, r, n + 1)."""
    axes, r, n = derivatives.shape[0], derivatives.shape[1], steps.shape[1]
    y = np.empty((axes, 2 * r + 1, n), dtype=derivatives.dtype)
    y[:, 0] = steps
    np.multiply(scale, derivatives[:, :, :-1], out=y[:, 1 : r + 1])
    np.multiply(scale, derivatives[:, :, 1:], out=y[:, r + 1 :])
    return y


def _scattered(scale: NDArray[Any], local: NDArray[Any]) -> NDArray[Any]:
    """Return the sums over the pieces at each knot (axes, r, n + 1) of what belongs to local unknowns."""
    axes, r, n = local.shape[0], len(scale), local.shape[2]
    summed = np.zeros((axes, r, n + 1), dtype=local.dtype)
    summed[:, :, :-1] = scale * local[:, 1 : r + 1]
    summed[:, :, 1:] += scale * local[:, r + 1 :]
    return summed


def _factorised(knots: Knots, durations_s: Array) -> tuple[Array, Array]:
    """Return the banded Cholesky factor of the matrix scaled to a unit diagonal, and the scale."""
    r, n = knots.order, len(durations_s)
    energy = basis(r).energy
    s = _powers(r, durations_s) * durations_s ** (0.5 - r)
    own, next_ = slice(1, r + 1), slice(r + 1, 2 * r + 1)
    size = np.zeros((r, n + 1))
    size[:, :-1] = np.diag(energy)[own, None] * s * s
    size[:, 1:] += np.diag(energy)[next_, None] * s * s
    scale = np.where(knots.pinned, 0.0, 1.0 / np.sqrt(size))
    left, right = s * scale[:, :-1], s * scale[:, 1:]
    width = 2 * r - 1
    # Unknowns of a knot stand together; of the symmetric matrix only the upper diagonals are stored, each as a row.
    banded = np.zeros((width + 1, n + 1, r))
    for a in range(r):
        for b in range(r):
            if a < b:
                entry = banded[width + a - b, :, b]
                entry[:-1] = energy[1 + a, 1 + b] * left[a] * left[b]
                entry[1:] += energy[1 + r + a, 1 + r + b] * right[a] * right[b]
            banded[width + a - b - r, 1:, b] = energy[1 + a, 1 + r + b] * left[a] * right[b]
    banded[width] = 1.0
    factor: Array = cholesky_banded(banded.reshape(width + 1, -1), overwrite_ab=True, check_finite=False)
    return factor, scale


def _solved(factor: Array, scale: Array, right: Array) -> Array:
    """Return the solution for a right side of shape (axes, r, n + 1); zero where the unknowns are pinned."""
    axes = len(right)
    flat = (scale * right).transpose(0, 2, 1).reshape(axes, -1).T
    found = cho_solve_banded((factor, False), flat, overwrite_b=True, check_finite=False)
    solved: Array = scale * found.T.reshape(axes, scale.shape[1], -1).transpose(0, 2, 1)
    return solved


def _energy_gradient(knots: Knots, durations_s: Array, derivatives: Array, precision: type) -> Array:
    """Return half the gradient of the integral over the derivatives at the knots, summed up in a given precision."""
    r = knots.order
    t: NDArray[Any] = durations_s.astype(precision)
    s = _powers(r, t)
    y = _local(knots.steps.astype(precision), s, derivatives.astype(precision))
    slope = basis(r).energy.astype(precision) @ y / t ** (2 * r - 1)
    return _scattered(s, slope).astype(np.float64)


def _times(a: list[list[Fraction]], b: list[list[Fraction]]) -> list[list[Fraction]]:
    return [
        [sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*b, strict=True)]
        for row in a
    ]


def _inverse(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return the inverse of a regular matrix, by Gauss and Jordan."""
    size = len(matrix)
    rows = [[*row, *(Fraction(int(i == k)) for k in range(size))] for i, row in enumerate(matrix)]
    for i in range(size):
        pivot = next(k for k in range(i, size) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(size):
            if k != i and rows[k][i] != 0:
                rows[k] = [x - rows[k][i] * y for x, y in zip(rows[k], rows[i], strict=True)]
    return [row[size:] for row in rows]
