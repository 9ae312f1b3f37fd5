"""Faults on real sockets: a vehicle's answers and flight under them, orders by hand, a companion that survives."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import math
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from flight_cases import Stand, make_flight
from typer.testing import CliRunner
from vehicle_tools import HOLD, IN_AIR, LAND, OFFBOARD, Flight, free_socket, mavlink

from companion.flight.phases import Cause
from companion.record.columns import COLUMNS
from sim_link.cli import app
from sim_link.fault_client import FaultClient, NoVehicleError
from sim_link.fault_file import load as load_faults
from sim_link.fault_keys import FaultError
from sim_link.fault_kinds import fault
from sim_link.truth_log import TruthLog
from sim_link.vehicle_file import load

POSITION = 3 << 16
INJECT_FAILURE = 420
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
WALL_COLUMNS = ("state_age_ms", "step_us", "late")
"""Of the record: what the wall clock says."""


def flight(*faults, **options) -> Flight:
    return Flight(**{"start": IN_AIR, "faults": faults, **options})


# Datagrams


EVERY_DATAGRAM_FAULT = """
[[fault]]
kind = "loss"
start_s = 0.3
share = 0.1
[[fault]]
kind = "burst_loss"
start_s = 0.3
good_s = 0.3
bad_s = 0.05
direction = "from_vehicle"
[[fault]]
kind = "jitter"
start_s = 0.5
jitter_s = 0.03
[[fault]]
kind = "duplicate"
start_s = 0.5
share = 0.1
late_s = 0.02
[[fault]]
kind = "reorder"
start_s = 0.5
share = 0.1
late_s = 0.05
[[fault]]
kind = "corrupt"
start_s = 0.5
share = 0.1
[[fault]]
kind = "force"
start_s = 1.0
end_s = 1.2
force_n = [3.0, 0.0, 0.0]
[[fault]]
kind = "rotor"
start_s = 1.5
rotor = 4
share = 0.9
"""


def flown(path: Path, seed: int) -> tuple[str, str, list[bytes]]:
    """Fly two seconds under every fault of datagrams; gives the truth, the faults and what was received."""
    faults = path.with_suffix(".toml")
    faults.write_text(EVERY_DATAGRAM_FAULT)
    stand = Flight(start=IN_AIR, faults=load_faults(str(faults)), seed=seed)
    stand.peer.log_truth(TruthLog(path))
    stand.vehicle.faults.log_to(path.with_suffix(".faults.csv"))
    with stand as c:
        c.bad_frames = True
        c.each = lambda: c.attitude_target(128, rates=(0.1 * math.sin(c.t_us * 1e-5), 0.0, 0.1))
        c.step()
        assert c.set_mode(OFFBOARD) == ACCEPTED
        while c.t_us < 3_000_000:
            c.step()
        received = c.raw
    return path.read_text(), path.with_suffix(".faults.csv").read_text(), received


def test_the_same_seed_and_faults_give_the_same_flight_to_the_byte(tmp_path: Path) -> None:
    first = flown(tmp_path / "1.csv", 7)
    assert first == flown(tmp_path / "2.csv", 7)
    truth, events, received = first
    assert [line.split(",")[2] for line in events.splitlines()[1:]] == ["begins"] * 7 + ["ends"] + ["begins"]
    other = flown(tmp_path / "3.csv", 8)
    assert truth != other[0] and received != other[2]
    digests = {hashlib.sha256(raw).digest() for raw in received}
    assert len(digests) < len(received), "some came twice"


def test_lost_states_do_not_stop_the_exchange_and_silence_ends() -> None:
    with flight(fault("silence", 1.0, 2.0)) as c:
        c.run(1.0 - (c.t_us - 1_000_000) * 1e-6 + 0.04)
        assert c.count("ODOMETRY", 0.9) == 0
        assert {m.get_type() for m in c.log} == {"TIMESYNC"}
        c.run(0.1)
        assert c.count("ODOMETRY", 0.2) == 10


def test_what_the_vehicle_does_not_hear_does_not_count() -> None:
    """All setpoints are lost for longer than COM_OF_LOSS_T: the failsafe acts, and ends with the loss."""
    lost = fault("loss", 2.0, 4.0, share=1.0, direction="to_vehicle", messages=["SET_ATTITUDE_TARGET"])
    with flight(lost, parameters={"COM_OBL_RC_ACT": 5, "COM_OF_LOSS_T": 0.5}) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.0))
        c.until(lambda: c.t_us > 2_900_000)
        assert c.mode == OFFBOARD
        c.until(lambda: c.mode == HOLD, 1.0)
        c.until(lambda: c.t_us > 4_900_000)
        assert c.mode == HOLD and c.intended == OFFBOARD
        c.until(lambda: c.mode == OFFBOARD, 1.0)


def test_a_delay_is_seen_by_both_sides() -> None:
    with flight(fault("delay", 0.5, delay_s=0.1)) as c:
        c.until(lambda: c.t_us > 2_000_000)
        state = c.last["ODOMETRY"]
        assert c.t_us - state.time_usec == 100_000
        begin_us = c.t_us
        c.send(mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0))
        c.last.pop("COMMAND_ACK", None)
        c.until(lambda: "COMMAND_ACK" in c.last, 1.0)
        # There and back, and the answer goes out after the state in which the question is heard.
        assert c.t_us - begin_us == pytest.approx(200_000, abs=40_000)


def test_wrong_answers_to_timesync() -> None:
    with flight(fault("timesync", 0.5, offset_s=-0.25)) as c:
        c.until(lambda: c.t_us > 2_000_000)
        c.send(mavlink.MAVLink_timesync_message(0, 77))
        c.until(lambda: any(m.ts1 == 77 for m in c.of_type("TIMESYNC")), 1.0)
        (answer,) = (m for m in c.of_type("TIMESYNC") if m.ts1 == 77)
        assert answer.tc1 // 1000 == pytest.approx(c.t_us - 250_000, abs=40_000)


# The vehicle


def test_a_vehicle_falls_with_a_rotor_that_has_stopped() -> None:
    with flight(fault("rotor", 0.5, rotor=1)) as c:
        c.run(2.5)
        assert c.tilt > 0.5 or c.position[2] > -15.0
        c.run(3.0)
        assert c.position[2] == pytest.approx(0.0, abs=0.1)


def test_the_pilot_takes_a_mode() -> None:
    with flight(fault("pilot_mode", 1.0, mode="Position")) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.0))
        c.until(lambda: c.mode == POSITION, 2.0)
        assert c.t_us == pytest.approx(2_000_000, abs=60_000)
        c.run(3.0)
        assert c.mode == c.intended == POSITION, "the sticks are there"
        assert c.position[2] == pytest.approx(-20.0, abs=2.0)


def test_a_command_is_refused_for_a_time() -> None:
    with flight(fault("refuse", 0.0, 2.0, command="DO_SET_MODE", result="DENIED")) as c:
        assert c.set_mode(LAND) == DENIED
        assert c.mode == HOLD
        c.until(lambda: c.t_us > 3_000_000)
        assert c.set_mode(LAND) == ACCEPTED
        c.until(lambda: c.mode == LAND, 1.0)


def test_a_parameter_changes_in_flight_and_listeners_are_told() -> None:
    with flight(fault("parameter", 1.0, 1.5, name="COM_OBL_RC_ACT", value=4)) as c:
        c.until(lambda: c.t_us > 2_800_000)
        told = [(m.param_id, mavlink_int(m.param_value)) for m in c.of_type("PARAM_VALUE")]
        assert told == [("COM_OBL_RC_ACT", 4), ("COM_OBL_RC_ACT", 5)]


def mavlink_int(value: float) -> int:
    import struct

    return struct.unpack("<i", struct.pack("<f", value))[0]


def test_an_autopilot_that_reboots_in_flight() -> None:
    with flight(fault("reboot", 1.0, boot_s=1.5)) as c:
        c.enter_offboard(rates=(0.0, 0.0, 0.0))
        c.until(lambda: c.t_us > 1_980_000)
        c.log.clear()
        for _ in range(70):
            c.step()
        assert {m.get_type() for m in c.log} == {"TIMESYNC"}
        c.silence()
        while c.t_us > 1_900_000:
            c.step()
        assert c.t_us == pytest.approx(1_500_000, abs=60_000), "time begins anew"
        c.until(lambda: not c.armed, 2.0)
        assert c.last["HEARTBEAT"].custom_mode == HOLD
        c.until(lambda: c.of_type("ODOMETRY"), 1.0)
        assert c.last["ODOMETRY"].time_usec <= c.t_us
        c.run(3.0)
        assert c.position[2] == pytest.approx(0.0, abs=0.1), "it has fallen"
        assert c.arm() == ACCEPTED


def test_px4s_own_command_stops_a_motor_and_lets_it_run_again() -> None:
    with flight() as c:
        assert c.command(INJECT_FAILURE, 101, 1, 2) == ACCEPTED
        c.run(0.2)
        assert abs(c.rates[0]) + abs(c.rates[1]) > 0.3
        assert c.command(INJECT_FAILURE, 101, 0, 2) == ACCEPTED
        c.run(6.0)
        assert c.tilt < 0.1 and c.position[2] < -5.0
        assert c.command(INJECT_FAILURE, 101, 3, 2) == UNSUPPORTED
        c.set_param("SYS_FAILURE_EN", 0)
        assert c.command(INJECT_FAILURE, 101, 1, 2) == UNSUPPORTED


def test_the_companion_itself_orders_faults_in_the_shell() -> None:
    """As MAVSDK's shell plugin does, over the link that it has; in lockstep they act in the same state every time."""
    with flight() as c:
        line = b"fault force, force_n = [0, 30, 0], for_s = 0.2\n"
        data = list(line.ljust(70, b"\0"))
        c.send(mavlink.MAVLink_serial_control_message(10, 4, 0, 0, len(line), data))
        c.until(lambda: "SERIAL_CONTROL" in c.last, 1.0)
        answer = c.last["SERIAL_CONTROL"]
        assert bytes(answer.data[: answer.count]) == b"fault 0\n"
        c.run(0.3)
        assert c.last["ODOMETRY"].vy > 0.5


