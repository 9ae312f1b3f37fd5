"""`companion check`: figures that can be worked out by hand, every reason to refuse, and what it prints."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from format_cases import DATA, EIGHT, mavsdk, polynomial, rest_to_rest, skybrush

from companion.campaign import predict
from companion.cli import check, main
from companion.cli.sketch import sketch
from companion.config import Vehicle, load_vehicle
from companion.control.types import Reference
from companion.errors import RefusedError
from companion.flight.inspection import inspect
from companion.flight.surroundings import separation
from companion.frames import compass_deg
from companion.toml_text import toml_text
from companion.trajectory import torque
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.flatness import PointMass
from companion.trajectory.load import load
from companion.trajectory.shapes import Circle, Hover, Joint

ZERO = (0.0, 0.0, 0.0)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No simulated flight: that takes most of the time, and has its own tests."""
    figures = predict.Prediction(*(predict.Extreme(1.0, 0.5) for _ in range(6)), 0.0, 0.0)
    monkeypatch.setattr(predict, "gate_prediction", lambda *_: figures)


def document(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict[str, Any]:
    assert main(["check", *arguments, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_the_figures_of_a_circle() -> None:
    vehicle = load_vehicle("bundled")
    shape = Circle(center_m=(0.0, 0.0, -10.0), radius_m=5.0, angular_rate_rad_s=0.6)
    found = inspect(Trajectory(name="c", shape=shape, duration_s=30.0, anchor="local"), vehicle, hold_point=ZERO)
    peaks = {peak.name: peak for peak in found.peaks}
    # Acceleration inwards and drag against the velocity, at right angles.
    level = math.hypot(5.0 * 0.36, vehicle.body.drag_1_s * 3.0)
    tilt, thrust = math.atan2(level, 9.81), vehicle.body.mass_kg * math.hypot(level, 9.81)
    expected = {
        "speed": 3.0,
        "acceleration": 1.8,
        "jerk": 1.08,
        "tilt": tilt,
        "thrust": thrust,
        "thrust, least": thrust,
        "body rate": 0.6 * math.sin(tilt),
        "torque": 0.025 * 0.6**2 * math.sin(tilt) * math.cos(tilt),
    }
    assert {name: peak.value for name, peak in peaks.items() if name in expected} == pytest.approx(expected, rel=1e-6)
    assert peaks["speed"].use == pytest.approx(0.5)
    assert peaks["thrust, least"].use == pytest.approx(2.0 / thrust)
    assert peaks["torque"].limit == pytest.approx(min(thrust / 4, 5.0 - thrust / 4) * 0.8 / math.sqrt(2.0))
    assert found.problems == ()
    assert found.snap_steps == ()
    assert found.ground is not None
    assert found.ground.value_m == pytest.approx(10.0)


def test_the_time_scale_that_passes_is_the_fastest_one() -> None:
    vehicle = load_vehicle("bundled")
    shape = Circle(radius_m=5.0, angular_rate_rad_s=0.6)
    for scale in (1.0, 0.5, 3.0):
        trajectory = Trajectory(name="c", shape=shape, duration_s=30.0 / scale, time_scale=scale)
        found = inspect(trajectory, vehicle, hold_point=(0.0, 0.0, -5.0))
        assert found.time_scale is not None
        # The acceleration gets to its limit first: 6 m/s^2 of 1.8.
        assert found.time_scale == pytest.approx(math.sqrt(6.0 / 1.8), rel=3e-3)
        assert (found.problems != ()) == (scale > found.time_scale)
        best = Trajectory(name="c", shape=shape, duration_s=20.0, time_scale=found.time_scale)
        assert inspect(best, vehicle, hold_point=(0.0, 0.0, -5.0)).problems == ()


def test_a_step_of_the_fourth_derivative() -> None:
    # At rest the thrust is vertical: only the level part of the jump turns it, by jump over gravity.
    rest = Hover().at(0.0)
    after = rest._replace(s=(3.0, 4.0, 100.0))
    step = torque.step(Joint(2.0, rest, after), PointMass(1.0), torque.Body(0.02, 0.5, 5.0))
    assert step.at_s == 2.0
    assert step.snap_m_s4 == pytest.approx(math.hypot(5.0, 100.0))
    assert step.angular_acceleration_rad_s2 == pytest.approx(5.0 / 9.81)
    assert step.torque_n_m == pytest.approx(0.02 * 5.0 / 9.81)


def test_the_torque_that_rotors_have_is_that_of_the_worst_direction() -> None:
    vehicle = load_vehicle("bundled")
    of = torque.body(vehicle)
    arm, moved = 0.2, 1.0
    # Each rotor moved by at most 1 N with the same sum: about a diagonal two rotors do it all, at arm * sqrt(2) each.
    assert of.lever_m * moved == pytest.approx(2.0 * arm * math.sqrt(2.0) * moved)


def commanded(vehicle: Vehicle) -> str:
    """The file of a vehicle that follows the headings of its trajectory."""
    table = vehicle.model_dump(mode="json", exclude_none=True)
    table["controller"]["heading"] = "commanded"
    return toml_text(table)


def written(folder: Path, name: str, text: str) -> str:
    (folder / name).write_text(text)
    return str(folder / name)


@pytest.mark.usefixtures("quick")
def test_a_jump_in_the_fourth_derivative_at_joints_is_reported_and_let_pass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, "eight.csv", polynomial(EIGHT.at, 62.0, 31, digits=12))
    found = document(capsys, path, "--vehicle", "paper")["files"][0]
    fourth = found["fourth_derivative"]
    assert 25 <= fourth["jumps"] <= 30
    assert 0.0 < fourth["largest"]["angular_acceleration_rad_s2"] < 0.1
    assert found["problems"] == []
    ends = found["ends"]
    assert ends["start"]["speed_m_s"] == pytest.approx(1.0, abs=1e-3)
    assert ends["start"]["joined"].startswith("a join of ")
    assert ends["end"]["joined"].startswith("a stop of ")


@pytest.mark.usefixtures("quick")
def test_a_jump_at_rest_is_reported_as_what_it_would_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, "move.csv", polynomial(rest_to_rest(10.0, 6.0), 6.0, 1, digits=12))
    start = document(capsys, path, "--vehicle", "bundled")["files"][0]["ends"]["start"]
    # 840 times the length over the time to the fourth power.
    assert start["snap_m_s4"] == pytest.approx(840.0 * 10.0 / 6.0**4, rel=1e-6)
    assert start["step"]["angular_acceleration_rad_s2"] == pytest.approx(840.0 * 10.0 / 6.0**4 / 9.81, rel=1e-6)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("power", "name"), [(0, "position"), (1, "velocity"), (2, "acceleration"), (3, "jerk")])
