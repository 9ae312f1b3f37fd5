"""The slow error of what the vehicle believes: a bias that walks at random, of position, velocity, heading and rate.

The bias is a function of seed and time alone, so that it does not matter who asks for it, how often, or in which order.
It is exact at knots a tenth of a second apart and linear between them; it begins at zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .rotation import Vec3
from .vehicle_file import VehicleFile

KNOT_US = 100_000
"""Time between two knots."""
BLOCK_KNOTS = 256
"""Knots whose random numbers are drawn at once."""
_NUMBERS = 10
_SEED_MASK = (1 << 64) - 1
_STREAM = 0x57414C4B
"""Keeps these numbers apart from the white noise of the same seed."""
_BLOCKS_KEPT = 4

Ten = tuple[float, float, float, float, float, float, float, float, float, float]
_ZERO: Ten = (0.0,) * 10


class WalkSigmas(NamedTuple):
    """Intensity of the walks per axis: the sigma of what a second adds. The heading's is that of the attitude."""

    position_m: float
    velocity_m_s: float
    yaw_rad: float
    rate_rad_s: float
    time_constant_s: float
    """With which a bias is drawn back to zero: it stays within sigma sqrt(time_constant_s / 2); 0: never drawn back."""

    @property
    def any(self) -> bool:
        """Whether anything walks."""
        return max(self[:4]) > 0.0


class Bias(NamedTuple):
    """An error of the state, to be added to it."""

    p: Vec3
    """Position NED [m]."""
    v: Vec3
    """Velocity NED [m/s]."""
    yaw: float
    """Turns the attitude about the inertial down axis [rad]."""
    w: Vec3
    """Body rates FRD [rad/s]."""


def sigmas_of(vehicle: VehicleFile) -> WalkSigmas:
    """Return the walks of a vehicle file."""
    return WalkSigmas(
        vehicle.walk_position_m,
        vehicle.walk_velocity_m_s,
        vehicle.walk_yaw_rad,
        vehicle.walk_rate_rad_s,
        vehicle.walk_time_constant_s,
    )


class BiasWalk:
    """The walk from a time on; before it there is no bias."""

    def __init__(self, sigmas: WalkSigmas, *, seed: int, start_us: int) -> None:
        self._seed = seed & _SEED_MASK
        self._start_us = start_us
        step_s, constant_s = KNOT_US * 1.0e-6, sigmas.time_constant_s
        self._left = math.exp(-step_s / constant_s) if constant_s > 0.0 else 1.0
        """What a knot's bias leaves of itself at the next."""
        added_s = 0.5 * constant_s * (1.0 - self._left * self._left) if constant_s > 0.0 else step_s
        spread = math.sqrt(added_s)
        p, v, yaw, w = (spread * sigma for sigma in sigmas[:4])
        self._scale: Ten = (p, p, p, v, v, v, yaw, w, w, w)
        self._starts: list[Ten] = [_ZERO]
        """First knot of each block so far."""
        self._blocks: dict[int, list[Ten]] = {}

    def at(self, t_us: int) -> Bias:
        """Return the bias of a time."""
        knot, rest_us = divmod(max(0, t_us - self._start_us), KNOT_US)
        share = rest_us / KNOT_US
        b = [low + share * (high - low) for low, high in zip(self._knot(knot), self._knot(knot + 1), strict=True)]
        return Bias((b[0], b[1], b[2]), (b[3], b[4], b[5]), b[6], (b[7], b[8], b[9]))

    def _knot(self, number: int) -> Ten:
        block, row = divmod(number, BLOCK_KNOTS)
        return self._block(block)[row]

    def _block(self, block: int) -> list[Ten]:
        """Return a block's knots; the last few that were asked for are kept."""
        knots = self._blocks.get(block)
        if knots is not None:
            return knots
        while len(self._starts) <= block:
            self._starts.append(self._walk(len(self._starts) - 1)[-1])
        if len(self._blocks) >= _BLOCKS_KEPT:
            self._blocks.pop(next(iter(self._blocks)))
        knots = self._blocks[block] = self._walk(block)[:-1]
        return knots

    def _walk(self, block: int) -> list[Ten]:
        """Walk through a block from its first knot; the last of what is returned is the next block's first."""
        words = np.random.SeedSequence((self._seed, block, _STREAM))
        numbers = np.random.Generator(np.random.PCG64(words)).standard_normal((BLOCK_KNOTS, _NUMBERS))
        knots = [self._starts[block]]
        for row in numbers.tolist():
            a, b, c, d, e, f, g, h, i, j = (
                self._left * old + scale * n for old, scale, n in zip(knots[-1], self._scale, row, strict=True)
            )
            knots.append((a, b, c, d, e, f, g, h, i, j))
        return knots
