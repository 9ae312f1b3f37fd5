"""Time constant and delay of a body rate behind its setpoint.

    w'(t) = ( r(t - delay) - w(t) + k_i z(t) ) / lag,     z' = r(t - delay) - w

the loop that the law inverts (docs/law.md section 8): first order, with the integral of the autopilot's rate controller
(k_i: integral over proportional gain, read from its parameters). Each window begins with w and z of its own; both enter
linearly and are solved for inside of the search for delay and lag.

A real rate loop is of higher order. Where many states fall into its response, the lag is that of the first-order loop
that answers most like it. Commands go out when states come, though, so that rare states see every response at the same
few moments: with one or two of them in it, the lag is what makes the model pass through those, and which moments they
are is chance. No fit can undo that; the lag's standard deviation has a part for it.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from companion.identification.data import GRID_S, Array, FlightData, Grid, Held, spread

DELAY_RANGE_S: Final = (-0.05, 0.3)
"""After sending; below zero where the clock's own delay is in the sending time."""
LAG_RANGE_S: Final = (0.004, 1.0)
TOLERANCE: Final = 1e-5
"""Relative change of the parameters and of the squared residuals below which a search ends."""
START: Final = (0.02, 0.06)
EXCITED_RAD_S: Final = 0.03
"""Standard deviation of the commands below which nothing can be told."""
RARE: Final = 0.06
"""Standard deviation of a lag by rare states, over the lag, where they are one lag apart; it goes with the square.
Second-order loops of 20 to 80 ms at 10 to 100 Hz come out wrong by up to 1.5 times as much (the bundled vehicle's)."""
SOUND: Final = 0.3
"""A lag with a larger standard deviation, over the lag, is not told."""


class RateFit(NamedTuple):
    """One axis."""

    delay_s: float
    """From sending a setpoint."""
    lag_s: float
    delay_sd_s: float
    lag_sd_s: float
    residual_rad_s: float
    """Root mean square of what the model leaves."""
    rare_sd_s: float
    """The part of the lag's standard deviation that comes of rare states, however many there are."""

    @property
    def sound(self) -> bool:
        """Whether the flight told enough."""
        return self.lag_sd_s < SOUND * self.lag_s and self.residual_rad_s > 0.0

    @property
    def rare(self) -> bool:
        """Whether its states were too far apart for this lag: a longer flight would not tell it either."""
        return not self.rare_sd_s < SOUND * self.lag_s


class RateAxis:
    """The data of one axis, ready to be fitted.

    Args:
        data: of the flight.
        axis: 0 to 2.
        integral_1_s: k_i.
    """

    def __init__(self, data: FlightData, axis: int, integral_1_s: float) -> None:
        self._data, self._integral = data, integral_1_s
        self._command = Held(data.sent_s, data.rates[:, axis])
        self._windows = [(data.w[w, axis], Grid(data.t_s[w])) for w in data.windows]
        self.excitation = float(np.std(data.rates[:, axis]))

    def residuals(self, delay_s: float, lag_s: float) -> Array:
        """Measured less modelled rates of all windows [rad/s]."""
        k = self._integral
        system = np.array([[-1.0 / lag_s, k / lag_s], [-1.0, 0.0]])
        augmented = np.zeros((3, 3))
        augmented[:2, :2] = system
        augmented[:2, 2] = (1.0 / lag_s, 1.0)
        step = expm(augmented * GRID_S)
        a, b = step[:2, :2], step[:2, 2]
        # w after n cells as a filter of the commands: C (z - A)^-1 B
        denominator = [1.0, -(a[0, 0] + a[1, 1]), a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]]
        numerator = [0.0, b[0], a[0, 1] * b[1] - a[1, 1] * b[0]]
        found = []
        for w, cells in self._windows:
            edges = cells.edges_s
            forced = lfilter(numerator, denominator, np.append(self._command.means(edges - delay_s), 0.0))
            target = w - cells.at_stamps(forced)
            basis = cells.at_stamps(_free(a, len(edges)))
            if k == 0.0:
                basis = basis[:, :1]
            solution = np.linalg.lstsq(basis.T @ basis, basis.T @ target, rcond=None)[0]
            found.append(target - basis @ solution)
        return np.concatenate(found)

    def fit(self, delay_s: float | None = None, lag_s: float = START[1]) -> RateFit:
        """The best lag and delay, or the best lag with a delay that is given; the search begins at `lag_s`."""
        low, high = (math.log(x) for x in LAG_RANGE_S)

        def residuals(x: Array) -> Array:
            return self.residuals(float(x[1]) if delay_s is None else delay_s, math.exp(float(x[0])))

        start, bounds = [math.log(lag_s), START[0]], ([low, DELAY_RANGE_S[0]], [high, DELAY_RANGE_S[1]])
        count = 2 if delay_s is None else 1
        best = least_squares(
            residuals,
            start[:count],
            bounds=(bounds[0][:count], bounds[1][:count]),
            x_scale=[0.3, 0.01][:count],
            xtol=TOLERANCE,
            ftol=TOLERANCE,
            diff_step=[1e-3] * count,
        )
        lag = math.exp(float(best.x[0]))
        delay = float(best.x[1]) if delay_s is None else delay_s
        rms = float(np.sqrt(np.mean(best.fun**2)))
        deviations = spread(np.asarray(best.jac), rms, self._data)
        delay_sd = deviations[1] if delay_s is None else 0.0
        rare_sd = RARE * self._data.interval_s**2 / lag
        return RateFit(delay, lag, delay_sd, math.hypot(deviations[0] * lag, rare_sd), rms, rare_sd)


def _free(a: Array, count: int) -> Array:
    """w over time from w = 1 and from z = 1 without commands, shape (count, 2)."""
    values, vectors = np.linalg.eig(a)
    if abs(values[0] - values[1]) < 1e-9:
        values = values * np.array([1.0, 1.0 - 1e-6])
    powers = values[None, :] ** np.arange(count)[:, None]
    return np.asarray((powers * vectors[0]) @ np.linalg.inv(vectors)).real
