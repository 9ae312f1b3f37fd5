"""A real PX4 of airframe 10016 flies in the world of `sim-link hil`. Skipped without one: see px4_tools."""

from __future__ import annotations

import math
import signal
import time

import pytest
from px4_tools import LAND, binary, flying

from sim_link.hil import HilOptions
from sim_link.rotation import body_z
from sim_link.vehicle_file import load
from sim_link.wind import World

pytestmark = pytest.mark.timeout(300)
SPEED = 3.0


@pytest.fixture(autouse=True)
def there_is_a_px4() -> None:
    binary()


def options(**changes) -> HilOptions:
    return HilOptions(**({"vehicle": load("px4_iris"), "speed": SPEED} | changes))


def distance(a, b) -> float:
    return math.dist(a[:3], b[:3])


def tilt(rigid) -> float:
    return math.acos(min(1.0, body_z(rigid.q)[2]))


def test_it_connects_arms_takes_off_holds_in_wind_and_lands(tmp_path) -> None:
    with flying(options(), tmp_path) as flight:
        flight.boot()
        assert not flight.link.armed
        assert flight.truth.p == pytest.approx((0.0, 0.0, 0.0), abs=0.01)

        flight.take_off()
        link = flight.link
        link.passed(6.0 / SPEED)
        estimate = [link.value("LOCAL_POSITION_NED", axis) for axis in "xyz"]
        assert distance(estimate, flight.truth.p) < 1.5, "the estimate is where the vehicle is"
        at = flight.truth.p
        link.passed(6.0 / SPEED)
        assert distance(at, flight.truth.p) < 0.7, "it holds"
        assert tilt(flight.truth) < 0.1
        hover = sum(flight.hil.controls.controls[:4]) / 4.0
        assert hover == pytest.approx(0.497, abs=0.05)

        flight.hil.world.airframe.set_wind((5.0, 0.0, 0.0), 0.1)
        link.passed(10.0 / SPEED)
        assert distance(at, flight.truth.p) < 1.5, "it holds in wind"
        leaning = math.atan(5.0 * 0.30 / 9.81)
        assert tilt(flight.truth) == pytest.approx(leaning, abs=0.07), "it leans against it"
        flight.hil.world.airframe.set_wind((0.0, 0.0, 0.0), 0.0)

        nan = float("nan")
        assert link.command(LAND, 0.0, 0.0, 0.0, nan, nan, nan, nan) == 0
        link.until(lambda: not link.armed, 40.0, "landed and disarmed")
        assert flight.truth.p[2] == pytest.approx(0.0, abs=0.01)
        link.until(lambda: max(flight.hil.controls.controls[:4]) == 0.0, 5.0, "rotors off")

        assert flight.hil.misses == 0, "lockstep was never lost"
        assert sum("in lockstep" in sentence for sentence in flight.said) == 1


def test_it_flies_in_gusts_from_the_start(tmp_path) -> None:
    world = World(wind_m_s=(0.0, 4.0, 0.0), turbulence=0.2, seed=2)
    with flying(options(world=world), tmp_path) as flight:
        flight.boot()
        flight.take_off()
        at = flight.truth.p
        flight.link.passed(8.0 / SPEED)
        assert distance(at, flight.truth.p) < 1.5
        assert flight.link.armed and flight.hil.misses == 0


def test_a_px4_that_stands_still_is_waited_for_a_bounded_time_and_one_that_is_killed_is_missed(tmp_path) -> None:
    with flying(options(patience_s=0.3), tmp_path) as flight:
        flight.boot()
        missed = flight.hil.misses
        flight.px4.signal(signal.SIGSTOP)
        end_s = time.monotonic() + 20.0
        while flight.hil.misses == missed and time.monotonic() < end_s:
            time.sleep(0.05)
        stood_us = flight.hil.world.t_us
        time.sleep(0.5)
        assert flight.hil.misses == missed + 1, "it is not waited for again and again"
        assert flight.hil.world.t_us > stood_us, "the world goes on"
        flight.px4.signal(signal.SIGCONT)
        flight.link.until(lambda: flight.hil.synchronous, 30.0, "lockstep again")

        flight.px4.signal(signal.SIGKILL)
        flight.thread.join(10.0)
        assert not flight.thread.is_alive()
        assert flight.results == [False]
        assert any("PX4 has left" in sentence for sentence in flight.said)
