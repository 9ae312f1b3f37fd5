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
    a, b, c = f
    a1, b1, c1 = f1
    a2, b2, c2 = f2
    k = 1.0 / math.sqrt(a * a + b * b + c * c)
    x, y, z = k * a, k * b, k * c
    n1 = x * a1 + y * b1 + z * c1
    x1, y1, z1 = k * (a1 - n1 * x), k * (b1 - n1 * y), k * (c1 - n1 * z)
    n2 = x * a2 + y * b2 + z * c2 + x1 * a1 + y1 * b1 + z1 * c1
    n1 = 2.0 * n1
    return (
        (x, y, z),
        (x1, y1, z1),
        (k * (a2 - n2 * x - n1 * x1), k * (b2 - n2 * y - n1 * y1), k * (c2 - n2 * z - n1 * z1)),
    )


def unit_rate(f: Vec3, f1: Vec3) -> tuple[Vec3, Vec3]:
    """u = f/|f| with its first derivative; f must not be zero."""
    a, b, c = f
    a1, b1, c1 = f1
    k = 1.0 / math.sqrt(a * a + b * b + c * c)
    x, y, z = k * a, k * b, k * c
    n = x * a1 + y * b1 + z * c1
    return (x, y, z), (k * (a1 - n * x), k * (b1 - n * y), k * (c1 - n * z))


def desired_frame(force: tuple[Vec3, Vec3, Vec3], r3d: tuple[Vec3, Vec3], f: Vec3, f1: Vec3, f2: Vec3) -> Frame:
    """(40) and the yaw rate w3d = -r1d . r2d' that follows from R_d' = R_d S(w_d), with its derivative.

    Args:
        force: F/m and its first two derivatives; only their direction counts.
        r3d: the desired thrust direction F/|F| and its derivative (`unit_rate`).
        f: forward direction, not parallel to r3d; f1 and f2 its derivatives.
    """
    (ax, ay, az), (ax1, ay1, az1), (ax2, ay2, az2) = force
    fx, fy, fz = f
    fx1, fy1, fz1 = f1
    fx2, fy2, fz2 = f2
    # r2d has the direction of F x f. With its derivatives, written out: this is the longest part of a control step
    q = (ay * fz - az * fy, az * fx - ax * fz, ax * fy - ay * fx)
    q1 = (
        ay1 * fz - az1 * fy + ay * fz1 - az * fy1,
        az1 * fx - ax1 * fz + az * fx1 - ax * fz1,
        ax1 * fy - ay1 * fx + ax * fy1 - ay * fx1,
    )
    q2 = (
        ay2 * fz - az2 * fy + 2.0 * (ay1 * fz1 - az1 * fy1) + ay * fz2 - az * fy2,
        az2 * fx - ax2 * fz + 2.0 * (az1 * fx1 - ax1 * fz1) + az * fx2 - ax * fz2,
        ax2 * fy - ay2 * fx + 2.0 * (ax1 * fy1 - ay1 * fx1) + ax * fy2 - ay * fx2,
    )
    r2d, r2d_rate, r2d_acceleration = unit_derivatives(q, q1, q2)
    (ux, uy, uz), (ux1, uy1, uz1) = r3d
    yx, yy, yz = r2d
    yx1, yy1, yz1 = r2d_rate
    yx2, yy2, yz2 = r2d_acceleration
    # r1d = r2d x r3d; of its derivative only r2d x r3d' has a share in r1d' . r2d'
    xx, xy, xz = yy * uz - yz * uy, yz * ux - yx * uz, yx * uy - yy * ux
    w3d = -(xx * yx1 + xy * yy1 + xz * yz1)
    turned = (yy * uz1 - yz * uy1) * yx1 + (yz * ux1 - yx * uz1) * yy1 + (yx * uy1 - yy * ux1) * yz1
    w3d_rate = -(turned + xx * yx2 + xy * yy2 + xz * yz2)
    return Frame((xx, xy, xz), r2d, r2d_rate, w3d, w3d_rate)


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
    a, b, c = r3d
    d, e, g = ref.v
    x, y, z = b * g - c * e, c * d - a * g, a * e - b * d
    size = math.sqrt(x * x + y * y + z * z)
    threshold = 2.0 * speed_min if memory.held else speed_min
    if size > threshold:
        if memory.held:
            memory = HeadingState(memory.r2d, memory.forward, False)
        return ref.v, ref.a, ref.j, memory, size
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
    r3d = unit_rate(force[0], force[1])
    f, f1, f2, memory, size = forward_direction(ref, r3d[0], memory, kind, limits[1])
    if size < 1e-6:
        return -damping * w3, memory, math.nan
    frame = desired_frame(force, r3d, f, f1, f2)
    if dt_s > 0.0:
        frame = limit_rate(frame, r3d[0], memory.r2d, limits[0], dt_s)
    r1d, r2d, (a1, b1, c1), w3d, w3d_rate = frame
    (r10, r11, r12), (r20, r21, r22), (r30, r31, r32) = body
    a, b, c = r2d
    along = a * r10 + b * r11 + c * r12
    # d/dt(r2d . r1) = r2d' . r1 + r2d . (w3 r2 - w2 r3)
    turning = a * (w3 * r20 - w2 * r30) + b * (w3 * r21 - w2 * r31) + c * (w3 * r22 - w2 * r32)
    along_rate = a1 * r10 + b1 * r11 + c1 * r12 + turning
    tau3 = -l2 * (w3 - w3d + l1 * along) + w3d_rate - l1 * along_rate
    error = math.atan2(along, r1d[0] * r10 + r1d[1] * r11 + r1d[2] * r12)
    return tau3, HeadingState(r2d, memory.forward, memory.held), error
