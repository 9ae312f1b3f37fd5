"""What the ground does: rest without creeping, friction, lift-off, touchdown speed, turning the vehicle upright."""

from __future__ import annotations

import math

import pytest
from sim_cases import DT, OFF, body

from sim_link.physics import RigidState, at_rest, contact, step
from sim_link.rotation import Quat, Vec3, Vec4, exponential, inertial_z_in_body, multiply, norm, yaw_of

GROUND = -3.0


def run(
    state: RigidState, command: Vec4, seconds: float, force: Vec3 = (0.0, 0.0, 0.0)
) -> tuple[RigidState, list[float]]:
    """Return the state after a while and what `contact` said at each step."""
    b = body()
    said = []
    for _ in range(round(seconds / DT)):
        state, sinking = contact(state, step(state, command, (0.0, 0.0, 0.0), force, b, DT), GROUND, b, DT)
        said.append(sinking)
    return state, said


def on_ground(q: Quat, v: Vec3 = (0.0, 0.0, 0.0), w: Vec3 = (0.0, 0.0, 0.0)) -> RigidState:
    return RigidState((1.0, 2.0, GROUND), v, q, w, OFF)


def test_rests_without_moving_under_side_force_and_unequal_rotors() -> None:
    start = at_rest((1.0, 2.0, GROUND), 0.7, OFF)
    end, said = run(start, (0.1, 0.08, 0.09, 0.1), 20.0, force=(5.0, -5.0, 0.0))
    assert end.p == start.p
    assert end.v == (0.0, 0.0, 0.0)
    assert end.w == (0.0, 0.0, 0.0)
    assert end.q == pytest.approx(start.q, abs=1e-12)
    assert all(s >= 0.0 for s in said)


def test_friction_stops_sliding_after_the_right_distance() -> None:
    end, _ = run(on_ground((1.0, 0.0, 0.0, 0.0), v=(2.0, 0.0, 0.0)), OFF, 1.0)
    assert end.v == (0.0, 0.0, 0.0)
    assert end.p[0] - 1.0 == pytest.approx(2.0**2 / (2.0 * 0.6 * 9.81), rel=0.01)
    assert end.p[1] == 2.0


def test_a_force_beyond_friction_pushes_it_along() -> None:
    end, _ = run(on_ground((1.0, 0.0, 0.0, 0.0)), OFF, 1.0, force=(4.76 * (0.6 * 9.81 + 1.0), 0.0, 0.0))
    assert end.v[0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("share", "lifts"), [(0.99, False), (1.01, True)])
def test_lifts_off_when_thrust_exceeds_weight(share: float, lifts: bool) -> None:
    hover = 4.76 * 9.81 / 96.0
    end, said = run(at_rest((0.0, 0.0, GROUND), 0.0, OFF), (share * hover,) * 4, 2.0)
    assert (end.p[2] < GROUND - 0.05) is lifts
    assert (said[-1] < 0.0) is lifts


def test_touchdown_does_not_sink_or_bounce_and_tells_its_speed() -> None:
    end, said = run(at_rest((0.0, 0.0, GROUND - 1.0), 0.0, OFF), OFF, 1.0)
    assert end.p[2] == GROUND
    assert end.v == (0.0, 0.0, 0.0)
    assert max(said) == pytest.approx(math.sqrt(2.0 * 9.81 * 1.0), abs=9.81 * DT)
    first = next(i for i, s in enumerate(said) if s >= 0.0)
    assert all(s == -1.0 for s in said[:first])
    assert said[-1] == pytest.approx(9.81 * DT)


@pytest.mark.parametrize("tilt", [(0.5, 0.0, 0.0), (0.0, -0.6, 0.0), (-0.4, 0.7, 0.0)])
def test_gear_turns_a_tilted_vehicle_upright_and_keeps_its_heading(tilt: Vec3) -> None:
    start = on_ground(multiply(exponential((0.0, 0.0, 2.0)), exponential(tilt)))
    end, _ = run(start, OFF, 2.0)
    assert inertial_z_in_body(end.q)[2] == pytest.approx(1.0, abs=1e-9)
    assert norm(end.w) < 1e-9
    assert abs(math.remainder(yaw_of(end.q) - yaw_of(start.q), 2.0 * math.pi)) < 0.25


def test_an_overturned_vehicle_stays_overturned() -> None:
    start = on_ground(exponential((2.5, 0.0, 0.0)), w=(1.0, 0.0, 0.5))
    end, _ = run(start, OFF, 2.0)
    assert inertial_z_in_body(end.q)[2] < -0.5
    assert end.w == (0.0, 0.0, 0.0)
