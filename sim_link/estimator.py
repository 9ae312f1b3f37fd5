"""What the vehicle believes: the truth, some time ago, with noise. What goes wrong with it is in `beliefs`.

Two stages, each of which can be given more to do: which true sample the estimator is at (`Estimator._sample`: a fixed
delay), and what it makes of it (`with_noise`: white noise). The noise of a sample is a function of seed and sample
number alone (its time over the step), so that it does not matter who asks for estimates, how often, or in which order.
It is drawn in blocks ahead.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from .physics import RigidState
from .rotation import Quat, Vec3, exponential, multiply, normalised
from .vehicle_file import VehicleFile

NOISE_ROWS = 256
"""Samples whose noise is drawn at once."""
_SEED_MASK = (1 << 64) - 1

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


def noise_block(seed: int, block: int) -> np.ndarray:
    """Return the standard normal numbers of the samples NOISE_ROWS block to NOISE_ROWS (block + 1) - 1.

    They depend on seed and block alone. One row per sample: position, velocity, attitude and rate, three numbers each.
    """
    words = np.random.SeedSequence((seed & _SEED_MASK, block))
    return np.random.Generator(np.random.PCG64(words)).standard_normal((NOISE_ROWS, 12))


def with_noise(p: Vec3, v: Vec3, q: Quat, w: Vec3, noise: Noise, numbers: Twelve) -> tuple[Vec3, Vec3, Quat, Vec3]:
    """Return a true state with noise: added to p, v and w, and as a small rotation in the body frame on q."""
    n = numbers
    a, b, c, d = noise
    return (
        (p[0] + a * n[0], p[1] + a * n[1], p[2] + a * n[2]),
        (v[0] + b * n[3], v[1] + b * n[4], v[2] + b * n[5]),
        normalised(multiply(q, exponential((c * n[6], c * n[7], c * n[8])))),
        (w[0] + d * n[9], w[1] + d * n[10], w[2] + d * n[11]),
    )


def noise_of(vehicle: VehicleFile, factor: float = 1.0) -> Noise:
    """Return the sigmas of a vehicle file, scaled by a factor."""
    return Noise(
        factor * vehicle.noise_position_m,
        factor * vehicle.noise_velocity_m_s,
        factor * vehicle.noise_attitude_rad,
        factor * vehicle.noise_rate_rad_s,
    )


def age_steps(vehicle: VehicleFile, dt_us: int) -> int:
    """Return the state's age in whole steps."""
    return round(vehicle.state_age_s * 1.0e6 / dt_us)


class NoiseBlocks:
    """Knows which block of noise is at hand, for samples that come in any order."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._block = -1
        self.first = 0
        """Number of the first sample of the block."""
        self.count = 0
        """How many samples it holds."""
        self.rows: np.ndarray = np.zeros((0, 12))

    def move_to(self, sample: int) -> bool:
        """Draw the block that holds a sample, not below 0; False: it was at hand."""
        block = sample // NOISE_ROWS
        if block == self._block:
            return False
        self._block = block
        self.first = NOISE_ROWS * block
        self.rows = noise_block(self._seed, block)
        self.count = NOISE_ROWS
        return True


class Estimator:
    """The last true states at step resolution; the one `state_age_s` ago, with noise, is what the vehicle believes."""

    def __init__(self, vehicle: VehicleFile, *, seed: int, t_us: int, rigid: RigidState, dt_us: int) -> None:
        """Start with a vehicle that has been in this state for as long as the estimator is late.

        Args:
            vehicle: gives state age (rounded to whole steps) and noise.
            seed: of the noise.
            t_us: vehicle time of `rigid`.
            rigid: true state now.
            dt_us: time between two `push` calls.
        """
        steps = age_steps(vehicle, dt_us)
        self.age_us = steps * dt_us
        """How old an estimate is when it is published."""
        self._noise = noise_of(vehicle)
        self._dt_us = dt_us
        self._blocks = NoiseBlocks(seed)
        self._samples = deque([(t_us - i * dt_us, rigid) for i in range(steps, -1, -1)], maxlen=steps + 1)
        self._last: Estimate | None = None

    def push(self, t_us: int, rigid: RigidState) -> None:
        """Take the true state at the end of one physics step."""
        self._samples.append((t_us, rigid))

    def set_noise(self, noise: Noise) -> None:
        """Change the noise of the estimates that are asked for from now on."""
        self._noise = noise
        self._last = None

    def believed(self, steps_ahead: int = 0) -> Estimate:
        """Return the newest estimate, or the one so many steps from now, at most its age; asking twice is free."""
        t_us, rigid = self._sample(steps_ahead)
        if self._last is None or self._last.t_us != t_us:
            number = t_us // self._dt_us
            blocks = self._blocks
            blocks.move_to(number)
            numbers: Twelve = tuple(blocks.rows[number - blocks.first].tolist())
            p, v, q, w, _ = rigid
            self._last = Estimate(t_us, *with_noise(p, v, q, w, self._noise, numbers))
        return self._last

    def _sample(self, steps_ahead: int) -> tuple[int, RigidState]:
        return self._samples[steps_ahead]
