"""Gains are searched among those that a flight would be allowed with, and the choice is explained."""

import math

import pytest

from companion.campaign import tune
from companion.campaign.study import load_study
from companion.cli import main
from companion.config import find
from companion.control.certificate import certify, disturbance_overcome
from companion.control.law import Gains
from companion.errors import InputError, RefusedError
from companion.flight.loop_margins import loop_margins
from tests.unit.campaign_cases import tiny, tiny_file

OWN = {"k1_1_s": 2.0, "k2": 3.0, "k3_1_s": 3.0, "k4_1_s": 4.0, "gamma_1_s3": 4.0, "position_error_max_m": 0.75}
WISH = tune.Wish(0.01, 1, 0.3)


def test_p_max_is_what_the_largest_disturbance_asks_for(tmp_path):
    vehicle = load_study("robustness").flight.vehicle
    gains = tune.complete(vehicle, [2.0, 3.0, 3.0, 4.0, 4.0])
    sound = Gains(2.0, 3.0, 3.0, 4.0, 4.0, gains["position_error_max_m"], 1, 1.0, 1.0, 1.0)
    assert 1.0 < disturbance_overcome(sound) / vehicle.limits.disturbance_max_m_s2 < 1.06
    assert gains | {"position_error_max_m": 0.0} == OWN | {"position_error_max_m": 0.0}


@pytest.mark.parametrize(
    ("changes", "margin_s", "says"),
    [
        ({"gamma_1_s3": 60.0}, 0.01, "not certified: the smallest eigenvalue of Q"),
        ({}, 0.15, "150 ms are asked for"),
        ({"k3_1_s": 60.0, "k4_1_s": 60.0}, 0.01, "a delay margin of"),
    ],
)
def test_what_no_flight_would_be_allowed_with_is_not_flown(changes, margin_s, says, tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "fly", lambda *_: pytest.fail("it was flown"))
    found = tune.score(tiny(tmp_path).to_json(), OWN | changes, WISH._replace(delay_margin_s=margin_s), 0, "python")
    assert says in found.unfit and found.cost > tune.UNFIT * 0.99 and found.converged == 0


def over(folder, kind):
    """A study of the vehicle of PX4's SIH, flown with these setpoints."""
    eight = find("eight", "flights").read_text().replace('vehicle = "bundled"', 'vehicle = "px4_sih"')
    (folder / f"{kind}.toml").write_text(f'{eight}\n[output]\nkind = "{kind}"\n')
    return tiny(folder, duration_s=0.2, flight=f"{kind}.toml")


@pytest.mark.parametrize(("kind", "loop"), [("rates", "body rates"), ("attitude", "attitude setpoints")])
def test_the_margins_are_those_of_the_loop_that_flies(kind, loop, tmp_path, monkeypatch):
    """The same gains bear 9.4 ms over attitude setpoints, which the gate refuses, and more over body rates."""
    monkeypatch.setattr(tune, "fly", lambda *_: pytest.fail("it was flown"))
    study = over(tmp_path, kind)
    vehicle = study.flight.vehicle
    gains = {name: getattr(vehicle.controller, name) for name in OWN}
    margin_s = loop_margins(vehicle, kind, 0.08, 0.2).delay_margin_s
    found = tune.score(study.to_json(), gains, tune.Wish(margin_s + 0.002, 1, 0.3), 0, "python")
    assert found.unfit.startswith(f"a delay margin of {margin_s * 1e3:.1f} ms over {loop}, ")
    assert found.delay_margin_s == pytest.approx(margin_s, abs=1e-4)
    if kind == "attitude":
        least = tune.score(study.to_json(), gains, tune.Wish(0.0, 1, 0.3), 0, "python")
        assert least.unfit.endswith("attitude setpoints, 10 ms are asked for")


def test_actuator_controls_are_refused_before_the_search(tmp_path):
    with pytest.raises(
        InputError, match=r'the search for gains fly the law with output\.kind = "auto", "rates" or "att'
    ):
        over(tmp_path, "actuators")


def test_a_bounded_error_that_does_not_hold_against_the_disturbance_is_not_flown(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "fly", lambda *_: pytest.fail("it was flown"))
    weak = OWN | {"position_error_max_m": 0.1}
    found = tune.score(tiny(tmp_path).to_json(), weak, WISH, 0, "python")
    assert found.cost > tune.UNFIT and "limits.disturbance_max_m_s2 is more" in found.unfit


def test_better_tracking_costs_less_and_a_lost_flight_more(tmp_path):
    text = tiny(tmp_path, duration_s=8.0, more="[converged]\nstatistics_after_s = 0.0\n").to_json()
    good = tune.score(text, OWN, WISH, 0, "auto")
    assert (good.unfit, good.converged) == ("", 1) and 0.0 < good.rms_m < 0.2
    lost = tiny(tmp_path, duration_s=8.0, more="thrust_factor = { constant = 0.55 }\n").to_json()
    assert tune.score(lost, OWN, WISH, 0, "auto").cost > good.cost + tune.LOST