def test_a_jump_below_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], power: int, name: str) -> None:
    lines = polynomial(EIGHT.at, 20.0, 10).splitlines()
    cells = lines[4].split(",")
    cells[1 + power] = f"{float(cells[1 + power]) + 0.05:.6f}"
    lines[4] = ",".join(cells)
    path = written(tmp_path, "jump.csv", "\n".join(lines))
    problems = document(capsys, path, "--vehicle", "paper", code=3)["files"][0]["problems"]
    assert any(problem["name"] == "jump" and problem["sentence"].startswith(f"{name} jumps by") for problem in problems)
    # The gate of the flight refuses by the same sentence.
    assert main(["fly", path, "--vehicle", "paper", "--sim"]) == 3
    assert problems[0]["sentence"] in capsys.readouterr().err


@pytest.mark.usefixtures("quick")
def test_what_is_too_fast_is_refused_with_the_pace_that_would_do(capsys: pytest.CaptureFixture[str]) -> None:
    found = document(capsys, "circle", "--vehicle", "bundled", "--time-scale", "4", code=3)
    assert found["refused"] is True
    checked = found["files"][0]
    assert {"speed", "acceleration"} <= {problem["name"] for problem in checked["problems"]}
    passing = checked["time_scale_that_passes"]
    assert 1.0 < passing < 4.0
    again = document(capsys, "circle", "--vehicle", "bundled", "--time-scale", f"{passing:.6f}")
    assert again["refused"] is False


@pytest.mark.usefixtures("quick")
def test_ground_and_start(capsys: pytest.CaptureFixture[str]) -> None:
    low = document(capsys, "lissajous", "--vehicle", "bundled", "--start", "0,0,-1", code=3)["files"][0]
    assert [problem["name"] for problem in low["problems"]] == ["ground"]
    assert low["height_above_home"]["value_m"] < 0.5
    assert low["start"]["position_m"] == [0.0, 0.0, -1.0]
    document(capsys, "lissajous", "--vehicle", "bundled", "--start", "0,0,-1,90", "--height-min", "-3")
    high = document(capsys, "lissajous", "--vehicle", "bundled")["files"][0]
    assert high["start"]["position_m"] == [0.0, 0.0, -5.0]


