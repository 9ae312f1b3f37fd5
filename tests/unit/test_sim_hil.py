"""`sim-link hil`: what a PX4 sees of its world over TCP, played by a client that is written with pymavlink alone."""

from __future__ import annotations

import json
import math
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink

from sim_link.airframe import START_US
from sim_link.codec import frames
from sim_link.fault_keys import FaultError
from sim_link.fault_kinds import fault
from sim_link.hil import Hil, HilOptions, HilWorld
from sim_link.hil_link import HilServer, controls_of, split
from sim_link.hil_sensors import Noise
from sim_link.udp import PortError
from sim_link.vehicle_file import VehicleFileError, load
from sim_link.wind import World

IRIS = load("px4_iris")
HOVER = IRIS.mass_kg * 9.81 / (4.0 * IRIS.rotor_thrust_max_n)
QUIET = Noise(*(0.0,) * 11, 60.0)
FAST = 1000.0
GROUPS = (0x007, 0x038, 0x1C0, 0x1A00)


class FakePx4:
    """A PX4's side of the connection."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.waiting: list = []
        self.t_us = 0

    def receive(self):
        """The next message; raises ConnectionError when the world closed the connection."""
        while not self.waiting:
            data = self.socket.recv(4096)
            if not data:
                raise ConnectionError
            self.waiting += self.mav.parse_buffer(data) or []
        return self.waiting.pop(0)

    def sample(self) -> list:
        """All messages up to the next HIL_SENSOR."""
        got = [self.receive()]
        while got[-1].get_type() != "HIL_SENSOR":
            got.append(self.receive())
        self.t_us = got[-1].time_usec
        return got

    def answer(self, controls=(0.0,) * 4, t_us: int | None = None) -> None:
        values = [*controls, *(0.0,) * (16 - len(controls))]
        when = self.t_us if t_us is None else t_us
        self.send(mavlink.MAVLink_hil_actuator_controls_message(when, values, 129, 1))

    def send(self, message) -> None:
        self.socket.sendall(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256

    def fly(self, samples: int, controls=(0.0,) * 4) -> list:
        """Answer so many samples; gives all messages."""
        got = []
        for _ in range(samples):
            got += self.sample()
            self.answer(controls)
        return got

    def silent_for(self, seconds: float) -> bool:
        """Whether nothing comes for a time."""
        return not self.waiting and not select.select([self.socket], [], [], seconds)[0]

    def close(self) -> None:
        self.socket.close()


class Running:
    """A world in a thread of its own."""

    def __init__(self, **options) -> None:
        self.said: list[str] = []
        self.stop = False
        defaults = {"vehicle": IRIS, "speed": FAST, "engine": "python"}
        self.hil = Hil(
            HilOptions(**(defaults | options)), HilServer(0), stopped=lambda: self.stop, notice=self.said.append
        )
        self.port = self.hil.server.port
        self.results: list[bool] = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        while not self.stop:
            self.results.append(self.hil.run())

    def close(self) -> None:
        self.stop = True
        self.thread.join(10.0)
        self.hil.close()
        assert not self.thread.is_alive()


@contextmanager
def flying(**options) -> Iterator[tuple[Running, FakePx4]]:
    world = Running(**options)
    px4 = FakePx4(world.port)
    try:
        yield world, px4
    finally:
        world.stop = True
        px4.close()
        world.close()


def sensors(messages: list) -> list:
    return [m for m in messages if m.get_type() == "HIL_SENSOR"]


def test_every_group_of_fields_is_sent_whole_or_not_at_all() -> None:
    with flying() as (_, px4):
        got = sensors(px4.fly(30))
    assert got[0].fields_updated == sum(GROUPS)
    for message in got:
        assert all(message.fields_updated & group in (0, group) for group in GROUPS)
        assert message.fields_updated & 0x3F == 0x3F, "the IMU is in every sample"
        assert message.id == 0, "the primary sensor, whose time is PX4's"
    assert sum(1 for m in got if m.fields_updated & 0x1C0) == 6  # 50 Hz
    assert sum(1 for m in got if m.fields_updated & 0x1A00) == 6


def test_a_vehicle_at_rest_measures_what_a_vehicle_at_rest_measures() -> None:
    with flying(noise=QUIET) as (_, px4):
        got = px4.fly(60)
    message = sensors(got)[-1]
    assert (message.xacc, message.yacc, message.zacc) == pytest.approx((0.0, 0.0, -9.81), abs=1e-5)
    assert (message.xgyro, message.ygyro, message.zgyro) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    # Zurich: 0.482 G, inclination 63 degrees, declination 3.4 degrees
    assert math.degrees(math.atan2(message.ymag, message.xmag)) == pytest.approx(3.4, abs=0.1)
    assert math.hypot(message.xmag, message.ymag, message.zmag) == pytest.approx(0.4824, abs=0.001)
    assert message.abs_pressure == pytest.approx(955.9, abs=0.5)
    assert message.pressure_alt == pytest.approx(489.4, abs=0.1)
    gps = next(m for m in got if m.get_type() == "HIL_GPS")
    assert (gps.lat, gps.lon, gps.alt) == (473977420, 85455940, 489400)
    assert (gps.vn, gps.ve, gps.vd, gps.vel) == (0, 0, 0, 0)
    assert gps.fix_type == 3 and gps.satellites_visible >= 6
    assert gps.eph < 300 and gps.epv < 500, "centimetres; above, PX4's checks refuse it"
    assert gps.cog == 65535 and gps.yaw == 0, "unknown"


def test_time_rises_by_exactly_one_sample() -> None:
    with flying() as (_, px4):
        got = sensors(px4.fly(50))
    assert got[0].time_usec == START_US
    assert {b.time_usec - a.time_usec for a, b in pairwise(got)} == {4000}


def test_the_world_waits_for_the_controls_of_this_very_sample() -> None:
    with flying() as (world, px4):
        px4.fly(3)
        px4.sample()
        assert px4.silent_for(0.05)
        px4.answer(t_us=px4.t_us - 4000)  # of the sample before
        assert px4.silent_for(0.05)
        px4.answer()
        t_us = px4.t_us
        px4.sample()
        assert px4.t_us == t_us + 4000
        assert world.hil.synchronous and world.hil.misses == 0


def test_before_px4_gives_controls_the_world_runs_at_real_time() -> None:
    with flying() as (world, px4):
        first = px4.sample()[-1].time_usec
        for _ in range(20):
            px4.sample()
        assert px4.t_us - first == 80_000
        assert not world.hil.synchronous and not any("lockstep" in s for s in world.said)


def test_a_silent_px4_is_waited_for_a_bounded_time_and_taken_back() -> None:
    with flying(patience_s=0.1) as (world, px4):
        got = sensors(px4.fly(5))
        lost = world.hil.misses
        for _ in range(10):
            got += sensors(px4.sample())  # says nothing
        assert world.hil.misses == lost + 1, "once it is missed it is not waited for any more"
        assert not world.hil.synchronous
        assert any("no controls from PX4 for 0.1 s" in s for s in world.said)
        got += sensors(px4.fly(20))
        assert sum("in lockstep" in s for s in world.said) >= 2, "taken back"
        assert {b.time_usec - a.time_usec for a, b in pairwise(got)} == {4000}


def test_a_px4_slower_than_real_time_gets_lockstep_too() -> None:
    with flying() as (world, px4):
        for _ in range(10):
            px4.sample()
            time.sleep(0.01)  # more than a sample's time
            px4.answer()
        while not px4.silent_for(0.05):
            px4.sample()
        assert world.hil.synchronous and world.hil.misses == 0, "it stands still until the newest sample is answered"


def test_a_px4_that_leaves_ends_the_world_and_the_next_one_finds_it_at_its_start() -> None:
    world = Running()
    try:
        first = FakePx4(world.port)
        first.fly(100, (1.0,) * 4)
        first.close()
        second = FakePx4(world.port)
        got = second.sample()
        assert got[-1].time_usec == START_US
        assert world.results == [False]
        assert any("PX4 has left: it closed the connection" in s for s in world.said)
        assert world.hil.world.airframe.rigid.p == (0.0, 0.0, 0.0)
        world.stop = True
        second.close()
    finally:
        world.close()


def test_a_px4_that_leaves_with_something_unread_has_closed_the_connection_too() -> None:
    """Its system then resets the connection."""
    with flying() as (world, px4):
        px4.fly(10)
        assert select.select([px4.socket], [], [], 5.0)[0]
        px4.close()
        second = FakePx4(world.port)
        second.sample()
        assert next(s for s in world.said if "has left" in s).startswith("PX4 has left: it closed the connection")
        world.stop = True
        second.close()


def test_a_second_px4_is_sent_away() -> None:
    with flying() as (world, px4):
        px4.fly(2)
        other = FakePx4(world.port)
        px4.fly(260)
        other.socket.settimeout(5.0)
        assert other.socket.recv(1) == b""
        other.close()
        assert any("a second PX4 was sent away" in s for s in world.said)
        px4.fly(2)


def test_a_port_in_use_is_refused_in_one_line() -> None:
    server = HilServer(0)
    try:
        with pytest.raises(PortError, match=f"TCP port {server.port} on 127.0.0.1 is in use"):
            HilServer(server.port)
        command = [sys.executable, "-m", "sim_link", "hil", "--port", str(server.port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    finally:
        server.close()
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and f"TCP port {server.port}" in done.stderr


def test_the_command_serves_one_px4_and_says_how_it_ended(tmp_path) -> None:
    truth = tmp_path / "truth.csv"
    options = "--port 0 --speed 1000 --once --json-ready --with-parent --engine python --duration 0.2"
    command = [sys.executable, "-m", "sim_link", "hil", *options.split(), "--truth", str(truth)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        px4 = FakePx4(json.loads(process.stdout.readline())["port"])
        with pytest.raises(ConnectionError):
            px4.fly(1000, (0.6,) * 4)
        assert process.wait(20.0) == 0
        px4.close()
    rows = truth.read_text().splitlines()
    assert len(rows) == 51
    assert float(rows[-1].split(",")[3]) < 0.0, "it has risen"


def test_px4_gets_the_truth_when_it_asks_for_it() -> None:
    with flying() as (_, px4):
        px4.fly(5)
        values = (115.0, 5000.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        px4.send(mavlink.MAVLink_command_long_message(0, 0, 511, 0, *values))
        got = px4.fly(41)
    truth = [m for m in got if m.get_type() == "HIL_STATE_QUATERNION"]
    assert 18 <= len(truth) <= 21, "5 ms become 8 ms, two samples"
    assert (truth[-1].lat, truth[-1].lon) == (473977420, 85455940)


# The world itself


def world_after(seconds: float, controls, **options) -> HilWorld:
    world = HilWorld(HilOptions(**({"vehicle": IRIS, "engine": "python", "noise": QUIET} | options)))
    for _ in range(round(seconds / 0.004)):
        world.sample()
        world.advance(controls)
    return world


def test_rotor_positions_and_turning_are_those_of_airframe_10016() -> None:
    assert IRIS.rotor_x_m == (0.1515, -0.1515, 0.1515, -0.1515)
    assert IRIS.rotor_y_m == (0.2450, -0.1875, -0.2450, 0.1875)
    assert IRIS.rotor_yaw_m == (0.05, 0.05, -0.05, -0.05)
    # More thrust front right turns left (roll < 0), nose up (pitch > 0), and its counterclockwise rotor the nose right.
    for rotor, signs in enumerate(((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1))):
        controls = [0.7] * 4
        controls[rotor] = 0.8
        w = world_after(0.1, tuple(controls)).airframe.rigid.w
        assert [math.copysign(1, x) for x in w] == list(signs), f"rotor {rotor + 1}"


def test_controls_are_rotor_commands() -> None:
    assert world_after(1.0, (HOVER - 0.01,) * 4).airframe.on_ground
    assert world_after(1.0, (HOVER + 0.02,) * 4).airframe.rigid.p[2] < -0.05
    free = world_after(0.4, (1.0, 1.0, 1.0, 1.0))
    lift = 4.0 * IRIS.rotor_thrust_max_n / IRIS.mass_kg
    assert free.airframe.rigid.v[2] == pytest.approx(9.81 * 0.4 - lift * (0.4 - IRIS.rotor_lag_s), rel=0.1)
    stopped = world_after(0.5, (math.nan, 2.0, -1.0, math.inf)).airframe.rigid.rotor_n
    assert stopped == pytest.approx((0.0, IRIS.rotor_thrust_max_n, 0.0, IRIS.rotor_thrust_max_n), abs=1e-4)


@pytest.mark.numba
def test_both_engines_give_the_same_samples() -> None:
    one = world_after(0.5, (0.6, 0.61, 0.62, 0.63), world=World(wind_m_s=(5.0, 0.0, 0.0), turbulence=0.2))
    two = world_after(
        0.5, (0.6, 0.61, 0.62, 0.63), world=World(wind_m_s=(5.0, 0.0, 0.0), turbulence=0.2), engine="numba"
    )
    assert one.airframe.rigid.p == pytest.approx(two.airframe.rigid.p, abs=1e-12)
    assert one.airframe.rigid.q == pytest.approx(two.airframe.rigid.q, abs=1e-12)


def test_wind_and_force_act() -> None:
    hover = (HOVER + 0.05,) * 4
    assert world_after(1.0, hover).airframe.rigid.p[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    n, e, _ = world_after(1.0, hover, world=World(wind_m_s=(0.0, 5.0, 0.0), force_n=(1.0, 0.0, 0.0))).airframe.rigid.p
    assert n == pytest.approx(0.3, abs=0.1)
    assert e == pytest.approx(0.65, abs=0.25)


def test_faults_of_body_and_air_act_at_their_times() -> None:
    said: list[str] = []
    options = HilOptions(
        vehicle=IRIS,
        engine="python",
        faults=(fault("rotor", 0.1, 0.2, rotor=2, share=0.5), fault("wind", 0.3, wind_m_s=(0.0, 8.0, 0.0))),
    )
    world = HilWorld(options, said.append)
    thrusts = []
    for _ in range(100):
        world.advance((0.4,) * 4)
        thrusts.append(world.airframe.rigid.rotor_n[1])
    at = IRIS.rotor_thrust_max_n * 0.4
    assert thrusts[24] == pytest.approx(at, rel=0.05)
    assert thrusts[49] == pytest.approx(0.5 * at, rel=0.1)
    assert thrusts[99] == pytest.approx(at, rel=0.05)
    assert [s.split(": ", 1)[1].split()[0] for s in said] == ["begins:", "ends:", "begins:"]
    assert world.airframe.truth().disturbance_m_s2[1] == pytest.approx(8.0 * IRIS.drag_1_s)


def test_what_is_px4s_own_business_cannot_be_a_fault_here() -> None:
    with pytest.raises(FaultError, match=r"fault\[1\].kind = 'loss': .*allowed are rotor, thrust_scale, wind, force"):
        HilWorld(HilOptions(vehicle=IRIS, faults=(fault("thrust_scale", factor=0.9), fault("loss", share=0.1))))


def test_a_vehicle_whose_steps_do_not_fit_into_a_sample_is_refused(tmp_path) -> None:
    text = (IRIS.path, "loop_rate_hz = 500.0", "loop_rate_hz = 400.0")
    path = tmp_path / "odd.toml"
    with open(text[0], encoding="utf-8") as file:
        path.write_text(file.read().replace(*text[1:]))
    with pytest.raises(VehicleFileError, match=r"autopilot.loop_rate_hz = 400: must be a multiple of the 250"):
        HilWorld(HilOptions(vehicle=load(str(path))))


def test_the_same_seed_measures_the_same_and_another_does_not() -> None:
    def samples(seed: int) -> bytes:
        world = HilWorld(HilOptions(vehicle=IRIS, engine="python", seed=seed))
        data = b""
        for _ in range(60):
            data += world.sample()
            world.advance((0.55,) * 4)
        return data

    assert samples(3) == samples(3)
    assert samples(3) != samples(4)


# The stream


def controls_frames(count: int) -> list[bytes]:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    made = []
    for i in range(count):
        message = mavlink.MAVLink_hil_actuator_controls_message(4000 * i, [0.1 * i] * 16, 129, 1)
        made.append(bytes(message.pack(mav, force_mavlink1=i % 3 == 2)))
        mav.seq += 1
    return made


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 120), min_size=1, max_size=40), st.binary(max_size=20))
def test_frames_are_found_however_the_stream_is_cut(cuts: list[int], noise: bytes) -> None:
    junk = bytes(b for b in noise if b not in (0xFD, 0xFE))
    made = controls_frames(6)
    stream = junk.join(made)
    found, rest, at = [], b"", 0
    for cut in [*cuts, len(stream)]:
        pieces, rest = split(rest + stream[at : at + cut])
        found += pieces
        at += cut
    assert found == made and rest == b""
    times = [controls_of(frames(piece)[0]).t_us for piece in found]
    assert times == [4000 * i for i in range(6)]


def test_a_frame_that_is_broken_is_passed_over() -> None:
    first, second, third = controls_frames(3)
    broken = second[:20] + bytes((second[20] ^ 0xFF,)) + second[21:]
    pieces, _ = split(first + broken + third)
    assert [controls_of(f).t_us for piece in pieces for f in frames(piece)] == [0, 8000]
