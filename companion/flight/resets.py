"""What a flight does when the autopilot's estimate is reset (ODOMETRY.reset_counter): nothing moves but the numbers.

A reset changes what is believed, not where the vehicle is. The jump is the new state less the one that the law's own
model foresaw for the same stamp. The reference is moved by the position's jump, so that the vehicle stays where it is.

A velocity that jumps is left to the law: the estimate was wrong before, the error is real, and a reference that went
along would drift away for good.

After a jump of the heading the thrust that is believed to act points elsewhere. The disturbance estimate changes by as
much, so that the believed acceleration stays (at rest this turns the estimate about the vertical), and a heading that
the vehicle holds as its own turns along. One that the trajectory asks for stays as it is in the world, and the nose
turns there no faster than `limits.heading_rate_max_rad_s`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from companion.config import FlightLimits
from companion.control.types import State, Vec3
from companion.control.vectors import axes, quat_multiply
from companion.frames import degrees, wrap_angle

TURN_MIN_RAD = 0.005
"""A smaller turn is the noise of two attitudes."""


class Reset(NamedTuple):
    """One jump of the estimate; with these numbers and the states, the commands can be computed again."""

    at_s: float
    """Stamp of the first state after it [s]."""
    moved_m: Vec3
    """The position's jump, NED: the reference moves by as much."""
    faster_m_s: Vec3
    """The velocity's jump, NED."""
    turned_rad: float
    """The heading's jump; 0 where it is no more than noise."""
    disturbance_m_s2: Vec3
    """What the disturbance estimate changes by, NED."""

    @classmethod
    def from_numbers(cls, entry: Any) -> Reset:
        """Reads what JSON keeps of it. Raises KeyError, TypeError or ValueError."""
        if isinstance(entry, Mapping):
            entry = [entry[name] for name in cls._fields]
        at_s, moved, faster, turned, disturbance = entry
        return cls(float(at_s), _vector(moved), _vector(faster), float(turned), _vector(disturbance))


def jump(at_s: float, foreseen: State, state: State, thrust_m_s2: float) -> Reset:
    """The jump between two states of one instant.

    Args:
        at_s: their stamp [s].
        foreseen: by the state before and the commands since.
        state: as received.
        thrust_m_s2: the thrust that acts, over the mass.
    """
    a, b, c, d = foreseen.q
    w, _, _, z = quat_multiply(state.q, (a, -b, -c, -d))
    turned = wrap_angle(2.0 * math.atan2(z, w))
    if abs(turned) < TURN_MIN_RAD:
        turned = 0.0
    r3 = axes(foreseen.q)[2]
    after = about_vertical(turned, r3)
    disturbance = (thrust_m_s2 * (after[0] - r3[0]), thrust_m_s2 * (after[1] - r3[1]), 0.0)
    return Reset(at_s, _difference(state.p, foreseen.p), _difference(state.v, foreseen.v), turned, disturbance)


def about_vertical(yaw_rad: float, vector: Vec3) -> Vec3:
    """A vector turned about the vertical, clockwise seen from above."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]


def _difference(a: Vec3, b: Vec3) -> Vec3:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _vector(numbers: Any) -> Vec3:
    north, east, down = numbers
    return float(north), float(east), float(down)


class Carried(Protocol):
    """A controller, as far as resets concern it."""

    def foresee(self, stamp_s: float) -> tuple[State, float] | None:
        """The state at a stamp, from the last one and the commands since, and the thrust over the mass [m/s^2]."""
        ...

    def carry(self, reset: Reset) -> None:
        """Goes on after a reset as if nothing had happened."""
        ...


class Moved(Protocol):
    """A course, as far as resets concern it."""

    def shift(self, by_m: Vec3) -> None:
        """Moves all of it."""
        ...


class Resets:
    """Follows the resets of one flight.

    Args:
        limits: of the vehicle; beyond them an estimate that jumps is not flown on.
        notify: gets a line for people.
    """

    def __init__(self, limits: FlightLimits, notify: Callable[[str], None]) -> None:
        self.carried: list[Reset] = []
        """Those that the flight went on through."""
        self._limits, self._notify = limits, notify

    def follow(self, stamp_s: float, state: State, controller: Carried, course: Moved) -> str:
        """The estimate was reset with this state.

        Returns:
            "" when the flight goes on, or by how much it jumped too far, for people.
        """
        known = controller.foresee(stamp_s)
        if known is None:
            return "nothing is known of the state before"
        reset = jump(stamp_s, known[0], state, known[1])
        problem = self._too_large(reset)
        if problem:
            return problem
        course.shift(reset.moved_m)
        controller.carry(reset)
        self.carried.append(reset)
        self._notify(f"the autopilot's estimate was reset: {described(reset)}; the reference moves along")
        return ""

    def _too_large(self, reset: Reset) -> str:
        limits = self._limits
        for size, limit, unit, key in (
            (math.hypot(*reset.moved_m), limits.estimate_jump_max_m, "m", "estimate_jump_max_m"),
            (math.hypot(*reset.faster_m_s), limits.estimate_jump_max_m_s, "m/s", "estimate_jump_max_m_s"),
            (abs(reset.turned_rad), limits.estimate_jump_max_rad, "rad", "estimate_jump_max_rad"),
        ):
            if not size <= limit:
                return f"{described(reset)}, limit {limit:g} {unit} (limits.{key})"
        return ""


def described(reset: Reset) -> str:
    """The sizes of a jump, for people."""
    moved, faster = math.hypot(*reset.moved_m), math.hypot(*reset.faster_m_s)
    return f"moved by {moved:.2f} m and {faster:.2f} m/s, turned by {degrees(reset.turned_rad):.1f} deg"
