"""How large V_H may be: what the linear loop makes of the errors at the start and of one step of the disturbance.

Inside |e1| <= p_max the closed loop is linear and the same on every axis (docs/law.md section 3), so V_H, a sum over
the axes, splits into a horizontal and a vertical part with an envelope each: wind comes from the side, while what is
lost of the thrust acts along the vertical. Per part, with V(0) at the start and the configured step b of its axis,

    V(t) <= ( |exp(A t)| sqrt(V(0)) + |b| sqrt(ROOM max_t V_step(t)) )^2

where V_step is V after a unit step of b (`control/certificate.py: linear_loop`). Outside p_max the certificate says
that V_H does not grow, and the envelope is its value at the start in place of the first term, for V_H as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion import accelerate
from companion.control import flat
from companion.control.certificate import FloatArray, linear_loop
from companion.control.law import Gains

ROOM = 1.5
"""Of V_H: the flown loop is sampled, late and behind lags. A step of the wind that the vehicle file allows was seen to
reach 1.06 times what the linear loop gives."""
STRIDE_S = 0.05
STRIDES = 120
"""The decay is tabulated over 6 s; afterwards it stays at its last value."""
_SUBSTEPS = 5

# where things stand among the numbers
START = 0
"""When the errors at the start were seen, vehicle time [s]; NaN before that."""
INSIDE = 1
"""1: they were within p_max."""
P_MAX = 2
ROOTS, STEP_ROOTS = 3, 5
"""Horizontal and vertical: square roots of V at the start, and of what the configured steps give [m]."""
DECAY = 7
"""Norms of exp(A t) at the strides."""
SIZE = DECAY + STRIDES + 1


class Envelope:
    """The envelope of one gain set.

    Args:
        gains: that are flown.
        drag: D [1/s].
        step_m_s2: the configured disturbance step, horizontal and vertical [m/s^2].
        engine: "python" or "numba".
    """

    def __init__(self, gains: Gains, drag: float, step_m_s2: tuple[float, float], engine: str = "python") -> None:
        decay, peak = _linear(gains, drag)
        self.step_roots = tuple(step * math.sqrt(ROOM * peak) for step in step_m_s2)
        """Square roots of what the configured steps give, horizontal and vertical [m]."""
        self.numbers = n = accelerate.numbers(SIZE, engine)
        """What the kernels below work on."""
        n[P_MAX], n[STEP_ROOTS], n[STEP_ROOTS + 1] = gains.p_max, *self.step_roots
        n[DECAY:SIZE] = decay
        self._whole = 0.0
        self.restart()

    def restart(self) -> None:
        """The next errors are those at the start: after engaging, a reset of the estimate, a change of the gains."""
        self.numbers[START] = math.nan

    def excess(self, numbers: tuple[float, ...], now_s: float) -> tuple[float, float, str] | None:
        """V_H or a part of it that is above the envelope: the value, the envelope [m^2] and the part; None: within.

        Of two parts that are above it is the one further above.

        Args:
            numbers: of a step (`control.flat`).
            now_s: vehicle time [s].
        """
        n, errors = self.numbers, numbers[flat.ERRORS]
        inside = is_inside(n, errors, 0)
        if math.isnan(n[START]) or (inside and n[INSIDE] < 0.5):
            # Where the bound of the position error ends the linear loop begins, with the errors that are there.
            n[START], n[INSIDE], self._whole = now_s, float(inside), numbers[flat.LYAPUNOV]
            horizontal, vertical = parts(errors, 0)
            n[ROOTS], n[ROOTS + 1] = math.sqrt(horizontal), math.sqrt(vertical)
            return None
        if not (inside and n[INSIDE] > 0.5):
            value = numbers[flat.LYAPUNOV]
            most = (math.sqrt(self._whole) + self.step_roots[0]) ** 2
            return (value, most, "all axes") if value > most else None
        horizontal, vertical = parts(errors, 0)
        horizontal_most, vertical_most = bounds(n, now_s)
        if vertical > vertical_most and vertical * horizontal_most >= horizontal * vertical_most:
            return vertical, vertical_most, "vertical"
        return (horizontal, horizontal_most, "horizontal") if horizontal > horizontal_most else None


def is_inside(n: Sequence[float], e: Sequence[float], at: int) -> bool:
    """Whether the position error, the first of the twelve errors that begin at a place, is within p_max. A kernel."""
    x, y, z = e[at], e[at + 1], e[at + 2]
    return x * x + y * y + z * z <= n[P_MAX] * n[P_MAX]


def parts(e: Sequence[float], at: int) -> tuple[float, float]:
    """V_H within p_max, horizontal and vertical, of twelve errors (e1 to e4) that begin at a place [m^2]. A kernel."""
    x, y, z, x2, y2, z2 = e[at], e[at + 1], e[at + 2], e[at + 3], e[at + 4], e[at + 5]
    x3, y3, z3, x4, y4, z4 = e[at + 6], e[at + 7], e[at + 8], e[at + 9], e[at + 10], e[at + 11]
    horizontal = x * x + x2 * x2 + x3 * x3 + x4 * x4 + y * y + y2 * y2 + y3 * y3 + y4 * y4
    return 0.5 * horizontal, 0.5 * (z * z + z2 * z2 + z3 * z3 + z4 * z4)


def bounds(n: Sequence[float], now_s: float) -> tuple[float, float]:
    """The envelope within p_max, horizontal and vertical, at a vehicle time [m^2]. A kernel."""
    stride = int((now_s - n[START]) / STRIDE_S)
    decay = n[DECAY + (stride if stride < STRIDES else STRIDES)]
    horizontal, vertical = decay * n[ROOTS] + n[STEP_ROOTS], decay * n[ROOTS + 1] + n[STEP_ROOTS + 1]
    return horizontal * horizontal, vertical * vertical


def keeps(n: Sequence[float], e: Sequence[float], at: int, now_s: float) -> bool:
    """Whether errors that begin at a place are within the envelope, and nothing begins with them. A kernel.

    What it denies `Envelope.excess` looks at.
    """
    if not (n[INSIDE] > 0.5 and is_inside(n, e, at) and now_s >= n[START]):  # NaN before the start
        return False
    horizontal, vertical = parts(e, at)
    horizontal_most, vertical_most = bounds(n, now_s)
    return horizontal <= horizontal_most and vertical <= vertical_most


def _linear(gains: Gains, drag: float) -> tuple[list[float], float]:
    """Norm of exp(A t) from errors to errors at the strides, never below its later values, and the peak of V after a
    unit step of the disturbance."""
    a = linear_loop(gains, drag)
    fine = _exponential(a * (STRIDE_S / _SUBSTEPS))
    stride = np.linalg.matrix_power(fine, _SUBSTEPS)
    power, decay = np.eye(5), []
    for _ in range(STRIDES + 1):
        decay.append(float(np.linalg.norm(power[:4, :4], 2)))
        power = power @ stride
    for i in range(STRIDES - 1, -1, -1):
        decay[i] = max(decay[i], decay[i + 1])
    x, peak = np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 0.0
    for _ in range(STRIDES * _SUBSTEPS):
        peak = max(peak, 0.5 * float(x[:4] @ x[:4]))
        x = fine @ x
    return decay, peak


def _exponential(a: FloatArray) -> FloatArray:
    """exp of a matrix of small norm, by its series after halving it a few times."""
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(a).sum(axis=1).max()), 1e-9)))) + 2
    scaled = a / 2.0**halvings
    term = result = np.eye(len(a))
    for k in range(1, 12):
        term = term @ scaled / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result
