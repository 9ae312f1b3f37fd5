"""Is a reference what the law needs: are its derivatives those of its position, and does nothing up to the third jump?

Two generic tests that know nothing of how a reference is made. Over every interval of a grid, the change of a
derivative is compared with the integral of the next one; where they differ, halving tells a jump (the difference stays)
from a curve (it vanishes). At scattered instants every derivative is compared with a finite difference of the one
below. Declared joints are compared by their exact values.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from math import dist, hypot, pi, remainder
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Reference
from companion.trajectory.batch import Batch
from companion.trajectory.pieces import Piece

JUMP_TOLERANCE = 1e-5
"""Smallest jump that counts, as a share of the derivative's largest value."""

SLOPE_TOLERANCE = 1e-3
"""Largest difference between a derivative and the finite difference of the one below, as a share of its largest
value."""

FLOOR = 1e-7
"""Jumps and differences below this (SI units) are rounding."""

HALVINGS = 10
JUMP_REMAINDER = 0.3
"""What must be left of a difference after halving its interval so often, for it to be a jump: of a curve a thousandth
is."""

SUSPECTS_MAX = 100
"""Intervals per derivative that are looked into, those with the largest differences."""

SLOPE_INSTANTS = 150
GOLDEN = 0.6180339887498949

NAMES = ("position", "velocity", "acceleration", "jerk", "snap")
UNITS = ("m", "m/s", "m/s^2", "m/s^3", "m/s^4")
YAW_NAMES = ("yaw", "yaw_rate", "yaw_acceleration")
YAW_UNITS = ("rad", "rad/s", "rad/s^2")

Levels = tuple[tuple[float, ...], ...]
"""One quantity with its derivatives, each as a vector."""

Rows = tuple[NDArray[np.float64], ...]
"""The same over a scan of n instants, each of shape (components, n)."""


class Finding(NamedTuple):
    """Something that is wrong with a reference's derivatives."""

    name: str
    """Of the derivative."""
    unit: str
    at_s: float
    value: float
    """Size of the jump, or of the difference between the derivative given and the true one."""
    limit: float
    jump: bool
    """True: it jumps. False: it is not the derivative of the one below."""


class _Channel(NamedTuple):
    """A quantity whose derivatives belong together: the position, or the heading."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    levels: Callable[[Reference], Levels]
    rows: Callable[[Batch], Rows]
    wraps: bool
    jumps: int
    """How many of the levels must not jump: up to jerk, up to the heading's rate."""


def _position_levels(r: Reference) -> Levels:
    return r.p, r.v, r.a, r.j, r.s


def _yaw_levels(r: Reference) -> Levels:
    return (r.yaw,), (r.yaw_rate,), (r.yaw_acceleration,)


def _position_rows(scan: Batch) -> Rows:
    return scan[:5]


def _yaw_rows(scan: Batch) -> Rows:
    return tuple(scan.yaw[:, None])


_CHANNELS = (
    _Channel(NAMES, UNITS, _position_levels, _position_rows, False, 4),
    _Channel(YAW_NAMES, YAW_UNITS, _yaw_levels, _yaw_rows, True, 2),
)


def findings(piece: Piece, times_s: Sequence[float], scan: Batch) -> list[Finding]:
    """Return what is wrong with a piece's derivatives, the first instance of each kind.

    Args:
        piece: what to look at.
        times_s: an increasing grid over the time that counts, fine enough to follow the reference [s].
        scan: the piece at these times, all finite.

    """
    found: list[Finding] = []
    for channel in _CHANNELS:
        rows = channel.rows(scan)
        scales = _scales(rows, channel.wraps)
        jumps = _joint_jumps(piece, channel, scales, times_s[-1]) + _grid_jumps(piece, channel, scales, times_s, rows)
        found += _first_of_each(jumps)
        if not jumps:
            # A jump spoils the finite differences around it, and is the finding that matters.
            found += _first_of_each(_slopes(piece, channel, scales, times_s))
    return found


def _scales(rows: Rows, wraps: bool) -> list[float]:
    """Return the size of each level over the grid: the largest length, of the lowest the largest way from its start."""
    lowest = pi if wraps else _longest(rows[0] - rows[0][:, :1])
    return [lowest, *(_longest(row) for row in rows[1:])]


def _longest(row: NDArray[np.float64]) -> float:
    size = float(np.abs(row).max())
    return size * float(np.sqrt(((row / size) ** 2).sum(0).max())) if size > 0.0 else 0.0


def _limit(share: float, scale: float) -> float:
    return max(share * scale, FLOOR)


def _difference(channel: _Channel, level: int, a: tuple[float, ...], b: tuple[float, ...]) -> float:
    if channel.wraps and level == 0:
        return abs(remainder(a[0] - b[0], 2.0 * pi))
    return dist(a, b)


def _joint_jumps(piece: Piece, channel: _Channel, scales: Sequence[float], end_s: float) -> list[Finding]:
    """Compare the exact values on both sides of the declared joints."""
    found = []
    for at_s, before, after in piece.joints():
        if at_s > end_s:
            continue
        for k, (a, b) in enumerate(zip(channel.levels(before), channel.levels(after), strict=True)):
            size, limit = _difference(channel, k, a, b), _limit(JUMP_TOLERANCE, scales[k])
            if k < channel.jumps and not size <= limit:
                found.append(Finding(channel.names[k], channel.units[k], at_s, size, limit, True))
    return found


