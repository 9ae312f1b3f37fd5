"""What the sensors measure besides the estimator: specific force, magnetic field, air pressure.

The noise of a sample depends on the seed and the time alone, as the estimator's does.
"""

from __future__ import annotations

import hashlib
import math
import struct
from typing import NamedTuple

from .geodesy import HOME_ALTITUDE_M
from .physics import RigidState
from .rotation import Vec3, rotate_back

_GRAVITY_M_S2 = 9.80665
FIELD_G: Vec3 = (0.2175, 0.0129, 0.4304)
"""Magnetic field of the Earth at home, NED [gauss]: declination 3.4 degrees, as PX4's world magnetic model has it."""
_NOISE_M_S2, _NOISE_RAD_S, _NOISE_G, _NOISE_HPA = 0.05, 0.002, 0.002, 0.02
_KEY = struct.Struct("<qq")
_NUMBERS = 10
_BYTES_MEAN, _BYTES_SIGMA = 510.0, math.sqrt(4.0 * (256.0**2 - 1.0) / 12.0)
"""Of the sum of four random bytes, which is normal enough for a sensor."""
_NORMAL = [(total - _BYTES_MEAN) / _BYTES_SIGMA for total in range(4 * 255 + 1)]
"""The standard normal number of each sum."""
_TEMPERATURE_C = 25.0
"""Of the board."""


class Sample(NamedTuple):
    """One sample of everything."""

    acceleration: Vec3
    """Specific force, FRD [m/s^2]: (0, 0, -9.8) at rest."""
    rates: Vec3
    """FRD [rad/s]."""
    field: Vec3
    """FRD [gauss]."""
    pressure_hpa: float
    pressure_altitude_m: float
    temperature_c: float


def sample(seed: int, t_us: int, rigid: RigidState, acceleration: Vec3) -> Sample:
    """Measure a true state that accelerates with `acceleration` NED [m/s^2]."""
    noise = _normal_numbers(seed, t_us)
    a = acceleration
    force = rotate_back(rigid.q, (a[0], a[1], a[2] - _GRAVITY_M_S2))
    field = rotate_back(rigid.q, FIELD_G)
    pressure = pressure_hpa(HOME_ALTITUDE_M - rigid.p[2]) + _NOISE_HPA * noise[9]
    return Sample(
        _noisy(force, _NOISE_M_S2, noise, 0),
        _noisy(rigid.w, _NOISE_RAD_S, noise, 3),
        _noisy(field, _NOISE_G, noise, 6),
        pressure,
        altitude_at_m(pressure),
        _TEMPERATURE_C,
    )


def _normal_numbers(seed: int, index: int) -> list[float]:
    """Give ten standard normal numbers that depend on seed and index alone."""
    raw = hashlib.blake2b(_KEY.pack(seed, index), digest_size=4 * _NUMBERS, person=b"sensors").digest()
    return [_NORMAL[a + b + c + d] for a, b, c, d in zip(raw[0::4], raw[1::4], raw[2::4], raw[3::4], strict=True)]


def _noisy(value: Vec3, sigma: float, noise: list[float], at: int) -> Vec3:
    x, y, z = value
    return (x + sigma * noise[at], y + sigma * noise[at + 1], z + sigma * noise[at + 2])


def pressure_hpa(altitude_m: float) -> float:
    """Give the air pressure of the standard atmosphere (below 11 km)."""
    if math.isnan(altitude_m):
        return 1013.25
    return float(1013.25 * (1.0 - min(max(altitude_m, -1000.0), 11000.0) / 44330.77) ** 5.255876)


def altitude_at_m(pressure: float) -> float:
    """Give the altitude of a pressure [hPa] in the standard atmosphere."""
    return float(44330.77 * (1.0 - (max(pressure, 1.0) / 1013.25) ** (1.0 / 5.255876)))
