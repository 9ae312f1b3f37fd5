"""The free heading: w3d and w3d' against finite differences, the holds, the rate limit."""

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import MASS, PAPER_GAINS, ZERO, eight, memory, numbers, parameters, quaternions, vectors

from companion.campaign.ideal import World, fly
from companion.control import heading
from companion.control.heading import (
    COMMANDED,
    DAMPING,
    SIDESLIP,
    HeadingState,
    desired_frame,
    forward_direction,
    limit_rate,
)
from companion.control.law import ControllerState
from companion.control.types import Reference, State, Vec3
from companion.control.vectors import axes, cross, dot, norm, quat_exp, quat_multiply


class Frame(NamedTuple):
    """The desired axes and rates by their names."""

    r1d: Vec3
    r2d: Vec3
    w1d: float
    w3d: float
    w3d_rate: float


def smooth(coefficients, t):
    """A vector polynomial and its first two derivatives."""
    a, b, c = (np.array(x) for x in coefficients)
    return tuple(a + b * t + c * t * t), tuple(b + 2 * c * t), tuple(2 * c)


def frame_of(force, forward):
    """The frame for a force and a forward direction, each with its first two derivatives."""
    size = norm(force[0])
    r3d = tuple(x / size for x in force[0])
    return Frame(*desired_frame(force, size, r3d, forward, cross(r3d, forward[0])))


def parts(ref):
    """What the heading is told of a reference: the path's direction and the commanded one."""
    return ref[1:4], ref[5:]


def turning(frame, force):
    """r2d' of a frame."""
    return frame.w1d * np.array(force) / norm(force) - frame.w3d * np.array(frame.r1d)


@settings(max_examples=50, deadline=None)
@given(
    force=st.tuples(vectors(2.0), vectors(2.0), vectors(2.0)),
    forward=st.tuples(vectors(2.0), vectors(1.0), vectors(1.0)),
)
def test_yaw_rate_and_its_derivative_agree_with_finite_differences(force, forward):
    force = (tuple(np.array(force[0]) + np.array([0.0, 0.0, 9.81])), force[1], force[2])

    def frame(t):
        return frame_of(smooth(force, t), smooth(forward, t))

    if norm(cross(force[0], forward[0])) < 0.3 * norm(force[0]):
        return
    h = 1e-5
    before, now, after = frame(-h), frame(0.0), frame(h)
    r2_rate = (np.array(after.r2d) - np.array(before.r2d)) / (2 * h)
    scale = 1.0 + abs(now.w3d) ** 2 + abs(now.w3d_rate)
    assert turning(now, force[0]) == pytest.approx(r2_rate, abs=1e-6 * scale)
    assert now.w3d == pytest.approx(-np.dot(now.r1d, r2_rate), abs=1e-6 * scale)
    assert now.w3d_rate == pytest.approx((after.w3d - before.w3d) / (2 * h), abs=1e-5 * scale)


@given(q=quaternions, v=vectors(2.0), a=vectors(1.0), j=vectors(1.0), held=st.booleans())
def test_the_path_gives_the_direction_where_it_is_fast_enough_across_the_thrust(q, v, a, j, held):
    """Otherwise the last one is held, which does not turn."""
    _, r2, r3 = axes(q)
    ref, slow, last = Reference(ZERO, v, a, j, ZERO, 0.0, 0.0, 0.0), 0.4, (0.6, 0.0, 0.8)
    (f, f1, f2), after, across = forward_direction(*parts(ref), r3, HeadingState(r2, last, held), SIDESLIP, slow)
    assert across == pytest.approx(tuple(np.cross(r3, f)))
    if float(np.linalg.norm(np.cross(r3, v))) > (2.0 * slow if held else slow):
        assert (f, f1, f2) == (v, a, j)
        assert after == HeadingState(r2, last, False)
        return
    assert (f1, f2) == (ZERO, ZERO)
    assert after == HeadingState(r2, f, True)
    assert f == pytest.approx(last if held else tuple(np.cross(r2, r3)))


