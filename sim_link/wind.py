"""The world around the vehicle: force, gravity, steady wind and Dryden turbulence.

The turbulence has the Dryden spectra in the form of MIL-F-8785C, for a vehicle that stands in moving air: the frozen
field passes it with the mean wind, u along it, v to its right, w downwards. The length scales, and the share of the
vertical intensity, are the low-altitude ones. The forming filters are discretised exactly, so that variance and
spectrum do not depend on the step.
"""

from __future__ import annotations

import math
import random
from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

from .rotation import Vec3

_FOOT_M = 0.3048
_ALTITUDE_MIN_M, _ALTITUDE_MAX_M = 3.0, 304.8
"""Where the low-altitude formulas hold (10 to 1000 ft)."""
DRAWS_PER_PERIOD = 5
"""Random numbers that the gusts of one period take."""
_STILL_M_S = 1.0e-6
"""Mean wind below which there is no direction and, the intensity being a share of it, no turbulence."""


@dataclass(frozen=True)
class World:
    """What acts on the vehicle from outside ([world] of a flight file)."""

    force_n: Vec3 = (0.0, 0.0, 0.0)
    """Constant force on the centre of mass, NED [N]."""
    gravity_factor: float = 1.0
    """Gravity over 9.81 m/s^2."""
    wind_m_s: Vec3 = (0.0, 0.0, 0.0)
    """Mean velocity of the air, NED (where it blows to); acts through the drag."""
    turbulence: float = 0.0
    """Standard deviation of the horizontal gusts as a share of the mean wind speed."""
    ground_d_m: float = 0.0
    """Down coordinate of the ground [m]."""
    seed: int = 1
    """Of the gusts."""


def dryden_scales(altitude_m: float) -> tuple[float, float, float]:
    """Return the low-altitude horizontal and vertical length scales [m], and vertical over horizontal intensity."""
    feet = min(max(altitude_m, _ALTITUDE_MIN_M), _ALTITUDE_MAX_M) / _FOOT_M
    factor = 0.177 + 0.000823 * feet
    return feet / factor**1.2 * _FOOT_M, feet * _FOOT_M, factor**0.4


class _LongGust:
    """First-order Dryden filter: spectrum of the gusts along the mean wind."""

    def __init__(self, sigma_m_s: float, corner_rad_s: float, dt_s: float, draw: random.Random) -> None:
        self._kept = math.exp(-corner_rad_s * dt_s)
        self._added = sigma_m_s * math.sqrt(-math.expm1(-2.0 * corner_rad_s * dt_s))
        self._draw = draw
        self.value_m_s = sigma_m_s * draw.gauss(0.0, 1.0)

    def advance(self) -> None:
        """Go one period on."""
        self.value_m_s = self._kept * self.value_m_s + self._added * self._draw.gauss(0.0, 1.0)

    def numbers(self) -> tuple[float, ...]:
        """Return factors and value."""
        return (self._kept, self._added, self.value_m_s)


class _CrossGust:
    """Second-order Dryden filter K (1 + sqrt(3) s/a) / (1 + s/a)^2: the gusts across the mean wind, a = V/L.

    State x1' = x2, x2' = -a^2 x1 - 2 a x2 + white noise: stationary variances 1/(4 a^3) and 1/(4 a), uncorrelated. With
    K = sigma/sqrt(a) the output K a^2 (x1 + sqrt(3)/a x2) has the variance sigma^2.
    """

    def __init__(self, sigma_m_s: float, corner_rad_s: float, dt_s: float, draw: random.Random) -> None:
        a, h = corner_rad_s, corner_rad_s * dt_s
        fade = math.exp(-h)
        self._phi = (fade * (1.0 + h), fade * dt_s, -fade * a * h, fade * (1.0 - h))
        p1, p2 = 0.25 / a**3, 0.25 / a
        f11, f12, f21, f22 = self._phi
        # What a period adds is the stationary covariance less what is left of it.
        q11 = max(0.0, p1 - (f11 * f11 * p1 + f12 * f12 * p2))
        q12 = -(f11 * f21 * p1 + f12 * f22 * p2)
        q22 = max(0.0, p2 - (f21 * f21 * p1 + f22 * f22 * p2))
        l22 = math.sqrt(q22)
        l12 = q12 / l22 if l22 > 0.0 else 0.0
        self._noise = (math.sqrt(max(0.0, q11 - l12 * l12)), l12, l22)
        self._out = (sigma_m_s * a**1.5, sigma_m_s * math.sqrt(3.0 * a))
        self._draw = draw
        self._x1 = math.sqrt(p1) * draw.gauss(0.0, 1.0)
        self._x2 = math.sqrt(p2) * draw.gauss(0.0, 1.0)
        self.value_m_s = self._out[0] * self._x1 + self._out[1] * self._x2

    def advance(self) -> None:
        """Go one period on."""
        f11, f12, f21, f22 = self._phi
        n11, n12, n22 = self._noise
        g1, g2 = self._draw.gauss(0.0, 1.0), self._draw.gauss(0.0, 1.0)
        x1, x2 = self._x1, self._x2
        self._x1 = f11 * x1 + f12 * x2 + n11 * g1 + n12 * g2
        self._x2 = f21 * x1 + f22 * x2 + n22 * g2
        self.value_m_s = self._out[0] * self._x1 + self._out[1] * self._x2

    def numbers(self) -> tuple[float, ...]:
        """Return transition, noise, output and state."""
        return (*self._phi, *self._noise, *self._out, self._x1, self._x2)


