"""`sim-link run` as a process of its own: time, ports, the truth file, and how it ends."""

import csv
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from vehicle_tools import HOLD, OFFBOARD, Companion, Flight, free_socket, mavlink

from sim_link.truth_log import COLUMNS
from sim_link.vehicle_file import load

RUN = [sys.executable, "-m", "sim_link", "run", "--vehicle", "paper", "--engine", "python"]


def start(*options, port=0, remote_port=0, wait=True):
    """Start a vehicle; gives the process and what it says once ready."""
    command = [
        *RUN,
        "--port",
        str(port),
        "--remote-port",
        str(remote_port),
        "--no-truth-stream",
        "--json-ready",
        *options,
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    return process, json.loads(process.stdout.readline()) if wait else None


def end(process):
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 0, err
    return out, err


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def lockstep_flight(path, seed):
    """Fly three seconds in rates with noise, gusts and a wind; gives the bytes of the truth and what was received."""
    # With drag, so that wind and gusts act.
    file = path.with_suffix(".toml")
    file.write_text(Path(load("paper").path).read_text().replace("drag_1_s = 0.0", "drag_1_s = 0.5"))
    with free_socket() as sock:
        world = ("--wind", "2,1,0", "--turbulence", "0.3", "--force", "4.76,0,0", "--gravity-factor", "1.05")
        options = ("--lockstep", "--start", "3,-2,-20,30", "--seed", str(seed), "--truth", str(path), "--no-ground")
        options += ("--vehicle", str(file))
        process, ready = start(*world, *options, remote_port=sock.getsockname()[1])
        try:
            c = Companion(sock, ready["port"])
            c.step()
            c.interval("ODOMETRY", 1)
            c.stream(rates=(0.05, 0.0, 0.1))
            c.run(0.2)
            assert c.set_mode(OFFBOARD) == 0
            c.run(3.0)
            received = [m.get_msgbuf()[10:-2] for m in c.of_type("ODOMETRY")]
        finally:
            end(process)
    return path.read_bytes(), received


def test_the_same_seed_gives_the_same_flight_to_the_byte(tmp_path):
    first = lockstep_flight(tmp_path / "1.csv", 7)
    assert first == lockstep_flight(tmp_path / "2.csv", 7)
    other = lockstep_flight(tmp_path / "3.csv", 8)
    assert first[0] != other[0], "gusts"
    assert first[1] != other[1], "noise"
    table = rows(tmp_path / "1.csv")
    assert tuple(table[0]) == COLUMNS
    times = [float(row["t_s"]) for row in table]
    assert times[0] == 1.0
    assert all(abs(b - a - 0.004) < 1e-9 for a, b in itertools.pairwise(times))
    assert len(table) > 750
    assert (float(table[0]["p_n"]), float(table[0]["p_d"])) == (3.0, -20.0)
    # Force 1 m/s^2 north, drag times wind 1 m/s^2 on average, five per cent more gravity.
    assert float(table[-1]["disturbance_n_m_s2"]) == pytest.approx(2.0, abs=1.0)
    assert float(table[-1]["disturbance_d_m_s2"]) == pytest.approx(0.05 * 9.81, abs=0.5)


def test_lockstep_stands_still_until_a_companion_speaks():
    flight = Flight()
    flight._thread.start()
    sock = flight.sock
    decode = mavlink.MAVLink(None)
    begin = time.monotonic()
    kinds = [decode.decode(bytearray(sock.recv(2048))).get_type() for _ in range(4)]
    assert kinds == ["HEARTBEAT"] * 4
    assert time.monotonic() - begin > 0.5
    assert flight.vehicle.t_us == flight.vehicle.start_us
    flight._stopping = True
    flight._thread.join(5.0)
    flight.peer.close()
    sock.close()


def test_a_silent_companion_does_not_stop_the_clock_for_good():
    flight = Flight(start=((0.0, 0.0, -20.0), 0.0), parameters={"COM_OBL_RC_ACT": 5})
    with flight as c:
        c.enter_offboard()
        before = flight.vehicle.t_us
        time.sleep(3.2)  # one second of patience, then real time
        passed = (flight.vehicle.t_us - before) * 1e-6
        assert 1.2 < passed < 3.0
        assert not flight.peer.synchronous
        c.silence()
        c.until(lambda: c.mode == HOLD, 6.0)
        c.run(1.0)
        assert flight.peer.synchronous, "answers bring lockstep back"
        count = flight.vehicle.t_us
        c.run(0.2)
        assert flight.vehicle.t_us - count <= 240_000


def test_speed_and_time_without_lockstep(tmp_path):
    with free_socket() as sock:
        path = tmp_path / "truth.csv"
        process, ready = start("--speed", "5", "--truth", str(path), remote_port=sock.getsockname()[1])
        try:
            decode = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
            begin, stamps, asked = time.monotonic(), [], 0
            while time.monotonic() - begin < 1.5:
                message = decode.decode(bytearray(sock.recv(2048)))
                if message.get_type() == "ODOMETRY":
                    stamps.append((time.monotonic(), message.time_usec * 1e-6))
                asked += message.get_type() == "TIMESYNC"
            request = mavlink.MAVLink_timesync_message(0, 99)
            sock.sendto(request.pack(decode), ("127.0.0.1", ready["port"]))
            while message.get_type() != "TIMESYNC" or message.ts1 != 99:
                message = decode.decode(bytearray(sock.recv(2048)))
            assert message.tc1 > stamps[-1][1] * 1e9
        finally:
            end(process)
    rate = (stamps[-1][1] - stamps[0][1]) / (stamps[-1][0] - stamps[0][0])
    assert 3.0 < rate < 6.0
    assert asked > 10
    table = path.read_text()
    assert table.endswith("\n")
    assert all(line.count(",") == len(COLUMNS) - 1 for line in table.splitlines())


def test_duration_ends_it_and_the_ready_line_names_the_ports(tmp_path):
    path = tmp_path / "truth.csv"
    process, ready = start("--duration", "0.5", "--speed", "50", "--instance", "3", "--truth", str(path))
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "", "")
    assert ready["system_id"] == 4
    assert ready["port"] > 0 and ready["ground_port"] > 0
    assert ready["state_rate_hz"] == 250.0
    assert len(rows(path)) == 126


