"""Whether a flight stays above the ground and within its fences on the whole of its way: join, trajectory and stop.

A trajectory that begins or ends in motion is joined from behind and left straight ahead: ways that nobody drew, and
that may dip below the lowest point of the trajectory itself. `Course` looks for ways that stay clear; where there is
none the flight is refused before a setpoint goes out.

Ground and the fences of the vehicle file count from the vehicle's own home, wherever a trajectory was planned. Where
the planned home lies higher, its ground counts too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.config import FlightLimits
from companion.control.types import Vec3
from companion.trajectory.anchored import Anchored
from companion.trajectory.batch import batch
from companion.trajectory.feasibility import grid
from companion.trajectory.pieces import Piece

Array = NDArray[np.float64]

SAMPLES = 400
"""Of a join or a stop, which are single polynomials."""
HOLD_ROOM_M = 0.05
"""A join that begins below the least height may go so far below its beginning: no vehicle stands still there."""
ON_THE_LINE_M = 1e-6
"""Rounding."""


class Breach(NamedTuple):
    """Where a way is not clear."""

    by_m: float
    at_s: float
    """Since the beginning of the piece."""
    sentence: str


def own_fence_margins(path: Anchored, points: Array) -> Array | None:
    """How far points are from breaking the fence that came with a trajectory [m]; negative: broken.

    That fence is in the coordinates of the definition: it is moved and turned with the trajectory. Where the vehicle
    happens to be ("here") it does not stand, as where the file has none: None.

    Args:
        path: the trajectory in its place.
        points: NED, shape (n, 2 or 3) [m].
    """
    fence = path.trajectory.fence
    if fence is None or path.trajectory.anchor == "here":
        return None
    north, east = points[:, 0] - path.offset_m[0], points[:, 1] - path.offset_m[1]
    c, s = path.cos_yaw, path.sin_yaw
    return fence.margins(np.column_stack([c * north + s * east, c * east - s * north]))


@dataclass(frozen=True)
class Clearance:
    """What the whole of a way is measured by, in the autopilot's local frame (NED)."""

    path: Anchored
    limits: FlightLimits
    hold_point: Vec3
    home: Vec3 | None
    """The vehicle's own. None: where the ground is is not known, and the fences of the limits count from the hold
    point."""
    origin: Vec3 | None
    """Where the trajectory's coordinates count from: of places on the Earth another point than home, with ground of its
    own."""
    height_min_m: float
    """Above home."""

    def breach(self, piece: Piece, *, joins: bool = False) -> Breach | None:
        """The worst place of a piece of the way; None where it is clear.

        Args:
            piece: the join, the trajectory or the stop.
            joins: it begins at the hold point, which may be lower than the least height.
        """
        times_s, points = _points(piece)
        worst: Breach | None = None
        for margins, told in (*self._ground(points, joins=joins), *self._limits(points), *self._own(points)):
            at = int(np.argmin(margins))
            by_m = -float(margins[at])
            # what is no number is not clear
            if not by_m <= ON_THE_LINE_M and (worst is None or not by_m <= worst.by_m):
                worst = Breach(by_m, float(times_s[at]), told.format(by=by_m))
        return worst

    def _ground(self, points: Array, *, joins: bool) -> list[tuple[Array, str]]:
        if self.home is None:
            return []
        grounds = [(self.home[2], "home")]
        if self.origin is not None and self.origin[2] < self.home[2]:  # one that is no higher asks for nothing more
            grounds.append((self.origin[2], "the home that it was planned from"))
        found = []
        for down, name in grounds:
            height_m = down - points[:, 2]
            least_m = self.height_min_m
            if joins:
                least_m = min(least_m, down - self.hold_point[2] - HOLD_ROOM_M)
            lowest = f"falls to {float(height_m.min()):.2f} m above {name}"
            required = f"at least {least_m:.4g} m are required (height_min_m of the flight file)"
            found.append((height_m - least_m, f"{lowest}, {required}"))
        return found

    def _limits(self, points: Array) -> list[tuple[Array, str]]:
        north, east, down = self.home or self.hold_point
        found = []
        radius_m, top_m = self.limits.fence_radius_m, self.limits.fence_height_m
        if radius_m is not None:
            away_m = np.hypot(points[:, 0] - north, points[:, 1] - east)
            found.append((radius_m - away_m, f"leaves the fence by {{by:.2f}} m (limits.fence_radius_m {radius_m:g})"))
        if top_m is not None:
            found.append((top_m - (down - points[:, 2]), f"rises {{by:.2f}} m above limits.fence_height_m {top_m:g}"))
        return found

    def _own(self, points: Array) -> list[tuple[Array, str]]:
        margins = own_fence_margins(self.path, points)
        return [] if margins is None else [(margins, "leaves the trajectory's own fence by {by:.2f} m")]


def _points(piece: Piece) -> tuple[Array, Array]:
    """Times [s] and places, shape (n, 3) [m]."""
    if isinstance(piece, Anchored):
        times_s = grid(piece)
        return np.array(times_s), batch(piece, times_s).p.T
    times = np.linspace(0.0, piece.duration_s, SAMPLES + 1)
    return times, np.array([piece.at(t_s).p for t_s in times.tolist()])
