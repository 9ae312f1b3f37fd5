"""PX4's own tracking of the same reference, to compare the law with.

Every state is answered with the reference's position, velocity, acceleration, heading and heading rate, and PX4's
position controller does the rest (SET_POSITION_TARGET_LOCAL_NED; PX4 takes velocity and acceleration as feed-forward).
Offboard setpoints pass no smoothing there: what is sent is what is followed.

The reference is taken at the same time of effect as the law's: the stamp of the state that is answered, and the vehicle
file's delay from there until a setpoint acts. PX4 compares it with what it believes then. Left at the present, the
reference would be late by the delay, and PX4 be blamed for it.
"""

from __future__ import annotations

import math

from companion.config import Vehicle
from companion.control import flat
from companion.control.output import PositionSetpoint, Setpoint
from companion.control.types import GRAVITY_M_S2, Reference, State
from companion.control.vectors import quat_exp, quat_multiply
from companion.flight.engines import ReferenceAt
from companion.flight.resets import Reset
from companion.flight.tracker import Stepping, TrackerStep
from companion.frames import wrap_angle, yaw_from_quat

_NOTHING = [math.nan] * flat.RESULTS
_NOTHING[flat.LIMITS] = 0.0
_BEFORE_HEADING, _AFTER_HEADING = tuple(_NOTHING[: flat.HEADING_ERROR]), tuple(_NOTHING[flat.HEADING_ERROR + 1 :])


class Px4Baseline(Stepping):
    """Sends the reference itself.

    The nose does what the vehicle file's [controller] heading asks of the law: along the reference's horizontal
    velocity ("sideslip": held while that is slow), as the trajectory says ("commanded"), or anything ("damping": no
    heading is sent, PX4 holds the one that it has); it is turned no faster than limits.heading_rate_max_rad_s.

    Args:
        vehicle: the vehicle file.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.delay_s = vehicle.delay_s
        self._heading = vehicle.controller.heading
        self._slow_m_s = vehicle.controller.heading_speed_min_m_s
        self._turn_max_rad_s = vehicle.limits.heading_rate_max_rad_s
        self._interval_s = 1.0 / vehicle.link.state_rate_hz
        self._last_s: float | None = None
        self._seen: State | None = None
        self._yaw = 0.0
        self._held = True
        self._last: TrackerStep | None = None

    def begin(self, state: State, thrust_n: float | None = None) -> None:
        """Starts from a hover: the nose stays where it points."""
        self._yaw = yaw_from_quat(state.q)
        self._held = True
        self._last_s = None

    def command(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> Setpoint:
        """The setpoint for one state; of the record's numbers only the heading error exists.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            reference_at: the reference as a function of vehicle time [s]; it is asked for the time of effect.
            frozen: means nothing here.
        """
        dt_s = self._interval_s if self._last_s is None else max(stamp_s - self._last_s, 0.0)
        self._last_s, self._seen = stamp_s, state
        reference = reference_at(stamp_s + self.delay_s)
        yaw, yaw_rate, error = None, None, math.nan
        if self._heading != "damping":
            yaw, yaw_rate = self._turn(*self._wanted(reference), dt_s)
            error = wrap_angle(yaw_from_quat(state.q) - (yaw - yaw_rate * self.delay_s))  # at the state's stamp
        setpoint = PositionSetpoint(reference.p, reference.v, reference.a, yaw, yaw_rate)
        self._last = TrackerStep(setpoint, (*_BEFORE_HEADING, error, *_AFTER_HEADING))
        return setpoint

    def last_step(self) -> TrackerStep:
        """The last step, for the record."""
        assert self._last is not None
        return self._last

    def foresee(self, stamp_s: float) -> tuple[State, float] | None:
        """The last state, moved on as it was; and the thrust of a hover over the mass [m/s^2]."""
        if self._last_s is None or self._seen is None:
            return None
        dt = stamp_s - self._last_s
        (x, y, z), (vx, vy, vz) = self._seen.p, self._seen.v
        rates = self._seen.w
        q = quat_multiply(self._seen.q, quat_exp((dt * rates[0], dt * rates[1], dt * rates[2])))
        return State((x + dt * vx, y + dt * vy, z + dt * vz), self._seen.v, q, rates), GRAVITY_M_S2

    def carry(self, reset: Reset) -> None:
        """Goes on after a reset of the autopilot's estimate: a heading that is held turns along."""
        self._yaw = wrap_angle(self._yaw + reset.turned_rad)

    def _wanted(self, reference: Reference) -> tuple[float, float]:
        """Heading and heading rate that the reference asks for."""
        if self._heading == "commanded":
            return reference.yaw, reference.yaw_rate
        north, east, _ = reference.v
        speed = math.hypot(north, east)
        self._held = not speed > (2.0 * self._slow_m_s if self._held else self._slow_m_s)
        if self._held:
            return self._yaw, 0.0
        return math.atan2(east, north), (north * reference.a[1] - east * reference.a[0]) / (speed * speed)

    def _turn(self, yaw: float, yaw_rate: float, dt_s: float) -> tuple[float, float]:
        """The heading to send: from the last one towards the wanted one, no faster than the limit."""
        most = self._turn_max_rad_s * dt_s
        way = wrap_angle(yaw - self._yaw)
        if abs(way) > most:
            yaw, yaw_rate = self._yaw + math.copysign(most, way), math.copysign(self._turn_max_rad_s, way)
        self._yaw = wrap_angle(yaw)
        return self._yaw, min(max(yaw_rate, -self._turn_max_rad_s), self._turn_max_rad_s)
