"""Arming, takeoff, hold, landing, return and automatic disarming of the simulated vehicle."""

import math

import pytest
from vehicle_tools import HOLD, IN_AIR, LAND, OFFBOARD, RETURN, TAKEOFF, Flight, mavlink, vehicle_file

DISARM = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0)
ON_GROUND, FLYING, TAKING_OFF, LANDING = 1, 2, 3, 4


def landed_state(c):
    return c.last["EXTENDED_SYS_STATE"].landed_state


def test_takeoff_hold_land_and_disarm():
    with Flight(parameters={"MIS_TAKEOFF_ALT": 4.0}) as c:
        assert (c.mode, c.armed, landed_state(c)) == (HOLD, False, ON_GROUND)
        assert c.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, math.nan, math.nan, math.nan) == 0
        c.run(1.0)
        assert not c.armed, "NAV_TAKEOFF does not arm"
        assert c.arm() == 0
        c.until(lambda: landed_state(c) == TAKING_OFF, 3.0)
        c.until(lambda: c.mode == HOLD, 12.0)
        c.run(3.0)
        assert c.position == pytest.approx((0.0, 0.0, -4.0), abs=0.1)
        assert landed_state(c) == FLYING
        assert c.command(*DISARM) == 1, "not in the air"
        assert c.command(mavlink.MAV_CMD_NAV_LAND, 0, 0, 0, math.nan) == 0
        c.until(lambda: landed_state(c) == LANDING, 1.0)
        descent = c.until(lambda: landed_state(c) == ON_GROUND, 15.0)
        assert 4.0 / 0.7 < descent < 4.0 / 0.7 + 4.0
        assert c.position[2] == pytest.approx(0.0, abs=0.02)
        c.until(lambda: not c.armed, 4.0)
        assert "Disarmed by landing" in c.texts()
        assert c.arm() == 1, "Land prevents arming"
        assert any("Arming denied" in text for text in c.texts())


def test_takeoff_to_a_height_above_sea_level():
    with Flight() as c:
        assert c.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 489.4 + 6.0) == 0
        assert c.arm() == 0
        c.until(lambda: c.mode == HOLD, 15.0)
        c.run(2.0)
        assert c.position[2] == pytest.approx(-6.0, abs=0.1)


def test_nobody_took_off_so_it_disarms_itself():
    with Flight() as c:
        assert c.arm() == 0
        c.until(lambda: c.armed, 1.5)
        waited = c.until(lambda: "Disarmed by auto preflight disarming" in c.texts(), 12.0)
        assert waited == pytest.approx(11.0, abs=1.1)  # spool-up 1 s and COM_DISARM_PRFLT 10 s
        c.until(lambda: not c.armed, 1.1)


def test_automatic_disarming_can_be_switched_off():
    with Flight(parameters={"COM_DISARM_PRFLT": -1.0}) as c:
        assert c.arm() == 0
        c.run(13.0)
        assert c.armed


def test_force_disarms_in_the_air_but_does_not_skip_checks_when_arming():
    flight = Flight(start=IN_AIR)
    with flight as c:
        assert c.command(*DISARM) == 1
        assert c.command(*DISARM, 21196) == 0
        c.run(0.4)
        assert sum(flight.vehicle.airframe.rigid.rotor_n) < 0.1
    with Flight() as c:
        assert c.set_mode(LAND) == 0, "any mode can be chosen while disarmed"
        assert c.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196) == 1
        assert c.set_mode(OFFBOARD) == 0
        assert c.arm() == 1, "no offboard signal"
        c.stream(thrust=0.0)
        c.run(0.1)
        assert c.arm() == 0
        assert c.command(*DISARM) == 0
        assert c.set_mode(3 << 16) == 0
        assert c.arm() == 1, "Position without sticks"


def test_offboard_from_the_ground_needs_no_spool_up_and_lands_by_low_thrust():
    flight = Flight()
    with flight as c:
        c.stream(thrust=0.0)
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        assert c.arm() == 0
        c.stream(thrust=0.7)
        c.run(0.3)
        assert c.position[2] < -0.05
        c.run(0.5)
        c.stream(thrust=0.46)
        c.until(lambda: c.position[2] > -0.01, 30.0)
        c.stream(thrust=0.0)
        c.until(lambda: landed_state(c) == ON_GROUND, 3.0)
        c.until(lambda: not c.armed, 4.0)
        assert "Disarmed by landing" in c.texts()


