"""Calibration: manoeuvres, the hover that flies them, the fits, the file. Truth is the bundled physics."""

from __future__ import annotations

import math
from datetime import date
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from calibration_cases import calibration_flight, fly, hover_share

from companion.config import CalibrationFlight, find, load_vehicle
from companion.control.hover import hover
from companion.control.types import GRAVITY_M_S2, State
from companion.control.vectors import quat_exp
from companion.errors import InputError
from companion.flight.course import at_rest
from companion.flight.manoeuvres import Kind, Manoeuvre, length_s, plan
from companion.identification.data import Grid, Held, flight_data, windows
from companion.identification.identify import Identified, identify, rate_integrals
from companion.identification.motion import MotionFit
from companion.identification.vehicle_file import Entered, provenance, template_of, vehicle_values, written

SHORT = {"repeats": 1, "run_length_m": 3.0, "run_speed_m_s": 2.0}
ZERO = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


# ---- the hover and the manoeuvres ------------------------------------------------------------------------------------


def test_hover_at_rest_asks_for_nothing() -> None:
    command = hover(State(ZERO, ZERO, LEVEL, ZERO), at_rest(ZERO, 0.0), ZERO, 0.01)
    assert command.thrust == pytest.approx(1.0)
    assert command.rates == pytest.approx(ZERO)


@pytest.mark.parametrize(
    ("p", "axis", "sign"),
    [((1.0, 0.0, 0.0), 1, 1.0), ((0.0, 1.0, 0.0), 0, -1.0), ((-1.0, 0.0, 0.0), 1, -1.0)],
)
def test_hover_turns_back_to_its_place(p, axis: int, sign: float) -> None:
    """North of its place it pitches up (positive), east of it it rolls left (negative); by hand: angle times gain."""
    command = hover(State(p, ZERO, LEVEL, ZERO), at_rest(ZERO, 0.0), ZERO, 0.0)
    assert command.rates[axis] == pytest.approx(sign * 3.5 * math.atan2(0.7, GRAVITY_M_S2), rel=1e-6)


def test_hover_lifts_when_low_turns_its_nose_back_and_keeps_its_limits() -> None:
    low = hover(State((0.0, 0.0, 1.0), ZERO, LEVEL, ZERO), at_rest(ZERO, 0.0), ZERO, 0.0)
    assert low.thrust == pytest.approx(1.0 + 0.7 / GRAVITY_M_S2)
    turned = hover(State(ZERO, ZERO, quat_exp((0.0, 0.0, 0.1)), ZERO), at_rest(ZERO, 0.0), ZERO, 0.0)
    assert turned.rates[2] == pytest.approx(-0.1)
    far = hover(State((50.0, -80.0, 30.0), (9.0, 9.0, 9.0), LEVEL, ZERO), at_rest(ZERO, 3.0), ZERO, 0.0)
    assert max(map(abs, far.rates[:2])) <= 1.5 and abs(far.rates[2]) <= 0.4 and far.thrust <= 1.7


def test_steps_come_back_and_runs_begin_and_end_at_rest() -> None:
    step = Manoeuvre(Kind.RATE, 0, 0.8, 0.25, 1.0)
    values = np.array([step.step(t) for t in np.arange(0.0005, 1.0, 0.001)])
    angle = np.cumsum(values) * 0.001
    assert angle[-1] == pytest.approx(0.0, abs=1e-3) and np.sum(angle) * 0.001 == pytest.approx(0.0, abs=1e-3)
    assert max(abs(angle)) == pytest.approx(0.2, abs=2e-3)
    run = next(slot.manoeuvre for slot in plan(CalibrationFlight()) if slot.manoeuvre.kind is Kind.RUN)
    times = np.linspace(0.0, run.length_s, 4001)
    p, v, a = (np.array([run.run(t)[k] for t in times]) for k in range(3))
    assert abs(p[0]).max() + abs(v[0]).max() + abs(p[-1]).max() + abs(v[-1]).max() < 1e-6
    assert abs(v).max() == pytest.approx(2.5, rel=0.02) and abs(p).max() == pytest.approx(2.5, rel=0.05)
    assert np.allclose(np.gradient(p[:, 0], times), v[:, 0], atol=5e-3)
    assert np.allclose(np.gradient(v[:, 0], times), a[:, 0], atol=3e-2) and abs(a).max() < 3.2


