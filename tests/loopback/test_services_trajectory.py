"""SET_POSITION_TARGET: what is taken, what is refused, and how the position controller flies it in OFFBOARD."""

import math

import pytest
from vehicle_tools import HOLD, IN_AIR, OFFBOARD, Flight, mavlink, vehicle_file

from sim_link.geodesy import global_position

# Few states and few steps a second: what is looked at here is slow.
QUICK = vehicle_file(25.0, loop_rate_hz=250.0)
NONE = (0.0, 0.0, 0.0)
POSITION = 0b110111111000  # position, yaw
VELOCITY = 0b110111000111
ACCELERATION = 0b110000111111
LOCAL, BODY, OFFSET = 1, 8, 7
YAW = 1024


def target(c, mask, *, p=NONE, v=NONE, a=NONE, yaw=0.0, yaw_rate=0.0, frame=LOCAL, to=(1, 1)):
    c.send(mavlink.MAVLink_set_position_target_local_ned_message(0, *to, frame, mask, *p, *v, *a, yaw, yaw_rate))


def stream(c, mask, **fields):
    c.each = lambda: target(c, mask, **fields)


def enter(c, mask, **fields):
    stream(c, mask, **fields)
    c.run(0.1)
    assert c.set_mode(OFFBOARD) == 0
    c.until(lambda: c.mode == OFFBOARD, 1.0)


def velocity(c):
    m = c.last["ODOMETRY"]
    return m.vx, m.vy, m.vz


def heading(c):
    w, _, _, z = c.last["ODOMETRY"].q
    return 2.0 * math.atan2(z, w)


def test_position_velocity_and_acceleration_are_flown():
    with Flight(start=IN_AIR, file=QUICK) as c:
        enter(c, POSITION & ~YAW, p=(3.0, -2.0, -21.0), yaw=1.0)
        c.run(8.0)
        assert c.position == pytest.approx((3.0, -2.0, -21.0), abs=0.1)
        assert heading(c) == pytest.approx(1.0, abs=0.05)
        assert c.request("POSITION_TARGET_LOCAL_NED") == 0
        m = c.last["POSITION_TARGET_LOCAL_NED"]
        assert (m.x, m.y, m.z) == (3.0, -2.0, -21.0) and math.isnan(m.vx)
        stream(c, VELOCITY, v=(0.0, 2.0, -0.5))
        c.run(8.0)
        assert velocity(c) == pytest.approx((0.0, 2.0, -0.5), abs=0.15)
        stream(c, VELOCITY, v=(1.5, 0.0, 0.0), frame=BODY)
        c.run(8.0)
        yaw = heading(c)
        assert velocity(c) == pytest.approx((1.5 * math.cos(yaw), 1.5 * math.sin(yaw), 0.0), abs=0.2)


def test_acceleration_feeds_forward_along_a_circle():
    """With position, velocity and acceleration of a circle the error is a fraction of that with the position alone."""

    def error(mask):
        with Flight(start=((2.0, 0.0, -20.0), 0.0), file=QUICK) as c:

            def send():
                angle = 0.8 * (c.t_us * 1e-6)
                n, e = math.cos(angle), math.sin(angle)
                circle = {"p": (2 * n, 2 * e, -20.0), "v": (-1.6 * e, 1.6 * n, 0.0), "a": (-1.28 * n, -1.28 * e, 0.0)}
                send.at = circle["p"]
                target(c, mask, **circle)

            send.at = (2.0, 0.0, -20.0)
            c.each = send
            c.run(0.1)
            assert c.set_mode(OFFBOARD) == 0
            c.run(12.0)
            worst = 0.0

            def look():
                nonlocal worst
                worst = max(worst, math.dist(c.position, send.at))
                return False

            end = c.t_us + 8_000_000
            c.until(lambda: look() or c.t_us >= end, 9.0)
            return worst

    with_all, position_alone = error(0b110000000000), error(POSITION)
    assert with_all < 0.25
    assert position_alone > 3.0 * with_all


def test_acceleration_alone_tilts():
    with Flight(start=IN_AIR, file=QUICK) as c:
        enter(c, ACCELERATION, a=(2.0, 0.0, 0.0))
        c.run(1.5)
        assert c.tilt == pytest.approx(math.atan(2.0 / 9.81), abs=0.03)


def test_global_positions_are_flown_too():
    with Flight(start=IN_AIR, file=QUICK) as c:
        latitude, longitude, altitude = global_position((4.0, 3.0, -22.0))
        message = mavlink.MAVLink_set_position_target_global_int_message
        c.each = lambda: c.send(message(0, 1, 1, 5, POSITION, latitude, longitude, altitude, *[0.0] * 8))
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        c.run(8.0)
        assert c.position == pytest.approx((4.0, 3.0, -22.0), abs=0.15)
        c.each = lambda: c.send(message(0, 1, 1, 6, POSITION, latitude, longitude, 18.0, *[0.0] * 8))
        c.run(6.0)
        assert c.position[2] == pytest.approx(-18.0, abs=0.15)


