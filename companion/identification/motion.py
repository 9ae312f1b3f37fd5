"""Thrust and drag from velocities: what a command of thrust gives, how late, along which curve; linear drag.

    v' = g u3 - S c(u) r3 + b - D v,      c(u) = f u^2 + (1 - f) u behind a delay and a first-order lag

S is the thrust over the mass at full command. The model is integrated along the attitudes that were measured; each
window has its own velocity at its beginning and its own steady disturbance b, which enter linearly and are solved for,
as S and D are, inside of the search for delay, lag and f. The vertical part of b is held near zero: what holds the
vehicle up is the thrust, by definition, and so the mass may be wrong without harm.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from companion.control.types import GRAVITY_M_S2
from companion.identification.data import GRID_S, Array, FlightData, Grid, Held, spread
from companion.identification.rates import DELAY_RANGE_S, TOLERANCE

LAG_RANGE_S: Final = (0.002, 0.5)
CURVE_RANGE: Final = (0.0, 1.0)
VERTICAL_RATIO: Final = 0.02 / 0.05
"""Noise of a velocity [m/s] over the vertical disturbance that there may be [m/s^2]."""
TRANSIENT_S: Final = 0.5
"""At the beginning, when what acted before is not known."""


class MotionFit(NamedTuple):
    """What was found."""

    full_m_s2: float
    """S [m/s^2]."""
    curve_factor: float
    lag_s: float
    delay_s: float
    """Of the thrust, from sending its command."""
    drag_1_s: float
    full_sd_m_s2: float
    curve_sd: float
    lag_sd_s: float
    delay_sd_s: float
    drag_sd_1_s: float
    residual_m_s: float
    """Root mean square of what the model leaves of the velocities."""

    @property
    def hover_share(self) -> float:
        """The command that hovers."""
        share, f = GRAVITY_M_S2 / self.full_m_s2, self.curve_factor
        if f < 1e-9:
            return share
        half = 0.5 * (1.0 - f) / f
        return math.sqrt(half * half + share / f) - half

    @property
    def sound(self) -> bool:
        """Whether the flight told enough about the thrust."""
        return self.full_sd_m_s2 < 0.05 * self.full_m_s2 and self.lag_sd_s < max(0.3 * self.lag_s, 0.01)


class Motion:
    """The data of a flight, ready to be fitted.

    Args:
        data: of the flight.
    """

    def __init__(self, data: FlightData) -> None:
        self._data = data
        self._parts = []
        for w in data.windows:
            t_s, cells = data.t_s[w], Grid(data.t_s[w])
            middles = 0.5 * (cells.edges_s[1:] + cells.edges_s[:-1])
            axis = np.column_stack([np.interp(middles, t_s, column) for column in data.thrust_axis[w].T])
            speed = np.column_stack([np.interp(middles, t_s, column) for column in data.v[w].T])
            fallen = data.v[w] - np.outer(t_s - t_s[0], (0.0, 0.0, GRAVITY_M_S2))
            self._parts.append((t_s - np.mean(t_s), cells, axis, cells.summed(speed), fallen))

    def _linear(self, delay_s: float, lag_s: float, curve: float) -> tuple[Array, Array]:
        """Columns of S and D and the target, all windows and axes, what is solved for per window taken out."""
        command = Held(self._data.sent_s, curve * self._data.thrust**2 + (1.0 - curve) * self._data.thrust)
        left = math.exp(-GRID_S / lag_s)
        columns, targets = [], []
        for since, cells, axis, way, fallen in self._parts:
            edges = cells.edges_s
            # the lag's state at the window's beginning comes from some lags before it
            before = edges[0] - delay_s - GRID_S * np.arange(round(TRANSIENT_S / GRID_S), 0, -1)
            means = command.means(np.concatenate((before, edges - delay_s)))
            lagged = lfilter([1.0 - left], [1.0, -left], means, zi=[left * means[0]])[0][len(before) :]
            pushed = cells.summed(-lagged[:, None] * axis)
            power = float(since @ since)
            for i in range(3):
                prior = VERTICAL_RATIO**2 if i == 2 else 0.0
                share = 1.0 - math.sqrt(prior / (prior + power))
                part = np.column_stack((pushed[:, i], -way[:, i], fallen[:, i]))
                part = part - part.mean(axis=0)
                part = part - np.outer(since, share * (since @ part) / power)
                columns.append(part[:, :2])
                targets.append(part[:, 2])
        return np.concatenate(columns), np.concatenate(targets)

    def residuals(self, delay_s: float, lag_s: float, curve: float) -> Array:
        """Of the velocities [m/s], with the best S and D."""
        columns, target = self._linear(delay_s, lag_s, curve)
        solution = np.linalg.lstsq(columns.T @ columns, columns.T @ target, rcond=None)[0]
        return np.asarray(target - columns @ solution)

    def fit(self, delay_s: float | None = None, curve: float | None = None, lag_s: float = 0.04) -> MotionFit:
        """The best of all.

        Args:
            delay_s: of the thrust; None: is found.
            curve: f; None: is found.
            lag_s: where the search begins.
        """
        names = ["lag"] + ["delay"] * (delay_s is None) + ["curve"] * (curve is None)
        given = {name: x for name, x in (("delay", delay_s), ("curve", curve)) if x is not None}
        start = {"lag": math.log(lag_s), "delay": 0.02, "curve": 0.2}
        bounds = {"lag": tuple(map(math.log, LAG_RANGE_S)), "delay": DELAY_RANGE_S, "curve": CURVE_RANGE}

        def values(x: Array) -> tuple[float, float, float]:
            at = given | {name: float(value) for name, value in zip(names, x, strict=True)}
            return at["delay"], math.exp(at["lag"]), at["curve"]

        def residuals(x: Array) -> Array:
            return self.residuals(*values(x))

        best = least_squares(
            residuals,
            [start[name] for name in names],
            bounds=([bounds[name][0] for name in names], [bounds[name][1] for name in names]),
            x_scale=[{"lag": 0.3, "delay": 0.01, "curve": 0.2}[name] for name in names],
            xtol=TOLERANCE,
            ftol=TOLERANCE,
            diff_step=[1e-3] * len(names),
        )
        delay, lag, factor = values(best.x)
        columns, target = self._linear(delay, lag, factor)
        (full, drag), *_ = np.linalg.lstsq(columns, target, rcond=None)
        rms = float(np.sqrt(np.mean(best.fun**2)))
        deviations = dict(zip(names, spread(np.asarray(best.jac), rms, self._data), strict=True))
        full_sd, drag_sd = spread(columns, rms, self._data)
        return MotionFit(
            *(float(full), factor, lag, delay, float(drag), full_sd, deviations.get("curve", 0.0)),
            *(deviations["lag"] * lag, deviations.get("delay", 0.0), drag_sd, rms),
        )
