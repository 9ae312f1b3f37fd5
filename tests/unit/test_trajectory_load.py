"""Trajectory files: the bundled ones, the keys, and what a wrong file is answered with."""

import math
from pathlib import Path

import pytest

from companion.config import Flight, build_flight, bundled_root, load_vehicle
from companion.errors import InputError
from companion.trajectory.anchored import anchored
from companion.trajectory.feasibility import check
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.joins import join, stop
from companion.trajectory.load import embedded, load, of_flight
from companion.trajectory.pieces import chain, sample
from companion.trajectory.shapes import Circle, Hover, Lemniscate

# Gentle for any multirotor that flies outdoors.
LIMITS = ReferenceLimits(5.0, 3.2, 0.5, 9.0, 80.0, 2.0)
MODEL = PointMass(4.76, 0.2)
BUNDLED = ["circle", "helix", "hover", "indoor", "line", "lissajous", "paper", "waypoints", "windtest"]


def test_no_bundled_file_is_forgotten() -> None:
    assert sorted(path.stem for path in (bundled_root() / "trajectories").glob("*.toml")) == BUNDLED


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_file_can_be_flown_with_join_and_stop(name: str) -> None:
    trajectory = load(name, vehicle=load_vehicle("bundled"))
    assert trajectory.name == name
    placed = anchored(trajectory, (0.0, 0.0, -10.0), (0.0, 0.0, 0.0))
    assert check(placed, LIMITS, MODEL) == []
    first = join(Hover(point_m=(1.0, 1.0, -11.0)).at(0.0), placed.at(0.0), LIMITS, MODEL)
    last = stop(placed.at(placed.duration_s), LIMITS, MODEL)
    assert check(chain([first, placed, last]), LIMITS, MODEL) == []


def test_the_papers_flight() -> None:
    trajectory = load("paper")
    assert trajectory.shape == Lemniscate(center_m=(-5.0, 0.0, -10.0), amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.2)
    assert (trajectory.anchor, trajectory.join, trajectory.duration_s) == ("local", "law", 60.0)
    for t in (0.0, 3.3, 48.0):
        expected = (5.0 * math.cos(0.2 * t) - 5.0, 2.5 * math.sin(0.4 * t), -10.0)
        assert anchored(trajectory, (9.0, 9.0, 9.0), None).at(t).p == pytest.approx(expected)


def test_what_the_comments_of_the_bundled_files_say() -> None:
    line, lissajous, helix, indoor = (sample(load(name), 2001) for name in ("line", "lissajous", "helix", "indoor"))
    assert abs(line.v).max() == pytest.approx(3.1, abs=0.05)
    assert abs(line.a).max() == pytest.approx(1.5, abs=0.05)
    assert (lissajous.v**2).sum(1).max() ** 0.5 == pytest.approx(2.0, abs=0.05)
    assert (lissajous.a**2).sum(1).max() ** 0.5 == pytest.approx(0.7, abs=0.05)
    assert helix.p[0, 2] - helix.p[-1, 2] == pytest.approx(10.0)
    east = math.atan2(helix.v[700, 1], helix.v[700, 0])
    assert math.remainder(helix.yaw[700] - east, math.tau) == pytest.approx(0.0, abs=1e-3)  # nose along the path
    assert (indoor.v**2).sum(1).max() ** 0.5 == pytest.approx(0.6, abs=0.05)
    assert (indoor.a**2).sum(1).max() ** 0.5 == pytest.approx(0.5, abs=0.05)
    relative = indoor.p - indoor.p[0]
    assert relative[:, 0].min() == pytest.approx(-1.5, abs=1e-3)
    assert relative[:, 0].max() <= 1e-9
    assert abs(relative[:, 1]).max() == pytest.approx(0.5, abs=1e-3)


