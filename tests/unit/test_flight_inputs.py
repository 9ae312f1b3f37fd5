"""Bad input on the command line: one clear line and the right exit code, before anything connects or starts."""

from __future__ import annotations

import subprocess
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from companion.cli import main
from companion.config import build_flight, find, read_toml
from companion.control.types import Reference
from companion.errors import ExitCode, RefusedError
from companion.flight.preflight import gate_gains, gate_reference
from companion.trajectory.load import of_flight

BAD, REFUSED = ExitCode.BAD_INPUT, ExitCode.REFUSED
GONE = object()
"""Stands for a key that is taken out."""

VEHICLE_CASES: dict[str, tuple[dict[str, Any], ExitCode, list[str]]] = {
    "unknown key": ({"body.colour": "red"}, BAD, ["vehicle.toml", "body.colour = 'red' is not a known key"]),
    "missing key": ({"body.mass_kg": GONE}, BAD, ["vehicle.toml", "body.mass_kg is missing"]),
    "wrong unit": (
        {"body.mass_kg": GONE, "body.mass_g": 4760.0},
        BAD,
        ["body.mass_kg is missing", "body.mass_g = 4760.0 is not a known key"],
    ),
    "wrong type": ({"body.mass_kg": "4.76"}, BAD, ["body.mass_kg = '4.76'", "number"]),
    "no mass": ({"body.mass_kg": 0.0}, BAD, ["body.mass_kg = 0.0", "greater than 0"]),
    "negative lag": ({"rotors.lag_s": -0.01}, BAD, ["rotors.lag_s = -0.01", "greater than or equal to 0"]),
    "not a number": ({"limits.tilt_max_rad": float("nan")}, BAD, ["limits.tilt_max_rad = nan"]),
    "three rotors": ({"rotors.x_m": [0.1, -0.1, 0.1]}, BAD, ["rotors.x_m"]),
    "grams for kilograms": ({"body.mass_kg": 4760.0}, BAD, ["must enclose the weight 46695.60 N", "4760.0"]),
    "no such heading": ({"controller.heading": "north"}, BAD, ["controller.heading = 'north'", "'damping'"]),
    "gains without a certificate": ({"controller.gamma_1_s3": 4.0}, REFUSED, ["not certified", "eigenvalue"]),
    "gains that fail": ({"controller.k2": 0.5}, REFUSED, ["not certified", "companion certify"]),
    "no delay margin": (
        {"controller.prediction": False, "link.state_age_s": 0.2},
        REFUSED,
        ["delay margin of", "10 ms are required"],
    ),
}


def write(folder: Path, name: str, data: dict[str, Any]) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(tomlkit.dumps(data))
    return path


def changed(kind: str, changes: dict[str, Any]) -> dict[str, Any]:
    data = deepcopy(read_toml(find("paper", kind)))
    for key, value in changes.items():
        *path, last = key.split(".")
        table = data
        for name in path:
            table = table.setdefault(name, {})
        if value is GONE:
            del table[last]
        else:
            table[last] = value
    return data


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No process is started and no folder is left behind by what is refused."""

    def started(*args: object, **options: object) -> None:
        raise AssertionError(f"started {args}")

    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.chdir(tmp_path)


def says(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code, and the one line."""
    code = main(arguments)
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1, err
    assert not Path("flights").exists()
    return code, lines[0]


