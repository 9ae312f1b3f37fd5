"""What many instants of a reference ask of the vehicle at once, and by how much that exceeds its limits: `flatness` for
arrays, with room for wind, and with gradients for the search for times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.torque import Body

Array = NDArray[np.float64]

UNLIMITED = 1e9
"""What stands for a limit that is infinite."""

TINY = 1e-12
"""Keeps divisions by lengths of zero vectors defined."""


class Excess(NamedTuple):
    """How far instants are beyond the limits, as a share of what a vehicle at rest has left of them: -1 at rest, above
    zero a violation. Durations that grow by a share take at least about that share off what is above -1.

    The first six are those of `flatness.BOUNDS`; all have the shape of one component.
    """

    speed: Array
    acceleration: Array
    tilt: Array
    thrust_low: Array
    thrust_high: Array
    rate: Array


class Parts(NamedTuple):
    """What the gradient needs again."""

    v: Array
    a: Array
    speed: Array
    acceleration: Array
    f: Array
    level: Array
    """Length of f's horizontal part."""
    r: Array
    along: Array
    """Of f' along the thrust."""
    across: Array
    """f' across the thrust."""
    turn: Array
    """Its length."""

    def at(self, indices: NDArray[np.intp]) -> Parts:
        """Return those of some of the instants, counted through in the order of their flattened arrays."""
        vectors = (0, 1, 4, 6, 8)
        return Parts(
            *(x.reshape(3, -1)[:, indices] if i in vectors else x.ravel()[indices] for i, x in enumerate(self))
        )


@dataclass(frozen=True)
class Gauge:
    """The limits of references, as smooth functions of velocity, acceleration and jerk.

    With f = (T/m) r3 as in `flatness.demand`, wind from any direction adds a vector of at most `disturbance_m_s2` to f.
    All such sums are within the limits exactly if the ball around f is: its distance to the cone of the largest tilt
    is f_h cos(tilt) - f_down sin(tilt), |f| gains or loses the ball's radius, and the same f' turns a thrust that is
    shorter by it faster.
    """

    limits: ReferenceLimits
    model: PointMass
    disturbance_m_s2: float = 0.0
    body: Body | None = None

    def left_at_rest(self) -> dict[str, float]:
        """Return what a vehicle at rest has left of the limits that bear on rest [m/s^2]; what is not above zero leaves
        no way to fly."""
        g, mass, room = self.model.gravity_m_s2, self.model.mass_kg, self.disturbance_m_s2
        return {
            "tilt": g * sin(self.limits.tilt_max_rad) - room,
            "least thrust": g - room - self.limits.thrust_min_n / mass,
            "thrust": min(self.limits.thrust_max_n / mass, UNLIMITED) - g - room,
        }

    def excess(self, v: Array, a: Array, j: Array) -> tuple[Excess, Parts]:
        """Return the excess of instants with these derivatives, each of shape (3, ...) in NED."""
        lim, model, room = self.limits, self.model, self.disturbance_m_s2
        g, d = model.gravity_m_s2, model.drag_1_s
        f, f1 = -a - d * v, -j - d * a
        f[2] += g
        level2 = f[0] * f[0] + f[1] * f[1]
        n, level = np.sqrt(level2 + f[2] * f[2]), np.sqrt(level2)
        r = f / (n + TINY)
        along = _dot(r, f1)
        across = f1 - along * r
        speed, acceleration, turn = _length(v), _length(a), _length(across)
        s, c, w = sin(lim.tilt_max_rad), cos(lim.tilt_max_rad), min(lim.rate_max_rad_s, UNLIMITED)
        tilt, low, high = self.left_at_rest().values()
        excess = Excess(
            speed / lim.speed_max_m_s - 1.0,
            acceleration / lim.acceleration_max_m_s2 - 1.0,
            (level * c - f[2] * s + room) / tilt,
            (g - n) / low - 1.0,
            (n - g) / high - 1.0,
            (turn - w * (n - room)) / (w * (g - room)),
        )
        return excess, Parts(v, a, speed, acceleration, f, level, r, along, across, turn)

    def torque_excess(self, v: Array, a: Array, j: Array, s: Array) -> Array:
        """Return by what share the torque exceeds what the rotors have for it, as `torque.use` less one."""
        if self.body is None:
            return np.full(v.shape[1:], -1.0)
        model, room = self.model, self.disturbance_m_s2
        d = model.drag_1_s
        f, f1, f2 = -a - d * v, -j - d * a, -s - d * j
        f[2] += model.gravity_m_s2
        n = _length(f) + TINY
        r = f / n
        n1 = _dot(r, f1)
        turn = _length(f2 - _dot(r, f2) * r - 2.0 * n1 * ((f1 - n1 * r) / n)) / np.maximum(n - room, TINY)
        least, most = (model.mass_kg / 4.0 * (n + change) for change in (-room, room))
        limit = self.body.lever_m * np.maximum(np.minimum(least, self.body.rotor_max_n - most), TINY)
        return np.asarray(self.body.inertia_kg_m2 * turn / limit - 1.0)

    def gradient(self, parts: Parts, weights: Excess) -> tuple[Array, Array, Array]:
        """Return the gradient over v, a and j of the sum of weights times excess."""
        lim, g, d = self.limits, self.model.gravity_m_s2, self.model.drag_1_s
        s, c, w = sin(lim.tilt_max_rad), cos(lim.tilt_max_rad), min(lim.rate_max_rad_s, UNLIMITED)
        tilt, low, high = self.left_at_rest().values()
        rate = g - self.disturbance_m_s2
        unit = parts.across / (parts.turn + TINY)
        over_f1 = (weights.rate / (w * rate)) * unit
        n = _dot(parts.f, parts.r)
        over_f = (weights.thrust_high / high - weights.thrust_low / low - weights.rate / rate) * parts.r
        over_f -= (parts.along / (n + TINY)) * over_f1
        over_f[2] -= weights.tilt * (s / tilt)
        over_f[:2] += (weights.tilt * (c / tilt) / (parts.level + TINY)) * parts.f[:2]
        over_v = (weights.speed / (lim.speed_max_m_s * (parts.speed + TINY))) * parts.v - d * over_f
        over_a = (weights.acceleration / (lim.acceleration_max_m_s2 * (parts.acceleration + TINY))) * parts.a
        return over_v, over_a - over_f - d * over_f1, -over_f1


def eased(gauge: Gauge, share: float) -> Gauge:
    """Return a gauge that lets a share of speed, acceleration, tilt and body rate be used."""
    lim = gauge.limits
    limits = replace(
        lim,
        speed_max_m_s=share * lim.speed_max_m_s,
        acceleration_max_m_s2=share * lim.acceleration_max_m_s2,
        tilt_max_rad=share * lim.tilt_max_rad,
        rate_max_rad_s=share * lim.rate_max_rad_s,
    )
    return replace(gauge, limits=limits)


def _dot(a: Array, b: Array) -> Array:
    found: Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return found


def _length(a: Array) -> Array:
    found: Array = np.sqrt(_dot(a, a))
    return found
