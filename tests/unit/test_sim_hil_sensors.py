"""The sensors of a vehicle that a real PX4 flies, against closed forms and their own statistics."""

from __future__ import annotations

import math
import statistics
import struct
from itertools import pairwise

import pytest

from sim_link.hil_sensors import GPS_DELAY_US, GPS_US, SAMPLE_US, Noise, Sensors
from sim_link.physics import RigidState
from sim_link.rotation import exponential, from_yaw, multiply

G = 9.81
T0 = 1_000_000
QUIET = Noise(*(0.0,) * 11, 60.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
SENSOR = struct.Struct("<Q13fIB")
GPS = struct.Struct("<QiiiHHHhhhHBBBH")


def state(p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), q=LEVEL) -> RigidState:
    return RigidState(p, v, q, (0.0, 0.0, 0.0), (0.0,) * 4)


def measured(before: RigidState, now: RigidState, noise: Noise = QUIET) -> tuple:
    return SENSOR.unpack(Sensors(1, G, T0, noise).hil_sensor(T0, before, now))


def test_free_fall_is_weightless() -> None:
    now = state(v=(0.0, 0.0, G * SAMPLE_US * 1e-6))
    assert measured(state(), now)[1:4] == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def test_a_steady_turn_is_measured_exactly() -> None:
    dt, w = SAMPLE_US * 1e-6, (3.0, -2.0, 1.0)
    before = state(q=from_yaw(0.7))
    now = state(q=multiply(before.q, exponential((w[0] * dt, w[1] * dt, w[2] * dt))))
    assert measured(before, now)[4:7] == pytest.approx(w, abs=1e-5)
    other_sign = now._replace(q=(-now.q[0], -now.q[1], -now.q[2], -now.q[3]))
    assert measured(before, other_sign)[4:7] == pytest.approx(w, abs=1e-5)


def test_an_acceleration_north_is_felt_on_the_left_when_the_nose_points_east() -> None:
    east = from_yaw(math.pi / 2)
    now = state(v=(0.004, 0.0, 0.0), q=east)
    assert measured(state(q=east), now)[1:4] == pytest.approx((0.0, -1.0, -G), abs=1e-4)


def test_a_blow_stays_within_the_range_of_the_sensor() -> None:
    spin = exponential((0.5, 0.0, 0.0))
    got = measured(state(v=(0.0, 0.0, 5.0)), state(q=spin))
    # PX4 stores them as int16 in units of g / 2048 and 2000 / 32768 degrees a second.
    assert all(abs(a) * 2048 / 9.80665 < 32767.0 for a in got[1:4]) and min(got[1:4]) < -150.0
    assert got[4] * 32768 / math.radians(2000.0) < 32767.0 and got[4] > 34.0


def test_the_field_turns_with_the_vehicle() -> None:
    north = measured(state(), state())[7:10]
    south = measured(state(), state(q=from_yaw(math.pi)))[7:10]
    assert south == pytest.approx((-north[0], -north[1], north[2]), abs=1e-6)


def test_pressure_falls_with_height() -> None:
    low, high = measured(state(), state()), measured(state(), state(p=(0.0, 0.0, -100.0)))
    assert low[10] - high[10] == pytest.approx(11.3, abs=0.3)  # hPa, at 490 m above the sea
    assert high[12] - low[12] == pytest.approx(100.0, abs=0.1)


def fixes(sensors: Sensors, count: int, p=lambda t: (0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0)) -> list[tuple]:
    found = []
    for i in range(count * GPS_US // SAMPLE_US + 1):
        t_us = T0 + i * SAMPLE_US
        fix = sensors.hil_gps(t_us, state(p=p((t_us - T0) * 1e-6), v=v))
        if fix is not None:
            found.append(GPS.unpack(fix))
    return found


def test_a_position_is_late_by_its_delay_and_comes_ten_times_a_second() -> None:
    got = fixes(Sensors(1, G, T0, QUIET), 10, lambda t: (0.0, 0.0, -10.0 * t), (3.0, 4.0, -10.0))
    assert [fix[0] - T0 for fix in got] == [GPS_US * (i + 1) for i in range(10)]
    last = got[-1]
    assert last[3] == pytest.approx(489_400 + 10_000.0 * (1.0 - GPS_DELAY_US * 1e-6), abs=2)
    assert last[6:10] == (500, 300, 400, -1000)
    assert last[10] == 5313, "course over ground [cdeg]"


def test_a_step_north_is_a_step_of_latitude() -> None:
    here = fixes(Sensors(1, G, T0, QUIET), 1)[0]
    there = fixes(Sensors(1, G, T0, QUIET), 1, lambda t: (100.0, 50.0, 0.0))[0]
    assert (there[1] - here[1]) * 1e-7 * math.pi / 180.0 * 6371000.0 == pytest.approx(100.0, abs=0.1)
    east = (there[2] - here[2]) * 1e-7 * math.pi / 180.0 * 6371000.0 * math.cos(math.radians(47.397742))
    assert east == pytest.approx(50.0, abs=0.1)


def test_noise_has_the_size_that_it_is_said_to_have() -> None:
    noise = Noise()
    sensors = Sensors(5, G, T0)
    rows = [SENSOR.unpack(sensors.hil_sensor(T0 + i * SAMPLE_US, state(), state())) for i in range(1500)]
    for column, sigma in ((1, noise.acceleration_m_s2), (4, noise.rate_rad_s)):
        assert statistics.stdev(row[column] for row in rows) == pytest.approx(sigma, rel=0.1)
    field = [row[7] for row in rows if row[14] & 0x1C0]
    assert statistics.stdev(field) == pytest.approx(noise.field_g, rel=0.2)
    assert abs(statistics.mean(row[3] for row in rows) + G) < 4.0 * noise.acceleration_bias_m_s2
    assert len({row[7] for row in rows}) > 250, "PX4 calls a sensor stuck whose values stay the same"


def test_the_gps_wanders_slowly_within_its_sigma() -> None:
    noise = Noise()
    got = fixes(Sensors(7, G, T0), 6000)
    north = [(fix[1] - 473977420) * 1e-7 * math.pi / 180.0 * 6371000.0 for fix in got]
    sigma = math.hypot(noise.wander_horizontal_m, noise.gps_horizontal_m)
    assert 0.5 * sigma < statistics.stdev(north) < 1.6 * sigma
    steps = [b - a for a, b in pairwise(north)]
    assert statistics.stdev(steps) < 2.0 * noise.gps_horizontal_m
