"""Trajectories whose coordinates are places on the Earth: ground and fences are those of the vehicle's own home."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import pytest
from format_cases import HOME, place
from test_flight_sequence import Script

from companion.config import load_vehicle
from companion.control import flat
from companion.control.output import RateSetpoint
from companion.control.types import Vec3
from companion.flight.controller import controller_of
from companion.flight.course import Course
from companion.flight.engines import kernels
from companion.flight.guards import Finding, Guard
from companion.flight.phases import Cause, Engagement
from companion.flight.tracker import TrackerStep
from companion.flight.watch import Seen, Watch
from companion.frames import GeoPoint
from companion.link.telemetry import VehicleState
from companion.trajectory.anchored import Origin, Trajectory
from companion.trajectory.load import build
from companion.trajectory.shapes import Hover

AWAY_M = 100.0
"""The planned home lies so far north of the vehicle's own, which is the origin of its local frame."""
LEVEL = (1.0, 0.0, 0.0, 0.0)


def planned(trajectory: Trajectory, higher_m: float = 0.0, north_m: float = AWAY_M) -> Trajectory:
    """The same in coordinates that count from another place, which is so much higher than the vehicle's home."""
    origin = Origin(GeoPoint(*place(north_m, 0.0), HOME[2] + higher_m), altitude_above_home=False)
    return replace(trajectory, anchor="home", origin=origin)


def hovering(p: Vec3) -> Trajectory:
    """Over a point of the planned home's coordinates."""
    return Trajectory(name="h", shape=Hover(point_m=p), duration_s=20.0)


def script(trajectory: Trajectory, **limits: float) -> Script:
    """A vehicle 5 m above its home."""
    script = Script(trajectory=trajectory, limits=limits)
    script.autopilot.home_global = GeoPoint(*HOME)
    return script


def refused(trajectory: Trajectory, **limits: float) -> str:
    """Why the flight is refused when the vehicle holds."""
    ended = script(trajectory, **limits).ends(10.0)
    assert ended.cause is Cause.REFUSED
    return ended.detail


def flown(trajectory: Trajectory, **limits: float) -> tuple[Script, Course]:
    """The flight, with its course."""
    flying = script(trajectory, **limits)
    flying.to_track()
    assert flying.sequence.course is not None
    return flying, flying.sequence.course


def seen_at(flying: Script, course: Course, p: Vec3) -> Finding | None:
    """What the guards find when the vehicle stays somewhere for a second."""
    watch = Watch(flying.flight, controller_of(flying.flight, kernels("python")), flying.autopilot, lambda line: None)
    for i in range(250):
        state = VehicleState(10_000_000 + 4000 * i, p, (0.0,) * 3, LEVEL, (0.0,) * 3, 0)
        out = TrackerStep(RateSetpoint(0.5, (0.0,) * 3), (0.0,) * flat.RESULTS)
        found = watch.on_step(Seen(state, (0.0,) * 3, out, 0, False, None, 0, True), course, 10.0 + 0.004 * i)
        if found is not None:
            return found
    return None


def test_a_flight_around_the_vehicles_home_is_within_its_fence() -> None:
    """However far away it was planned."""
    flying, course = flown(planned(hovering((-AWAY_M, 0.0, -5.0))), fence_radius_m=20.0)
    assert course.path.at(0.0).p == pytest.approx((0.0, 0.0, -5.0), abs=0.01)
    assert seen_at(flying, course, (19.9, 0.0, -5.0)) is None
    found = seen_at(flying, course, (0.0, -20.4, -5.0))
    assert found is not None and found.guard is Guard.FENCE
    assert found.detail.startswith("20.4 m from home, limit 20 m (limits.fence_radius_m)")


def test_a_flight_around_the_planned_home_is_outside_of_the_vehicles_fence() -> None:
    told = refused(planned(hovering((0.0, 0.0, -5.0))), fence_radius_m=20.0)
    assert told.startswith("trajectory 'h': it leaves the fence by 80.00 m (limits.fence_radius_m 20)")


