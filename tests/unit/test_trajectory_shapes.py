"""Shapes: exact derivatives, periods, and the paper's figure of eight."""

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.control.types import Reference
from companion.trajectory.anchored import Trajectory
from companion.trajectory.shapes import Circle, Heading, Helix, Hover, Lemniscate, Line, Lissajous, Shape

# Central differences of eighth order: at a step of a twentieth of a radian they are good to 1e-11.
WEIGHTS = ((1, 4.0 / 5.0), (2, -1.0 / 5.0), (3, 4.0 / 105.0), (4, -1.0 / 280.0))


def slope(f: Callable[[float], float], t: float, step: float) -> float:
    return sum(weight * (f(t + n * step) - f(t - n * step)) for n, weight in WEIGHTS) / step


def assert_derivatives(at: Callable[[float], Reference], t: float, step: float, size: float) -> None:
    """Compare every derivative with the difference quotient of the one below; `size` is the scale of the position."""
    names = ("p", "v", "a", "j", "s")
    for below, above in pairwise(names):
        for axis in range(3):
            expected = slope(lambda x: getattr(at(x), below)[axis], t, step)  # noqa: B023
            scale = size / (20.0 * step) ** names.index(above)
            assert getattr(at(t), above)[axis] == pytest.approx(expected, rel=1e-8, abs=2e-8 * scale), (above, axis)
    assert at(t).yaw_rate == pytest.approx(slope(lambda x: at(x).yaw, t, step), rel=1e-8, abs=1e-8 / step)
    assert at(t).yaw_acceleration == pytest.approx(slope(lambda x: at(x).yaw_rate, t, step), rel=1e-8, abs=1e-8 / step)


lengths = st.floats(-20.0, 20.0)
points = st.tuples(lengths, lengths, lengths)
rates = st.floats(0.05, 3.0).flatmap(lambda w: st.sampled_from((w, -w)))
angles = st.floats(-math.pi, math.pi)
headings = st.builds(Heading, angles, st.floats(-1.0, 1.0))
scales = st.floats(0.2, 4.0)
times = st.floats(-30.0, 60.0)


def smooth_shapes() -> st.SearchStrategy[tuple[Shape, float]]:
    """Shapes of one formula, each with its fastest angular rate."""

    def turning(kind: type[Circle] | type[Helix]) -> st.SearchStrategy[tuple[Shape, float]]:
        extra = {"climb_m_s": st.floats(-3.0, 3.0)} if kind is Helix else {}
        return st.builds(
            kind,
            heading=headings,
            center_m=points,
            radius_m=st.floats(0.1, 20.0),
            angular_rate_rad_s=rates,
            phase_rad=angles,
            **extra,
        ).map(lambda shape: (shape, abs(shape.angular_rate_rad_s)))

    eight = st.builds(
        Lemniscate, heading=headings, center_m=points, amplitude_m=st.tuples(lengths, lengths), angular_rate_rad_s=rates
    ).map(lambda shape: (shape, 2.0 * abs(shape.angular_rate_rad_s)))
    sines = st.builds(
        Lissajous,
        heading=headings,
        center_m=points,
        amplitude_m=points,
        angular_rate_rad_s=st.tuples(rates, rates, rates),
        phase_rad=st.tuples(angles, angles, angles),
    ).map(lambda shape: (shape, max(map(abs, shape.angular_rate_rad_s))))
    return st.one_of(turning(Circle), turning(Helix), eight, sines)


@settings(max_examples=100, deadline=None)
@given(smooth_shapes(), scales, times)
def test_derivatives_of_smooth_shapes_at_any_pace(drawn: tuple[Shape, float], scale: float, t: float) -> None:
    shape, rate = drawn
    trajectory = Trajectory(name="x", shape=shape, duration_s=10.0, time_scale=scale)
    step = 0.05 / (rate * scale)
    # Rounding: the centre and a steady climb add to the positions that are differenced.
    size = 60.0 + abs(trajectory.at(t).p[2])
    assert_derivatives(trajectory.at, t, step, size)


@settings(max_examples=60, deadline=None)
@given(points, points, st.floats(0.5, 20.0), st.booleans(), st.floats(0.02, 0.98), st.booleans(), scales, headings)
def test_derivatives_of_lines(
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    move_s: float,
    back: bool,
    where: float,
    second: bool,
    scale: float,
    heading: Heading,
) -> None:
    shape = Line(heading=heading, from_m=start, to_m=end, move_s=move_s, back=back)
    trajectory = Trajectory(name="x", shape=shape, duration_s=10.0, time_scale=scale)
    t = (where + (1.0 if back and second else 0.0)) * move_s / scale
    # The stencil must not reach over the line's ends, where it is another polynomial.
    step = min(0.01, where / 5.0, (1.0 - where) / 5.0) * move_s / scale
    assert_derivatives(trajectory.at, t, step, 100.0)


@pytest.mark.parametrize("t", [0.0, 0.1, 1.0, 7.3, 15.0, 31.4, 59.9])
def test_lemniscate_is_the_papers(t: float) -> None:
    shape = Lemniscate(center_m=(-5.0, 0.0, -10.0), amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.2)
    a, b = 0.2 * t, 0.4 * t
    reference = shape.at(t)
    assert reference.p == pytest.approx((5.0 * math.cos(a) - 5.0, 2.5 * math.sin(b), -10.0))
    assert reference.v == pytest.approx((-math.sin(a), math.cos(b), 0.0))
    assert reference.a == pytest.approx((-0.2 * math.cos(a), -0.4 * math.sin(b), 0.0))
    assert reference.j == pytest.approx((0.04 * math.sin(a), -0.16 * math.cos(b), 0.0))
    assert reference.s == pytest.approx((0.008 * math.cos(a), 0.064 * math.sin(b), 0.0))
    assert (reference.yaw, reference.yaw_rate, reference.yaw_acceleration) == (0.0, 0.0, 0.0)


