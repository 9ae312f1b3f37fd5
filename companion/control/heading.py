"""The free heading (section V of the paper): the third component of the angular acceleration.

Three choices: damping of the yaw rate, zero sideslip (nose along the path) and a commanded heading. The last two share
one construction: a forward direction f (p_d' or a horizontal unit vector) and the thrust direction r3d give r2d = r3d x
f/|r3d x f| (40), and (42) turns the body's y axis there. Where |r3d x f| is too small for a direction the last one is
held; a rate limit turns the desired direction no faster than the vehicle should yaw. All functions are kernels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.control.types import Reference, State, Vec3
from companion.control.vectors import cross, dot, norm, scale

DAMPING = 0
SIDESLIP = 1
COMMANDED = 2

FORCE_MIN_M_S2 = 0.5
"""|F|/m below which the thrust direction means nothing: the heading is damped and its memory kept."""


class HeadingState(NamedTuple):
    """What the heading remembers."""

    r2d: Vec3
    """The desired direction of the body's y axis, as limited in rate (unit vector, NED)."""
    forward: Vec3
    """The direction that is held while none is defined (unit vector, NED)."""
    held: bool
    """Whether that is so now."""


class Frame(NamedTuple):
    """The desired y axis and the yaw rate that goes with it."""

    r1d: Vec3
    r2d: Vec3
    r2d_rate: Vec3
    w3d: float
    """Desired yaw rate [rad/s]."""
    w3d_rate: float
    """Its derivative [rad/s^2]."""


