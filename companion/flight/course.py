"""The reference of a whole flight on vehicle time: join, trajectory, stop, one after the other."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.config import Vehicle
from companion.control.types import Reference, Vec3
from companion.errors import RefusedError
from companion.flight.clearance import Clearance
from companion.flight.tempo import Ramp, RampPlan, Tempo
from companion.trajectory.anchored import Anchored, Trajectory, anchored
from companion.trajectory.curve import MOVED, curve_of
from companion.trajectory.flatness import PointMass, ReferenceLimits, demand
from companion.trajectory.joins import SHARE, Join, join, stop
from companion.trajectory.pieces import Piece, chain
from companion.trajectory.timing import paced
from companion.trajectory.vehicle_limits import point_mass, reference_limits

ZERO: Vec3 = (0.0, 0.0, 0.0)
GENTLE_ACCELERATION_M_S2 = 2.0
GENTLE_RATE_RAD_S = 1.0
"""Joins and stops are on the way to and from the flight's task: they need not use what the vehicle can do."""


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


_BRISKER = (SHARE, 0.75, 1.0)
"""Shares of the vehicle's own limits that are tried for a way that stays clear: the brisker, the shorter it is."""

Plan = Callable[[ReferenceLimits, float], Join]
"""Gives a join or a stop that keeps to limits and to a share of them."""


def _gently(plan: Plan, limits: ReferenceLimits, easy: ReferenceLimits) -> Join:
    """The plan within the easy limits, or within the vehicle's own where those do not do."""
    try:
        return plan(easy, SHARE)
    except RefusedError:
        return plan(limits, SHARE)


def _clear(plan: Plan, limits: ReferenceLimits, easy: ReferenceLimits, clear: Callable[[Join], bool]) -> Join:
    """The gentlest plan that stays clear of ground and fences; where none does, the gentlest."""
    gentle_one = _gently(plan, limits, easy)
    if clear(gentle_one):
        return gentle_one
    for share in _BRISKER:
        with contextlib.suppress(RefusedError):
            brisk = plan(limits, share)
            if clear(brisk):
                return brisk
    return gentle_one


def _curves(pieces: Iterable[tuple[Anchored | Join, float]]) -> Iterator[Curve]:
    """The curves of pieces, given with their begin on the course [s]."""
    for piece, begin_s in pieces:
        numbers = curve_of(piece)
        if numbers is not None:
            yield Curve(begin_s, piece.duration_s, np.array(numbers))


class Part(Enum):
    """A part of a course: what to call it, and what to do where it is in the way of something, for people."""

    JOIN = "its join", "; hold higher up or elsewhere, or let it begin at rest"
    TRACK = "it", ""
    STOP = "the stop after it", "; let it end at rest, or with more room"


class Obstruction(NamedTuple):
    """Ground or a fence in the way of a course."""

    part: Part
    sentence: str
    """For people."""


class Curve(NamedTuple):
    """A piece of a course as numbers."""

    begin_s: float
    """Time on the course at which it begins [s]."""
    duration_s: float
    numbers: NDArray[np.float64]
    """See `trajectory.curve`."""


def at_rest(p: Vec3, yaw_rad: float) -> Reference:
    """A reference that stays where it is."""
    return Reference(p, ZERO, ZERO, ZERO, ZERO, yaw_rad, 0.0, 0.0)