def test_landing_with_a_gravity_that_is_not_the_expected_one():
    from sim_link.wind import World

    world = World(force_n=(4.76, 0.0, 0.0), gravity_factor=1.05)
    with Flight(start=((3.0, 2.0, -3.0), 0.5), world=world, file=vehicle_file(state_rate_hz=100.0)) as c:
        c.run(3.0)
        assert c.set_mode(LAND) == 0
        c.until(lambda: not c.armed, 20.0)
        assert c.position == pytest.approx((3.0, 2.0, 0.0), abs=1.0)
        assert "Disarmed by landing" in c.texts()


def test_return_climbs_flies_home_and_lands():
    with Flight(parameters={"RTL_RETURN_ALT": 8.0}) as c:
        assert c.set_mode(TAKEOFF) == 0
        assert c.arm() == 0
        c.until(lambda: c.mode == HOLD, 12.0)
        tilted = (math.cos(0.15), 0.0, -math.sin(0.15), 0.0)  # nose down: north
        c.enter_offboard(7, q=tilted, thrust=0.52)
        c.until(lambda: c.position[0] > 14.0, 20.0)
        c.silence()
        assert c.set_mode(RETURN) == 0
        highest = 0.0

        def home():
            nonlocal highest
            highest = min(highest, c.position[2])
            return not c.armed

        c.until(home, 60.0)
        assert highest < -7.5
        assert c.position == pytest.approx((0.0, 0.0, 0.0), abs=0.5)


def test_hold_stops_where_it_is_and_stays():
    tilted = (math.cos(0.15), 0.0, -math.sin(0.15), 0.0)
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(7, q=tilted, thrust=0.5)
        c.run(2.0)
        c.silence()
        assert c.set_mode(HOLD) == 0
        c.run(15.0)
        here = c.position
        c.run(2.0)
        assert math.dist(here, c.position) < 0.1


@pytest.mark.parametrize("mode", [HOLD, LAND])
def test_a_wind_that_the_autopilot_has_not_learned_does_not_carry_it_off_while_it_stops(mode):
    """PX4 leads the vehicle to rest by a position, not by a speed alone: a push of 2 m/s^2 costs a metre, not four."""
    from sim_link.wind import World

    file = vehicle_file()
    push = World(force_n=(0.0, 2.0 * file.mass_kg, 0.0))
    leaning_against = (math.cos(0.1), -math.sin(0.1), 0.0, 0.0)
    with Flight(start=IN_AIR, world=push, file=file) as c:
        c.enter_offboard(7, q=leaning_against, thrust=0.51)
        c.run(1.0)
        c.silence()
        assert c.set_mode(mode) == 0
        begin, away_m = c.position[1], []
        c.each = lambda: away_m.append(abs(c.position[1] - begin))
        c.run(12.0)
        assert 0.3 < max(away_m) < 1.5


def test_set_mode_message_has_no_answer():
    with Flight(start=IN_AIR) as c:
        c.log.clear()
        c.send(mavlink.MAVLink_set_mode_message(1, 1, LAND))
        c.run(0.2)
        assert c.mode == LAND
        assert not c.of_type("COMMAND_ACK")


def test_modes_that_cannot_be_flown_are_refused_in_the_air():
    with Flight(start=IN_AIR) as c:
        for main, sub in ((3, 0), (2, 0), (7, 0), (1, 0), (5, 0), (4, 4), (10, 0), (4, 99), (77, 0)):
            assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub) == 1, (main, sub)
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 0, 4, 3) == 1, "without the custom mode flag"
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 1, OFFBOARD, 0) == 1, "the packed number is no main mode"
        assert c.mode == HOLD
        assert c.command(mavlink.MAV_CMD_DO_SET_MODE, 1 | 128 | 16, 4, 6) == 0
        c.run(0.1)
        assert c.mode == LAND


def test_a_ground_station_can_be_made_a_condition():
    with Flight(parameters={"NAV_DLL_ACT": 1}) as c:
        assert c.arm() == 1
        ground = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
        c.each = lambda: c.send(ground)
        c.run(0.1)
        assert c.arm() == 0


def test_an_attitude_beyond_60_degrees_disarms_early_in_a_flight_and_warns_later():
    upset = (math.cos(0.65), math.sin(0.65), 0.0, 0.0)  # 74 deg
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(7, q=upset, thrust=0.5)
        c.run(1.5)
        assert c.armed
        assert "Attitude failure detected" in c.texts()
    with Flight() as c:
        c.stream(7, thrust=0.0)
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        assert c.arm() == 0
        c.stream(7, q=upset, thrust=0.9)
        c.until(lambda: "Disarmed by failure detector: attitude" in c.texts(), 3.0)


def test_body_rates_are_free_of_the_attitude_detector():
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(rates=(3.0, 0.0, 0.0))
        c.run(1.5)
        assert c.armed
        assert "Attitude failure detected" not in c.texts()
