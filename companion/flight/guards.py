"""The bounds that a flight is ended by, and the setpoint that ends it when there is no state to fly on."""

from __future__ import annotations

import math

from companion.config import Flight, FlightLimits
from companion.control.output import (
    ActuatorSetpoint,
    AttitudeSetpoint,
    PositionSetpoint,
    RateSetpoint,
    Setpoint,
    thrust_fraction,
)
from companion.control.types import GRAVITY_M_S2, Quat, Vec3
from companion.control.vectors import axes
from companion.flight.phases import Cause
from companion.frames import tilt_from_quat

TILT_FOR_S = 0.2
"""A tilt beyond its limit for this long ends the flight; a shorter one is a gust."""
COSINE_MIN = 0.3
"""The coast setpoint makes up for the tilt no further than this."""

Finding = tuple[Cause, str]


class Guards:
    """Watches the states of a flight."""

    def __init__(self, limits: FlightLimits) -> None:
        self._limits = limits
        self._tilted_since_s: float | None = None

    def check(self, q: Quat, error: Vec3, now_s: float) -> Finding | None:
        """What ends the flight at this state, if anything.

        Args:
            q: attitude.
            error: position less reference, NED [m].
            now_s: vehicle time [s].
        """
        limits = self._limits
        size = math.hypot(*error)
        if size > limits.position_error_abort_m:
            limit = f"limit {limits.position_error_abort_m:g} m (limits.position_error_abort_m)"
            return Cause.POSITION_ERROR, f"{size:.2f} m, {limit}"
        tilt = tilt_from_quat(q)
        if tilt <= limits.tilt_max_rad:
            self._tilted_since_s = None
        elif self._tilted_since_s is None:
            self._tilted_since_s = now_s
        elif now_s - self._tilted_since_s > TILT_FOR_S:
            limit = f"limit {limits.tilt_max_rad:g} rad (limits.tilt_max_rad)"
            return Cause.TILT, f"{tilt:.2f} rad for {TILT_FOR_S:g} s, {limit}"
        return None


def coast_setpoint(flight: Flight, q: Quat) -> Setpoint:
    """No rotation, and hover thrust over the cosine of the tilt, clipped: what keeps height and attitude for a moment.

    Where PX4's own position controller follows the setpoints it is to stop: it has a state when we have none, but would
    fly on with the last velocity as feed-forward.

    Args:
        flight: gives weight, limits and the kind of output.
        q: the last known attitude.
    """
    if flight.output.sends == "position":
        return PositionSetpoint(None, (0.0, 0.0, 0.0), None, None, None)
    vehicle, limits = flight.vehicle, flight.vehicle.limits
    cosine = max(axes(q)[2][2], COSINE_MIN)
    thrust_n = min(max(vehicle.body.mass_kg * GRAVITY_M_S2 / cosine, limits.thrust_min_n), limits.thrust_max_n)
    thrust = thrust_fraction(thrust_n, vehicle.thrust_full_n, vehicle.rotors.curve_factor)
    if flight.output.kind == "attitude":
        return AttitudeSetpoint(thrust, q, 0.0)
    if flight.output.kind == "actuators":
        return ActuatorSetpoint(thrust, (0.0, 0.0, 0.0))
    return RateSetpoint(thrust, (0.0, 0.0, 0.0))
