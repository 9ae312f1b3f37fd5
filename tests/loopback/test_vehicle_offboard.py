"""Offboard control of the simulated vehicle: which setpoints act, how it is entered, and what NaN does."""

import math
import random

import pytest
from vehicle_tools import ATTITUDE, HOLD, IN_AIR, OFFBOARD, RATES, RETURN, Flight, mavlink, vehicle_file

NAN = math.nan


def accepted(flight, companion, mask, **fields):
    """Whether a SET_ATTITUDE_TARGET counts as a sign of life."""
    before = flight.vehicle.autopilot.offboard.accepted
    companion.attitude_target(mask, **fields)
    companion.step()
    companion.step()
    return flight.vehicle.autopilot.offboard.accepted > before


MASKS = [
    (7, True),
    (3, True),
    (128, True),
    (132, True),
    (7 + 32, True),
    (128 + 32, True),
    (39 + 64, True),
    (128 + 64 + 32, True),
    (0, True),
    (4, True),
    (1, True),  # attitude counts, the rates do not
    (129, False),
    (130, False),
    (131, False),
    (64, False),
    (71, False),
    (192, False),
    (128 + 7, False),
]


def test_masks_that_count_and_masks_that_are_dropped():
    flight = Flight(start=IN_AIR)
    with flight as c:
        seen = [(mask, accepted(flight, c, mask)) for mask, _ in MASKS]
    assert seen == MASKS


def test_1_13_needs_no_thrust():
    flight = Flight(start=IN_AIR, px4="1.13")
    with flight as c:
        assert accepted(flight, c, 64)
        assert accepted(flight, c, 192)
        assert not accepted(flight, c, 129)


def test_targets_are_checked_and_the_switch_for_setpoints_is_obeyed():
    flight = Flight(start=IN_AIR)
    with flight as c:
        assert accepted(flight, c, RATES, target=(0, 0))
        assert accepted(flight, c, RATES, target=(1, 0))
        assert not accepted(flight, c, RATES, target=(2, 1))
        assert not accepted(flight, c, RATES, target=(1, 2))
        c.set_param("MAV_FWDEXTSP", 0)
        assert not accepted(flight, c, RATES)


def test_one_fresh_setpoint_opens_offboard_and_a_stale_one_does_not():
    with Flight(start=IN_AIR) as c:
        assert c.set_mode(OFFBOARD) == 1
        assert c.mode == HOLD
        c.attitude_target(RATES)
        assert c.set_mode(OFFBOARD) == 0
        c.run(0.1)
        assert c.mode == OFFBOARD
        assert c.set_mode(HOLD) == 0
        c.run(1.2)
        assert c.set_mode(OFFBOARD) == 1
        c.attitude_target(RATES + 64)
        assert c.set_mode(OFFBOARD) == 1, "a dropped message is no sign of life"


def test_rates_are_followed_and_held_until_replaced():
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.6))
        c.run(0.6)
        assert c.rates[2] == pytest.approx(0.6, abs=0.05)
        c.silence()
        c.run(0.5)
        assert c.mode == OFFBOARD
        assert c.rates[2] == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize(("mask", "yaw_rate"), [(7, 0.0), (3, 0.5)])
def test_attitude_with_and_without_a_yaw_rate(mask, yaw_rate):
    tilted = (math.cos(0.05), math.sin(0.05), 0.0, 0.0)  # 0.1 rad to the right
    with Flight(start=IN_AIR) as c:
        yawing = mask == 3
        c.enter_offboard(mask, q=(1.0, 0.0, 0.0, 0.0) if yawing else tilted, rates=(9.0, 9.0, 0.5))
        c.run(0.4 if yawing else 1.0)
        if yawing:
            assert c.rates[2] > 0.2  # feed-forward, less what pulls the heading back
        else:
            assert c.tilt == pytest.approx(0.1, abs=0.01)
            assert c.position[1] > 0.05
            assert abs(c.rates[2]) < 0.02


def climbs(c, seconds=1.0):
    """How far up the vehicle gets."""
    before = c.position[2]
    c.run(seconds)
    return before - c.position[2]


def test_thrust_scalar_and_in_body_axes():
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(thrust=0.6)
        assert climbs(c) > 0.5
        c.stream(RATES + 32, thrust=0.9, body=(0.0, 0.0, -0.3))
        assert climbs(c, 2.0) < climbs(c, 0.0) + 1.0
        c.stream(RATES + 32 + 64, thrust=0.0, body=(0.0, 0.0, -0.7))
        c.run(1.0)
        assert climbs(c) > 0.5


def test_a_vehicle_of_no_type_gets_no_scalar_thrust():
    with Flight(start=IN_AIR, parameters={"MAV_TYPE": 0}) as c:
        c.enter_offboard(thrust=0.8)
        assert climbs(c) < -1.0
        c.stream(RATES + 32, body=(0.0, 0.0, -0.9))
        c.run(1.0)
        assert climbs(c) > 0.0


