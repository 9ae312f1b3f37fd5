"""The rate loop and the attitude loop on the body that they fly, and what odd setpoints do to them."""

from __future__ import annotations

import math

import pytest
from sim_cases import DT, HOVER, LEVEL, NOTHING, OFF, PAPER, rates, uneven, vehicle

from sim_link.inner_loops import (
    ATTITUDE,
    STOPPED_SETPOINT,
    TORQUE,
    LoopState,
    Setpoint,
    advance,
    attitude_rates,
    control,
    filtered_attitude,
    initial_loops,
    make_gains,
    normalisation,
)
from sim_link.loop_gains import hover_thrusts
from sim_link.physics import RigidState, at_rest, make_body
from sim_link.rotation import Quat, Vec3, exponential, from_yaw, logarithm, multiply, normalised, yaw_of
from sim_link.vehicle_file import VehicleFile

NAN = math.nan


class Flight:
    """A vehicle high in the air with its loops, starting in hover."""

    def __init__(self, craft: VehicleFile = PAPER, px4: str = "1.18", yaw: float = 0.0) -> None:
        self.body = make_body(craft, 9.81)
        self.gains = make_gains(craft, px4)
        self.dt = 1.0 / craft.loop_rate_hz
        self.rigid = at_rest((0.0, 0.0, -500.0), yaw, hover_thrusts(craft, craft.mass_kg * 9.81))
        self.loops = initial_loops(self.rigid.w)

    def fly(self, setpoint: Setpoint, seconds: float, every: int = 0) -> list[RigidState]:
        """Follow a setpoint, sent once or anew after `every` steps; return the states after each step."""
        states = []
        for i in range(round(seconds / self.dt)):
            fresh = i % every == 0 if every else i == 0
            self.rigid, self.loops, _ = advance(
                self.rigid, self.loops, setpoint, fresh, NOTHING, NOTHING, self.body, self.gains, 0.0, self.dt, 1
            )
            states.append(self.rigid)
        return states


def attitude(q: Quat, thrust: float = HOVER, yaw_rate: float = NAN) -> Setpoint:
    return Setpoint(ATTITUDE, thrust, NOTHING, q, yaw_rate, NOTHING)


def rise_and_overshoot(craft: VehicleFile, axis: int) -> tuple[float, float]:
    """Return the 63 % time of a small rate step over the stated lag, and its overshoot."""
    w = [0.0, 0.0, 0.0]
    w[axis] = 0.05
    flight = Flight(craft)
    answer = [0.0, *(s.w[axis] / 0.05 for s in flight.fly(rates((w[0], w[1], w[2])), 1.5))]
    level = 1.0 - math.exp(-1.0)
    k = next(i for i, y in enumerate(answer) if y >= level)
    rise = (k - 1 + (level - answer[k - 1]) / (answer[k] - answer[k - 1])) * flight.dt
    return rise / craft.rate_lag_s[axis], max(answer) - 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rate_loop_rises_like_the_stated_lag(axis: int) -> None:
    rise, overshoot = rise_and_overshoot(PAPER, axis)
    assert 0.85 < rise < 1.15
    assert overshoot < 0.10


@pytest.mark.parametrize(
    ("loop_hz", "rotor_lag_s", "rate_lag_s"),
    [
        (500.0, 0.0, 0.03),
        (500.0, 0.02, 0.1),
        (250.0, 0.05, 0.02),
        (1000.0, 0.02, 0.04),
        (500.0, 0.1, 0.2),
        (500.0, 0.02, 0.008),
    ],
)
def test_rate_loop_rises_like_the_stated_lag_on_other_vehicles(
    loop_hz: float, rotor_lag_s: float, rate_lag_s: float
) -> None:
    integral = min(0.5, 0.05 / rate_lag_s)  # a ratio that suits the lag; more of it overshoots more
    craft = vehicle(
        loop_rate_hz=loop_hz,
        rotor_lag_s=rotor_lag_s,
        rate_lag_s=(rate_lag_s,) * 3,
        rate_integral_1_s=(integral,) * 3,
    )
    rise, overshoot = rise_and_overshoot(craft, 0)
    assert 0.85 < rise < 1.15
    assert overshoot < 0.10


def test_rate_loop_lags_a_ramp_by_the_stated_lag() -> None:
    flight = Flight()
    slope = 0.5
    for i in range(150):
        flight.fly(rates((slope * (i + 1) * DT, 0.0, 0.0)), DT)
    lag = (slope * 150 * DT - flight.rigid.w[0]) / slope
    # The integral takes a little off the delay of P and D alone.
    assert 0.8 * 0.04 < lag < 1.05 * 0.04


