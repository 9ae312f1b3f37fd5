"""Take-off in Offboard: the autopilot's own position controller gets a point that rises from where the vehicle stands.

For vehicles that have no global position, and so no take-off of the autopilot's. PX4 spools up and leaves the ground by
itself; what goes out are position setpoints only. At the top the autopilot is asked for Hold, and the flight goes on as
after its own take-off: the kind of setpoint never changes while it is in Offboard.
"""

from __future__ import annotations

import math
from typing import Final

from companion.control.output import PositionSetpoint
from companion.control.types import Vec3
from companion.frames import yaw_from_quat
from companion.link.telemetry import VehicleState

SPEED_M_S: Final = 1.0
SPEED_UP_S: Final = 2.0
"""After that time the point rises with its full speed, and as long before the top it begins to slow down."""
ARRIVED_M: Final = 0.3
ASIDE_MAX_M: Final = 2.0
"""Further from the vertical through where it stood, or above the top, the climb is given up."""


class Climb:
    """The point of one take-off.

    Args:
        state: on the ground.
        height_m: to be reached above it.
    """

    def __init__(self, state: VehicleState, height_m: float) -> None:
        self._from: Vec3 = state.p
        self._height_m = height_m
        self._yaw = yaw_from_quat(state.q)
        self._begun_s: float | None = None
        self._stopped_m: float | None = None

    def begin(self, stamp_s: float) -> None:
        """The point starts to rise."""
        if self._begun_s is None:
            self._begun_s = stamp_s

    def stop(self, stamp_s: float) -> None:
        """The point stays where it is from now on."""
        if self._stopped_m is None:
            self._stopped_m = self._risen(stamp_s)[0]

    def setpoint(self, stamp_s: float) -> PositionSetpoint:
        """For the state with this stamp."""
        risen_m, speed_m_s = self._risen(stamp_s)
        north, east, down = self._from
        return PositionSetpoint((north, east, down - risen_m), (0.0, 0.0, -speed_m_s), None, self._yaw, None)

    def arrived(self, state: VehicleState) -> bool:
        """Whether the vehicle is at the top."""
        return abs(self._from[2] - state.p[2] - self._height_m) < ARRIVED_M

    def astray(self, state: VehicleState) -> str:
        """Why the climb is to be given up, for people; "" while it goes well."""
        aside_m = math.hypot(state.p[0] - self._from[0], state.p[1] - self._from[1])
        above_m = self._from[2] - state.p[2] - self._height_m
        if aside_m > ASIDE_MAX_M:
            return f"the vehicle is {aside_m:.1f} m aside of where it stood, limit {ASIDE_MAX_M:g} m"
        return f"the vehicle is {above_m:.1f} m above the height asked for" if above_m > ASIDE_MAX_M else ""

    def _risen(self, stamp_s: float) -> tuple[float, float]:
        """Height [m] and speed [m/s] of the point: it speeds up, rises, and slows down before the top."""
        if self._stopped_m is not None:
            return self._stopped_m, 0.0
        if self._begun_s is None or stamp_s <= self._begun_s:
            return 0.0, 0.0
        ramp_s = min(SPEED_UP_S, self._height_m / SPEED_M_S)
        top = SPEED_M_S / ramp_s
        whole_s = self._height_m / SPEED_M_S + ramp_s
        t = min(stamp_s - self._begun_s, whole_s)
        left_s = whole_s - t
        if t < ramp_s:
            return 0.5 * top * t * t, top * t
        if left_s < ramp_s:
            return self._height_m - 0.5 * top * left_s * left_s, top * left_s
        return 0.5 * SPEED_M_S * ramp_s + SPEED_M_S * (t - ramp_s), SPEED_M_S
