"""Shapes: closed-form paths over time with their exact derivatives up to the fourth.

Every shape is a frozen dataclass whose `at(t_s)` is worked out by hand in plain floats, because it runs in the control
loop. Shapes are defined for every time, also outside of what a flight uses of them: metres north-east-down, seconds,
radians.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from math import cos, isclose, lcm, pi, sin
from typing import NamedTuple

from companion.control.types import Reference, Vec3, new_record

ZERO: Vec3 = (0.0, 0.0, 0.0)

COMMENSURATE_DENOMINATOR_MAX = 64
"""Angular rates whose ratios are fractions with a denominator up to this one close a Lissajous figure."""

COMMENSURATE_TOLERANCE = 1e-9
"""How far, relatively, a ratio of angular rates may be from such a fraction."""


class Heading(NamedTuple):
    """The commanded heading over time: yaw + rate * t. Used where the vehicle's heading choice is "commanded"."""

    yaw_rad: float = 0.0
    """Heading at the start [rad], clockwise from north."""
    yaw_rate_rad_s: float = 0.0
    """Constant rate [rad/s], positive turns the nose right."""


NORTH = Heading()
"""The nose to the north, for ever."""


class Joint(NamedTuple):
    """An instant at which two pieces of a reference meet, with the exact values on either side."""

    at_s: float
    before: Reference
    after: Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape(ABC):
    """A path over time; the common part of all shapes."""

    heading: Heading = NORTH

    @property
    def period_s(self) -> float | None:
        """The time after which position and derivatives repeat [s], so that laps make sense; None for an open shape."""
        return None

    @property
    def own_duration_s(self) -> float | None:
        """How long the shape takes by itself [s]; None when only a duration or a number of laps ends it."""
        return None

    def joints(self) -> tuple[Joint, ...]:
        """Where pieces of the shape meet; empty for a shape that is one formula."""
        return ()

    @abstractmethod
    def at(self, t_s: float) -> Reference:
        """Return position and derivatives at the shape's own time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hover(Shape):
    """Rest at a point."""

    point_m: Vec3 = ZERO

    def at(self, t_s: float) -> Reference:
        """Return the point, at rest."""
        yaw_rate = self.heading.yaw_rate_rad_s
        return Reference(self.point_m, ZERO, ZERO, ZERO, ZERO, self.heading.yaw_rad + yaw_rate * t_s, yaw_rate, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Line(Shape):
    """A straight move from rest to rest, once or there and back again and again.

    The progress is the polynomial of degree 9 that has four zero derivatives at both ends, so that the line starts,
    ends and turns without a jump up to the fourth derivative. Its top speed is 315/128 (2.46) times the distance over
    `move_s`.
    """

    from_m: Vec3
    to_m: Vec3
    move_s: float
    """Time of one move [s], above zero."""
    back: bool = False
    """True: there and back, a lap takes twice `move_s`. False: rests at `to_m` from then on."""

    @property
    def period_s(self) -> float | None:
        """There and back again [s]; None for a single move."""
        return 2.0 * self.move_s if self.back else None

    @property
    def own_duration_s(self) -> float | None:
        """The time of the single move [s]."""
        return None if self.back else self.move_s

    def joints(self) -> tuple[Joint, ...]:
        """Where the line leaves and reaches rest: its turning points, or its end."""
        move_s = self.move_s
        there = self._move(self.from_m, self.to_m, move_s, move_s)
        if not self.back:
            return (Joint(move_s, there, Hover(heading=self.heading, point_m=self.to_m).at(move_s)),)
        return (
            Joint(move_s, there, self._move(self.to_m, self.from_m, 0.0, move_s)),
            Joint(
                2.0 * move_s,
                self._move(self.to_m, self.from_m, move_s, 2.0 * move_s),
                self._move(self.from_m, self.to_m, 0.0, 2.0 * move_s),
            ),
        )

    def at(self, t_s: float) -> Reference:
        """Return the reference; before the start and after a single move it rests at the ends."""
        if not self.back:
            return self._move(self.from_m, self.to_m, min(max(t_s, 0.0), self.move_s), t_s)
        in_lap_s = t_s % (2.0 * self.move_s)
        if in_lap_s <= self.move_s:
            return self._move(self.from_m, self.to_m, in_lap_s, t_s)
        return self._move(self.to_m, self.from_m, in_lap_s - self.move_s, t_s)

    def _move(self, start: Vec3, end: Vec3, in_move_s: float, t_s: float) -> Reference:
        """Return one move at its own time, with the heading of the shape's time."""
        n = 1.0 / self.move_s
        x = in_move_s * n
        y = 1.0 - x
        # The first derivative is 630 x^4 (1 - x)^4; the rest follows from it.
        xy = x * y
        mid = y - x
        c0 = x * x * x * x * x * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + x * 70.0))))
        c1 = 630.0 * n * (xy * xy * xy * xy)
        c2 = 2520.0 * n * n * (xy * xy * xy * mid)
        c3 = 2520.0 * n * n * n * (xy * xy * (3.0 * mid * mid - 2.0 * xy))
        c4 = 2520.0 * n * n * n * n * (xy * mid * (6.0 * mid * mid - 18.0 * xy))
        dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
        yaw_rate = self.heading.yaw_rate_rad_s
        return Reference(
            (start[0] + c0 * dx, start[1] + c0 * dy, start[2] + c0 * dz),
            (c1 * dx, c1 * dy, c1 * dz),
            (c2 * dx, c2 * dy, c2 * dz),
            (c3 * dx, c3 * dy, c3 * dz),
            (c4 * dx, c4 * dy, c4 * dz),
            self.heading.yaw_rad + yaw_rate * t_s,
            yaw_rate,
            0.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle(Shape):
    """A level circle: center + radius (cos(w t + phase), sin(w t + phase), 0)."""

    center_m: Vec3 = ZERO
    radius_m: float
    angular_rate_rad_s: float
    """w, not zero; positive turns clockwise seen from above (north to east)."""
    phase_rad: float = 0.0
    """Where on the circle it starts, clockwise from north."""

    @property
    def period_s(self) -> float | None:
        """One turn [s]."""
        return 2.0 * pi / abs(self.angular_rate_rad_s)

    def at(self, t_s: float) -> Reference:
        """Return the reference on the circle."""
        return _turning(self.center_m, self.radius_m, self.angular_rate_rad_s, self.phase_rad, 0.0, t_s, self.heading)


@dataclass(frozen=True, slots=True, kw_only=True)
class Helix(Shape):
    """A circle that climbs (or sinks) at a constant rate, from the height of its center on."""

    center_m: Vec3 = ZERO
    radius_m: float
    angular_rate_rad_s: float
    """w, not zero; positive turns clockwise seen from above (north to east)."""
    climb_m_s: float
    """Positive upwards."""
    phase_rad: float = 0.0

    def at(self, t_s: float) -> Reference:
        """Return the reference on the helix."""
        return _turning(
            self.center_m, self.radius_m, self.angular_rate_rad_s, self.phase_rad, -self.climb_m_s, t_s, self.heading
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Lemniscate(Shape):
    """The paper's figure of eight (section VI): center + (A cos(w t), B sin(2 w t), 0)."""

    center_m: Vec3 = ZERO
    amplitude_m: tuple[float, float]
    """A (north) and B (east)."""
    angular_rate_rad_s: float
    """w, not zero."""

    @property
    def period_s(self) -> float | None:
        """One figure [s]."""
        return 2.0 * pi / abs(self.angular_rate_rad_s)

    def at(self, t_s: float) -> Reference:
        """Return the reference on the figure of eight."""
        w = self.angular_rate_rad_s
        u = 2.0 * w
        (north, east), (x, y, z), (yaw, yaw_rate) = self.amplitude_m, self.center_m, self.heading
        angle, double = w * t_s, u * t_s
        n0, n1, e0, e1 = north * cos(angle), -w * north * sin(angle), east * sin(double), u * east * cos(double)
        # two derivatives on, a sine is itself again, times minus the square of its rate
        w2, u2 = -w * w, -u * u
        n2, n3, e2, e3 = w2 * n0, w2 * n1, u2 * e0, u2 * e1
        p, v, a, j, s = (x + n0, y + e0, z), (n1, e1, 0.0), (n2, e2, 0.0), (n3, e3, 0.0), (w2 * n2, u2 * e2, 0.0)
        return new_record(Reference, (p, v, a, j, s, yaw + yaw_rate * t_s, yaw_rate, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Lissajous(Shape):
    """A sine on each axis: center_i + amplitude_i sin(w_i t + phase_i)."""

    center_m: Vec3 = ZERO
    amplitude_m: Vec3
    angular_rate_rad_s: Vec3
    """w per axis; zero only where the amplitude is zero."""
    phase_rad: Vec3 = ZERO

    @property
    def period_s(self) -> float | None:
        """The common period of the moving axes [s]; None when their rates have no simple ratio: it never closes."""
        moving = zip(self.angular_rate_rad_s, self.amplitude_m, strict=True)
        rates = [abs(rate) for rate, amplitude in moving if rate != 0.0 and amplitude != 0.0]
        if not rates:
            return None
        slowest = min(rates)
        turns = 1
        for rate in rates:
            ratio = Fraction(rate / slowest).limit_denominator(COMMENSURATE_DENOMINATOR_MAX)
            if not isclose(float(ratio), rate / slowest, rel_tol=COMMENSURATE_TOLERANCE):
                return None
            turns = lcm(turns, ratio.denominator)
        return 2.0 * pi / slowest * turns

    def at(self, t_s: float) -> Reference:
        """Return the reference on the figure."""
        x0, x1, x2, x3, x4 = _sine(self.amplitude_m[0], self.angular_rate_rad_s[0], self.phase_rad[0], t_s)
        y0, y1, y2, y3, y4 = _sine(self.amplitude_m[1], self.angular_rate_rad_s[1], self.phase_rad[1], t_s)
        z0, z1, z2, z3, z4 = _sine(self.amplitude_m[2], self.angular_rate_rad_s[2], self.phase_rad[2], t_s)
        center = self.center_m
        yaw_rate = self.heading.yaw_rate_rad_s
        return Reference(
            (center[0] + x0, center[1] + y0, center[2] + z0),
            (x1, y1, z1),
            (x2, y2, z2),
            (x3, y3, z3),
            (x4, y4, z4),
            self.heading.yaw_rad + yaw_rate * t_s,
            yaw_rate,
            0.0,
        )


def _sine(amplitude_m: float, w: float, phase_rad: float, t_s: float) -> tuple[float, float, float, float, float]:
    """Return amplitude sin(w t + phase) and its first four derivatives."""
    angle = w * t_s + phase_rad
    s, c = amplitude_m * sin(angle), amplitude_m * cos(angle)
    w2 = w * w
    return s, w * c, -w2 * s, -w2 * w * c, w2 * w2 * s


def _turning(
    center_m: Vec3, radius_m: float, w: float, phase_rad: float, sink_m_s: float, t_s: float, heading: Heading
) -> Reference:
    """Return the reference on a circle that sinks at a constant rate."""
    angle = w * t_s + phase_rad
    c, s = radius_m * cos(angle), radius_m * sin(angle)
    w2 = w * w
    w3, w4 = w2 * w, w2 * w2
    return Reference(
        (center_m[0] + c, center_m[1] + s, center_m[2] + sink_m_s * t_s),
        (-w * s, w * c, sink_m_s),
        (-w2 * c, -w2 * s, 0.0),
        (w3 * s, -w3 * c, 0.0),
        (w4 * c, w4 * s, 0.0),
        heading.yaw_rad + heading.yaw_rate_rad_s * t_s,
        heading.yaw_rate_rad_s,
        0.0,
    )