@pytest.mark.parametrize("mask", [RATES, RATES + 4])
def test_a_rate_that_is_nan_or_ignored_holds_the_rate_at_arrival(mask):
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.8))
        c.run(0.8)
        before = c.rates[2]
        assert before == pytest.approx(0.8, abs=0.05)
        c.silence()
        c.attitude_target(mask, rates=(0.0, 0.0, NAN if mask == RATES else 0.0))
        c.run(0.6)
        assert c.mode == OFFBOARD
        assert c.rates[2] == pytest.approx(before, abs=0.03)


def rotor_thrust(flight):
    return sum(flight.vehicle.airframe.rigid.rotor_n)


def test_nan_thrust_stops_the_rotors_while_it_lasts():
    flight = Flight(start=IN_AIR)
    with flight as c:
        c.enter_offboard()
        c.stream(RATES, thrust=NAN)
        c.run(0.5)
        assert rotor_thrust(flight) < 0.1
        c.stream(RATES, thrust=0.6)
        c.run(0.5)
        assert rotor_thrust(flight) == pytest.approx(0.6 * 96.0, rel=0.02)
        assert c.armed


@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (NAN, 0.0, 0.0, 0.0)])
def test_one_quaternion_that_is_none_spoils_the_attitude_loop_for_good(bad):
    tilted = (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(ATTITUDE)
        c.run(0.3)
        c.each = lambda: c.attitude_target(ATTITUDE, q=bad)
        c.step()
        c.stream(ATTITUDE, q=tilted)
        c.run(1.5)
        assert c.tilt < 0.02, "rates stay as they were: nothing follows the attitude any more"
        c.stream(RATES, rates=(0.0, 0.3, 0.0))
        c.run(1.0)
        assert c.rates[1] == pytest.approx(0.3, abs=0.05), "body rates are still obeyed"


def test_1_13_recovers_from_a_quaternion_that_is_none():
    tilted = (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
    with Flight(start=IN_AIR, px4="1.13") as c:
        c.enter_offboard(ATTITUDE)
        c.each = lambda: c.attitude_target(ATTITUDE, q=(0.0, 0.0, 0.0, 0.0))
        c.step()
        c.stream(ATTITUDE, q=tilted)
        c.run(1.5)
        assert c.tilt == pytest.approx(0.2, abs=0.02)


def test_mask_zero_is_a_race_that_the_attitude_controller_mostly_wins():
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(0, rates=(0.0, 0.0, 1.0))
        c.run(1.0)
        assert 0.02 < c.rates[2] < 0.6, "neither the level attitude alone (0) nor the rates alone (1)"


def test_another_setpoint_type_waits_for_the_next_evaluation():
    with Flight(start=IN_AIR) as c:
        c.enter_offboard(RATES)
        c.run(0.7)
        tilted = (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
        c.stream(ATTITUDE, q=tilted)
        waited = c.until(lambda: c.tilt > 0.01, 1.0)
        assert 0.0 < waited <= 0.62
        c.run(1.0)
        assert c.tilt == pytest.approx(0.2, abs=0.02)


def test_a_setpoint_needs_the_command_delay_to_act():
    def reaction(delay_s):
        with Flight(start=IN_AIR, file=vehicle_file(command_delay_s=delay_s)) as c:
            c.enter_offboard()
            c.run(0.5)
            c.stream(RATES, rates=(0.0, 0.0, 1.0))
            return c.until(lambda: c.rates[2] > 0.3, 1.0)

    assert reaction(0.1) - reaction(0.0) == pytest.approx(0.1, abs=0.021)


def controls(c, *values, group=0):
    c.send(mavlink.MAVLink_set_actuator_control_target_message(0, group, 1, 1, [*values, 0.0, 0.0, 0.0, 0.0]))


def test_actuator_controls_fly_1_13_only():
    with Flight(start=IN_AIR) as c:
        c.each = lambda: controls(c, 0.0, 0.0, 0.0, 0.5)
        c.run(0.2)
        assert c.set_mode(OFFBOARD) == 1
        assert not [t for t in c.texts() if "139" in t], "1.18 does not even know the message"
    flight = Flight(start=IN_AIR, px4="1.13")
    with flight as c:
        c.each = lambda: controls(c, 0.0, 0.0, 0.0, 0.5, group=1)
        c.run(0.2)
        assert c.set_mode(OFFBOARD) == 1, "group 1 is not the flight controls"
        c.each = lambda: controls(c, 0.0, 0.0, 0.02, 0.55)
        c.run(0.2)
        assert c.set_mode(OFFBOARD) == 0
        c.run(1.0)
        assert rotor_thrust(flight) == pytest.approx(0.55 * 96.0, rel=0.01)
        assert c.rates[2] > 0.1


def test_what_message_139_does_follows_from_the_version():
    for px4, obeys in (("1.18", False), ("1.13", True)):
        with Flight(px4=px4) as c:
            assert c.request("AUTOPILOT_VERSION") == 0
            version = c.last["AUTOPILOT_VERSION"]
            assert version.flight_sw_version >> 16 == (0x10D if obeys else 0x112)
            assert bool(version.capabilities & 1024) is obeys
            assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET


# Losing the stream

LOSS = [
    (0, 2, RETURN),
    (1, 2, RETURN),
    (2, 3, 4 << 16 | 6 << 24),
    (0, 1, HOLD),
    (3, 2, RETURN),
    (4, 2, 4 << 16 | 6 << 24),
    (5, 2, HOLD),
]


@pytest.mark.parametrize(("act", "rc_act", "mode"), LOSS)
def test_a_lost_stream_ends_in_what_the_parameters_say(act, rc_act, mode):
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": act, "NAV_RCL_ACT": rc_act}) as c:
        c.enter_offboard()
        c.silence()
        lost = c.until(lambda: c.mode != OFFBOARD, 2.0)
        assert 1.0 <= lost <= 1.14
        assert (c.mode, c.intended) == (mode, OFFBOARD)
        assert c.armed
        assert any("Offboard signal lost" in text for text in c.texts())
        c.until(lambda: c.last["HEARTBEAT"].system_status == mavlink.MAV_STATE_CRITICAL, 1.5)
        # The intention stays: a stream that resumes brings OFFBOARD back without being asked.
        c.stream()
        assert c.until(lambda: c.mode == OFFBOARD, 1.0) <= 0.06


def test_sticks_make_the_stick_modes_possible():
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 0}) as c:
        stick = mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)

        def both():
            c.send(stick)
            c.attitude_target(RATES)

        c.each = both
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        c.each = lambda: c.send(stick)
        c.until(lambda: c.mode == 3 << 16, 2.0)  # Position
        c.run(2.0)
        assert c.mode == 3 << 16
        assert c.position[2] == pytest.approx(-20.0, abs=1.0)


