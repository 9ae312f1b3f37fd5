"""The free heading (section V of the paper): the third component of the angular acceleration.

Three choices: damping of the yaw rate, zero sideslip (nose along the path) and a commanded heading. The last two share
one construction: a forward direction f (p_d' or a horizontal unit vector) and the thrust direction r3d give r2d = r3d x
f/|r3d x f| (40), and (42) turns the body's y axis there. Where |r3d x f| is too small for a direction the last one is
held; a rate limit turns the desired direction no faster than the vehicle should yaw. All functions are kernels.
"""

from __future__ import annotations

from math import atan2, copysign, cos, nan, sin, sqrt
from typing import NamedTuple

from companion.control.types import Vec3
from companion.control.vectors import cross, dot, norm, scale

DAMPING = 0
SIDESLIP = 1
COMMANDED = 2

FORCE_MIN_M_S2 = 0.5
"""|F|/m below which the thrust direction means nothing: the heading is damped and its memory kept."""
ACROSS_MIN = 1e-6
"""|r3d x f| below which there is no direction either."""


class HeadingState(NamedTuple):
    """What the heading remembers."""

    r2d: Vec3
    """The desired direction of the body's y axis, as limited in rate (unit vector, NED)."""
    forward: Vec3
    """The direction that is held while none is defined (unit vector, NED)."""
    held: bool
    """Whether that is so now."""


PlainHeading = tuple[Vec3, Vec3, bool]
"""What a HeadingState holds."""
Frame = tuple[Vec3, Vec3, float, float, float]
"""The desired axes r1d and r2d, and the rates that go with them: the roll rate w1d, with which r2d leaves the plane at
right angles to r3d, r2d' = w1d r3d - w3d r1d, the yaw rate w3d [rad/s] and its derivative [rad/s^2]."""


def desired_frame(
    force: tuple[Vec3, Vec3, Vec3], size: float, r3d: Vec3, forward: tuple[Vec3, Vec3, Vec3], across: Vec3
) -> Frame:
    """(40) and the yaw rate w3d with its derivative that follow from R_d' = R_d S(w_d) (docs/law.md section 5).

    Args:
        force: F/m and its first two derivatives; only their direction counts.
        size: |F/m|.
        r3d: the desired thrust direction F/|F|.
        forward: f and its first two derivatives; f is not parallel to r3d.
        across: r3d x f.
    """
    _, (ax, ay, az), (bx, by, bz) = force
    (fx, fy, fz), (gx, gy, gz), (hx, hy, hz) = forward
    zx, zy, zz = r3d
    yx, yy, yz = across
    f1 = sqrt(yx * yx + yy * yy + yz * yz)
    k = 1.0 / f1
    yx, yy, yz = k * yx, k * yy, k * yz
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    # F stays along r3d, f stays in the plane of r1d and r3d: their derivatives' components in the frame give its rates
    per_size = 1.0 / size
    growth = per_size * (ax * zx + ay * zy + az * zz)
    w1 = -per_size * (ax * yx + ay * yy + az * yz)
    w2 = per_size * (ax * xx + ay * xy + az * xz)
    f3 = fx * zx + fy * zy + fz * zz
    w3 = k * (gx * yx + gy * yy + gz * yz + f3 * w1)
    w1_rate = w3 * w2 - 2.0 * w1 * growth - per_size * (bx * yx + by * yy + bz * yz)
    g1, g3 = gx * xx + gy * xy + gz * xz, gx * zx + gy * zy + gz * zz
    h2 = hx * yx + hy * yy + hz * yz
    w3_rate = k * (h2 + 2.0 * (w1 * g3 - w3 * g1) + w2 * (w3 * f3 + w1 * f1) + w1_rate * f3)
    return (xx, xy, xz), (yx, yy, yz), w1, w3, w3_rate


def limit_rate(frame: Frame, r3d: Vec3, last: Vec3, rate_max: float, dt_s: float) -> Frame:
    """The frame, turned from the last r2d towards the wanted one by no more than rate_max dt about r3d.

    While the limit acts, w3d comes from the limited direction and w3d' is zero.
    """
    most = rate_max * dt_s
    _, wanted, _, _, _ = frame
    along = dot(last, r3d)
    flat = (last[0] - along * r3d[0], last[1] - along * r3d[1], last[2] - along * r3d[2])
    n = norm(flat)
    if n < 1e-6:
        return frame
    start = scale(1.0 / n, flat)
    side = cross(start, r3d)
    # angle from the last to the wanted direction, positive clockwise seen from above: r2d' = -w r1d
    angle = atan2(-dot(wanted, side), dot(wanted, start))
    if abs(angle) <= most:
        return frame
    rate = copysign(rate_max, angle)
    c, s = cos(rate * dt_s), sin(rate * dt_s)
    r2d = (c * start[0] - s * side[0], c * start[1] - s * side[1], c * start[2] - s * side[2])
    r1d = cross(r2d, r3d)
    return r1d, r2d, 0.0, rate, 0.0