@given(q=quaternions, yaw=numbers(-3.0, 3.0), rate=numbers(-1.0, 1.0), acceleration=numbers(-1.0, 1.0))
def test_a_commanded_direction_is_level_and_turns_with_the_commanded_rate(q, yaw, rate, acceleration):
    _, r2, r3 = axes(q)

    def direction(t):
        now = (yaw + rate * t + acceleration * t * t / 2, rate + acceleration * t, acceleration)
        return forward_direction((ZERO, ZERO, ZERO), now, r3, memory(), COMMANDED, 0.1)

    h = 1e-4
    (before, *_), ((f, f1, f2), after, across), (later, *_) = direction(-h), direction(0.0), direction(h)
    assert f == (math.cos(yaw), math.sin(yaw), 0.0)
    assert np.array(f1) == pytest.approx((np.array(later[0]) - np.array(before[0])) / (2 * h), abs=1e-6)
    assert np.array(f2) == pytest.approx((np.array(later[1]) - np.array(before[1])) / (2 * h), abs=1e-6)
    assert across == pytest.approx(tuple(np.cross(r3, f)))
    held = HeadingState(r2, f, True)
    wanted = (yaw, 0.0, 0.0)
    assert forward_direction((ZERO, ZERO, ZERO), wanted, r3, held, COMMANDED, 0.1)[1] == (r2, f, False)
    assert after == memory()


def torque(state, ref, force, memory, kind, gains, limits, dt_s):
    told, body = parts(ref), axes(state.q)
    tau3, after, error = heading.heading_torque(state.w, *told, force, memory, kind, *gains, *limits, dt_s, body)
    return tau3, HeadingState(*after), error


def level(yaw, w3=0.0):
    return State(ZERO, ZERO, quat_exp((0.0, 0.0, yaw)), (0.0, 0.0, w3))


def moving(v):
    return Reference(ZERO, v, ZERO, ZERO, ZERO, 0.0, 0.0, 0.0)


GRAVITY = ((0.0, 0.0, 9.81), ZERO, ZERO)
GAINS = (1.0, 1.0, 2.0)


@given(path=numbers(-3.1, 3.1), off=numbers(-3.0, 3.0))
def test_sideslip_turns_the_nose_towards_the_path(path, off):
    tau3, _, error = torque(
        level(path + off),
        moving((math.cos(path), math.sin(path), 0.0)),
        GRAVITY,
        memory(),
        SIDESLIP,
        GAINS,
        (1.0, 0.1),
        0.0,
    )
    assert error == pytest.approx(off, abs=1e-9)
    assert tau3 == pytest.approx(-math.sin(off), abs=1e-9)  # -l2 l1 r2d . r1


@given(yaw=numbers(-3.1, 3.1), off=numbers(-1.5, 1.5), rate=numbers(-1.0, 1.0), acceleration=numbers(-1.0, 1.0))
def test_commanded_heading_feeds_rate_and_acceleration_forward(yaw, off, rate, acceleration):
    ref = Reference(ZERO, ZERO, ZERO, ZERO, ZERO, yaw, rate, acceleration)
    tau3, _, error = torque(level(yaw, rate), ref, GRAVITY, memory(), COMMANDED, GAINS, (9.0, 0.1), 0.0)
    assert tau3 == pytest.approx(acceleration, abs=1e-9) and error == pytest.approx(0.0, abs=1e-9)
    _, _, error = torque(level(yaw + off), ref, GRAVITY, memory(), COMMANDED, GAINS, (9.0, 0.1), 0.0)
    assert error == pytest.approx(off, abs=1e-9)


@given(q=quaternions, w=vectors(2.0), force=st.tuples(vectors(2.0), vectors(2.0), vectors(2.0)), yaw=numbers(-3, 3))
def test_the_torque_is_that_of_42_with_the_error_rate_of_a_turning_body(q, w, force, yaw):
    """tau3 = -l2 (w3 - w3d + l1 r2d . r1) + w3d' - l1 d/dt(r2d . r1), the last one by finite differences."""
    force = (tuple(np.array(force[0]) + np.array([0.0, 0.0, 9.81])), force[1], force[2])
    l1, l2 = 1.3, 0.8
    state = State(ZERO, ZERO, q, w)
    ref = Reference(*[ZERO] * 5, yaw, 0.2, -0.1)
    tau3, _, error = torque(state, ref, force, memory(), COMMANDED, (l1, l2, 2.0), (9.0, 0.1), 0.0)
    frame = frame_of(force, forward_direction(*parts(ref), force[0], memory(), COMMANDED, 0.1)[0])
    h = 1e-6

    def along(t):
        turned = axes(quat_multiply(q, quat_exp(tuple(t * x for x in w))))
        return dot(tuple(np.array(frame.r2d) + t * turning(frame, force[0])), turned[0])

    rate = (along(h) - along(-h)) / (2 * h)
    expected = -l2 * (w[2] - frame.w3d + l1 * along(0.0)) + frame.w3d_rate - l1 * rate
    assert tau3 == pytest.approx(expected, abs=1e-7 * (1.0 + abs(expected)))
    assert math.tan(error) == pytest.approx(along(0.0) / dot(frame.r1d, axes(q)[0]), rel=1e-6, abs=1e-9)