def test_the_plan_has_every_kind_and_a_hover_after_each() -> None:
    slots = plan(CalibrationFlight())
    assert {(s.manoeuvre.kind, s.manoeuvre.axis) for s in slots} == {
        *(("rate", axis) for axis in range(3)),
        ("thrust", 0),
        *(("run", axis) for axis in range(2)),
    }
    assert all(b.begin_s - a.end_s >= 2.0 for a, b in pairwise(slots))
    assert length_s(slots) < 150.0


def test_no_manoeuvre_begins_while_the_vehicle_is_not_at_rest_and_a_large_tilt_ends_one() -> None:
    from companion.flight.calibration import Calibrator
    from companion.flight.phases import Autopilot

    told: list[str] = []
    calibrator = Calibrator(calibration_flight(SHORT), Autopilot(), told.append)
    still = State(ZERO, ZERO, LEVEL, ZERO)
    calibrator.begin(still)

    def until(state: State, begin_s: float, end_s: float) -> None:
        for i in range(round(100 * begin_s), round(100 * end_s)):
            calibrator.step(0.01 * i, state, lambda t: at_rest(ZERO, 0.0))

    until(still, 0.0, 4.0)
    assert not told
    until(State(ZERO, (1.0, 0.0, 0.0), LEVEL, ZERO), 4.0, 5.2)
    assert len(told) == 1 and "left out, the vehicle is not at rest (1.00 m/s" in told[0]
    until(still, 5.2, 7.6)
    assert told[-1].startswith("calibration 2 of")
    until(State(ZERO, ZERO, quat_exp((0.6, 0.0, 0.0)), ZERO), 7.6, 7.7)
    assert told[-1].endswith("ended early, the tilt is 0.60 rad")
    assert calibrator.flown == 0


# ---- the fits --------------------------------------------------------------------------------------------------------


def test_a_manoeuvre_for_whose_beginning_no_state_came_is_named() -> None:
    from companion.flight.calibration import Calibrator
    from companion.flight.phases import Autopilot

    told: list[str] = []
    calibrator = Calibrator(calibration_flight(SHORT), Autopilot(), told.append)
    still = State(ZERO, ZERO, LEVEL, ZERO)
    calibrator.begin(still)
    begin_s = plan(CalibrationFlight(**SHORT))[0].begin_s
    for t in (0.0, 0.01, begin_s - 0.01, begin_s + 0.2):
        calibrator.step(t, still, lambda t: at_rest(ZERO, 0.0))
    assert len(told) == 1 and "left out, for 200 ms no state came to begin it by" in told[0]


def test_a_held_command_is_averaged_over_its_time() -> None:
    command = Held(np.array([0.0, 1.0, 3.0]), np.array([2.0, 4.0, 8.0]))
    assert command.means(np.array([-1.0, 0.0, 0.5, 1.5, 4.0, 9.0])) == pytest.approx([2.0, 2.0, 3.0, 5.6, 8.0])


def test_a_gap_ends_a_window() -> None:
    t_s = np.concatenate((np.arange(0.0, 12.0, 0.01), np.arange(12.5, 15.0, 0.01), np.arange(16.0, 16.5, 0.01)))
    assert [(round(t_s[w.start], 1), round(t_s[w.stop - 1], 1)) for w in windows(t_s)] == [
        (0.0, 6.0),
        (6.0, 12.0),
        (12.5, 15.0),
    ]
    cells = Grid(t_s[:100])
    assert cells.summed(np.ones((len(cells.edges_s) - 1, 1)))[:, 0] == pytest.approx(t_s[:100] - t_s[0])


@pytest.mark.parametrize("rate_hz", [10.0, 12.0])
def test_states_that_come_slowly_are_no_gaps_and_one_lost_state_is_none(rate_hz) -> None:
    """The slowest that a vehicle file may ask for, with jitter."""
    steps_s = (1.0 + 0.15 * np.sin(np.arange(600.0))) / rate_hz
    steps_s[200] *= 2.0
    steps_s[400] *= 4.0
    t_s = np.cumsum(steps_s)
    found = windows(t_s)
    assert sum(w.stop - w.start for w in found) == 600
    assert {w.start for w in found} >= {0, 400} and found[-1].stop == 600
    assert all(np.diff(t_s[w]).max() < 2.5 / rate_hz for w in found)


