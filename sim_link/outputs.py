"""What is sent to the rotors, as SERVO_OUTPUT_RAW and ACTUATOR_OUTPUT_STATUS have it."""

from __future__ import annotations

import math

from .allocation import rotor_command
from .rotation import Vec4
from .vehicle_file import VehicleFile

PWM_OFF, PWM_MIN, PWM_MAX = 900, 1000, 2000
"""Pulse widths [us] disarmed, and of the commands 0 and 1."""


def commands(vehicle: VehicleFile, before_n: Vec4, now_n: Vec4, passed_s: float) -> Vec4:
    """Find the rotor commands 0..1 of a period from the rotors' thrusts [N] at its two ends.

    The thrust follows the command with a first-order lag, so that two thrusts a known time apart tell the command
    between them.
    """
    lag_s = vehicle.rotor_lag_s
    left = math.exp(-passed_s / lag_s) if lag_s > 0.0 and passed_s > 0.0 else 0.0
    wanted = [(n - left * b) / (1.0 - left) for n, b in zip(now_n, before_n, strict=True)]
    shares = [min(1.0, max(0.0, n / vehicle.rotor_thrust_max_n)) for n in wanted]
    a, b, c, d = (rotor_command(share, vehicle.curve_factor) for share in shares)
    return a, b, c, d


def pulse_widths(shares: Vec4, armed: bool) -> tuple[int, int, int, int]:
    """Give the pulse widths [us] of rotor commands."""
    if not armed:
        return PWM_OFF, PWM_OFF, PWM_OFF, PWM_OFF
    a, b, c, d = (PWM_MIN + round((PWM_MAX - PWM_MIN) * u) for u in shares)
    return a, b, c, d