CIRCLE = """
shape = "circle"
laps = 2
[circle]
radius_m = 5
angular_rate_rad_s = 0.5
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "my flight.toml"
    path.write_text(text)
    return path


def test_defaults_and_integers(tmp_path: Path) -> None:
    trajectory = load(written(tmp_path, CIRCLE))
    assert trajectory.name == "my flight"
    assert trajectory.shape == Circle(radius_m=5.0, angular_rate_rad_s=0.5)
    assert (trajectory.anchor, trajectory.join, trajectory.anchor_yaw_rad) == ("here", "smooth", 0.0)
    assert trajectory.duration_s == pytest.approx(8.0 * math.pi)
    assert type(trajectory.at(0.0).p[0]) is float


def test_time_scale_of_the_file_and_in_its_place(tmp_path: Path) -> None:
    path = written(tmp_path, "time_scale = 2.0\n" + CIRCLE)
    assert load(path).duration_s == pytest.approx(4.0 * math.pi)
    assert math.hypot(*load(path).at(0.0).v) == pytest.approx(5.0)
    assert load(path, 0.5).duration_s == pytest.approx(16.0 * math.pi)
    assert math.hypot(*load(path, time_scale=0.5).at(0.0).v) == pytest.approx(1.25)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_time_scale_that_makes_no_sense(tmp_path: Path, scale: float) -> None:
    with pytest.raises(InputError, match="must be a number above zero"):
        load(written(tmp_path, CIRCLE), scale)


def test_degrees_become_radians(tmp_path: Path) -> None:
    text = "anchor_yaw_deg = 90.0\n" + CIRCLE + "phase_deg = 180.0\n[heading]\nyaw_deg = -90.0\nyaw_rate_deg_s = 18.0\n"
    trajectory = load(written(tmp_path, text))
    assert trajectory.anchor_yaw_rad == pytest.approx(math.pi / 2.0)
    assert trajectory.at(0.0).p == pytest.approx((-5.0, 0.0, 0.0))
    assert trajectory.at(0.0).yaw == pytest.approx(-math.pi / 2.0)
    assert trajectory.at(0.0).yaw_rate == pytest.approx(math.pi / 10.0)


def test_single_line_ends_by_itself(tmp_path: Path) -> None:
    text = 'shape = "line"\n[line]\nfrom_m = [0, 0, 0]\nto_m = [3, 0, 0]\nmove_s = 4\n'
    assert load(written(tmp_path, text)).duration_s == 4.0
    assert load(written(tmp_path, text), 2.0).duration_s == 2.0


def test_a_file_may_have_a_name_of_its_own(tmp_path: Path) -> None:
    assert load(written(tmp_path, 'name = "round the tree"\n' + CIRCLE)).name == "round the tree"
    named = flight_table(written(tmp_path, CIRCLE.replace("laps", 'name = "inner"\nlaps')))
    assert of_flight(named).name == "inner"


def test_laps_of_the_command_line_go_before_those_of_the_file(tmp_path: Path) -> None:
    lap_s = load(written(tmp_path, CIRCLE)).duration_s / 2.0
    assert load(written(tmp_path, CIRCLE), laps=5).duration_s == pytest.approx(5.0 * lap_s)
    timed = written(tmp_path, CIRCLE.replace("laps = 2", "duration_s = 3.0"))
    assert load(timed, laps=3).duration_s == pytest.approx(3.0 * lap_s)
    assert of_flight(flight_table(timed, laps=3)).duration_s == pytest.approx(3.0 * lap_s)
    with pytest.raises(InputError, match="does not repeat"):
        load(written(tmp_path, LINE.format("")), laps=2)


def flight_table(path: Path, **options: int) -> Flight:
    """A flight that has the file's trajectory as a table."""
    return embedded(build_flight({"name": "x", "vehicle": "bundled", "trajectory": str(path)}, "test"), **options)


LINE = 'shape = "line"\n{}[line]\nfrom_m = [0, 0, 0]\nto_m = [3, 0, 0]\nmove_s = 4\n'
LISSAJOUS = 'shape = "lissajous"\nduration_s = 9\n[lissajous]\namplitude_m = {}\nangular_rate_rad_s = {}\n'

