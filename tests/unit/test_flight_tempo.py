"""Changes of pace: continuous up to the fourth derivative, within the limits, on the path, and the same again."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import asdict, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import Vehicle, load_vehicle
from companion.control.types import Reference
from companion.flight.course import Course
from companion.flight.pacing import LOOK_AHEAD_S, Pacing
from companion.flight.phases import Engagement
from companion.flight.tempo import LEAD_S, Ramp, Tempo
from companion.trajectory.flatness import worst_use
from companion.trajectory.load import load
from companion.trajectory.timing import RUN_OUT_ACCELERATION_M_S2
from companion.trajectory.vehicle_limits import point_mass, reference_limits

VEHICLE: Vehicle = load_vehicle("paper")
NAMES = ("paper", "circle", "helix", "lissajous", "line")


def course_of(name: str, vehicle: Vehicle = VEHICLE) -> Course:
    trajectory = load(name, vehicle=vehicle)
    return Course(trajectory, vehicle, (0.0, 0.0, -20.0), 0.3, (0.0, 0.0, 0.0))


def planned(course: Course, begin_s: float, rate: float) -> Ramp:
    plan = course.plan_pace(begin_s, rate)
    for _ in range(plan.samples_max):
        ramp = plan.work(1)
        if ramp is not None:
            return ramp
    raise AssertionError("the search has no end")


def apart(a: Reference, b: Reference) -> list[float]:
    return [max(abs(x - y) for x, y in zip(a[k], b[k], strict=True)) for k in range(5)]


@pytest.mark.parametrize("name", NAMES)
def test_pause_and_resume_keep_limits_and_derivatives(name: str) -> None:
    course = course_of(name)
    limits, model = reference_limits(VEHICLE), point_mass(VEHICLE)
    down = planned(course, course.join_s + 4.0, 0.0)
    course.change_pace(down)
    up = planned(course, down.begin_s + down.duration_s + 3.0, 1.0)
    course.change_pace(up)
    for at_s in (down.begin_s, down.begin_s + down.duration_s, up.begin_s, up.begin_s + up.duration_s):
        assert max(apart(course.at(at_s - 1e-9), course.at(at_s + 1e-9))) < 1e-5
    end_s = up.begin_s + up.duration_s + 1.0
    times = [down.begin_s - 1.0 + i * 0.01 for i in range(int((end_s - down.begin_s) * 100.0))]
    assert max(worst_use(course.at(t), limits, model) for t in times) < 1.0 + 1e-3
    resting = course.at(down.begin_s + down.duration_s + 1.0)
    assert all(abs(x) < 1e-9 for k in range(1, 5) for x in resting[k])
    assert course.over_s == pytest.approx(course.duration_s + end_s - 1.0 - course.course_s(end_s - 1.0))


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_a_changed_pace_are_those_of_its_positions(name: str) -> None:
    course = course_of(name)
    down = planned(course, course.join_s + 4.0, 0.0)
    course.change_pace(down)
    h = 1e-3
    for share in (0.1, 0.3, 0.5, 0.8):
        t = down.begin_s + share * down.duration_s
        before, here, after = course.at(t - h), course.at(t), course.at(t + h)
        for k in range(4):
            for axis in range(3):
                slope = (after[k][axis] - before[k][axis]) / (2.0 * h)
                assert slope == pytest.approx(here[k + 1][axis], abs=2e-4)


def test_the_path_is_the_same_at_any_pace() -> None:
    plain, changed = course_of("paper"), course_of("paper")
    changed.change_pace(planned(changed, 5.0, 0.0))
    for i in range(100):
        t = 4.5 + i * 0.05
        assert math.dist(changed.at(t).p, plain.at(changed.course_s(t)).p) < 1e-12


def test_a_fast_course_takes_longer_to_stop() -> None:
    """Along the path the reference brakes no harder than the limit of joins and stops."""
    slow, fast = course_of("paper"), course_of("circle")
    for course in (slow, fast):
        ramp = planned(course, course.join_s + 5.0, 0.0)
        course.change_pace(ramp)
        speeds = [math.hypot(*course.at(ramp.begin_s + i * 1e-3 * ramp.duration_s).v) for i in range(1001)]
        step_s = 1e-3 * ramp.duration_s
        braking = max(abs(b - a) / step_s for a, b in itertools.pairwise(speeds))
        assert braking < 1.3 * RUN_OUT_ACCELERATION_M_S2
    assert slow.ramps[0].duration_s < fast.ramps[0].duration_s


def test_where_the_course_itself_uses_a_limit_up_the_least_excess_is_taken() -> None:
    course = course_of("circle")
    most = max(math.hypot(*course.at(course.join_s + i * 0.1).a) for i in range(100))
    tight = VEHICLE.limits.model_copy(update={"acceleration_max_m_s2": most * 1.0001})
    tight_course = course_of("circle", VEHICLE.model_copy(update={"limits": tight}))
    ramp = planned(tight_course, tight_course.join_s + 5.0, 0.0)
    tight_course.change_pace(ramp)
    accelerations = [math.hypot(*tight_course.at(ramp.begin_s + i * 0.01 * ramp.duration_s).a) for i in range(101)]
    assert max(accelerations) < 1.1 * most


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.0, 6.0), st.floats(2.0, 8.0), st.sampled_from([0.0, 1.0])), min_size=1, max_size=5)
)
def test_any_changes_in_a_row_are_continuous(changes: list[tuple[float, float, float]]) -> None:
    """Also one that begins while the one before is under way."""
    tempo, begin_s, borders = Tempo(), 1.0, []
    for wait_s, duration_s, rate in changes:
        begin_s += wait_s
        tempo.add(Ramp(begin_s, duration_s, rate))
        borders += [begin_s, begin_s + duration_s]
    for border in borders:
        before, after = tempo.at(border - 1e-9), tempo.at(border + 1e-9)
        assert all(abs(a - b) < 1e-5 for a, b in zip(before, after, strict=True))
    end_s = tempo.settled_s
    assert tempo.at(end_s + 5.0)[1] == changes[-1][2]
    assert tempo.at(end_s + 5.0)[0] - tempo.at(end_s)[0] == pytest.approx(5.0 * changes[-1][2], abs=1e-6)


@pytest.mark.parametrize("rate_hz", [50.0, 250.0])
def test_pacing_never_changes_what_the_control_step_has_asked_for(rate_hz: float) -> None:
    course = course_of("paper")
    pacing = Pacing(course, rate_hz)
    pacing.want(0.0, 5.0)
    assert not pacing.reached(5.0)
    t = 5.0
    while not course.ramps:
        t += 1.0 / rate_hz
        pacing.tick(t)
        assert t < 5.0 + LEAD_S
    assert t + LOOK_AHEAD_S - 1.0 / rate_hz < course.ramps[0].begin_s == 5.0 + LEAD_S
    assert not pacing.reached(course.ramps[0].begin_s)
    assert pacing.reached(course.ramps[0].begin_s + course.ramps[0].duration_s)
    pacing.want(0.0, 20.0)
    pacing.tick(20.1)
    assert len(course.ramps) == 1


def test_pacing_after_a_gap_in_the_states_plans_anew() -> None:
    course = course_of("paper")
    pacing = Pacing(course, 250.0)
    pacing.want(0.0, 5.0)
    pacing.tick(5.4)  # the ramp at 5.5 s is too near now
    t = 5.4
    while not course.ramps:
        t += 0.004
        pacing.tick(t)
    assert course.ramps[0].begin_s == pytest.approx(5.4 + LEAD_S)


def test_a_recorded_engagement_holds_the_changes_of_pace() -> None:
    ramps = (Ramp(3.5, 2.0, 0.0), Ramp(9.25, 2.5, 1.0))
    engagement = Engagement(1.0, (0.0, 0.0, -5.0), 0.1, None, (1.0, 0.0, 0.0, 0.0), 46.0, ramps)
    assert Engagement.from_numbers(json.loads(json.dumps(asdict(engagement)))) == engagement
    older = {key: value for key, value in asdict(engagement).items() if key != "ramps"}
    assert Engagement.from_numbers(older) == replace(engagement, ramps=())