def test_a_calibration_at_ten_states_a_second_integrates_and_is_identified() -> None:
    flight = calibration_flight({"repeats": 1}, link__state_rate_hz=10.0, world={"wind_m_s": (0.5, 0.0, 0.0)})
    source, calibrator, told = fly(flight, hover_share=hover_share(flight, 0.0))
    assert not any("left out" in line or "early" in line for line in told), told
    found = identify(flight_data(source), flight.vehicle.autopilot.rate_integral_1_s, curved=False)
    assert found.motion.full_m_s2 == pytest.approx(20.0, rel=0.01)
    assert found.rare == found.lacking == ["roll rate", "pitch rate"]  # of 40 ms; yaw's 80 ms are told
    still = State(ZERO, ZERO, LEVEL, ZERO)
    calibrator.begin(still)
    for t_s in (0.0, 0.112, 0.221):  # 10 Hz with jitter
        out = calibrator.step(t_s, still._replace(p=(1.0, 0.0, 0.0)), lambda t: at_rest(ZERO, 0.0))
    late = calibrator.step(0.221 + 0.3, still._replace(p=(1.0, 0.0, 0.0)), lambda t: at_rest(ZERO, 0.0))
    assert out.b_hat[0] == pytest.approx(0.15 * (0.1 + 0.112 + 0.109), rel=1e-6) and late.b_hat == out.b_hat


@pytest.mark.parametrize(("rate_hz", "age_s"), [(10.0, 0.05), (12.5, 0.02), (20.0, 0.05), (25.0, 0.02)])
def test_a_lag_that_rare_states_tell_is_within_its_standard_deviation(rate_hz, age_s) -> None:
    """Loops of 20 and 40 ms: at 100 Hz their first-order lags are 33.7 and 42.3 ms."""
    lags = {"autopilot__rate_lag_s": [0.02, 0.04, 0.08], "link__state_age_s": age_s, "link__state_rate_hz": rate_hz}
    flight = calibration_flight({"repeats": 1}, **lags)
    source, _, _ = fly(flight, hover_share=hover_share(flight, 0.0))
    found = identify(flight_data(source), flight.vehicle.autopilot.rate_integral_1_s, curved=False)
    for fit, truth_s in zip(found.rates[:2], (0.0337, 0.0423), strict=True):
        assert fit is not None
        assert fit.rare or abs(fit.lag_s - truth_s) < 2.0 * fit.lag_sd_s
    assert ("roll rate" in found.rare) is (rate_hz < 15.0) and "yaw rate" not in found.rare


def test_rate_integrals_come_from_the_parameters_where_they_are_told() -> None:
    told = {"MC_ROLLRATE_P": 0.15, "MC_ROLLRATE_I": 0.2, "MC_PITCHRATE_P": 0.0, "MC_PITCHRATE_I": 0.2}
    assert rate_integrals(told, (9.0, 8.0, 7.0)) == pytest.approx((0.2 / 0.15, 8.0, 7.0))


def identified(settings=SHORT, *, curved: bool = True, undone: float | None = None, off: float = 1.0, **changes):
    """The truth's flight file, and what is found; the calibrator is told a hover thrust that is `off`."""
    flight = calibration_flight(settings, **changes)
    curve = flight.vehicle.rotors.curve_factor if undone is not None else 0.0
    source, _, told = fly(flight, hover_share=off * hover_share(flight, curve), undone_curve=undone)
    assert not any("left out" in line or "early" in line for line in told), told
    integrals = flight.vehicle.autopilot.rate_integral_1_s
    return flight, identify(flight_data(source), integrals, curved=curved), source


def near_the_truth(flight, found: Identified) -> None:
    vehicle = flight.vehicle
    assert found.lacking == []
    assert found.motion.full_m_s2 == pytest.approx(vehicle.thrust_full_n / vehicle.body.mass_kg, rel=0.01)
    assert found.motion.drag_1_s == pytest.approx(vehicle.body.drag_1_s, abs=0.02)
    assert found.motion.lag_s + found.delay_s == pytest.approx(
        vehicle.rotors.lag_s + vehicle.link.command_delay_s, abs=5e-3
    )
    for fit, lag_s in zip(found.rates, vehicle.autopilot.rate_lag_s, strict=True):
        assert fit is not None
        assert fit.lag_s + found.delay_s == pytest.approx(lag_s + vehicle.link.command_delay_s, rel=0.2, abs=4e-3)
    assert found.age_s == pytest.approx(vehicle.link.state_age_s, abs=1e-3)