def test_a_port_in_use_is_one_clear_line():
    with free_socket() as taken:
        port = taken.getsockname()[1]
        process, _ = start(port=port, wait=False)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 2
    assert out == ""
    assert err.count("\n") == 1
    assert str(port) in err and "in use" in err and "--port" in err


BAD = [
    (("--vehicle", "no-such-vehicle"), "no-such-vehicle"),
    (("--state-rate", "90"), "500"),
    (("--px4", "1.15"), "1.18, 1.13"),
    (("--start", "1,2"), "--start"),
    (("--start", "1,2,3"), "down must be negative"),
    (("--force", "1,x,3"), "--force"),
    (("--param", "NO_SUCH=1"), "NO_SUCH"),
    (("--param", "NAV_RCL_ACT=1.5"), "NAV_RCL_ACT"),
    (("--param", "NAV_RCL_ACT"), "NAME=VALUE"),
    (("--gravity-factor", "nan"), "--gravity-factor"),
    (("--gravity-factor", "1e30"), "gravity factor"),
    (("--speed", "0"), "--speed"),
    (("--speed", "2", "--lockstep"), "--speed does nothing with --lockstep"),
    (("--ground-port", "20000"), "--ground-port does nothing with --no-ground"),
    (("--truth-port", "20000", "--no-truth-stream"), "--truth-port does nothing"),
    (("--state-rate", "0.001"), "at least 1 Hz"),
    (("--start", "0,0,-1e300"), "start"),
    (("--force", "1e300,0,0"), "force"),
    (("--wind", "0,1e300,0"), "wind"),
    (("--turbulence", "1e300"), "turbulence"),
    (("--seed", "1" + 400 * "0"), "seed"),
    (("--param", "CA_ROTOR0_PX=5"), "the vehicle file says it"),
    (("--param", "MAV_SYS_ID=7"), "must be 1, the instance says"),
    (("--param", "MAV_COMP_ID=7"), "MAV_COMP_ID"),
    (("--truth", "/no/such/folder/truth.csv"), "/no/such/folder/truth.csv"),
]


@pytest.mark.parametrize(("options", "word"), BAD)
def test_bad_input_is_refused_in_one_line(options, word, capsys):
    from sim_link.cli import app

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as caught:
            app(["run", "--port", "0", "--no-ground", "--duration", "0.01", *options], prog_name="sim-link")
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    out, err = capsys.readouterr()
    assert caught.value.code == 2
    assert out == ""
    assert err.count("\n") == 1 and word in err


def test_a_vehicle_flies_on_when_nobody_reads_its_console_any_more(tmp_path):
    faults = tmp_path / "faults.toml"
    faults.write_text('[[fault]]\nkind = "wind"\nstart_s = 0.2\nend_s = 0.4\nwind_m_s = [1.0, 0.0, 0.0]\n')
    path = tmp_path / "truth.csv"
    options = ("--truth", str(path), "--faults", str(faults), "--start", "0,0,-20", "--duration", "1", "--no-ground")
    process, _ = start(*options)
    process.stderr.close()
    assert process.wait(timeout=20) == 0
    process.stdout.close()
    assert float(rows(path)[-1]["t_s"]) - float(rows(path)[0]["t_s"]) == pytest.approx(1.0, abs=0.05)


def test_interrupt_leaves_a_complete_truth_file_and_no_trace(tmp_path):
    path = tmp_path / "truth.csv"
    process, _ = start("--truth", str(path), "--lockstep")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (0, "")
    assert len(rows(path)) == 1


def test_it_ends_with_its_parent():
    options = ["--port", "0", "--no-ground", "--no-truth-stream", "--with-parent", "--json-ready"]
    script = (
        "import subprocess, os\n"
        f"p = subprocess.Popen({[*RUN, *options]!r}, stdout=subprocess.PIPE)\n"
        "p.stdout.readline()\n"
        "print(p.pid, flush=True)\n"
        "os._exit(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=30, check=True)
    pid = int(done.stdout)
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        if state == "Z":
            return  # ended, and only waits to be collected
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("the vehicle outlived its parent")


def test_version_and_help():
    for option, word in (("--version", "sim-link"), ("--help", "run")):
        done = subprocess.run([sys.executable, "-m", "sim_link", option], capture_output=True, text=True, check=True)
        assert word in done.stdout
    done = subprocess.run([*RUN[:4], "--help"], capture_output=True, text=True, check=True)
    assert "Example: sim-link run" in done.stdout
    assert "[m/s]" in done.stdout
