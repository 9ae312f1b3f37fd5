"""The control step as the loop calls it: both engines give the same numbers; gaps are not integrated over."""

import math
import random
from dataclasses import replace

import pytest

from companion.config import load_flight, load_vehicle
from companion.control import flat
from companion.control.history import Attitude
from companion.control.types import State
from companion.control.vectors import quat_normalise
from companion.flight.course import Course, Timed, at_rest
from companion.flight.delay import CHANGE_MAX_S
from companion.flight.engines import kernels
from companion.flight.resets import Reset
from companion.flight.retuning import flown
from companion.flight.tracker import Tracker
from companion.trajectory.load import load


def random_state(rng: random.Random, near: float) -> State:
    def vec(size):
        return (rng.uniform(-size, size), rng.uniform(-size, size), rng.uniform(-size, size))

    q = quat_normalise((1.0, rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), rng.uniform(-2, 2)))
    x, y, z = vec(near)
    return State((x, y, z - 10.0), vec(3.0), q, vec(1.0))


@pytest.mark.numba
@pytest.mark.parametrize("output", ["rates", "attitude", "actuators"])
@pytest.mark.parametrize("heading", ["damping", "sideslip", "commanded"])
def test_both_engines_give_the_same_numbers(output, heading):
    vehicle = load_vehicle("paper", {"controller": {"heading": heading}})
    course = Course(load("paper"), vehicle, (0.0, 0.0, -10.0), 0.0, None)
    trackers = [Tracker(vehicle, output, kernels(engine)) for engine in ("python", "numba")]
    rng = random.Random(heading + output)
    for tracker in trackers:
        tracker.begin(State((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    stamp, asked = 1.0, 0
    for i in range(400):
        # steps of every kind: near and far, limits, short and too long gaps, frozen
        stamp += 0.5 if i % 97 == 96 else rng.choice([0.004, 0.004, 0.008, 0.02])
        state = random_state(rng, rng.choice([0.5, 4.0, 40.0]))
        frozen = i % 13 == 0
        if i == 120:  # the flight begins anew, on another course
            course = Course(load("paper"), vehicle, (1.0, 2.0, -12.0), 0.3, None)
            for t in trackers:
                t.begin(state, 20.0)
        if i == 260:  # paused: the curve is left when the pace changes
            plan = course.plan_pace(stamp - 1.5 + 0.6, 0.0)
            ramp = plan.work(plan.samples_max)
            assert ramp is not None
            course.change_pace(ramp)
        if i == 200:  # the estimate was reset: from here on all of the course is elsewhere
            course.shift((0.3, -0.2, 0.1))
        if i % 3 == 0:  # of before or after the state, near its attitude or not
            q = quat_normalise(tuple(x + rng.uniform(-0.01, 0.01) * (1 + 9 * (i % 2)) for x in state.q))
            for t in trackers:
                t.refresh(Attitude(stamp + 0.003 * (i % 5 - 1), q, state.w))
        if i % 50 == 49:
            delay_s = trackers[0].delay_s + rng.uniform(-0.003, 0.003)
            for t in trackers:
                t.retime(delay_s)
        # the plain one asks the course; the compiled one has the trajectory as numbers, and asks before it begins
        plain = trackers[0].step(stamp, state, lambda s, c=course: c.at(s - 1.5), frozen=frozen)
        compiled = trackers[1].step(stamp, state, Timed(course, 1.5), frozen=frozen)
        at_stamp = course.at(stamp - 1.5)
        assert (compiled.target is not None) == (1.5 <= stamp < 1.5 + course.changes_s - trackers[1].delay_s)
        if compiled.target is not None:
            assert compiled.target.p == pytest.approx(at_stamp.p, abs=1e-12)
            assert compiled.target.v == pytest.approx(at_stamp.v, abs=1e-12)
        scale = [1.0 + abs(x) for x in plain.numbers]
        for a, b, size in zip(plain.numbers, compiled.numbers, scale, strict=True):
            assert a == pytest.approx(b, abs=1e-12 * size, nan_ok=True)
        assert plain.setpoint[0] == pytest.approx(compiled.setpoint[0], abs=1e-12)
        asked += compiled.target is None
    assert trackers[0].refreshed == trackers[1].refreshed > 10
    assert 60 < asked < 200


@pytest.mark.parametrize("output", ["rates", "attitude"])
@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
def test_a_step_that_is_like_the_last_one_gives_what_one_that_is_put_together_anew_does(engine, output):
    """The same course object in every step lets an engine go on where it was; another one each time does not.
    Whatever changes on the way, both send and tell the same to the last bit."""
    vehicle = load_vehicle("paper")
    stiffer = load_vehicle("paper", {"controller": {"k1_1_s": 0.8, "k3_1_s": 3.4}})
    course = Course(replace(load("paper"), duration_s=12.0), vehicle, (0.5, 0.0, -10.0), 0.0, None)
    one, other = (Tracker(vehicle, output, kernels(engine)) for _ in range(2))
    rng = random.Random(output)
    for tracker in (one, other):
        tracker.begin(State((0.5, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    timed, stamp, alike, again = Timed(course, 1.0), 1.0, [0], one._whole.again

    def counted(*given):
        sent = again(*given)
        alike[0] += sent is not None
        return sent

    one._whole.again = counted
    for i in range(6000):
        stamp += 0.5 if i % 977 == 976 else rng.choice([0.004, 0.004, 0.008])
        if 12.9 < stamp < 12.95:
            stamp = 13.1  # from one curve to the next, with none between
        state = random_state(rng, rng.choice([0.3, 0.3, 3.0]))
        event = rng.random() if i % 20 == 0 else 1.0
        for tracker in (one, other):
            if i == 500:
                tracker.retune(flown(stiffer.parameters(), tracker.parameters), 1.5)
            if event < 0.1:
                tracker.retime(vehicle.delay_s + 0.02 * event)
            elif event < 0.3:
                tracker.refresh(Attitude(stamp + 0.002, state.q, (0.1, 0.0, -0.1)))
            elif event < 0.4:
                tracker.carry(Reset(stamp, (0.2, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1, (0.0, 0.1, 0.0)))
            elif event < 0.45:
                tracker.begin(state, 30.0)
        if i == 2500:
            plan = course.plan_pace(stamp - 1.0 + 0.6, 0.5)
            course.change_pace(plan.work(plan.samples_max))
        frozen = 0.45 <= event < 0.55
        if i % 10:  # somebody else asks the same object before
            timed.curve(stamp, one.delay_s)
        sent = one.command(stamp, state, timed, frozen=frozen)
        assert sent == other.command(stamp, state, Timed(course, 1.0), frozen=frozen), i
        if i % 3 == 0:
            told, wanted = one.last_step(), other.last_step()
            assert told.target == wanted.target
            assert repr(told) == repr(wanted)  # NaN and all
    assert one.refreshed == other.refreshed > 10
    assert one.transitions and not one.changing
    assert (alike[0] > 1000) == (output == "rates")


@pytest.mark.numba
def test_an_attitude_of_before_a_reset_is_not_used_after_it():
    """Also where an answer by reflex had it already, and was declined."""
    vehicle = load_vehicle("paper")
    course = Course(load("paper"), vehicle, (0.5, 0.0, -10.0), 0.0, None)
    state = State((0.5, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    sent, timed = [], Timed(course, 1.0)
    for given in (True, False):
        tracker = Tracker(vehicle, "rates", kernels("numba"))
        tracker.begin(state)
        for i in range(5):
            tracker.command(1.0 + 0.004 * i, state, timed)
        if given:
            attitude = Attitude(1.023, quat_normalise((1.0, 0.02, 0.0, 0.0)), (0.1, 0.0, 0.0))
            tracker.refresh(attitude)
            tracker._whole.give_attitude(attitude)
        tracker.carry(Reset(1.02, (0.2, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0)))
        sent.append(tracker.command(1.02, state, timed))
    assert sent[0] == sent[1]


def test_a_gap_is_not_integrated_over():
    vehicle = load_vehicle("paper")
    tracker = Tracker(vehicle, "rates", kernels("python"))
    state = State((1.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    tracker.begin(state)
    hold = at_rest((0.0, 0.0, -10.0), 0.0)
    first = tracker.step(1.0, state, lambda t: hold).numbers
    after_gap = tracker.step(1.0 + vehicle.limits.state_gap_max_s + 0.01, state, lambda t: hold).numbers
    assert after_gap[flat.TOTAL] == first[flat.TOTAL] and after_gap[flat.B_HAT] == first[flat.B_HAT]
    assert int(after_gap[flat.LIMITS]) & 32
    going_on = tracker.step(1.0 + vehicle.limits.state_gap_max_s + 0.014, state, lambda t: hold).numbers
    assert going_on[flat.TOTAL] != first[flat.TOTAL]


def test_begin_takes_the_estimate_from_the_hover_or_from_zero():
    state = State((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), quat_normalise((1.0, 0.0, 0.05, 0.0)), (0.0, 0.0, 0.0))
    hold = at_rest(state.p, 0.0)
    for start, expected in (("hover", True), ("zero", False)):
        tracker = Tracker(
            load_vehicle("paper", {"controller": {"disturbance_start": start}}), "rates", kernels("python")
        )
        tracker.begin(state)
        out = tracker.step(1.0, state, lambda t: hold)
        assert (abs(out.b_hat[0]) > 0.5) == expected


def test_the_reference_is_taken_at_the_time_of_effect():
    flight = load_flight("paper")
    tracker = Tracker(flight.vehicle, "rates", kernels("python"))
    state = State((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    tracker.begin(state)
    asked = []
    tracker.step(5.0, state, lambda t: asked.append(t) or at_rest(state.p, 0.0))
    assert asked == [pytest.approx(5.0 + flight.vehicle.link.state_age_s)]


@pytest.mark.numba
def test_the_longest_delay_that_may_be_followed_is_predicted_over():
    link = {"state_age_s": 0.5, "command_delay_s": 0.5}
    tracker = Tracker(load_vehicle("paper", {"link": link}), "rates", kernels("numba"))
    state = State((1.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    tracker.begin(state)
    tracker.retime(tracker.delay_s + CHANGE_MAX_S)
    out = tracker.step(1.0, state, lambda t: at_rest((0.0, 0.0, -10.0), 0.0))
    assert tracker.delay_s == pytest.approx(1.02)
    assert all(math.isfinite(x) for x in out.rates)
