"""Trajectories in their place: anchors, yaw offsets, and what happens outside of their time."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.control.types import Reference
from companion.errors import RefusedError
from companion.trajectory.anchored import Anchored, Trajectory, anchored
from companion.trajectory.batch import batch
from companion.trajectory.continuity import findings
from companion.trajectory.pieces import sample
from companion.trajectory.shapes import Circle, Heading, Helix, Line
from companion.trajectory.timing import RUN_OUT_ACCELERATION_M_S2, RUN_OUT_MIN_S, paced, run_out, scaled

HOLD = (3.0, -4.0, -7.0)
HOME = (0.5, 0.25, 1.5)
HELIX = Helix(
    center_m=(1.0, 2.0, -3.0),
    radius_m=4.0,
    angular_rate_rad_s=0.7,
    climb_m_s=0.4,
    phase_rad=0.3,
    heading=Heading(0.2, 0.1),
)
TRACK = Trajectory(name="helix", shape=HELIX, duration_s=20.0, time_scale=1.3)


def turned(yaw: float, vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """Turn north towards east, by complex numbers."""
    z = complex(vector[0], vector[1]) * complex(math.cos(yaw), math.sin(yaw))
    return z.real, z.imag, vector[2]


def plus(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["here", "local", "home"]), st.floats(-4.0, 4.0), st.floats(0.0, 20.0))
def test_anchor_moves_and_turns(anchor: str, yaw: float, t: float) -> None:
    trajectory = replace(TRACK, anchor=anchor, anchor_yaw_rad=yaw)
    found, plain = anchored(trajectory, HOLD, HOME).at(t), TRACK.at(t)
    start = TRACK.at(0.0).p
    expected = {
        "here": plus(HOLD, turned(yaw, plus(plain.p, (-start[0], -start[1], -start[2])))),
        "local": turned(yaw, plain.p),
        "home": plus(HOME, turned(yaw, plain.p)),
    }[anchor]
    assert found.p == pytest.approx(expected, abs=1e-12)
    for name in ("v", "a", "j", "s"):
        assert getattr(found, name) == pytest.approx(turned(yaw, getattr(plain, name)), abs=1e-12)
    assert found.yaw == pytest.approx(plain.yaw + yaw)
    assert (found.yaw_rate, found.yaw_acceleration) == (plain.yaw_rate, plain.yaw_acceleration)


def test_here_starts_at_the_hold_point_and_a_quarter_turn_flies_north_to_east() -> None:
    line = Line(from_m=(9.0, 9.0, 9.0), to_m=(19.0, 9.0, 9.0), move_s=5.0)
    trajectory = Trajectory(name="line", shape=line, duration_s=5.0, anchor_yaw_rad=math.pi / 2.0)
    found = anchored(trajectory, HOLD, None)
    assert found.at(0.0).p == pytest.approx(HOLD)
    assert found.at(5.0).p == pytest.approx((3.0, 6.0, -7.0))


def test_home_without_a_home_position_is_refused() -> None:
    with pytest.raises(RefusedError, match='helix: anchor = "home", but the vehicle has not told its home position'):
        anchored(replace(TRACK, anchor="home"), HOLD, None)


def test_without_a_turn_the_derivatives_are_untouched() -> None:
    found, plain = anchored(TRACK, HOLD, None).at(4.0), TRACK.at(4.0)
    assert found[1:] == plain[1:]


def test_shift_after_an_estimator_reset() -> None:
    before = anchored(TRACK, HOLD, None)
    after = before.shifted((0.5, -0.25, 2.0))
    assert after.at(3.0).p == pytest.approx(plus(before.at(3.0).p, (0.5, -0.25, 2.0)))
    assert after.at(3.0).v == before.at(3.0).v


class Window:
    """A stretch of a reference around an instant, seen as a piece."""

    period_s = None

    def __init__(self, source: Anchored, start_s: float, duration_s: float) -> None:
        self.source, self.start_s, self.duration_s = source, start_s, duration_s

    def at(self, t_s: float) -> Reference:
        return self.source.at(self.start_s + t_s)

    def joints(self) -> tuple[()]:
        return ()


@pytest.mark.parametrize("yaw", [0.0, 1.1])
def test_runs_out_to_rest_continuously_with_true_derivatives(yaw: float) -> None:
    placed = anchored(replace(TRACK, anchor_yaw_rad=yaw), HOLD, None)
    assert placed.run_out_s > RUN_OUT_MIN_S
    window = Window(placed, -placed.run_up_s - 1.0, placed.run_up_s + 20.0 + placed.run_out_s + 2.0)
    times = [window.duration_s * i / 4000 for i in range(4001)]
    assert findings(window, times, batch(window, times)) == []
    # And the fourth derivative does not jump either at the two ends.
    for end in (0.0, 20.0):
        assert placed.at(end - 1e-7).s == pytest.approx(placed.at(end + 1e-7).s, abs=1e-4)
    for t in (-placed.run_up_s, -1e6, 20.0 + placed.run_out_s, 1e6):
        for derivative in placed.at(t)[1:5]:
            assert derivative == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        assert placed.at(t).yaw_rate == pytest.approx(0.0, abs=1e-12)


def test_running_out_stays_on_the_path_and_adds_a_bounded_acceleration() -> None:
    circle = Trajectory(name="c", shape=Circle(radius_m=5.0, angular_rate_rad_s=0.8), duration_s=7.0)
    placed = anchored(circle, HOLD, None)
    centre = (HOLD[0] - 5.0, HOLD[1])
    for i in range(400):
        reference = placed.at(6.0 + 0.05 * i)
        assert math.dist(reference.p[:2], centre) == pytest.approx(5.0)
        assert math.hypot(*reference.v) <= 4.0 + 1e-9
        assert math.hypot(*reference.a) <= math.hypot(3.2, RUN_OUT_ACCELERATION_M_S2) + 1e-9


def test_ending_at_once_runs_out_from_there() -> None:
    placed = anchored(TRACK, HOLD, None)
    ended = placed.ending_at(8.0)
    assert ended.duration_s == 8.0
    assert ended.at(8.0) == placed.at(8.0)
    assert ended.at(3.0) == placed.at(3.0)
    assert ended.at(8.0 + ended.run_out_s).v == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    rest = placed.at(8.0 + ended.run_out_s / 2.0).p
    assert ended.at(1000.0).p == pytest.approx(rest)


def test_pace_of_one_changes_nothing_and_a_constant_pace_scales() -> None:
    reference = TRACK.at(2.0)
    assert paced(reference, (2.0, 1.0, 0.0, 0.0, 0.0)) == reference
    faster = paced(reference, (2.0, 1.7, 0.0, 0.0, 0.0))
    for found, expected in zip(faster[:5], scaled(reference, 1.7)[:5], strict=True):
        assert found == pytest.approx(expected)


def test_run_out_takes_half_its_time_of_path() -> None:
    assert run_out(0.0, 4.0) == pytest.approx((0.0, 1.0, 0.0, 0.0, 0.0))
    assert run_out(4.0, 4.0) == (2.0, 0.0, 0.0, 0.0, 0.0)
    assert run_out(4.0 - 1e-12, 4.0) == pytest.approx((2.0, 0.0, 0.0, 0.0, 0.0), abs=1e-9)


def test_samples_for_plots() -> None:
    placed = anchored(
        Trajectory(name="c", shape=Circle(radius_m=5.0, angular_rate_rad_s=0.5), duration_s=60.0), HOLD, None
    )
    samples = sample(placed, 101)
    assert samples.t_s.shape == samples.yaw.shape == (101,)
    assert {array.shape for array in samples[1:6]} == {(101, 3)}
    assert samples.t_s[-1] == 60.0
    assert samples.p[50] == pytest.approx(placed.at(30.0).p)
    assert samples.s[50] == pytest.approx(placed.at(30.0).s)
    lap = sample(placed, 101, laps=1)
    assert lap.t_s[-1] == pytest.approx(4.0 * math.pi)
    assert lap.p[0] == pytest.approx(lap.p[-1])
