"""What is flown over the loop as it is measured: setpoints and gains, certified as they are."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from companion.campaign.starved import Starvation, fly_starved
from companion.config import Flight, build_flight, find, load_vehicle, read_toml
from companion.control.certificate import certify, disturbance_overcome
from companion.control.sampled import spectral_radius
from companion.control.sampled_attitude import AttitudeLoop, attitude_margins, loop_matrix
from companion.errors import RefusedError
from companion.flight.adaptation import Adaptation, adapted, slower
from companion.flight.engines import kernels
from companion.flight.findings import Verdict
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S, loop_margins, timing
from companion.flight.measure import LinkFigures
from companion.flight.phases import Engagement
from companion.flight.preflight import gate_gains
from companion.flight.schedule import choose
from companion.trajectory.load import embedded, of_flight

WELL = LinkFigures(100, 100.0, 0.020, 0.002, 0.012, 0, (), 0, 0, 0.002, 0.0005, False)
FED = Starvation(rate_hz=(1e4, 1e4), late_share=0.0, gap_every_s=0.0)
STARVED = Starvation(gap_every_s=2.0, loss_s=1.0)


def flight(vehicle: str = "bundled", output: str | None = None, share: float = 1.0, speed: float = 1.0) -> Flight:
    data = read_toml(find("eight", "flights"))
    car = read_toml(find(vehicle, "vehicles"))
    car["link"]["state_rate_hz"] = 100.0
    data |= {"vehicle": car} | ({} if output is None else {"output": {"kind": output}})
    made = embedded(build_flight(data, "test"), speed)
    return made.model_copy(update={"vehicle": slower(made.vehicle, share)}) if share != 1.0 else made


def starved(made: Flight, how: Starvation, seconds: float = 14.0) -> Any:
    return fly_starved(made, of_flight(made), kernels("auto"), how, duration_max_s=seconds, from_s=9.0)


# -- the certificate over attitude setpoints -------------------------------------------------------------------------


def test_attitude_setpoints_need_a_certificate_of_their_own() -> None:
    vehicle = load_vehicle("px4_sih")
    gate_gains(vehicle, "rates")
    with pytest.raises(
        RefusedError, match=r"sampled loop over attitude setpoints bears; lower it, or use output rates"
    ):
        gate_gains(vehicle, "attitude")
    gate_gains(slower(vehicle, 0.7), "attitude")
    gate_gains(load_vehicle("bundled"), "attitude")


def test_the_attitude_loop_becomes_unstable_where_its_margins_end() -> None:
    vehicle = load_vehicle("px4_sih")
    inner = AttitudeLoop(vehicle.autopilot.attitude_gain_1_s, vehicle.autopilot.attitude_lag_s)
    parameters, at = vehicle.parameters(), timing(vehicle)
    found = attitude_margins(parameters, at, inner)

    def radius(extra_s: float) -> float:
        return float(np.abs(np.linalg.eigvals(loop_matrix(parameters, at, inner, extra_s))).max())

    assert radius(found.delay_margin_s - 0.001) < 1.0 < radius(found.delay_margin_s + 0.002)


def test_a_stiff_attitude_loop_is_as_good_as_body_rates_at_low_gains() -> None:
    """At low gains the slowest pole is the law's, whatever takes its commands."""
    heading = {"heading_l1_1_s": 8.0, "heading_l2_1_s": 8.0}
    vehicle = slower(load_vehicle("bundled", {"link": {"state_rate_hz": 100.0}, "controller": heading}), 0.3)
    inner = AttitudeLoop((12.0, 12.0, 12.0), 0.0)
    whole = np.abs(np.linalg.eigvals(loop_matrix(vehicle.parameters(), timing(vehicle), inner))).max()
    assert whole == pytest.approx(spectral_radius(vehicle.parameters(), timing(vehicle)), abs=1e-5)


@pytest.mark.parametrize(("share", "flies"), [(1.0, False), (0.7, True)])
def test_the_simulated_vehicle_agrees_with_the_certificate_over_attitude_setpoints(share: float, flies: bool) -> None:
    made = flight("px4_sih", "attitude", share)
    margins = loop_margins(made.vehicle, "attitude")
    certified = margins.delay_margin_s >= DELAY_MARGIN_MIN_S and margins.interval_max_s >= 0.1
    flown = starved(made, FED)
    assert certified == flies
    assert (flown.handed_over_s is None and flown.max_m < 0.02) == flies, flown


# -- lower gains -----------------------------------------------------------------------------------------------------