def test_the_bundled_vehicle_is_found(tmp_path) -> None:
    """With a hover thrust that is told 8 % wrong; and the file that comes of it is a vehicle file."""
    flight, found, source = identified(off=0.92)
    near_the_truth(flight, found)
    assert found.motion.curve_factor == 0.0
    facts = {"autopilot": "1.18.0", "battery_v": 15.3, "hold_thrust": 0.49, "parameters": {"MC_ROLL_P": 6.0}}
    entered = Entered("mine", 1.1, 0.1, False)
    values = vehicle_values(template_of("px4_sih"), entered, found, facts)
    text = written("px4_sih", values, provenance(found, facts, entered, source.path, date(2026, 11, 27)))
    other = written("bundled", values, provenance(found, facts, entered, source.path, date(2026, 11, 27)))
    assert "exclusive = true" in find("bundled", "vehicles").read_text()
    assert "exclusive" not in other, "who else listens there nobody has told"
    path = tmp_path / "mine.toml"
    path.write_text(text)
    vehicle = load_vehicle(str(path))
    assert vehicle.calibration is not None and vehicle.calibration.date == "2026-11-27"
    assert (vehicle.name, vehicle.simulated, vehicle.body.mass_kg) == ("mine", False, 1.1)
    assert vehicle.thrust_full_n / vehicle.body.mass_kg == pytest.approx(20.0, rel=0.01)
    assert vehicle.controller.measured_delay
    assert (
        "sih_params: SIH_MASS" not in text
        and "# measured: a step of 6 rad/s is tracked" not in text.split("[limits]")[0]
    )


@pytest.mark.parametrize(("mass_kg", "full_m_s2"), [(10.0, 28.23481), (1.1, 20.00002), (2.0, 17.5309)])
def test_a_limit_that_is_all_that_the_rotors_give_stays_within_it_after_rounding(mass_kg, full_m_s2) -> None:
    template = template_of("px4_sih")
    limits = template.limits.model_copy(update={"thrust_max_n": template.thrust_full_n})
    template = template.model_copy(update={"limits": limits})
    motion = MotionFit(full_m_s2, 0.0, 0.05, 0.0, 0.5, 0.01, 0.0, 0.001, 0.001, 0.01, 0.01)
    nothing = (None, None, None)
    found = Identified(nothing, nothing, (0.5, 0.5, 0.5), motion, motion, 0.02, None, 60.0, 0.01)
    entered = Entered("mine", mass_kg, 0.1, False)
    values = vehicle_values(template, entered, found, {})
    assert values["limits.thrust_max_n"] <= 4.0 * values["rotors.thrust_max_n"]
    assert values["limits.thrust_max_n"] == pytest.approx(mass_kg * full_m_s2, rel=1e-4)
    written("px4_sih", values, provenance(found, {}, entered, Path("flight"), date(2026, 11, 27)))


def test_a_calibration_that_is_no_date_is_refused() -> None:
    with pytest.raises(InputError, match=r"calibration\.date = 'yesterday': must be a date, YYYY-MM-DD"):
        load_vehicle("bundled", {"calibration": {"date": "yesterday"}})


@pytest.mark.long
@pytest.mark.parametrize(
    "changes",
    [
        {
            "body__mass_kg": 1.3,
            "body__drag_1_s": 0.2,
            "rotors__lag_s": 0.03,
            "autopilot__rate_lag_s": [0.06, 0.05, 0.12],
        },
        {"link__state_age_s": 0.03, "link__command_delay_s": 0.015, "link__state_rate_hz": 125.0},
        {"rotors__thrust_max_n": 8.0, "noise__rate_rad_s": 0.01, "world": {"wind_m_s": [2.0, -1.0, 0.0]}},
    ],
)
def test_other_vehicles_are_found(changes) -> None:
    settings = {"repeats": 2}
    near_the_truth(*identified(settings, **changes)[:2])


@pytest.mark.long
def test_a_thrust_curve_is_found_where_the_autopilot_does_not_undo_it() -> None:
    flight, found, _ = identified({"repeats": 2}, undone=0.0, rotors__curve_factor=0.4)
    assert found.motion.curve_factor == pytest.approx(0.4, abs=0.05)
    assert found.motion.hover_share == pytest.approx(hover_share(flight, 0.4), abs=0.005)