def test_it_takes_off_with_a_ramp_and_lands():
    with Flight(file=QUICK) as c:
        stream(c, POSITION, p=(0.0, 0.0, -3.0))
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        assert c.arm() == 0
        c.run(0.9)
        assert c.position[2] == pytest.approx(0.0, abs=0.02), "rotors spool up first"
        c.run(1.0)
        assert -1.5 < c.position[2] < -0.02, "the climb begins slowly"
        c.run(6.0)
        assert c.position == pytest.approx((0.0, 0.0, -3.0), abs=0.15)
        stream(c, VELOCITY, v=(0.0, 0.0, 0.7))
        c.until(lambda: "Disarmed by landing" in c.texts(), 20.0)
        assert abs(c.position[2]) < 0.05


def test_on_the_ground_a_trajectory_that_does_not_lead_up_is_not_flown():
    with Flight(file=QUICK) as c:
        stream(c, POSITION, p=(1.0, 0.0, 0.0))
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        assert c.arm() == 0
        c.run(3.0)
        assert c.position == pytest.approx(NONE, abs=0.02)


REFUSED = [
    ({"mask": 0b111111111111}, "invalid"),
    ({"mask": POSITION, "frame": OFFSET}, "frame 7"),
    ({"mask": 0b111111111111, "frame": BODY}, "invalid"),
    ({"mask": VELOCITY | 8, "frame": BODY}, "invalid"),  # one axis ignored drops the vector in the body frame
    ({"mask": ACCELERATION | 512}, "force"),
    ({"mask": POSITION, "p": (math.nan,) * 3}, "invalid"),
]


@pytest.mark.parametrize(("fields", "word"), REFUSED)
def test_what_is_refused_is_no_sign_of_life(fields, word):
    with Flight(start=IN_AIR, file=QUICK) as c:
        fields = dict(fields)
        mask = fields.pop("mask")
        stream(c, mask, **fields)
        c.run(0.2)
        assert c.set_mode(OFFBOARD) == 1
        assert any(word in text for text in c.texts())


def test_for_others_it_is_nothing_at_all():
    with Flight(start=IN_AIR, file=QUICK) as c:
        for to in ((2, 1), (1, 42)):
            stream(c, POSITION, to=to)
            c.run(0.2)
            assert c.set_mode(OFFBOARD) == 1
        stream(c, POSITION, p=(0.0, 0.0, -20.0), to=(0, 0))
        c.run(0.2)
        assert c.set_mode(OFFBOARD) == 0


def test_an_incomplete_trajectory_stops_the_vehicle_and_a_lost_one_is_a_failsafe():
    with Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 5}, file=QUICK) as c:
        enter(c, VELOCITY, v=(2.0, 0.0, 0.0))
        c.run(3.0)
        assert velocity(c)[0] > 1.7
        stream(c, VELOCITY | 16, v=(2.0, 0.0, 0.0))  # x without y
        c.run(4.0)
        assert math.hypot(*velocity(c)) < 0.2
        assert c.mode == OFFBOARD
        c.each = None
        c.until(lambda: c.mode == HOLD, 1.5)
        stream(c, POSITION, p=(0.0, 0.0, -20.0))
        c.until(lambda: c.mode == OFFBOARD, 0.5)


def test_another_type_takes_up_to_half_a_second():
    with Flight(start=IN_AIR, file=QUICK) as c:
        enter(c, POSITION, p=(0.0, 0.0, -20.0))
        c.run(1.0)
        c.stream(128, rates=(0.0, 0.0, 1.0), thrust=0.49)
        waited = c.until(lambda: c.rates[2] > 0.5, 1.5)
        assert waited < 1.0
        stream(c, POSITION, p=(0.0, 0.0, -20.0))
        c.run(6.0)
        assert c.position == pytest.approx((0.0, 0.0, -20.0), abs=0.2)


@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e30, math.nan])
def test_absurd_numbers_do_not_end_the_vehicle(value):
    with Flight(start=IN_AIR, file=QUICK) as c:
        enter(c, 0b110000000000, p=(0.0, 0.0, -20.0), v=(value, 0.0, value), a=(0.0, value, value))
        c.run(1.0)
        stream(c, 0, p=(value, value, value), yaw=value, yaw_rate=value)
        c.run(1.0)
        assert all(map(math.isfinite, c.position))
        assert c.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148) == 0