def test_damping_and_missing_thrust_direction_only_damp():
    tau3, after, error = torque(
        level(0.3, 0.5), moving((1.0, 0.0, 0.0)), GRAVITY, memory(), DAMPING, GAINS, (1.0, 0.1), 0.01
    )
    assert tau3 == -1.0 and after == memory() and math.isnan(error)
    weak = ((0.0, 0.0, 0.1), ZERO, ZERO)
    tau3, after, _ = torque(level(0.3, 0.5), moving((1.0, 0.0, 0.0)), weak, memory(), SIDESLIP, GAINS, (1.0, 0.1), 0.01)
    assert tau3 == -1.0 and after == memory()


@pytest.mark.parametrize(("size", "damped"), [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.1), (1.0, 0.0, 0.1), (0.0, 0.6, 0.8)])
def test_half_a_metre_per_second_squared_of_force_has_a_direction(direction, size, damped):
    force = (tuple(size * x / norm(direction) for x in direction), ZERO, ZERO)
    ref = moving((1.0, 1.0, 0.0))
    tau3, after, error = torque(level(0.3, 0.5), ref, force, memory(), SIDESLIP, GAINS, (9.0, 0.1), 0.01)
    assert (tau3 == -1.0, after == memory(), math.isnan(error)) == (damped,) * 3


def test_a_nose_along_the_thrust_has_no_direction_and_is_only_damped():
    along = ((9.81, 0.0, 0.0), ZERO, ZERO)
    ref = Reference(ZERO, ZERO, ZERO, ZERO, ZERO, 0.0, 0.3, 0.0)
    tau3, _, error = torque(level(0.3, 0.5), ref, along, memory(), COMMANDED, GAINS, (1.0, 0.1), 0.01)
    assert tau3 == -1.0 and math.isnan(error)


@given(q=quaternions, turn=numbers(-3.0, 3.0), off=numbers(-0.3, 0.3), dt=st.sampled_from([0.02, 0.4, 2.0]))
def test_the_rate_limit_holds_about_any_axis(q, turn, off, dt):
    """The last direction need not be at right angles to the thrust any more: its share in the plane counts."""
    rate, (r1, r2, r3) = 0.5, np.array(axes(q))
    wanted = math.cos(turn) * r2 - math.sin(turn) * r1
    frame = Frame(tuple(np.cross(wanted, r3)), tuple(wanted), 9.0, 9.0, 9.0)
    last = (r2 + off * r3) / math.hypot(1.0, off)
    out = Frame(*limit_rate(frame, tuple(r3), tuple(last), rate, dt))
    if abs(abs(turn) - rate * dt) < 1e-6:
        return
    if abs(turn) < rate * dt:
        assert out == frame
        return
    turned = math.copysign(rate * dt, turn)
    assert np.array(out.r2d) == pytest.approx(math.cos(turned) * r2 - math.sin(turned) * r1, abs=1e-9)
    assert np.array(out.r1d) == pytest.approx(np.cross(out.r2d, r3), abs=1e-9)
    assert (out.w1d, out.w3d, out.w3d_rate) == (0.0, math.copysign(rate, turn), 0.0)


@pytest.mark.parametrize("share", [0.8, 0.94, 0.96, 1.04, 1.15, 1.3])
@pytest.mark.parametrize("dt", [0.02, 0.9, 1.1, 4.0])
def test_the_rate_limit_acts_from_where_it_stands(share, dt):
    """Also where a shortcut is taken, by the chord in place of the angle."""
    rate = 0.5
    turn = share * rate * dt
    ref = moving((math.cos(turn), math.sin(turn), 0.0))
    _, after, _ = torque(level(0.0), ref, GRAVITY, memory(), SIDESLIP, GAINS, (rate, 0.1), dt)
    turned = min(turn, rate * dt)
    assert after.r2d == pytest.approx((-math.sin(turned), math.cos(turned), 0.0), abs=1e-12)


