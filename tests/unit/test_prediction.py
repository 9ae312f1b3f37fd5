"""The prediction over the delay: which command acts when, and where that brings the vehicle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from companion.control import history
from companion.control.model import advance, factors
from companion.control.types import State
from companion.control.vectors import axes, quat_exp, quat_multiply, quat_normalise
from companion.flight.prediction import PIECE_MAX_S, Prediction

LAGS = (0.04, 0.05, 0.08, 0.05)
VEHICLE = (2.0, 9.81, 0.3)


def test_the_model_agrees_with_an_integrated_rigid_body():
    state = State((1.0, 2.0, -3.0), (0.5, -0.2, 0.1), quat_exp((0.2, -0.1, 0.4)), (0.3, -0.5, 0.2))
    rates, thrust, setpoint, b = (1.5, -1.0, 0.4), 20.0, 24.0, (0.3, -0.2, 0.1)

    def rhs(_, y):
        q, w, t = y[6:10], y[10:13], y[13]
        r3 = np.array(axes(quat_normalise(tuple(q)))[2])
        a = np.array(b) + np.array([0, 0, 9.81]) - 0.3 * y[3:6] - t / 2.0 * r3
        q_rate = 0.5 * np.array(quat_multiply(tuple(q), (0.0, *w)))
        w_rate = (np.array(rates) - w) / np.array(LAGS[:3])
        return np.concatenate([y[3:6], a, q_rate, w_rate, [(setpoint - t) / LAGS[3]]])

    start = np.concatenate([*state, [thrust]])
    errors = []
    for dt in (0.02, 0.01):
        exact = solve_ivp(rhs, (0, dt), start, rtol=1e-12, atol=1e-12).y[:, -1]
        got, got_thrust = advance(state, thrust, rates, setpoint, b, VEHICLE, factors(LAGS, dt), dt)
        errors.append(np.abs(np.concatenate([*got, [got_thrust]]) - exact))
    assert errors[0][10:].max() < 1e-9  # rates and thrust are exact
    assert errors[1].max() < 0.22 * errors[0].max()  # the rest: local errors of third order
    assert errors[1][:3].max() < 1e-5


def integral(commands, k, begin_s, end_s):
    """Of number k of commands, each given with the time from which it acts, over a time."""
    until = [since for since, _ in commands[1:]] + [math.inf]
    spans = [max(0.0, min(end, end_s) - max(since, begin_s)) for (since, _), end in zip(commands, until, strict=True)]
    return sum(span * command[k] for span, (_, command) in zip(spans, commands, strict=True) if span > 0.0)


@given(
    delay=st.floats(0.001, 0.09),
    interval=st.floats(0.003, 0.03),
    jitter=st.lists(st.floats(0.7, 1.4), min_size=60, max_size=60),
)
def test_every_piece_is_the_mean_of_the_commands_that_act_in_it(delay, interval, jitter):
    """Before the first command acts, what holds the hover does; a new scale is one for all that is under way."""
    prediction = Prediction(0.05, delay, 10.0)
    stamp, sent = 1.0, [(-math.inf, (10.0, 0.0, 0.0, 0.0))]
    for i, factor in enumerate(jitter):
        pieces = list(zip(*[iter(prediction.pieces(stamp))] * 5, strict=True))
        assert sum(piece[4] for piece in pieces) == pytest.approx(delay)
        begin_s = stamp
        for *means, duration_s in pieces:
            assert duration_s <= PIECE_MAX_S + 1e-9
            for k, mean in enumerate(means):
                expected = integral(sent, k, begin_s, begin_s + duration_s)
                assert mean * duration_s == pytest.approx(expected, abs=5.0 * history.SHORTEST_S)
            begin_s += duration_s
        command = (10.0 + i, float(i), -2.0 * i, 0.5 * i)
        prediction.sent(stamp, command[0], command[1:])
        sent.append((stamp + delay, command))
        if i == 40:
            prediction.rescale(1.5)
            sent = [(since, (1.5 * thrust, *rates)) for since, (thrust, *rates) in sent]
        stamp += interval * factor


@given(
    delay=st.floats(0.001, 0.2),
    commands=st.lists(st.tuples(st.floats(-0.02, 0.03), st.sampled_from([-5.0, 5.0])), min_size=2, max_size=60),
)
def test_a_mean_lies_between_the_commands_whatever_the_stamps_do(delay, commands):
    """Also where a command acts before the one that was sent before it: with stamps that go back, or less delay."""
    prediction, stamp = Prediction(0.05, delay, 10.0), 1.0
    for i, (interval, rate) in enumerate(commands):
        for thrust, x, y, z, _ in zip(*[iter(prediction.pieces(stamp))] * 5, strict=True):
            assert 10.0 - 1e-6 <= thrust <= 15.0 + 1e-6
            assert all(abs(mean) <= 5.0 + 1e-6 for mean in (x, y, z))
        prediction.sent(stamp, 12.5 + 0.5 * rate, (rate, -rate, rate))
        if i == 20:
            prediction.retime(0.5 * delay)
        stamp += interval


def test_the_thrust_at_the_stamp_is_followed_with_the_lag():
    prediction = Prediction(0.05, 0.0, 10.0)
    stamp, expected = 0.0, 10.0
    for i in range(50):
        prediction.pieces(stamp)
        assert prediction.thrust == pytest.approx(expected)
        setpoint = 10.0 + math.sin(0.3 * i)
        prediction.sent(stamp, setpoint, (0.0, 0.0, 0.0))
        expected = setpoint + (expected - setpoint) * math.exp(-0.01 / 0.05)
        stamp += 0.01


def test_without_delay_nothing_is_predicted():
    prediction = Prediction(0.05, 0.0, 10.0)
    prediction.sent(1.0, 11.0, (1.0, 0.0, 0.0))
    assert len(prediction.pieces(1.01)) == 0


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
def test_a_history_that_overflows_forgets_its_oldest_and_one_that_goes_on_stays_small(engine):
    full = Prediction(0.05, 0.5, 10.0, engine)
    for i in range(3000):  # all of them are still to act
        full.sent(1e-4 * i, float(i), (0.0, 0.0, 0.0))
    spans = full.between(0.0, 10.0)
    assert [thrust for thrust, _, _ in spans][-3:] == [2997.0, 2998.0, 2999.0]
    assert len(spans) == (history.CAPACITY - history.COMMANDS) // history.COMMAND - 1  # room for one is kept
    going_on, most = Prediction(0.05, 0.04, 10.0, engine), 0
    for i in range(3000):
        going_on.pieces(0.004 * i)
        going_on.sent(0.004 * i, float(i), (0.0, 0.0, 0.0))
        most = max(most, int(going_on.numbers[history.END]))
    assert most < 3 * history.FORGOTTEN_MAX
    assert going_on.between(0.004 * 2999, 20.0)[-1][0] == 2999.0


@pytest.mark.numba
@given(
    delay=st.floats(0.0, 0.09),
    commands=st.lists(st.tuples(st.floats(0.0005, 0.03), st.floats(0.0, 30.0), st.floats(-5.0, 5.0)), max_size=80),
)
def test_compiled_code_keeps_the_same_history(delay, commands):
    plain, compiled = (Prediction(0.05, delay, 10.0, engine) for engine in ("python", "numba"))
    stamp = 1.0
    for i, (interval, thrust, rate) in enumerate(commands):
        stamp += interval
        seen = [list(map(float, p.pieces(stamp))) for p in (plain, compiled)]
        assert seen[0] == pytest.approx(seen[1], rel=1e-12, abs=1e-12)
        assert plain.thrust == pytest.approx(compiled.thrust, rel=1e-12)
        for p in (plain, compiled):
            p.sent(stamp, thrust, (rate, -rate, 0.5 * rate))
            if i == 40:
                p.retime(0.7 * delay)
                p.rescale(1.1)
