"""A piece of a course as a row of numbers, for control steps that are compiled: what sines or polynomials give.

`curve_of` makes the numbers on the ground, `on_curve` evaluates them: the reference of `Anchored.at` or `Join.at`
within the piece's own time, to rounding. `on_curve` is a kernel (see `companion.accelerate`). Shapes that are neither
sines nor polynomials have no such row; whoever flies them asks the trajectory itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.control.types import Reference, Vec3
from companion.trajectory.anchored import Anchored, rotated
from companion.trajectory.joins import Join
from companion.trajectory.piecewise import TERMS, Piecewise
from companion.trajectory.polynomial import Derivatives, evaluate, of_axes
from companion.trajectory.shapes import ZERO, Circle, Helix, Hover, Lemniscate, Lissajous, Shape
from companion.trajectory.timing import scaled

WAVES = 1.0
POLYNOMIALS = 2.0

# where things stand in a row
KIND = 0
SCALE = 1
"""The trajectory's pace."""
COS = 2
SIN = 3
YAW = 4
"""Rotation about the vertical [rad], with its cosine and sine."""
OFFSET = 5
"""Added after the rotation, NED [m]."""
MOVED = 8
"""Added in the end: by how much the course was moved since it was planned, NED [m]."""
HEADING = 11
"""Commanded heading at the start [rad] and its rate [rad/s], where no polynomials give it."""
SHAPE = 13
"""Where the shape's own numbers begin."""
WAVE = 6
"""Numbers of an axis: centre [m], slope [m/s], and a sine's amplitude [m], rate [rad/s], phase [rad], cosine or not."""
KNOTS = SHAPE + 2
"""After the numbers of position and heading pieces: their knots [s], the coefficients, the same for the heading."""

Wave = tuple[float, float, float, float, float, float]


def curve_of(path: Anchored | Join) -> list[float] | None:
    """Return the row of a trajectory in its place, or of a join or stop; None for a shape that has none."""
    if isinstance(path, Join):
        knots = (0.0, path.duration_s)
        axes = (*path.north, *path.east, *path.down)
        return [POLYNOMIALS, 1.0, 1.0, *(0.0,) * (SHAPE - COS - 1), 1.0, 1.0, *knots, *axes, *knots, *path.yaw]
    trajectory = path.trajectory
    shape = trajectory.shape
    numbers = _polynomials(shape) if isinstance(shape, Piecewise) else _waves(shape)
    if numbers is None:
        return None
    kind = POLYNOMIALS if isinstance(shape, Piecewise) else WAVES
    place = (path.cos_yaw, path.sin_yaw, path.yaw_rad, *path.offset_m, *ZERO)
    return [kind, trajectory.time_scale, *place, *shape.heading, *numbers]


def _waves(shape: Shape) -> list[float] | None:
    north: Wave
    east: Wave
    down: Wave
    if isinstance(shape, Hover):
        north, east, down = (_still(x) for x in shape.point_m)
    elif isinstance(shape, Lemniscate):
        (x, y, z), (a, b), w = shape.center_m, shape.amplitude_m, shape.angular_rate_rad_s
        north, east, down = (x, 0.0, a, w, 0.0, 1.0), (y, 0.0, b, 2.0 * w, 0.0, 0.0), _still(z)
    elif isinstance(shape, Circle | Helix):
        (x, y, z), r, w, phase = shape.center_m, shape.radius_m, shape.angular_rate_rad_s, shape.phase_rad
        sink_m_s = -shape.climb_m_s if isinstance(shape, Helix) else 0.0
        north, east = (x, 0.0, r, w, phase, 1.0), (y, 0.0, r, w, phase, 0.0)
        down = (z, sink_m_s, 0.0, 0.0, 0.0, 0.0)
    elif isinstance(shape, Lissajous):
        parts = zip(shape.center_m, shape.amplitude_m, shape.angular_rate_rad_s, shape.phase_rad, strict=True)
        north, east, down = ((x, 0.0, amplitude, w, phase, 0.0) for x, amplitude, w, phase in parts)
    else:
        return None
    return [*north, *east, *down]


def _still(x: float) -> Wave:
    return x, 0.0, 0.0, 0.0, 0.0, 0.0


def _polynomials(shape: Piecewise) -> list[float]:
    numbers = [float(len(shape.pieces)), float(len(shape.yaw_pieces)), *shape.knots_s]
    for piece in shape.pieces:
        for axis in piece:
            numbers += axis
    numbers += shape.yaw_knots_s
    for yaw in shape.yaw_pieces:
        numbers += yaw
    return numbers


