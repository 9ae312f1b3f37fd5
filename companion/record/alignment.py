"""The time between two logs of the same flight, found from the motion in them.

Each log has its own clock, and may begin and end at another time. The offset is the one at which the velocities, and
the positions up to a constant, of both differ least: over all offsets at a coarse step by Fourier transforms, then
refined between the samples. How much better it is than any other one says whether it can be trusted: on a path of equal
laps a whole lap fits nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft
from scipy.optimize import minimize_scalar

from companion.errors import InputError

Array = npt.NDArray[np.float64]

_STEP_S: Final = 0.02
_GAP_S: Final = 0.25
"""Between samples further apart than this nothing is known."""
_OVERLAP_LEAST: Final = 0.5
"""Of the shorter log."""
_OVERLAP_LEAST_S: Final = 2.0
_APART_S: Final = 1.0
"""An offset further away than this is another one."""
_LEAST_AGREEMENT: Final = 0.8
_MOVING_M_S: Final = 0.05
SAME_FLIGHT_M_S: Final = 0.03
"""Both logs of a flight have the velocities of one estimator."""
_CLEAR: Final = 2.0
"""The next best offset leaves so many times the difference, or the offset is ambiguous."""
_NOTHING_M_S: Final = 0.005
"""Less than this remains only where both are the same."""


@dataclass(frozen=True)
class Motion:
    """Where something was."""

    t_s: Array
    """Strictly increasing, shape (len,)."""
    p: Array
    """Position, NED [m], shape (len, 3)."""
    v: Array
    """Velocity, NED [m/s], shape (len, 3)."""


class Fit(NamedTuple):
    """How two motions lie over each other."""

    offset_s: float
    """To be added to the second one's times; to a tenth of a millisecond."""
    agreement: float
    """Share of the velocities' variance that both have in common: 1 for equal ones."""
    velocity_rms_m_s: float
    """Of the difference."""
    position_rms_m: float
    """Of the difference, up to `position_offset_m`."""
    position_offset_m: tuple[float, float, float]
    """The first one's position less the second one's, on average, NED."""
    overlap_s: float
    runner_up_s: float | None
    """The next best offset; None: there is no other."""
    clear: bool
    """Whether the next best offset fits far worse."""

    @property
    def same_flight(self) -> bool:
        """Whether so little remains as between two logs of one flight; two flights of one path differ by more."""
        return self.velocity_rms_m_s < SAME_FLIGHT_M_S

    @property
    def sentence(self) -> str:
        """For people."""
        doubt = "" if self.clear or self.runner_up_s is None else f"; ambiguous: {self.runner_up_s:+.2f} s fits as well"
        if not self.same_flight:
            doubt += "; so much remains between two flights of one path, this may be the log of another"
        return (
            f"{self.offset_s:+.4f} s ({100.0 * self.agreement:.2f} % of the velocity's variance agrees over "
            f"{self.overlap_s:.1f} s; {100.0 * self.velocity_rms_m_s:.2g} cm/s and "
            f"{100.0 * self.position_rms_m:.2g} cm rms remain){doubt}"
        )


def align(first: Motion, second: Motion) -> Fit:
    """Find the time to add to the second motion's.

    Raises:
        InputError: there is too little motion or time, or no offset at which both agree.
    """
    one, other = _Sampled.of(first), _Sampled.of(second)
    cost, overlap, lags = _costs(one, other)
    least = max(_OVERLAP_LEAST * min(one.known.sum(), other.known.sum()), _OVERLAP_LEAST_S / _STEP_S)
    cost = np.where(overlap >= least, cost, np.inf)
    if not np.isfinite(cost).any():
        raise InputError(f"the logs have less than {_OVERLAP_LEAST_S:g} s of flight; nothing can be laid over another")
    best = int(np.argmin(cost))
    offset_s = one.begin_s - other.begin_s + _refined(one, other, float(lags[best])) * _STEP_S
    fit = _fit(first, second, offset_s)
    if fit.agreement < _LEAST_AGREEMENT:
        raise InputError(
            f"the logs do not show the same flight: at the best time offset ({offset_s:+.2f} s) only "
            f"{100.0 * max(fit.agreement, 0.0):.0f} % of the velocity's variance agrees"
        )
    valley = np.concatenate(([False], (cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:]), [False]))
    elsewhere = np.where(valley & (np.abs(lags - lags[best]) * _STEP_S > _APART_S), cost, np.inf)
    if not np.isfinite(elsewhere).any():
        return fit
    other_lag = _refined(one, other, float(lags[int(np.argmin(elsewhere))]))
    runner_up = _fit(first, second, one.begin_s - other.begin_s + other_lag * _STEP_S)
    as_good = runner_up.velocity_rms_m_s < max(_CLEAR * fit.velocity_rms_m_s, _NOTHING_M_S)
    return fit._replace(runner_up_s=runner_up.offset_s, clear=not as_good)