def test_circle_by_hand() -> None:
    reference = Circle(center_m=(1.0, 2.0, -3.0), radius_m=2.0, angular_rate_rad_s=3.0, phase_rad=math.pi / 2.0).at(0.0)
    assert reference.p == pytest.approx((1.0, 4.0, -3.0))
    assert reference.v == pytest.approx((-6.0, 0.0, 0.0))  # clockwise from above: from the east it goes south
    assert reference.a == pytest.approx((0.0, -18.0, 0.0))
    assert reference.j == pytest.approx((54.0, 0.0, 0.0))
    assert reference.s == pytest.approx((0.0, 162.0, 0.0))


def test_helix_climbs() -> None:
    shape = Helix(radius_m=3.0, angular_rate_rad_s=0.6, climb_m_s=0.5)
    assert shape.at(20.0).p[2] == pytest.approx(-10.0)
    assert shape.at(7.0).v[2] == -0.5
    assert shape.period_s is None


def test_hover_turns_its_nose_only() -> None:
    reference = Hover(point_m=(1.0, 2.0, -3.0), heading=Heading(1.0, 0.25)).at(4.0)
    zero = (0.0, 0.0, 0.0)
    assert reference == Reference((1.0, 2.0, -3.0), zero, zero, zero, zero, 2.0, 0.25, 0.0)


def test_line_goes_from_rest_to_rest_and_stays() -> None:
    line = Line(from_m=(1.0, 0.0, -5.0), to_m=(11.0, -4.0, -7.0), move_s=8.0)
    zero = (0.0, 0.0, 0.0)
    for t, point in ((-1.0, line.from_m), (0.0, line.from_m), (8.0, line.to_m), (30.0, line.to_m)):
        reference = line.at(t)
        assert reference.p == pytest.approx(point)
        assert (reference.v, reference.a, reference.j, reference.s) == (zero, zero, zero, zero)
    middle = line.at(4.0)
    assert middle.p == pytest.approx((6.0, -2.0, -6.0))
    assert middle.v[0] == pytest.approx(315.0 / 128.0 * 10.0 / 8.0)
    assert line.own_duration_s == 8.0
    assert line.period_s is None


def test_line_there_and_back_repeats() -> None:
    line = Line(from_m=(0.0, 0.0, 0.0), to_m=(10.0, 0.0, 0.0), move_s=8.0, back=True)
    assert line.period_s == 16.0
    assert line.own_duration_s is None
    assert line.at(8.0).p == pytest.approx((10.0, 0.0, 0.0))
    assert line.at(12.0).p == pytest.approx((5.0, 0.0, 0.0))
    assert line.at(12.0).v[0] == pytest.approx(-line.at(4.0).v[0])
    assert line.at(16.0).p == pytest.approx((0.0, 0.0, 0.0))
    assert line.at(35.0).p == pytest.approx(line.at(3.0).p)


@settings(max_examples=60, deadline=None)
@given(smooth_shapes(), times)
def test_closed_shapes_repeat_after_their_period(drawn: tuple[Shape, float], t: float) -> None:
    shape, rate = drawn
    if shape.period_s is None:
        return
    here, later = shape.at(t), shape.at(t + shape.period_s)
    tolerance = 1e-9 * (1.0 + shape.period_s * rate) * 60.0
    for k, (a, b) in enumerate(zip(here[:5], later[:5], strict=True)):
        assert a == pytest.approx(b, abs=tolerance * max(1.0, rate**k))


@pytest.mark.parametrize(
    ("amplitudes", "rates_rad_s", "period_s"),
    [
        ((1.0, 1.0, 1.0), (0.2, 0.4, 0.6), 2.0 * math.pi / 0.2),
        ((1.0, 1.0, 1.0), (0.4, 0.6, 1.0), 2.0 * math.pi / 0.2),
        ((1.0, 1.0, 1.0), (0.6, 0.9, 0.8), 2.0 * math.pi / 0.1),
        ((1.0, 1.0, 0.0), (0.3, -0.9, 0.123), 2.0 * math.pi / 0.3),
        ((1.0, 1.0, 0.0), (0.3, 0.3 * math.sqrt(2.0), 0.0), None),
        ((0.0, 0.0, 2.0), (0.0, 0.0, 0.5), 4.0 * math.pi),
        ((0.0, 0.0, 0.0), (0.1, 0.2, 0.3), None),
    ],
)
def test_period_of_lissajous(
    amplitudes: tuple[float, float, float], rates_rad_s: tuple[float, float, float], period_s: float | None
) -> None:
    found = Lissajous(amplitude_m=amplitudes, angular_rate_rad_s=rates_rad_s).period_s
    assert found == (None if period_s is None else pytest.approx(period_s))


def test_scaling_goes_with_powers() -> None:
    shape = Helix(radius_m=3.0, angular_rate_rad_s=0.6, climb_m_s=0.5, heading=Heading(0.3, 0.2))
    twice = Trajectory(name="x", shape=shape, duration_s=5.0, time_scale=2.0).at(1.5)
    once = shape.at(3.0)
    assert twice.p == once.p
    for k, name in enumerate(("v", "a", "j", "s"), start=1):
        assert getattr(twice, name) == pytest.approx([2.0**k * x for x in getattr(once, name)], rel=1e-15)
    assert (twice.yaw, twice.yaw_rate) == (once.yaw, 2.0 * once.yaw_rate)
