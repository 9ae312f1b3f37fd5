"""References at many instants at once, for scans: the numbers of `at`, `flatness` and `torque` to rounding, as arrays.

A scan of a long path, or a campaign's flight, looks at tens of thousands of instants; what is made of polynomials or
sines is evaluated for all of them together, everything else instant by instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, inf, pi, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.trajectory import torque
from companion.trajectory.anchored import Anchored, Trajectory
from companion.trajectory.flatness import SPECIFIC_THRUST_MIN_M_S2, PointMass, ReferenceLimits
from companion.trajectory.joins import Join
from companion.trajectory.pieces import Piece
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.polynomial import Coefficients, evaluate
from companion.trajectory.shapes import ZERO, Circle, Helix, Hover, Lemniscate, Lissajous, Shape

Array = NDArray[np.float64]


class Batch(NamedTuple):
    """A reference at n instants, NED, SI."""

    p: Array
    """Position, shape (3, n), as the derivatives below."""
    v: Array
    a: Array
    j: Array
    s: Array
    yaw: Array
    """Heading, its rate and its acceleration, shape (3, n)."""


def batch(piece: Piece | Piecewise, times_s: Sequence[float] | Array) -> Batch:
    """Return a piece at instants within its duration [s]."""
    t_s = np.array(times_s)
    found: Batch | None = None
    if isinstance(piece, Anchored):
        found = _of_trajectory(piece.trajectory, t_s)
        found = None if found is None else _placed(piece, found)
    elif isinstance(piece, Trajectory):
        found = _of_trajectory(piece, t_s)
    elif isinstance(piece, Piecewise):
        found = _of_polynomials(piece, t_s)
    elif isinstance(piece, Join):
        found = _of_join(piece, t_s)
    return _one_by_one(piece, t_s.tolist()) if found is None else found


def _one_by_one(piece: Piece | Piecewise, times_s: Sequence[float]) -> Batch:
    references = [piece.at(t) for t in times_s]
    vectors = np.array([reference[:5] for reference in references])
    yaw = np.array([(r.yaw, r.yaw_rate, r.yaw_acceleration) for r in references])
    p, v, a, j, s = np.ascontiguousarray(vectors.transpose(1, 2, 0))
    return Batch(p, v, a, j, s, np.ascontiguousarray(yaw.T))


def _of_join(piece: Join, t_s: Array) -> Batch:
    t = np.clip(t_s, 0.0, piece.duration_s)
    axes = [_rows(piece, axis, t) for axis in (piece.north, piece.east, piece.down)]
    p, v, a, j, s = (np.stack([axis[k] for axis in axes]) for k in range(5))
    return Batch(p, v, a, j, s, _rows(piece, piece.yaw, t)[:3])


def _rows(piece: Join, axis: Coefficients, t_s: Array) -> Array:
    # the polynomial's arithmetic is that of one instant, on all of them at once
    found: tuple[Any, ...] = evaluate(axis, piece.duration_s, t_s)  # type: ignore[arg-type]
    return np.stack([np.broadcast_to(row, t_s.shape) for row in found])


def _sine(amplitude: float, w: float, angle: Array, ahead: float = 0.0) -> Array:
    """amplitude sin(angle) and its first four derivatives, w the angle's rate; `ahead` 1: of the cosine."""
    # the library's own sine: numpy's depends on the processor, and campaigns must not
    s = amplitude * np.array([sin(x) for x in angle.tolist()])
    c = amplitude * np.array([cos(x) for x in angle.tolist()])
    w2 = w * w
    if ahead:
        return np.stack([c, -w * s, -w2 * c, w2 * w * s, w2 * w2 * c])
    return np.stack([s, w * c, -w2 * s, -w2 * w * c, w2 * w2 * s])


def _axes_of(shape: Shape, t_s: Array) -> list[Array] | None:
    """Value and four derivatives of north, east and down, without the centre; None for a shape that is not known."""
    zero = np.zeros((5, len(t_s)))
    if isinstance(shape, Hover):
        return [zero, zero, zero]
    if isinstance(shape, Lemniscate):
        w = shape.angular_rate_rad_s
        north, east = shape.amplitude_m
        return [_sine(north, w, w * t_s, 1.0), _sine(east, 2.0 * w, 2.0 * w * t_s), zero]
    if isinstance(shape, Circle | Helix):
        w = shape.angular_rate_rad_s
        angle = w * t_s + shape.phase_rad
        sinking = zero.copy()
        if isinstance(shape, Helix):
            sinking[0], sinking[1] = -shape.climb_m_s * t_s, -shape.climb_m_s
        return [_sine(shape.radius_m, w, angle, 1.0), _sine(shape.radius_m, w, angle), sinking]
    if isinstance(shape, Lissajous):
        parts = zip(shape.amplitude_m, shape.angular_rate_rad_s, shape.phase_rad, strict=True)
        return [_sine(amplitude, w, w * t_s + phase) for amplitude, w, phase in parts]
    return None