WRONG = {
    "syntax": (CIRCLE.replace("laps = 2", "laps = = 2"), ["not valid TOML", "line 3"]),
    "key twice": (CIRCLE.replace("laps = 2", "laps = 2\nlaps = 3"), ["not valid TOML", "line 4"]),
    "unknown key": ("lap = 2\n" + CIRCLE, ["unknown key 'lap' = 2", "laps", "time_scale"]),
    "unknown key in the table": (
        CIRCLE + "radius = 5\n",
        ["circle", "unknown key 'radius' = 5", "allowed: center_m, radius_m"],
    ),
    "name that is none": ("name = 5\n" + CIRCLE, ["name = 5", "string"]),
    "name of two lines": ('name = "a\\nb"\n' + CIRCLE, ["name = 'a\\nb'", "printable"]),
    "unknown table": (CIRCLE + "[circel]\nradius_m = 1\n", ["unknown key 'circel'"]),
    "missing key": (CIRCLE.replace("radius_m = 5", ""), ["circle.radius_m is missing"]),
    "missing shape": (CIRCLE.replace('shape = "circle"', ""), ["shape is missing"]),
    "missing table": ('shape = "circle"\nlaps = 2\n', ["table [circle] is missing"]),
    "table of another shape": (
        CIRCLE + "[hover]\npoint_m = [0, 0, 0]\n",
        ['table [hover] does not belong here: shape = "circle"'],
    ),
    "unknown shape": (CIRCLE.replace('"circle"', '"square"'), ["shape = 'square'", "'lemniscate'", "'helix'"]),
    "number as text": (CIRCLE.replace("radius_m = 5", 'radius_m = "5"'), ["circle.radius_m = '5'", "number"]),
    "truth as number": (CIRCLE.replace("radius_m = 5", "radius_m = true"), ["circle.radius_m = True", "number"]),
    "table as number": ('shape = "circle"\nlaps = 2\ncircle = 5\n', ["circle = 5", "must be a table"]),
    "two coordinates": (CIRCLE + "center_m = [1.0, 2.0]\n", ["circle.center_m"]),
    "not a number": (CIRCLE.replace("radius_m = 5", "radius_m = nan"), ["circle.radius_m = nan"]),
    "infinite": (CIRCLE + "center_m = [0.0, inf, 0.0]\n", ["circle.center_m.1 = inf", "finite"]),
    "no radius": (CIRCLE.replace("radius_m = 5", "radius_m = 0"), ["circle.radius_m = 0", "greater than 0"]),
    "no rate": (CIRCLE.replace("0.5", "0.0"), ["circle.angular_rate_rad_s = 0.0", "must not be zero"]),
    "no rate on a moving axis": (
        LISSAJOUS.format("[1, 1, 0]", "[1, 0, 0]"),
        ["lissajous", "angular_rate_rad_s.1 = 0.0", "must not be zero"],
    ),
    "nothing moves": (LISSAJOUS.format("[0, 0, 0]", "[1, 1, 1]"), ["lissajous", "nothing moves"]),
    "duration and laps": ("duration_s = 5\n" + CIRCLE, ["duration_s = 5.0 and laps = 2.0 exclude each other"]),
    "neither": (CIRCLE.replace("laps = 2", ""), ["duration_s or laps is missing"]),
    "laps of a hover": (
        'shape = "hover"\nlaps = 2\n[hover]\n',
        ["laps = 2.0", "this hover does not repeat", "duration_s"],
    ),
    "laps of a single line": (LINE.format("laps = 2\n"), ["laps = 2.0", "line.back = true"]),
    "line without length": (LINE.format("").replace("[3, 0, 0]", "[0, 0, 0]"), ["line", "the same point"]),
    "hover for ever": ('shape = "hover"\n[hover]\n', ["duration_s is missing"]),
    "negative duration": (
        CIRCLE.replace("laps = 2", "duration_s = -3.0"),
        ["duration_s = -3.0", "greater than 0"],
    ),
    "negative laps": (CIRCLE.replace("laps = 2", "laps = -2"), ["laps = -2", "greater than 0"]),
    "no pace": ("time_scale = 0.0\n" + CIRCLE, ["time_scale = 0.0", "greater than 0"]),
    "endless": ("time_scale = 1e-300\n" + CIRCLE.replace("laps = 2", "laps = 1e300"), ["finite time"]),
    "unknown anchor": ('anchor = "there"\n' + CIRCLE, ["anchor = 'there'", "'here', 'local' or 'home'"]),
    "unknown join": ('join = "jump"\n' + CIRCLE, ["join = 'jump'", "'smooth' or 'law'"]),
    "no place in the local frame": ('anchor = "local"\n' + CIRCLE, ['circle.center_m is missing: anchor = "local"']),
    "unknown heading": (CIRCLE + "[heading]\nyaw_rad = 1.0\n", ["heading", "unknown key 'yaw_rad' = 1.0", "yaw_deg"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_file_is_answered_in_one_line(tmp_path: Path, case: str) -> None:
    text, parts = WRONG[case]
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    for part in parts:
        assert part in message, message
    assert caught.value.exit_code == 2


def test_file_that_is_not_text(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(b'shape = "\xff\xfe"')
    with pytest.raises(InputError, match="not a text file"):
        load(path)


def test_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="indoor"):
        load(tmp_path / "nothing.toml")