def test_integral_takes_up_a_steady_torque() -> None:
    flight = Flight()
    weak = flight.body._replace(rotor_y_m=(0.26, -0.24, -0.24, 0.26))  # the mix does not know of this
    flight.body = weak
    last = flight.fly(rates(NOTHING), 12.0)[-1]
    assert abs(last.w[0]) < 3e-4  # a constant 0.08 rad/s without it
    assert 0.005 < abs(flight.loops.integral[0]) < 0.3


def test_integral_stands_still_on_the_ground_and_while_saturated_and_is_cleared_when_stopped() -> None:
    gains = make_gains(PAPER)
    rigid = at_rest(NOTHING, 0.0, OFF)
    state = initial_loops(NOTHING)._replace(integral=(0.1, 0.1, 0.1))
    small = rates((0.1, 0.1, 0.1))
    assert control(rigid, state, small, True, True, gains, DT)[1].integral == (0.1, 0.1, 0.1)
    grown = control(rigid, state, small, True, False, gains, DT)[1].integral
    assert all(0.1 < i < 0.11 for i in grown)
    assert control(rigid, state, rates((9.0, 9.0, 9.0)), True, False, gains, DT)[1].integral == (0.1, 0.1, 0.1)
    assert control(rigid, state, STOPPED_SETPOINT, True, False, gains, DT)[1].integral == NOTHING
    limit = initial_loops(NOTHING)._replace(integral=(0.3, 0.3, 0.3))
    assert control(rigid, limit, small, True, False, gains, DT)[1].integral == (0.3, 0.3, 0.3)


def test_nan_rate_holds_the_rate_of_arrival_until_the_next_setpoint() -> None:
    flight = Flight()
    flight.fly(rates((0.5, 0.0, 0.4)), 0.6)
    arrived = flight.rigid.w
    end = flight.fly(rates((0.0, 0.2, NAN)), 1.0)[-1]
    assert flight.loops.rates == (0.0, 0.2, arrived[2])
    assert end.w == pytest.approx((0.0, 0.2, arrived[2]), abs=0.02)


def test_infinite_setpoints_do_not_break_the_vehicle() -> None:
    flight = Flight()
    flight.fly(rates((math.inf, 0.0, -math.inf)), 0.05)
    flight.fly(attitude(LEVEL, yaw_rate=math.inf), 0.05)
    assert all(math.isfinite(x) for x in (*flight.rigid.w, *flight.rigid.q, *flight.rigid.rotor_n))
    assert flight.loops.rates[2] == pytest.approx(math.radians(200.0))


def test_nan_thrust_stops_the_rotors_while_it_lasts() -> None:
    flight = Flight()
    flight.fly(rates(NOTHING, NAN), 0.5)
    assert sum(flight.rigid.rotor_n) < 0.01
    flight.fly(rates(NOTHING), 0.5)
    assert sum(flight.rigid.rotor_n) == pytest.approx(PAPER.mass_kg * 9.81, rel=0.01)


def test_stopped_means_all_rotors_off() -> None:
    flight = Flight()
    flight.fly(STOPPED_SETPOINT, 1.0)
    assert sum(flight.rigid.rotor_n) < 1e-6


@pytest.mark.parametrize("yaw", [0.0, 1.0, math.pi / 2, 3.0, -2.0])
def test_attitude_loop_reaches_its_setpoint_at_any_heading(yaw: float) -> None:
    for tilt in ((0.3, 0.0, 0.0), (0.0, -0.4, 0.0), (0.2, 0.3, 0.0)):
        flight = Flight(yaw=yaw)
        goal = multiply(from_yaw(yaw), exponential(tilt))
        states = flight.fly(attitude(goal), 1.5, every=2)
        left = logarithm(multiply((goal[0], -goal[1], -goal[2], -goal[3]), states[-1].q))
        assert max(abs(e) for e in left) < 2e-3
        # It begins to turn about the body axes that the error names.
        assert states[40].w[0] * tilt[0] >= 0.0
        assert states[40].w[1] * tilt[1] >= 0.0
        assert abs(states[40].w[2]) < 0.05


