"""Splines through samples: as few polynomials of degree 9 as the samples need, continuous up to the eighth derivative.

A least-squares spline on knots taken from the samples' times. How many is decided by generalised cross-validation: more
knots until they only follow the noise. Samples that are exact are followed to within nanometres; samples that are
rounded or measured are smoothed by as much as they are uncertain, because differences of neighbours divided by the
fourth power of their spacing would otherwise be what the vehicle is told to do. Samples that are too far apart for that
are gone through exactly.

An end at which the samples rest is at rest up to the fourth derivative.
"""

from __future__ import annotations

from math import factorial, inf
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from companion.trajectory.piecewise import coefficients
from companion.trajectory.polynomial import Coefficients

Array = NDArray[np.float64]

DEGREE = 9
REST_TERMS = 5
"""Coefficients at a clamped end that are equal where value and four derivatives are constant."""

FREE_KNOTS = 4
"""Knots that are left out beside an end that moves: its derivatives come from more samples ("not a knot")."""

THROUGH_BEYOND = 0.01
"""Where the spline stays farther (m, rad) than this from some sample, one through all of them is considered."""

GROWTH = 1.5
"""Between numbers of knots that are tried."""

GCV_TOLERANCE = 1.02
"""The smallest number of knots within this factor of the best expected error is taken."""

EXACT = 1e-8
"""A root mean square distance below this (m, rad) is not noise: no more knots are tried."""

KNOTS_PER_SAMPLE_MAX = 0.8
"""Beyond this cross-validation says little."""

STALLED = 0.97
"""More knots are not tried where four numbers of them leave this share of the distance, evenly everywhere ..."""
EVEN = 1.6
"""... which is where no stretch of the path has more than this times the distance of the whole."""
CORRELATION_MAX = 0.3
"""Of neighbouring samples' distances: a path that is not followed yet leaves more."""
STRETCHES = 100
STRETCH_MIN = 40

LEFT_OUT_EVERY = 4

REST_SAMPLES = 3
REST_SPREAD = 1e-6
"""An end whose outermost samples are this close together (m, rad) is at rest."""

REST_SPEED = 0.02
REST_ACCELERATION = 0.2
"""Below both (SI) an end counts as at rest."""


class UnfitError(ValueError):
    """Samples that do not determine a spline."""


class Curve(NamedTuple):
    """A spline as polynomials, for one or several quantities; times from the first sample on."""

    knots_s: tuple[float, ...]
    pieces: tuple[tuple[Coefficients, ...], ...]
    """Per piece and quantity, ascending powers of the piece's normalised time."""
    rms: float
    """Root mean square distance from the samples."""
    largest: float
    """Largest distance from a sample."""
    largest_at_s: float
    through: bool
    """Whether it was made to go through every sample."""
    left_out: float
    """Largest distance of samples from a spline that goes through the others alone; 0 unless `through`."""
    rest: tuple[bool, bool]
    """Whether it is at rest at its ends."""
    spline: BSpline
    """The same, for evaluation at many instants."""