@pytest.mark.usefixtures("quick")
def test_the_headings_at_both_ends_are_a_compass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "east,north,up,yaw_deg\n0,0,5,0\n0,10,5,135\n"
    path = written(tmp_path, "wp.csv", text)
    followed = written(tmp_path, "follows.toml", commanded(load_vehicle("bundled")))
    found = document(capsys, path, "--vehicle", followed)["files"][0]
    assert found["heading"] == {"start_deg": 90.0, "end_deg": 315.0, "followed": True}
    note = "yaw_deg counts from east to north in this frame: the first point's 0 is a heading of 90 deg"
    assert any(said.startswith(note) for said in found["notes"])
    assert main(["check", path, "--vehicle", followed]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  heading: 90 deg at the start, 315 deg at the end, clockwise from north" in lines
    assert any(line.startswith(f"  {note}") for line in lines)


@pytest.mark.usefixtures("quick")
def test_headings_of_a_turned_file_and_a_vehicle_that_does_not_follow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path, "wp.csv", "east,north,up,heading_deg\n0,0,5,350\n0,10,5,10\n")
    path = written(tmp_path, "turned.toml", 'file = "wp.csv"\nanchor_yaw_deg = 9.99\n')
    found = document(capsys, path, "--vehicle", "bundled")["files"][0]
    assert found["heading"] == {"start_deg": pytest.approx(359.99), "end_deg": pytest.approx(19.99), "followed": False}
    assert main(["check", path, "--vehicle", "bundled"]) == 0
    said = "heading: 0 deg at the start, 20 deg at the end, clockwise from north"
    assert f"  {said}; not followed: this vehicle chooses its own" in capsys.readouterr().out.splitlines()


def test_a_compass_never_says_360() -> None:
    degrees = (0.0, -1e-9, 359.9999999, 360.0, -90.0, 725.0)
    assert [compass_deg(math.radians(x)) for x in degrees] == [0.0, 0.0, 0.0, 0.0, 270.0, 5.0]


@pytest.mark.usefixtures("quick")
def test_a_fence_from_another_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fence = str(DATA / "square.plan")
    inside = document(capsys, "circle", "--vehicle", "bundled", "--fence", fence)["files"][0]
    assert inside["fence_margin"]["value_m"] == pytest.approx(10.0, abs=0.05)  # 10 m to the south, of 20
    outside = document(capsys, "circle", "--vehicle", "bundled", "--fence", fence, "--start", "-15,0,-5", code=3)
    assert [problem["name"] for problem in outside["files"][0]["problems"]] == ["fence"]


def east_of(distance_m: float, delay_s: float = 0.0) -> Any:
    def at(t: float) -> Reference:
        r = EIGHT.at(t - delay_s)
        return r._replace(p=(r.p[0], r.p[1] + distance_m, r.p[2]))

    return at


@pytest.mark.usefixtures("quick")
def test_several_files_keep_their_distance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = written(tmp_path, "one.csv", mavsdk(EIGHT.at, 31.5, 10.0))
    two = written(tmp_path, "two.csv", skybrush(east_of(4.0), 31.5, 4.0))
    three = written(tmp_path, "three.csv", mavsdk(east_of(-0.6), 31.5, 10.0))
    apart = document(capsys, one, two, "--vehicle", "paper")["separation"]
    assert apart["value_m"] == pytest.approx(4.0, abs=2e-3)
    assert apart["files"] == ["one", "two"]
    near = document(capsys, one, two, three, "--vehicle", "paper", code=3)
    assert near["separation"]["files"] == ["one", "three"]
    assert near["separation"]["value_m"] == pytest.approx(0.6, abs=1e-3)
    assert near["refused"] is True
    assert all(entry["problems"] == [] for entry in near["files"])
    document(capsys, one, three, "--vehicle", "paper", "--separation", "0.5")


def test_separation_of_paths_that_cross_at_another_time() -> None:
    there = Trajectory(name="a", shape=Circle(radius_m=5.0, angular_rate_rad_s=0.5), duration_s=10.0)
    opposite = Trajectory(
        name="b", shape=Circle(radius_m=5.0, angular_rate_rad_s=0.5, phase_rad=math.pi), duration_s=10.0
    )
    found = separation([anchored(t, ZERO, ZERO) for t in (there, opposite)])
    assert found is not None
    # Both begin at the hold point, so the circles lie beside each other.
    assert found[0].value_m == pytest.approx(0.0, abs=1e-9)
    local = [anchored(_local(t), ZERO, ZERO) for t in (there, opposite)]
    found = separation(local)
    assert found is not None
    assert found[0].value_m == pytest.approx(10.0, abs=1e-6)
    assert separation(local[:1]) is None


def _local(trajectory: Trajectory) -> Trajectory:
    return Trajectory(name=trajectory.name, shape=trajectory.shape, duration_s=10.0, anchor="local")


def test_the_table_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(DATA / "eight-mavsdk.csv"), "--vehicle", "paper"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "eight-mavsdk on paper: 30.00 s, anchor here"
    assert lines[-1] == "verdict: can be flown"
    text = "\n".join(lines)
    for part in (
        "301 samples at 10 Hz became a spline of degree 9",
        "  speed                      1.41 m/s",
        "predicted, first 15 s",
        "fourth derivative: continuous",
        "start: 1 m/s",
        "lowest above home: 5.00 m",
        "from above, north up: 5 m east-west, 10 m north-south",
    ):
        assert part in text, text
    assert any(0x2800 < ord(character) < 0x2900 for character in text)
    assert max(map(len, lines)) < 160


