"""Small parts of linearising a sampled loop by central differences, for rates and for attitude setpoints."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Quat, State
from companion.control.vectors import quat_exp

FloatArray = NDArray[np.float64]


def jacobian(function: Callable[[FloatArray], FloatArray], at: FloatArray, scales: FloatArray) -> FloatArray:
    """By central differences, a column per entry of `at`."""
    columns = []
    for i, h in enumerate(scales):
        offset = np.zeros_like(at)
        offset[i] = h
        columns.append((function(at + offset) - function(at - offset)) / (2.0 * h))
    return np.stack(columns, axis=1)


def state_of(x: FloatArray) -> State:
    """Position, velocity, rotation vector and body rates as a state."""
    n = x.tolist()
    return State((n[0], n[1], n[2]), (n[3], n[4], n[5]), quat_exp((n[6], n[7], n[8])), (n[9], n[10], n[11]))


def rotation_vector(q: Quat) -> list[float]:
    """The rotation vector of a small rotation, to third order."""
    return [2.0 * math.copysign(1.0, q[0]) * x for x in q[1:]]


def split(delay_s: float, dt: float) -> tuple[int, float]:
    """Whole intervals of a delay, and what is left of it [s]."""
    waits = int(delay_s / dt + 1e-9)
    return waits, max(0.0, delay_s - waits * dt)
