"""The rigid body against closed forms, hand-computed signs and its own order of convergence."""

from __future__ import annotations

import itertools
import math

import pytest
from sim_cases import DT, NOTHING, OFF, body

from sim_link.physics import Body, RigidState, at_rest, step, wrench
from sim_link.rotation import Vec3, Vec4, dot, norm, rotate, yaw_of


def fly(state: RigidState, command: Vec4, b: Body, seconds: float, dt: float = DT, air: Vec3 = NOTHING) -> RigidState:
    for _ in range(round(seconds / dt)):
        state = step(state, command, air, NOTHING, b, dt)
    return state


def test_free_fall_is_a_parabola() -> None:
    end = fly(at_rest((1.0, 2.0, -100.0), 0.0, OFF), OFF, body(), 2.0)
    assert end.p == pytest.approx((1.0, 2.0, -100.0 + 0.5 * 9.81 * 4.0), abs=1e-9)
    assert end.v == pytest.approx((0.0, 0.0, 9.81 * 2.0), abs=1e-10)


def test_fall_with_drag_follows_its_closed_form_to_terminal_speed() -> None:
    b = body(drag_1_s=0.8)
    end = fly(at_rest((0.0, 0.0, 0.0), 0.0, OFF), OFF, b, 3.0)
    assert end.v[2] == pytest.approx(9.81 / 0.8 * (1.0 - math.exp(-2.4)), abs=1e-9)
    assert fly(end, OFF, b, 30.0).v[2] == pytest.approx(9.81 / 0.8, abs=1e-6)


def test_drag_pulls_towards_the_air_and_force_acts_on_the_mass() -> None:
    b = body(drag_1_s=1.5, gravity_m_s2=0.0)
    start = at_rest((0.0, 0.0, 0.0), 0.0, OFF)
    assert fly(start, OFF, b, 20.0, air=(3.0, -2.0, 1.0)).v == pytest.approx((3.0, -2.0, 1.0), abs=1e-9)
    pushed = start
    for _ in range(500):
        pushed = step(pushed, OFF, NOTHING, (4.76, 0.0, -9.52), body(gravity_m_s2=0.0), DT)
    assert pushed.v == pytest.approx((1.0, 0.0, -2.0), abs=1e-10)


def test_hover_trim_stays_where_it_is() -> None:
    b = body()
    share = b.mass_kg * 9.81 / (4.0 * b.rotor_thrust_max_n)
    each = share * b.rotor_thrust_max_n
    end = fly(at_rest((3.0, 4.0, -5.0), 1.0, (each,) * 4), (share,) * 4, b, 10.0)
    assert end.p == pytest.approx((3.0, 4.0, -5.0), abs=1e-9)
    assert norm(end.v) < 1e-10
    assert yaw_of(end.q) == pytest.approx(1.0, abs=1e-12)


def test_rotor_lag_is_exact_for_any_step() -> None:
    for dt in (0.002, 0.02):
        end = fly(at_rest(NOTHING, 0.0, (5.0, 0.0, 0.0, 0.0)), (1.0, 0.5, 0.0, 2.0), body(), 0.1, dt)
        left = math.exp(-0.1 / 0.05)
        expected = (24.0 - 19.0 * left, 12.0 * (1.0 - left), 0.0, 24.0 * (1.0 - left))
        assert end.rotor_n == pytest.approx(expected, abs=1e-12)


def test_thrust_curve_saturation_and_rotors_without_lag() -> None:
    b = body(rotor_lag_s=0.0, curve_factor=0.6)
    end = step(at_rest(NOTHING, 0.0, OFF), (0.5, -1.0, 7.0, math.nan), NOTHING, NOTHING, b, DT)
    assert end.rotor_n == pytest.approx((24.0 * (0.6 * 0.25 + 0.4 * 0.5), 0.0, 24.0, 0.0), abs=1e-12)


