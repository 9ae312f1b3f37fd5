"""The position controller: its limits one by one, and flights with it."""

from __future__ import annotations

import math

import pytest
from sim_cases import HOVER, LEVEL, NOTHING, PAPER, noiseless, vehicle

from sim_link.airframe import Airframe, Truth
from sim_link.inner_loops import ATTITUDE
from sim_link.position_loop import (
    PositionParameters,
    PositionSetpoint,
    PositionState,
    initial_position_state,
    limited_thrust,
    position_control,
    thrust_attitude,
    wanted_thrust,
)
from sim_link.rotation import Vec3, body_z, from_yaw, norm, rotate, yaw_of
from sim_link.vehicle_file import VehicleFile
from sim_link.wind import World

NAN = math.nan
ANY = (NAN, NAN, NAN)
PARAMETERS = PositionParameters(MPC_THR_HOVER=HOVER)
START = initial_position_state(NOTHING)


def hold(p: Vec3, yaw: float = 0.0) -> PositionSetpoint:
    return PositionSetpoint(p, ANY, ANY, yaw, NAN)


def fly(
    setpoint: PositionSetpoint,
    seconds: float,
    world: World,
    *,
    craft: VehicleFile = PAPER,
    start: tuple[Vec3, float] = ((0.0, 0.0, -10.0), 0.0),
    parameters: PositionParameters = PARAMETERS,
) -> tuple[Airframe, list[Truth]]:
    """Fly on what the vehicle believes, at 100 Hz; return the vehicle and the truth at each call."""
    airframe = Airframe(craft, world, seed=5, start=start)
    state = initial_position_state(NOTHING)
    truths = []
    for _ in range(round(seconds * 100)):
        e = airframe.believed()
        out, state = position_control(e.p, e.v, e.q, setpoint, state, parameters, 0.01)
        airframe.advance(out, True, 5)
        truths.append(airframe.truth())
    return airframe, truths


def thrust_of(setpoint: PositionSetpoint, v: Vec3 = NOTHING, state: PositionState = START) -> Vec3:
    """Return the thrust vector NED that a call commands, from rest at the origin."""
    out, _ = position_control(NOTHING, v, LEVEL, setpoint, state, PARAMETERS, 0.01)
    z = body_z(out.q)
    return (-z[0] * out.thrust, -z[1] * out.thrust, -z[2] * out.thrust)


def test_hovers_within_centimetres_under_force_and_gravity_error() -> None:
    world = World(force_n=(4.76, 0.0, 0.0), gravity_factor=1.05)
    _, truths = fly(hold((0.0, 0.0, -10.0)), 35.0, world)
    off = [math.dist(t.p, (0.0, 0.0, -10.0)) for t in truths]
    assert 0.2 < max(off) < 1.0  # the integrals have to find the disturbance first
    assert max(off[-500:]) < 0.01
    assert max(norm(t.w) for t in truths[-500:]) < 0.05


def test_holds_in_gusts() -> None:
    craft = vehicle(mass_kg=1.0, inertia_kg_m2=(0.025, 0.025, 0.03), drag_1_s=1.0, rotor_thrust_max_n=5.0)
    parameters = PARAMETERS._replace(MPC_THR_HOVER=9.80665 / 20.0)
    world = World(wind_m_s=(4.0, 0.0, 0.0), turbulence=0.1)
    _, truths = fly(hold((0.0, 0.0, -10.0)), 25.0, world, craft=craft, parameters=parameters)
    assert max(math.dist(t.p, (0.0, 0.0, -10.0)) for t in truths[-500:]) < 0.5


def test_goes_to_a_point_and_a_heading() -> None:
    _, truths = fly(hold((4.0, -3.0, -12.0), 2.0), 20.0, World(), craft=noiseless())
    assert truths[-1].p == pytest.approx((4.0, -3.0, -12.0), abs=0.02)
    assert yaw_of(truths[-1].q) == pytest.approx(2.0, abs=1e-3)


def test_follows_a_velocity_and_keeps_the_heading_that_it_has() -> None:
    setpoint = PositionSetpoint((NAN, NAN, -10.0), (1.0, -2.0, NAN), ANY, NAN, NAN)
    _, truths = fly(setpoint, 12.0, World(), craft=noiseless(), start=((0.0, 0.0, -10.0), -2.0))
    assert truths[-1].v == pytest.approx((1.0, -2.0, 0.0), abs=0.03)
    assert truths[-1].p[2] == pytest.approx(-10.0, abs=0.02)
    assert yaw_of(truths[-1].q) == pytest.approx(-2.0, abs=0.05)


def test_lands_softly_and_rests() -> None:
    down = PositionSetpoint((0.0, 0.0, NAN), (NAN, NAN, 0.7), ANY, 0.3, NAN)
    airframe, truths = fly(down, 8.0, World(force_n=(2.0, 0.0, 0.0)), start=((0.0, 0.0, -2.0), 0.3))
    assert airframe.on_ground
    assert 0.3 < airframe.impact_speed_m_s < 0.9
    assert truths[-1].p == truths[-100].p
    assert truths[-1].q == pytest.approx(from_yaw(yaw_of(truths[-1].q)), abs=1e-6)


def test_directions_and_hover_thrust() -> None:
    assert thrust_of(hold(NOTHING)) == pytest.approx((0.0, 0.0, -HOVER))
    assert thrust_of(hold((0.5, 0.0, 0.0)))[0] > 0.01
    assert thrust_of(hold((0.0, 0.5, 0.0)))[1] > 0.01
    assert thrust_of(hold((0.0, 0.0, -0.5)))[2] < -HOVER - 0.01
    # 1 m off: 0.95 m/s wanted, 1.71 m/s^2, of which the hover thrust makes its share.
    assert thrust_of(hold((1.0, 0.0, 0.0)))[0] == pytest.approx(0.95 * 1.8 * HOVER / 9.80665)


