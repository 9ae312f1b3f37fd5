"""The law against its closed forms: the linear loop, V' and V_H', the paper's flight, the sampled step."""

import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from law_cases import (
    MASS,
    NO_LIMITS,
    PAPER_GAINS,
    ZERO,
    eight,
    far_states,
    memory,
    near_states,
    numbers,
    parameters,
    quaternions,
    rising,
    vectors,
)
from scipy.linalg import expm

from companion.campaign.ideal import World, fly
from companion.control import law
from companion.control.certificate import inside_matrix, linear_loop
from companion.control.heading import COMMANDED, DAMPING, SIDESLIP
from companion.control.law import ControllerState, Gains, Limits, evaluate, step
from companion.control.types import Reference, State
from companion.control.vectors import axes, dot, norm, rotate_to_body, sub

G = 9.81


def errors_of(sample):
    return np.array(sample.evaluation.errors[:4])


@pytest.mark.parametrize(
    ("kind", "drag", "gamma"), [(SIDESLIP, 0.0, 2.0), (DAMPING, 0.8, 2.0), (COMMANDED, 0.4, 1.0), (SIDESLIP, 0.5, 0.0)]
)
def test_inside_the_errors_follow_the_linear_system(kind, drag, gamma):
    p = parameters(PAPER_GAINS._replace(heading_kind=kind, gamma=gamma), drag)
    start = State((0.5, -0.4, -9.2), (0.3, 1.2, 0.2), (0.98, 0.1, -0.05, 0.16), (0.1, -0.2, 0.3))
    force = (1.5, -2.0, 1.0)
    world = World(force, G + 0.2, drag)
    truth = np.array([force[0] / MASS, force[1] / MASS, force[2] / MASS + 0.2])
    times = np.linspace(0.0, 6.0, 61)
    ctrl = ControllerState(MASS * G * 1.02, 0.4, (0.1, 0.2, -0.1), memory(), ZERO)
    flight = fly(rising, start, ctrl, p, world, times, tolerance=1e-11)
    assert max(norm(s.evaluation.errors.e1) for s in flight) < p.gains.p_max

    a = linear_loop(p.gains, drag)
    z0 = np.vstack([errors_of(flight[0]), truth - np.array(flight[0].controller.b_hat)])
    for t, sample in zip(times, flight, strict=True):
        expected = expm(a * t) @ z0
        assert np.abs(errors_of(sample) - expected[:4]).max() < 1e-6
        assert np.abs(truth - np.array(sample.controller.b_hat) - expected[4]).max() < 1e-6


def lyapunov_functions(sample, truth, gains):
    e = errors_of(sample)
    b_tilde = np.array(truth) - np.array(sample.controller.b_hat)
    estimate = (b_tilde @ b_tilde) / (2 * gains.k1 * gains.gamma)
    return law.lyapunov(sample.evaluation.errors, gains.p_max) + estimate, 0.5 * np.sum(e * e) + estimate