def on_curve(r: Sequence[float], t_s: float) -> Reference:
    """Return the reference at a time within the trajectory [s].

    Args:
        r: what `curve_of` gave.
        t_s: since its start, at the pace of the flight.
    """
    scale = r[SCALE]
    own_s = scale * t_s
    reference = _on_waves(r, own_s) if r[KIND] == WAVES else _on_polynomials(r, own_s)
    if scale != 1.0:
        reference = scaled(reference, scale)
    p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = reference
    if r[YAW] != 0.0:
        cos, sin = r[COS], r[SIN]
        p, v, a = rotated(cos, sin, p), rotated(cos, sin, v), rotated(cos, sin, a)
        j, s = rotated(cos, sin, j), rotated(cos, sin, s)
        yaw += r[YAW]
    p = (p[0] + r[OFFSET] + r[MOVED], p[1] + r[OFFSET + 1] + r[MOVED + 1], p[2] + r[OFFSET + 2] + r[MOVED + 2])
    return Reference(p, v, a, j, s, yaw, yaw_rate, yaw_acceleration)


def _on_waves(r: Sequence[float], t_s: float) -> Reference:
    north, east, down = _wave(r, SHAPE, t_s), _wave(r, SHAPE + WAVE, t_s), _wave(r, SHAPE + 2 * WAVE, t_s)
    return of_axes(north, east, down, _steady_heading(r, t_s))


def _steady_heading(r: Sequence[float], t_s: float) -> Vec3:
    return r[HEADING] + r[HEADING + 1] * t_s, r[HEADING + 1], 0.0


def _wave(r: Sequence[float], at: int, t_s: float) -> Derivatives:
    """Return an axis and its first four derivatives."""
    centre, slope, amplitude, w, phase = r[at], r[at + 1], r[at + 2], r[at + 3], r[at + 4]
    if amplitude == 0.0:
        return centre + slope * t_s, slope, 0.0, 0.0, 0.0
    angle = w * t_s + phase
    s, c = amplitude * math.sin(angle), amplitude * math.cos(angle)
    w2 = w * w
    if r[at + 5] > 0.5:
        return centre + c + slope * t_s, slope - w * s, -w2 * c, w2 * w * s, w2 * w2 * c
    return centre + s + slope * t_s, slope + w * c, -w2 * s, -w2 * w * c, w2 * w2 * s


def _on_polynomials(r: Sequence[float], t_s: float) -> Reference:
    count, yaw_count = int(r[SHAPE]), int(r[SHAPE + 1])
    coefficients = KNOTS + count + 1
    end_s = r[KNOTS + count]
    inside_s = min(max(t_s, 0.0), end_s)
    i = _piece(r, KNOTS, count, inside_s)
    at, begin_s = coefficients + 3 * TERMS * i, r[KNOTS + i]
    duration_s = r[KNOTS + i + 1] - begin_s
    north = _polynomial(r, at, duration_s, inside_s - begin_s)
    east = _polynomial(r, at + TERMS, duration_s, inside_s - begin_s)
    down = _polynomial(r, at + 2 * TERMS, duration_s, inside_s - begin_s)
    if inside_s != t_s:
        past_s = t_s - inside_s
        north, east, down = _straight_on(north, past_s), _straight_on(east, past_s), _straight_on(down, past_s)
    heading = _steady_heading(r, t_s)
    if yaw_count > 0:
        knots = coefficients + 3 * TERMS * count
        inside_s = min(max(t_s, r[knots]), r[knots + yaw_count])
        i = _piece(r, knots, yaw_count, inside_s)
        begin_s = r[knots + i]
        at, duration_s = knots + yaw_count + 1 + TERMS * i, r[knots + i + 1] - begin_s
        yaw, yaw_rate, yaw_acceleration, _, _ = _polynomial(r, at, duration_s, inside_s - begin_s)
        heading = (yaw, yaw_rate, yaw_acceleration) if inside_s == t_s else (yaw, 0.0, 0.0)
    return of_axes(north, east, down, heading)


def _straight_on(axis: Derivatives, past_s: float) -> Derivatives:
    """Return an axis so long after the end of its polynomials [s]."""
    return axis[0] + past_s * axis[1], axis[1], 0.0, 0.0, 0.0


def _piece(r: Sequence[float], knots: int, count: int, t_s: float) -> int:
    """Return which piece it is at a time; at a joint the one that begins."""
    low, high = 0, count - 1
    while low < high:
        middle = (low + high + 1) // 2
        if r[knots + middle] <= t_s:
            low = middle
        else:
            high = middle - 1
    return low


def _polynomial(r: Sequence[float], at: int, duration_s: float, t_s: float) -> tuple[float, float, float, float, float]:
    c = (r[at], r[at + 1], r[at + 2], r[at + 3], r[at + 4], r[at + 5], r[at + 6], r[at + 7], r[at + 8], r[at + 9])
    return evaluate(c, duration_s, t_s)
