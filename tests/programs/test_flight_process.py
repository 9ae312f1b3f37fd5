"""The programs as processes: signals, kills, ports, and what is left behind."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import tomlkit
from flight_cases import HOVER, Stand, flight_data, make_flight

from companion.errors import ExitCode
from companion.flight.bundled import free_udp_port
from companion.record.folder import write_configuration
from sim_link.modes import Mode

PATIENCE_S = 60.0


GROUND_SIDE = """
import sys
from pathlib import Path
from companion.flight.launch import control
said = lambda message: print(message.get("line", ""), flush=True)
flown = control(Path(sys.argv[1]), sys.argv[2], "python", 30.0, said)
print(flown.sentence, file=sys.stderr)
sys.exit(flown.exit_code)
"""
"""What `companion fly` does after its gates, which take a while."""


class Command:
    """A program as a process in a session of its own, like one in a terminal of its own."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in (*self.children(), self.process.pid):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        self.process.communicate()

    def children(self, name: str = "", of: int | None = None) -> list[int]:
        """Process ids of its children, or another process's, whose command line holds a name."""
        found = []
        for folder in Path("/proc").iterdir():
            if not folder.name.isdigit():
                continue
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if parent == (of or self.process.pid) and name in words:
                found.append(int(folder.name))
        return found

    @property
    def control_pid(self) -> int:
        (pid,) = self.children("companion.flight.process")
        return pid

    def ends(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def fly(folder: Path, port: int, duration_s: float, *options: str) -> Command:
    """`companion fly` over a point."""
    folder.mkdir(exist_ok=True)
    data = flight_data(trajectory=dict(HOVER) | {"duration_s": duration_s}, statistics_from_s=1.0)
    path = folder / "flight.toml"
    path.write_text(tomlkit.dumps(data))
    trajectory = folder / "hover.toml"
    trajectory.write_text(tomlkit.dumps({k: v for k, v in data["trajectory"].items() if k != "name"}))
    return Command(
        *("-m", "companion", "fly", str(trajectory), "--flight", str(path), "--connect", f"udpin:127.0.0.1:{port}"),
        *("--out", str(folder / "out"), "--engine", "python", *options),
    )


def control(folder: Path, port: int, duration_s: float) -> Command:
    """The ground side of a flight over a point, past its gates."""
    out = folder / "out"
    out.mkdir(parents=True)
    flight = make_flight(trajectory=dict(HOVER) | {"duration_s": duration_s}, statistics_from_s=1.0)
    write_configuration(out, flight.model_dump(exclude_none=True))
    return Command("-c", GROUND_SIDE, str(out), f"udpin:127.0.0.1:{port}")


def test_killed_control_process(tmp_path: Path) -> None:
    """The vehicle fails safe as its parameters say, and the ground side says what happened."""
    wanted = {5: Mode.HOLD, 4: Mode.LAND}
    with contextlib.ExitStack() as stack:
        flights = []
        for action in wanted:
            folder = tmp_path / str(action)
            folder.mkdir()
            parameters = {"COM_OBL_RC_ACT": action, "COM_OF_LOSS_T": 0.5}
            stand = stack.enter_context(Stand(make_flight(), folder, parameters=parameters))
            flights.append((stand, stack.enter_context(control(folder, stand.port, 60.0))))
        for stand, command in flights:
            until(lambda stand=stand: stand.offboard_s > 0.5)
            os.kill(command.control_pid, signal.SIGKILL)
        for (stand, command), mode in zip(flights, wanted.values(), strict=True):
            code, _, err = command.ends()
            until(lambda stand=stand: stand.mode is not Mode.OFFBOARD)
            assert stand.mode is mode
            assert stand.vehicle.autopilot.in_failsafe
            assert stand.t_us - stand.setpoints()[-1].t_us >= 500_000
            assert code == ExitCode.INTERNAL
            assert "ended by signal 9" in err
            assert "Traceback" not in err


def test_killed_ground_side(tmp_path: Path) -> None:
    """The flight goes on to its end, and its results are there."""
    with Stand(make_flight(), tmp_path) as stand, control(tmp_path, stand.port, 3.0) as command:
        until(lambda: stand.offboard_s > 0.5)
        os.kill(command.process.pid, signal.SIGKILL)
        summary_file = tmp_path / "out" / "summary.json"
        until(summary_file.exists)
        assert stand.mode is Mode.HOLD
    summary = json.loads(summary_file.read_text())
    assert summary["duration_s"] == pytest.approx(3.0, abs=0.02)
    assert summary["verdict"] == "passed"
    assert summary["ended"] == "the flight was completed: the vehicle is in Hold"
    assert (tmp_path / "out" / "link.tlog").stat().st_size > 100_000


def test_a_full_disk_costs_records_and_no_step(tmp_path: Path) -> None:
    """From some moment of the flight on no file grows beyond 40 kB, as on a disk that is full. What did not fit is
    counted and said; the flight ends as it would have, every state answered."""
    with Stand(make_flight(), tmp_path) as stand, control(tmp_path, stand.port, 3.0) as command:
        until(lambda: stand.offboard_s > 0.5)
        for pid in (control_pid := command.control_pid, *command.children("companion.record.recorder", control_pid)):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
        code, out, err = command.ends()
        assert stand.mode is Mode.HOLD
    assert code == ExitCode.DONE, err
    assert err.count("nothing more is written, the flight goes on") == 2
    assert "Traceback" not in err
    assert "link.tlog, flight.ulg: incomplete, the disk did not take everything" in out
    assert "record.npz: cannot be written (File too large)\n" in out, "the log does not have it either"
    folder = tmp_path / "out"
    assert not list(folder.glob("*.npz")) + list(folder.glob(".*"))
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["verdict"], summary["lost_setpoints"]) == ("passed", 0)
    assert summary["duration_s"] == pytest.approx(3.0, abs=0.02)


