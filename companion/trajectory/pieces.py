"""References as the checks, the plots and the loop see them: pieces with a duration, one after the other."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Reference
from companion.trajectory.shapes import Joint


class Piece(Protocol):
    """Anything that gives a reference over [0, duration_s]: a Trajectory, an Anchored one, a Join or a Chain."""

    @property
    def duration_s(self) -> float:
        """Time that it takes [s]."""
        ...

    @property
    def period_s(self) -> float | None:
        """Time of one lap [s]; None when it does not repeat."""
        ...

    def at(self, t_s: float) -> Reference:
        """Return the reference at a time from the piece's start [s]."""
        ...

    def joints(self) -> tuple[Joint, ...]:
        """Where pieces meet inside, with the exact values on either side."""
        ...


@dataclass(frozen=True, slots=True)
class Chain:
    """Pieces flown one after the other, such as a join, a trajectory and a stop.

    Before 0 it is the first piece's value there, past its end the last one's: each piece says what it does outside of
    its own time.
    """

    pieces: tuple[Piece, ...]
    starts_s: tuple[float, ...]
    """When each piece starts [s]."""

    @property
    def duration_s(self) -> float:
        """Time of all pieces [s]."""
        return self.starts_s[-1] + self.pieces[-1].duration_s

    @property
    def period_s(self) -> None:
        """A chain does not repeat."""
        return

    def at(self, t_s: float) -> Reference:
        """Return the reference of the piece whose turn it is; at a joint that of the piece that begins."""
        index = max(bisect_right(self.starts_s, t_s) - 1, 0)
        return self.pieces[index].at(t_s - self.starts_s[index])

    def joints(self) -> tuple[Joint, ...]:
        """Where the pieces meet, and the joints inside of each."""
        found = []
        for piece, start_s in zip(self.pieces, self.starts_s, strict=True):
            found += [Joint(start_s + at_s, before, after) for at_s, before, after in piece.joints()]
        for (before, after), start_s in zip(pairwise(self.pieces), self.starts_s[1:], strict=True):
            found.append(Joint(start_s, before.at(before.duration_s), after.at(0.0)))
        return tuple(sorted(found, key=lambda joint: joint.at_s))


def chain(pieces: Sequence[Piece]) -> Chain:
    """Put at least one piece in a row."""
    starts_s = tuple(accumulate((piece.duration_s for piece in pieces[:-1]), initial=0.0))
    return Chain(tuple(pieces), starts_s)


class Samples(NamedTuple):
    """A reference sampled for plots: n instants, NED, SI."""

    t_s: NDArray[np.float64]
    """Shape (n,)."""
    p: NDArray[np.float64]
    """Position [m], shape (n, 3), as are the derivatives below."""
    v: NDArray[np.float64]
    a: NDArray[np.float64]
    j: NDArray[np.float64]
    s: NDArray[np.float64]
    yaw: NDArray[np.float64]
    """Commanded heading [rad], shape (n,)."""


def sample(piece: Piece, count: int = 500, laps: float | None = None) -> Samples:
    """Sample a piece at `count` (>= 2) evenly spaced instants; only its first `laps` when it repeats."""
    end_s = piece.duration_s
    if laps is not None and piece.period_s is not None:
        end_s = min(end_s, laps * piece.period_s)
    t_s = np.linspace(0.0, end_s, count)
    references = [piece.at(t) for t in t_s.tolist()]
    p, v, a, j, s = (np.array([r[k] for r in references]) for k in range(5))
    return Samples(t_s, p, v, a, j, s, np.array([r.yaw for r in references]))


def golden_maximum(f: Callable[[float], float], low: float, high: float, steps: int = 40) -> tuple[float, float]:
    """Return where in [low, high] a function with one maximum there is largest, and its value (golden section)."""
    ratio = (sqrt(5.0) - 1.0) / 2.0
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    f_left, f_right = f(left), f(right)
    for _ in range(steps):
        if f_left > f_right:
            high, right, f_right = right, left, f_left
            left = high - ratio * (high - low)
            f_left = f(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + ratio * (high - low)
            f_right = f(right)
    return (left, f_left) if f_left > f_right else (right, f_right)