def test_feed_forwards_add_up() -> None:
    moving = PositionSetpoint(NOTHING, (0.4, 0.0, 0.0), (0.0, 0.5, 0.0), 0.0, NAN)
    assert thrust_of(moving)[0] == pytest.approx(0.4 * 1.8 * HOVER / 9.80665)
    assert thrust_of(moving)[1] == pytest.approx(0.5 * HOVER / 9.80665)
    alone = PositionSetpoint(ANY, ANY, (1.0, 0.0, -1.0), 0.0, NAN)
    # The tilt is that for 1 m/s^2 beside standard gravity; a tilted thrust is raised to carry 1 m/s^2 more.
    up = HOVER * (1.0 + 1.0 / 9.80665)
    assert thrust_of(alone) == pytest.approx((up / 9.80665, 0.0, -up))


def test_tilt_is_limited() -> None:
    x, y, z = wanted_thrust((30.0, -40.0, 0.0), PARAMETERS)
    assert math.atan2(math.hypot(x, y), -z) == pytest.approx(math.radians(45.0))
    assert x / y == pytest.approx(-0.75)


def test_thrust_is_limited_at_both_ends_with_the_vertical_first() -> None:
    assert wanted_thrust((0.0, 0.0, 20.0), PARAMETERS) == pytest.approx((0.0, 0.0, -0.12))
    assert limited_thrust((0.0, 0.0, -5.0), 1.0, 0.3) == pytest.approx((0.0, 0.0, -1.0))
    x, _, z = limited_thrust(wanted_thrust((8.0, 0.0, -12.0), PARAMETERS), 1.0, 0.3)
    # The margin of 0.3 is kept for the horizontal part, which wanted more.
    assert x == pytest.approx(0.3)
    assert z == pytest.approx(-math.sqrt(1.0 - 0.09))
    # What the vertical part does not need is left for it.
    assert limited_thrust((-0.6, 0.8, -0.6), 1.0, 0.3) == pytest.approx((-0.48, 0.64, -0.6))


def test_velocities_are_limited_with_the_position_part_first() -> None:
    calm = START._replace(v_previous=(12.0, 0.0, 0.0))
    assert thrust_of(hold((1000.0, 0.0, 0.0)), (12.0, 0.0, 0.0), calm)[0] == pytest.approx(0.0, abs=1e-12)
    sideways = PositionSetpoint((1000.0, 0.0, 0.0), (0.0, 9.0, 0.0), ANY, 0.0, NAN)
    assert thrust_of(sideways, (12.0, 0.0, 0.0), calm)[1] == pytest.approx(0.0, abs=1e-12)
    both = PositionSetpoint((10.0, 0.0, 0.0), (0.0, 9.0, 0.0), ANY, 0.0, NAN)
    wanted = (9.5, math.sqrt(144.0 - 9.5**2), 0.0)
    assert thrust_of(both, wanted, START._replace(v_previous=wanted))[:2] == pytest.approx((0.0, 0.0), abs=1e-12)
    for p, v in (((0.0, 0.0, -50.0), (0.0, 0.0, -3.0)), ((0.0, 0.0, 50.0), (0.0, 0.0, 1.5))):
        assert thrust_of(hold(p), v, START._replace(v_previous=v))[2] == pytest.approx(-HOVER)


def test_integral_does_not_wind_up_against_the_limits() -> None:
    state = START
    for _ in range(2000):
        _, state = position_control(NOTHING, NOTHING, LEVEL, hold((500.0, 0.0, -500.0)), state, PARAMETERS, 0.01)
    assert state.integral[0] < 9.81
    assert abs(state.integral[2]) < 1e-9  # full thrust already wants more than there is
    free = START
    for _ in range(100):
        _, free = position_control(NOTHING, NOTHING, LEVEL, hold((0.1, 0.0, 0.0)), free, PARAMETERS, 0.01)
    assert free.integral[0] == pytest.approx(0.1 * 0.95 * 0.4)


@pytest.mark.parametrize("yaw", [0.0, 1.0, math.pi, -2.5])
@pytest.mark.parametrize("thrust", [(0.0, 0.0, -0.5), (0.3, 0.1, -0.4), (-0.2, 0.3, -0.3)])
def test_attitude_points_the_thrust_and_the_nose(thrust: Vec3, yaw: float) -> None:
    q = thrust_attitude(thrust, yaw)
    size = norm(thrust)
    assert sum(c * c for c in q) == pytest.approx(1.0)
    assert body_z(q) == pytest.approx(tuple(-c / size for c in thrust))
    nose = rotate(q, (1.0, 0.0, 0.0))
    assert nose[0] * math.sin(yaw) - nose[1] * math.cos(yaw) == pytest.approx(0.0, abs=1e-12)
    assert nose[0] * math.cos(yaw) + nose[1] * math.sin(yaw) > 0.0


def test_output_is_an_attitude_setpoint() -> None:
    setpoint = PositionSetpoint(NOTHING, ANY, ANY, 1.0, 0.4)
    out, _ = position_control(NOTHING, NOTHING, LEVEL, setpoint, START, PARAMETERS, 0.01)
    assert out.mode == ATTITUDE
    assert out.yaw_rate == 0.4
    assert out.q == pytest.approx(from_yaw(1.0))
