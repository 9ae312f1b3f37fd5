"""Whole flights in one kernel: the numbers of the flights step by step, with either engine."""

import math

import numpy as np
import pytest

from companion.campaign import kernel
from companion.campaign.outcome import BINS, measured
from companion.campaign.simulate import fly_sampled
from companion.campaign.whole import Case, Throw, fly, tabulated
from companion.config import Output, load_flight
from companion.control.vectors import axes
from companion.errors import InputError
from companion.flight.course import Course
from companion.flight.engines import kernels
from companion.trajectory.load import embedded, load, of_flight
from sim_link.wind import DRAWS_PER_PERIOD, Wind, series
from tests.unit.campaign_cases import tiny


def flight_of(name="eight", kind="rates", wind=True, **link):
    flight = load_flight(name)
    world = {"wind_m_s": (2.0, 1.0, 0.3), "turbulence": 0.3, "seed": 7} if wind else {}
    vehicle = flight.vehicle.model_copy(update={"link": flight.vehicle.link.model_copy(update=link)})
    changes = {"world": flight.world.model_copy(update=world), "output": Output(kind=kind), "vehicle": vehicle}
    return flight.model_copy(update=changes)


def case_of(flight, duration_s=1.0, vehicle=None, **more):
    return Case(flight, vehicle or flight.vehicle, of_flight(flight), ground=False, duration_s=duration_s, **more)


@pytest.mark.parametrize(
    ("name", "kind", "link"),
    [
        ("eight", "rates", {}),
        ("eight", "attitude", {"command_delay_s": 0.008}),
        ("paper", "rates", {"state_age_s": 0.013}),
        ("eight", "rates", {"state_age_s": 0.0}),
        ("eight", "rates", {"command_delay_s": 0.005}),  # in the middle of an interval, and of a physics step
        ("eight", "rates", {"state_age_s": 0.015, "command_delay_s": 0.023, "state_rate_hz": 50.0}),
    ],
)
def test_the_kernel_flies_what_the_flight_step_by_step_flies(name, kind, link):
    flight = flight_of(name, kind, **link)
    whole = fly(case_of(flight), "python")
    trace = fly_sampled(flight, of_flight(flight), kernels("python"), duration_max_s=1.0)
    assert len(whole.rows) == len(trace.rows) > 0.9 * flight.vehicle.link.state_rate_hz
    record = trace.record
    for got, column in (
        (whole.rows[:, kernel.ERROR], record.columns("error_n", "error_e", "error_d")),
        (whole.rows[:, kernel.THRUST], record.column("thrust_n")),
        (whole.rows[:, kernel.TAU], record.columns("tau_x", "tau_y", "tau_z")),
        (whole.rows[:, kernel.B_HAT], record.columns("b_hat_n", "b_hat_e", "b_hat_d")),
        (whole.time_s, np.array([row.t_s for row in trace.rows])),
    ):
        assert np.abs(got - column).max() < 1e-10
    assert whole.disturbance_m_s2 != (0.0, 0.0, 0.0)


@pytest.mark.numba
@pytest.mark.parametrize("kind", ["rates", "attitude"])
def test_both_engines_give_the_same_numbers(kind):
    case = case_of(flight_of("eight", kind))
    plain, compiled = fly(case, "python"), fly(case, "numba")
    assert np.abs(plain.rows - compiled.rows).max() < 1e-9
    again = fly(case, "numba")
    assert np.array_equal(compiled.rows, again.rows, equal_nan=True)


def test_gusts_in_one_call_are_those_one_by_one_to_the_bit():
    one, other = (Wind((3.0, -2.0, 0.5), 0.3, seed=5, period_s=0.01) for _ in range(2))
    expected = [one.air_m_s]
    for _ in range(200):
        one.advance()
        expected.append(one.air_m_s)
    air = [0.0] * (3 * 201)
    series(other.filters(), other.draws(DRAWS_PER_PERIOD * 200), air)
    assert np.array_equal(np.array(air).reshape(-1, 3), np.array(expected))


@pytest.mark.parametrize("name", ["paper", "circle", "helix", "lissajous", "line", "hover", "waypoints"])
def test_a_course_at_many_instants_is_the_course_at_each(name):
    vehicle = load_flight("eight").vehicle
    course = Course(load(name, vehicle=vehicle), vehicle, (1.0, -2.0, -8.0), 0.4, (0.0, 0.0, 0.0))
    times_s = np.linspace(-0.1, course.duration_s + 1.0, 150)
    found = tabulated(course, times_s)
    for row, t in zip(found, times_s.tolist(), strict=True):
        r = course.at(t)
        assert row == pytest.approx([*r.p, *r.v, *r.a, *r.j, *r.s, r.yaw, r.yaw_rate, r.yaw_acceleration], abs=1e-9)


