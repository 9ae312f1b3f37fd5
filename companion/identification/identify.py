"""All of a vehicle from one flight: hover thrust, thrust curve, motor lag, rate loops, delay, drag.

The law predicts over one delay. Every axis is fitted with a delay of its own first. The common one is the thrust's,
where it is known well: rotors are a first-order lag by nature, so that what is left there is the way of the command.
The fit of a rate loop, which is of higher order, calls a part of its inertia delay. Where the thrust does not tell, it
is where the misfits of roll, pitch and thrust together are smallest. The lags that go with the common delay are fitted
again: what an axis has more of delay than that goes into its lag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from companion.errors import RefusedError
from companion.identification.data import FlightData
from companion.identification.motion import Motion, MotionFit
from companion.identification.rates import EXCITED_RAD_S, RateAxis, RateFit

AXES: Final = ("roll", "pitch", "yaw")
CURVE_MIN: Final = 0.03
"""A smaller curve factor is none."""
DELAY_SD_MAX_S: Final = 0.004
"""Of the thrust's own delay, to be the common one."""
DELAY_TOLERANCE_S: Final = 0.001
_NAMES: Final = ("ROLL", "PITCH", "YAW")


@dataclass(frozen=True)
class Identified:
    """What a flight says about its vehicle. Delays count from a command's sending."""

    own: tuple[RateFit | None, RateFit | None, RateFit | None]
    """Roll, pitch, yaw, each with its own delay; None: not excited."""
    rates: tuple[RateFit | None, RateFit | None, RateFit | None]
    """The same with the common delay."""
    integral_1_s: tuple[float, float, float]
    motion_own: MotionFit
    """Thrust and drag with the thrust's own delay."""
    motion: MotionFit
    """The same with the common delay."""
    delay_s: float
    """The common one."""
    age_s: float | None
    """Of the states at sending; None: the clocks did not tell, and the delay counts from the states' stamps."""
    duration_s: float
    interval_s: float
    """The usual time between two states."""

    @property
    def rare(self) -> list[str]:
        """What the states were too far apart for, for people."""
        return [f"{name} rate" for name, fit in zip(AXES, self.rates, strict=True) if fit is not None and fit.rare]

    @property
    def lacking(self) -> list[str]:
        """What the flight did not tell, for people."""
        names = [f"{name} rate" for name, fit in zip(AXES, self.rates, strict=True) if fit is None or not fit.sound]
        return names + ([] if self.motion.sound else ["thrust"])


def rate_integrals(parameters: Mapping[str, float], assumed: tuple[float, float, float]) -> tuple[float, float, float]:
    """Integral over proportional gain of the autopilot's rate loops [1/s], from its parameters where it told them."""
    found = []
    for name, otherwise in zip(_NAMES, assumed, strict=True):
        p, i = parameters.get(f"MC_{name}RATE_P"), parameters.get(f"MC_{name}RATE_I")
        found.append(i / p if p is not None and i is not None and p > 0.0 and i >= 0.0 else otherwise)
    return found[0], found[1], found[2]


def identify(
    data: FlightData,
    integral_1_s: tuple[float, float, float],
    *,
    curved: bool,
    progress: Callable[[str], None] = lambda what: None,
) -> Identified:
    """Fits everything.

    Args:
        data: of the flight.
        integral_1_s: `rate_integrals`.
        curved: whether the thrust may have a curve; not where the autopilot undoes it.
        progress: gets what is being fitted.

    Raises:
        RefusedError: nothing can be told from this flight.
    """
    if not data.windows:
        raise RefusedError("the flight has no two seconds without a gap in its states")
    motion = Motion(data)
    progress("thrust and drag")
    motion_own = motion.fit(curve=None if curved else 0.0)
    curve = motion_own.curve_factor if curved and motion_own.curve_factor > max(CURVE_MIN, motion_own.curve_sd) else 0.0
    if curved and curve == 0.0:
        motion_own = motion.fit(curve=0.0)
    axes: list[RateAxis | None] = []
    own: list[RateFit | None] = []
    for index, name in enumerate(AXES):
        axis = RateAxis(data, index, integral_1_s[index]) if np.isfinite(data.rates[:, index]).all() else None
        if axis is not None and axis.excitation < EXCITED_RAD_S:
            axis = None
        progress(f"{name} rate")
        axes.append(axis)
        own.append(None if axis is None else axis.fit())
    progress("the delay that they share")
    delay_s = motion_own.delay_s
    if motion_own.delay_sd_s > DELAY_SD_MAX_S:
        delay_s = _common_delay(axes[:2], own[:2], motion, motion_own, curve)
    delay_s = max(delay_s, 0.0)
    together = [None if axis is None else axis.fit(delay_s) for axis in axes]
    return Identified(
        (own[0], own[1], own[2]),
        (together[0], together[1], together[2]),
        integral_1_s,
        motion_own,
        motion.fit(delay_s, curve),
        delay_s,
        data.age_s,
        data.duration_s,
        data.interval_s,
    )


def _common_delay(
    axes: list[RateAxis | None], own: list[RateFit | None], motion: Motion, motion_own: MotionFit, curve: float
) -> float:
    """Where the misfits are smallest, each against its own best."""
    known = [(axis, fit) for axis, fit in zip(axes, own, strict=True) if axis is not None and fit is not None]
    delays = [fit.delay_s for _, fit in known] + [motion_own.delay_s]
    low, high = min(delays), max(delays)
    if high - low < DELAY_TOLERANCE_S:
        return 0.5 * (low + high)

    def misfit(delay_s: float) -> float:
        total = 2.0 * math.log(motion.fit(delay_s, curve, motion_own.lag_s).residual_m_s / motion_own.residual_m_s)
        for axis, fit in known:
            total += 2.0 * math.log(axis.fit(delay_s, fit.lag_s).residual_rad_s / fit.residual_rad_s)
        return total

    found = minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"xatol": DELAY_TOLERANCE_S})
    return float(found.x)
