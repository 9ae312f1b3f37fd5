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

import numpy as np

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


class Envelope:
    """The envelope of one gain set.

    Args:
        gains: that are flown.
        drag: D [1/s].
        step_m_s2: the configured disturbance step, horizontal and vertical [m/s^2].
    """

    def __init__(self, gains: Gains, drag: float, step_m_s2: tuple[float, float]) -> None:
        self._p_max = gains.p_max
        self._decay, peak = _linear(gains, drag)
        self.step_roots = tuple(step * math.sqrt(ROOM * peak) for step in step_m_s2)
        """Square roots of what the configured steps give, horizontal and vertical [m]."""
        self._start_s: float | None = None
        self._inside = False
        self._roots = (0.0, 0.0)
        self._whole = 0.0

    def restart(self) -> None:
        """The next errors are those at the start: after engaging, a reset of the estimate, a change of the gains."""
        self._start_s = None

    def excess(self, numbers: tuple[float, ...], now_s: float) -> tuple[float, float, str] | None:
        """V_H or a part of it that is above the envelope: the value, the envelope [m^2] and the part; None: within.

        Of two parts that are above it is the one further above.

        Args:
            numbers: of a step (`control.flat`).
            now_s: vehicle time [s].
        """
        x, y, z, x2, y2, z2, x3, y3, z3, x4, y4, z4 = numbers[flat.ERRORS]
        inside = x * x + y * y + z * z <= self._p_max * self._p_max
        if self._start_s is None or (inside and not self._inside):
            # Where the bound of the position error ends the linear loop begins, with the errors that are there.
            self._start_s, self._inside, self._whole = now_s, inside, numbers[flat.LYAPUNOV]
            level = x * x + x2 * x2 + x3 * x3 + x4 * x4 + y * y + y2 * y2 + y3 * y3 + y4 * y4
            self._roots = math.sqrt(0.5 * level), math.sqrt(0.5 * (z * z + z2 * z2 + z3 * z3 + z4 * z4))
            return None
        if not (inside and self._inside):
            value = numbers[flat.LYAPUNOV]
            most = (math.sqrt(self._whole) + self.step_roots[0]) ** 2
            return (value, most, "all axes") if value > most else None
        stride = int((now_s - self._start_s) / STRIDE_S)
        decay = self._decay[stride if stride < STRIDES else STRIDES]
        vertical = 0.5 * (z * z + z2 * z2 + z3 * z3 + z4 * z4)
        root = decay * self._roots[1] + self.step_roots[1]
        vertical_most = root * root
        horizontal = 0.5 * (x * x + x2 * x2 + x3 * x3 + x4 * x4 + y * y + y2 * y2 + y3 * y3 + y4 * y4)
        root = decay * self._roots[0] + self.step_roots[0]
        horizontal_most = root * root
        if vertical > vertical_most and vertical * horizontal_most >= horizontal * vertical_most:
            return vertical, vertical_most, "vertical"
        return (horizontal, horizontal_most, "horizontal") if horizontal > horizontal_most else None


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