class Course:
    """Join, trajectory and stop, and the pace at which they are flown; times are seconds from the moment of engaging.

    Args:
        trajectory: what is to be flown.
        vehicle: for the limits of join and stop.
        hold_point: where the vehicle is held, NED [m].
        yaw_rad: the heading there.
        home: the vehicle's own home position, NED [m], if known: ground and fences count from there.
        height_min_m: what all of it is to stay above, over home; None: nothing is looked at but the limits.
        origin: where a trajectory with the anchor "home" counts its coordinates from, NED [m]; None: from home.

    Raises:
        RefusedError: the join or the stop cannot be flown within the limits.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        vehicle: Vehicle,
        hold_point: Vec3,
        yaw_rad: float,
        home: Vec3 | None,
        height_min_m: float | None = None,
        *,
        origin: Vec3 | None = None,
    ) -> None:
        self.hold_point, self.yaw_rad, self.home = hold_point, yaw_rad, home
        self.origin = home if origin is None else origin
        self._limits, self._model = limits, model = reference_limits(vehicle), point_mass(vehicle)
        path: Anchored = anchored(trajectory, hold_point, self.origin)
        self._clearance: Clearance | None = None
        if height_min_m is not None:
            self._clearance = Clearance(path, vehicle.limits, hold_point, home, self.origin, height_min_m)
        pieces: list[Join] = []
        self.join_s = 0.0
        if trajectory.join == "smooth":
            begin = path.at(0.0)
            rest = at_rest(hold_point, yaw_rad)
            joined = _clear(
                lambda use, share: join(rest, begin, use, model, share),
                *(limits, gentle(limits, begin, model), lambda way: self._is_clear(way, joins=True)),
            )
            pieces.append(joined)
            self.join_s = joined.duration_s
        end = path.at(path.duration_s)
        stopping = _clear(
            lambda use, share: stop(end, use, model, share), limits, gentle(limits, end, model), self._is_clear
        )
        self.path = path
        self.track_s = path.duration_s
        self.stop_s = stopping.duration_s
        self._chain = chain([*pieces, path, stopping])
        self.curves = tuple(_curves(zip((*pieces, path, stopping), self._chain.starts_s, strict=True)))
        """Its pieces as numbers, those that have any."""
        self._tempo = Tempo()
        self.changes_s = math.inf
        """Time since engaging at which its pace changes first [s]; infinity: it was never changed."""
        self.moved_m: Vec3 = ZERO
        """By how much it was moved since it was planned, NED: its hold point, path, home and origin do not show it."""

    @property
    def duration_s(self) -> float:
        """Join, trajectory and stop together, at their own pace [s]."""
        return self.join_s + self.track_s + self.stop_s

    def at(self, t_s: float) -> Reference:
        """The reference, `t_s` after engaging; before 0 the start, after the end the point of rest."""
        if t_s < self.changes_s:
            reference = self._at_own_pace(t_s)
        else:
            pace = self._tempo.at(t_s)
            reference = paced(self._at_own_pace(pace[0]), pace)
        if self.moved_m is ZERO:
            return reference
        (x, y, z), (dx, dy, dz) = reference.p, self.moved_m
        return reference._replace(p=(x + dx, y + dy, z + dz))

    @property
    def pieces(self) -> tuple[tuple[float, Piece], ...]:
        """Join (if there is one), trajectory and stop, as planned and at their own pace, each with its begin [s]."""
        return tuple(zip(self._chain.starts_s, self._chain.pieces, strict=True))

    def _is_clear(self, way: Piece, *, joins: bool = False) -> bool:
        return self._clearance is None or self._clearance.breach(way, joins=joins) is None

    def obstruction(self) -> Obstruction | None:
        """What is in the way of it, ground or a fence; None: nothing, as far as that is known.

        The trajectory itself comes first: its join and stop are no better than it is.
        """
        if self._clearance is None:
            return None
        *joins, path, stopping = self._chain.pieces
        for part, piece in ((Part.TRACK, path), *((Part.JOIN, way) for way in joins), (Part.STOP, stopping)):
            breach = self._clearance.breach(piece, joins=part is Part.JOIN)
            if breach is not None:
                name, advice = part.value
                return Obstruction(part, f"{name} {breach.sentence}, {breach.at_s:.1f} s after it began{advice}")
        return None

    def shift(self, by_m: Vec3) -> None:
        """Moves all of it (NED): after the autopilot's estimate has jumped by as much."""
        (x, y, z), (dx, dy, dz) = self.moved_m, by_m
        self.moved_m = (x + dx, y + dy, z + dz)
        for curve in self.curves:
            curve.numbers[MOVED : MOVED + 3] = self.moved_m

    def _at_own_pace(self, course_s: float) -> Reference:
        on_track_s = course_s - self.join_s
        if 0.0 <= on_track_s <= self.track_s:  # the usual case, without the search for the piece
            return self.path.at(on_track_s)
        return self._chain.at(course_s)

    # -- pace -----------------------------------------------------------------------------------------------------

    @property
    def ramps(self) -> tuple[Ramp, ...]:
        """How the pace was changed so far."""
        return self._tempo.ramps

    def course_s(self, t_s: float) -> float:
        """Time on the course [s], `t_s` after engaging."""
        tempo = self._tempo
        return t_s if tempo.steady else tempo.at(t_s)[0]

    def resting(self, t_s: float) -> bool:
        """Whether the pace is zero from now on, until it is changed."""
        return self._tempo.resting(t_s)

    @property
    def over_s(self) -> float:
        """When everything is flown, or the vehicle at rest for good as far as is known [s since engaging]."""
        tempo = self._tempo
        settled_s = tempo.settled_s
        if tempo.resting(settled_s):
            return settled_s
        return settled_s + max(0.0, self.duration_s - self.course_s(settled_s)) / tempo.rate

    def plan_pace(self, begin_s: float, rate: float) -> RampPlan:
        """Begins to look for a change of pace; see `RampPlan`.

        Args:
            begin_s: when it is to begin, far enough ahead [s since engaging].
            rate: 0 to come to rest, 1 to go on, between the two slowly.
        """
        return RampPlan(self._tempo, _OwnPace(self), begin_s, rate, self._limits, self._model)

    def change_pace(self, ramp: Ramp) -> None:
        """Takes a change of pace that was planned, or recorded."""
        self._tempo.add(ramp)
        self.changes_s = self._tempo.changes_s