@settings(max_examples=25, deadline=None)
@given(
    start=st.one_of(near_states, far_states), b_hat=vectors(1.5), drag=st.sampled_from([0.0, 0.5]), t0=st.floats(0, 30)
)
def test_the_lyapunov_functions_fall_as_their_closed_forms_say(start, b_hat, drag, t0):
    p = parameters(drag=drag)
    g = p.gains
    truth = (0.4, -0.3, 0.2)
    ctrl = ControllerState(MASS * 9.0, 1.0, b_hat, memory(), ZERO)
    world = World((truth[0] * MASS, truth[1] * MASS, truth[2] * MASS), G, drag)
    h = 1e-4
    before, now, after = fly(eight, start, ctrl, p, world, np.array([t0, t0 + h, t0 + 2 * h]), tolerance=1e-13)
    e1, e2, e3, e4 = errors_of(now)
    e1n = norm(now.evaluation.errors.e1)
    if abs(e1n - g.p_max) < 0.05:
        return
    far_before, near_before = lyapunov_functions(before, truth, g)
    far_after, near_after = lyapunov_functions(after, truth, g)
    e = np.array([e1, e2, e3, e4])
    if e1n < g.p_max:
        expected = -np.sum(e * (inside_matrix(g, drag) @ e))
        measured = (near_after - near_before) / (2 * h)
    else:
        # outside: V_H' written out from section 3, tangential part of e2 included
        s = np.array(now.evaluation.errors.sigma)
        c0 = 1 / (g.k1**2 * g.k2)
        kk = g.k1 * g.k2
        b_tilde = np.array(truth) - np.array(b_hat_at(now))
        ds_e2 = (g.p_max / e1n) * (e2 - e1 * (e1 @ e2) / e1n**2)
        rate = g.gamma * (e2 + e3 + e4)
        e2r = g.k1 * ds_e2 - drag * (e2 - s) + kk * (e3 - e2) + b_tilde / g.k1
        e3r = e2r + (kk + g.k3) * (e4 - e3) + c0 * rate
        e4r = e3r - c0 * rate - kk * (e3 - e2) - (kk + g.k3 + g.k4) * e4
        expected = s @ (g.k1 * (e2 - s)) + e2 @ e2r + e3 @ e3r + e4 @ e4r - b_tilde @ rate / (g.k1 * g.gamma)
        measured = (far_after - far_before) / (2 * h)
    assert measured == pytest.approx(expected, rel=2e-5, abs=2e-5)


@pytest.mark.parametrize("start", [(0.5, -0.4, -9.2), (25.0, -15.0, -18.0)], ids=["inside", "outside"])
def test_what_the_heading_is_told_of_the_force_is_a_direction_and_its_two_derivatives(start, monkeypatch):
    """Along the closed loop with a right estimate, with drag and with gains of which no two are alike: the derivatives
    given against central differences of what they are derivatives of."""
    drag, truth = 0.6, (0.3, -0.4, 0.2)
    p = parameters(Gains(0.7, 3.5, 2.0, 4.5, 1.3, 5.0, SIDESLIP, 1.0, 1.0, 2.0), drag)
    told = []
    heard = law.heading_torque

    def listen(w, path, wanted, force, *rest):
        told.append(force)
        return heard(w, path, wanted, force, *rest)

    world = World((truth[0] * MASS, truth[1] * MASS, truth[2] * MASS), G, drag)
    state = State(start, (0.3, 1.2, 0.2), (0.98, 0.1, -0.05, 0.16), (0.1, -0.2, 0.3))
    h = 1e-3
    times = 3.0 + h * np.arange(3)
    begin = ControllerState(MASS * 9.0, 0.4, truth, memory(), ZERO)
    # begun so that the estimate, which moves, is right in the middle
    back = evaluate(state, rising(times[0]), begin, p, False, 0.0).b_hat_rate
    begin = begin._replace(b_hat=sub(truth, (h * back[0], h * back[1], h * back[2])))
    flight = fly(rising, state, begin, p, world, times, tolerance=1e-13)
    samples = []
    monkeypatch.setattr(law, "heading_torque", listen)
    for t, sample in zip(times, flight, strict=True):
        samples.append(evaluate(sample.state, rising(t), sample.controller, p, False, 0.0))
    before, now, after = told
    for given_rate, a, b in ((now[1], before[0], after[0]), (now[2], before[1], after[1])):
        assert np.array(given_rate) == pytest.approx((np.array(b) - np.array(a)) / (2 * h), rel=1e-3, abs=1e-4)


def b_hat_at(sample):
    return sample.controller.b_hat


def test_outside_the_radial_form_is_the_quadratic_one_of_the_certificate():
    from companion.control.certificate import outside_matrix

    for drag in (0.0, 0.5):
        g = PAPER_GAINS
        rng = np.random.default_rng(3)
        for _ in range(20):
            s, e2, e3, e4, b = g.p_max, *rng.normal(size=4)
            c0 = 1 / (g.k1**2 * g.k2)
            kk = g.k1 * g.k2
            rate = g.gamma * (e2 + e3 + e4)
            e2r = -drag * (e2 - s) + kk * (e3 - e2) + b / g.k1
            e3r = e2r + (kk + g.k3) * (e4 - e3) + c0 * rate
            e4r = e3r - c0 * rate - kk * (e3 - e2) - (kk + g.k3 + g.k4) * e4
            derivative = s * g.k1 * (e2 - s) + e2 * e2r + e3 * e3r + e4 * e4r - b * rate / (g.k1 * g.gamma)
            z = np.array([s, e2, e3, e4])
            assert derivative == pytest.approx(-z @ outside_matrix(g, drag) @ z, rel=1e-9, abs=1e-9)


