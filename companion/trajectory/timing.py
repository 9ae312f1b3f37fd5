"""References at another pace: the exact derivatives of reference(f(t)), and the pace that runs a path out to rest."""

from __future__ import annotations

from companion.control.types import Reference, Vec3

Pace = tuple[float, float, float, float, float]
"""The path's time f [s] and its first four derivatives over the flight's time."""

RUN_OUT_MIN_S = 2.0
"""Shortest time over which a path is run out to rest."""

RUN_OUT_ACCELERATION_M_S2 = 2.0
"""What running out adds at most to the acceleration along the path."""


def paced(reference: Reference, pace: Pace) -> Reference:
    """Return the reference seen at another pace, by the chain rule; `reference` is taken at f."""
    _, f1, f2, f3, f4 = pace
    v, a, j, s = reference.v, reference.a, reference.j, reference.s
    g1 = f1 * f1
    g2 = 3.0 * f1 * f2
    g3 = f1 * g1
    h2 = 3.0 * f2 * f2 + 4.0 * f1 * f3
    h3 = 6.0 * g1 * f2
    h4 = g1 * g1
    return Reference(
        reference.p,
        (f1 * v[0], f1 * v[1], f1 * v[2]),
        (g1 * a[0] + f2 * v[0], g1 * a[1] + f2 * v[1], g1 * a[2] + f2 * v[2]),
        (
            g3 * j[0] + g2 * a[0] + f3 * v[0],
            g3 * j[1] + g2 * a[1] + f3 * v[1],
            g3 * j[2] + g2 * a[2] + f3 * v[2],
        ),
        (
            h4 * s[0] + h3 * j[0] + h2 * a[0] + f4 * v[0],
            h4 * s[1] + h3 * j[1] + h2 * a[1] + f4 * v[1],
            h4 * s[2] + h3 * j[2] + h2 * a[2] + f4 * v[2],
        ),
        reference.yaw,
        f1 * reference.yaw_rate,
        g1 * reference.yaw_acceleration + f2 * reference.yaw_rate,
    )


def scaled(reference: Reference, scale: float) -> Reference:
    """Return the reference of a path played `scale` times as fast; `reference` is taken at scale * t."""
    k2 = scale * scale
    return Reference(
        reference.p,
        _times(scale, reference.v),
        _times(k2, reference.a),
        _times(k2 * scale, reference.j),
        _times(k2 * k2, reference.s),
        reference.yaw,
        scale * reference.yaw_rate,
        k2 * reference.yaw_acceleration,
    )


def run_out_duration_s(speed_m_s: float) -> float:
    """Return the time to run a path out to rest from a speed [m/s]; 35/16 is the steepest slope of `run_out`."""
    return max(RUN_OUT_MIN_S, 35.0 / 16.0 * speed_m_s / RUN_OUT_ACCELERATION_M_S2)


def run_out(past_s: float, duration_s: float) -> Pace:
    """Return the path's time beyond its end, `past_s` (>= 0) after it, when the path runs out to rest over
    `duration_s`.

    The pace falls from 1 to 0 with three zero derivatives at both ends, so that the reference stays continuous up to
    the fourth derivative and its path stays on the shape; in all the path's time goes on by half of `duration_s`.
    """
    if past_s >= duration_s:
        return duration_s / 2.0, 0.0, 0.0, 0.0, 0.0
    n = 1.0 / duration_s
    x = past_s * n
    x2 = x * x
    x3 = x2 * x
    return (
        past_s * (1.0 + x2 * x2 * (-7.0 + x * (14.0 + x * (-10.0 + x * 2.5)))),
        1.0 - x3 * x * (35.0 + x * (-84.0 + x * (70.0 - x * 20.0))),
        -140.0 * n * x3 * (1.0 - x) * (1.0 - x) * (1.0 - x),
        -420.0 * n * n * x2 * (1.0 - x) * (1.0 - x) * (1.0 - 2.0 * x),
        -840.0 * n * n * n * x * (1.0 - x) * (1.0 - 5.0 * x + 5.0 * x2),
    )


def _times(factor: float, vector: Vec3) -> Vec3:
    return factor * vector[0], factor * vector[1], factor * vector[2]
