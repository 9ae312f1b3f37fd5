"""What a file turns out to hold, already north-east-down: polynomials, samples, or points to plan a path through."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.frames import GeoPoint
from companion.trajectory.fence import Fence
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.waypoints import Waypoint


@dataclass(frozen=True, kw_only=True)
class Polynomials:
    """Pieces as the file has them: nothing is fitted."""

    shape: Piecewise
    notes: tuple[str, ...] = ()
    """What people should know, a sentence each."""


@dataclass(frozen=True, kw_only=True)
class Sampled:
    """Instants of a path; n of them."""

    t_s: NDArray[np.float64]
    """Increasing, shape (n,); the first need not be zero."""
    p_m: NDArray[np.float64]
    """Position, NED, shape (n, 3)."""
    v_m_s: NDArray[np.float64] | None = None
    """Velocity, where the file has it."""
    a_m_s2: NDArray[np.float64] | None = None
    """Acceleration, where the file has it."""
    yaw_rad: NDArray[np.float64] | None = None
    """Heading, clockwise from north, shape (n,), where the file has it."""
    lines: tuple[int, ...] = ()
    """Of the file, one per instant."""
    notes: tuple[str, ...] = ()


class Leg(NamedTuple):
    """A waypoint and the time that is waited there."""

    waypoint: Waypoint
    hold_s: float = 0.0
    """At rest, above zero only with `stop`."""
    line: int | None = None
    """Of the file, where it has lines."""


@dataclass(frozen=True, kw_only=True)
class Route:
    """Points that a path is planned through, from rest to rest."""

    legs: tuple[Leg, ...]
    speed_max_m_s: float | None = None
    """What the file itself asks for at most."""
    origin: GeoPoint | None = None
    """Where the coordinates' origin is on the Earth; None where the file does not say."""
    altitude_above_home: bool = True
    """With an origin: heights count from home (True) or, like the origin's altitude, from mean sea level (False)."""
    fence: Fence | None = None
    notes: tuple[str, ...] = field(default=())


Content = Polynomials | Sampled | Route
