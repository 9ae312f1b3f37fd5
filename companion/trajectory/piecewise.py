"""References made of polynomials, one piece after the other: what planning through waypoints and files give."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Reference
from companion.trajectory.pieces import Samples
from companion.trajectory.polynomial import Coefficients, Derivatives, evaluate, of_axes
from companion.trajectory.shapes import ZERO, Joint, Shape

TERMS = 10
"""Coefficients of a piece: degree 9 at most."""

CHUNK = 4096
"""Instants that are sampled at once, to stay within the processor's caches."""


class PathPiece(NamedTuple):
    """The position over one piece, each axis in ascending powers of x = t / duration from the piece's start."""

    north: Coefficients
    east: Coefficients
    down: Coefficients


@dataclass(frozen=True, slots=True, kw_only=True)
class Piecewise(Shape):
    """Polynomials of degree 9 or less, one after the other, from 0 on.

    Outside of its time an end that moves goes on straight at its velocity, one at rest stays there.
    """

    knots_s: tuple[float, ...]
    """Where pieces begin and end, increasing, the first 0.0 [s]; one more than there are pieces."""
    pieces: tuple[PathPiece, ...]
    yaw_knots_s: tuple[float, ...] = ()
    """The same for the heading, whose pieces need not be those of the position. Outside of it the heading stays."""
    yaw_pieces: tuple[Coefficients, ...] = ()
    """Heading [rad]; empty: it is `heading`."""

    @property
    def own_duration_s(self) -> float:
        """The time of all pieces [s]."""
        return self.knots_s[-1]

    def at(self, t_s: float) -> Reference:
        """Return the reference; at a joint that of the piece that begins."""
        knots = self.knots_s
        end = knots[-1]
        inside = min(max(t_s, 0.0), end)
        index = min(bisect_right(knots, inside) - 1, len(self.pieces) - 1)
        if inside == t_s:
            return self._inside(index, t_s)
        edge = self._inside(index, inside)
        past_s = t_s - inside
        p, v = edge.p, edge.v
        moved = (p[0] + past_s * v[0], p[1] + past_s * v[1], p[2] + past_s * v[2])
        yaw, yaw_rate, yaw_acceleration = self._yaw(t_s)
        return Reference(moved, v, ZERO, ZERO, ZERO, yaw, yaw_rate, yaw_acceleration)

    def joints(self) -> tuple[Joint, ...]:
        """Where pieces of the position meet."""
        return tuple(
            Joint(self.knots_s[i], self._inside(i - 1, self.knots_s[i]), self._inside(i, self.knots_s[i]))
            for i in range(1, len(self.pieces))
        )

    def sampled(self, t_s: NDArray[np.float64]) -> Samples:
        """Return the reference at many instants within [0, own_duration_s], the same as `at` to rounding.

        Args:
            t_s: instants in any order, shape (n,) [s].

        """
        path = np.array(self.pieces)
        rows = _sampled(np.array(self.knots_s), path, t_s)
        return Samples(t_s, rows[0], rows[1], rows[2], rows[3], rows[4], self.headings(t_s)[0])

    def headings(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return heading [rad], its rate and its acceleration at many instants, shape (3, n)."""
        if not self.yaw_pieces:
            rate = np.full(t_s.shape, self.heading.yaw_rate_rad_s)
            return np.stack([self.heading.yaw_rad + rate * t_s, rate, np.zeros(t_s.shape)])
        knots_s = np.array(self.yaw_knots_s)
        inside = np.clip(t_s, knots_s[0], knots_s[-1])
        found = _sampled(knots_s, np.array(self.yaw_pieces)[:, None, :], inside)[:3, :, 0]
        found[1:, inside != t_s] = 0.0
        return found

    def _inside(self, index: int, t_s: float) -> Reference:
        start_s = self.knots_s[index]
        duration_s = self.knots_s[index + 1] - start_s
        north, east, down = self.pieces[index]
        return of_axes(
            evaluate(north, duration_s, t_s - start_s),
            evaluate(east, duration_s, t_s - start_s),
            evaluate(down, duration_s, t_s - start_s),
            self._yaw(t_s),
        )

    def _yaw(self, t_s: float) -> tuple[float, float, float]:
        """Return heading, rate and acceleration."""
        if not self.yaw_pieces:
            yaw_rate = self.heading.yaw_rate_rad_s
            return self.heading.yaw_rad + yaw_rate * t_s, yaw_rate, 0.0
        knots = self.yaw_knots_s
        inside = min(max(t_s, knots[0]), knots[-1])
        index = min(bisect_right(knots, inside) - 1, len(self.yaw_pieces) - 1)
        start_s = knots[index]
        found: Derivatives = evaluate(self.yaw_pieces[index], knots[index + 1] - start_s, inside - start_s)
        return (found[0], found[1], found[2]) if inside == t_s else (found[0], 0.0, 0.0)


def coefficients(values: Sequence[float]) -> Coefficients:
    """Return up to `TERMS` ascending powers of the normalised time, filled up with zeros."""
    c0, c1, c2, c3, c4, c5, c6, c7, c8, c9 = (*map(float, values), *([0.0] * (TERMS - len(values))))
    return c0, c1, c2, c3, c4, c5, c6, c7, c8, c9


def _sampled(
    knots_s: NDArray[np.float64], pieces: NDArray[np.float64], t_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values and the first four derivatives, shape (5, n, axes), of pieces of shape (count, axes, TERMS)."""
    found = np.empty((5, len(t_s), pieces.shape[1]))
    index = np.clip(np.searchsorted(knots_s, t_s, side="right") - 1, 0, len(pieces) - 1)
    n = 1.0 / np.diff(knots_s)[index]
    x = (t_s - knots_s[index]) * n
    for begin in range(0, len(t_s), CHUNK):
        part = slice(begin, begin + CHUNK)
        _horner(np.moveaxis(pieces[index[part]], 2, 0), x[part, None], found[:, part])
    for k, factor in enumerate((1.0, 1.0, 2.0, 6.0, 24.0)):
        found[k] *= (factor * n**k)[:, None]
    return found


def _horner(c: NDArray[np.float64], x: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write value and derivatives over k!, by x, into `out` (5, ...), by Horner's scheme on all of them at once."""
    out[:] = 0.0
    for coefficient in c[::-1]:
        for k in (4, 3, 2, 1):
            out[k] *= x
            out[k] += out[k - 1]
        out[0] *= x
        out[0] += coefficient