def test_the_fences_height_counts_from_the_vehicles_home() -> None:
    """Planned over a hill, 8 m above where the vehicle stands: 4 m above the hill are 12."""
    trajectory = planned(hovering((-AWAY_M, 0.0, -4.0)), 8.0)
    assert "rises 2.00 m above limits.fence_height_m 10" in refused(trajectory, fence_height_m=10.0)
    flying, course = flown(trajectory, fence_height_m=13.0)
    assert seen_at(flying, course, (0.0, 0.0, -12.9)) is None
    found = seen_at(flying, course, (0.0, 0.0, -13.2))
    assert found is not None
    assert found.detail.startswith("13.2 m above home, limit 13 m (limits.fence_height_m)")


def test_the_fence_counts_from_the_hold_point_while_home_is_not_known() -> None:
    flying = Script(limits={"fence_radius_m": 20.0, "fence_height_m": 10.0})
    flying.autopilot.home = None
    flying.to_track()
    course = flying.sequence.course
    assert course is not None and course.home is None
    assert seen_at(flying, course, (19.9, 0.0, -14.9)) is None
    for p, told in (((20.1, 0.0, -5.0), "20.1 m from the hold"), ((0.0, 0.0, -15.1), "10.1 m above the hold")):
        found = seen_at(flying, course, p)
        assert found is not None and found.detail.startswith(told)


def moving(center_down_m: float, climb_m_s: float) -> Trajectory:
    """Begins and ends in motion, around the vehicle's home."""
    table: dict[str, Any] = {"shape": "helix", "duration_s": 9.0}
    table["helix"] = {
        **{"center_m": [-AWAY_M - 5.0, 0.0, center_down_m], "radius_m": 5.0},
        **{"angular_rate_rad_s": 0.4, "climb_m_s": climb_m_s},
    }
    return build(table, "helix", "test", vehicle=load_vehicle("paper"))


VALLEY_M = -40.0
"""By which the planned home is higher: what is high above it may be in the ground of the vehicle's own."""


@pytest.mark.parametrize(
    ("trajectory", "part"),
    [
        (hovering((-AWAY_M, 0.0, VALLEY_M + 2.0)), "it falls to -2.00 m above home, "),
        (moving(VALLEY_M - 1.0, 1.5), "its join falls to -"),
        (moving(VALLEY_M - 9.6, -1.0), "the stop after it falls to "),
    ],
    ids=["track", "join", "stop"],
)
def test_the_whole_way_stays_above_the_ground_of_the_vehicles_home(trajectory: Trajectory, part: str) -> None:
    told = refused(planned(trajectory, VALLEY_M))
    assert told.startswith(f"trajectory {trajectory.name!r}: {part}")
    assert "m above home, at least 0.5 m are required (height_min_m of the flight file), " in told


def test_a_recorded_engagement_holds_home_and_origin() -> None:
    """And in recordings from before the two were told apart `home_m` was the origin."""
    home, origin = (1.0, 2.0, -0.5), (101.0, 2.0, 3.0)
    kept = Engagement(1.0, (0.0, 0.0, -5.0), 0.0, home, LEVEL, None, origin_m=origin)
    assert Engagement.from_numbers(json.loads(json.dumps(asdict(kept)))) == kept
    older = {key: value for key, value in asdict(kept).items() if key != "origin_m"} | {"home_m": list(origin)}
    read = Engagement.from_numbers(older)
    assert (read.home_m, read.origin_m) == (origin, None)
    trajectory = planned(hovering((0.0, 0.0, -4.0)))
    for engagement in (kept, read):
        where = engagement.hold_point_m, engagement.yaw_rad, engagement.home_m
        course = Course(trajectory, load_vehicle("paper"), *where, origin=engagement.origin_m)
        assert course.path.at(0.0).p == (101.0, 2.0, -1.0)
