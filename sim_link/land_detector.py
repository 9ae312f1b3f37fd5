"""Tells whether the vehicle stands on the ground, from what it knows itself: thrust, motion and intent, as PX4 does it.

Three stages, each of which must hold for a third of a second: ground contact, maybe landed, landed
(MulticopterLandDetector.cpp). Leaving a stage is immediate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .parameters import Parameters
from .rotation import Vec3

_STAGE_US = 333_000
_VERTICAL_MAX_M_S = 0.25
_HORIZONTAL_MAX_M_S = 1.5
_ROTATION_MAX_RAD_S = math.radians(20.0)
_LOW_THRUST, _LOW_THRUST_ESTIMATED = 0.3, 0.6
"""Share of (hover - minimum thrust) under which the throttle is low: by MPC_THR_HOVER, and by a valid estimate."""
_IDLE_THRUST = 0.1
"""Share of the same under which a climb-rate controller has given up."""
_FREE_FALL_M_S2 = 2.0


class Motion(NamedTuple):
    """What the detector looks at."""

    v: Vec3
    """Velocity, NED [m/s]."""
    w: Vec3
    """Body rates [rad/s]."""
    thrust: float
    """Collective thrust commanded, 0..1."""
    climb_controlled: bool
    """Whether the autopilot controls the climb rate itself (not so in offboard attitude and rates)."""
    descending: bool
    """Whether a climb-rate controller is told to go down."""
    armed: bool
    hover: float | None = None
    """Hover thrust as it is estimated; None: no estimate is valid."""


class LandDetector:
    """The three stages with their hysteresis."""

    def __init__(self, parameters: Parameters, landed: bool) -> None:
        self._parameters = parameters
        self.ground_contact = landed
        self.maybe_landed = landed
        self.landed = landed
        self._since_us: list[int | None] = [None, None, None]
        self._hover: float | None = None
        """The last valid estimate of the hover thrust."""
        self._estimated = False
        """Whether it counts as one: what ends during a descent goes on to."""
        self._vertical_m_s = 0.0
        self._at_us: int | None = None

    def update(self, motion: Motion, now_us: int) -> None:
        """Advance the stages to `now_us`."""
        if not motion.armed:
            self.ground_contact = self.maybe_landed = self.landed = True
            self._since_us = [None, None, None]
            return
        falling = self._falls(motion, now_us)
        if not self._touches(motion):
            self.lift()
            return
        self.ground_contact = self._hold(0, True, self.ground_contact, now_us)
        maybe = (
            self.ground_contact and self._idles(motion) and math.hypot(*motion.w) < _ROTATION_MAX_RAD_S and not falling
        )
        self.maybe_landed = self._hold(1, maybe, self.maybe_landed, now_us)
        self.landed = self._hold(2, self.maybe_landed, self.landed, now_us)

    def lift(self) -> None:
        """Be in the air: what counted towards standing on the ground counts no more."""
        self.ground_contact = self.maybe_landed = self.landed = False
        self._since_us = [None, None, None]

    def _touches(self, motion: Motion) -> bool:
        """Tell whether the vehicle neither moves nor holds itself up."""
        v_n, v_e, v_d = motion.v
        moving = abs(v_d) > _VERTICAL_MAX_M_S or math.hypot(v_n, v_e) > _HORIZONTAL_MAX_M_S
        if motion.hover is not None:
            self._hover = motion.hover
        if motion.hover is not None or not motion.descending:
            self._estimated = motion.hover is not None
        if moving:
            return False
        low = motion.thrust <= self._above_minimum(_LOW_THRUST_ESTIMATED if self._estimated else _LOW_THRUST)
        # Who controls the climb rate may hover with any thrust: only going down can end on the ground.
        arrives = not motion.climb_controlled or motion.descending or self.maybe_landed or self.landed
        return low and arrives

    def _above_minimum(self, share: float) -> float:
        """Give the thrust this share of the way from the least to the one that hovers."""
        minimum = self._parameters.number("MPC_THR_MIN")
        hover = self._parameters.number("MPC_THR_HOVER") if self._hover is None else self._hover
        return minimum + share * (hover - minimum)

    def _idles(self, motion: Motion) -> bool:
        """Tell whether the thrust is at its minimum."""
        if motion.climb_controlled:
            return motion.thrust <= self._above_minimum(_IDLE_THRUST)
        return motion.thrust <= self._parameters.number("MPC_MANTHR_MIN") + 0.01

    def _falls(self, motion: Motion, now_us: int) -> bool:
        """Tell whether the vehicle is in free fall, judged by its vertical acceleration."""
        before_us, before_m_s = self._at_us, self._vertical_m_s
        self._at_us, self._vertical_m_s = now_us, motion.v[2]
        if before_us is None or now_us <= before_us:
            return False
        return (motion.v[2] - before_m_s) / ((now_us - before_us) * 1e-6) > 9.81 - _FREE_FALL_M_S2

    def _hold(self, stage: int, condition: bool, state: bool, now_us: int) -> bool:
        """Let a condition become true only after it has held for a stage's time."""
        if not condition:
            self._since_us[stage] = None
            return False
        since = self._since_us[stage]
        if since is None:
            since = self._since_us[stage] = now_us
        return state or now_us - since >= _STAGE_US
