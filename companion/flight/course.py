"""The reference of a whole flight on vehicle time: join, trajectory, stop, one after the other."""

from __future__ import annotations

from companion.config import Vehicle
from companion.control.types import GRAVITY_M_S2, Reference, Vec3
from companion.trajectory.anchored import Anchored, Trajectory, anchored
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.joins import Join, join, stop
from companion.trajectory.pieces import Piece, chain

ZERO: Vec3 = (0.0, 0.0, 0.0)


def reference_limits(vehicle: Vehicle) -> ReferenceLimits:
    """The vehicle's limits as far as they bear on references."""
    lim = vehicle.limits
    heading_rate = lim.heading_rate_max_rad_s if vehicle.controller.heading == "commanded" else float("inf")
    return ReferenceLimits(
        speed_max_m_s=lim.speed_max_m_s,
        acceleration_max_m_s2=lim.acceleration_max_m_s2,
        tilt_max_rad=lim.tilt_max_rad,
        thrust_min_n=lim.thrust_min_n,
        thrust_max_n=lim.thrust_max_n,
        rate_max_rad_s=min(lim.rate_max_rad_s[:2]),
        heading_rate_max_rad_s=heading_rate,
    )


def point_mass(vehicle: Vehicle) -> PointMass:
    """The vehicle as differential flatness sees it."""
    return PointMass(vehicle.body.mass_kg, vehicle.body.drag_1_s, GRAVITY_M_S2)


def at_rest(p: Vec3, yaw_rad: float) -> Reference:
    """A reference that stays where it is."""
    return Reference(p, ZERO, ZERO, ZERO, ZERO, yaw_rad, 0.0, 0.0)


class Course:
    """Join, trajectory and stop; times are seconds from the moment of engaging.

    Args:
        trajectory: what is to be flown.
        vehicle: for the limits of join and stop.
        hold_point: where the vehicle is held, NED [m].
        yaw_rad: the heading there.
        home: the home position, NED [m], if known.

    Raises:
        RefusedError: the join or the stop cannot be flown within the limits.
    """

    def __init__(
        self, trajectory: Trajectory, vehicle: Vehicle, hold_point: Vec3, yaw_rad: float, home: Vec3 | None
    ) -> None:
        limits, model = reference_limits(vehicle), point_mass(vehicle)
        path: Anchored = anchored(trajectory, hold_point, home)
        pieces: list[Piece] = []
        self.join_s = 0.0
        if trajectory.join == "smooth":
            joined: Join = join(at_rest(hold_point, yaw_rad), path.at(0.0), limits, model)
            pieces.append(joined)
            self.join_s = joined.duration_s
        stopping = stop(path.at(path.duration_s), limits, model)
        self.path = path
        self.track_s = path.duration_s
        self.stop_s = stopping.duration_s
        self._chain = chain([*pieces, path, stopping])

    @property
    def duration_s(self) -> float:
        """Join, trajectory and stop together [s]."""
        return self.join_s + self.track_s + self.stop_s

    def at(self, t_s: float) -> Reference:
        """The reference, `t_s` after engaging; before 0 the start, after the end the point of rest."""
        on_track_s = t_s - self.join_s
        if 0.0 <= on_track_s <= self.track_s:  # the usual case, without the search for the piece
            return self.path.at(on_track_s)
        return self._chain.at(t_s)
