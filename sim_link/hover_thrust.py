"""The hover thrust as the autopilot estimates it in flight (PX4: mc_hover_thrust_estimator).

A Kalman filter with one state, the thrust that carries the vehicle: thrust over hover thrust, less one, is the upward
acceleration in g. It learns its measurement noise from what is left, leaves out what does not fit, and opens again when
nothing fits any more. The position controller and the land detector use it while it is valid; the thrust of offboard
attitudes and rates stays as it came.
"""

from __future__ import annotations

import math

from .parameters import Parameters
from .rotation import Vec3, clip

_GRAVITY_M_S2 = 9.80665
_VARIANCE_FIRST = 0.1**2
"""HTE_HT_ERR_INIT"""
_PROCESS_VARIANCE_1_S2 = 0.0036**2
"""HTE_HT_NOISE"""
_GATE = 3.0
"""HTE_ACC_GATE: standard deviations."""
_VERTICAL_M_S, _HORIZONTAL_M_S = 2.0, 10.0
"""HTE_VZ_THR and HTE_VXY_THR: beyond these speeds drag and propeller wash count, and the acceleration less."""
_NOISE_FIRST, _NOISE_MIN, _NOISE_MAX = 5.0, 1.0, 400.0
"""Variance of the acceleration [m^2/s^4]."""
_LEARNING_S, _BIAS_S = 2.0, 1.0
_OFFSET_RATIO = 0.2
"""Mean test ratio beyond which the hover thrust has changed and the filter opens."""
_VALID_VARIANCE = 0.001
_VALID_AFTER_US = 2_000_000
_IN_AIR_M = 1.0
_DT_MIN_S, _DT_MAX_S = 0.001, 1.0


class HoverThrust:
    """The filter, and whether what it says is valid."""

    def __init__(self, parameters: Parameters, ground_d_m: float) -> None:
        """Begin on, or above, the ground at ground_d_m (down)."""
        self._parameters = parameters
        self._ground_d_m = ground_d_m
        self._in_air = False
        self._good_us: int | None = None
        """Since when the estimate is good."""
        self._valid = False
        self._before: tuple[int, float] | None = None
        """Time [us] and vertical speed of the last call."""
        self._limits = 0.1, 0.9
        self._limits_version = -1
        self._reset()

    def _reset(self) -> None:
        self._share = self._parameters.within("MPC_THR_HOVER", 0.1, 0.8)
        self._variance, self._noise = _VARIANCE_FIRST, _NOISE_FIRST
        self._bias = self._mean_ratio = self._ratio = 0.0

    @property
    def value(self) -> float | None:
        """The estimate, as a share of the collective thrust; None: none is valid, or it is not to be used."""
        if not self._valid:
            return None
        unused = "MPC_USE_HTE" in self._parameters and self._parameters.integer("MPC_USE_HTE") == 0
        return None if unused else self._share

    def shift(self, dp_m: Vec3, dv_m_s: Vec3) -> None:
        """Take note that the estimate of position and velocity has jumped: that is no acceleration."""
        self._ground_d_m += dp_m[2]
        if self._before is not None:
            self._before = self._before[0], self._before[1] + dv_m_s[2]

    def update(self, now_us: int, p: Vec3, v: Vec3, thrust_up: float, *, armed: bool, landed: bool) -> None:
        """Go on to now_us; thrust_up: the upward part of the collective thrust that is commanded."""
        before, self._before = self._before, (now_us, v[2])
        if landed:
            self._in_air, self._ground_d_m = False, p[2]
        elif self._ground_d_m - p[2] > _IN_AIR_M:
            self._in_air = True
        dt_s = 0.0 if before is None else (now_us - before[0]) * 1e-6
        if not (armed and self._in_air):
            self._good_us, self._valid = None, False
            if not armed:
                self._reset()
        elif before is not None and _DT_MIN_S < dt_s < _DT_MAX_S and math.isfinite(thrust_up):
            horizontal = math.hypot(v[0], v[1]) - _HORIZONTAL_M_S + 1.0
            scale = max(1.0, abs(v[2]) - _VERTICAL_M_S + 1.0, horizontal)
            self._fuse((before[1] - v[2]) / dt_s, thrust_up, scale * scale, dt_s)
            self._judge(now_us)

    def _judge(self, now_us: int) -> None:
        """Tell whether the estimate is valid: it has to be good for a while first."""
        good = self._variance < _VALID_VARIANCE and (self._valid or self._ratio < 1.0)
        self._good_us = (now_us if self._good_us is None else self._good_us) if good else None
        self._valid = self._good_us is not None and (self._valid or now_us - self._good_us >= _VALID_AFTER_US)

    def _fuse(self, up_m_s2: float, thrust: float, scale: float, dt_s: float) -> None:
        """Take in an upward acceleration; `scale` multiplies its variance."""
        share, noise = self._share, self._noise
        variance = self._variance + _PROCESS_VARIANCE_1_S2 * dt_s * dt_s
        slope = -_GRAVITY_M_S2 * thrust / (share * share)
        error = up_m_s2 - _GRAVITY_M_S2 * (thrust / share - 1.0)
        expected = slope * slope * variance + noise * scale
        ratio = self._ratio = error * error / (_GATE * _GATE * expected)
        left = error
        if ratio < 1.0:
            gain = variance * slope / expected
            share = self._share = clip(share + gain * error, *self._share_range())
            variance = clip((1.0 - gain * slope) * variance, 1e-10, 1.0)
            left = up_m_s2 - _GRAVITY_M_S2 * (thrust / share - 1.0)
        elif abs(self._mean_ratio) > _OFFSET_RATIO:
            variance = min(variance + 1e3 * _PROCESS_VARIANCE_1_S2 * dt_s, 1.0)
        self._variance = variance
        taken = dt_s / (_BIAS_S + dt_s)
        self._bias += taken * (left - self._bias)
        self._mean_ratio += taken * (math.copysign(min(ratio, 1.0), error) - self._mean_ratio)
        learned = (left - self._bias) ** 2 + slope * slope * variance
        noise += dt_s / (_LEARNING_S + dt_s) * (min(learned, _NOISE_MAX) - noise)
        self._noise = max(noise, _NOISE_MIN)

    def _share_range(self) -> tuple[float, float]:
        """Give the limits of the estimate."""
        if self._limits_version != self._parameters.version:
            self._limits_version = self._parameters.version
            middle = self._parameters.within("MPC_THR_HOVER", 0.1, 0.8)
            reach = self._parameters.within("HTE_THR_RANGE", 0.0, 1.0)
            self._limits = max(middle - reach, 0.1), min(middle + reach, 0.9)
        return self._limits