class _Try(NamedTuple):
    """A fitted spline and what it costs."""

    spline: BSpline
    residuals: Array
    """Distance of each sample, shape (n,)."""
    free: int
    """Number of coefficients that were free."""
    correlation: float
    """Of the distances of neighbouring samples, -1 to 1: near zero for noise."""
    through: bool = False
    """Whether it goes through every sample."""

    @property
    def rms(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def largest(self) -> float:
        """Largest distance."""
        return float(self.residuals.max())

    @property
    def gcv(self) -> float:
        """Generalised cross-validation: the mean square error of prediction."""
        share = 1.0 - self.free / len(self.residuals)
        return inf if share <= 0.0 else (self.rms / share) ** 2


def fit(
    t_s: Array,
    values: Array,
    *,
    distance_max: float | None = None,
    rest: tuple[bool | None, bool | None] = (None, None),
) -> Curve:
    """Return the spline through or along samples.

    Args:
        t_s: increasing, shape (n,), n >= 12 [s].
        values: one column per quantity, shape (n, d).
        distance_max: stay within this of every sample, and be as smooth as that allows; None: let the samples decide.
        rest: whether it is at rest at the start and at the end; None: let the samples decide.

    Raises:
        UnfitError: the samples do not determine one.

    """
    local = t_s - t_s[0]
    offset = values.mean(axis=0)
    centred = values - offset
    known = (
        _still(centred[:REST_SAMPLES]) if rest[0] is None else rest[0],
        _still(centred[-REST_SAMPLES:]) if rest[1] is None else rest[1],
    )
    found = _chosen(local, centred, known, distance_max)
    slow = _slow(found.spline, float(local[-1]))
    resting = tuple(known[i] or (rest[i] is None and slow[i]) for i in (0, 1))
    if resting != known:
        known = (resting[0], resting[1])
        found = _chosen(local, centred, known, distance_max)
    left_out = float(_left_out(local, centred, known).max()) if found.through else 0.0
    spline = BSpline(found.spline.t, found.spline.c + offset, DEGREE)
    knots_s, pieces = _polynomials(spline)
    worst = int(np.argmax(found.residuals))
    return Curve(knots_s, pieces, found.rms, found.largest, float(local[worst]), found.through, left_out, known, spline)


def _chosen(t_s: Array, values: Array, rest: tuple[bool, bool], distance_max: float | None) -> _Try:
    """Return the spline with as many knots as the samples support."""
    tries: list[_Try] = []
    most = int(KNOTS_PER_SAMPLE_MAX * (len(t_s) - 1))
    count = 1
    while count <= most:
        tried = _fitted(t_s, values, count, rest)
        if tried is not None:
            tries.append(tried)
            if distance_max is not None and tried.largest <= distance_max:
                return tried
            if tried.rms < EXACT or _settled(tries):
                break
        count = max(count + 1, round(GROWTH * count))
    bound = GCV_TOLERANCE**2 * min((tried.gcv for tried in tries), default=inf)
    found = next((tried for tried in tries if tried.gcv <= bound), None)
    limit = THROUGH_BEYOND if distance_max is None else distance_max
    if found is not None and found.largest <= limit:
        return found
    exact = _fitted(t_s, values, len(t_s) - 1, rest)
    if found is None and exact is None:
        raise UnfitError("no spline follows from these samples: their times are too uneven")
    if found is not None and (exact is None or (distance_max is None and _misses(t_s, values, rest) > found.gcv)):
        return found  # noise, and not a lack of samples: one through most of them misses the others by more
    assert exact is not None  # of the two one is there
    return exact._replace(through=True)


def _settled(tries: list[_Try]) -> bool:
    """Whether more knots only follow the noise: what is left does not shrink, and no stretch stands out."""
    if len(tries) < 5 or tries[-1].rms < STALLED * tries[-4].rms or tries[-1].correlation > CORRELATION_MAX:
        return False
    residuals = tries[-1].residuals
    length = max(STRETCH_MIN, len(residuals) // STRETCHES)
    usable = len(residuals) // length * length
    stretches = np.sqrt((residuals[:usable].reshape(-1, length) ** 2).mean(axis=1))
    return bool((stretches <= EVEN * tries[-1].rms).all())


def _fitted(t_s: Array, values: Array, count: int, rest: tuple[bool, bool]) -> _Try | None:
    """Return the least-squares spline with about `count` pieces; None where the samples do not determine one."""
    inner = np.round(np.linspace(0, len(t_s) - 1, count + 1)).astype(int)[1:-1]
    knots = t_s[inner]
    for at_start, resting in ((True, rest[0]), (False, rest[1])):
        if not resting:
            left = min(FREE_KNOTS, len(knots) // 2)
            knots = knots[left:] if at_start else knots[: len(knots) - left]
    full = np.concatenate([np.repeat(t_s[0], DEGREE + 1), knots, np.repeat(t_s[-1], DEGREE + 1)])
    merge = _merging(len(knots) + DEGREE + 1, rest)
    if merge is None or merge.shape[1] > len(t_s):
        return None
    design = BSpline.design_matrix(t_s, full, DEGREE).tocsr() @ merge
    solved = _least_squares(design, values)
    if solved is None:
        return None
    spline = BSpline(full, merge @ solved, DEGREE)
    apart = design @ solved - values
    squares = (apart**2).sum(axis=1)
    if not np.isfinite(squares).all():
        return None
    total = float(squares.sum())
    correlation = float((apart[1:] * apart[:-1]).sum()) / total if total > 0.0 else 0.0
    return _Try(spline, np.sqrt(squares), merge.shape[1], correlation)


def _merging(count: int, rest: tuple[bool, bool]) -> sp.csr_matrix | None:
    """Return the matrix from free coefficients to all: at an end that rests the outermost ones are one."""
    head = REST_TERMS - 1 if rest[0] else 0
    tail = REST_TERMS - 1 if rest[1] else 0
    free = count - head - tail
    if free < 2:
        return None
    columns = np.clip(np.arange(count) - head, 0, free - 1)
    return sp.csr_matrix((np.ones(count), (np.arange(count), columns)), shape=(count, free))


def _least_squares(design: sp.csr_matrix, values: Array) -> Array | None:
    """Solve the banded normal equations, with one refinement that makes up for their squared condition."""
    normal = (design.T @ design).todia()
    size = normal.shape[0]
    bands = np.zeros((DEGREE + 1, size))
    for offset, diagonal in zip(normal.offsets, normal.data, strict=True):
        if 0 <= offset <= DEGREE:
            bands[DEGREE - offset] = (
                diagonal[:size] if len(diagonal) >= size else np.pad(diagonal, (0, size - len(diagonal)))
            )
    try:
        factor = (cholesky_banded(bands), False)
        solved = cho_solve_banded(factor, design.T @ values)
        for _ in range(2):
            solved = solved + cho_solve_banded(factor, design.T @ (values - design @ solved))
    except (LinAlgError, ValueError):
        return None
    return solved


def _still(values: Array) -> bool:
    """Whether a few samples are one point."""
    return float(np.ptp(values, axis=0).max()) <= REST_SPREAD


def _slow(spline: BSpline, end_s: float) -> tuple[bool, bool]:
    """Whether a spline nearly stands still at its ends."""
    slow = []
    for at_s in (0.0, end_s):
        speed = float(np.linalg.norm(spline(at_s, 1)))
        acceleration = float(np.linalg.norm(spline(at_s, 2)))
        slow.append(speed < REST_SPEED and acceleration < REST_ACCELERATION)
    return slow[0], slow[1]


def _misses(t_s: Array, values: Array, rest: tuple[bool, bool]) -> float:
    """Return the mean square of `_left_out`, to compare with cross-validation."""
    return float(np.mean(_left_out(t_s, values, rest) ** 2))


def _left_out(t_s: Array, values: Array, rest: tuple[bool, bool]) -> Array:
    """Return how far a spline through three of every four samples stays from each fourth."""
    hidden = np.zeros(len(t_s), dtype=bool)
    hidden[2 : len(t_s) - 2 : LEFT_OUT_EVERY] = True
    seen = _fitted(t_s[~hidden], values[~hidden], int((~hidden).sum()) - 1, rest)
    if seen is None:
        return np.array([inf])
    distances: Array = np.sqrt(((seen.spline(t_s[hidden]) - values[hidden]) ** 2).sum(axis=1))
    return distances


def _polynomials(spline: BSpline) -> tuple[tuple[float, ...], tuple[tuple[Coefficients, ...], ...]]:
    """Return the spline's pieces in powers of their normalised time."""
    knots = np.unique(spline.t)
    lengths = np.diff(knots)
    powers = np.array([spline(knots[:-1], k) / factorial(k) for k in range(DEGREE + 1)])
    powers *= lengths[None, :, None] ** np.arange(DEGREE + 1)[:, None, None]
    rows = np.moveaxis(powers, 0, -1).tolist()
    return tuple(knots.tolist()), tuple(tuple(coefficients(axis) for axis in piece) for piece in rows)