@pytest.fixture(scope="module")
def paper_flight():
    p = parameters()
    start = State((30.0, -20.0, -20.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    ctrl = ControllerState(MASS * G, 0.0, (0.0, 0.0, 0.0), memory(), ZERO)
    return fly(eight, start, ctrl, p, World((4.76, 0.0, 0.0), 1.05 * G, 0.0), np.arange(0.0, 20.005, 0.01))


def test_the_papers_flight_has_the_values_of_section_6(paper_flight):
    f = paper_flight
    e1 = np.array([norm(s.evaluation.errors.e1) for s in f])
    inside = e1 <= 5.0
    exit_index = int(np.argmax(inside))
    assert f[exit_index].t_s == pytest.approx(9.31, abs=0.05)
    assert inside[exit_index:].all()
    assert f[exit_index - 1].controller.b_hat == pytest.approx((1.0, 0.0, 0.4905), abs=1e-3)
    speed = np.array([norm(s.state.v) for s in f])
    assert speed.max() == pytest.approx(5.64, abs=0.01)
    assert f[int(speed.argmax())].t_s == pytest.approx(0.8, abs=0.05)
    assert speed[400] == pytest.approx(4.0, abs=0.15)
    after = f[exit_index:]
    assert max(np.abs(s.evaluation.errors.e2).max() for s in after) == pytest.approx(0.87, abs=0.05)
    assert max(norm(s.evaluation.errors.e3) for s in after) == pytest.approx(0.67, abs=0.01)
    assert max(norm(sub((1.0, 0.0, 0.4905), s.controller.b_hat)) for s in after) == pytest.approx(1.74, abs=0.01)
    assert e1[1500] == pytest.approx(0.136, abs=0.001)
    assert e1[2000] == pytest.approx(0.0065, abs=0.0001)
    sideways = [rotate_to_body(s.state.q, s.state.v)[1] for s in f]
    assert sideways[900] == pytest.approx(-3.3, abs=0.05)
    assert sideways[1500] == pytest.approx(0.06, abs=0.005)
    assert sideways[2000] == pytest.approx(0.002, abs=0.0005)
    assert max(s.controller.thrust for s in f) / (MASS * G) == pytest.approx(1.57, abs=0.01)
    assert max(math.degrees(math.acos(axes(s.state.q)[2][2])) for s in f) == pytest.approx(62.5, abs=0.1)
    assert np.abs(f[0].evaluation.tau).max() == pytest.approx(61.0, abs=1.0)


def test_the_sampled_step_approaches_the_continuous_law():
    """Halving dt halves the distance to the derivatives: step and evaluate share one law."""
    state = State((0.5, 0.1, -9.7), (0.2, 0.9, 0.1), (0.99, 0.05, -0.08, 0.1), (0.2, -0.1, 0.05))
    ctrl = ControllerState(MASS * G, 1.0, (0.2, 0.1, 0.3), memory(), ZERO)
    p = parameters()
    out = evaluate(state, eight(1.0), ctrl, p, False, 0.0)
    gaps = []
    for dt in (1e-3, 5e-4):
        command, after, _ = step(state, eight(1.0), ctrl, p, False, dt)
        assert command.tau == pytest.approx(out.tau)
        assert after.thrust_rate == pytest.approx(ctrl.thrust_rate + dt * out.thrust_acceleration)
        gaps.append(after.thrust - ctrl.thrust - dt * ctrl.thrust_rate - 0.5 * dt**2 * out.thrust_acceleration)
        assert np.array(after.b_hat) == pytest.approx(np.array(ctrl.b_hat) + dt * np.array(out.b_hat_rate))
    assert gaps == pytest.approx([0.0, 0.0], abs=1e-12)


HOVER = Reference((0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, 0.0)
TIGHT = Limits(20.0, 60.0, (2.0, 2.0, 1.0), 2.0, 1.0, 0.3)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def level_state(p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0)):
    return State(p, v, LEVEL, (0.0, 0.0, 0.0))


def clipped(x, low, high):
    return min(max(x, low), high)


@settings(max_examples=200, deadline=None)
@given(
    state=st.one_of(near_states, far_states),
    thrust=st.sampled_from([20.0, 20.05, 30.0, 45.0, 59.95, 60.0]),
    rate=numbers(-200.0, 200.0),
    b_hat=st.one_of(vectors(1.1), st.floats(1.65, 1.99).map(lambda size: (0.0, -0.6 * size, 0.8 * size))),
    lead=vectors(0.5),
    frozen=st.booleans(),
    dt=st.sampled_from([0.004, 0.02]),
)
def test_the_step_integrates_what_the_law_gives_and_cuts_it_as_section_8_says(
    state, thrust, rate, b_hat, lead, frozen, dt
):
    assume(abs(norm(b_hat) - 0.9 * TIGHT.disturbance_max) > 1e-9)  # there the last digit decides about a flag
    p = parameters(PAPER_GAINS._replace(heading_kind=COMMANDED), 0.3, TIGHT)
    lags, integral, rotors = (0.05, 0.06, 0.1), np.array([1.3, 0.9, 0.4]), 0.05
    p = p._replace(model=p.model._replace(rate_lag=lags, rate_integral=tuple(integral), thrust_lag=rotors))
    ctrl = ControllerState(thrust, rate, b_hat, memory(), lead)
    command, after, out = step(state, rising(2.0), ctrl, p, frozen, dt)
    low, high, most = TIGHT.thrust_min, TIGHT.thrust_max, np.array(TIGHT.rate_max)
    stopped = frozen or not low < thrust < high
    assert out == evaluate(state, rising(2.0), ctrl, p, stopped, dt)
    flags = law.LIMIT_ESTIMATOR_FROZEN * stopped

    free = thrust + dt * rate + dt**2 / 2 * out.thrust_acceleration
    free_rate = rate + dt * out.thrust_acceleration
    assert after.thrust == pytest.approx(clipped(free, low, high))
    inside = low < free < high
    back = clipped(free_rate, 0.0, math.inf) if free <= low else clipped(free_rate, -math.inf, 0.0)
    assert after.thrust_rate == pytest.approx(free_rate if inside else back)
    flags |= law.LIMIT_THRUST_MIN * (free <= low) | law.LIMIT_THRUST_MAX * (free >= high)

    estimate = np.array(b_hat) + dt * np.array(out.b_hat_rate)
    size, bound = np.linalg.norm(estimate), TIGHT.disturbance_max
    assert np.array(after.b_hat) == pytest.approx(estimate * min(1.0, bound / max(size, 1e-9)))
    flags |= law.LIMIT_DISTURBANCE * bool(size > 0.9 * bound)

    w = np.array(state.w)
    wanted = w + np.array(out.tau) * dt / (1.0 - np.exp(-dt / np.array(lags)))
    over = max(np.abs(wanted[:2] / most[:2]).max(), 1.0)
    flags |= law.LIMIT_ROLL_PITCH_RATE * bool(over > 1.0) | law.LIMIT_YAW_RATE * bool(abs(wanted[2]) > most[2])
    wanted = np.array([wanted[0] / over, wanted[1] / over, clipped(wanted[2], -most[2], most[2])])
    assert np.array(command.rates_model) == pytest.approx(wanted)
    assert np.array(command.rates) == pytest.approx(np.clip(wanted - integral * np.array(lead), -most, most))
    change = wanted - w - (integral + 0.2) * np.array(lead)
    assert np.array(after.lead_integral) == pytest.approx(np.array(lead) + dt * change)

    ahead = thrust + (clipped(free, low, high) - thrust) / (1.0 - math.exp(-dt / rotors))
    assert command.thrust == pytest.approx(clipped(ahead, low, high))
    flags |= law.LIMIT_THRUST_MIN * (ahead < low) | law.LIMIT_THRUST_MAX * (ahead > high)
    assert command.limits == flags
    assert command.tau == out.tau and after.heading == out.heading


def test_at_the_thrust_limit_only_the_way_back_is_open_and_the_estimator_stops():
    p = parameters(limits=TIGHT)
    low = level_state(p=(0.0, 0.0, -4.0))  # far too high: the law wants less and less thrust
    ctrl = ControllerState(TIGHT.thrust_min, -5.0, (0.0, 0.0, 0.5), memory(), ZERO)
    command, after, _ = step(low, HOVER, ctrl, p, False, 0.01)
    assert after.thrust == TIGHT.thrust_min and after.thrust_rate >= 0.0
    assert after.b_hat == ctrl.b_hat
    assert command.limits & law.LIMIT_THRUST_MIN and command.limits & law.LIMIT_ESTIMATOR_FROZEN
    high = level_state(p=(0.0, 0.0, 4.0))
    command, after, _ = step(
        high, HOVER, ControllerState(TIGHT.thrust_max, 5.0, (0.0, 0.0, 0.5), memory(), ZERO), p, False, 0.01
    )
    assert after.thrust == TIGHT.thrust_max and after.thrust_rate <= 0.0 and command.limits & law.LIMIT_THRUST_MAX


def test_a_frozen_estimator_uses_zero_everywhere():
    """The b_hat' in the torque is the one that is integrated: with a frozen estimate it is that of Gamma = 0."""
    state = State((0.5, 0.1, -0.7), (0.2, 0.9, 0.1), (0.99, 0.05, -0.08, 0.1), (0.2, -0.1, 0.05))
    ctrl = ControllerState(MASS * G, 1.0, (0.2, 0.1, 0.3), memory(), ZERO)
    frozen = evaluate(state, HOVER, ctrl, parameters(), True, 0.0)
    off = evaluate(state, HOVER, ctrl, parameters(PAPER_GAINS._replace(gamma=0.0)), False, 0.0)
    assert frozen.tau == off.tau and frozen.b_hat_rate == (0.0, 0.0, 0.0)
    assert frozen.thrust_acceleration == off.thrust_acceleration


@pytest.mark.parametrize(("b_hat", "frozen"), [(ZERO, True), ((0.0, 0.0, 1.95), False)], ids=["frozen", "projected"])
def test_while_the_estimate_does_not_follow_the_heading_is_told_of_the_references_snap_alone(
    b_hat, frozen, monkeypatch
):
    told = []
    heard = law.heading_torque
    monkeypatch.setattr(law, "heading_torque", lambda *said: told.append(said[3]) or heard(*said))
    p = parameters(drag=0.3, limits=TIGHT)
    ctrl = ControllerState(MASS * G, 1.0, b_hat, memory(), ZERO)
    ref = rising(1.0)
    out = evaluate(State((0.5, 0.1, 2.3), *level_state()[1:]), ref, ctrl, p, frozen, 0.0)
    free = [2.0 * sum(e[axis] for e in out.errors[1:4]) for axis in range(3)]
    assert frozen or np.abs(np.array(out.b_hat_rate) - free).max() > 0.1
    assert told[0][2] == pytest.approx(tuple(-s - 0.3 * j for s, j in zip(ref.s, ref.j, strict=True)))


@settings(max_examples=60, deadline=None)
@given(state=far_states, b_hat=vectors(1.1), dt=st.sampled_from([0.004, 0.02]))
def test_every_limit_holds_for_any_state(state, b_hat, dt):
    p = parameters(limits=TIGHT)
    ctrl = ControllerState(40.0, 0.0, b_hat, memory(), ZERO)
    for _ in range(30):
        command, ctrl, _ = step(state, eight(3.0), ctrl, p, False, dt)
        assert TIGHT.thrust_min <= command.thrust <= TIGHT.thrust_max
        assert TIGHT.thrust_min <= ctrl.thrust <= TIGHT.thrust_max
        assert all(abs(r) <= m * (1 + 1e-12) for r, m in zip(command.rates, TIGHT.rate_max, strict=True))
        assert norm(ctrl.b_hat) <= TIGHT.disturbance_max * (1 + 1e-12)


def test_rate_limit_keeps_the_direction_of_roll_and_pitch():
    p = parameters(limits=NO_LIMITS)
    state = level_state(p=(3.0, 1.0, 0.0))
    ctrl = ControllerState(MASS * G, 0.0, (0.0, 0.0, 0.0), memory(), ZERO)
    free, _, _ = step(state, HOVER, ctrl, p, False, 0.1)
    cut, _, _ = step(state, HOVER, ctrl, parameters(limits=NO_LIMITS._replace(rate_max=(0.1, 0.1, 9.0))), False, 0.1)
    assert math.hypot(*free.rates[:2]) > 0.2
    assert cut.rates[0] / cut.rates[1] == pytest.approx(free.rates[0] / free.rates[1])
    assert max(abs(cut.rates[0]), abs(cut.rates[1])) == pytest.approx(0.1)
    assert cut.limits & law.LIMIT_ROLL_PITCH_RATE


@pytest.mark.parametrize(("roll", "pitch"), [(0.2, 0.1), (0.1, 0.2), (9.0, 0.1), (0.1, 9.0)])
def test_roll_and_pitch_have_limits_of_their_own(roll, pitch):
    state, ctrl = level_state(p=(3.0, 1.0, 0.0)), ControllerState(MASS * G, 0.0, ZERO, memory(), ZERO)
    free = step(state, HOVER, ctrl, parameters(), False, 0.1)[0].rates
    cut = step(state, HOVER, ctrl, parameters(limits=NO_LIMITS._replace(rate_max=(roll, pitch, 9.0))), False, 0.1)[0]
    over = max(abs(free[0]) / roll, abs(free[1]) / pitch, 1.0)
    assert cut.rates == pytest.approx((free[0] / over, free[1] / over, free[2]))
    assert bool(cut.limits & law.LIMIT_ROLL_PITCH_RATE) == (over > 1.0)


def test_what_the_autopilots_integral_will_add_is_taken_out_and_forgotten_slowly():
    """Section 8: w_sent = w_cmd - k_i L, L' = w_cmd - w - (k_i + 0.2) L, axis by axis."""
    p, dt = parameters(), 0.01
    k, memory_of_leads, w = np.array([1.3, 0.9, 0.4]), np.array([0.3, -0.2, 0.1]), (0.2, -0.1, 0.3)
    p = p._replace(model=p.model._replace(rate_integral=tuple(k)))
    state = level_state(p=(0.4, -0.3, 0.2))._replace(w=w)
    command, after, _ = step(
        state, HOVER, ControllerState(MASS * G, 0.0, ZERO, memory(), tuple(memory_of_leads)), p, False, dt
    )
    wanted = np.array(command.rates_model)
    assert np.array(command.rates) == pytest.approx(wanted - k * memory_of_leads)
    change = (np.array(after.lead_integral) - memory_of_leads) / dt
    assert change == pytest.approx(wanted - np.array(w) - (k + 0.2) * memory_of_leads)


@given(lag=st.floats(0.005, 0.2), dt=st.floats(0.001, 0.05), w=st.floats(-3, 3), tau=st.floats(-50, 50))
def test_the_rate_setpoint_inverts_a_first_order_loop(lag, dt, w, tau):
    target = w + tau * law.lead_time(lag, dt)
    assert target + (w - target) * math.exp(-dt / lag) == pytest.approx(w + tau * dt, abs=1e-9)
    assert law.lead_time(0.0, dt) == dt


@given(b=vectors(1.9), y=vectors(3.0))
def test_projection_never_adds_to_the_lyapunov_function(b, y):
    """(b/m - b_hat) . (Gamma y - b_hat') <= 0 for every true value within the layer."""
    bound = 2.0
    if norm(b) > bound:
        return
    rate = law.projected(tuple(1.5 * x for x in y), b, bound)
    free = tuple(1.5 * x for x in y)
    size = norm(b)
    inner = (1.0 - law.PROJECTION_LAYER) * bound
    outward = tuple(x * inner / size for x in b) if size > 1e-9 else (inner, 0.0, 0.0)
    for truth in (outward, (0.0,) * 3, (0.0, 0.0, inner), (-inner, 0.0, 0.0)):
        assert dot(sub(truth, b), sub(free, rate)) <= 1e-9
    if size > 0.999 * bound:
        assert dot(b, rate) <= 0.05 * norm(free) * bound


@given(b=vectors(1.9), y=vectors(3.0))
@example(b=(0.0, 0.0, 1.95), y=(0.5, 0.0, 0.2))
def test_the_projection_begins_at_nine_tenths_of_the_ball(b, y):
    if abs(dot(b, y)) < 1e-6 or abs(norm(b) - 1.8) < 1e-6:
        return
    rate = law.projected(tuple(1.5 * x for x in y), b, 2.0)
    assert (rate != tuple(1.5 * x for x in y)) == (norm(b) > 0.9 * 2.0 and dot(b, y) > 0.0)


@given(b=vectors(1.9), y=vectors(3.0))
def test_the_projection_takes_away_a_share_of_what_points_outwards_and_nothing_else(b, y):
    bound, b = 2.0, np.array(b)
    inner = (1.0 - law.PROJECTION_LAYER) * bound
    free = np.array(y)
    rate = np.array(law.projected(y, tuple(b), bound))
    size_sq, outward = b @ b, b @ free
    if size_sq <= inner**2 or outward <= 0.0:
        assert rate == pytest.approx(free)
        return
    share = min(1.0, (size_sq - inner**2) / (bound**2 - inner**2))
    assert b @ rate == pytest.approx((1.0 - share) * outward, abs=1e-9)
    assert np.cross(b, rate) == pytest.approx(np.cross(b, free), abs=1e-9)


@given(thrust=st.floats(10.0, 100.0), q=quaternions, bound=st.floats(0.5, 5.0))
def test_the_start_explains_the_hover_as_far_as_the_ball_reaches(thrust, q, bound):
    found, b_hat = law.start(thrust, q, MASS, G, bound)
    missing = thrust / MASS * np.array(axes(q)[2]) - np.array([0.0, 0.0, G])
    assert found == thrust
    assert np.array(b_hat) == pytest.approx(missing * min(1.0, bound / np.linalg.norm(missing)))


@given(e1=vectors(9.0), e2=vectors(2.0), e3=vectors(2.0), e4=vectors(2.0), p_max=st.floats(0.5, 5.0))
def test_the_lyapunov_function_is_the_integral_of_the_bounded_error_and_squares(e1, e2, e3, e4, p_max):
    size = norm(e1)
    reached = np.linspace(0.0, size, 20001)
    potential = np.trapezoid(np.minimum(reached, p_max), reached)
    squares = 0.5 * sum(dot(e, e) for e in (e2, e3, e4))
    assert law.lyapunov(law.Errors(e1, e2, e3, e4, ZERO), p_max) == pytest.approx(potential + squares, rel=1e-6)


@pytest.mark.parametrize(("speed", "held"), [(0.1, True), (1.0, False)])
def test_a_step_says_that_the_heading_is_held(speed, held):
    ref = HOVER._replace(v=(speed, 0.0, 0.0))
    ctrl = ControllerState(MASS * G, 0.0, ZERO, memory(), ZERO)
    command, after, _ = step(level_state(), ref, ctrl, parameters(limits=TIGHT), False, 0.01)
    assert (bool(command.limits & law.LIMIT_HEADING_HELD), after.heading.held) == (held, held)


def test_each_limit_has_a_bit_of_its_own():
    flags = [value for name, value in vars(law).items() if name.startswith("LIMIT_")]
    assert sorted(flags) == [1 << i for i in range(len(flags))]


def test_start_from_a_tilted_hover_does_not_step():
    tilt = 0.1
    q = (math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0)
    thrust, b_hat = law.start(MASS * G / math.cos(tilt), q, MASS, G, 4.0)
    state = State((0.0,) * 3, (0.0,) * 3, q, (0.0,) * 3)
    out = evaluate(state, HOVER, ControllerState(thrust, 0.0, b_hat, memory(), ZERO), parameters(), False, 0.0)
    assert np.abs(out.errors.e3).max() < 1e-12 and np.abs(out.errors.e4).max() < 1e-12
    assert abs(out.tau[0]) < 1e-9 and abs(out.tau[1]) < 1e-9 and abs(out.thrust_acceleration) < 1e-9
