"""A path of a file flown several times: from its end back to its start, and again.

Between two laps a join leads from the end to the start, continuous up to the fourth derivative and within the vehicle's
limits; a path that comes back to where and how it began is simply flown again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import remainder, tau
from typing import Final

from companion.control.types import Reference, Vec3
from companion.errors import RefusedError
from companion.trajectory.joins import SHARE, Join, join
from companion.trajectory.pieces import Chain, Piece, chain
from companion.trajectory.shapes import Joint, Shape
from companion.trajectory.waypoints import PlanLimits

SAME: Final = 1e-6
"""Differences of position [m] and its derivatives between an end and a start that are rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Laps(Shape):
    """A shape several times, with what leads from its end to its start between them."""

    course: Chain
    back_s: float
    """From the end of a lap to the start of the next [s]."""

    @property
    def own_duration_s(self) -> float:
        """All laps [s]."""
        return self.course.duration_s

    def at(self, t_s: float) -> Reference:
        """Return the reference at a time from the first lap's start [s]."""
        return self.course.at(t_s)

    def joints(self) -> tuple[Joint, ...]:
        """Where the laps, the ways back and the pieces of the shape meet."""
        return self.course.joints()


@dataclass(frozen=True, slots=True)
class _Lap:
    """A shape with its duration, as a piece of a chain."""

    shape: Shape
    duration_s: float

    @property
    def period_s(self) -> None:
        """One lap does not repeat by itself."""
        return

    def at(self, t_s: float) -> Reference:
        """Return the shape's reference."""
        return self.shape.at(t_s)

    def joints(self) -> tuple[Joint, ...]:
        """Return the shape's joints."""
        return self.shape.joints()


def repeated(shape: Shape, duration_s: float, laps: int, limits: PlanLimits, time_scale: float = 1.0) -> Laps:
    """Return a shape flown several times.

    Args:
        shape: one lap.
        duration_s: of one lap, at the shape's own pace [s].
        laps: how often, at least 2.
        limits: what the ways back keep to.
        time_scale: at which it is flown: the ways back are played as much faster.

    Raises:
        RefusedError: no way back keeps the limits.
    """
    lap = _Lap(shape, duration_s)
    end, start = shape.at(duration_s), shape.at(0.0)
    back = None if _same(end, start) else _way_back(end, start, limits, time_scale)
    pieces: list[Piece] = [lap]
    for _ in range(laps - 1):
        pieces += [lap] if back is None else [back, lap]
    return Laps(heading=shape.heading, course=chain(pieces), back_s=0.0 if back is None else back.duration_s)


def _way_back(end: Reference, start: Reference, limits: PlanLimits, scale: float) -> Join:
    """Played faster it uses more: by as much less it is planned."""
    pace = max(scale, 1.0)
    reference = replace(
        limits.reference,
        speed_max_m_s=limits.reference.speed_max_m_s / pace,
        acceleration_max_m_s2=limits.reference.acceleration_max_m_s2 / pace**2,
        heading_rate_max_rad_s=limits.reference.heading_rate_max_rad_s / pace,
        rate_max_rad_s=limits.reference.rate_max_rad_s / pace**3,
    )
    try:
        return join(end, start, reference, limits.model, SHARE)
    except RefusedError as error:
        raise RefusedError(f"laps: from the end back to the start: {error}") from None


def _same(end: Reference, start: Reference) -> bool:
    """Whether a lap can follow another as it is; its heading may have made whole turns, which is the same direction."""

    def near(a: Vec3, b: Vec3) -> bool:
        return all(abs(x - y) <= SAME for x, y in zip(a, b, strict=True))

    vectors = zip(end[:5], start[:5], strict=True)
    turned_rad = remainder(end.yaw - start.yaw, tau)
    turning = abs(end.yaw_rate - start.yaw_rate) <= SAME and abs(turned_rad) <= SAME
    return turning and all(near(a, b) for a, b in vectors)
