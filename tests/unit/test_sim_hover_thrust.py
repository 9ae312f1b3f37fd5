"""The estimated hover thrust, and what the position controller and the land detector make of it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

from sim_link.hover_thrust import HoverThrust
from sim_link.land_detector import LandDetector, Motion
from sim_link.parameters import Parameters
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load

FILE = replace(load("bundled"), state_rate_hz=50.0)
HOVER = FILE.mass_kg * 9.80665 / (4.0 * FILE.rotor_thrust_max_n)


def in_hold(**options) -> Vehicle:
    return Vehicle(VehicleOptions(vehicle=FILE, start=((0.0, 0.0, -30.0), 0.0), engine="python", **options))


def run(vehicle: Vehicle, duration_s: float) -> list[float]:
    """Run; gives the thrust that was commanded."""
    thrusts = []
    end_us = vehicle.t_us + round(duration_s * 1e6)
    while vehicle.t_us < end_us:
        vehicle.tick()
        thrusts.append(vehicle.autopilot.held.thrust)
        for link in vehicle.links:
            link.outbox.clear()
        vehicle.truth_outbox.clear()
    return thrusts


def estimate(vehicle: Vehicle) -> float | None:
    return vehicle.autopilot._hover.value


def test_it_is_valid_after_a_while_in_the_air_and_finds_what_hovers() -> None:
    vehicle = in_hold()
    run(vehicle, 2.0)
    assert estimate(vehicle) is None, "it has to be good for two seconds"
    run(vehicle, 1.0)
    assert estimate(vehicle) == pytest.approx(HOVER, rel=0.01)
    ground = Vehicle(VehicleOptions(vehicle=FILE, engine="python"))
    run(ground, 4.0)
    assert estimate(ground) is None


@pytest.mark.parametrize("factor", [0.75, 1.2])
def test_a_weak_or_strong_vehicle_is_found_out_and_carried_on_without_a_jolt(factor: float) -> None:
    vehicle = in_hold(world=replace(VehicleOptions(FILE).world, gravity_factor=1.0 / factor))
    thrusts = run(vehicle, 12.0)
    assert estimate(vehicle) == pytest.approx(HOVER / factor, rel=0.03)
    steps = [abs(b - a) for a, b in itertools.pairwise(thrusts[75:])]
    assert max(steps) < 0.01, "the integral makes up for the change"
    assert vehicle.airframe.rigid.p[2] == pytest.approx(-30.0, abs=0.1)


def test_it_stays_within_reach_of_the_parameter() -> None:
    vehicle = in_hold(world=replace(VehicleOptions(FILE).world, gravity_factor=1.6))
    run(vehicle, 12.0)
    middle = vehicle.parameters.number("MPC_THR_HOVER")
    assert vehicle.autopilot._hover._share == pytest.approx(middle + vehicle.parameters.number("HTE_THR_RANGE"))


def test_a_jump_of_the_estimate_is_no_acceleration() -> None:
    vehicle = in_hold()
    run(vehicle, 4.0)
    vehicle.faults.inject("estimator_reset", jump_m_s=(0.0, 0.0, 1.0))
    run(vehicle, 0.1)
    assert abs(vehicle.autopilot._hover._ratio) < 1.0
    assert estimate(vehicle) == pytest.approx(HOVER, rel=0.02)


def test_version_1_13_can_leave_it_unused() -> None:
    vehicle = in_hold(px4="1.13", parameters={"MPC_USE_HTE": 0})
    run(vehicle, 4.0)
    assert estimate(vehicle) is None
    vehicle.parameters.set("MPC_USE_HTE", 1)
    assert estimate(vehicle) is not None


@pytest.mark.parametrize("reach", [0.2, math.nan, math.inf, -1.0])
@pytest.mark.parametrize("thrust", [0.0, -1.0, 1e9, math.nan, math.inf])
def test_no_thrust_and_no_parameter_breaks_the_filter(thrust: float, reach: float) -> None:
    parameters = Parameters("1.18", {"HTE_THR_RANGE": reach})
    hover = HoverThrust(parameters, 0.0)
    for k in range(200):
        speed = 50.0 * math.sin(0.1 * k)
        hover.update(20_000 * k, (0.0, 0.0, -9.0), (speed, 0.0, speed), thrust, armed=True, landed=False)
        assert 0.1 <= hover._share <= 0.9
        assert all(map(math.isfinite, (hover._variance, hover._noise, hover._bias, hover._mean_ratio)))


# The land detector


def landed_by(*, thrust: float, hover: float | None, descending: bool = True, climb_controlled: bool = True) -> bool:
    """Tell whether a vehicle that rests with this thrust is taken to touch the ground."""
    detector = LandDetector(Parameters(), landed=False)  # MPC_THR_MIN 0.12, MPC_THR_HOVER 0.5
    still = (0.0, 0.0, 0.0)
    for k in range(50):
        detector.update(Motion(still, still, thrust, climb_controlled, descending, True, hover), 20_000 * k)
    return detector.ground_contact


@pytest.mark.parametrize("climb_controlled", [True, False])
def test_the_thrust_of_a_touchdown_is_30_percent_or_60_by_an_estimate(climb_controlled: bool) -> None:
    for hover, limit in ((None, 0.12 + 0.3 * 0.38), (0.5, 0.12 + 0.6 * 0.38), (0.66, 0.12 + 0.6 * 0.54)):
        assert landed_by(thrust=limit - 0.01, hover=hover, climb_controlled=climb_controlled)
        assert not landed_by(thrust=limit + 0.01, hover=hover, climb_controlled=climb_controlled)


def test_who_holds_a_height_does_not_touch_the_ground_however_light_it_is() -> None:
    assert not landed_by(thrust=0.12, hover=None, descending=False)
    assert not landed_by(thrust=0.12, hover=0.5, descending=False)


def test_an_estimate_that_ends_during_a_descent_goes_on_to_count() -> None:
    detector = LandDetector(Parameters(), landed=False)
    still = (0.0, 0.0, 0.0)
    for k in range(60):
        hover = 0.66 if k < 5 else None
        detector.update(Motion(still, still, 0.42, True, True, True, hover), 20_000 * k)
    assert detector.ground_contact
    detector.update(Motion(still, still, 0.42, True, False, True, None), 1_300_000)
    assert not detector.ground_contact
