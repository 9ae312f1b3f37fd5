"""Geofences as missions bring them: polygons and circles to stay inside of or out of, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Polygon:
    """A fence of at least three corners, in order; the last is joined to the first."""

    corners_m: tuple[tuple[float, float], ...]
    """North, east [m]."""
    inclusion: bool
    """True: stay inside. False: stay out."""

    def margins(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance to the fence of points (n, 2) [m]; negative where it is broken."""
        nearest = np.full(len(p), inf)
        inside = np.zeros(len(p), dtype=bool)
        corners = np.array(self.corners_m)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge = b - a
            length2 = float(edge @ edge)
            along = np.clip((p - a) @ edge / length2, 0.0, 1.0) if length2 > 0.0 else np.zeros(len(p))
            nearest = np.minimum(nearest, np.hypot(*(p - a - along[:, None] * edge).T))
            crosses = (a[1] > p[:, 1]) != (b[1] > p[:, 1])
            if edge[1] != 0.0:
                inside ^= crosses & (p[:, 0] < a[0] + edge[0] * (p[:, 1] - a[1]) / edge[1])
        return np.where(inside == self.inclusion, nearest, -nearest)


@dataclass(frozen=True, slots=True)
class Circle:
    """A round fence."""

    center_m: tuple[float, float]
    """North, east [m]."""
    radius_m: float
    inclusion: bool

    def margins(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance to the fence of points (n, 2) [m]; negative where it is broken."""
        left: NDArray[np.float64] = self.radius_m - np.hypot(*(p - np.array(self.center_m)).T)
        return left if self.inclusion else -left


@dataclass(frozen=True, slots=True)
class Fence:
    """All fences of a file, in the coordinates of its path; every one of them is to be kept."""

    parts: tuple[Polygon | Circle, ...]

    def margins(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far points (n, 2 or 3; north, east) are from breaking any of them [m]; negative: broken."""
        nearest: NDArray[np.float64] = np.min([part.margins(p[:, :2]) for part in self.parts], axis=0, initial=inf)
        return nearest


def joined(fences: Sequence[Fence | None]) -> Fence | None:
    """Return one fence of all; None when there is none."""
    parts = tuple(part for fence in fences if fence is not None for part in fence.parts)
    return Fence(parts) if parts else None


def moved(fence: Fence, by_m: tuple[float, float]) -> Fence:
    """Return the fence moved by north, east [m]."""
    north, east = by_m
    parts: list[Polygon | Circle] = []
    for part in fence.parts:
        if isinstance(part, Circle):
            parts.append(replace(part, center_m=(part.center_m[0] + north, part.center_m[1] + east)))
        else:
            parts.append(replace(part, corners_m=tuple((a + north, b + east) for a, b in part.corners_m)))
    return Fence(tuple(parts))
