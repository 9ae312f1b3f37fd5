"""Polynomials of degree 9 that take a value and its first four derivatives from one end of an interval to the other."""

from __future__ import annotations

from companion.control.types import Reference

Derivatives = tuple[float, float, float, float, float]
"""A value and its first four derivatives over time (SI)."""

Coefficients = tuple[float, float, float, float, float, float, float, float, float, float]
"""Ascending powers of the normalised time x = t / duration."""


def through(start: Derivatives, end: Derivatives, duration_s: float) -> Coefficients:
    """Return the polynomial that has the derivatives `start` at 0 and `end` at `duration_s` (above zero).

    The lower five coefficients are the start's Taylor coefficients. The upper five take up what is then missing at x =
    1: the rows below are the inverse of the 5 x 5 matrix of the derivatives of x^5 .. x^9 at x = 1.
    """
    d1 = duration_s
    d2 = d1 * d1
    d3 = d2 * d1
    d4 = d2 * d2
    c0, c1, c2, c3, c4 = start[0], start[1] * d1, start[2] * d2 / 2.0, start[3] * d3 / 6.0, start[4] * d4 / 24.0
    r0 = end[0] - c0 - (c1 + c2 + c3 + c4)
    r1 = end[1] * d1 - (c1 + 2.0 * c2 + 3.0 * c3 + 4.0 * c4)
    r2 = end[2] * d2 - (2.0 * c2 + 6.0 * c3 + 12.0 * c4)
    r3 = end[3] * d3 - (6.0 * c3 + 24.0 * c4)
    r4 = end[4] * d4 - 24.0 * c4
    return (
        c0,
        c1,
        c2,
        c3,
        c4,
        126.0 * r0 - 56.0 * r1 + 10.5 * r2 - r3 + r4 / 24.0,
        -420.0 * r0 + 196.0 * r1 - 38.5 * r2 + 23.0 / 6.0 * r3 - r4 / 6.0,
        540.0 * r0 - 260.0 * r1 + 53.0 * r2 - 5.5 * r3 + r4 / 4.0,
        -315.0 * r0 + 155.0 * r1 - 32.5 * r2 + 3.5 * r3 - r4 / 6.0,
        70.0 * r0 - 35.0 * r1 + 7.5 * r2 - 5.0 / 6.0 * r3 + r4 / 24.0,
    )


def evaluate(c: Coefficients, duration_s: float, t_s: float) -> Derivatives:
    """Return the polynomial's value and its first four derivatives over time at `t_s` from its start."""
    c0, c1, c2, c3, c4, c5, c6, c7, c8, c9 = c
    n = 1.0 / duration_s
    x = t_s * n
    n2 = n * n
    y0 = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * (c5 + x * (c6 + x * (c7 + x * (c8 + x * c9))))))))
    y1 = c1 + x * (
        2.0 * c2
        + x
        * (3.0 * c3 + x * (4.0 * c4 + x * (5.0 * c5 + x * (6.0 * c6 + x * (7.0 * c7 + x * (8.0 * c8 + x * 9.0 * c9))))))
    )
    y2 = 2.0 * c2 + x * (
        6.0 * c3
        + x * (12.0 * c4 + x * (20.0 * c5 + x * (30.0 * c6 + x * (42.0 * c7 + x * (56.0 * c8 + x * 72.0 * c9)))))
    )
    y3 = 6.0 * c3 + x * (
        24.0 * c4 + x * (60.0 * c5 + x * (120.0 * c6 + x * (210.0 * c7 + x * (336.0 * c8 + x * 504.0 * c9))))
    )
    y4 = 24.0 * c4 + x * (120.0 * c5 + x * (360.0 * c6 + x * (840.0 * c7 + x * (1680.0 * c8 + x * 3024.0 * c9))))
    return y0, y1 * n, y2 * n2, y3 * n2 * n, y4 * n2 * n2


def of_axes(north: Derivatives, east: Derivatives, down: Derivatives, heading: tuple[float, float, float]) -> Reference:
    """Return the reference of three axes and of a heading [rad] with its rate and its acceleration; a kernel."""
    x0, x1, x2, x3, x4 = north
    y0, y1, y2, y3, y4 = east
    z0, z1, z2, z3, z4 = down
    return Reference((x0, y0, z0), (x1, y1, z1), (x2, y2, z2), (x3, y3, z3), (x4, y4, z4), *heading)


def travel_to_rest(start: Derivatives, duration_s: float) -> float:
    """Return how far the smoothest way to rest goes: the polynomial whose first derivative is of degree 7.

    That derivative matches the start's and has four zeros (value and three derivatives) at the end; its integral is
    exact in closed form. With no acceleration at the start it falls monotonically, so the way has no overshoot.
    """
    d = duration_s
    return d * (start[1] / 2.0 + d * (3.0 / 28.0 * start[2] + d * (start[3] / 84.0 + d * start[4] / 1680.0)))