@pytest.mark.parametrize("rc_act", [0, 7])
def test_the_hole_nothing_happens_and_the_last_rates_go_on(rc_act):
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": rc_act}) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.5))
        c.silence()
        c.log.clear()
        c.run(6.0)
        assert c.mode == OFFBOARD
        assert c.rates[2] == pytest.approx(0.5, abs=0.05)
        assert c.texts() == []
        assert c.last["HEARTBEAT"].system_status == mavlink.MAV_STATE_ACTIVE


def test_terminate_and_disarm_as_loss_actions():
    flight = Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 6})
    with flight as c:
        c.enter_offboard()
        c.silence()
        c.until(lambda: c.mode == 10 << 16, 2.0)
        c.run(0.5)
        assert rotor_thrust(flight) < 0.1
        c.stream()
        c.run(1.0)
        assert c.mode == 10 << 16, "nothing brings a terminated flight back"
        assert c.set_mode(HOLD) == 1
    flight = Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 7})
    with flight as c:
        c.enter_offboard()
        c.silence()
        c.run(2.5)
        assert not c.armed
        assert rotor_thrust(flight) < 0.1


def test_the_time_until_loss_is_a_parameter_and_a_mode_change_ends_the_failsafe():
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 3, "COM_OF_LOSS_T": 0.3}) as c:
        c.enter_offboard()
        c.silence()
        assert 0.3 <= c.until(lambda: c.mode == RETURN, 1.0) <= 0.44
        assert c.set_mode(HOLD) == 0
        c.run(0.1)
        assert (c.mode, c.intended) == (HOLD, HOLD)
        c.stream()
        c.run(1.0)
        assert c.mode == HOLD


@pytest.mark.parametrize("px4", ["1.18", "1.13"])
def test_any_setpoint_can_come_and_the_vehicle_goes_on(px4):
    draw = random.Random(3)
    odd = (0.0, -0.0, 1.0, -1.0, 1e-30, 3.4e38, -3.4e38, math.inf, -math.inf, NAN, 0.5)

    def some(count):
        return [draw.choice(odd) for _ in range(count)]

    with Flight(start=((0.0, 0.0, -200.0), 0.0), px4=px4) as c:
        c.enter_offboard()

        def wild():
            c.attitude_target(draw.randrange(256), q=some(4), rates=some(3), thrust=some(1)[0], body=tuple(some(3)))
            if draw.random() < 0.3:
                controls(c, *some(4))

        c.each = wild
        c.run(6.0)
        c.silence()
        assert c.request("AUTOPILOT_VERSION") == 0
