"""Pieces of a file that meet but for the digits that the file was written with: they are made to meet.

Six decimals of a coefficient of the seventh power are a jump of a millimetre per second cubed in the third derivative.
That is no mistake of whoever made the path, but it is a jump all the same; what is larger than the digits explain is
left as it is, for the check to refuse.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import perm
from typing import NamedTuple

from companion.trajectory.polynomial import Coefficients, Derivatives, evaluate, through

TERMS_WRITTEN = 8
SLACK = 2.0
"""How much larger than half a digit per coefficient a jump may be: durations are rounded too."""
FLOOR = 1e-12
EXPONENT_MAX = 6
"""Longest exponent that is looked at [characters]."""


class Closed(NamedTuple):
    """Pieces that meet where rounding alone kept them apart."""

    pieces: tuple[Coefficients, ...]
    joints: int
    """How many were closed."""
    largest: float
    """Largest jump in value among them."""


def last_digit(cell: str) -> float:
    """Return the size of the last digit that a number is written with, such as 1e-6; of a whole one 0: it is exact."""
    mantissa, _, exponent = cell.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    if len(exponent) > EXPONENT_MAX:
        return 0.0
    power = int(exponent) if exponent else 0
    if decimals == 0 and power == 0:
        return 0.0
    return 10.0 ** max(-300, min(300, power - decimals))


def close(pieces: Sequence[Coefficients], durations_s: Sequence[float], quanta: Sequence[float]) -> Closed:
    """Return the pieces of one quantity with joints closed that rounding explains.

    Both sides of a joint get the mean of their value and of their derivatives up to the third; of the fourth where that
    meets but for rounding as well.

    Args:
        pieces: ascending powers of the normalised time of each.
        durations_s: of each.
        quanta: the last digit of each piece's coefficients, in powers of seconds.

    """
    ends = [evaluate(c, d, d) for c, d in zip(pieces, durations_s, strict=True)]
    starts = [evaluate(c, d, 0.0) for c, d in zip(pieces, durations_s, strict=True)]
    new_ends, new_starts = list(ends), list(starts)
    count, largest = 0, 0.0
    for i in range(len(pieces) - 1):
        rounding = [
            a + b for a, b in zip(_rounding(durations_s[i], quanta[i]), _rounding(0.0, quanta[i + 1]), strict=True)
        ]
        jumps = [abs(a - b) for a, b in zip(ends[i], starts[i + 1], strict=True)]
        near = [jump <= SLACK * by + FLOOR for jump, by in zip(jumps, rounding, strict=True)]
        if not all(near[:4]) or not any(jumps[:4]):
            continue
        new_ends[i] = new_starts[i + 1] = _mean(ends[i], starts[i + 1])
        if not near[4]:
            new_ends[i] = (*new_ends[i][:4], ends[i][4])
            new_starts[i + 1] = (*new_starts[i + 1][:4], starts[i + 1][4])
        count, largest = count + 1, max(largest, jumps[0])
    corrected = []
    for c, d, start, end, new_start, new_end in zip(
        pieces, durations_s, starts, ends, new_starts, new_ends, strict=True
    ):
        change = through(_difference(new_start, start), _difference(new_end, end), d)
        corrected.append(_sum(c, change))
    return Closed(tuple(corrected), count, largest)


def _rounding(duration_s: float, quantum: float) -> list[float]:
    """Return by how much half a digit in every coefficient moves the value and its derivatives at a time, at most."""
    return [0.5 * quantum * sum(perm(k, r) * duration_s ** (k - r) for k in range(r, TERMS_WRITTEN)) for r in range(5)]


def _mean(a: Derivatives, b: Derivatives) -> Derivatives:
    v0, v1, v2, v3, v4 = (0.5 * (x + y) for x, y in zip(a, b, strict=True))
    return v0, v1, v2, v3, v4


def _difference(a: Derivatives, b: Derivatives) -> Derivatives:
    v0, v1, v2, v3, v4 = (x - y for x, y in zip(a, b, strict=True))
    return v0, v1, v2, v3, v4


def _sum(a: Coefficients, b: Coefficients) -> Coefficients:
    c0, c1, c2, c3, c4, c5, c6, c7, c8, c9 = (x + y for x, y in zip(a, b, strict=True))
    return c0, c1, c2, c3, c4, c5, c6, c7, c8, c9