def test_roll_to_the_right_moves_east_when_heading_north_and_pitching_down_moves_north() -> None:
    right = Flight().fly(attitude(exponential((0.2, 0.0, 0.0))), 1.0, every=5)[-1]
    assert right.v[1] > 0.5
    assert abs(right.v[0]) < 1e-6
    forward = Flight().fly(attitude(exponential((0.0, -0.2, 0.0))), 1.0, every=5)[-1]
    assert forward.v[0] > 0.5
    assert abs(forward.v[1]) < 1e-6
    turned = Flight().fly(attitude(from_yaw(0.5)), 3.0, every=5)[-1]
    assert yaw_of(turned.q) == pytest.approx(0.5, abs=0.01)


def test_thrust_direction_comes_before_heading_and_rates_are_limited() -> None:
    gains = make_gains(PAPER)
    small = attitude_rates(LEVEL, exponential((0.0, 0.0, 0.1)), NAN, gains)
    assert small == pytest.approx((0.0, 0.0, 0.28), rel=2e-3)  # the stated gain, whatever the weight
    both = multiply(exponential((0.3, 0.0, 0.0)), exponential((0.0, 0.0, 1.0)))
    p, q, r = attitude_rates(LEVEL, both, NAN, gains)
    # Of the heading error of 1 rad the weight leaves 0.4 rad: half angles 0.15 and 0.2.
    assert p == pytest.approx(2.0 * 6.0 * math.sin(0.15) * math.cos(0.2))
    assert q == pytest.approx(-2.0 * 6.0 * math.sin(0.15) * math.sin(0.2))
    assert r == pytest.approx(2.0 * 2.8 / 0.4 * math.cos(0.15) * math.sin(0.2))
    assert attitude_rates(LEVEL, exponential((0.0, 0.0, 3.0)), NAN, gains)[2] == math.radians(200.0)
    assert attitude_rates(LEVEL, exponential((2.0, 0.0, 0.0)), NAN, gains)[0] == math.radians(220.0)


def test_the_short_way_round_and_upside_down() -> None:
    gains = make_gains(PAPER)
    goal = exponential((0.2, 0.0, 0.0))
    flipped = (-goal[0], -goal[1], -goal[2], -goal[3])
    assert attitude_rates(LEVEL, flipped, NAN, gains) == pytest.approx(attitude_rates(LEVEL, goal, NAN, gains))
    over = attitude_rates(LEVEL, exponential((math.pi, 0.0, 0.0)), NAN, gains)
    assert over == pytest.approx((math.radians(220.0), 0.0, 0.0), abs=1e-9)


def test_yaw_rate_feed_forward_is_about_the_inertial_down_axis() -> None:
    gains = make_gains(PAPER)
    tilted = exponential((0.5, 0.0, 0.0))
    got = attitude_rates(tilted, tilted, 0.8, gains)
    assert got == pytest.approx((0.0, 0.8 * math.sin(0.5), 0.8 * math.cos(0.5)), abs=1e-12)


@pytest.mark.parametrize(("rate_hz", "lag_s"), [(20, 0.017), (50, 0.030), (100, 0.035), (250, 0.038)])
def test_reference_model_lags_a_stream_as_px4_was_measured_to(rate_hz: int, lag_s: float) -> None:
    dt, slope = 1.0 / rate_hz, 0.5
    q_ref: Quat = LEVEL
    w_ref: Vec3 = NOTHING
    for i in range(1, rate_hz + 1):
        q_ref, w_ref = filtered_attitude(q_ref, w_ref, exponential((slope * i * dt, 0.0, 0.0)), dt, 50.0)
    lag = 1.0 - logarithm(q_ref)[0] / slope
    assert lag == pytest.approx(lag_s, abs=0.0025)


def test_reference_model_reaches_63_percent_of_a_step_after_about_40_ms() -> None:
    q_ref: Quat = LEVEL
    w_ref: Vec3 = NOTHING
    reached = []
    for _ in range(30):
        q_ref, w_ref = filtered_attitude(q_ref, w_ref, exponential((0.3, 0.0, 0.0)), 0.004, 50.0)
        reached.append(logarithm(q_ref)[0] / 0.3)
    first = next(i for i, y in enumerate(reached) if y > 0.63) * 0.004
    assert 0.034 < first < 0.046
    assert max(reached) <= 1.0 + 1e-12


def test_first_setpoint_is_taken_as_it_is_and_the_model_moves_only_with_setpoints() -> None:
    flight = Flight()
    goal = exponential((0.2, 0.0, 0.0))
    flight.fly(attitude(goal), DT)
    assert flight.loops.q_ref == pytest.approx(goal)
    flight.fly(attitude(LEVEL), 0.02)
    held = flight.loops.q_ref
    flight.fly(attitude(LEVEL), DT)
    assert held != pytest.approx(LEVEL, abs=1e-3)
    assert flight.loops.q_ref != pytest.approx(held, abs=1e-6)