def forward_direction(
    path: tuple[Vec3, Vec3, Vec3], wanted: Vec3, r3d: Vec3, memory: PlainHeading, kind: int, speed_min: float
) -> tuple[tuple[Vec3, Vec3, Vec3], PlainHeading, Vec3]:
    """The forward direction f with two derivatives, the memory with the hold decision made, and r3d x f.

    For zero sideslip the hysteresis is on |r3d x p_d'|, not on the speed: a vertical climb has speed and no direction.
    """
    zero = (0.0, 0.0, 0.0)
    r2d, forward, held = memory
    if kind == COMMANDED:
        yaw, n, n2 = wanted
        c, s = cos(yaw), sin(yaw)
        f = (c, s, 0.0)
        f1 = (-n * s, n * c, 0.0)
        f2 = (-n2 * s - n * n * c, n2 * c - n * n * s, 0.0)
        return (f, f1, f2), (r2d, forward, False), cross(r3d, f)
    v, _, _ = path
    (x, y, z), (vx, vy, vz) = r3d, v
    x, y, z = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    threshold = 2.0 * speed_min if held else speed_min
    if x * x + y * y + z * z > threshold * threshold:
        return path, (r2d, forward, False), (x, y, z)
    if not held:
        forward = cross(r2d, r3d)
    return (forward, zero, zero), (r2d, forward, True), cross(r3d, forward)


def heading_torque(
    w: Vec3,
    path: tuple[Vec3, Vec3, Vec3],
    wanted: Vec3,
    force: tuple[Vec3, Vec3, Vec3],
    memory: PlainHeading,
    kind: int,
    l1: float,
    l2: float,
    damping: float,
    rate_max: float,
    speed_min: float,
    dt_s: float,
    body: tuple[Vec3, Vec3, Vec3],
) -> tuple[float, PlainHeading, float]:
    """tau3 by (42), with the l1 in front of d/dt(r2d . r1) that the derivation needs.

    Args:
        w: the body rates [rad/s].
        path: p_d' and its first two derivatives: the direction for zero sideslip.
        wanted: the commanded heading [rad] with its first two derivatives.
        force: F/m and its first two derivatives, NED [m/s^2 ...].
        memory: the heading's memory.
        kind: DAMPING, SIDESLIP or COMMANDED.
        l1: gain of the heading error [1/s].
        l2: gain of the heading rate [1/s].
        damping: of the yaw rate where there is no direction [1/s].
        rate_max: rate limit of the direction [rad/s].
        speed_min: |r3d x p_d'| below which the direction is held [m/s].
        dt_s: sample interval [s]; 0: continuous form, no rate limit.
        body: the body's axes r1, r2, r3 (`vectors.axes` of the attitude).

    Returns:
        tau3 [rad/s^2], the memory, and the heading error (body x axis against r1d, about r3d) [rad] or NaN.
    """
    _, w2, w3 = w
    (x, y, z), _, _ = force
    last, onward, held = memory
    size_sq = x * x + y * y + z * z
    if kind == DAMPING or size_sq < FORCE_MIN_M_S2 * FORCE_MIN_M_S2:
        return -damping * w3, (last, onward, held), nan
    size = sqrt(size_sq)
    k = 1.0 / size
    r3d = (k * x, k * y, k * z)
    forward, (_, onward, held), across = forward_direction(path, wanted, r3d, memory, kind, speed_min)
    x, y, z = across
    if x * x + y * y + z * z < ACROSS_MIN * ACROSS_MIN:
        return -damping * w3, (last, onward, held), nan
    frame = desired_frame(force, size, r3d, forward, across)
    (xx, xy, xz), r2d, w1d, w3d, w3d_rate = frame
    x, y, z = r2d
    if dt_s > 0.0:
        most, (x0, y0, z0) = rate_max * dt_s, last
        x0, y0, z0 = x - x0, y - y0, z - z0
        # usually even the chord between the two is shorter
        if x0 * x0 + y0 * y0 + z0 * z0 >= 0.9 * most * most or most >= 0.5:
            (xx, xy, xz), r2d, w1d, w3d, w3d_rate = limit_rate(frame, r3d, last, rate_max, dt_s)
            x, y, z = r2d
    (r10, r11, r12), (r20, r21, r22), (r30, r31, r32) = body
    zx, zy, zz = r3d
    ahead, along, below = (
        xx * r10 + xy * r11 + xz * r12,
        x * r10 + y * r11 + z * r12,
        zx * r10 + zy * r11 + zz * r12,
    )
    # d/dt(r2d . r1) = r2d' . r1 + r2d . (w3 r2 - w2 r3)
    turning = w3 * (x * r20 + y * r21 + z * r22) - w2 * (x * r30 + y * r31 + z * r32)
    along_rate = w1d * below - w3d * ahead + turning
    tau3 = -l2 * (w3 - w3d + l1 * along) + w3d_rate - l1 * along_rate
    return tau3, (r2d, onward, held), atan2(along, ahead)
