"""Study files: what they may say, and the flights that they make."""

import pytest

from companion.campaign.study import from_json, load_study
from companion.campaign.variables import VARIABLES
from companion.config import find
from companion.errors import InputError
from tests.unit.campaign_cases import tiny, tiny_file


@pytest.mark.parametrize("name", ["region", "robustness", "gains"])
def test_the_bundled_studies_are_sound(name):
    study = load_study(name)
    assert study.total >= 1000 and study.varied
    assert study.case(study.total - 1).flight.world.seed == study.flight_seed(study.total - 1)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("position_walk_m_per_sqrt_s = 0.0", "position_walk_m_per_sqrt_s = 0.1", "white noise alone"),
        ("state_rate_hz = 250.0", "state_rate_hz = 300.0", "must be a whole multiple of link.state_rate_hz = 300"),
    ],
)
def test_a_vehicle_that_no_campaign_can_fly_is_refused_before_anything_is_flown(tmp_path, before, after, says):
    vehicle = find("bundled", "vehicles").read_text()
    assert before in vehicle
    (tmp_path / "mine.toml").write_text(vehicle.replace(before, after))
    with pytest.raises(InputError, match=f"tiny.toml: vehicle 'bundled': .*{says}"):
        load_study(str(tiny_file(tmp_path)), vehicle=str(tmp_path / "mine.toml"))


def test_a_flight_follows_from_the_seed_and_its_number_alone(tmp_path):
    study = tiny(tmp_path, count=50)
    again = from_json(study.to_json())
    assert again.digest == study.digest and again.values(17) == study.values(17)
    assert study.values(17) != study.values(18) and study.flight_seed(17) != study.flight_seed(18)
    more = tiny(tmp_path, count=50, more="drag_factor = { uniform = [0.5, 2.0] }\n")
    assert {k: v for k, v in more.values(17).items() if "drag" not in k} == study.values(17)
    assert more.flight_seed(17) == study.flight_seed(17) and more.digest != study.digest
    case = study.case(17)
    assert case.vehicle.body.mass_kg == study.values(17)["vehicle.mass_factor"] * case.flight.vehicle.body.mass_kg
    assert case.flight.start.position_m[0] == study.values(17)["start.north_m"]


def test_all_combinations_of_grids_are_flown(tmp_path):
    more = """
[vary.controller]
k1_1_s = { grid = [1.0, 2.0, 3] }
k2 = { grid = [2.0, 3.0, 2] }
gamma_1_s3 = { constant = 1.0 }
"""
    study = tiny(tmp_path, count=2, more=more)
    points = [(v["controller.k1_1_s"], v["controller.k2"]) for v in map(study.values, range(study.total))]
    assert study.total == 12 and sorted(set(points)) == [(a, b) for a in (1.0, 1.5, 2.0) for b in (2.0, 3.0)]
    assert all(points.count(point) == 2 for point in points)
    assert study.case(11).flight.vehicle.controller.k1_1_s == 2.0
    assert "controller.gamma_1_s3" not in study.varied and study.case(0).flight.vehicle.controller.gamma_1_s3 == 1.0


