"""The margins of a vehicle file's loop, over body rate or over attitude setpoints."""

from __future__ import annotations

from typing import Final

from companion.config import Vehicle
from companion.control.sampled import INTERVAL_LIMIT_S, MARGIN_LIMIT_S, Margins, Timing, margins
from companion.control.sampled_attitude import AttitudeLoop, attitude_margins

DELAY_MARGIN_MIN_S: Final = 0.010
"""By so much delay beyond the vehicle file's every certified loop stays stable."""


def timing(vehicle: Vehicle) -> Timing:
    """The sampled loop of a vehicle file."""
    x, y, z = vehicle.autopilot.rate_lag_s
    return Timing(
        1.0 / vehicle.link.state_rate_hz,
        vehicle.delay_s,
        (x, y, z, vehicle.rotors.lag_s),
        vehicle.controller.prediction,
    )


def loop_margins(
    vehicle: Vehicle, output: str, delay_limit_s: float = MARGIN_LIMIT_S, interval_limit_s: float = INTERVAL_LIMIT_S
) -> Margins:
    """The margins of the loop over these setpoints; "attitude" has the autopilot's attitude loop in it."""
    parameters, at = vehicle.parameters(), timing(vehicle)
    if output == "attitude":
        inner = AttitudeLoop(vehicle.autopilot.attitude_gain_1_s, vehicle.autopilot.attitude_lag_s)
        return attitude_margins(parameters, at, inner, delay_limit_s, interval_limit_s)
    return margins(parameters, at, delay_limit_s, interval_limit_s)
