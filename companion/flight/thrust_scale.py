"""What a thrust command really gives, over what the vehicle file says: batteries sag, propellers age.

Over a quarter of a second the velocity changes by

    dv = g u3 t - s (sum of T/m r3) - D (sum of v) + b t

with T by the vehicle file. A scale s and a vertical force are the same thing in a hover; they are told apart by how
they last. s wanders slowly. The vertical b is air that moves up and down: some tenths of m/s^2 for some seconds, zero
on average, so that what stays is the scale's. The horizontal b is the wind's and may be anything; only what turns with
the vehicle counts there. This is a Kalman filter with four states (s, b), observable without any manoeuvre.

Its b is not used. What is used of s stays within bounds, moves slowly, and is taken over without a step in the command
(`Tracker`): b_hat of the law gives up exactly what the scale takes, and goes on to estimate what is left.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config import Vehicle
from companion.control.types import GRAVITY_M_S2, State, Vec3
from companion.control.vectors import axes

BOUND: Final = 0.2
"""The scale that is used stays this near to 1."""
RATE_MAX_1_S: Final = 0.02
"""It changes no faster."""
FOLLOW_S: Final = 2.0
"""Time constant with which it goes to the estimate."""
CHANGE_MIN: Final = 1e-5
WINDOW_S: Final = 0.25
WARM_UP_S: Final = 2.0
"""After the beginning of a flight nothing is used yet."""
SCALE_SD: Final = 0.15
"""Of s at the beginning."""
SCALE_WALK_1_SQRT_S: Final = 0.003
VERTICAL_SD_M_S2: Final = 0.3
VERTICAL_LASTS_S: Final = 2.0
HORIZONTAL_SD_M_S2: Final = 3.0
HORIZONTAL_WALK_M_S2_SQRT_S: Final = 1.0
VELOCITY_SD_M_S: Final = 0.03
"""Of a change of velocity over a window."""
OUTLIER: Final = 5.0
"""A window that is further off than so many standard deviations is a gust, a touch or a reset: it is left out."""


class ThrustScale:
    """Follows the scale of one flight.

    Args:
        vehicle: for mass and drag.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._mass, self._drag = vehicle.body.mass_kg, vehicle.body.drag_1_s
        self.used = 1.0
        """What commands go by."""
        self.estimate = 1.0
        """s."""
        self._x = [1.0, 0.0, 0.0, 0.0]
        wide, high = HORIZONTAL_SD_M_S2**2, VERTICAL_SD_M_S2**2
        self._p = _diagonal((SCALE_SD**2, wide, wide, high))
        self._begun_s: float | None = None
        self._interrupted = True
        self._from_s = self._last_s = 0.0
        self._v0: Vec3 = (0.0, 0.0, 0.0)
        self._before: tuple[float, ...] = ()
        self._pushed = [0.0, 0.0, 0.0]
        self._gone = [0.0, 0.0, 0.0]

    def interrupt(self) -> None:
        """What came since the window's beginning does not count: saturation, a gap, a jump of the estimate."""
        self._interrupted = True

    def take(self, ratio: float) -> None:
        """The commands go by `ratio` times the scale from now on."""
        self.used *= ratio

    def on_state(self, stamp_s: float, state: State, thrust_n: float) -> float:
        """Takes a state.

        Args:
            stamp_s: vehicle time of its stamp [s].
            state: as received.
            thrust_n: that acts then by the model, with the scale that is used [N].

        Returns:
            the change of the scale that is due, as a ratio: 1 for none.
        """
        push = thrust_n / (self.used * self._mass)
        r3 = axes(state.q)[2]
        now = (push * r3[0], push * r3[1], push * r3[2], *state.v)
        if self._begun_s is None:
            self._begun_s = stamp_s
        if self._interrupted:
            self._restart(stamp_s, state, now)
            return 1.0
        half = 0.5 * (stamp_s - self._last_s)
        for i in range(3):
            self._pushed[i] += half * (self._before[i] + now[i])
            self._gone[i] += half * (self._before[3 + i] + now[3 + i])
        self._last_s, self._before = stamp_s, now
        lasted_s = stamp_s - self._from_s
        if lasted_s < WINDOW_S - 1e-6:
            return 1.0
        self._update(state.v, lasted_s)
        self._restart(stamp_s, state, now)
        if stamp_s - self._begun_s < WARM_UP_S:
            return 1.0
        return self._ratio(lasted_s)

    def _restart(self, stamp_s: float, state: State, now: tuple[float, ...]) -> None:
        self._interrupted = False
        self._from_s = self._last_s = stamp_s
        self._v0, self._before = state.v, now
        self._pushed, self._gone = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def _ratio(self, lasted_s: float) -> float:
        """Towards the estimate, slowly and within the bounds."""
        goal = min(max(self.estimate, 1.0 - BOUND), 1.0 + BOUND)
        most = RATE_MAX_1_S * lasted_s
        change = min(max((goal - self.used) * lasted_s / FOLLOW_S, -most), most)
        return 1.0 if abs(change) < CHANGE_MIN else (self.used + change) / self.used

    def _update(self, v: Vec3, t_s: float) -> None:
        """One step of the filter: time, then the three components one after the other."""
        x, p = self._x, self._p
        decay = math.exp(-t_s / VERTICAL_LASTS_S)
        x[3] *= decay
        for i in range(4):
            p[i][3] *= decay
            p[3][i] *= decay
        p[0][0] += SCALE_WALK_1_SQRT_S**2 * t_s
        p[1][1] += HORIZONTAL_WALK_M_S2_SQRT_S**2 * t_s
        p[2][2] += HORIZONTAL_WALK_M_S2_SQRT_S**2 * t_s
        p[3][3] += VERTICAL_SD_M_S2**2 * (1.0 - decay * decay)
        for i in range(3):
            fall = GRAVITY_M_S2 * t_s if i == 2 else 0.0
            seen = v[i] - self._v0[i] - fall + self._drag * self._gone[i]
            h = [-self._pushed[i], 0.0, 0.0, 0.0]
            h[1 + i] = t_s
            ph = [sum(p[k][j] * h[j] for j in range(4)) for k in range(4)]
            variance = sum(a * b for a, b in zip(h, ph, strict=True)) + VELOCITY_SD_M_S**2
            off = seen - sum(a * b for a, b in zip(h, x, strict=True))
            if off * off > OUTLIER * OUTLIER * variance:
                continue
            gain = [a / variance for a in ph]
            for k in range(4):
                x[k] += gain[k] * off
                for j in range(4):
                    p[k][j] -= gain[k] * ph[j]
        self.estimate = x[0]


def _diagonal(values: tuple[float, ...]) -> list[list[float]]:
    return [[value if i == k else 0.0 for k in range(len(values))] for i, value in enumerate(values)]