def test_spreads_stay_where_they_belong(tmp_path):
    more = """
thrust_factor = { normal = [0.1, 1.0] }
drag_factor = { log_uniform = [0.5, 2.0] }
rate_lag_factor = { choice = [1.0, 1.5] }
[vary.trajectory]
name = { choice = ["circle", "hover"] }
time_scale = { uniform = [0.5, 1.0] }
[vary.world]
wind_m_s = { constant = 3.0 }
wind_towards_deg = { constant = 90.0 }
"""
    study = tiny(tmp_path, count=60, more=more)
    values = [study.values(i) for i in range(60)]
    assert all(v["vehicle.thrust_factor"] > 0.0 for v in values)
    assert all(0.5 <= v["vehicle.drag_factor"] <= 2.0 for v in values)
    assert {v["vehicle.rate_lag_factor"] for v in values} == {1.0, 1.5}
    assert {v["trajectory.name"] for v in values} == {"circle", "hover"}
    case = study.case(0)
    assert case.trajectory.name == values[0]["trajectory.name"]
    assert case.trajectory.time_scale == values[0]["trajectory.time_scale"] == case.flight.trajectory["time_scale"]
    assert case.flight.world.wind_m_s == pytest.approx((0.0, 3.0, 0.0), abs=1e-12)
    assert from_json(study.to_json()).case(3).trajectory == study.case(3).trajectory


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("mass = { constant = 1.0 }", ["vary.vehicle.mass", "is not known", "mass_factor"]),
        ("thrust_factor = { uniform = [2.0, 1.0] }", ["vary.vehicle.thrust_factor", "must not be above"]),
        ("thrust_factor = { uniform = [-1.0, 1.0] }", ["-1 is impossible", "above 0 to 10"]),
        ("thrust_factor = { log_uniform = [0.0, 1.0] }", ["above 0"]),
        ("thrust_factor = { normal = [1.0, -0.1] }", ["standard deviation"]),
        ("thrust_factor = { uniform = [0.9, 1.0], normal = [1.0, 0.1] }", ["exactly one", "uniform, normal"]),
        ("thrust_factor = { gauss = [0.9, 1.0] }", ["vary.vehicle.thrust_factor.gauss", "not a known key"]),
        ("thrust_factor = { choice = [] }", ["must be numbers"]),
        ('thrust_factor = { choice = ["a"] }', ["must be numbers"]),
        ("thrust_factor = { grid = [0.9, 1.0, 0] }", ["1 to 10000"]),
        ("thrust_factor = { uniform = [0.9, inf] }", ["vary.vehicle.thrust_factor.uniform"]),
        ('[vary.trajectory]\nname = { constant = "nowhere" }', ["nowhere"]),
        ("[vary.trajectory]\nname = { uniform = [1.0, 2.0] }", ["vary.trajectory.name", "choice"]),
        ("[vary.start]\ndown_m = { constant = 1.0 }", ["TOML"]),
        ("[converged]\nbelow = 1.0", ["converged.below", "not a known key"]),
        ('[[slices]]\nx = "start.north_m"\ny = "start.east_m"', ["slices[0].y", "must be a number that is varied"]),
    ],
)
def test_what_is_wrong_is_named(tmp_path, more, words):
    path = tiny_file(tmp_path, more=more + "\n")
    with pytest.raises(InputError) as caught:
        load_study(str(path))
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    for word in words:
        assert word in message, message


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("count = 3", "count = 0", ["count = 0"]),
        ("count = 3", "count = 100000000", ["count = 100000000"]),
        ('flight = "eight"', 'flight = "nine"', ["nine", "bundled"]),
        ('name = "tiny"', 'name = "../up"', ["name"]),
        ("seed = 3", "seed = 3\nsped = 4", ["sped = 4 is not a known key"]),
        ("seed = 3", "seed = ", ["line 5"]),
        ("north_m", "down_m", ["start.down_m", "the ground is there"]),
    ],
)
def test_keys_of_the_study_itself(tmp_path, old, new, words):
    path = tiny_file(tmp_path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        load_study(str(path))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("name", VARIABLES)
def test_every_variable_reaches_the_flight(name, tmp_path):
    """A variable that is accepted and then ignored would make a study lie."""
    section, _, key = name.partition(".")
    beside = {
        "world.wind_towards_deg": "wind_m_s",
        "start.tilt_towards_deg": "tilt_deg",
        "world.turbulence": "wind_m_s",
    }
    own = f"{beside[name]} = {{ constant = 2.0 }}\n" if name in beside else ""
    value = -5.0 if name == "start.down_m" else 0.3
    seen = []
    for line in ("", f"{key} = {{ constant = {value} }}\n"):
        path = tmp_path / "one.toml"
        path.write_text(f'name = "one"\nflight = "eight"\n[vary.{section}]\n{own}{line}')
        case = load_study(str(path)).case(0)
        flight = case.flight
        seen.append((flight.start, flight.world, flight.vehicle, case.vehicle, case.trajectory, case.throw))
    assert seen[0] != seen[1]