def test_the_flights_of_the_search_are_from_all_over_the_grids(tmp_path):
    """The first flights of a study with a grid are all of its first value."""
    study = tiny(tmp_path, count=8, more="[vary.world]\nwind_m_s = { grid = [0.0, 4.0, 3] }\n")
    winds = [study.values(tune.flight_at(study, place))["world.wind_m_s"] for place in range(6)]
    assert sorted(winds) == [0.0, 0.0, 2.0, 2.0, 4.0, 4.0]
    assert sorted(tune.flight_at(study, place) for place in range(24)) == list(range(24))
    assert [tune.flight_at(tiny(tmp_path, count=8), place) for place in (0, 7, 8)] == [0, 7, 0]


def test_where_gains_cannot_be_written_is_said_before_the_search(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tune, "tune", lambda *_, **__: pytest.fail("it was searched"))
    for out in (tmp_path, tmp_path / "nowhere" / "gains.toml"):
        assert main(["tune", str(tiny_file(tmp_path)), "--out", str(out)]) == 2
        assert f"--out {out}: cannot be written" in capsys.readouterr().err


def test_a_study_whose_flights_the_search_needs_all_is_refused_before_it(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "ProcessPoolExecutor", lambda *_, **__: pytest.fail("it was searched"))
    with pytest.raises(
        InputError, match="every candidate flies 2 flights, and of 2 none is left that the search has not"
    ):
        tune.tune(tiny(tmp_path, count=2), WISH._replace(flights=2), "python", generations=1, workers=1)


def test_a_flight_that_is_lost_in_its_join_has_a_cost(tmp_path):
    """It never comes to the trajectory, so that there is no actuation on it."""
    lost = tiny(tmp_path, duration_s=8.0, more="thrust_factor = { constant = 0.48 }\n").to_json()
    found = tune.score(lost, OWN, WISH, 0, "auto")
    assert (found.unfit, found.converged) == ("", 0) and tune.LOST < found.cost < tune.UNFIT


def test_a_flight_that_ends_before_its_statistics_begin_is_not_said_to_miss_its_bound(tmp_path):
    found = tune.score(tiny(tmp_path, duration_s=9.0).to_json(), OWN, WISH, 0, "auto")
    assert found.converged == 0 and found.lost == "it settled, but ended before its statistics begin"


def test_a_cost_that_is_no_number_is_that_of_gains_that_are_not_allowed(tmp_path):
    """The search would take NaN for the best that there is."""
    wish = WISH._replace(actuation_weight=math.nan)
    found = tune.score(tiny(tmp_path).to_json(), OWN, wish, 0, "python")
    assert found.cost == tune.UNFIT and "no number" in found.unfit


def test_it_is_refused_when_no_flight_converges(tmp_path, monkeypatch):
    """The study ends while the trajectory is still being joined."""
    monkeypatch.setattr(tune, "POPULATION", 1)
    study = tiny(tmp_path, count=4, duration_s=0.2, more="[vary.controller]\nk1_1_s = { uniform = [1.9, 2.0] }\n")
    said = r"none of 1 flights of the search \(the first: it ended at 0\.18 s, while the trajectory was still"
    with pytest.raises(RefusedError, match=said):
        tune.tune(study, WISH, "python", generations=1, workers=1)


def test_the_search_chooses_explains_and_compares(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "POPULATION", 1)
    more = (
        "[vary.controller]\nk1_1_s = { uniform = [1.9, 2.0] }\n[converged]\nbelow_m = 50.0\nstatistics_after_s = 0.0\n"
    )
    study = tiny(tmp_path, count=4, duration_s=0.2, more=more, flight="paper")
    seen = []
    tuned = tune.tune(study, WISH, "python", generations=1, workers=1, progress=lambda *x: seen.append(x))
    vehicle = study.flight.vehicle.model_copy(
        update={"controller": study.flight.vehicle.controller.model_copy(update=tuned.gains)}
    )
    parameters = vehicle.parameters()
    assert certify(parameters.gains, parameters.model.drag).failure() is None
    assert 1.9 <= tuned.gains["k1_1_s"] <= 2.0 and tuned.search.delay_margin_s >= 0.01 and not tuned.search.unfit
    assert seen[-1][0] == tuned.evaluations >= 10 and math.isfinite(seen[-1][1].cost)
    said = tune.words(tuned, WISH)
    assert said[0].startswith("Certified") and "the delay margin of the loop over body rates is at" in said[0]
    assert sum("a quarter higher" in s for s in said) == 5


def test_it_is_refused_when_nothing_is_allowed(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "POPULATION", 1)
    path = tiny_file(tmp_path, more="[vary.controller]\ngamma_1_s3 = { uniform = [900.0, 1000.0] }\n")
    with pytest.raises(RefusedError, match=r"no gain set of \d+ is allowed.*: ask for less margin"):
        tune.tune(load_study(str(path)), WISH, "python", generations=1, workers=1)