@pytest.mark.parametrize("what", VEHICLE_CASES)
@pytest.mark.parametrize("command", ["fly", "demo"])
def test_vehicle_files(what: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes, wanted, phrases = VEHICLE_CASES[what]
    path = write(tmp_path, "vehicle", changed("vehicles", changes))
    arguments = {"fly": ["fly", "hover", "--vehicle", str(path)], "demo": ["demo", "--vehicle", str(path)]}
    code, line = says(arguments[command], capsys)
    assert code == wanted
    assert line.startswith("companion: ")
    if command == "fly" or wanted is REFUSED:
        assert all(phrase in line for phrase in phrases), line


TRAJECTORY_CASES: dict[str, tuple[dict[str, Any], ExitCode, str]] = {
    "unknown key": ({"lemniscate.size_m": 1.0}, BAD, "size_m"),
    "no duration": ({"duration_s": GONE}, BAD, "duration_s or laps is missing"),
    "two ends": ({"laps": 2}, BAD, "exclude each other"),
    "unknown shape": ({"shape": "square"}, BAD, "'square'"),
    "too fast": ({"lemniscate.angular_rate_rad_s": 3.0}, REFUSED, "limit"),
    "a whole number for text": ({"anchor": 1}, BAD, "anchor"),
}


@pytest.mark.parametrize("what", TRAJECTORY_CASES)
def test_trajectory_files(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes, wanted, phrase = TRAJECTORY_CASES[what]
    path = write(tmp_path, "eight", changed("trajectories", changes))
    code, line = says(["fly", str(path), "--vehicle", "paper"], capsys)
    assert (code, phrase in line) == (wanted, True), line


FLIGHT_CASES: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"start.altitude_m": 20.0}, "start.altitude_m = 20.0 is not a known key"),
    "unknown threshold": ({"acceptance.position_m": 0.1}, "acceptance.position_m = 0.1 is not a known key"),
    "negative seed": ({"world.seed": -1}, "world.seed = -1"),
    "no start": ({"start": GONE}, "has no [start]"),
    "no vehicle": ({"vehicle": GONE}, "vehicle is missing"),
    "no such vehicle": ({"vehicle": "iris"}, "no vehicle file 'iris'"),
    "unknown output": ({"output.kind": "torque"}, "output.kind = 'torque'"),
    "override of what is not there": ({"controller.k9": 1.0}, "controller.k9 = 1.0 is not a known key"),
}


@pytest.mark.parametrize("what", FLIGHT_CASES)
def test_flight_files(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes, phrase = FLIGHT_CASES[what]
    path = write(tmp_path, "flight", changed("flights", changes))
    code, line = says(["demo", "--flight", str(path)], capsys)
    assert (code, phrase in line) == (BAD, True), line


OPTIONS = {
    "connection": (["--connect", "tcp:1.2.3.4"], 'connection "tcp:1.2.3.4"'),
    "port": (["--connect", "udpin:127.0.0.1:70000"], "port 70000 is not within"),
    "timeout": (["--timeout", "-1"], "--timeout -1: must be a number of seconds above 0"),
    "engine": (["--engine", "fortran"], "engine 'fortran'"),
    "time scale": (["--time-scale", "0"], "time_scale = 0.0"),
}


@pytest.mark.parametrize("what", OPTIONS)
def test_options(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    options, phrase = OPTIONS[what]
    code, line = says(["fly", "hover", "--vehicle", "paper", *options], capsys)
    assert (code, phrase in line) == (BAD, True), line


def test_options_of_the_demo(capsys: pytest.CaptureFixture[str]) -> None:
    code, line = says(["demo", "--px4", "1.15"], capsys)
    assert (code, line) == (BAD, "companion: --px4 '1.15': allowed are 1.13, 1.18")
    code, line = says(["fly", "hover"], capsys)
    assert code == BAD
    assert "--vehicle" in line


class Jumps:
    """A shape whose velocity, acceleration or jerk jumps at one second."""

    def __init__(self, shape: Any, field: str) -> None:
        self._shape = shape
        self._field = field

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shape, name)

    def at(self, t_s: float) -> Reference:
        r: Reference = self._shape.at(t_s)
        if t_s <= 1.0:
            return r
        x, y, z = getattr(r, self._field)
        return r._replace(**{self._field: (x + 0.5, y, z)})


@pytest.mark.parametrize(
    ("field", "name"), [("p", "position"), ("v", "velocity"), ("a", "acceleration"), ("j", "jerk")]
)
def test_reference_that_jumps_is_refused(field: str, name: str) -> None:
    flight = build_flight({"name": "test", "vehicle": "paper", "trajectory": "indoor"}, "test")
    trajectory = of_flight(flight)
    gate_reference(trajectory, flight.vehicle)
    with pytest.raises(RefusedError, match=rf"trajectory 'indoor': .*{name}.*jumps by 0\.5.* at 1\.000 s"):
        gate_reference(replace(trajectory, shape=Jumps(trajectory.shape, field)), flight.vehicle)  # type: ignore[arg-type]


def test_bundled_gains_pass() -> None:
    flight = build_flight({"name": "test", "vehicle": "paper", "trajectory": "hover"}, "test")
    assert gate_gains(flight.vehicle).delay_margin_s > 0.01