def series(f: Sequence[float], draws: Sequence[float], air: MutableSequence[float]) -> None:
    """Write the velocity of the air of as many periods as `air` holds: what `Wind.advance` gives, to the bit.

    Scalar code on flat arrays, as the other kernels: campaigns have millions of periods.

    Args:
        f: `Wind.filters`.
        draws: `Wind.draws`, for all periods but the first.
        air: gets north, east, down of every period, the present one first.
    """
    u = f[7]
    v1, v2, w1, w2 = f[17], f[18], f[28], f[29]
    v = f[15] * v1 + f[16] * v2
    w = f[26] * w1 + f[27] * w2
    for i in range(len(air) // 3):
        if i > 0:
            d = DRAWS_PER_PERIOD * (i - 1)
            u = f[5] * u + f[6] * draws[d]
            g1, g2 = draws[d + 1], draws[d + 2]
            v1, v2 = f[8] * v1 + f[9] * v2 + f[12] * g1 + f[13] * g2, f[10] * v1 + f[11] * v2 + f[14] * g2
            v = f[15] * v1 + f[16] * v2
            g1, g2 = draws[d + 3], draws[d + 4]
            w1, w2 = f[19] * w1 + f[20] * w2 + f[23] * g1 + f[24] * g2, f[21] * w1 + f[22] * w2 + f[25] * g2
            w = f[26] * w1 + f[27] * w2
        air[3 * i] = f[0] + f[3] * u - f[4] * v
        air[3 * i + 1] = f[1] + f[4] * u + f[3] * v
        air[3 * i + 2] = f[2] + w


class Wind:
    """The velocity of the air at the vehicle: a mean that can be stepped, and gusts about it, one value per period."""

    def __init__(
        self, wind_m_s: Vec3, turbulence: float, *, seed: int, period_s: float, altitude_m: float = 10.0
    ) -> None:
        """Start in stationary turbulence.

        Args:
            wind_m_s: mean velocity of the air, NED.
            turbulence: standard deviation of the horizontal gusts over the mean wind speed.
            seed: of this wind's own generator.
            period_s: time between two values.
            altitude_m: above ground, for the length scales.
        """
        self._draw = random.Random(f"wind {seed}")
        self._period_s = period_s
        self._scales = dryden_scales(altitude_m)
        self.set_wind(wind_m_s, turbulence)

    def set_wind(self, wind_m_s: Vec3, turbulence: float) -> None:
        """Change mean and turbulence in a step from now on; the gusts start anew."""
        self._mean = wind_m_s
        self._gusts: tuple[_LongGust, _CrossGust, _CrossGust] | None = None
        speed = math.sqrt(sum(c * c for c in wind_m_s))
        if turbulence > 0.0 and speed > _STILL_M_S:
            self._gusts = self._new_gusts(speed, turbulence)
        self.gusty = self._gusts is not None
        """Whether the air changes from one period to the next."""
        self.air_m_s = self._sum()

    def advance(self) -> None:
        """Go one period on."""
        if self._gusts is None:
            return
        for gust in self._gusts:
            gust.advance()
        self.air_m_s = self._sum()

    def filters(self) -> tuple[float, ...]:
        """Return what `series` goes on from: 30 numbers, after which this wind must not be advanced.

        Mean velocity and direction of the mean, then the long gust's factors and value, then of both cross gusts
        transition, noise, output and state.
        """
        assert self._gusts is not None
        u, v, w = self._gusts
        return (*self._mean, *self._along, *u.numbers(), *v.numbers(), *w.numbers())

    def draws(self, count: int) -> list[float]:
        """Return the next `count` standard normal numbers of the gusts, DRAWS_PER_PERIOD for every period."""
        gauss = self._draw.gauss
        return [gauss(0.0, 1.0) for _ in range(count)]

    def _new_gusts(self, speed: float, turbulence: float) -> tuple[_LongGust, _CrossGust, _CrossGust]:
        north, east, _ = self._mean
        level = math.hypot(north, east)
        self._along = (north / level, east / level) if level > _STILL_M_S else (1.0, 0.0)
        horizontal_m, vertical_m, share = self._scales
        sigma = turbulence * speed
        return (
            _LongGust(sigma, speed / horizontal_m, self._period_s, self._draw),
            _CrossGust(sigma, speed / horizontal_m, self._period_s, self._draw),
            _CrossGust(sigma * share, speed / vertical_m, self._period_s, self._draw),
        )

    def _sum(self) -> Vec3:
        if self._gusts is None:
            return self._mean
        u, v, w = (g.value_m_s for g in self._gusts)
        cos, sin = self._along
        north, east, down = self._mean
        return (north + cos * u - sin * v, east + sin * u + cos * v, down + w)
