"""The pilot's sticks: MANUAL_CONTROL from a joystick, RC_CHANNELS_OVERRIDE as a radio; which count, how fast they go.

Follows PX4's manual_control: COM_RC_IN_MODE says which sources count, COM_RC_LOSS_T when a source is gone, and a
movement faster than MAN_OVERRIDE_SPD takes over from a mode that steers itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .parameters import Parameters

_RADIO_MODES = frozenset((0, 2, 3, 5, 6, 7, 8))
_JOYSTICK_MODES = frozenset((1, 2, 3, 5, 6, 7, 8))
_JOYSTICK_FIRST_MODES = frozenset((6, 8))
_SPEED_LAG_S = 0.1
"""Of the filter on the sticks' speed."""
_CHANNEL_MIN_US, _CHANNEL_MAX_US = 800, 2200
"""A channel beyond is not given."""


class Sticks(NamedTuple):
    """Where the sticks are, each -1..1."""

    roll: float
    """Positive rolls right."""
    pitch: float
    """Positive pushes the nose down: forward."""
    yaw: float
    """Positive turns right."""
    throttle: float
    """-1 at the bottom, 0 in the middle."""


class _Source:
    """One source of sticks."""

    def __init__(self) -> None:
        self.sticks: Sticks | None = None
        self.seen_us = 0
        self._speeds = [0.0, 0.0, 0.0, 0.0]

    def move(self, sticks: Sticks, now_us: int) -> float:
        """Take a new position; gives the highest filtered speed of a stick [1/s]."""
        before, passed_s = self.sticks, (now_us - self.seen_us) * 1e-6
        self.sticks, self.seen_us = sticks, now_us
        if before is None or passed_s <= 0.0:
            return 0.0
        share = passed_s / (passed_s + _SPEED_LAG_S)
        for k in range(4):
            self._speeds[k] += share * ((sticks[k] - before[k]) / passed_s - self._speeds[k])
        return max(abs(speed) for speed in self._speeds)

    def forget(self) -> None:
        """Start anew: it was gone for a while."""
        self.sticks = None
        self._speeds = [0.0, 0.0, 0.0, 0.0]


class ManualInput:
    """Both sources and which of them is obeyed."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._joystick, self._radio = _Source(), _Source()
        self.channels: tuple[int, ...] | None = None
        """Of the radio [us]: roll, pitch, throttle, yaw and what else it gave; None before any came."""

    def joystick(self, x: int, y: int, z: int, r: int, now_us: int) -> bool:
        """Take a MANUAL_CONTROL: -1000..1000, z 0..1000. Returns whether it takes over from a mode that steers itself.

        A value beyond the range is not given; then PX4 does not use the message.
        """
        if max(abs(x), abs(y), abs(z), abs(r)) > 1000:
            return False
        return self._take(self._joystick, Sticks(y / 1000.0, x / 1000.0, r / 1000.0, z / 500.0 - 1.0), now_us)

    def radio(self, channels: tuple[int, ...], now_us: int) -> bool:
        """Take a RC_CHANNELS_OVERRIDE [us]: roll, pitch, throttle, yaw. Returns as `joystick` does."""
        if len(channels) < 4 or not all(_CHANNEL_MIN_US <= value <= _CHANNEL_MAX_US for value in channels[:4]):
            return False
        self.channels = channels
        roll, pitch, throttle, yaw = (min(1.0, max(-1.0, (value - 1500) / 500.0)) for value in channels[:4])
        return self._take(self._radio, Sticks(roll, -pitch, yaw, throttle), now_us)

    def now(self, now_us: int) -> Sticks | None:
        """Give the sticks that are obeyed; None: there are none, or they are too old."""
        source = self._chosen(now_us)
        return None if source is None else source.sticks

    def _take(self, source: _Source, sticks: Sticks, now_us: int) -> bool:
        if source.sticks is not None and not self._fresh(source, now_us):
            source.forget()
        speed = source.move(sticks, now_us)
        limit = self._parameters.number("MAN_OVERRIDE_SPD") if "MAN_OVERRIDE_SPD" in self._parameters else self._old()
        return source is self._chosen(now_us) and 0.0 <= limit < speed

    def _old(self) -> float:
        """Give the limit of the version before: COM_RC_OVERRIDE's bit 0 for the modes that steer themselves."""
        enabled = self._parameters.integer("COM_RC_OVERRIDE") & 1
        return self._parameters.number("COM_RC_STICK_OV") * 0.01 / _SPEED_LAG_S if enabled else -1.0

    def _fresh(self, source: _Source, now_us: int) -> bool:
        return (now_us - source.seen_us) * 1e-6 <= self._parameters.number("COM_RC_LOSS_T")

    def _chosen(self, now_us: int) -> _Source | None:
        """Give the source that COM_RC_IN_MODE puts first among those that are there."""
        if self._joystick.sticks is None and self._radio.sticks is None:
            return None
        mode = self._parameters.integer("COM_RC_IN_MODE")
        order = [self._joystick, self._radio] if mode in _JOYSTICK_FIRST_MODES else [self._radio, self._joystick]
        for source in order:
            allowed = _JOYSTICK_MODES if source is self._joystick else _RADIO_MODES
            if mode in allowed and source.sticks is not None and self._fresh(source, now_us):
                return source
        return None


def with_deadzone(value: float, zone: float) -> float:
    """Give a stick's value with nothing in the middle, 1 still at its end."""
    zone = min(max(zone, 0.0), 0.9)
    if abs(value) <= zone:
        return 0.0
    return math.copysign((abs(value) - zone) / (1.0 - zone), value)
