"""The manoeuvres of a calibration, one after the other, with a hover between: what is added to the hover, and when.

Steps come as four pieces, + - - +: rates turn the vehicle to one side, through level to the other, and back; thrust
lifts it and brings it back. After them attitude and velocity, and nearly the position, are what they were. Runs are
straight lines that begin and end at rest in their middle, with the speed of a sine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

from companion.config import CalibrationFlight
from companion.control.types import Vec3

SETTLE_S = 2.5
"""Of hover after a manoeuvre, before the next one."""
BEGIN_S = 4.0
"""Of hover before the first one."""
PIECES_S = {"rate": (0.25, 0.12, 0.18), "yaw": (0.6, 0.3), "thrust": (0.4, 0.25)}
"""Lengths of a piece: short ones tell the delay, long ones the time constant."""
YAW_SHARE = 0.35
"""Of the rate step: yaw is weaker."""
HALF_THRUST = 0.5
"""Every second thrust step has this share of its size: two sizes tell the curve."""
FADE_SHARE = 0.35
"""Of a run's time in which it begins, and in which it ends: shorter would ask for more speed than its own."""


class Kind(StrEnum):
    """What is added to the hover."""

    RATE = "rate"
    THRUST = "thrust"
    RUN = "run"


class Manoeuvre(NamedTuple):
    """One manoeuvre."""

    kind: Kind
    axis: int
    """Of a rate: 0 to 2, roll, pitch, yaw; of a run: 0 north, 1 east."""
    size: float
    """rad/s, share of the hover thrust, or the largest speed in m/s; its sign is that of the first piece."""
    piece_s: float
    """Length of a piece, or the time in which a run's sine goes through one radian."""
    length_s: float
    """Of the whole."""

    @property
    def told(self) -> str:
        """For people."""
        if self.kind is Kind.RATE:
            return f"{('roll', 'pitch', 'yaw')[self.axis]} rate {self.size:+.2f} rad/s for {self.piece_s:g} s and back"
        if self.kind is Kind.THRUST:
            return f"thrust {self.size:+.0%} for {self.piece_s:g} s and back"
        return f"run to the {('north', 'east')[self.axis]} and back, up to {self.size:.1f} m/s"

    def step(self, t_s: float) -> float:
        """The step's value at a time after its beginning: + - - +."""
        piece = int(t_s / self.piece_s)
        return self.size if piece in {0, 3} else -self.size

    def run(self, t_s: float) -> tuple[Vec3, Vec3, Vec3]:
        """Position from where it began [m], velocity and acceleration of a run at a time after its beginning."""
        rate = 1.0 / self.piece_s
        fade, slope, bend = _faded(t_s, self.length_s)
        wave, swing = math.sin(rate * t_s), math.cos(rate * t_s)
        reach = self.size / rate
        x = reach * fade * wave
        v = reach * (slope * wave + fade * rate * swing)
        a = reach * (bend * wave + 2.0 * slope * rate * swing - fade * rate * rate * wave)
        north = self.axis == 0
        return _along(x, north), _along(v, north), _along(a, north)


class Slot(NamedTuple):
    """A manoeuvre in its place."""

    begin_s: float
    """After the calibration's beginning."""
    manoeuvre: Manoeuvre

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.begin_s + self.manoeuvre.length_s


def plan(settings: CalibrationFlight) -> tuple[Slot, ...]:
    """All manoeuvres of a calibration in their order."""
    found: list[Manoeuvre] = []
    for repeat in range(settings.repeats):
        sign = 1.0 if repeat % 2 == 0 else -1.0
        for axis in range(2):
            found += _steps(Kind.RATE, axis, sign * settings.rate_step_rad_s, PIECES_S["rate"])
        found += _steps(Kind.RATE, 2, sign * YAW_SHARE * settings.rate_step_rad_s, PIECES_S["yaw"])
        for share in (1.0, HALF_THRUST):
            found += _steps(Kind.THRUST, 0, sign * share * settings.thrust_step, PIECES_S["thrust"])
    # a sine of speed v and reach L/2: its radian takes L / (2 v); two whole waves
    radian_s = 0.5 * settings.run_length_m / settings.run_speed_m_s
    found += [Manoeuvre(Kind.RUN, axis, settings.run_speed_m_s, radian_s, 4.0 * math.pi * radian_s) for axis in (0, 1)]
    slots, at_s = [], BEGIN_S
    for manoeuvre in found:
        slots.append(Slot(at_s, manoeuvre))
        at_s = slots[-1].end_s + SETTLE_S
    return tuple(slots)


def length_s(slots: Sequence[Slot]) -> float:
    """Of a calibration, with the hover at its end."""
    return slots[-1].end_s + SETTLE_S


def _steps(kind: Kind, axis: int, size: float, pieces_s: Sequence[float]) -> list[Manoeuvre]:
    return [Manoeuvre(kind, axis, size, piece_s, 4.0 * piece_s) for piece_s in pieces_s]


def _along(value: float, north: bool) -> Vec3:
    return (value, 0.0, 0.0) if north else (0.0, value, 0.0)


def _faded(t_s: float, whole_s: float) -> tuple[float, float, float]:
    """A window that rises smoothly from 0 to 1 and falls back, with its first two derivatives."""
    fade_s = FADE_SHARE * whole_s
    left_s = whole_s - t_s
    if t_s < fade_s:
        u, sign = t_s / fade_s, 1.0
    elif left_s < fade_s:
        u, sign = max(left_s, 0.0) / fade_s, -1.0
    else:
        return 1.0, 0.0, 0.0
    value = u * u * u * (10.0 + u * (6.0 * u - 15.0))
    slope = sign * 30.0 * u * u * (1.0 - u) ** 2 / fade_s
    bend = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / (fade_s * fade_s)
    return value, slope, bend
