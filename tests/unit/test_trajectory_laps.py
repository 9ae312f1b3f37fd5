"""Laps of paths that come from files: the way back is smooth and within the limits, a closed path needs none."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from format_cases import DATA

from companion.config import Vehicle, load_vehicle
from companion.errors import InputError
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.feasibility import check
from companion.trajectory.laps import repeated
from companion.trajectory.load import load
from companion.trajectory.shapes import Circle, Heading
from companion.trajectory.vehicle_limits import point_mass, reference_limits
from companion.trajectory.waypoints import plan_limits

POINTS = """shape = "waypoints"
anchor = "local"
laps = {laps}
[heading]
along_path = false
[[waypoint]]
p_m = [0.0, 0.0, -10.0]
[[waypoint]]
p_m = [6.0, 2.0, -11.0]
[[waypoint]]
p_m = [{end}]
"""


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("bundled")


def points(folder: Path, vehicle: Vehicle, end: str, laps: int, scale: float | None = None) -> Trajectory:
    path = folder / "points.toml"
    path.write_text(POINTS.format(laps=laps, end=end))
    return load(path, scale, vehicle=vehicle)


def near(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a == pytest.approx(b, abs=1e-6)


@pytest.mark.parametrize("scale", [None, 0.7, 1.4])
def test_an_open_path_gets_a_way_back(tmp_path: Path, vehicle: Vehicle, scale: float | None) -> None:
    once = points(tmp_path, vehicle, "8.0, -3.0, -12.0", 1, scale)
    thrice = points(tmp_path, vehicle, "8.0, -3.0, -12.0", 3, scale)
    back_s = (thrice.duration_s - 3.0 * once.duration_s) / 2.0
    assert back_s > 1.0
    lap_s = once.duration_s + back_s
    for number in range(3):
        for t_s in (0.0, 0.3 * once.duration_s, 0.999999 * once.duration_s):
            assert near(thrice.at(number * lap_s + t_s).p, once.at(t_s).p)
    path = anchored(thrice, (0.0, 0.0, 0.0), None)
    limits, model = reference_limits(vehicle), point_mass(vehicle)
    if scale != 1.4:  # the path itself uses its limits up: it is not flown faster
        assert check(path, limits, model) == []
    joints = [joint for joint in thrice.joints() if joint.at_s > once.duration_s - 1e-6]
    for _, before, after in joints:
        assert all(near(x, y) for x, y in zip(before[:5], after[:5], strict=True))
    assert "from the end back to the start" in thrice.notes[-1]


def test_a_closed_path_is_flown_again_at_once(tmp_path: Path, vehicle: Vehicle) -> None:
    once, twice = (points(tmp_path, vehicle, "0.0, 0.0, -10.0", laps) for laps in (1, 2))
    assert twice.duration_s == pytest.approx(2.0 * once.duration_s, rel=1e-12)
    assert near(twice.at(once.duration_s + 1.0).p, once.at(1.0).p)
    assert twice.notes[-1] == "2 laps, closed"


@pytest.mark.parametrize("turns", [1, -2])
def test_a_closed_path_whose_heading_made_whole_turns_is_closed(vehicle: Vehicle, turns: int) -> None:
    lap_s = 4.0 * math.pi
    circle = Circle(radius_m=5.0, angular_rate_rad_s=0.5, heading=Heading(0.3, turns * 0.5))
    limits, model = reference_limits(vehicle), point_mass(vehicle)
    thrice = repeated(circle, lap_s, 3, plan_limits(vehicle))
    assert thrice.back_s == 0.0 and thrice.own_duration_s == pytest.approx(3.0 * lap_s, rel=1e-12)
    for t_s in (0.0, 0.4 * lap_s, lap_s - 1e-6, lap_s, 1.5 * lap_s, 2.0 * lap_s, 3.0 * lap_s):
        assert near(thrice.at(t_s).p, circle.at(t_s).p)
        assert math.remainder(thrice.at(t_s).yaw - circle.at(t_s).yaw, math.tau) == pytest.approx(0.0, abs=1e-9)
    path = anchored(Trajectory(name="thrice", shape=thrice, duration_s=thrice.own_duration_s), (0.0, 0.0, 0.0), None)
    assert check(path, limits, model) == []


def test_laps_of_another_programs_file(tmp_path: Path, vehicle: Vehicle) -> None:
    """It ends while it moves; the way back begins and ends in flight."""
    shutil.copy(DATA / "eight-rpg.csv", tmp_path / "eight.csv")
    wrapping = tmp_path / "wrap.toml"
    wrapping.write_text('file = "eight.csv"\nframe = "enu"\nlaps = 2\n')
    once, twice = load(tmp_path / "eight.csv", frame="enu"), load(wrapping, vehicle=vehicle)
    assert twice.duration_s > 2.0 * once.duration_s
    start_s = twice.duration_s - once.duration_s
    assert near(twice.at(start_s).v, once.at(0.0).v)
    assert near(twice.at(start_s + 20.0).p, once.at(20.0).p)
    with pytest.raises(InputError, match="laps = 2: the way back takes a vehicle's limits"):
        load(wrapping)


@pytest.mark.parametrize("laps", ["0", "1001", "1.5", '"two"'])
def test_laps_that_make_no_sense(tmp_path: Path, vehicle: Vehicle, laps: str) -> None:
    path = tmp_path / "points.toml"
    path.write_text(POINTS.format(laps=laps, end="0.0, 0.0, -10.0"))
    with pytest.raises(InputError, match="laps"):
        load(path, vehicle=vehicle)