@pytest.mark.usefixtures("quick")
def test_a_refusal_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "circle", "--vehicle", "bundled", "--time-scale", "4"]) == 3
    out = capsys.readouterr().out
    assert "refused: speed reaches 10 m/s at " in out
    assert "the limits are kept up to a time scale of 2." in out
    assert out.rstrip().endswith("verdict: must not be flown")


@pytest.mark.usefixtures("quick")
def test_the_prediction_can_refuse(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(*_: object) -> None:
        raise RefusedError("it is predicted to leave its limits")

    monkeypatch.setattr(predict, "gate_prediction", refuse)
    problems = document(capsys, "circle", "--vehicle", "bundled", code=3)["files"][0]["problems"]
    assert problems == [{"name": "predicted", "at_s": None, "sentence": "it is predicted to leave its limits"}]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["nothing", "--vehicle", "paper"], "no trajectory file 'nothing'"),
        (["circle"], "Missing option '--vehicle'"),
        (["circle", "--vehicle", "nothing"], "no vehicle file 'nothing'"),
        (["circle", "--vehicle", "paper", "--start", "1,2"], "--start '1,2': expected north,east,down"),
        (["circle", "--vehicle", "paper", "--start", "1,2,nan"], "position_m.2 = nan"),
        (["circle", "--vehicle", "paper", "--frame", "enu"], "--frame is for other programs' files"),
        (["circle", "--vehicle", "paper", "--height-min", "nan"], "--height-min nan"),
        (["circle", "--vehicle", "paper", "--fence", "nothing.plan"], "nothing.plan: cannot be read"),
        (["circle", "--vehicle", "paper", "--time-scale", "0"], "time scale 0.0"),
        ([str(DATA / "eight-rpg.csv"), "--vehicle", "paper"], "declare it with --frame"),
    ],
)
def test_bad_input(capsys: pytest.CaptureFixture[str], arguments: list[str], part: str) -> None:
    assert main(["check", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert part in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.usefixtures("quick")
def test_json_stands_alone_even_when_a_figure_is_infinite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Free fall has no thrust direction: rates are infinite, which JSON does not know.
    text = 'shape = "lissajous"\nduration_s = 10\n[lissajous]\namplitude_m = [0, 0, 9.81]\n'
    text += "angular_rate_rad_s = [0, 0, 1]\n"
    found = document(capsys, written(tmp_path, "fall.toml", text), "--vehicle", "bundled", code=3)
    assert found["files"][0]["problems"]


def test_the_options_of_fly_and_simulate_know_the_formats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(DATA / "eight-rpg.csv", tmp_path / "a.csv")
    path = str(tmp_path / "a.csv")
    assert main(["simulate", "eight", "--trajectory", path]) == 2
    assert "declare it with --frame" in capsys.readouterr().err
    assert main(["simulate", "eight", "--trajectory", path, "--frame", "enu", "--time-scale", "9"]) == 3
    assert "speed reaches" in capsys.readouterr().err
    assert main(["fly", path, "--frame", "enu", "--vehicle", "bundled", "--time-scale", "9", "--sim"]) == 3
    assert main(["demo", "--flight", "eight", "--trajectory", path, "--frame", "enu", "--time-scale", "9"]) == 3
    assert main(["certify", "eight", "--trajectory", path, "--frame", "enu", "--time-scale", "9"]) == 3


def test_a_sketch_has_its_points_where_they_belong() -> None:
    lines = sketch([0.0, 1.0], [0.0, 1.0], columns=2, rows=1, same_scale=False)
    # Lower left and upper right of 4 x 4 dots.
    assert lines == [chr(0x2800 + 0x40) + chr(0x2800 + 0x08)]
    assert sketch([0.0, 1.0], [0.0, 1.0], columns=2, rows=1, same_scale=False, plain=True) == ["**"]
    tall = sketch([0.0, 0.0], [0.0, 10.0], columns=10, rows=3, same_scale=True)
    assert len(tall) == 3
    assert sketch([1.0], [1.0], columns=5, rows=3, same_scale=True) == [chr(0x2800 + 0x40)]
    square = sketch([0, 10, 10, 0], [0, 0, 10, 10], columns=20, rows=5, same_scale=True)
    assert len(square) == 5
    assert max(map(len, square)) == 10


def test_check_of_several_formats_declares_the_frame_where_it_is_open() -> None:
    assert [check._takes_frame(name) for name in ("circle", "a.toml", "a.csv", "b.TXT")] == [False, False, True, True]
    assert load(DATA / "eight-rpg.csv", frame="enu").name == "eight-rpg"
