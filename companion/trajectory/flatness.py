"""What a reference asks of the vehicle, by differential flatness with drag, and how much of the limits that uses.

From v' = g u3 - (T/m) r3 - D v (docs/law.md section 1, disturbance left out) the reference fixes the thrust vector; its
direction's derivatives fix the roll and pitch parts of body rate and angular acceleration. Rotation about the thrust
axis (heading) is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, hypot, inf, pi, sqrt
from typing import NamedTuple

from companion.control.types import GRAVITY_M_S2, Reference, Vec3

SPECIFIC_THRUST_MIN_M_S2 = 1e-9
"""Below this the thrust has no direction (free fall) and the rates are taken as infinite."""


class PointMass(NamedTuple):
    """What differential flatness needs to know of the vehicle."""

    mass_kg: float
    drag_1_s: float = 0.0
    """Linear drag D in v' = ... - D v."""
    gravity_m_s2: float = GRAVITY_M_S2


@dataclass(frozen=True, slots=True)
class ReferenceLimits:
    """What a reference may ask for: the vehicle's [limits], as far as they bear on references."""

    speed_max_m_s: float
    acceleration_max_m_s2: float
    tilt_max_rad: float
    thrust_min_n: float
    thrust_max_n: float
    rate_max_rad_s: float
    """Of the roll and pitch part of the body rate, as one vector."""
    heading_rate_max_rad_s: float = inf
    """Of the commanded heading; infinite where the vehicle does not follow it."""


class Demand(NamedTuple):
    """What following a reference exactly takes."""

    thrust_n: float
    tilt_rad: float
    """Angle between the thrust and the vertical, 0..pi."""
    rate_rad_s: float
    """Roll and pitch part of the body rate."""
    angular_acceleration_rad_s2: float
    """Roll and pitch part, for a body that does not turn about its thrust axis."""


class Bound(NamedTuple):
    """One limit of a reference."""

    quantity: str
    key: str
    """Field of `ReferenceLimits` and key of the vehicle's [limits]."""
    unit: str
    upper: bool = True


BOUNDS = (
    Bound("speed", "speed_max_m_s", "m/s"),
    Bound("acceleration", "acceleration_max_m_s2", "m/s^2"),
    Bound("tilt", "tilt_max_rad", "rad"),
    Bound("thrust", "thrust_min_n", "N", upper=False),
    Bound("thrust", "thrust_max_n", "N"),
    Bound("body rate", "rate_max_rad_s", "rad/s"),
    Bound("heading rate", "heading_rate_max_rad_s", "rad/s"),
)
"""All limits, in the order of the values of `quantities` and `uses`."""

Quantities = tuple[float, float, float, float, float, float, float]


def demand(reference: Reference, model: PointMass) -> Demand:
    """Return thrust [N], tilt [rad], body rate [rad/s] and angular acceleration [rad/s^2] that the reference takes.

    With f = (T/m) r3 = g u3 - p'' - D p': r3' = (f' - r3 (r3 . f')) / |f|, whose length is that of the body rate's roll
    and pitch part; the part of r3'' normal to r3 is as long as that of the angular acceleration.
    """
    d = model.drag_1_s
    v, a, j, s = reference.v, reference.a, reference.j, reference.s
    f = (-a[0] - d * v[0], -a[1] - d * v[1], model.gravity_m_s2 - a[2] - d * v[2])
    f1 = (-j[0] - d * a[0], -j[1] - d * a[1], -j[2] - d * a[2])
    f2 = (-s[0] - d * j[0], -s[1] - d * j[1], -s[2] - d * j[2])
    n = _length(f)
    if n < SPECIFIC_THRUST_MIN_M_S2:
        return Demand(model.mass_kg * n, pi, inf, inf)
    r = (f[0] / n, f[1] / n, f[2] / n)
    n1 = _dot(r, f1)
    w = ((f1[0] - n1 * r[0]) / n, (f1[1] - n1 * r[1]) / n, (f1[2] - n1 * r[2]) / n)
    # Normal part of r3'' = (f'' - |f|'' r3 - 2 |f|' r3') / |f|: what lies along r3 drops out.
    along = _dot(r, f2)
    tau = (
        (f2[0] - along * r[0] - 2.0 * n1 * w[0]) / n,
        (f2[1] - along * r[1] - 2.0 * n1 * w[1]) / n,
        (f2[2] - along * r[2] - 2.0 * n1 * w[2]) / n,
    )
    return Demand(model.mass_kg * n, acos(max(-1.0, min(1.0, r[2]))), _length(w), _length(tau))


def quantities(reference: Reference, model: PointMass) -> Quantities:
    """Return the bounded quantities of a reference, in the order of `BOUNDS`."""
    needs = demand(reference, model)
    return (
        _length(reference.v),
        _length(reference.a),
        needs.tilt_rad,
        needs.thrust_n,
        needs.thrust_n,
        needs.rate_rad_s,
        abs(reference.yaw_rate),
    )


def uses(values: Quantities, limits: ReferenceLimits) -> Quantities:
    """Return the share of each limit that is used, in the order of `BOUNDS`: above 1 is a violation."""
    return (
        values[0] / limits.speed_max_m_s,
        values[1] / limits.acceleration_max_m_s2,
        values[2] / limits.tilt_max_rad,
        limits.thrust_min_n / values[3] if values[3] > 0.0 else inf,
        values[4] / limits.thrust_max_n,
        values[5] / limits.rate_max_rad_s,
        values[6] / limits.heading_rate_max_rad_s,
    )


def worst_use(reference: Reference, limits: ReferenceLimits, model: PointMass) -> float:
    """Return the largest share of any limit that a reference uses."""
    return max(uses(quantities(reference, model), limits))


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _length(a: Vec3) -> float:
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) if max(map(abs, a)) < 1e150 else hypot(*a)