# Processes


@contextlib.contextmanager
def vehicle(*options: str) -> Iterator[tuple[subprocess.Popen[str], dict, socket.socket]]:
    """A vehicle of its own process, what it says once ready, and the socket that it speaks to first."""
    with free_socket() as sock:
        command = [sys.executable, "-m", "sim_link", "run", "--vehicle", "paper", "--engine", "python"]
        command += ["--port", "0", "--remote-port", str(sock.getsockname()[1]), "--no-ground", "--no-truth-stream"]
        process = subprocess.Popen(
            [*command, "--json-ready", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            assert process.stdout is not None
            yield process, json.loads(process.stdout.readline()), sock
        finally:
            process.kill()
            process.communicate()


def end(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=10)
    assert process.returncode == 0, err
    return err


def test_faults_are_ordered_of_a_running_vehicle(tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    options = ("--start", "0,0,-20", "--state-rate", "50", "--truth", str(truth), "--speed", "5")
    with vehicle(*options) as (process, ready, sock), FaultClient(ready["port"]) as client:
        assert client.list() == "no faults"
        number = client.inject("rotor", rotor=2, share=0.9)
        assert client.inject("pilot_mode", mode="Hold", start_s=1000.0) == number + 1
        with pytest.raises(FaultError, match="overlaps fault 0"):
            client.inject("rotor", rotor=2)
        with pytest.raises(FaultError, match="unknown; allowed are loss"):
            client.inject("rotors", rotor=2)
        done = CliRunner().invoke(app, ["fault", "--port", str(ready["port"]), "list"])
        assert done.exit_code == 0
        lines = done.stdout.splitlines()
        assert lines[0].startswith("0 acts from ") and lines[0].endswith("for good: rotor rotor = 2, share = 0.9")
        assert lines[1] == "1 waits from 1000 s for good: pilot_mode mode = Hold"
        client.end(number)
        client.end()
        assert client.list() == "no faults"
        # Who orders faults is not the vehicle's partner: that one gets its states still.
        assert sock.recv(2048)[0] == 0xFD
        assert process.stderr is not None
        told = [process.stderr.readline(), process.stderr.readline()]
        end(process)
    assert told[0].endswith("fault 0 begins: rotor rotor = 2, share = 0.9 (for good)\n")
    assert told[1].endswith("fault 0 ends: rotor rotor = 2, share = 0.9\n")
    with truth.with_suffix(".faults.csv").open() as file:
        assert [(row["number"], row["event"]) for row in csv.DictReader(file)] == [("0", "begins"), ("0", "ends")]


def test_an_order_does_not_start_a_vehicle_in_lockstep(tmp_path: Path) -> None:
    """So that a fault can be ordered before the flight, for a time of the flight."""
    flight_ = flight()
    flight_._thread.start()
    with FaultClient(flight_.peer.companion.port) as client:
        client.inject("force", start_s=0.5, end_s=0.6, force_n=(0, 0, -9))
        assert flight_.vehicle.faults.elapsed_s == 0.0
        assert flight_.peer.companion.partner is None
    flight_._stopping = True
    flight_._thread.join(5.0)
    flight_.peer.close()
    flight_.sock.close()


def test_nobody_answers(tmp_path: Path) -> None:
    with free_socket() as sock:
        port = sock.getsockname()[1]
    with FaultClient(port) as client, pytest.raises(NoVehicleError, match=rf"no answer .* at 127\.0\.0\.1:{port}"):
        client.list()
    done = CliRunner().invoke(app, ["fault", "--port", str(port), "list"])
    assert done.exit_code == 4


# A flight


def test_a_flight_survives_loss_each_way_and_a_gust(tmp_path: Path) -> None:
    """5 % of all datagrams lost each way, late by up to a state, and 2 m/s^2 from the side: it completes."""
    mass_kg = load("paper").mass_kg
    faults = (
        fault("loss", share=0.05),
        fault("jitter", jitter_s=0.008, direction="from_vehicle"),
        fault("force", 4.5, 5.5, force_n=(0.0, 2.0 * mass_kg, 0.0)),
    )
    flights = []
    for _ in range(2):
        with Stand(make_flight(), tmp_path, faults=faults) as stand:
            flights.append(stand.fly())
            for channel in stand.vehicle.faults.effects.links["companion"].channels.values():
                counts = channel.counts
                assert counts.lost / counts.taken == pytest.approx(0.05, abs=0.02)
        assert flights[-1].cause is Cause.COMPLETED, flights[-1].outcome.sentence
        assert flights[-1].summary["position_max_m"] < 1.0
    kept = [name for name in COLUMNS if name not in WALL_COLUMNS]
    first, second = (flown.record.columns(*kept).tobytes() for flown in flights)
    assert first == second, "the same seed and faults, the same flight"
