"""Sticks: the modes that they fly, and how they take over."""

import math

import pytest
from vehicle_tools import HOLD, IN_AIR, OFFBOARD, RATES, RETURN, TAKEOFF, Flight, mavlink, vehicle_file

# Few states and few steps a second: what is looked at here is slow.
QUICK = vehicle_file(25.0, loop_rate_hz=250.0)
POSITION, ALTITUDE, STABILIZED, ACRO, MANUAL = 3 << 16, 2 << 16, 7 << 16, 5 << 16, 1 << 16
TEXT = "Pilot took over using sticks"


def sticks(c, *, x=0, y=0, z=500, r=0):
    """Hold the sticks there from now on: pitch, roll, throttle and yaw as MANUAL_CONTROL has them."""
    message = mavlink.MAVLink_manual_control_message(c.target, x, y, z, r, 0)
    c.each = lambda: c.send(message)


def velocity(c):
    m = c.last["ODOMETRY"]
    return m.vx, m.vy, m.vz


def begin(c, mode):
    sticks(c)
    c.run(0.2)
    assert c.set_mode(mode) == 0
    c.run(0.2)
    assert c.mode == mode


def test_position_flies_as_fast_as_the_sticks_say_and_stays_when_they_are_let_go():
    with Flight(start=((0.0, 0.0, -20.0), math.pi / 2), parameters={"MPC_VEL_MANUAL": 4.0}, file=QUICK) as c:
        begin(c, POSITION)
        sticks(c, x=1000)  # the nose points east
        c.run(9.0)
        assert velocity(c) == pytest.approx((0.0, 4.0, 0.0), abs=0.3)
        sticks(c, z=1000)
        c.run(3.0)
        assert velocity(c)[2] == pytest.approx(-3.0, abs=0.3)
        sticks(c, r=500)
        c.run(1.5)
        turn = math.radians(150.0) * (0.5 - 0.1) / 0.9
        assert c.rates[2] == pytest.approx(turn, abs=0.1)
        sticks(c)
        c.run(4.0)
        here = c.position
        c.run(2.0)
        assert math.dist(here, c.position) < 0.1


def test_altitude_holds_the_height_only():
    with Flight(start=IN_AIR, file=QUICK) as c:
        begin(c, ALTITUDE)
        sticks(c, y=400)
        c.run(2.0)
        tilt = math.atan(math.tan(math.radians(35.0)) * (0.4 - 0.1) / 0.9)
        assert c.tilt == pytest.approx(tilt, abs=0.03)
        assert velocity(c)[1] > 2.0
        assert c.position[2] == pytest.approx(-20.0, abs=0.2)
        sticks(c, z=250)
        c.run(2.0)
        assert velocity(c)[2] == pytest.approx(1.5 * (0.5 - 0.1) / 0.9, abs=0.1)


@pytest.mark.parametrize("mode", [STABILIZED, MANUAL])
def test_stabilized_tilts_and_turns(mode):
    with Flight(start=IN_AIR, file=QUICK) as c:
        begin(c, mode)
        sticks(c, x=-500)  # back: nose up
        c.run(1.5)
        _, _, pitch, _ = c.last["ODOMETRY"].q
        assert 2.0 * math.asin(pitch) == pytest.approx(math.radians(17.5), abs=0.03)
        sticks(c, z=0)
        c.run(1.0)
        assert velocity(c)[2] > 3.0, "nobody holds the height"


def test_acro_turns_as_fast_as_the_sticks_say():
    with Flight(start=IN_AIR, file=QUICK) as c:
        begin(c, ACRO)
        sticks(c, y=300, r=-200)
        c.run(0.6)
        assert c.rates == pytest.approx((math.radians(30.0), 0.0, math.radians(-20.0)), abs=0.06)


def test_arming_and_taking_off_by_hand():
    with Flight(file=QUICK) as c:
        begin(c, POSITION)
        assert c.arm() == 0
        c.run(2.0)
        assert c.position[2] == pytest.approx(0.0, abs=0.02), "centred sticks leave it on the ground"
        sticks(c, z=900)
        c.run(4.0)
        assert c.position[2] < -2.0
        sticks(c, z=0)
        c.until(lambda: "Disarmed by landing" in c.texts(), 30.0)
        assert abs(c.position[2]) < 0.1


