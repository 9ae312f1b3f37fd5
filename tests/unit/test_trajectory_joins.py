"""Polynomials of degree 9, joins and stops."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from companion.control.types import Reference
from companion.errors import RefusedError
from companion.trajectory.anchored import Trajectory
from companion.trajectory.feasibility import check
from companion.trajectory.flatness import PointMass, ReferenceLimits, worst_use
from companion.trajectory.joins import SHARE, STOP_USE_MAX, join, stop
from companion.trajectory.pieces import chain, sample
from companion.trajectory.polynomial import evaluate, through, travel_to_rest
from companion.trajectory.shapes import Circle, Heading, Hover, Lemniscate

LIMITS = ReferenceLimits(12.0, 10.0, 1.25, 9.0, 80.0, 6.0)
MODEL = PointMass(mass_kg=4.76, drag_1_s=0.3)

values = st.floats(-10.0, 10.0)
derivatives = st.tuples(values, values, values, values, values)


@settings(max_examples=100, deadline=None)
@given(derivatives, derivatives, st.floats(0.3, 30.0), st.floats(0.0, 1.0))
def test_polynomial_meets_both_ends_and_is_its_own_derivative(
    start: tuple[float, ...], end: tuple[float, ...], duration_s: float, share: float
) -> None:
    c = through(start, end, duration_s)
    for k in range(5):
        # The terms that cancel at the end are as large as this; 3024 is the largest factor of a fourth derivative.
        size = 3024.0 * max(map(abs, c)) / duration_s**k
        assert evaluate(c, duration_s, 0.0)[k] == pytest.approx(start[k], rel=1e-12, abs=1e-12)
        assert evaluate(c, duration_s, duration_s)[k] == pytest.approx(end[k], abs=1e-13 * size)
    exact = Polynomial(c)
    for k, value in enumerate(evaluate(c, duration_s, share * duration_s)):
        expected = exact.deriv(k)(share) / duration_s**k if k else exact(share)
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-13 * 3024.0 * max(map(abs, c)) / duration_s**k)


@settings(max_examples=50, deadline=None)
@given(derivatives, st.floats(0.3, 10.0))
def test_way_to_rest_is_the_integral_of_the_smoothest_speed(start: tuple[float, ...], duration_s: float) -> None:
    # The polynomial of degree 9 to that point has no ninth power: its speed is the one of degree 7.
    way = travel_to_rest(start, duration_s)
    c = through(start, (start[0] + way, 0.0, 0.0, 0.0, 0.0), duration_s)
    assert c[9] == pytest.approx(0.0, abs=1e-9 * max(map(abs, c)))


def moving(
    point: tuple[float, float, float], radius_m: float, rate: float, phase: float, yaw: float, yaw_rate: float
) -> Reference:
    """A reference in the middle of a circle: all derivatives at once, and within the limits."""
    shape = Circle(
        center_m=point, radius_m=radius_m, angular_rate_rad_s=rate, phase_rad=phase, heading=Heading(yaw, yaw_rate)
    )
    return shape.at(0.7)


coordinates = st.floats(-15.0, 15.0)
movings = st.builds(
    moving,
    st.tuples(coordinates, coordinates, coordinates),
    st.floats(0.5, 5.0),
    st.floats(-1.0, 1.0),
    st.floats(-math.pi, math.pi),
    st.floats(-10.0, 10.0),
    st.floats(-0.5, 0.5),
)


def assert_same(found: Reference, expected: Reference, tolerance: float) -> None:
    for name in ("p", "v", "a", "j", "s"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=tolerance), name
    assert math.remainder(found.yaw - expected.yaw, math.tau) == pytest.approx(0.0, abs=tolerance)
    assert found.yaw_rate == pytest.approx(expected.yaw_rate, abs=tolerance)
    assert found.yaw_acceleration == pytest.approx(expected.yaw_acceleration, abs=tolerance)


@settings(max_examples=15, deadline=None)
@given(movings, movings)
def test_join_matches_its_ends_and_keeps_the_limits(start: Reference, end: Reference) -> None:
    found = join(start, end, LIMITS, MODEL)
    assert_same(found.at(0.0), start, 1e-9)
    assert_same(found.at(found.duration_s), end, 1e-9)
    uses = [worst_use(found.at(found.duration_s * i / 1777), LIMITS, MODEL) for i in range(1778)]
    assert max(uses) <= found.use + 1e-5
    assert found.use <= 1.0 + 1e-6
    assert abs(found.at(found.duration_s).yaw - start.yaw) <= math.pi + 1e-9


@settings(max_examples=15, deadline=None)
@given(movings)
def test_stop_comes_to_rest_within_the_limits(start: Reference) -> None:
    found = stop(start, LIMITS, MODEL)
    assert_same(found.at(0.0), start, 1e-9)
    end = found.at(found.duration_s)
    zero = (0.0, 0.0, 0.0)
    assert_same(end, Reference(end.p, zero, zero, zero, zero, end.yaw, 0.0, 0.0), 1e-9)
    uses = [worst_use(found.at(found.duration_s * i / 1777), LIMITS, MODEL) for i in range(1778)]
    assert max(uses) <= found.use + 1e-5
    assert found.use <= 1.0 + 1e-6
    assert found.at(found.duration_s + 100.0) == end


def test_stop_from_a_steady_speed_brakes_straight_ahead_without_overshoot() -> None:
    zero = (0.0, 0.0, 0.0)
    start = Reference((1.0, 2.0, -10.0), (5.0, 0.0, 0.0), zero, zero, zero, 0.0, 0.0, 0.0)
    found = stop(start, LIMITS, PointMass(4.76))
    samples = sample(found, 400)
    assert np.all(np.diff(samples.p[:, 0]) >= -1e-12)
    assert np.all(np.diff(samples.v[:, 0]) <= 1e-12)
    assert samples.p[-1] == pytest.approx([1.0 + 2.5 * found.duration_s, 2.0, -10.0])
    assert np.abs(samples.a).max() <= SHARE * LIMITS.acceleration_max_m_s2 + 1e-6


def test_stop_of_a_reference_at_its_speed_limit_that_still_accelerates() -> None:
    zero = (0.0, 0.0, 0.0)
    start = Reference(zero, (12.0, 0.0, 0.0), (1.0, 0.0, 0.0), zero, zero, 0.0, 0.0, 0.0)
    found = stop(start, LIMITS, PointMass(4.76))
    assert 1.0 < found.use <= STOP_USE_MAX


def test_stop_of_what_is_far_beyond_the_limits_is_refused() -> None:
    zero = (0.0, 0.0, 0.0)
    start = Reference(zero, (20.0, 0.0, 0.0), zero, zero, zero, 0.0, 0.0, 0.0)
    with pytest.raises(RefusedError, match=r"no stop of up to 120 s .* speed is 20 m/s, limit 12 m/s"):
        stop(start, LIMITS, MODEL)


def test_join_takes_about_the_shortest_time_and_longer_at_a_smaller_share() -> None:
    start, end = Hover(point_m=(0.0, 0.0, -10.0)).at(0.0), Hover(point_m=(30.0, 0.0, -10.0)).at(0.0)
    quick, gentle = join(start, end, LIMITS, MODEL, 1.0), join(start, end, LIMITS, MODEL, 0.25)
    assert quick.duration_s < gentle.duration_s
    assert 0.9 < quick.use <= 1.0 + 1e-6
    # Rest to rest over 30 m at 3 m/s: 315/128 * 30 / 3 = 24.6 s, to a step of the grid.
    assert 24.6 <= gentle.duration_s <= 24.6 * 1.05
    assert gentle.use > 0.2  # thrust counts in full


def test_join_takes_the_shorter_turn() -> None:
    start = Hover(heading=Heading(math.radians(170.0))).at(0.0)
    end = Hover(heading=Heading(math.radians(-170.0)), point_m=(3.0, 0.0, 0.0)).at(0.0)
    found = join(start, end, LIMITS, MODEL)
    assert found.at(found.duration_s).yaw == pytest.approx(math.radians(190.0))
    yaw = sample(found).yaw
    assert np.all(np.diff(yaw) >= -1e-12)


def test_heading_rate_limit_slows_a_join_down() -> None:
    start, end = Hover().at(0.0), Hover(heading=Heading(3.0), point_m=(1.0, 0.0, 0.0)).at(0.0)
    limits = ReferenceLimits(12.0, 10.0, 1.25, 9.0, 80.0, 6.0, heading_rate_max_rad_s=0.5)
    free, bound = join(start, end, LIMITS, MODEL), join(start, end, limits, MODEL)
    assert free.duration_s < bound.duration_s
    assert max(abs(bound.at(bound.duration_s * i / 500).yaw_rate) for i in range(501)) <= 0.5


def test_join_that_does_not_fit_is_refused_with_the_figure() -> None:
    start, end = Hover().at(0.0), Hover(point_m=(1000.0, 0.0, 0.0)).at(0.0)
    with pytest.raises(RefusedError) as caught:
        join(start, end, LIMITS, MODEL)
    text = str(caught.value)
    assert "over 1000.0 m" in text
    assert "in 120.0 s, speed is 20.5 m/s, limit 12 m/s (limits.speed_max_m_s)" in text
    assert "\n" not in text


def test_join_whose_end_is_beyond_the_limits_is_refused() -> None:
    end = Circle(radius_m=5.0, angular_rate_rad_s=2.0).at(0.0)
    with pytest.raises(RefusedError, match=r"acceleration is 20 m/s\^2, limit 10 m/s\^2"):
        join(Hover().at(0.0), end, LIMITS, PointMass(4.76))


def test_join_beyond_its_end_stays_at_its_end() -> None:
    found = join(Hover().at(0.0), Circle(radius_m=5.0, angular_rate_rad_s=0.5).at(0.0), LIMITS, MODEL)
    assert found.at(found.duration_s + 5.0) == found.at(found.duration_s)
    assert found.at(-5.0) == found.at(0.0)


@settings(max_examples=6, deadline=None)
@given(coordinates, coordinates, st.floats(-3.0, 3.0))
def test_join_trajectory_and_stop_make_one_continuous_flight(north: float, east: float, yaw: float) -> None:
    assume(math.hypot(north, east) > 0.1)
    shape = Lemniscate(center_m=(-5.0, 0.0, -10.0), amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.4)
    track = Trajectory(name="eight", shape=shape, duration_s=17.0)
    start = Hover(point_m=(north, east, -12.0), heading=Heading(yaw)).at(0.0)
    first = join(start, track.at(0.0), LIMITS, MODEL)
    last = stop(track.at(track.duration_s), LIMITS, MODEL)
    flight = chain([first, track, last])
    assert flight.duration_s == pytest.approx(first.duration_s + 17.0 + last.duration_s)
    assert [joint.at_s for joint in flight.joints()] == pytest.approx([first.duration_s, first.duration_s + 17.0])
    assert check(flight, LIMITS, MODEL) == []
    assert flight.at(first.duration_s + 3.0) == track.at((first.duration_s + 3.0) - first.duration_s)
    assert flight.at(-1.0) == first.at(0.0)
    assert flight.at(1000.0) == last.at(last.duration_s)


def test_fast_start_is_braked_gently_all_the_same() -> None:
    zero = (0.0, 0.0, 0.0)
    start = Reference(zero, (9.0, 0.0, 0.0), zero, zero, zero, 0.0, 0.0, 0.0)
    found = stop(start, LIMITS, PointMass(4.76))
    assert found.use == pytest.approx(0.75, abs=0.01)  # the speed that it has; all else at half of its limit
    assert np.abs(sample(found).a).max() <= SHARE * LIMITS.acceleration_max_m_s2 + 1e-6
