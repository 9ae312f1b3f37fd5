"""docs/testing.md: its program and its tests run as they stand there; its tables are true."""

from __future__ import annotations

import inspect
import os
import re
import socket
import subprocess
import sys
import threading
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from vehicle_tools import Companion

from sim_link import running
from sim_link.airframe import Truth
from sim_link.running import RunningVehicle

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "testing.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
OFFBOARD, TESTS, TIMESYNC, ALONE = BLOCKS


def plugin() -> list[str]:
    """The option that loads the plugin where this package was installed before it had one."""
    installed = any(point.value == "sim_link.pytest_plugin" for point in entry_points(group="pytest11"))
    return [] if installed else ["-p", "sim_link.pytest_plugin"]


def run_pytest(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "--rootdir", str(folder), "-c", os.devnull, *plugin(), *words]
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=110, check=False
    )


def test_the_example_runs_as_it_stands_there(tmp_path: Path) -> None:
    assert "import sim_link" not in OFFBOARD + TESTS and "from sim_link" not in OFFBOARD + TESTS
    lines = [line for line in OFFBOARD.splitlines() if line.strip()]
    assert len(lines) <= 22
    (tmp_path / "offboard.py").write_text(OFFBOARD, encoding="utf-8")
    (tmp_path / "test_offboard.py").write_text(TESTS, encoding="utf-8")
    done = run_pytest(tmp_path, "--strict-markers", "test_offboard.py")
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{TESTS.count('def test_')} passed" in done.stdout


def test_the_rest_of_the_code_runs() -> None:
    compile(TIMESYNC, "docs/testing.md", "exec")
    exec(compile(ALONE, "docs/testing.md", "exec"), {})


def test_the_tables_tell_every_option_and_attribute() -> None:
    options, attributes = (
        [name for cell in re.findall(r"^\| (`.*?`) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)", cell)]
        for table in re.findall(r"^\| (?:option|attribute) .*?(?=\n\n)", TEXT, re.MULTILINE | re.DOTALL)
    )
    assert sorted(options) == sorted(inspect.signature(RunningVehicle).parameters)
    public = {name for name in dir(RunningVehicle) if not name.startswith("_")}
    shown = {"remote_port", "ground_remote_port", "track"}
    assert set(attributes) == (public | shown) - {"describe"}


def test_a_failing_test_shows_the_vehicle_and_what_went_wrong(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import pytest\n"
        "pytestmark = pytest.mark.vehicle(start=(1, 2, -10), speed=50)\n"
        "@pytest.mark.vehicle(instance=4)\n"
        "def test_it(vehicle):\n"
        "    vehicle.faults.inject('wind', wind_m_s=(3.0, 0.0, 0.0))\n"
        "    vehicle.wait_until(lambda: vehicle.faults.active)\n"
        "    assert vehicle.landed\n"
        "@pytest.mark.vehicle((1, 2, -10))\n"
        "def test_wrong(vehicle):\n"
        "    pass\n",
        encoding="utf-8",
    )
    done = run_pytest(tmp_path, "test_it.py")
    assert done.returncode == 1
    assert re.search(r"vehicle 5: [\d.]+ s, Hold, armed, at [-\d.]+ m north", done.stdout), done.stdout
    assert "fault 0 begins: wind" in done.stdout
    assert "takes options by name only" in done.stdout


def test_a_vehicle_ends_and_gives_its_ports_back() -> None:
    with RunningVehicle(speed=100.0) as vehicle:
        vehicle.wait_until(lambda: vehicle.t_s > 0.5)
        assert len(vehicle.track) > 10
        assert vehicle.landed
        assert not vehicle.armed
        assert vehicle.connection == f"udpin:127.0.0.1:{vehicle.remote_port}"
        port = vehicle.port
    vehicle.stop()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("simulated vehicle")]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))


def test_a_vehicle_whose_program_breaks_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(self) -> None:
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(running.Peer, "step", breaks)
    vehicle = RunningVehicle(speed=100.0)
    with pytest.raises(running.VehicleBrokeError, match="broken"):
        vehicle.wait_until(lambda: False, 5.0)
    with pytest.raises(running.VehicleBrokeError, match="broken"):
        vehicle.stop()


def lockstep_track(seed: int) -> list[Truth]:
    with RunningVehicle(
        start=(0, 0, -10), lockstep=True, seed=seed, wind_m_s=(5.0, 0.0, 0.0), turbulence=0.3
    ) as vehicle:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind(("127.0.0.1", vehicle.remote_port))
        sock.settimeout(5.0)
        with sock:
            companion = Companion(sock, vehicle.port)
            companion.step()
            companion.run(0.4)
            return vehicle.track[:100]


def test_in_lockstep_the_same_seed_gives_the_same_flight() -> None:
    first = lockstep_track(3)
    assert len(first) == 100
    assert first == lockstep_track(3)
    assert first != lockstep_track(4)


def test_waiting_ends_with_how_the_vehicle_is() -> None:
    with (
        RunningVehicle(start=(0.0, 0.0, -5.0, 90.0)) as vehicle,
        pytest.raises(TimeoutError, match=r"Hold, armed, at -?0\.0"),
    ):
        vehicle.wait_until(lambda: vehicle.landed, 0.05)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"start": (0, 0, 10)}, "start = "),
        ({"start": (0, 0)}, "start = "),
        ({"speed": 0.0}, "speed = 0.0"),
        ({"state_rate_hz": -1.0}, "state_rate_hz = -1.0"),
        ({"state_age_s": 2.0}, "state_age_s = 2.0"),
        ({"vehicle": "no_such"}, "no_such"),
        ({"faults": "no_such"}, "no_such"),
        ({"parameters": {"NO_SUCH": 1}}, "NO_SUCH"),
        ({"px4": "1.0"}, "1.0"),
        ({"engine": "fast"}, "fast"),
        ({"wind_m_s": (1.0, 2.0)}, "wind (1.0, 2.0): must be three numbers"),
        ({"force_n": (1e300, 0.0, 0.0)}, "force [N] 1e+300"),
        ({"start": (0.0, 0.0, -1e300)}, "start [m] -1e+300"),
        ({"parameters": {"MAV_SYS_ID": 9}}, "MAV_SYS_ID = 9"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        RunningVehicle(**options)
