"""The one setpoint that goes out without a fresh state."""

from __future__ import annotations

from companion.config import Flight
from companion.control.output import (
    ActuatorSetpoint,
    AttitudeSetpoint,
    PositionSetpoint,
    RateSetpoint,
    Setpoint,
    thrust_fraction,
)
from companion.control.types import GRAVITY_M_S2, Quat
from companion.control.vectors import axes

COSINE_MIN = 0.3
"""The coast setpoint makes up for the tilt no further than this."""


def coast_setpoint(
    flight: Flight, q: Quat, hover_share: float | None = None, thrust_scale: float | None = None
) -> Setpoint:
    """No rotation, and hover thrust over the cosine of the tilt, clipped: what keeps height and attitude for a moment.

    Where PX4's own position controller follows the setpoints it is to stop: it has a state when we have none, but would
    fly on with the last velocity as feed-forward.

    Args:
        flight: gives weight, limits and the kind of output.
        q: the last known attitude.
        hover_share: the command that hovers, where it is known better than by the vehicle file.
        thrust_scale: what a thrust command gives over what the vehicle file says, where that is followed.
    """
    if flight.output.sends == "position":
        return PositionSetpoint(None, (0.0, 0.0, 0.0), None, None, None)
    vehicle, limits = flight.vehicle, flight.vehicle.limits
    cosine = max(axes(q)[2][2], COSINE_MIN)
    thrust_n = min(max(vehicle.body.mass_kg * GRAVITY_M_S2 / cosine, limits.thrust_min_n), limits.thrust_max_n)
    full_n = vehicle.thrust_full_n * (1.0 if thrust_scale is None else thrust_scale)
    thrust = thrust_fraction(thrust_n, full_n, vehicle.rotors.curve_factor)
    if hover_share is not None:
        return RateSetpoint(min(hover_share / cosine, 1.0), (0.0, 0.0, 0.0))
    if flight.output.by_law == "attitude":
        return AttitudeSetpoint(thrust, q, 0.0)
    if flight.output.by_law == "actuators":
        return ActuatorSetpoint(thrust, (0.0, 0.0, 0.0))
    return RateSetpoint(thrust, (0.0, 0.0, 0.0))
