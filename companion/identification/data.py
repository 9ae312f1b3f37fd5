"""What a flight's record says about the vehicle: states, and the commands with the times at which they went out.

A command computed from the state stamped s goes out at s and the state's age, and is held until the next one. Fits work
on windows: pieces of the record without a gap, each with a start of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from companion.errors import InputError
from companion.record.flight_source import FlightSource

Array = npt.NDArray[np.float64]

GRID_S: Final = 0.004
"""Step of the simulated responses; exact for commands that are held, so that only the sampling of the result counts."""
GAP_MAX_S: Final = 0.08
"""Longer without a state, a window ends; where states are rarer, see GAP_INTERVALS."""
GAP_INTERVALS: Final = 2.5
"""Up to so many of the record's usual intervals without a state are no gap: one state may be lost."""
WINDOW_S: Final = 6.0
WINDOW_MIN_S: Final = 2.0
AGE_MAX_S: Final = 0.5
"""A larger age is no age: the clock was wrong."""
ROWS_MIN: Final = 500


@dataclass(frozen=True)
class FlightData:
    """The rows of a record in which the vehicle followed setpoints."""

    t_s: Array
    """Stamps of the states, vehicle time."""
    sent_s: Array
    """When their commands went out, on the same clock."""
    p: Array
    v: Array
    q: Array
    w: Array
    rates: Array
    """Commanded body rates [rad/s], shape (rows, 3); NaN where none were sent."""
    thrust: Array
    """Command, of full."""
    age_s: float | None
    """Median age of the states at sending; None: the clock did not tell, and `sent_s` are the stamps."""
    windows: tuple[slice, ...]

    @property
    def duration_s(self) -> float:
        """Of all windows together."""
        return float(sum(self.t_s[w.stop - 1] - self.t_s[w.start] for w in self.windows))

    @property
    def interval_s(self) -> float:
        """The usual time between two states."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def thrust_axis(self) -> Array:
        """r3, the direction of body z, NED, shape (rows, 3)."""
        a, b, c, d = self.q.T
        return np.column_stack((2.0 * (b * d + a * c), 2.0 * (c * d - a * b), 1.0 - 2.0 * (b * b + c * c)))


def flight_data(source: FlightSource) -> FlightData:
    """Reads the rows of a flight.

    Raises:
        InputError: there is too little in it.
    """
    record = source.record
    thrust = record.column("thrust_cmd")
    state = record.columns(*(f"{x}_{i}" for x in "pv" for i in "ned"), "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z")
    good = np.isfinite(thrust) & np.isfinite(state).all(axis=1)
    if np.count_nonzero(good) < ROWS_MIN:
        raise InputError(f"{source.path}: only {np.count_nonzero(good)} states were answered with a thrust")
    rows = np.flatnonzero(good)
    t_s = record.column("t_s")[rows]
    age_s = 1e-3 * record.column("state_age_ms")[rows]
    known = bool(np.all(np.isfinite(age_s)) and np.median(age_s) >= 0.0 and np.max(np.abs(age_s)) < AGE_MAX_S)
    sent_s = np.maximum.accumulate(t_s + age_s) if known else t_s
    adaptation = (source.summary.get("engagement") or {}).get("adaptation")
    kind = source.configuration.get("output", {}).get("kind", "auto") if adaptation is None else adaptation[0]
    sends_rates = kind in {"auto", "rates"}
    rates = record.columns("rate_cmd_x", "rate_cmd_y", "rate_cmd_z")[rows]
    if not sends_rates:
        rates = np.full_like(rates, np.nan)
    return FlightData(
        *(t_s, sent_s, state[rows, 0:3], state[rows, 3:6], state[rows, 6:10], state[rows, 10:13]),
        *(rates, thrust[rows].copy(), float(np.median(age_s)) if known else None, windows(t_s)),
    )


def windows(t_s: Array) -> tuple[slice, ...]:
    """Cuts stamps into windows of about WINDOW_S without gaps."""
    apart_s = np.diff(t_s)
    gap_s = max(GAP_MAX_S, GAP_INTERVALS * float(np.median(apart_s)))
    edges = [0, *(np.flatnonzero(apart_s > gap_s) + 1).tolist(), len(t_s)]
    found = []
    for begin, end in itertools.pairwise(edges):
        length_s = t_s[end - 1] - t_s[begin]
        if length_s < WINDOW_MIN_S:
            continue
        cuts = np.linspace(0.0, length_s, max(1, round(length_s / WINDOW_S)) + 1)[1:-1] + t_s[begin]
        inner = [begin, *np.searchsorted(t_s, cuts).tolist(), end]
        found += [slice(int(a), int(b)) for a, b in itertools.pairwise(inner)]
    return tuple(found)


class Held:
    """A command that is held until the next one, as a function of time.

    Args:
        sent_s: when the commands went out.
        values: the commands.
    """

    def __init__(self, sent_s: Array, values: Array) -> None:
        self._at = np.append(sent_s, sent_s[-1] + 1.0)
        self._sum = np.concatenate(([0.0], np.cumsum(values * np.diff(self._at))))
        self._first, self._last = float(values[0]), float(values[-1])

    def means(self, edges_s: Array) -> Array:
        """The mean between each time and the next one."""
        at, total = self._at, self._sum
        summed = np.interp(edges_s, at, total)
        summed += self._first * np.minimum(edges_s - at[0], 0.0) + self._last * np.maximum(edges_s - at[-1], 0.0)
        return np.asarray(np.diff(summed) / np.diff(edges_s))


class Grid:
    """Cells of GRID_S that cover stamps, and the way back to the stamps."""

    def __init__(self, t_s: Array) -> None:
        count = int(np.ceil((t_s[-1] - t_s[0]) / GRID_S)) + 1
        self.edges_s: Array = t_s[0] + GRID_S * np.arange(count + 1)
        place = (t_s - t_s[0]) / GRID_S
        self._before = place.astype(np.intp)
        self._share = place - self._before

    def at_stamps(self, values: Array) -> Array:
        """What is known at the edges, shape (edges, ...), at the stamps."""
        share = self._share if values.ndim == 1 else self._share[:, None]
        before = values[self._before]
        return np.asarray(before + share * (values[self._before + 1] - before))

    def summed(self, values: Array) -> Array:
        """The integral of what is known in the cells, shape (cells, columns), from the first edge to each stamp."""
        total = np.zeros((len(values) + 1, values.shape[1]))
        np.cumsum(values * GRID_S, axis=0, out=total[1:])
        return self.at_stamps(total)


def spread(jacobian: Array, residual_rms: float, data: FlightData) -> Sequence[float]:
    """Standard deviations of fitted parameters; residuals of a fifth of a second count once, for they go together."""
    together = max(1.0, 0.2 * len(jacobian) / max(data.duration_s, 1e-9))
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * residual_rms**2 * together
    return [float(x) for x in np.sqrt(np.diag(covariance))]
