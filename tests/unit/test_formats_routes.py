"""Files of points: waypoints and missions become paths through them, where they belong on the Earth."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from format_cases import DATA, FENCE, HOME, SQUARE, item, place, plan, wpl

from companion.config import Vehicle, load_vehicle
from companion.control.types import Vec3
from companion.errors import InputError, RefusedError
from companion.flight.inspection import reference_problems
from companion.flight.surroundings import place_problems
from companion.frames import GeoPoint, ned_from_geo
from companion.trajectory.anchored import Origin, Trajectory, anchored
from companion.trajectory.earth import counts_from
from companion.trajectory.formats import read, read_fence
from companion.trajectory.formats.contents import Route
from companion.trajectory.load import load
from companion.trajectory.shapes import Hover

ORIGIN = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("bundled")


def saved(folder: Path, mission: dict[str, Any], name: str = "a.plan") -> Path:
    path = folder / name
    path.write_text(json.dumps(mission), encoding="utf-8")
    return path


def points_of(path: Path) -> Route:
    content = read(path)
    assert isinstance(content, Route)
    return content


def passes(trajectory: Trajectory, point: Vec3) -> float:
    """Nearest that a trajectory comes to a point [m], looked for on a grid and then around the best instant."""
    times = [trajectory.duration_s * i / 4000 for i in range(4001)]
    best = min(times, key=lambda t: math.dist(trajectory.at(t).p, point))
    step = trajectory.duration_s / 4000
    around = [best + step * (i / 200 - 1.0) for i in range(401)]
    return min(math.dist(trajectory.at(min(max(t, 0.0), trajectory.duration_s)).p, point) for t in around)


@pytest.mark.parametrize(
    ("name", "frame", "tolerance"),
    [("square.csv", "enu", 1e-3), ("square.plan", None, 5e-3), ("square.waypoints", None, 5e-3)],
)
def test_the_path_goes_through_the_points_from_rest_to_rest(
    vehicle: Vehicle, name: str, frame: Any, tolerance: float
) -> None:
    trajectory = load(DATA / name, vehicle=vehicle, frame=frame)
    for north, east, up in SQUARE:
        assert passes(trajectory, (north, east, -up)) < tolerance
    for t in (0.0, trajectory.duration_s):
        assert all(math.hypot(*trajectory.at(t)[k]) < 1e-6 for k in range(1, 5))  # type: ignore[misc]
    assert reference_problems(trajectory, vehicle) == []


def test_points_need_a_vehicle() -> None:
    with pytest.raises(InputError, match="name a vehicle"):
        load(DATA / "square.plan")


def test_the_hover_speed_of_a_plan_is_kept(vehicle: Vehicle) -> None:
    trajectory = load(DATA / "square.plan", vehicle=vehicle)
    speeds = [math.hypot(*trajectory.at(trajectory.duration_s * i / 2000).v) for i in range(2001)]
    assert 3.0 < max(speeds) < 5.0 + 1e-6


def test_the_wait_of_a_waypoint_is_kept(vehicle: Vehicle) -> None:
    trajectory = load(DATA / "square.plan", vehicle=vehicle)
    north, east, up = SQUARE[2]
    times = [trajectory.duration_s * i / 4000 for i in range(1, 4000)]
    there = [t for t in times if trajectory.at(t).v == ORIGIN]
    assert there[-1] - there[0] == pytest.approx(2.0, abs=0.03)
    assert all(trajectory.at(t).p == pytest.approx((north, east, -up), abs=5e-3) for t in there)


def test_the_slowest_commanded_speed_is_kept(tmp_path: Path) -> None:
    mission = plan()
    mission["mission"]["items"].insert(2, item(178, [1, 2.0, -1, 0, 0, 0, 0], frame=2))  # type: ignore[index]
    route = points_of(saved(tmp_path, mission))
    assert route.speed_max_m_s == 2.0
    assert any("slowest speed" in note for note in route.notes)


def test_what_a_mission_asks_beside_flying_is_named(vehicle: Vehicle) -> None:
    notes = load(DATA / "square.plan", vehicle=vehicle).notes
    assert any("530 (1 x)" in note for note in notes)
    assert any("RTL" in note for note in notes)


def test_a_landing_ends_above_it(tmp_path: Path) -> None:
    mission = plan()
    mission["mission"]["items"][-1] = item(21, [0, 0, 0, None, *place(-10.0, 5.0), 0.0])  # type: ignore[index]
    route = points_of(saved(tmp_path, mission))
    assert route.legs[-1].waypoint.p_m == pytest.approx((-10.0, 5.0, -SQUARE[-1][2]), abs=1e-4)
    assert any("landing is not part" in note for note in route.notes)


def test_a_survey_brings_its_own_items(tmp_path: Path) -> None:
    mission = plan()
    inner = [item(16, [0, 0, 0, None, *place(40.0, east), 10.0]) for east in (0.0, 5.0)]
    survey = {"type": "ComplexItem", "complexItemType": "survey", "TransectStyleComplexItem": {"Items": inner}}
    mission["mission"]["items"].insert(3, survey)  # type: ignore[index]
    points = [leg.waypoint.p_m for leg in points_of(saved(tmp_path, mission)).legs]
    assert points[2] == pytest.approx((40.0, 0.0, -10.0), abs=1e-4)
    assert points[3] == pytest.approx((40.0, 5.0, -10.0), abs=1e-4)


def test_altitudes_above_the_sea(tmp_path: Path) -> None:
    mission = plan()
    for entry in mission["mission"]["items"]:  # type: ignore[index]
        if entry["command"] in (16, 22):
            entry["frame"] = 0
            entry["params"][6] += HOME[2]
    route = points_of(saved(tmp_path, mission))
    assert route.legs[0].waypoint.p_m == pytest.approx((0.0, 0.0, -10.0), abs=1e-6)
    assert route.origin is not None
    assert not route.altitude_above_home
    origin = Origin(route.origin, route.altitude_above_home)
    trajectory = Trajectory(name="a", shape=Hover(), duration_s=1.0, anchor="home", origin=origin)
    # The vehicle's home is 3 m higher than the one that was planned with.
    home = counts_from(trajectory, (0.0, 0.0, 1.0), GeoPoint(HOME[0], HOME[1], HOME[2] + 3.0))
    assert home == pytest.approx((0.0, 0.0, 4.0), abs=1e-9)


def test_a_mission_is_flown_where_it_was_planned(vehicle: Vehicle) -> None:
    trajectory = load(DATA / "square.plan", vehicle=vehicle)
    assert trajectory.anchor == "home"
    # The vehicle stands 40 m north and 30 m west of the planned home; its local frame begins elsewhere again.
    latitude, longitude = place(40.0, -30.0)
    home = counts_from(trajectory, (7.0, 8.0, -1.0), GeoPoint(latitude, longitude, 500.0))
    assert home == pytest.approx((7.0 - 40.0, 8.0 + 30.0, -1.0), abs=0.01)
    path = anchored(trajectory, ORIGIN, home)
    assert path.at(0.0).p == pytest.approx((-33.0, 38.0, -11.0), abs=0.02)


def test_a_mission_of_another_field_is_refused(vehicle: Vehicle) -> None:
    trajectory = load(DATA / "square.plan", vehicle=vehicle)
    with pytest.raises(RefusedError, match=r"planned 5\.0 km away"):
        counts_from(trajectory, ORIGIN, GeoPoint(*place(5000.0, 0.0), 500.0))
    with pytest.raises(RefusedError, match="has not told where on the Earth"):
        counts_from(trajectory, ORIGIN, None)


def test_the_projection_is_the_inverse_of_walking_a_great_circle() -> None:
    origin = GeoPoint(*HOME)
    for north, east in ((0.0, 0.0), (0.001, 0.0), (-30.0, 80.0), (900.0, -1200.0), (-4000.0, -9000.0)):
        latitude, longitude = place(north, east)
        found = ned_from_geo(GeoPoint(latitude, longitude, HOME[2] + 5.0), origin)
        assert found == pytest.approx((north, east, -5.0), abs=1e-6)


def test_coordinates_from_another_origin(tmp_path: Path, vehicle: Vehicle) -> None:
    latitude, longitude = place(100.0, 50.0)
    (tmp_path / "a.plan").write_text((DATA / "square.plan").read_text())
    (tmp_path / "a.toml").write_text(f'file = "a.plan"\nanchor = "local"\norigin = [{latitude}, {longitude}, 488.0]\n')
    trajectory = load(tmp_path / "a.toml", vehicle=vehicle)
    assert trajectory.at(0.0).p == pytest.approx((-100.0, -50.0, -10.0), abs=0.01)
    assert trajectory.fence is not None
    corner = np.array([[-100.0 + FENCE[0][0], -50.0 + FENCE[0][1]]])
    assert abs(trajectory.fence.margins(corner)[0]) < 0.05


def test_the_fence_comes_with_the_plan(vehicle: Vehicle) -> None:
    trajectory = load(DATA / "square.plan", vehicle=vehicle)
    fence = trajectory.fence
    assert fence is not None
    points = np.array([[0.0, 0.0], [-25.0, 0.0], [15.0, 45.0], [15.0, 38.0], [59.0, 0.0]])
    # From the nearest side of the rectangle, or of the circle of 5 m around (15, 45) that is to be kept out of.
    assert fence.margins(points) == pytest.approx([20.0, -5.0, -5.0, 2.0, 1.0], abs=0.01)
    ground, nearest, problems = place_problems(anchored(trajectory, ORIGIN, ORIGIN), None, 0.5)
    assert ground is not None
    heights = [-trajectory.at(trajectory.duration_s * i / 2000).p[2] for i in range(2001)]
    assert ground.value_m == pytest.approx(min(heights), abs=0.01)
    assert nearest is not None
    assert 10.0 < nearest.value_m < 20.1
    assert problems == []


def test_a_path_that_leaves_its_fence_is_refused(tmp_path: Path, vehicle: Vehicle) -> None:
    mission = plan()
    corners = [list(place(north, east)) for north, east in ((-5.0, -5.0), (25.0, -5.0), (25.0, 30.0), (-5.0, 30.0))]
    mission["geoFence"]["polygons"][0]["polygon"] = corners  # type: ignore[index]
    path = anchored(load(saved(tmp_path, mission), vehicle=vehicle), ORIGIN, ORIGIN)
    _, nearest, problems = place_problems(path, None, 0.5)
    assert nearest is not None
    assert nearest.value_m < -4.9
    assert [problem.name for problem in problems] == ["fence"]


def test_a_fence_alone(tmp_path: Path) -> None:
    mission = plan()
    mission["mission"]["items"] = []  # type: ignore[index]
    assert read_fence(saved(tmp_path, mission)).margins(np.array([[0.0, 0.0]]))[0] == pytest.approx(20.0, abs=0.01)
    with pytest.raises(InputError, match="has no waypoints"):
        load(tmp_path / "a.plan", vehicle=load_vehicle("bundled"))
    with pytest.raises(InputError, match="no geofence"):
        read_fence(DATA / "square.csv")


def test_fence_items_of_a_text_mission(tmp_path: Path) -> None:
    lines = wpl().splitlines()[:2]
    for index, corner in enumerate(FENCE):
        latitude, longitude = place(*corner)
        lines.append(f"{index + 1}\t0\t3\t5001\t4\t0\t0\t0\t{latitude:.8f}\t{longitude:.8f}\t0\t1")
    latitude, longitude = place(15.0, 45.0)
    lines.append(f"5\t0\t3\t5004\t5\t0\t0\t0\t{latitude:.8f}\t{longitude:.8f}\t0\t1")
    (tmp_path / "fence.waypoints").write_text("\n".join(lines))
    points = np.array([[0.0, 0.0], [15.0, 45.0]])
    assert read_fence(tmp_path / "fence.waypoints").margins(points) == pytest.approx([20.0, -5.0], abs=0.01)


def absolute(home: str) -> str:
    """A text mission with altitudes above sea level, whose first waypoint is the current one."""
    lines = ["QGC WPL 110", home] if home else ["QGC WPL 110"]
    for index, (north, east, up) in enumerate(SQUARE, start=len(lines) - 1):
        latitude, longitude = place(north, east)
        current = int(len(lines) == 1)
        lines.append(f"{index}\t{current}\t0\t16\t0\t0\t0\t0\t{latitude:.8f}\t{longitude:.8f}\t{500.0 + up:.6f}\t1")
    return "\n".join(lines) + "\n"


def test_what_is_taken_for_home_is_said(tmp_path: Path, vehicle: Vehicle) -> None:
    path = tmp_path / "a.waypoints"
    path.write_text(absolute(home=""))
    note = "item 0 (47.39774, 8.54559, 510 m) is taken for the home position, not flown"
    route = points_of(path)
    assert route.notes[0] == note
    assert len(route.legs) == len(SQUARE) - 1
    assert note in load(path, vehicle=vehicle).notes
    # With the line that is missing, or with a first waypoint that is not the current one, all points are flown.
    path.write_text(absolute(home=f"0\t1\t0\t16\t0\t0\t0\t0\t{HOME[0]:.8f}\t{HOME[1]:.8f}\t488.25\t1"))
    route = points_of(path)
    assert route.notes[0] == "item 0 (47.39774, 8.54559, 488.25 m) is taken for the home position, not flown"
    assert len(route.legs) == len(SQUARE)
    path.write_text(absolute(home="").replace("0\t1\t0\t16", "0\t0\t0\t16", 1))
    route = points_of(path)
    assert not any("home position" in said for said in route.notes)
    assert len(route.legs) == len(SQUARE)


def test_the_home_of_a_ground_station_is_said_too() -> None:
    assert points_of(DATA / "square.waypoints").notes[0] == (
        "item 0 (47.39774, 8.54559, 488 m) is taken for the home position, not flown"
    )


def test_a_waypoint_table_with_names(tmp_path: Path, vehicle: Vehicle) -> None:
    (tmp_path / "a.csv").write_text(
        "north,east,down,yaw_deg,speed_m_s,stop\n0,0,-5,90,0,0\n10,0,-5,90,2.0,0\n20,0,-6,180,0,1\n20,10,-6,180,0,0\n"
    )
    trajectory = load(tmp_path / "a.csv", vehicle=vehicle)
    times = [trajectory.duration_s * i / 8000 for i in range(8001)]
    at_second = min(times, key=lambda t: math.dist(trajectory.at(t).p, (10.0, 0.0, -5.0)))
    assert math.hypot(*trajectory.at(at_second).v) == pytest.approx(2.0, abs=0.02)
    at_stop = min(times, key=lambda t: math.dist(trajectory.at(t).p, (20.0, 0.0, -6.0)))
    assert math.hypot(*trajectory.at(at_stop).v) < 0.01
    assert trajectory.at(0.0).yaw == pytest.approx(math.pi / 2.0, abs=1e-6)
    assert trajectory.at(trajectory.duration_s).yaw == pytest.approx(math.pi, abs=1e-6)


POINTS = {
    # Two points, the second 10 m north of the first, in each frame.
    "ned": ("x,y,z", "0,0,-5", "10,0,-5"),
    "enu": ("x,y,z", "0,0,5", "0,10,5"),
    "nwu": ("x,y,z", "0,0,5", "10,0,5"),
}
NAMED = {"ned": "north,east,down", "enu": "east,north,up", "nwu": "north,west,up"}


def headed(folder: Path, frame: str, column: str, first: float, last: float, *, named: bool = False) -> Path:
    """A waypoint file with a column of headings."""
    axes, one, other = POINTS[frame]
    path = folder / "wp.csv"
    path.write_text(f"{NAMED[frame] if named else axes},{column}\n{one},{first}\n{other},{last}\n")
    return path


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("frame", "turn", "first", "heading"),
    [
        ("enu", "from east to north", 0.0, 90.0),
        ("enu", "from east to north", 90.0, 0.0),
        ("enu", "from east to north", 12.5, 77.5),
        ("nwu", "from north to west", 90.0, 270.0),
        ("nwu", "from north to west", -30.0, 30.0),
        ("ned", None, 90.0, 90.0),
    ],
)
def test_yaw_turns_with_the_frame_and_a_note_says_so(
    tmp_path: Path, vehicle: Vehicle, frame: Any, turn: str | None, first: float, heading: float, named: bool
) -> None:
    path = headed(tmp_path, frame, "yaw_deg", first, first + 10.0, named=named)
    trajectory = load(path, vehicle=vehicle, frame=None if named else frame)
    assert math.remainder(trajectory.at(0.0).yaw - math.radians(heading), math.tau) == pytest.approx(0.0, abs=1e-9)
    notes = [note for note in trajectory.notes if "yaw_deg" in note]
    if turn is None:
        assert notes == []
    else:
        assert notes == [
            f"yaw_deg counts {turn} in this frame: the first point's {first:g} is a heading of {heading:g} deg"
            " (clockwise from north)"
        ]


@pytest.mark.parametrize("frame", ["ned", "enu", "nwu"])
def test_a_heading_column_is_a_compass_in_every_frame(tmp_path: Path, vehicle: Vehicle, frame: Any) -> None:
    trajectory = load(headed(tmp_path, frame, "heading_deg", 350, 80), vehicle=vehicle, frame=frame)
    assert math.degrees(trajectory.at(0.0).yaw) % 360.0 == pytest.approx(350.0)
    assert math.degrees(trajectory.at(trajectory.duration_s).yaw) % 360.0 == pytest.approx(80.0)
    assert trajectory.at(0.5 * trajectory.duration_s).yaw_rate > 0.0  # clockwise, by north: the shorter turn
    assert not any("yaw_deg" in note for note in trajectory.notes)


def test_points_without_headings_have_no_note_of_them(tmp_path: Path, vehicle: Vehicle) -> None:
    path = headed(tmp_path, "enu", "stop", 0, 0)
    assert not any("yaw_deg" in note for note in load(path, vehicle=vehicle, frame="enu").notes)


def test_two_columns_of_headings_are_refused(tmp_path: Path, vehicle: Vehicle) -> None:
    path = tmp_path / "wp.csv"
    path.write_text("# both\neast,north,up,yaw_deg,heading_deg\n0,0,5,0,90\n0,10,5,0,90\n")
    with pytest.raises(InputError) as caught:
        load(path, vehicle=vehicle)
    assert str(caught.value) == (
        f"{path}: line 2: has yaw_deg (from x towards y of its frame) and heading_deg (clockwise from north); keep one"
        " of the columns"
    )


def test_a_heading_beyond_belief_is_refused(tmp_path: Path, vehicle: Vehicle) -> None:
    with pytest.raises(InputError, match=r"line 2: heading_deg is 4000 deg, more than 3600 deg is not believed"):
        load(headed(tmp_path, "enu", "heading_deg", 4000, 0), vehicle=vehicle, frame="enu")


OURS = """
shape = "waypoints"
anchor = "local"
[limits]
speed_max_m_s = 1.5
wind_m_s = 1.0
[[waypoint]]
p_m = [0, 0, -5]
yaw_deg = 0
[[waypoint]]
p_m = [10, 0, -5]
hold_s = 3
[[waypoint]]
p_m = [10, 10, -5.0]
yaw_deg = 90
"""


def test_waypoints_of_our_own(tmp_path: Path, vehicle: Vehicle) -> None:
    (tmp_path / "a.toml").write_text(OURS)
    trajectory = load(tmp_path / "a.toml", vehicle=vehicle)
    times = [trajectory.duration_s * i / 3000 for i in range(3001)]
    assert max(math.hypot(*trajectory.at(t).v) for t in times) < 1.5 + 1e-6
    there = [t for t in times if math.dist(trajectory.at(t).p, (10.0, 0.0, -5.0)) < 1e-3]
    assert there[-1] - there[0] > 2.9
    assert reference_problems(trajectory, vehicle) == []
    rates = [trajectory.at(t).yaw_rate for t in times]
    assert max(rates) > 0.01
    assert math.remainder(trajectory.at(trajectory.duration_s).yaw - math.pi / 2.0, math.tau) == pytest.approx(
        0.0, abs=1e-6
    )


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("p_m = [10, 0, -5]\n", "p_m = [0, 0, -5]\n", ["waypoint.1.p_m", "the same point"]),
        ("hold_s = 3", "hold_s = -3", ["waypoint.1.hold_s = -3", "greater than or equal to 0"]),
        ("hold_s = 3", "speed_m_s = 5.0", ["waypoint.1.speed_m_s = 5.0", "faster than the limit of 1.5 m/s"]),
        ("wind_m_s = 1.0", "wind = 1.0", ["limits", "unknown key 'wind'"]),
        ("yaw_deg = 90", "yaw = 90", ["waypoint.2", "unknown key 'yaw'"]),
    ],
)
def test_wrong_waypoints_of_our_own(tmp_path: Path, vehicle: Vehicle, old: str, new: str, parts: list[str]) -> None:
    (tmp_path / "a.toml").write_text(OURS.replace(old, new))
    with pytest.raises(InputError) as caught:
        load(tmp_path / "a.toml", vehicle=vehicle)
    assert all(part in str(caught.value) for part in parts), str(caught.value)


def changed(change: Any) -> dict[str, Any]:
    mission = copy.deepcopy(plan())
    change(mission)
    return mission


PLAN_FAULTS = {
    "another type": (lambda m: m.update(fileType="Fence"), "fileType is 'Fence', expected 'Plan'"),
    "another version": (lambda m: m.update(version=2), "version is '2', expected 1"),
    "no mission": (lambda m: m.pop("mission"), "mission is missing"),
    "items as text": (lambda m: m["mission"].update(items="x"), "mission.items is not an array"),
    "no items": (lambda m: m["mission"].update(items=[]), "has no waypoints"),
    "one point": (lambda m: m["mission"].update(items=m["mission"]["items"][:1]), "only one point"),
    "six parameters": (lambda m: m["mission"]["items"][2]["params"].pop(), "items[2].params has 6 entries"),
    "text for a number": (
        lambda m: m["mission"]["items"][2]["params"].__setitem__(4, "47"),
        "items[2].params[4] is '47', not a number",
    ),
    "no position": (lambda m: m["mission"]["items"][2]["params"].__setitem__(4, None), "items[2]: has no position"),
    "no place on the Earth": (
        lambda m: m["mission"]["items"][2]["params"].__setitem__(4, 470.0),
        "is no place on the Earth",
    ),
    "far away": (lambda m: m["mission"]["items"][2]["params"].__setitem__(4, 48.4), "km from home; 20 km can be"),
    "millimetres": (lambda m: m["mission"]["items"][2]["params"].__setitem__(6, 10000.0), "altitude 10000 m"),
    "loiter": (lambda m: m["mission"]["items"][2].update(command=19), "command 19 is flown in a way"),
    "terrain": (lambda m: m["mission"]["items"][2].update(frame=10), "frame 10 is not supported"),
    "two levels": (lambda m: m["mission"]["items"][2].update(frame=0), "use one level for all"),
    "structure scan": (
        lambda m: m["mission"]["items"].insert(2, {"type": "ComplexItem", "complexItemType": "StructureScan"}),
        "items[2] is of a type that is not supported",
    ),
    "half a home": (lambda m: m["mission"].update(plannedHomePosition=[1.0, 2.0]), "latitude, longitude and altitude"),
    "a speed of 1000 m/s": (lambda m: m["mission"].update(hoverSpeed=1000.0), "1000 m/s, which is not believed"),
    "wait of a day": (lambda m: m["mission"]["items"][2]["params"].__setitem__(0, 86400), "waits for 86400 s"),
    "two corners": (lambda m: m["geoFence"]["polygons"][0].update(polygon=[[1, 2], [3, 4]]), "has 2 corners"),
    "fence without a side": (
        lambda m: m["geoFence"]["polygons"][0].pop("inclusion"),
        "inclusion must be true or false",
    ),
    "huge": (lambda m: m["mission"]["items"][2]["params"].__setitem__(4, 10**400), "must be finite"),
}


@pytest.mark.parametrize("case", PLAN_FAULTS)
def test_a_wrong_plan_is_answered_in_one_line(tmp_path: Path, vehicle: Vehicle, case: str) -> None:
    change, part = PLAN_FAULTS[case]
    path = saved(tmp_path, changed(change))
    with pytest.raises(InputError) as caught:
        load(path, vehicle=vehicle)
    message = str(caught.value)
    assert part in message, message
    assert str(path) in message
    assert "\n" not in message


WPL_FAULTS = {
    "another version": ("QGC WPL 110", "QGC WPL 120", "line 1: the first line must be QGC WPL 110"),
    "a column less": ("\t10.000000\t1\n2", "\t10.000000\n2", "line 3: 11 columns, 12 are expected"),
    "letters": ("2\t0\t3\t16", "2\t0\t3\tgo", "line 4: command is 'go', not a number"),
    "half a command": ("2\t0\t3\t16", "2\t0\t3\t16.5", "line 4: command is 16.5; it must be a whole number"),
    "loiter": ("2\t0\t3\t16", "2\t0\t3\t17", "line 4: item 2: command 17 is flown in a way"),
    "no number": ("2\t0\t3\t16\t0", "2\t0\t3\t16\tinf", "line 4: p1 is 'inf'; it must be finite"),
}


@pytest.mark.parametrize("case", WPL_FAULTS)
def test_a_wrong_text_mission_is_answered_in_one_line(tmp_path: Path, vehicle: Vehicle, case: str) -> None:
    old, new, part = WPL_FAULTS[case]
    assert old in wpl()
    path = tmp_path / "a.waypoints"
    path.write_text(wpl().replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load(path, vehicle=vehicle)
    assert part in str(caught.value), str(caught.value)