@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (1.0, NAN, 0.0, 0.0)])
def test_one_bad_quaternion_poisons_118_for_good_and_113_for_as_long_as_it_lasts(bad: Quat) -> None:
    goal = exponential((0.3, 0.0, 0.0))
    for px4, recovers in (("1.18", False), ("1.13", True)):
        flight = Flight(px4=px4)
        flight.fly(attitude(LEVEL), 0.1, every=5)
        flight.fly(rates((0.2, 0.0, 0.0)), 0.3)
        turning = flight.rigid.w[0]
        flight.fly(attitude(bad), 0.01)
        assert all(math.isnan(c) for c in flight.loops.q_ref)
        # Zero rate error in each step: the vehicle goes on turning.
        assert flight.rigid.w[0] == pytest.approx(turning, abs=0.05)
        flight.fly(attitude(goal), 2.0, every=5)
        assert all(math.isfinite(c) for c in (*flight.rigid.q, *flight.rigid.w, *flight.rigid.rotor_n))
        error = math.hypot(*(a - b for a, b in zip(normalised(flight.rigid.q), goal, strict=True)))
        assert (error < 0.01) is recovers
        # Rates do not pass the model: they work all the same.
        assert flight.fly(rates((-0.5, 0.0, 0.0)), 0.6)[-1].w[0] == pytest.approx(-0.5, abs=0.05)
        assert any(math.isnan(c) for c in flight.loops.q_ref) is not recovers


def test_torque_goes_straight_to_the_rotors() -> None:
    craft = uneven()
    flight, norm = Flight(craft), normalisation(craft)
    control_value = (0.02, -0.03, 0.05)
    before = flight.rigid.w
    flight.rigid = flight.rigid._replace(w=(0.0, 0.0, 0.0))
    setpoint = Setpoint(TORQUE, HOVER, NOTHING, LEVEL, 0.0, control_value)
    end = flight.fly(setpoint, 0.5)[-1]
    lag = 0.5 - 0.05 * (1.0 - math.exp(-10.0))  # what the rotor lag leaves of the torque's time
    j = craft.inertia_kg_m2
    for axis in range(3):
        expected = control_value[axis] * norm.torque_max_n_m[axis] / j[axis] * lag
        assert end.w[axis] - before[axis] == pytest.approx(expected, rel=0.12, abs=0.03)
    idle = Setpoint(TORQUE, HOVER, NOTHING, LEVEL, 0.0, (NAN, NAN, NAN))
    commands, state = control(end, flight.loops, idle, True, False, flight.gains, DT)
    assert commands == control(end, flight.loops, idle._replace(torque=NOTHING), True, False, flight.gains, DT)[0]
    assert state.integral == NOTHING


def test_many_steps_in_one_call_are_the_same_as_one_at_a_time() -> None:
    one, many = Flight(), Flight()
    setpoint = attitude(exponential((0.3, 0.2, 0.5)), yaw_rate=0.2)
    one.fly(setpoint, 0.1)
    rigid, loops, _ = advance(
        many.rigid, many.loops, setpoint, True, NOTHING, NOTHING, many.body, many.gains, 0.0, DT, 50
    )
    assert rigid == one.rigid
    assert loops == one.loops


def test_advance_tells_the_touchdown() -> None:
    flight = Flight()
    rigid = at_rest((0.0, 0.0, -0.2), 0.0, OFF)
    arguments = (NOTHING, NOTHING, flight.body, flight.gains, 0.0, DT)
    rigid, loops, touch = advance(rigid, flight.loops, STOPPED_SETPOINT, True, *arguments, 150)
    assert touch.on_ground
    assert touch.impact_m_s == pytest.approx(math.sqrt(2.0 * 9.81 * 0.2), abs=0.03)
    _, _, later = advance(rigid, loops, STOPPED_SETPOINT, False, *arguments, 10)
    assert later == (True, 0.0)


def test_unknown_version_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1\.18, 1\.13"):
        make_gains(PAPER, "2.0")


def test_loop_state_has_no_setpoint_at_start() -> None:
    state = initial_loops((0.1, 0.2, 0.3))
    assert state == LoopState(NOTHING, (0.1, 0.2, 0.3), NOTHING, LEVEL, NOTHING, 1000.0)
