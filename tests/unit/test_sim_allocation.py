"""Sequential desaturation: cases computed by hand, and what must hold for any command."""

from __future__ import annotations

import math
import random

import pytest
from sim_cases import PAPER, uneven, vehicle

from sim_link.allocation import allocate, rotor_command
from sim_link.loop_gains import hover_thrusts, make_gains, normalisation
from sim_link.physics import make_body, rotor_target, wrench
from sim_link.rotation import Vec3, Vec4

GAINS = make_gains(PAPER)


def test_normalisation_of_the_paper_vehicle() -> None:
    norm = normalisation(PAPER)
    # 12 N = half a rotor's thrust, times four arms of 0.25 m or 0.05 m.
    assert norm.torque_max_n_m == pytest.approx((12.0, 12.0, 2.4))
    assert norm.thrust_max_n == pytest.approx(96.0)


@pytest.mark.parametrize(
    ("torque", "thrust", "shares", "delivered"),
    [
        # Enough room: half of each control, with the geometry's signs (front right, rear left, front left, rear right).
        ((0.2, 0.0, 0.0), 0.5, (0.4, 0.6, 0.6, 0.4), 1.0),
        ((0.0, 0.2, 0.0), 0.5, (0.6, 0.4, 0.6, 0.4), 1.0),
        ((0.0, 0.0, 0.2), 0.5, (0.6, 0.6, 0.4, 0.4), 1.0),
        # High thrust: collective goes down for roll.
        ((0.8, 0.0, 0.0), 0.8, (0.2, 1.0, 1.0, 0.2), 1.0),
        # Low thrust: roll is halved, collective stays.
        ((0.8, 0.0, 0.0), 0.2, (0.0, 0.4, 0.4, 0.0), 0.5),
        # Both ends at once: collective to the middle, then the torque to what fits.
        ((1.0, 1.0, 0.0), 0.7, (0.5, 0.5, 1.0, 0.0), 0.5),
        # No thrust, no torque; below and above the range of thrust.
        ((1.0, -1.0, 1.0), 0.0, (0.0, 0.0, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.0), -0.3, (0.0, 0.0, 0.0, 0.0), 1.0),
        ((0.0, 0.0, 0.0), 1.7, (1.0, 1.0, 1.0, 1.0), 1.0),
    ],
)
def test_by_hand(torque: Vec3, thrust: float, shares: Vec4, delivered: float) -> None:
    got, share = allocate(torque, thrust, GAINS)
    assert got == pytest.approx(shares, abs=1e-12)
    assert share[0] == share[1] == pytest.approx(delivered)


def test_yaw_is_sacrificed_first_and_has_a_margin_at_full_thrust() -> None:
    # At full thrust yaw may exceed the range by 15 %, for which the collective goes down.
    shares, delivered = allocate((0.0, 0.0, 1.0), 1.0, GAINS)
    assert shares == pytest.approx((1.0, 1.0, 0.7, 0.7))
    assert delivered == pytest.approx((1.0, 1.0, 0.3))
    # Roll has taken the room at the lower end: no yaw is left, roll is whole.
    shares, delivered = allocate((0.4, 0.0, 1.0), 0.2, GAINS)
    assert shares == pytest.approx((0.0, 0.4, 0.4, 0.0))
    assert delivered == pytest.approx((1.0, 1.0, 0.0), abs=1e-12)


def test_nan_thrust_stops_all_rotors() -> None:
    assert allocate((0.5, 0.5, 0.5), math.nan, GAINS) == ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_any_command_stays_in_range_never_raises_thrust_and_keeps_the_direction_of_roll_and_pitch() -> None:
    draw = random.Random(7)
    limited = exact = 0
    for _ in range(3000):
        yaw = draw.choice((0.0, draw.uniform(-1, 1)))
        torque = (draw.uniform(-1, 1), draw.uniform(-1, 1), yaw)
        thrust = draw.uniform(0, 1)
        shares, delivered = allocate(torque, thrust, GAINS)
        a, b, c, d = shares
        assert all(0.0 <= s <= 1.0 for s in shares)
        assert (a + b + c + d) / 4.0 <= thrust + 1e-12
        assert all(0.0 <= s <= 1.0 for s in delivered)
        # With rotors at both ends, yaw's 15 % beyond the range are cut off in the end, half at each.
        cut = 0.0751 if yaw != 0.0 and min(shares) == 0.0 and max(shares) == 1.0 else 1e-9
        assert (b + c - a - d) / 2.0 == pytest.approx(torque[0] * delivered[0], abs=cut)
        assert (a + c - b - d) / 2.0 == pytest.approx(torque[1] * delivered[1], abs=cut)
        assert (a + b - c - d) / 2.0 == pytest.approx(torque[2] * delivered[2], abs=cut)
        exact += cut < 1e-3
        limited += delivered[0] < 1.0
    assert 100 < limited < 2900
    assert exact > 2000


@pytest.mark.parametrize("craft", [PAPER, uneven()])
@pytest.mark.parametrize("curve", [0.0, 0.4, 1.0])
def test_the_physics_makes_the_wrench_that_the_controls_mean(craft: object, curve: float) -> None:
    chosen = vehicle(rotor_x_m=craft.rotor_x_m, rotor_y_m=craft.rotor_y_m, curve_factor=curve)
    b, norm = make_body(chosen, 9.81), normalisation(chosen)
    torque, thrust = (0.08, -0.06, 0.05), 0.5
    shares, _ = allocate(torque, thrust, make_gains(chosen))
    rotors = tuple(rotor_target(rotor_command(s, curve), b) for s in shares)
    wanted = (thrust * norm.thrust_max_n, *(t * m for t, m in zip(torque, norm.torque_max_n_m, strict=True)))
    assert wrench(rotors, b) == pytest.approx(wanted, abs=1e-9)


def test_rotor_command_inverts_the_thrust_curve_at_its_ends() -> None:
    for curve in (0.0, 0.5, 1.0):
        assert rotor_command(0.0, curve) == 0.0
        assert rotor_command(1.0, curve) == pytest.approx(1.0)
    assert rotor_command(0.25, 1.0) == pytest.approx(0.5)


def test_hover_thrusts_carry_without_torque() -> None:
    craft = uneven()
    assert wrench(hover_thrusts(craft, 46.7), make_body(craft, 9.81)) == pytest.approx((46.7, 0.0, 0.0, 0.0), abs=1e-12)