@pytest.mark.parametrize("mode", [HOLD, RETURN])
def test_a_quick_stick_takes_over_from_a_mode_that_steers_itself(mode):
    with Flight(start=IN_AIR, file=QUICK) as c:
        begin(c, mode)
        sticks(c, y=100)
        c.run(0.5)
        assert c.mode == mode, "a small movement"
        sticks(c, y=900)
        c.until(lambda: c.mode == POSITION, 0.5)
        assert c.intended == POSITION
        assert TEXT in c.texts()


def test_a_quick_stick_takes_over_from_offboard_and_the_limit_is_obeyed():
    for limit, taken in ((1.0, True), (-1.0, False), (20.0, False)):
        with Flight(start=IN_AIR, parameters={"MAN_OVERRIDE_SPD": limit}, file=QUICK) as c:
            c.enter_offboard()
            for x in (0, 600):
                stick = mavlink.MAVLink_manual_control_message(1, x, 0, 500, 0, 0)
                c.each = lambda stick=stick: (c.attitude_target(RATES), c.send(stick))
                c.run(0.4)
            assert (c.mode == POSITION) is taken, limit
            assert (c.mode == OFFBOARD) is not taken


def test_sticks_that_are_switched_off_or_gone_do_nothing():
    with Flight(start=IN_AIR, parameters={"COM_RC_IN_MODE": 4}, file=QUICK) as c:
        sticks(c)
        c.run(0.2)
        assert c.set_mode(POSITION) == 1
        sticks(c, y=1000)
        c.run(0.5)
        assert c.mode == HOLD
    with Flight(start=IN_AIR, file=QUICK) as c:
        begin(c, POSITION)
        c.each = None
        c.until(lambda: c.mode != POSITION, 1.5)
        assert c.mode == HOLD, "for COM_FAIL_ACT_T"
        c.until(lambda: c.mode == RETURN, 6.0)
        sticks(c)
        c.until(lambda: c.mode == POSITION, 1.0)


def test_a_radio_is_reported_and_flies_where_it_is_allowed():
    def radio(c, *channels):
        rest = (65535,) * (8 - len(channels))
        c.each = lambda: c.send(mavlink.MAVLink_rc_channels_override_message(1, 1, *channels, *rest))

    with Flight(start=IN_AIR, file=QUICK) as c:
        assert c.request("RC_CHANNELS") == 2, "nothing yet"
        radio(c, 1500, 1500, 1500, 1500)
        c.run(0.3)
        assert c.set_mode(POSITION) == 1, "COM_RC_IN_MODE 1 is the joystick alone"
    with Flight(start=IN_AIR, parameters={"COM_RC_IN_MODE": 0}, file=QUICK) as c:
        radio(c, 1500, 1500, 1500, 1500)
        c.run(0.3)
        assert c.set_mode(STABILIZED) == 0
        radio(c, 1750, 1500, 1600, 1500, 1234)
        c.run(1.5)
        assert c.tilt == pytest.approx(math.radians(17.5), abs=0.03)
        channels = c.last["RC_CHANNELS"]
        assert (channels.chan1_raw, channels.chan3_raw, channels.chan5_raw, channels.chancount) == (1750, 1600, 1234, 5)
        assert c.request("MANUAL_CONTROL") == 0
        assert (c.last["MANUAL_CONTROL"].y, c.last["MANUAL_CONTROL"].z) == (500, 600)


def test_version_1_13_asks_another_parameter_about_sticks():
    for override, taken in ((1, True), (0, False)):
        with Flight(start=IN_AIR, px4="1.13", parameters={"COM_RC_OVERRIDE": override}, file=QUICK) as c:
            begin(c, HOLD)
            sticks(c, y=1000)
            c.run(0.5)
            assert (c.mode == POSITION) is taken


def test_nobody_takes_over_on_the_ground():
    with Flight(file=QUICK) as c:
        begin(c, TAKEOFF)
        sticks(c, y=1000)
        c.run(0.5)
        assert c.mode == TAKEOFF