def test_the_join_stays_above_the_least_height_as_in_every_flight():
    """A helix begins on its way up: from a metre above home the gentlest join would come from below the ground."""
    flight = embedded(flight_of("eight", wind=False).model_copy(update={"trajectory": "helix"}))
    start = flight.start.model_copy(update={"position_m": (1.5, -1.0, -1.0)})
    flight = flight.model_copy(update={"start": start})
    case = Case(flight, flight.vehicle, of_flight(flight), duration_s=4.0)
    whole = fly(case, "auto")
    flown = Course(case.trajectory, flight.vehicle, start.position_m, 0.0, (0.0, 0.0, 0.0), flight.height_min_m)
    assert (whole.ended, whole.course.join_s) == (kernel.FLOWN, flown.join_s)
    assert whole.rows[:, kernel.POSITION][:, 2].max() < -flight.height_min_m + 0.02


def test_a_delay_that_nobody_knows_acts_after_its_steps():
    flight = flight_of("eight", wind=False)
    late = flight.vehicle.model_copy(update={"link": flight.vehicle.link.model_copy(update={"command_delay_s": 0.006})})
    whole = [fly(case_of(flight, 0.6, vehicle), "python").rows for vehicle in (None, late)]
    assert not np.allclose(whole[0][-1], whole[1][-1])


def test_a_thrown_vehicle_starts_as_it_is_thrown():
    throw = Throw((1.0, -2.0, 0.5), math.radians(90.0), math.radians(30.0), (0.1, 0.2, 0.3))
    r3 = axes(throw.attitude(0.7))[2]
    assert (-r3[0], -r3[1], -r3[2]) == pytest.approx((math.cos(math.pi / 6), math.sin(math.pi / 6), 0.0), abs=1e-12)
    whole = fly(case_of(flight_of("paper", wind=False), 0.2, throw=throw), "python")
    assert whole.rows[0, kernel.TILT_COSINE] == pytest.approx(0.0, abs=5e-3)
    moved = whole.rows[10, kernel.POSITION] - whole.rows[0, kernel.POSITION]
    assert moved[0] == pytest.approx(0.04, abs=0.03) and moved[1] == pytest.approx(-0.08, abs=0.03)


def test_what_a_flight_amounts_to_is_what_its_summary_says(tmp_path):
    study = tiny(tmp_path, count=1, duration_s=19.0)
    case = study.case(0)
    flight = case.flight.model_copy(update={"statistics_from_s": 1.0})
    case = Case(flight, flight.vehicle, load("circle"), ground=False, duration_s=15.0)
    engine = "auto"
    outcome = measured(study, 0, case, fly(case, engine), True)
    summary = fly_sampled(case.flight, load("circle"), kernels(engine), duration_max_s=15.0).summary
    m = outcome.measures
    assert outcome.converged and outcome.ended == "flown"
    for key, name in (("settled_at_s", "settled_at_s"), ("rms_m", "position_rms_m"), ("max_m", "position_max_m"),
                      ("vertical_rms_m", "vertical_rms_m"), ("track_rms_m", "track_rms_m")):  # fmt: skip
        assert m[key] == pytest.approx(summary[name], abs=1e-9), key
    assert np.isfinite(outcome.error_m).all() and len(outcome.error_m) == BINS
    assert m["error_max_m"] >= m["max_m"] and 0.0 < m["tilt_max_rad"] < 1.0


def test_a_flight_that_diverges_ends_there_and_says_so(tmp_path):
    study = tiny(tmp_path, count=1, duration_s=5.0)
    flight = flight_of("eight", wind=False)
    heavy = flight.vehicle.model_copy(update={"body": flight.vehicle.body.model_copy(update={"mass_kg": 1.99})})
    case = case_of(flight, 4.0, heavy, diverged_m=1.0)
    whole = fly(case, "python")
    outcome = measured(study, 0, case, whole, True)
    assert (whole.ended, outcome.ended, outcome.converged) == (kernel.DIVERGED, "diverged", False)
    assert "position error reached 1" in outcome.reason and math.isnan(outcome.measures["rms_m"])
    assert outcome.measures["flown_s"] < 4.0 and np.isnan(outcome.error_m[-1])


def test_the_ground_ends_a_flight():
    flight = flight_of("eight", wind=False)
    start = flight.start.model_copy(update={"position_m": (1.5, -1.0, -0.2)})
    heavy = flight.vehicle.model_copy(update={"body": flight.vehicle.body.model_copy(update={"mass_kg": 1.9})})
    case = Case(flight.model_copy(update={"start": start}), heavy, of_flight(flight), duration_s=3.0)
    assert fly(case, "python").ended == kernel.GROUND


def test_what_a_campaign_cannot_fly_is_said():
    flight = flight_of("eight", "actuators")
    with pytest.raises(InputError, match="rates or attitudes"):
        fly(case_of(flight), "python")
    noise = flight.vehicle.noise.model_copy(update={"position_walk_m_per_sqrt_s": 0.1})
    walking = flight_of("eight").vehicle.model_copy(update={"noise": noise})
    with pytest.raises(InputError, match="walk"):
        fly(case_of(flight_of("eight"), vehicle=walking), "python")
