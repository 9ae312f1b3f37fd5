"""Vehicles that the tests of the simulated one share."""

from __future__ import annotations

import dataclasses

from sim_link.inner_loops import RATES, Setpoint
from sim_link.physics import Body, make_body
from sim_link.rotation import Vec3, Vec4
from sim_link.vehicle_file import VehicleFile, load

NOTHING: Vec3 = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
OFF: Vec4 = (0.0, 0.0, 0.0, 0.0)
DT = 0.002
PAPER = load("paper")
HOVER = PAPER.mass_kg * 9.81 / (4.0 * PAPER.rotor_thrust_max_n)


def body(**changes: object) -> Body:
    """Return the paper's quadrotor, with three different moments of inertia."""
    return make_body(vehicle(inertia_kg_m2=(0.09, 0.11, 0.15)), 9.81)._replace(**changes)


def vehicle(**changes: object) -> VehicleFile:
    return dataclasses.replace(PAPER, **changes)


def uneven() -> VehicleFile:
    """Return a vehicle like PX4's iris: arms of different lengths."""
    return vehicle(
        rotor_x_m=(0.1515, -0.1515, 0.1515, -0.1515),
        rotor_y_m=(0.2450, -0.1875, -0.2450, 0.1875),
    )


def noiseless(**changes: object) -> VehicleFile:
    quiet = dict.fromkeys(
        ("noise_position_m", "noise_velocity_m_s", "noise_attitude_rad", "noise_rate_rad_s", "state_age_s"), 0.0
    )
    return vehicle(**{**quiet, **changes})


def rates(w: Vec3, thrust: float = HOVER) -> Setpoint:
    return Setpoint(RATES, thrust, w, LEVEL, 0.0, NOTHING)
