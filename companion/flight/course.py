"""The reference of a whole flight on vehicle time: join, trajectory, stop, one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from companion.config import Vehicle
from companion.control.types import GRAVITY_M_S2, Reference, Vec3
from companion.errors import RefusedError
from companion.trajectory.anchored import Anchored, Trajectory, anchored
from companion.trajectory.flatness import PointMass, ReferenceLimits, demand
from companion.trajectory.joins import Join, join, stop
from companion.trajectory.pieces import Piece, chain

ZERO: Vec3 = (0.0, 0.0, 0.0)
GENTLE_ACCELERATION_M_S2 = 2.0
GENTLE_RATE_RAD_S = 1.0
"""Joins and stops are on the way to and from the flight's task: they need not use what the vehicle can do."""


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


def gentle(limits: ReferenceLimits, end: Reference, model: PointMass) -> ReferenceLimits:
    """The limits of a join or stop; what its moving end itself asks for is allowed, and half as much again."""
    rate = demand(end, model).rate_rad_s
    return replace(
        limits,
        acceleration_max_m_s2=min(
            limits.acceleration_max_m_s2, max(GENTLE_ACCELERATION_M_S2, 1.5 * math.hypot(*end.a))
        ),
        rate_max_rad_s=min(limits.rate_max_rad_s, max(GENTLE_RATE_RAD_S, 1.5 * rate)),
    )


def _gently(plan: Callable[[ReferenceLimits], Join], limits: ReferenceLimits, easy: ReferenceLimits) -> Join:
    """The plan within the easy limits, or within the vehicle's own where those do not do."""
    try:
        return plan(easy)
    except RefusedError:
        return plan(limits)


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
        self.hold_point, self.yaw_rad, self.home = hold_point, yaw_rad, home
        limits, model = reference_limits(vehicle), point_mass(vehicle)
        path: Anchored = anchored(trajectory, hold_point, home)
        pieces: list[Piece] = []
        self.join_s = 0.0
        if trajectory.join == "smooth":
            begin = path.at(0.0)
            rest = at_rest(hold_point, yaw_rad)
            joined = _gently(lambda use: join(rest, begin, use, model), limits, gentle(limits, begin, model))
            pieces.append(joined)
            self.join_s = joined.duration_s
        end = path.at(path.duration_s)
        stopping = _gently(lambda use: stop(end, use, model), limits, gentle(limits, end, model))
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