def unit_derivatives(f: Vec3, f1: Vec3, f2: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """u = f/|f| with its first two derivatives, from those of f; f must not be zero."""
    k = 1.0 / math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    x, y, z = k * f[0], k * f[1], k * f[2]
    n1 = x * f1[0] + y * f1[1] + z * f1[2]
    x1, y1, z1 = k * (f1[0] - n1 * x), k * (f1[1] - n1 * y), k * (f1[2] - n1 * z)
    n2 = x * f2[0] + y * f2[1] + z * f2[2] + x1 * f1[0] + y1 * f1[1] + z1 * f1[2]
    n1 = 2.0 * n1
    return (
        (x, y, z),
        (x1, y1, z1),
        (k * (f2[0] - n2 * x - n1 * x1), k * (f2[1] - n2 * y - n1 * y1), k * (f2[2] - n2 * z - n1 * z1)),
    )


def desired_frame(r3d: tuple[Vec3, Vec3, Vec3], f: Vec3, f1: Vec3, f2: Vec3) -> Frame:
    """(40) and the yaw rate w3d = -r1d . r2d' that follows from R_d' = R_d S(w_d), with its derivative.

    Args:
        r3d: the desired thrust direction and its first two derivatives.
        f: forward direction, not parallel to r3d; f1 and f2 its derivatives.
    """
    (a, b, c), (a1, b1, c1), (a2, b2, c2) = r3d
    # q = r3d x f and its derivatives, written out: this is the longest part of a control step
    q = (b * f[2] - c * f[1], c * f[0] - a * f[2], a * f[1] - b * f[0])
    q1 = (
        b1 * f[2] - c1 * f[1] + b * f1[2] - c * f1[1],
        c1 * f[0] - a1 * f[2] + c * f1[0] - a * f1[2],
        a1 * f[1] - b1 * f[0] + a * f1[1] - b * f1[0],
    )
    q2 = (
        b2 * f[2] - c2 * f[1] + 2.0 * (b1 * f1[2] - c1 * f1[1]) + b * f2[2] - c * f2[1],
        c2 * f[0] - a2 * f[2] + 2.0 * (c1 * f1[0] - a1 * f1[2]) + c * f2[0] - a * f2[2],
        a2 * f[1] - b2 * f[0] + 2.0 * (a1 * f1[1] - b1 * f1[0]) + a * f2[1] - b * f2[0],
    )
    y, y1, y2 = unit_derivatives(q, q1, q2)
    # r1d = r2d x r3d and its derivative
    x = (y[1] * c - y[2] * b, y[2] * a - y[0] * c, y[0] * b - y[1] * a)
    x1 = (
        y1[1] * c - y1[2] * b + y[1] * c1 - y[2] * b1,
        y1[2] * a - y1[0] * c + y[2] * a1 - y[0] * c1,
        y1[0] * b - y1[1] * a + y[0] * b1 - y[1] * a1,
    )
    w3d = -(x[0] * y1[0] + x[1] * y1[1] + x[2] * y1[2])
    w3d_rate = -(x1[0] * y1[0] + x1[1] * y1[1] + x1[2] * y1[2] + x[0] * y2[0] + x[1] * y2[1] + x[2] * y2[2])
    return Frame(x, y, y1, w3d, w3d_rate)


def limit_rate(frame: Frame, r3d: Vec3, last: Vec3, rate_max: float, dt_s: float) -> Frame:
    """The frame, turned from the last r2d towards the wanted one by no more than rate_max dt about r3d.

    While the limit acts, w3d comes from the limited direction and w3d' is zero.
    """
    most = rate_max * dt_s
    x, y, z = frame.r2d[0] - last[0], frame.r2d[1] - last[1], frame.r2d[2] - last[2]
    if x * x + y * y + z * z < 0.9 * most * most and most < 0.5:
        return frame  # the usual case: even the chord between the two is shorter
    along = dot(last, r3d)
    flat = (last[0] - along * r3d[0], last[1] - along * r3d[1], last[2] - along * r3d[2])
    n = norm(flat)
    if n < 1e-6:
        return frame
    start = scale(1.0 / n, flat)
    side = cross(start, r3d)
    # angle from the last to the wanted direction, positive clockwise seen from above: r2d' = -w r1d
    angle = math.atan2(-dot(frame.r2d, side), dot(frame.r2d, start))
    if abs(angle) <= most:
        return frame
    rate = math.copysign(rate_max, angle)
    c, s = math.cos(rate * dt_s), math.sin(rate * dt_s)
    r2d = (c * start[0] - s * side[0], c * start[1] - s * side[1], c * start[2] - s * side[2])
    r1d = cross(r2d, r3d)
    return Frame(r1d, r2d, scale(-rate, r1d), rate, 0.0)


def forward_direction(
    ref: Reference, r3d: Vec3, memory: HeadingState, kind: int, speed_min: float
) -> tuple[Vec3, Vec3, Vec3, HeadingState, float]:
    """The forward direction f with two derivatives, the memory with the hold decision made, and |r3d x f|.

    For zero sideslip the hysteresis is on |r3d x p_d'|, not on the speed: a vertical climb has speed and no direction.
    """
    zero = (0.0, 0.0, 0.0)
    if kind == COMMANDED:
        c, s = math.cos(ref.yaw), math.sin(ref.yaw)
        n, n2 = ref.yaw_rate, ref.yaw_acceleration
        f = (c, s, 0.0)
        f1 = (-n * s, n * c, 0.0)
        f2 = (-n2 * s - n * n * c, n2 * c - n * n * s, 0.0)
        return f, f1, f2, HeadingState(memory.r2d, memory.forward, False), norm(cross(r3d, f))
    v = ref.v
    x, y, z = r3d[1] * v[2] - r3d[2] * v[1], r3d[2] * v[0] - r3d[0] * v[2], r3d[0] * v[1] - r3d[1] * v[0]
    size = math.sqrt(x * x + y * y + z * z)
    threshold = 2.0 * speed_min if memory.held else speed_min
    if size > threshold:
        return ref.v, ref.a, ref.j, HeadingState(memory.r2d, memory.forward, False), size
    forward = memory.forward
    if not memory.held:
        forward = cross(memory.r2d, r3d)
    return forward, zero, zero, HeadingState(memory.r2d, forward, True), norm(cross(r3d, forward))


def heading_torque(
    state: State,
    ref: Reference,
    force: tuple[Vec3, Vec3, Vec3],
    memory: HeadingState,
    kind: int,
    gains: tuple[float, float, float],
    limits: tuple[float, float],
    dt_s: float,
    body: tuple[Vec3, Vec3, Vec3],
) -> tuple[float, HeadingState, float]:
    """tau3 by (42), with the l1 in front of d/dt(r2d . r1) that the derivation needs.

    Args:
        state: the vehicle.
        ref: the reference; its velocity or its yaw gives the direction.
        force: F/m and its first two derivatives, NED [m/s^2 ...].
        memory: the heading's memory.
        kind: DAMPING, SIDESLIP or COMMANDED.
        gains: l1 [1/s], l2 [1/s], damping [1/s].
        limits: rate limit of the direction [rad/s], |r3d x p_d'| below which it is held [m/s].
        dt_s: sample interval [s]; 0: continuous form, no rate limit.
        body: the body's axes r1, r2, r3 (`vectors.axes` of the attitude).

    Returns:
        tau3 [rad/s^2], the memory, and the heading error (body x axis against r1d, about r3d) [rad] or NaN.
    """
    l1, l2, damping = gains
    _, w2, w3 = state.w
    x, y, z = force[0]
    if kind == DAMPING or x * x + y * y + z * z < FORCE_MIN_M_S2 * FORCE_MIN_M_S2:
        return -damping * w3, memory, math.nan
    r3d = unit_derivatives(force[0], force[1], force[2])
    f, f1, f2, memory, size = forward_direction(ref, r3d[0], memory, kind, limits[1])
    if size < 1e-6:
        return -damping * w3, memory, math.nan
    frame = desired_frame(r3d, f, f1, f2)
    if dt_s > 0.0:
        frame = limit_rate(frame, r3d[0], memory.r2d, limits[0], dt_s)
    r1, r2, r3 = body
    along = dot(frame.r2d, r1)
    # d/dt(r2d . r1) = r2d' . r1 + r2d . (w3 r2 - w2 r3)
    along_rate = dot(frame.r2d_rate, r1) + w3 * dot(frame.r2d, r2) - w2 * dot(frame.r2d, r3)
    tau3 = -l2 * (w3 - frame.w3d + l1 * along) + frame.w3d_rate - l1 * along_rate
    error = math.atan2(along, dot(frame.r1d, r1))
    return tau3, HeadingState(frame.r2d, memory.forward, memory.held), error