@pytest.mark.parametrize(("i", "j"), [(0, 1), (1, 2), (2, 0)])
def test_the_rate_limit_takes_no_direction_for_one_that_mirrors_it(i, j):
    rate, dt, k = 0.5, 0.02, 3 - i - j
    r3 = tuple(float(axis == k) for axis in range(3))

    def direction(eighths):
        along = {i: math.cos(math.pi / 4 * eighths), j: math.sin(math.pi / 4 * eighths), k: 0.0}
        return tuple(along[axis] for axis in range(3))

    for first, second in itertools.permutations(range(8), 2):
        wanted, last = direction(second), direction(first)
        out = Frame(*limit_rate(Frame(tuple(np.cross(wanted, r3)), wanted, 9.0, 9.0, 9.0), r3, last, rate, dt))
        assert math.acos(min(dot(out.r2d, last), 1.0)) == pytest.approx(rate * dt, abs=1e-7)


def test_slow_path_holds_the_last_direction_with_hysteresis():
    """Held below 0.3 m/s, left at 0.6 m/s; a vertical climb has speed and no direction."""
    m = memory()
    east = HeadingState((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), False)
    _, m, error = torque(level(math.pi / 2), moving((0.0, 0.2, -3.0)), GRAVITY, east, SIDESLIP, GAINS, (9.0, 0.3), 0.01)
    assert m.held and m.forward == pytest.approx((0.0, 1.0, 0.0)) and error == pytest.approx(0.0)
    _, m, error = torque(level(math.pi / 2), moving((0.5, 0.0, 0.0)), GRAVITY, m, SIDESLIP, GAINS, (9.0, 0.3), 0.01)
    assert m.held and error == pytest.approx(0.0)
    _, m, _ = torque(level(math.pi / 2), moving((0.7, 0.0, 0.0)), GRAVITY, m, SIDESLIP, GAINS, (9.0, 0.3), 0.01)
    assert not m.held
    _, m, _ = torque(level(0.0), moving((0.4, 0.0, 0.0)), GRAVITY, m, SIDESLIP, GAINS, (9.0, 0.3), 0.01)
    assert not m.held


@pytest.mark.parametrize("target", [1.0, -2.5, 3.1])
def test_the_rate_limit_turns_the_direction_no_faster_and_the_shorter_way(target):
    m, state, limit, dt = memory(), level(0.0), 0.5, 0.02
    ref = moving((math.cos(target), math.sin(target), 0.0))
    angle, steps = 0.0, 0
    while abs(angle - target) > 1e-9 and steps < 1000:
        _, m, _ = torque(state, ref, GRAVITY, m, SIDESLIP, GAINS, (limit, 0.1), dt)
        new = math.atan2(-m.r2d[0], m.r2d[1])
        assert abs(new - angle) <= limit * dt + 1e-12
        assert (new - angle) * target >= 0.0
        angle, steps = new, steps + 1
    assert steps == math.ceil(abs(target) / (limit * dt))


def test_nose_backwards_is_an_equilibrium_left_as_45_says():
    """eta = 1 - r2d . r2 obeys eta' = -l1 (2 - eta) eta once xi = 0: integrated from near 2 in the closed loop."""
    p = parameters(PAPER_GAINS._replace(heading_kind=COMMANDED))
    hover = Reference((0.0, 0.0, -10.0), ZERO, ZERO, ZERO, ZERO, 0.0, 0.0, 0.0)
    off = math.pi - 0.05
    # xi = w3 - w3d + l1 r2d . r1 = 0 at the start
    start = State((0.0, 0.0, -10.0), ZERO, quat_exp((0.0, 0.0, off)), (0.0, 0.0, -math.sin(off)))
    ctrl = ControllerState(MASS * 9.81, 0.0, ZERO, memory(), ZERO)
    times = np.linspace(0.0, 8.0, 41)
    flight = fly(lambda t: hover, start, ctrl, p, World(ZERO, 9.81, 0.0), times)
    eta0 = 1.0 - math.cos(off)
    for t, s in zip(times, flight, strict=True):
        eta = 1.0 - dot((0.0, 1.0, 0.0), axes(s.state.q)[1])
        growth = eta0 / (2.0 - eta0) * math.exp(-2.0 * t)
        assert eta == pytest.approx(2.0 * growth / (1.0 + growth), abs=1e-6)


def test_in_the_papers_flight_the_heading_follows_the_path_not_the_velocity():
    p = parameters()
    start = State((0.0, 0.0, -10.0), (0.0, 1.0, 0.0), quat_exp((0.0, 0.0, 1.4)), ZERO)
    ctrl = ControllerState(MASS * 9.81, 0.0, ZERO, memory(), ZERO)
    flight = fly(eight, start, ctrl, p, World(ZERO, 9.81, 0.0), np.arange(0.0, 15.0, 0.5))
    assert abs(flight[0].evaluation.heading_error) > 0.15
    assert abs(flight[-1].evaluation.heading_error) < 1e-4
