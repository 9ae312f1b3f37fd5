"""Minimises a smooth function of many variables within bounds, in a given number of steps (L-BFGS, projected).

Made for functions that cost a millisecond: the general-purpose minimisers of scipy cost more than that per step, and
start threads for vectors that are far too short for them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], tuple[float, Array]]
"""From the variables to a value and its gradient."""

MEMORY = 6
"""Steps whose change of gradient says how the function bends."""

TRIALS = 8
"""Of the length of one step."""

DECREASE = 1e-4
"""Share of what the slope promises that a step must bring."""

CURVATURE_MIN = 1e-10
FLAT = 1e-12
"""Where the gradient is this short, beside the first one, nothing is left to gain."""


def minimise(function: Function, low: Array, high: Array, start: Array, steps: int) -> Array:
    """Return the best variables found between `low` and `high` from `start` on, all of shape (n,)."""
    x = np.clip(start, low, high)
    value, gradient = function(x)
    memory: deque[tuple[Array, Array, float]] = deque(maxlen=MEMORY)
    first = float(np.abs(gradient).max())
    for _ in range(steps):
        free = ~(((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0)))
        slope = np.where(free, gradient, 0.0)
        if float(np.abs(slope).max()) <= FLAT * first:
            break
        found = _step(function, x, value, gradient, _direction(slope, free, memory), low, high)
        if found is None:
            if not memory:
                break
            memory.clear()  # what is remembered of the bends misleads here: go down the slope
            continue
        moved, value, after = found
        change, bend = moved - x, after - gradient
        curvature = float(change @ bend)
        if curvature > CURVATURE_MIN * float(bend @ bend):
            memory.append((change, bend, curvature))
        x, gradient = moved, after
    return x


def _direction(slope: Array, free: NDArray[np.bool_], memory: deque[tuple[Array, Array, float]]) -> Array:
    """Return the way down by the bends that are remembered, among the variables that are free to move."""
    if not memory:
        return -slope / max(float(np.abs(slope).max()), 1e-300) * float(np.sqrt(len(slope)) / len(slope))
    d = slope.copy()
    shares = []
    for change, bend, curvature in reversed(memory):
        share = float(change @ d) / curvature
        d -= share * bend
        shares.append(share)
    _, bend, curvature = memory[-1]
    d *= curvature / float(bend @ bend)
    for (change, bend, curvature), share in zip(memory, reversed(shares), strict=True):
        d += (share - float(bend @ d) / curvature) * change
    down = np.where(free, -d, 0.0)
    return down if float(down @ slope) < 0.0 else -slope


def _step(
    function: Function, x: Array, value: float, gradient: Array, direction: Array, low: Array, high: Array
) -> tuple[Array, float, Array] | None:
    """Return a point along the direction that is enough lower, with its value and gradient; None if none is found."""
    length = 1.0
    for _ in range(TRIALS):
        moved = np.clip(x + length * direction, low, high)
        promised = float(gradient @ (moved - x))
        after, slope = function(moved)
        if after <= value + DECREASE * promised and promised < 0.0:
            return moved, after, slope
        # The lowest point of the parabola through what is known, but not too far from the last trial.
        bend = after - value - promised
        length *= min(max(-0.5 * promised / bend, 0.1), 0.5) if bend > 0.0 else 0.3
    return None
