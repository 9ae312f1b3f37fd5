"""What the vehicle believes: the truth, some time ago, with noise.

Two stages, each of which can be given more to do: which true sample the estimator is at (`Estimator._sample`: a fixed
delay), and what it makes of it (`measured`: white noise). The noise of a sample is a function of seed and sample time
alone, so that it does not matter who asks for estimates, how often, or in which order.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections import deque
from typing import NamedTuple

from .physics import RigidState
from .rotation import Quat, Vec3, exponential, multiply, normalised
from .vehicle_file import VehicleFile

_TO_UNIT = 2.0**-53
_NUMBERS = struct.Struct("<12Q")
_KEY = struct.Struct("<qq")

Twelve = tuple[float, float, float, float, float, float, float, float, float, float, float, float]


class Estimate(NamedTuple):
    """One state as the vehicle's estimator gives it."""

    t_us: int
    """Vehicle time of the sample, not of its publication."""
    p: Vec3
    """Position NED [m]."""
    v: Vec3
    """Velocity NED [m/s]."""
    q: Quat
    """Attitude, body to inertial."""
    w: Vec3
    """Body rates FRD [rad/s]."""


class Noise(NamedTuple):
    """White noise of one sample, one sigma per axis."""

    position_m: float
    velocity_m_s: float
    attitude_rad: float
    rate_rad_s: float


def normal_numbers(seed: int, index: int) -> Twelve:
    """Return twelve standard normal numbers that depend on seed and index alone (hash, then Box and Muller)."""
    raw = _NUMBERS.unpack(hashlib.shake_128(_KEY.pack(seed, index)).digest(_NUMBERS.size))
    return (
        *_normal_pair(raw[0], raw[1]),
        *_normal_pair(raw[2], raw[3]),
        *_normal_pair(raw[4], raw[5]),
        *_normal_pair(raw[6], raw[7]),
        *_normal_pair(raw[8], raw[9]),
        *_normal_pair(raw[10], raw[11]),
    )


def _normal_pair(a: int, b: int) -> tuple[float, float]:
    # 1 - u is in (0, 1], so that the logarithm exists.
    radius = math.sqrt(-2.0 * math.log(1.0 - (a >> 11) * _TO_UNIT))
    angle = 2.0 * math.pi * ((b >> 11) * _TO_UNIT)
    return radius * math.cos(angle), radius * math.sin(angle)


def measured(t_us: int, rigid: RigidState, noise: Noise, numbers: Twelve) -> Estimate:
    """Return a true state with noise: added to p, v and w, and as a small rotation in the body frame on q."""
    n = numbers
    a, b, c, d = noise
    return Estimate(
        t_us,
        (rigid.p[0] + a * n[0], rigid.p[1] + a * n[1], rigid.p[2] + a * n[2]),
        (rigid.v[0] + b * n[3], rigid.v[1] + b * n[4], rigid.v[2] + b * n[5]),
        normalised(multiply(rigid.q, exponential((c * n[6], c * n[7], c * n[8])))),
        (rigid.w[0] + d * n[9], rigid.w[1] + d * n[10], rigid.w[2] + d * n[11]),
    )


class Estimator:
    """The last true states at step resolution; the one `state_age_s` ago, with noise, is what the vehicle believes."""

    def __init__(self, vehicle: VehicleFile, *, seed: int, t_us: int, rigid: RigidState, dt_us: int) -> None:
        """Start with a vehicle that has been in this state for as long as the estimator is late.

        Args:
            vehicle: gives state age (rounded to whole steps) and noise.
            seed: of the noise, -2^63 to 2^63 - 1.
            t_us: vehicle time of `rigid`.
            rigid: true state now.
            dt_us: time between two `push` calls.
        """
        steps = round(vehicle.state_age_s * 1.0e6 / dt_us)
        self.age_us = steps * dt_us
        """How old an estimate is when it is published."""
        self._noise = Noise(
            vehicle.noise_position_m, vehicle.noise_velocity_m_s, vehicle.noise_attitude_rad, vehicle.noise_rate_rad_s
        )
        self._seed = seed
        self._samples = deque([(t_us - i * dt_us, rigid) for i in range(steps, -1, -1)], maxlen=steps + 1)
        self._last: Estimate | None = None

    def push(self, t_us: int, rigid: RigidState) -> None:
        """Take the true state at the end of one physics step."""
        self._samples.append((t_us, rigid))

    def believed(self) -> Estimate:
        """Return the newest estimate; asking twice gives the same one."""
        t_us, rigid = self._sample()
        if self._last is None or self._last.t_us != t_us:
            self._last = measured(t_us, rigid, self._noise, normal_numbers(self._seed, t_us))
        return self._last

    def _sample(self) -> tuple[int, RigidState]:
        return self._samples[0]
