"""Plans a path through the points of a route, with waits where it has them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate, pairwise
from math import pi, remainder

from companion.control.types import Vec3
from companion.errors import CompanionError
from companion.trajectory.formats.contents import Leg, Route
from companion.trajectory.piecewise import PathPiece, Piecewise, coefficients
from companion.trajectory.polynomial import Coefficients, through
from companion.trajectory.waypoints import HeadingMode, PlanLimits, plan


@lru_cache(maxsize=8)  # the gates and the flight ask for the same path
def planned(
    route: Route, limits: PlanLimits, heading: HeadingMode | None = None, yaw_rad: float = 0.0
) -> tuple[Piecewise, tuple[str, ...]]:
    """Return the near-shortest path through a route and what people should know about it.

    Args:
        route: at least two points.
        limits: kept throughout; the route's own speed comes on top.
        heading: None: from the waypoints where they give one, else along the path.
        yaw_rad: the heading where waypoints are to say and none does [rad].

    Raises:
        InputError: a waypoint is wrong.
        RefusedError: the limits leave no way.

    """
    used = limits
    if route.speed_max_m_s is not None and route.speed_max_m_s < limits.reference.speed_max_m_s:
        used = replace(limits, reference=replace(limits.reference, speed_max_m_s=route.speed_max_m_s))
    given = any(leg.waypoint.yaw_rad is not None for leg in route.legs)
    mode: HeadingMode = heading or ("waypoints" if given else "path")
    path = joined(_with_waits(_parts(route, used, mode, yaw_rad)))
    notes = [
        f"planned through {len(route.legs)} points in {path.own_duration_s:.1f} s, with at most"
        f" {used.reference.speed_max_m_s:g} m/s and {used.reference.acceleration_max_m_s2:g} m/s^2"
    ]
    waits = sum(leg.hold_s for leg in route.legs)
    if waits:
        notes.append(f"{waits:g} s of it are waits at points")
    return path, tuple(notes)


def _parts(
    route: Route, limits: PlanLimits, heading: HeadingMode, yaw_rad: float
) -> list[tuple[Leg, Piecewise | None]]:
    """Return the points at which the path rests for a time, or begins, each with the path from there to the next."""
    rests = [0, *(i for i, leg in enumerate(route.legs) if leg.hold_s > 0.0 and i), len(route.legs) - 1]
    found: list[tuple[Leg, Piecewise | None]] = []
    for begin, end in pairwise(dict.fromkeys(rests)):
        points = [leg.waypoint for leg in route.legs[begin : end + 1]]
        if begin and heading == "waypoints":
            points[0] = replace(points[0], yaw_rad=yaw_rad)  # as it was reached, through the wait
        try:
            shape = plan(points, limits, heading=heading, yaw_rad=yaw_rad)
        except CompanionError as error:
            raise _renumbered(error, route.legs, begin) from None
        yaw_rad = shape.at(shape.own_duration_s).yaw
        found.append((route.legs[begin], shape))
    return [*found, (route.legs[-1], None)]


def _renumbered(error: CompanionError, legs: Sequence[Leg], begin: int) -> CompanionError:
    """Return an error of a part with the points numbered as in the whole, and their lines where they have some."""

    def whole(found: re.Match[str]) -> str:
        index = begin + int(found[1])
        line = legs[index].line if index < len(legs) else None
        return f"waypoint.{index}" if line is None else f"line {line}: waypoint.{index}"

    return type(error)(re.sub(r"waypoint\.(\d+)", whole, str(error)))


def _with_waits(parts: Sequence[tuple[Leg, Piecewise | None]]) -> list[Piecewise]:
    """Return the paths with the waits before them; a wait turns to the heading that comes next."""
    shapes: list[Piecewise] = []
    for leg, shape in parts:
        if leg.hold_s > 0.0:
            after = None if shape is None else shape.at(0.0).yaw
            before = shapes[-1].at(shapes[-1].own_duration_s).yaw if shapes else after or 0.0
            turn = 0.0 if after is None else remainder(after - before, 2.0 * pi)
            shapes.append(_waiting(leg.waypoint.p_m, leg.hold_s, before, before + turn))
        if shape is not None:
            shapes.append(shape)
    return shapes


def _waiting(p: Vec3, hold_s: float, yaw_rad: float, then_rad: float) -> Piecewise:
    """Rest at a point, turning from one heading to another."""
    north, east, down = (coefficients([x]) for x in p)
    turn = through((yaw_rad, 0.0, 0.0, 0.0, 0.0), (then_rad, 0.0, 0.0, 0.0, 0.0), hold_s)
    return Piecewise(
        knots_s=(0.0, hold_s),
        pieces=(PathPiece(north, east, down),),
        yaw_knots_s=(0.0, hold_s),
        yaw_pieces=(turn,),
    )


def joined(shapes: Sequence[Piecewise]) -> Piecewise:
    """Return shapes one after the other as one; each must begin where the one before ends."""
    starts = list(accumulate((shape.own_duration_s for shape in shapes), initial=0.0))
    knots: list[float] = [0.0]
    pieces: list[PathPiece] = []
    yaw_knots: list[float] = [0.0]
    yaw_pieces: list[Coefficients] = []
    for shape, start_s, end_s in zip(shapes, starts, starts[1:], strict=False):
        knots += [start_s + t_s for t_s in shape.knots_s[1:-1]] + [end_s]
        pieces += shape.pieces
        if shape.yaw_pieces:
            yaw_knots += [start_s + t_s for t_s in shape.yaw_knots_s[1:-1]] + [end_s]
            yaw_pieces += shape.yaw_pieces
        else:
            yaw, rate = shape.heading
            yaw_knots.append(end_s)
            yaw_pieces.append(coefficients([yaw, rate * shape.own_duration_s]))
    return Piecewise(
        knots_s=tuple(knots), pieces=tuple(pieces), yaw_knots_s=tuple(yaw_knots), yaw_pieces=tuple(yaw_pieces)
    )