class Timed:
    """A course on the vehicle's clock: the reference as a function of vehicle time.

    Args:
        course: that is flown.
        begin_s: vehicle time at which it was engaged [s].
    """

    def __init__(self, course: Course, begin_s: float) -> None:
        self.course, self.begin_s = course, begin_s
        self._on_track = course.path.inside
        self._take(course.curves[0] if course.curves else None)

    def _take(self, curve: Curve | None) -> None:
        self.on = curve
        """The curve of the last answer; None: there was none."""
        self._from_s, self._length_s = (0.0, -math.inf) if curve is None else (curve.begin_s, curve.duration_s)

    def __call__(self, t_s: float) -> Reference:
        """The reference at a vehicle time [s]."""
        course, t_s = self.course, t_s - self.begin_s
        on_track_s = t_s - course.join_s
        if 0.0 <= on_track_s <= course.track_s and t_s < course.changes_s and course.moved_m is ZERO:
            return self._on_track(on_track_s)  # the usual case, without the calls on the way
        return course.at(t_s)

    def goes_on(self, stamp_s: float, delay_s: float) -> bool:
        """Whether the curve of the last answer gives the reference at a stamp and a delay later [s], too."""
        # in the order in which `fused.flight_step` works them out: at an end the last digit counts
        now_s, effect_s = stamp_s - self.begin_s, stamp_s + delay_s - self.begin_s
        begin_s = self._from_s
        return now_s >= begin_s and effect_s - begin_s <= self._length_s and effect_s < self.course.changes_s

    def curve(self, stamp_s: float, delay_s: float) -> Curve | None:
        """The curve that gives the reference at a stamp and a delay later [s], where one does; else None.

        It goes by the times alone: a replay, which knows all changes of the pace from its beginning, takes the same.
        """
        if not self.goes_on(stamp_s, delay_s):
            for other in self.course.curves:
                self._take(other)
                if self.goes_on(stamp_s, delay_s):
                    break
            else:
                self._take(None)
        return self.on


class _OwnPace:
    """A course without its changes of pace."""

    def __init__(self, course: Course) -> None:
        self.at = course._at_own_pace
