"""Ways to and from a trajectory: none goes through the ground or a fence, a brisker one is taken, or none at all."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.config import Vehicle, load_vehicle
from companion.errors import RefusedError
from companion.flight.clearance import own_fence_margins
from companion.flight.course import Course
from companion.flight.inspection import inspect
from companion.flight.preflight import gate_place
from companion.flight.surroundings import gate_course
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.fence import Circle, Fence, Polygon
from companion.trajectory.load import build

VEHICLE = load_vehicle("bundled")
HOME = (0.0, 0.0, 0.0)
LEAST_M = 0.5


def helix(anchor: str = "home", **of: Any) -> Trajectory:
    table = {"shape": "helix", "anchor": anchor, "duration_s": 9.0, "helix": {"angular_rate_rad_s": 0.4, **of}}
    return build(table, "helix", "test", vehicle=VEHICLE)


def lowest_m(course: Course) -> float:
    """Above home, of the whole course."""
    return min(-course.at(course.duration_s * i / 3000).p[2] for i in range(3001))


CLIMB = helix(center_m=[0.0, 0.0, -1.0], radius_m=5.0, climb_m_s=1.5)
SINK = helix(center_m=[0.0, 0.0, -10.0], radius_m=5.0, climb_m_s=-1.0)
HERE = helix("here", radius_m=3.0, climb_m_s=2.0)


@pytest.mark.parametrize(
    ("trajectory", "hold", "part"),
    [
        (CLIMB, (5.0, 0.0, -5.0), "its join falls to -"),
        (SINK, (5.0, 0.0, -10.0), "the stop after it falls to "),
        (HERE, (5.0, 0.0, -2.0), "its join falls to -"),
    ],
    ids=["climb", "sink", "here"],
)
def test_a_way_through_the_ground_is_refused(trajectory: Trajectory, hold: Any, part: str) -> None:
    unseen = Course(trajectory, VEHICLE, hold, 0.0, HOME)
    assert unseen.obstruction() is None
    assert lowest_m(unseen) < LEAST_M
    course = Course(trajectory, VEHICLE, hold, 0.0, HOME, LEAST_M)
    if lowest_m(course) >= LEAST_M:  # a brisker way was found
        gate_course(course)
        return
    with pytest.raises(RefusedError, match=part):
        gate_course(course)
    found = inspect(trajectory, VEHICLE, hold_point=hold, height_min_m=LEAST_M).problems
    assert [problem.name for problem in found] == ["stop" if part.startswith("the stop") else "join"]


def test_a_brisker_way_is_taken_where_the_gentle_one_would_dip() -> None:
    """Of the same start, climbing slower: the gentle join dips below half a metre, a shorter one does not."""
    found = 0
    for climb in np.arange(0.3, 1.5, 0.1):
        trajectory = helix(center_m=[0.0, 0.0, -1.5], radius_m=5.0, climb_m_s=float(climb))
        gentle = Course(trajectory, VEHICLE, (5.0, 0.0, -5.0), 0.0, HOME)
        course = Course(trajectory, VEHICLE, (5.0, 0.0, -5.0), 0.0, HOME, LEAST_M)
        if lowest_m(gentle) >= LEAST_M:
            assert course.join_s == gentle.join_s, "what is clear stays as it is"
        elif course.obstruction() is None:
            found += 1
            assert course.join_s < gentle.join_s
            assert lowest_m(course) >= LEAST_M - 1e-3
    assert found > 0


def test_a_hold_below_the_least_height_may_be_left() -> None:
    up = build(
        {"shape": "line", "anchor": "home", "line": {"from_m": [0, 0, -3], "to_m": [5, 0, -3], "move_s": 8.0}},
        *("line", "test"),
        vehicle=VEHICLE,
    )
    assert Course(up, VEHICLE, (0.0, 0.0, -0.3), 0.0, HOME, LEAST_M).obstruction() is None
    below = Course(HERE, VEHICLE, (0.0, 0.0, 0.2), 0.0, None, LEAST_M)
    assert below.obstruction() is None, "where the ground is is not known"


def test_a_home_that_is_no_number_is_no_ground() -> None:
    course = Course(SINK, VEHICLE, (5.0, 0.0, -10.0), 0.0, (0.0, 0.0, math.nan), LEAST_M, origin=HOME)
    assert course.obstruction() is not None


def with_limits(**limits: float) -> Vehicle:
    return VEHICLE.model_copy(update={"limits": VEHICLE.limits.model_copy(update=limits)})


def test_the_fences_of_the_vehicle_file_hold_for_the_whole_way() -> None:
    circle = build(
        {
            **{"shape": "circle", "anchor": "home", "duration_s": 12.0},
            "circle": {"center_m": [0.0, 0.0, -6.0], "radius_m": 4.0, "angular_rate_rad_s": 0.8},
        },
        *("circle", "test"),
        vehicle=VEHICLE,
    )
    hold = (4.0, 0.0, -6.0)
    assert (
        Course(circle, with_limits(fence_radius_m=20.0, fence_height_m=9.0), hold, 0.0, HOME, LEAST_M).obstruction()
        is None
    )
    near = Course(circle, with_limits(fence_radius_m=4.04), hold, 0.0, HOME, LEAST_M).obstruction()
    assert near is not None
    assert "leaves the fence by" in near.sentence and "limits.fence_radius_m 4.04" in near.sentence
    assert near.sentence.startswith(("its join", "the stop after it"))
    inside = Course(circle, with_limits(fence_radius_m=3.0), hold, 0.0, HOME, LEAST_M).obstruction()
    assert inside is not None
    assert "leaves the fence by" in inside.sentence
    low = Course(circle, with_limits(fence_height_m=5.5), hold, 0.0, HOME, LEAST_M).obstruction()
    assert low is not None
    assert "rises 0.50 m above limits.fence_height_m 5.5" in low.sentence


NORTH = Fence((Polygon(((-5.0, -5.0), (25.0, -5.0), (25.0, 5.0), (-5.0, 5.0)), True),))
EAST = Fence((Polygon(((-5.0, -5.0), (5.0, -5.0), (5.0, 25.0), (-5.0, 25.0)), True),))


@pytest.mark.parametrize(
    ("fence", "yaw_rad", "kept"), [(NORTH, 0.0, True), (NORTH, math.pi / 2, True), (EAST, math.pi / 2, False)]
)
def test_a_trajectorys_own_fence_turns_with_it(fence: Fence, yaw_rad: float, kept: bool) -> None:
    """For the gate as for the guard in flight."""
    line = build(
        {"shape": "line", "anchor": "home", "line": {"from_m": [0, 0, -5], "to_m": [20, 0, -5], "move_s": 15.0}},
        *("line", "test"),
        vehicle=VEHICLE,
    )
    turned = replace(line, fence=fence, anchor_yaw_rad=yaw_rad)
    path = anchored(turned, HOME, (3.0, -2.0, 0.0))
    margins = own_fence_margins(path, np.array([path.at(0.15 * i).p for i in range(101)]))
    assert margins is not None and (margins.min() > 0.0) == kept
    if kept:
        gate_place(turned, LEAST_M)
        return
    with pytest.raises(RefusedError, match="leaves the fence"):
        gate_place(turned, LEAST_M)


def test_where_the_vehicle_happens_to_be_no_fence_came_along() -> None:
    round_fence = Fence((Circle((0.0, 0.0), 1.0, True),))
    path = anchored(replace(HERE, fence=round_fence), (9.0, 9.0, -5.0), HOME)
    assert own_fence_margins(path, np.zeros((1, 3))) is None