def test_moments_have_the_signs_of_forward_right_down() -> None:
    b = body()
    assert wrench((1.0, 1.0, 1.0, 1.0), b) == pytest.approx((4.0, 0.0, 0.0, 0.0))
    # Thrust at the left (rear left, front left) rolls right, at the front pitches up, of the first two yaws right.
    assert wrench((0.0, 1.0, 1.0, 0.0), b) == pytest.approx((2.0, 0.5, 0.0, 0.0))
    assert wrench((1.0, 0.0, 1.0, 0.0), b) == pytest.approx((2.0, 0.0, 0.5, 0.0))
    assert wrench((1.0, 1.0, 0.0, 0.0), b) == pytest.approx((2.0, 0.0, 0.0, 0.1))


@pytest.mark.parametrize(
    ("command", "axis"),
    [((0.45, 0.5, 0.5, 0.45), "roll"), ((0.5, 0.45, 0.5, 0.45), "pitch"), ((0.5, 0.5, 0.45, 0.45), "yaw")],
)
def test_unequal_rotors_turn_and_move_the_vehicle_the_right_way(command: Vec4, axis: str) -> None:
    end = fly(at_rest((0.0, 0.0, -50.0), 0.0, (11.5,) * 4), command, body(), 0.2)
    if axis == "roll":  # heading north: right side down, flies east
        assert end.w[0] > 0.1
        assert end.v[1] > 1e-3
        assert abs(end.v[0]) < 1e-9
    elif axis == "pitch":  # nose up, flies south
        assert end.w[1] > 0.1
        assert end.v[0] < -1e-3
        assert abs(end.v[1]) < 1e-9
    else:  # nose right
        assert end.w[2] > 0.02
        assert yaw_of(end.q) > 1e-3


def test_constant_yaw_moment_gives_a_quadratic_angle() -> None:
    b = body(rotor_lag_s=0.0, gravity_m_s2=0.0)
    end = fly(at_rest(NOTHING, 0.0, OFF), (0.1, 0.1, 0.0, 0.0), b, 1.0)
    acceleration = 2.0 * 2.4 * 0.05 / 0.15
    assert end.w == pytest.approx((0.0, 0.0, acceleration), abs=1e-10)
    assert yaw_of(end.q) == pytest.approx(0.5 * acceleration, abs=1e-10)


def test_free_rotation_conserves_energy_and_momentum_over_a_minute() -> None:
    b = body(gravity_m_s2=0.0)
    jx, jy, jz = b.inertia_kg_m2

    def energy(s: RigidState) -> float:
        return dot((jx * s.w[0], jy * s.w[1], jz * s.w[2]), s.w)

    def momentum(s: RigidState) -> Vec3:
        return rotate(s.q, (jx * s.w[0], jy * s.w[1], jz * s.w[2]))

    state = RigidState(NOTHING, NOTHING, (1.0, 0.0, 0.0, 0.0), (3.0, 0.5, -2.0), OFF)
    e0, l0 = energy(state), momentum(state)
    for _ in range(60):
        state = fly(state, OFF, b, 1.0)
        l1 = momentum(state)
        assert energy(state) == pytest.approx(e0, rel=1e-9)
        assert norm((l1[0] - l0[0], l1[1] - l0[1], l1[2] - l0[2])) < 1e-9 * norm(l0)
        assert sum(c * c for c in state.q) == pytest.approx(1.0, abs=1e-15)


def test_converges_with_order_four() -> None:
    b = body(drag_1_s=0.7, curve_factor=0.3)
    start = RigidState(
        (0.0, 0.0, 0.0), (3.0, -1.0, 2.0), (1.0, 0.0, 0.0, 0.0), (3.0, -2.0, 4.0), (10.0, 5.0, 20.0, 0.0)
    )
    command = (0.7, 0.5, 0.6, 0.55)

    def numbers(dt: float) -> list[float]:
        end = fly(start, command, b, 0.8, dt, (5.0, 1.0, -1.0))
        return [*end.p, *end.v, *end.q, *end.w]

    exact = numbers(0.8 / 4096)
    errors = [max(abs(a - e) for a, e in zip(numbers(0.8 / n), exact, strict=True)) for n in (32, 64, 128)]
    assert errors[2] < 1e-6
    for coarse, fine in itertools.pairwise(errors):
        assert 3.7 < math.log2(coarse / fine) < 4.5
    # The step that the vehicles use.
    assert max(abs(a - e) for a, e in zip(numbers(0.002), exact, strict=True)) < 1e-8
