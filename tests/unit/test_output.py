"""From the law's command to setpoints: what the autopilot makes of them must be the command again."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import numbers, quaternions, vectors

from companion.control.output import (
    LEAD_FILTER_S,
    Conversion,
    actuator_output,
    attitude_output,
    lead,
    rates_output,
    thrust_fraction,
)
from companion.control.vectors import axes, quat_multiply

CONVERSION = Conversion(96.0, 0.0, (6.0, 5.0, 2.8), 0.0, (0.09, 0.1, 0.15), (12.0, 11.0, 2.4))


@given(share=st.floats(0.0, 1.0), factor=st.floats(0.0, 1.0))
def test_the_thrust_fraction_inverts_the_curve(share, factor):
    u = thrust_fraction(share * 50.0, 50.0, factor)
    assert 0.0 <= u <= 1.0
    assert factor * u * u + (1.0 - factor) * u == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize("factor", [0.0, 1e-7, 0.4, 1.0])
def test_the_thrust_fraction_ends_where_the_vehicle_does(factor):
    assert [thrust_fraction(n, 50.0, factor) for n in (-9.0, 0.0)] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert [thrust_fraction(n, 50.0, factor) for n in (50.0, 70.0)] == pytest.approx([1.0, 1.0])


@given(q=quaternions, rates=vectors(2.0))
def test_an_attitude_loop_makes_the_rates_of_the_attitude_setpoint(q, rates):
    """PX4: rates = P x (twice the vector part of the error) + R' u3 x the yaw feed-forward, about body x and y."""
    down = [axis[2] for axis in axes(q)]
    if down[2] < 0.4:
        return
    out = attitude_output(40.0, rates, (0.0, 0.0, 0.0), q, (0.0, 0.0, 0.0), CONVERSION)
    error = quat_multiply((q[0], -q[1], -q[2], -q[3]), out.q)
    for axis in range(3):
        angle = 2.0 * math.atan2(np.linalg.norm(error[1:]), error[0])
        part = error[1 + axis] / max(np.linalg.norm(error[1:]), 1e-12) * angle
        got = CONVERSION.attitude_gain[axis] * part + down[axis] * out.yaw_rate
        assert got == pytest.approx(rates[axis], abs=1e-6)
    assert np.linalg.norm(out.q) == pytest.approx(1.0)


def test_a_filtered_attitude_gets_its_lag_ahead():
    """A reference model of lag T follows the setpoint's ramp T later: the setpoint is where the ramp will be."""
    lagging = CONVERSION._replace(attitude_lag=0.04)
    out = attitude_output(40.0, (0.6, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.6, 0.0, 0.0), lagging)
    assert 2.0 * math.asin(out.q[1]) == pytest.approx(0.6 / 6.0 + 0.04 * 0.6)


@given(q=quaternions, rates=vectors(1.0), tau=vectors(3.0), w=vectors(1.0))
def test_the_lag_is_led_by_the_setpoints_own_rate_of_change(q, rates, tau, w):
    """About x and y the setpoint runs ahead of the vehicle by rates / P: it turns with w + tau / P. About z with w."""

    def turned(lag):
        out = attitude_output(40.0, rates, tau, q, w, CONVERSION._replace(attitude_lag=lag))
        error = quat_multiply((q[0], -q[1], -q[2], -q[3]), out.q)
        size = np.linalg.norm(error[1:])
        return np.array(error[1:]) / max(size, 1e-12) * 2.0 * math.atan2(size, error[0])

    lag, gain = 0.05, CONVERSION.attitude_gain
    change = (turned(lag) - turned(0.0)) / lag
    assert change == pytest.approx([w[0] + tau[0] / gain[0], w[1] + tau[1] / gain[1], w[2]], abs=1e-5)


@pytest.mark.parametrize(("down", "share"), [(0.9, 1.0 / 0.9), (0.35, 1.0 / 0.35), (0.2, 1.0 / 0.3), (-0.5, 1.0 / 0.3)])
def test_the_yaw_feed_forward_grows_until_the_vehicle_is_steep(down, share):
    half = math.acos(down) / 2.0
    q = (math.cos(half), 0.6 * math.sin(half), 0.8 * math.sin(half), 0.0)
    assert attitude_output(40.0, (0.1, 0.2, 0.5), (0.0,) * 3, q, (0.0,) * 3, CONVERSION).yaw_rate == pytest.approx(
        0.5 * share
    )


@given(tau=st.one_of(vectors(20.0), vectors(500.0)), w=vectors(3.0))
def test_actuator_controls_are_the_torque_of_equation_6(tau, w):
    out = actuator_output(48.0, tau, w, CONVERSION)
    j = np.diag(CONVERSION.inertia)
    torque = j @ tau + np.cross(w, j @ w)
    expected = np.clip(torque / np.array(CONVERSION.torque_full_n_m), -1.0, 1.0)
    assert out.torque == pytest.approx(tuple(expected), abs=1e-12)
    assert out.thrust == pytest.approx(0.5)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_actuator_controls_end_at_full(axis, sign):
    tau = tuple(sign * 500.0 * (other == axis) for other in range(3))
    assert actuator_output(48.0, tau, (0.0,) * 3, CONVERSION).torque == tuple(x / 500.0 for x in tau)


def test_rates_pass_as_they_are():
    out = rates_output(24.0, (0.1, -0.2, 0.3), CONVERSION)
    assert out == (0.25, (0.1, -0.2, 0.3))


@given(lag=st.floats(0.02, 0.1), target=numbers(-5.0, 5.0))
def test_the_lead_makes_up_for_a_first_order_lag(lag, target):
    """Behind the lead a rotor of that lag answers with the filter's time constant instead of its own."""
    dt, slow, rotors, t = 1e-4, (0.0, 0.0, 0.0), np.zeros(3), 0.0
    shares = np.array([1.0, -0.5, 2.0])
    while t < LEAD_FILTER_S - 1e-9:
        ahead, slow = lead(tuple(target * shares), slow, lag, dt)
        rotors += (np.array(ahead) - rotors) * (1.0 - math.exp(-dt / lag))
        t += dt
    for rotor in rotors / shares:
        assert rotor == pytest.approx(target * (1.0 - math.exp(-1.0)), abs=0.02 * abs(target) + 1e-9)


def test_without_a_lag_nothing_is_led():
    ahead, _ = lead((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), 0.0, 0.004)
    slow = (0.0, 0.0, 0.0)
    _, slow = lead((1.0, 2.0, 3.0), slow, 0.0, 0.004)
    assert ahead == pytest.approx((1.0, 2.0, 3.0))
