"""A trajectory as a file defines it, and the same put in its place in the autopilot's local frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, hypot, sin
from typing import Literal

from companion.control.types import Reference, Vec3, new_record
from companion.errors import RefusedError
from companion.frames import GeoPoint
from companion.trajectory.fence import Fence
from companion.trajectory.shapes import ZERO, Joint, Shape
from companion.trajectory.timing import paced, run_out, run_out_duration_s, scaled

Anchor = Literal["here", "local", "home"]
JoinKind = Literal["smooth", "law"]


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the coordinates of a trajectory count from, on the Earth."""

    point: GeoPoint
    altitude_above_home: bool
    """True: heights count from the vehicle's home, and the point's altitude means nothing. False: from the point's
    altitude above mean sea level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """A shape with its pace, its duration and where it belongs; in the coordinates of its definition."""

    name: str
    shape: Shape
    duration_s: float
    """Time of flight [s], at the pace of `time_scale`."""
    anchor: Anchor = "here"
    anchor_yaw_rad: float = 0.0
    """Rotates the trajectory about its anchor, clockwise seen from above."""
    join: JoinKind = "smooth"
    time_scale: float = 1.0
    """2.0 plays the shape twice as fast."""
    origin: Origin | None = None
    """Of coordinates that are places on the Earth; with the anchor "home" they are flown at these places."""
    fence: Fence | None = None
    """To be kept to, in the coordinates of the definition."""
    notes: tuple[str, ...] = ()
    """What people should know about where it comes from, a sentence each."""

    @property
    def period_s(self) -> float | None:
        """Time of one lap [s]; None for an open shape."""
        period_s = self.shape.period_s
        return None if period_s is None else period_s / self.time_scale

    def at(self, t_s: float) -> Reference:
        """Return the reference at a time since the start [s]; the shape goes on outside of [0, duration_s]."""
        if self.time_scale == 1.0:
            return self.shape.at(t_s)
        return scaled(self.shape.at(self.time_scale * t_s), self.time_scale)

    def joints(self) -> tuple[Joint, ...]:
        """Where pieces of the shape meet within the duration, with the exact values on either side."""
        k = self.time_scale
        return tuple(
            Joint(at_s / k, scaled(before, k), scaled(after, k))
            for at_s, before, after in self.shape.joints()
            if at_s / k <= self.duration_s
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchored:
    """A trajectory in the autopilot's local frame (NED): rotated about the vertical, then moved.

    Outside of [0, duration_s] it neither stops dead nor flies on for ever: it runs out to rest along its own path (and,
    before 0, comes from rest along it), continuous up to the fourth derivative. So a loop that asks a little ahead, for
    the time at which a setpoint takes effect, gets the true continuation; one that forgets to end the flight gets a
    point to hold. Running out adds at most `RUN_OUT_ACCELERATION_M_S2` along the path and is a safety net: a planned
    end is `joins.stop`, which keeps the limits.
    """

    trajectory: Trajectory
    offset_m: Vec3
    """Added after the rotation."""
    cos_yaw: float
    sin_yaw: float
    yaw_rad: float
    run_up_s: float
    """Over which it comes from rest before 0 [s]."""
    run_out_s: float
    """Over which it comes to rest after the end [s]."""

    @property
    def duration_s(self) -> float:
        """Time of flight [s]."""
        return self.trajectory.duration_s

    @property
    def period_s(self) -> float | None:
        """Time of one lap [s]; None for an open shape."""
        return self.trajectory.period_s

    @property
    def time_scale(self) -> float:
        """The pace of the trajectory."""
        return self.trajectory.time_scale

    def at(self, t_s: float) -> Reference:
        """Return the reference at a time since the start [s], any time."""
        trajectory = self.trajectory
        if 0.0 <= t_s <= trajectory.duration_s:
            return self._placed(trajectory.at(t_s))
        if t_s > 0.0:
            pace = run_out(t_s - trajectory.duration_s, self.run_out_s)
            return self._placed(paced(trajectory.at(trajectory.duration_s + pace[0]), pace))
        # The run-out mirrored in time: odd derivatives of the path's time keep their sign, even ones change it.
        f0, f1, f2, f3, f4 = run_out(-t_s, self.run_up_s)
        return self._placed(paced(trajectory.at(-f0), (-f0, f1, -f2, f3, -f4)))

    @property
    def inside(self) -> Callable[[float], Reference]:
        """What gives the same as `at` within [0, duration_s]: the shape itself, where nothing has to be done to it."""
        trajectory = self.trajectory
        as_it_is = trajectory.time_scale == 1.0 and self.yaw_rad == 0.0 and self.offset_m == ZERO
        return trajectory.shape.at if as_it_is else self.at

    def joints(self) -> tuple[Joint, ...]:
        """Where pieces of the trajectory meet, with the exact values on either side."""
        joints = self.trajectory.joints()
        return tuple(Joint(at_s, self._placed(before), self._placed(after)) for at_s, before, after in joints)

    def shifted(self, delta_m: Vec3) -> Anchored:
        """Return the same moved by `delta_m` (NED): after the estimator has reset its position by as much."""
        x, y, z = self.offset_m
        return replace(self, offset_m=(x + delta_m[0], y + delta_m[1], z + delta_m[2]))

    def ending_at(self, t_s: float) -> Anchored:
        """Return the same with its end at `t_s`: from then on it runs out to rest along its path. For a stop at
        once."""
        trajectory = replace(self.trajectory, duration_s=t_s)
        return replace(self, trajectory=trajectory, run_out_s=run_out_duration_s(hypot(*trajectory.at(t_s).v)))

    def _placed(self, reference: Reference) -> Reference:
        turned = self.yaw_rad
        p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = reference
        if turned != 0.0:
            cos_yaw, sin_yaw = self.cos_yaw, self.sin_yaw
            p, v, a = rotated(cos_yaw, sin_yaw, p), rotated(cos_yaw, sin_yaw, v), rotated(cos_yaw, sin_yaw, a)
            j, s, yaw = rotated(cos_yaw, sin_yaw, j), rotated(cos_yaw, sin_yaw, s), yaw + turned
        (x, y, z), (north, east, down) = p, self.offset_m
        p = (x + north, y + east, z + down)
        return new_record(Reference, (p, v, a, j, s, yaw, yaw_rate, yaw_acceleration))


def anchored(trajectory: Trajectory, hold_point: Vec3, home_point: Vec3 | None) -> Anchored:
    """Put a trajectory in its place in the autopilot's local frame (NED, metres).

    "here": its start p_d(0) is at `hold_point`, and the yaw offset turns it about that point. "local": its coordinates
    are the local frame's, turned about the origin. "home": its coordinates are relative to `home_point` (HOME_POSITION
    x, y, z), turned about it.

    Raises:
        RefusedError: the anchor is "home" and the home position is not known (None).

    """
    yaw_rad = trajectory.anchor_yaw_rad
    c, s = cos(yaw_rad), sin(yaw_rad)
    if trajectory.anchor == "here":
        start = rotated(c, s, trajectory.at(0.0).p)
        offset_m = (hold_point[0] - start[0], hold_point[1] - start[1], hold_point[2] - start[2])
    elif trajectory.anchor == "home":
        if home_point is None:
            raise RefusedError(
                f'trajectory {trajectory.name}: anchor = "home", but the vehicle has not told its home position; '
                'wait until it has one, or use anchor = "here"'
            )
        offset_m = home_point
    else:
        offset_m = ZERO
    return Anchored(
        trajectory=trajectory,
        offset_m=offset_m,
        cos_yaw=c,
        sin_yaw=s,
        yaw_rad=yaw_rad,
        run_up_s=run_out_duration_s(hypot(*trajectory.at(0.0).v)),
        run_out_s=run_out_duration_s(hypot(*trajectory.at(trajectory.duration_s).v)),
    )


def rotated(c: float, s: float, vector: Vec3) -> Vec3:
    """Rotate about the vertical (down) axis, north to east."""
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]
