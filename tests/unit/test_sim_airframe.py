"""The whole vehicle below its modes: start, truth, determinism, and the same numbers with both engines."""

from __future__ import annotations

import math

import pytest
from sim_cases import HOVER, LEVEL, NOTHING, PAPER, noiseless, rates, uneven, vehicle

from sim_link.airframe import START_US, Airframe, Truth
from sim_link.inner_loops import ATTITUDE, STOPPED_SETPOINT, TORQUE, Setpoint
from sim_link.rotation import body_z, exponential, yaw_of
from sim_link.vehicle_file import VehicleFile
from sim_link.wind import World

WINDY = World(
    force_n=(4.76, -2.0, 1.0), gravity_factor=1.05, wind_m_s=(4.0, 3.0, 0.0), turbulence=0.3, ground_d_m=0.0, seed=9
)
DRAGGY = vehicle(drag_1_s=0.6)


def airframe(
    craft: VehicleFile = PAPER, world: World | None = None, *, seed: int = 1, engine: str = "python", px4: str = "1.18"
) -> Airframe:
    return Airframe(craft, world or World(), seed=seed, engine=engine, start=((1.0, 2.0, -10.0), 0.8), px4=px4)


def varied_flight(a: Airframe) -> list[Truth]:
    """Fly through all modes, limits, odd inputs and the ground; return the truths."""
    plan = [
        (rates((1.0, -0.5, 0.3)), 60),
        (rates((6.0, math.nan, -3.0), 0.9), 80),
        (Setpoint(ATTITUDE, 0.55, NOTHING, exponential((0.3, -0.2, 2.0)), 0.2, NOTHING), 120),
        (Setpoint(ATTITUDE, 0.02, NOTHING, exponential((-0.5, 0.2, 1.0)), math.nan, NOTHING), 60),
        (Setpoint(TORQUE, 0.5, NOTHING, LEVEL, 0.0, (0.05, -0.05, 0.1)), 40),
        (Setpoint(ATTITUDE, 0.5, NOTHING, (math.nan, 0.0, 0.0, 0.0), math.nan, NOTHING), 20),
        (rates(NOTHING, math.nan), 20),
        (STOPPED_SETPOINT, 700),
    ]
    truths = []
    for setpoint, steps in plan:
        for i in range(steps // 4):
            a.advance(setpoint, i % 2 == 0, 4)
            truths.append(a.truth())
    return truths


def numbers(t: Truth) -> list[float]:
    return [*t.p, *t.v, *t.q, *t.w, *t.rotor_n, *t.disturbance_m_s2]


def test_starts_on_the_ground_and_stays_there() -> None:
    a = Airframe(PAPER, World(force_n=(3.0, 0.0, 0.0), ground_d_m=-1.5), seed=1, engine="python")
    assert a.on_ground
    a.advance(STOPPED_SETPOINT, True, 500)
    assert a.on_ground
    assert a.rigid.p == (0.0, 0.0, -1.5)
    assert a.rigid.v == NOTHING
    assert a.impact_speed_m_s == 0.0
    assert a.t_us == START_US + 1_000_000


@pytest.mark.parametrize("craft", [PAPER, uneven(), vehicle(curve_factor=0.7)])
def test_starts_in_the_air_in_hover_trim(craft: VehicleFile) -> None:
    world = World(gravity_factor=1.05, force_n=(0.0, 0.0, -2.0))
    a = airframe(craft, world)
    load = craft.mass_kg * 9.81 * 1.05 - 2.0
    assert not a.on_ground
    assert a.truth().thrust_n == pytest.approx(load)
    a.advance(rates(NOTHING, load / (4.0 * craft.rotor_thrust_max_n)), True, 1000)
    assert a.rigid.p == pytest.approx((1.0, 2.0, -10.0), abs=1e-6)
    assert yaw_of(a.rigid.q) == pytest.approx(0.8, abs=1e-6)
    assert a.inner_state() is a.rigid


def test_truth_names_the_disturbance_that_the_motion_shows() -> None:
    a = airframe(DRAGGY, WINDY)
    a.advance(rates((0.3, -0.2, 0.1)), True, 400)
    before, step_s = a.truth(), a.dt_us * 1e-6
    a.advance(rates((0.3, -0.2, 0.1)), False, 1)
    after = a.truth()
    assert after.t_us - before.t_us == 2000
    z0, z1 = body_z(before.q), body_z(after.q)
    for i in range(3):
        speed = 0.5 * (before.v[i] + after.v[i])
        thrust = 0.5 * (before.thrust_n * z0[i] + after.thrust_n * z1[i]) / 4.76
        known = (9.81 if i == 2 else 0.0) - thrust - 0.6 * speed
        shown = (after.v[i] - before.v[i]) / step_s - known
        assert before.disturbance_m_s2[i] == pytest.approx(shown, abs=2e-4)


def test_disturbance_of_the_papers_world() -> None:
    a = airframe(PAPER, World(force_n=(4.76, 0.0, 0.0), gravity_factor=1.05, wind_m_s=(9.0, 0.0, 0.0)))
    assert a.truth().disturbance_m_s2 == pytest.approx((1.0, 0.0, 0.4905))
    a.set_force((0.0, 4.76, 0.0))
    assert a.truth().disturbance_m_s2 == pytest.approx((0.0, 1.0, 0.4905))
    windy = airframe(DRAGGY)
    windy.set_wind((0.0, 5.0, 0.0), 0.0)
    assert windy.truth().disturbance_m_s2 == pytest.approx((0.0, 3.0, 0.0))


def test_belief_is_late_and_noisy() -> None:
    a = airframe()
    history = {}
    for _ in range(100):
        a.advance(rates((0.2, 0.1, 0.0)), True, 1)
        history[a.t_us] = a.truth()
    e = a.believed()
    assert e.t_us == a.t_us - 20_000
    then = history[e.t_us]
    assert e.p == pytest.approx(then.p, abs=0.012)
    assert e.p != then.p
    quiet = airframe(noiseless())
    quiet.advance(rates((0.2, 0.1, 0.0)), True, 100)
    for believed, true in zip(quiet.believed()[1:], quiet.rigid, strict=False):
        assert believed == pytest.approx(true, abs=1e-15)


def test_same_seeds_same_flight_however_the_steps_are_divided() -> None:
    a, b = airframe(DRAGGY, WINDY), airframe(DRAGGY, WINDY)
    setpoint = rates((0.5, 0.2, -0.1), 0.6)
    a.advance(setpoint, True, 210)
    beliefs = []
    for i in range(70):
        b.advance(setpoint, i == 0, 3)
        beliefs.append(b.believed())
    assert a.rigid == b.rigid
    assert a.believed() == b.believed()
    other = airframe(DRAGGY, WINDY, seed=2)
    other.advance(setpoint, True, 210)
    assert other.rigid == a.rigid  # the noise of what is believed does not move the vehicle
    assert other.believed() != a.believed()


def test_hardest_touchdown_is_kept() -> None:
    a = airframe(PAPER, World())
    a.advance(STOPPED_SETPOINT, True, 1200)
    assert a.on_ground
    hard = a.impact_speed_m_s
    assert 12.0 < hard < 14.1  # 10 m of fall, braked by the rotors' last thrust
    a.advance(rates(NOTHING, 1.3 * HOVER), True, 100)
    a.advance(STOPPED_SETPOINT, True, 300)
    assert a.impact_speed_m_s == hard


@pytest.mark.numba
def test_both_engines_give_the_same_numbers() -> None:
    for px4 in ("1.18", "1.13"):
        plain = varied_flight(airframe(DRAGGY, WINDY, engine="python", px4=px4))
        fast = varied_flight(airframe(DRAGGY, WINDY, engine="numba", px4=px4))
        assert any(t.p[2] == 0.0 for t in plain)
        for a, b in zip(plain, fast, strict=True):
            assert numbers(b) == pytest.approx(numbers(a), rel=1e-12, abs=1e-12)
            assert all(math.isfinite(x) for x in numbers(a))
