"""Other programs' files wherever a trajectory is named: in flight files, in tables, and in the folder of a flight."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from format_cases import DATA, EIGHT, mavsdk, place
from pymavlink.dialects.v20 import common as mavlink

from companion.cli.common import adjustments, trajectory_changes
from companion.config import build_flight, load_flight, load_vehicle, read_toml
from companion.control.types import Vec3
from companion.errors import InputError, RefusedError
from companion.flight import launch
from companion.flight.course import Course
from companion.flight.inspection import reference_problems
from companion.flight.phases import Autopilot
from companion.flight.preflight import gate_place, gate_reference
from companion.flight.reports import take_report
from companion.flight.surroundings import gate_course
from companion.frames import GeoPoint
from companion.link.framing import Frame
from companion.record.folder import CONFIGURATION_FILE, create_flight_folder, write_configuration
from companion.trajectory.anchored import Trajectory
from companion.trajectory.fence import Fence, Polygon
from companion.trajectory.load import embedded, load, of_flight, stored
from companion.trajectory.shapes import Hover, Lissajous

FLIGHT = 'name = "mine"\nvehicle = "bundled"\n'


def a_flight(folder: Path, trajectory: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(FLIGHT + trajectory)
    return path


@pytest.fixture
def lap(tmp_path: Path) -> Path:
    path = tmp_path / "flights" / "lap.csv"
    path.parent.mkdir()
    shutil.copy(DATA / "eight-mavsdk.csv", path)
    return path


@pytest.mark.parametrize(
    "trajectory",
    ['trajectory = "lap.csv"\n', '[trajectory]\nname = "lap"\nfile = "lap.csv"\n', 'trajectory = "wrap.toml"\n'],
)
def test_a_flight_file_names_a_file_beside_it(lap: Path, monkeypatch: pytest.MonkeyPatch, trajectory: str) -> None:
    monkeypatch.chdir("/")
    (lap.parent / "wrap.toml").write_text('file = "lap.csv"\n')
    flight = load_flight(str(a_flight(lap.parent, trajectory)))
    assert of_flight(flight).at(3.0).p == pytest.approx(EIGHT.at(3.0).p, abs=1e-5)
    table = embedded(flight, 0.5).trajectory
    assert isinstance(table, dict)
    assert table["file"] == str(lap)
    assert len(table["sha256"]) == 64
    assert of_flight(embedded(flight, 0.5)).duration_s == pytest.approx(60.0)


def test_a_flights_folder_holds_all_that_was_flown(lap: Path, tmp_path: Path) -> None:
    flight = embedded(load_flight(str(a_flight(lap.parent, 'trajectory = "lap.csv"\n'))))
    folder = create_flight_folder("x", tmp_path / "out")
    write_configuration(folder, stored(flight, folder).model_dump(exclude_none=True))
    lap.unlink()
    moved = tmp_path / "elsewhere"
    folder.rename(moved)
    configuration = moved / CONFIGURATION_FILE
    again = build_flight(read_toml(configuration), str(configuration))
    assert (moved / "trajectory.csv").read_bytes() == (DATA / "eight-mavsdk.csv").read_bytes()
    assert 'file = "trajectory.csv"' in configuration.read_text()
    assert of_flight(again).name == "lap"
    assert of_flight(again).at(3.0).p == pytest.approx(EIGHT.at(3.0).p, abs=1e-5)


def test_a_file_that_changes_meanwhile_is_not_flown(lap: Path, tmp_path: Path) -> None:
    flight = embedded(load_flight(str(a_flight(lap.parent, 'trajectory = "lap.csv"\n'))))
    lap.write_text(mavsdk(EIGHT.at, 5.0, 10.0))
    with pytest.raises(InputError, match=r"lap\.csv: is not the file any more"):
        of_flight(flight)
    with pytest.raises(InputError, match=r"lap\.csv: is not the file any more"):
        stored(flight, tmp_path)


def test_prepare_checks_and_stores(lap: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "gate_prediction", lambda *_: None)  # its own test flies it
    flight = embedded(load_flight(str(a_flight(lap.parent, 'trajectory = "lap.csv"\n'))), 2.0)
    folder = launch.prepare(flight, tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == ["flight.toml", "trajectory.csv"]
    with pytest.raises(RefusedError, match="speed reaches"):
        launch.prepare(embedded(flight, 9.0), tmp_path / "fast")
    assert not (tmp_path / "fast").exists()


def test_text_instead_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("text = '''\n" + mavsdk(EIGHT.at, 5.0, 10.0) + "'''\n")
    assert load(tmp_path / "a.toml").duration_s == pytest.approx(5.0)


def test_options_of_the_command_line(lap: Path) -> None:
    changes = adjustments(**trajectory_changes(str(lap), "ned"))
    flight = load_flight("eight", changes)
    assert of_flight(flight).name == "lap"
    with pytest.raises(InputError, match="--frame 'flu': allowed are ned"):
        trajectory_changes(str(lap), "flu")
    with pytest.raises(InputError, match="add that"):
        trajectory_changes(None, "enu")
    with pytest.raises(InputError, match="--frame is for other programs' files"):
        trajectory_changes("circle", "enu")
    assert trajectory_changes(None, None) == {}


def test_paths_through_points_are_planned_for_the_flights_vehicle(tmp_path: Path) -> None:
    shutil.copy(DATA / "square.plan", tmp_path / "square.plan")
    flight = load_flight(str(a_flight(tmp_path, 'trajectory = "square.plan"\n')))
    trajectory = of_flight(flight)
    assert reference_problems(trajectory, flight.vehicle) == []
    gate_reference(trajectory, flight.vehicle)
    gate_place(trajectory, flight.height_min_m)


def hovering(height_m: float, **changes: object) -> Trajectory:
    shape = Hover(point_m=(0.0, 0.0, -height_m))
    return Trajectory(name="h", shape=shape, duration_s=5.0, anchor="home", **changes)  # type: ignore[arg-type]


def test_the_ground_is_kept_away_from() -> None:
    gate_place(hovering(0.6), 0.5)
    with pytest.raises(RefusedError, match=r"height above home falls to 0\.40 m at .* at least 0\.5 m are required"):
        gate_place(hovering(0.4), 0.5)
    gate_place(hovering(-30.0), -40.0)

    # In the air, against the home that the vehicle has told.
    def looked_at(height_m: float, origin: Vec3, home: Vec3 | None) -> None:
        hold = (0.0, 0.0, -1.0)
        gate_course(Course(hovering(height_m), load_vehicle("bundled"), hold, 0.0, home, 0.5, origin=origin))

    low = (0.0, 0.0, 1.0)
    looked_at(3.0, low, low)
    looked_at(3.0, low, None)
    with pytest.raises(RefusedError, match=r"it falls to -0\.50 m above home"):
        looked_at(-0.5, low, low)
    # places on the Earth count from elsewhere: the ground is that of home, and of where they were planned from
    with pytest.raises(RefusedError, match=r"it falls to -4\.00 m above home"):
        looked_at(3.0, low, (0.0, 0.0, -6.0))
    with pytest.raises(RefusedError, match=r"it falls to 0\.30 m above the home that it was planned from"):
        looked_at(0.3, low, (0.0, 0.0, 6.0))


def test_the_fence_is_a_gate() -> None:
    fence = Fence((Polygon(((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)), inclusion=False),))
    with pytest.raises(RefusedError, match=r"leaves the fence by 1\.00 m"):
        gate_place(hovering(5.0, fence=fence), 0.5)


def test_a_torque_that_the_rotors_do_not_have_is_refused() -> None:
    flight = build_flight({"name": "x", "vehicle": "bundled", "trajectory": "hover"}, "test")
    # 1.5 cm at 15 rad/s: tilted by 0.33 rad at most and turning at 5 rad/s, but at 66 rad/s^2.
    shape = Lissajous(center_m=(0.0, 0.0, -5.0), amplitude_m=(0.015, 0.0, 0.0), angular_rate_rad_s=(15.0, 0.0, 0.0))
    trajectory = Trajectory(name="shaking", shape=shape, duration_s=5.0, anchor="local")
    (problem,) = reference_problems(trajectory, flight.vehicle)
    assert problem.name == "torque"
    with pytest.raises(RefusedError, match=r"torque reaches 1\.\d+ N m at .* s, the rotors have 1\.\d+ N m there"):
        gate_reference(trajectory, flight.vehicle)
    gate_reference(Trajectory(name="slower", shape=shape, duration_s=5.0, time_scale=0.9), flight.vehicle)


def test_where_home_is_on_the_earth_is_heard() -> None:
    def heard(latitude: int, longitude: int) -> GeoPoint | None:
        message = mavlink.MAVLink_home_position_message(
            latitude, longitude, 488_000, 1.0, 2.0, -3.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
        )
        raw = bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
        autopilot = Autopilot()
        take_report(autopilot, Frame(message.get_msgId(), 1, 1, 0, raw[10:-2], raw, 0))
        assert autopilot.home == (1.0, 2.0, -3.0)
        return autopilot.home_global

    latitude, longitude = place(0.0, 0.0)
    found = heard(round(latitude * 1e7), round(longitude * 1e7))
    assert found == pytest.approx((latitude, longitude, 488.0), abs=1e-6)
    assert heard(0, 0) is None


def test_the_numbers_are_the_same_in_the_other_process(lap: Path, tmp_path: Path) -> None:
    flight = embedded(load_flight(str(a_flight(lap.parent, 'trajectory = "lap.csv"\n'))))
    folder = create_flight_folder("x", tmp_path / "out")
    write_configuration(folder, stored(flight, folder).model_dump(exclude_none=True))
    configuration = folder / CONFIGURATION_FILE
    again = build_flight(read_toml(configuration), str(configuration))
    for t in (0.0, math.pi, 29.0):
        assert of_flight(again).at(t) == of_flight(flight).at(t)