@dataclass(frozen=True)
class _Sampled:
    """A motion at equal steps."""

    begin_s: float
    known: npt.NDArray[np.bool_]
    numbers: Array
    """Velocity and position, each over its spread, shape (len, 6); 0 where nothing is known."""
    motion: Motion

    @classmethod
    def of(cls, motion: Motion) -> _Sampled:
        if len(motion.t_s) < 2:
            raise InputError("one of the logs has no motion; nothing can be laid over another")
        t_s = np.arange(motion.t_s[0], motion.t_s[-1], _STEP_S)
        after = np.searchsorted(motion.t_s, t_s, side="right").clip(1, len(motion.t_s) - 1)
        known = motion.t_s[after] - motion.t_s[after - 1] < _GAP_S
        numbers = np.column_stack([np.interp(t_s, motion.t_s, column) for column in (*motion.v.T, *motion.p.T)])
        numbers[:, 3:] -= numbers[known, 3:].mean(axis=0) if known.any() else 0.0
        return cls(float(motion.t_s[0]), known, np.where(known[:, None], numbers, 0.0), motion)


def _scales(one: _Sampled, other: _Sampled) -> tuple[float, float]:
    """Variances of velocity and position that make their differences comparable. Raises InputError without motion."""
    spreads = [
        [float(sampled.numbers[sampled.known][:, part].var(axis=0).sum()) for part in (slice(0, 3), slice(3, 6))]
        for sampled in (one, other)
    ]
    velocity, position = (max(a, b) for a, b in zip(*spreads, strict=True))
    if not min(spreads[0][0], spreads[1][0]) > _MOVING_M_S**2:
        raise InputError("one of the logs hardly moves; without motion no time offset can be found")
    return velocity, position


def _costs(one: _Sampled, other: _Sampled) -> tuple[Array, Array, Array]:
    """For every lag of the second motion, in steps: the mean square difference, and over how many samples.

    The difference of velocities counts as it is, that of positions about its mean.
    """
    velocity, position = _scales(one, other)
    scale = np.sqrt(np.array([velocity] * 3 + [position] * 3))
    a, b = one.numbers / scale, other.numbers / scale
    length = next_fast_len(len(a) + len(b), real=True)

    def correlated(x: Array, y: Array) -> Array:
        """Sum over i of x[i + lag] y[i], for lags from -(len(b) - 1) to len(a) - 1."""
        full = irfft(rfft(x, length) * np.conj(rfft(y, length)), length)
        return np.concatenate((full[-(len(b) - 1) :] if len(b) > 1 else full[:0], full[: len(a)]))

    here, there = one.known.astype(np.float64), other.known.astype(np.float64)
    overlap = np.round(correlated(here, there))
    count = np.maximum(overlap, 1.0)
    cost = np.zeros(len(overlap))
    for column in range(a.shape[1]):
        x, y = a[:, column], b[:, column]
        squares = correlated(x * x, there) + correlated(here, y * y) - 2.0 * correlated(x, y)
        cost += squares / count
        if column >= 3:
            cost -= ((correlated(x, there) - correlated(here, y)) / count) ** 2
    return np.maximum(cost, 1e-12), overlap, np.arange(-(len(b) - 1), len(a), dtype=np.float64)


def _refined(one: _Sampled, other: _Sampled, lag: float) -> float:
    """The lag between the steps, by the least mean square difference of the velocities themselves [steps]."""
    base_s = one.begin_s - other.begin_s

    def cost(found: float) -> float:
        difference, _ = _differences(one.motion, other.motion, base_s + found * _STEP_S)
        return float(np.mean(difference[:, :3] ** 2)) if len(difference) else np.inf

    found = minimize_scalar(cost, bounds=(lag - 1.5, lag + 1.5), method="bounded", options={"xatol": 1e-3})
    return float(found.x)


def _differences(first: Motion, second: Motion, offset_s: float) -> tuple[Array, Array]:
    """First less second at the first one's times where both are known: velocity and position, shape (n, 6), and the
    first one's numbers there."""
    shifted = second.t_s + offset_s
    after = np.searchsorted(shifted, first.t_s).clip(1, len(shifted) - 1)
    gap = shifted[after] - shifted[after - 1]
    inside = (first.t_s >= shifted[0]) & (first.t_s <= shifted[-1]) & (gap < _GAP_S)
    t_s = first.t_s[inside]
    numbers = np.column_stack((first.v, first.p))[inside]
    others = np.column_stack([np.interp(t_s, shifted, column) for column in (*second.v.T, *second.p.T)])
    return numbers - others, numbers


def _fit(first: Motion, second: Motion, offset_s: float) -> Fit:
    difference, numbers = _differences(first, second, offset_s)
    velocity, position = difference[:, :3], difference[:, 3:]
    variance = float(numbers[:, :3].var(axis=0).sum())
    square = float((velocity**2).sum(axis=1).mean())
    mean = position.mean(axis=0)
    north, east, down = (float(x) for x in mean)
    step_s = float(np.median(np.diff(first.t_s)))
    return Fit(
        offset_s=round(offset_s, 4) + 0.0,
        agreement=1.0 - square / variance if variance > 0.0 else 0.0,
        velocity_rms_m_s=float(np.sqrt(square)),
        position_rms_m=float(np.sqrt((((position - mean) ** 2).sum(axis=1)).mean())),
        position_offset_m=(north, east, down),
        overlap_s=step_s * len(difference),
        runner_up_s=None,
        clear=True,
    )