def _residual(channel: _Channel, k: int, step_s: float, a: Levels, b: Levels) -> float:
    """Return by how much level k changes over a step beyond the integral of the level above (Hermite, or trapezoid)."""
    corrected = k + 2 < len(a)
    expected = []
    for i, value in enumerate(a[k]):
        change = step_s / 2.0 * (a[k + 1][i] + b[k + 1][i])
        if corrected:
            change += step_s * step_s / 12.0 * (a[k + 2][i] - b[k + 2][i])
        expected.append(value + change)
    return _difference(channel, k, tuple(expected), b[k])


def _grid_jumps(
    piece: Piece, channel: _Channel, scales: Sequence[float], times_s: Sequence[float], rows: Rows
) -> list[Finding]:
    """Look for jumps in every interval of the grid."""
    found: list[Finding] = []
    steps_s = np.diff(times_s)
    for k in range(channel.jumps):
        limit = _limit(JUMP_TOLERANCE, scales[k])
        firsts = _residuals(channel, k, steps_s, rows)
        above = np.flatnonzero(firsts > limit)
        for i in above[np.argsort(-firsts[above], kind="stable")][:SUSPECTS_MAX].tolist():
            at_s, last = _halved(piece, channel, k, times_s[i], times_s[i + 1])
            if last > limit and last > JUMP_REMAINDER * firsts[i]:
                found.append(Finding(channel.names[k], channel.units[k], at_s, last, limit, True))
    return found


def _residuals(channel: _Channel, k: int, steps_s: NDArray[np.float64], rows: Rows) -> NDArray[np.float64]:
    """Return `_residual` for all intervals of a grid."""
    change = steps_s / 2.0 * (rows[k + 1][:, :-1] + rows[k + 1][:, 1:])
    if k + 2 < len(rows):
        change += steps_s * steps_s / 12.0 * (rows[k + 2][:, :-1] - rows[k + 2][:, 1:])
    missed = rows[k][:, :-1] + change - rows[k][:, 1:]
    if channel.wraps and k == 0:
        missed = np.remainder(missed + pi, 2.0 * pi) - pi
    residuals: NDArray[np.float64] = np.sqrt((missed * missed).sum(0))
    return residuals


def _halved(piece: Piece, channel: _Channel, k: int, low_s: float, high_s: float) -> tuple[float, float]:
    """Follow the larger residual into ever smaller intervals; return where it ends and what is left of it."""
    low, high = channel.levels(piece.at(low_s)), channel.levels(piece.at(high_s))
    left_over = 0.0
    for _ in range(HALVINGS):
        mid_s = (low_s + high_s) / 2.0
        mid = channel.levels(piece.at(mid_s))
        left = _residual(channel, k, mid_s - low_s, low, mid)
        right = _residual(channel, k, high_s - mid_s, mid, high)
        left_over = max(left, right)
        if left > right:
            high_s, high = mid_s, mid
        else:
            low_s, low = mid_s, mid
    return (low_s + high_s) / 2.0, left_over


def _slopes(piece: Piece, channel: _Channel, scales: Sequence[float], times_s: Sequence[float]) -> list[Finding]:
    """Compare every derivative with a finite difference (fourth order) of the one below, at scattered instants.

    Differences across a declared joint are left out: what is beyond the fourth derivative may jump there.
    """
    start_s, end_s = times_s[0], times_s[-1]
    step_s = (times_s[1] - times_s[0]) / 16.0
    room_s = end_s - start_s - 4.0 * step_s
    joints_s = [joint.at_s for joint in piece.joints()]
    found = []
    for i in range(SLOPE_INSTANTS):
        t_s = start_s + 2.0 * step_s + room_s * (GOLDEN * i % 1.0)
        if bisect_left(joints_s, t_s - 2.0 * step_s) < bisect_right(joints_s, t_s + 2.0 * step_s):
            continue
        around = [channel.levels(piece.at(t_s + n * step_s)) for n in (-2, -1, 1, 2)]
        middle = channel.levels(piece.at(t_s))
        for k in range(1, len(middle)):
            slope = tuple(
                (8.0 * (c - b) - (d - a)) / (12.0 * step_s)
                for a, b, c, d in zip(*(level[k - 1] for level in around), strict=True)
            )
            size = dist(slope, middle[k])
            # Rounding of the level below grows with 1 / step.
            rounding = 1e-14 * (hypot(*middle[k - 1]) + scales[k - 1]) / step_s
            limit = _limit(SLOPE_TOLERANCE, scales[k]) + 10.0 * rounding
            if not size <= limit:
                found.append(Finding(channel.names[k], channel.units[k], t_s, size, limit, False))
    return found


def _first_of_each(all_found: Sequence[Finding]) -> list[Finding]:
    """Keep the earliest finding of each level."""
    kept: dict[str, Finding] = {}
    for finding in sorted(all_found, key=lambda f: f.at_s):
        kept.setdefault(finding.name, finding)
    return list(kept.values())