def test_lower_gains_are_the_same_law_on_a_slower_clock() -> None:
    vehicle = load_vehicle("px4_sih", {"body": {"drag_1_s": 0.0}})
    fast, slow = vehicle.parameters().gains, slower(vehicle, 0.5).parameters().gains
    assert np.sort_complex(certify(slow, 0.0).poles) == pytest.approx(0.5 * np.sort_complex(certify(fast, 0.0).poles))
    assert disturbance_overcome(slow) == pytest.approx(disturbance_overcome(fast))


@pytest.mark.parametrize("output", ["rates", "attitude"])
def test_a_starved_process_flies_with_lower_gains_and_not_with_the_full_ones(output: str) -> None:
    """Steps 30 % late, gaps of 100 to 400 ms, 40 to 60 Hz."""
    full = starved(flight("px4_sih", output, speed=2.5), STARVED, 20.0)
    low = starved(flight("px4_sih", output, 0.7, speed=2.5), STARVED, 20.0)
    assert full.steps_hz < 55.0
    assert full.handed_over_s is not None and full.error_then_m < 0.5
    assert low.max_m < 0.75 and low.tilt_max_rad < 0.6


def test_a_gap_of_more_than_half_of_the_loss_time_is_handed_over_at() -> None:
    flown = starved(flight(), Starvation(gap_s=(0.3, 0.4), gap_every_s=2.0), 20.0)
    assert flown.why.startswith("no setpoint for 0.3")
    assert flown.error_then_m < 0.1


# -- the choice ------------------------------------------------------------------------------------------------------


def told(made: Flight, **changes: Any) -> tuple[Adaptation | None, Verdict, str]:
    choice = choose(made, WELL._replace(**changes))
    return choice.adaptation, choice.finding.verdict, choice.finding.told


def test_a_sound_loop_is_flown_with_rates_and_the_gains_of_the_file() -> None:
    nothing, verdict, said = told(flight())
    assert nothing is None and verdict is Verdict.PASSED
    assert said == "the loop is as the vehicle file says: output rates, the most precise"
    assert told(flight(output="attitude"))[2].endswith("output attitude, as asked for")


def test_rare_states_are_flown_with_lower_gains() -> None:
    made = flight("px4_sih")
    chosen, verdict, said = told(made, rate_hz=45.0, age_s=0.085, jitter_s=0.03)
    assert chosen is not None and verdict is Verdict.WARNING
    assert chosen.output == "rates" and chosen.state_rate_hz == 45.0 and chosen.state_age_s == 0.085
    assert "states at 45 Hz, not 100, states 85 ms old, not 40, jitter of 30 ms): output rates" in said
    margins = loop_margins(adapted(made, chosen).vehicle, "rates")
    assert margins.delay_margin_s >= 0.03


def test_gaps_are_flown_with_attitude_where_that_is_certified_with_as_much_gain() -> None:
    chosen, _, said = told(flight(), gaps=1, longest_gap_s=0.09)
    assert chosen is not None and chosen.output == "attitude" and "gaps of up to 90 ms" in said
    chosen, *_ = told(flight("px4_sih"), gaps=1, longest_gap_s=0.09)
    assert chosen is not None and chosen.output == "rates" and chosen.gains_share == 1.0


@pytest.mark.parametrize("output", ["rates", "attitude"])
def test_what_the_user_asks_for_goes_out(output: str) -> None:
    chosen, *_ = told(flight("px4_sih", output), gaps=1, longest_gap_s=0.09)
    assert chosen is not None and chosen.output == output


def test_a_loop_for_which_no_gains_are_certified_is_refused() -> None:
    made = flight("px4_sih")
    gains = made.vehicle.controller.model_copy(update={"gamma_1_s3": 500.0})
    weak = made.model_copy(update={"vehicle": made.vehicle.model_copy(update={"controller": gains})})
    chosen, verdict, said = told(weak, rate_hz=45.0)
    assert chosen is None and verdict is Verdict.REFUSED
    assert said.startswith("no certified gains for the loop as it is: states at 45 Hz, not 100;")


@pytest.mark.parametrize("changes", [{"rate_hz": 30.0}, {"age_s": 0.2}, {"rate_hz": None}])
def test_what_other_gates_refuse_is_left_to_them(changes: dict[str, Any]) -> None:
    nothing, verdict, _ = told(flight(), **changes)
    assert nothing is None and verdict is Verdict.PASSED


def test_an_engagement_keeps_what_was_adapted() -> None:
    how = Adaptation("attitude", 0.7, 45.0, 0.03)
    kept = Engagement(1.0, (0.0, 0.0, -1.0), 0.0, None, (1.0, 0.0, 0.0, 0.0), None, adaptation=how)
    assert Engagement.from_numbers(json.loads(json.dumps(asdict(kept)))) == kept
    assert adapted(flight(), None) == flight()
