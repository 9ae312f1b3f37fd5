"""A vehicle file as references see it: its limits, and the point mass of differential flatness."""

from __future__ import annotations

from math import inf

from companion.config import Vehicle
from companion.control.types import GRAVITY_M_S2
from companion.trajectory.flatness import PointMass, ReferenceLimits


def reference_limits(vehicle: Vehicle) -> ReferenceLimits:
    """Return the vehicle's limits as far as they bear on references."""
    lim = vehicle.limits
    return ReferenceLimits(
        speed_max_m_s=lim.speed_max_m_s,
        acceleration_max_m_s2=lim.acceleration_max_m_s2,
        tilt_max_rad=lim.tilt_max_rad,
        thrust_min_n=lim.thrust_min_n,
        thrust_max_n=lim.thrust_max_n,
        rate_max_rad_s=min(lim.rate_max_rad_s[:2]),
        heading_rate_max_rad_s=lim.heading_rate_max_rad_s if vehicle.controller.heading == "commanded" else inf,
    )


def point_mass(vehicle: Vehicle) -> PointMass:
    """Return the vehicle as differential flatness sees it."""
    return PointMass(vehicle.body.mass_kg, vehicle.body.drag_1_s, GRAVITY_M_S2)