def _of_shape(shape: Shape, t_s: Array) -> Batch | None:
    if isinstance(shape, Piecewise):
        return _of_polynomials(shape, t_s)
    axes = _axes_of(shape, t_s)
    if axes is None:
        return None
    p, v, a, j, s = (np.stack([axis[k] for axis in axes]) for k in range(5))
    centre = shape.point_m if isinstance(shape, Hover) else getattr(shape, "center_m", ZERO)
    rate = np.full(len(t_s), shape.heading.yaw_rate_rad_s)
    yaw = np.stack([shape.heading.yaw_rad + rate * t_s, rate, np.zeros(len(t_s))])
    return Batch(p + np.array(centre)[:, None], v, a, j, s, yaw)


def _of_polynomials(shape: Piecewise, t_s: Array) -> Batch:
    inside = np.clip(t_s, 0.0, shape.own_duration_s)  # at most rounding is clipped
    found = shape.sampled(inside)
    p, v, a, j, s = (np.ascontiguousarray(rows.T) for rows in found[1:6])
    return Batch(p, v, a, j, s, shape.headings(inside))


def _of_trajectory(trajectory: Trajectory, t_s: Array) -> Batch | None:
    k = trajectory.time_scale
    found = _of_shape(trajectory.shape, k * t_s)
    if found is None:
        return None
    turned = found.yaw * np.array([[1.0], [k], [k * k]])
    return Batch(found.p, k * found.v, k**2 * found.a, k**3 * found.j, k**4 * found.s, turned)


def _placed(path: Anchored, found: Batch) -> Batch:
    c, s = path.cos_yaw, path.sin_yaw
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, v, a, j, snap = (rotation @ rows for rows in found[:5])
    yaw = found.yaw + np.array([[path.yaw_rad], [0.0], [0.0]])
    return Batch(p + np.array(path.offset_m)[:, None], v, a, j, snap, yaw)


class Demands(NamedTuple):
    """What following the reference exactly takes: `flatness.Demand` for n instants."""

    thrust_n: Array
    tilt_rad: Array
    rate_rad_s: Array
    angular_acceleration_rad_s2: Array


def demands(found: Batch, model: PointMass) -> Demands:
    """Return thrust [N], tilt [rad], body rate [rad/s] and angular acceleration [rad/s^2], each of shape (n,)."""
    d = model.drag_1_s
    f, f1, f2 = -found.a - d * found.v, -found.j - d * found.a, -found.s - d * found.j
    f[2] += model.gravity_m_s2
    n = _length(f)
    falling = n < SPECIFIC_THRUST_MIN_M_S2
    divisor = np.where(falling, 1.0, n)
    r = f / divisor
    n1 = _dot(r, f1)
    w = (f1 - n1 * r) / divisor
    turn = (f2 - _dot(r, f2) * r - 2.0 * n1 * w) / divisor
    return Demands(
        model.mass_kg * n,
        np.where(falling, pi, np.arccos(np.clip(r[2], -1.0, 1.0))),
        np.where(falling, inf, _length(w)),
        np.where(falling, inf, _length(turn)),
    )


def quantities(found: Batch, model: PointMass) -> Array:
    """Return the bounded quantities in the order of `flatness.BOUNDS`, shape (7, n)."""
    needs = demands(found, model)
    thrust = needs.thrust_n
    rows = (_length(found.v), _length(found.a), needs.tilt_rad, thrust, thrust, needs.rate_rad_s, np.abs(found.yaw[1]))
    return np.stack(rows)


def uses(values: Array, limits: ReferenceLimits) -> Array:
    """Return the shares of the limits that are used, in the order of `flatness.BOUNDS`, shape (7, n)."""
    found = np.empty_like(values)
    upper = (limits.speed_max_m_s, limits.acceleration_max_m_s2, limits.tilt_max_rad, inf, limits.thrust_max_n)
    for i, limit in enumerate((*upper, limits.rate_max_rad_s, limits.heading_rate_max_rad_s)):
        found[i] = values[i] / limit
    with np.errstate(divide="ignore"):
        found[3] = np.where(values[3] > 0.0, limits.thrust_min_n / values[3], inf)
    return found


def torque_uses(found: Batch, model: PointMass, of: torque.Body) -> Array:
    """Return the share of the torque there is that is taken, `torque.use` for n instants."""
    needs = demands(found, model)
    share_n = needs.thrust_n / 4.0
    limit = of.lever_m * np.maximum(0.0, np.minimum(share_n, of.rotor_max_n - share_n))
    taken = of.inertia_kg_m2 * needs.angular_acceleration_rad_s2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(taken == 0.0, 0.0, np.where(limit > 0.0, taken / limit, inf))


def finite(found: Batch) -> NDArray[np.bool_]:
    """Return whether all numbers of each instant are finite."""
    return np.asarray(np.isfinite(np.concatenate(found)).all(axis=0))


def _dot(a: Array, b: Array) -> Array:
    found: Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return found


def _length(a: Array) -> Array:
    scale = np.abs(a).max(0)
    if scale.size and scale.max() > 1e150:
        divisor = np.where(scale > 0.0, scale, 1.0)
        found: Array = scale * np.sqrt(_dot(a / divisor, a / divisor))
        return found
    return np.sqrt(_dot(a, a))