def test_ctrl_c_in_flight(tmp_path: Path) -> None:
    """Hold, then 130."""
    with Stand(make_flight(), tmp_path) as stand, fly(tmp_path, stand.port, 8.0, "--json") as command:
        until(lambda: stand.offboard_s > 0.5)
        os.kill(command.process.pid, signal.SIGINT)
        code, out, err = command.ends()
        assert (stand.mode, stand.vehicle.autopilot.intended) == (Mode.HOLD, Mode.HOLD)
        assert not stand.vehicle.autopilot.in_failsafe
    assert code == ExitCode.INTERRUPTED
    document = json.loads(out)
    assert document["exit_code"] == ExitCode.INTERRUPTED
    assert document["ended"] == "interrupted by the operator: the vehicle is in Hold"
    assert "Traceback" not in err
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["verdict"].startswith("ended early")


def test_ctrl_c_in_the_demo(tmp_path: Path) -> None:
    """A terminal sends it to the whole process group: the vehicle outlives it until it is handed over, and nobody is
    left behind."""
    with Command("-m", "companion", "demo", "--out", str(tmp_path / "out"), "--engine", "python") as command:
        lines = iter(command.process.stdout.readline, "")  # type: ignore[union-attr]
        assert any("track: OFFBOARD confirmed" in line for line in lines)
        started = command.children()
        assert len(started) == 2
        os.killpg(command.process.pid, signal.SIGINT)
        code, out, err = command.ends()
        assert command.children() == []
    assert code == ExitCode.INTERRUPTED
    assert "interrupted by the operator: the vehicle is in Hold" in out
    assert "Traceback" not in err
    assert all(not Path(f"/proc/{pid}").exists() for pid in started)
    assert (tmp_path / "out" / "report.html").exists()


def test_ctrl_c_before_anything_connects(tmp_path: Path) -> None:
    """While the control process starts, and while it waits for a vehicle."""
    with (
        control(tmp_path / "1", free_udp_port(), 1.0) as starting,
        control(tmp_path / "2", free_udp_port(), 1.0) as waiting,
    ):
        until(starting.children)
        os.kill(starting.process.pid, signal.SIGINT)
        until((tmp_path / "2" / "out" / "link.tlog").exists)
        os.kill(waiting.process.pid, signal.SIGINT)
        for command in (starting, waiting):
            code, _, err = command.ends()
            assert code == ExitCode.INTERRUPTED
            assert "interrupted by the operator" in err
            assert "Traceback" not in err


def test_port_in_use_and_nobody_at_a_port(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        used, free = holder.getsockname()[1], free_udp_port()
        with (
            fly(tmp_path / "1", used, 0.5) as held,
            fly(tmp_path / "2", free, 0.5, "--timeout", "0.2", "--json") as alone,
        ):
            code, _, err = held.ends()
            assert code == ExitCode.LOST
            last = err.splitlines()[-1]
            assert f"port {used} on 127.0.0.1 is in use (process {os.getpid()} " in last
            assert "stop that program" in last
            code, out, err = alone.ends()
            assert code == ExitCode.LOST
            assert f"no vehicle was found: nothing came at udpin:127.0.0.1:{free} within 0.2 s" in err
            assert "sim-link run" in err
            assert json.loads(out)["exit_code"] == ExitCode.LOST
