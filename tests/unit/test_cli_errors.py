"""Bad input on the command line: the exit code, one line that names what is wrong, and nothing begun."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.cli import main
from companion.config import bundled_root
from companion.errors import ExitCode

VEHICLE = (bundled_root() / "vehicles" / "bundled.toml").read_text(encoding="utf-8")
FLIGHT = (bundled_root() / "flights" / "eight.toml").read_text(encoding="utf-8")

Refusal = Callable[..., str]


@pytest.fixture
def refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refusal:
    """Runs a command in an empty folder; returns the one line on stderr after checking all that every refusal has."""
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def run(*arguments: str, code: ExitCode = ExitCode.BAD_INPUT) -> str:
        assert main(list(arguments)) == code
        printed = capsys.readouterr()
        assert printed.out.strip() == ""
        lines = [line for line in printed.err.splitlines() if line.strip()]
        assert len(lines) == 1, printed.err
        assert lines[0].startswith("companion")
        assert "Traceback" not in lines[0]
        assert list(folder.iterdir()) == []
        return lines[0]

    return run


def changed(path: Path, text: str, *changes: tuple[str, str]) -> str:
    """Writes a text with some of its parts replaced; returns the path."""
    for old, new in changes:
        assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in the text"
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return str(path)


def flight_with(folder: Path, *changes: tuple[str, str]) -> str:
    """A flight file whose vehicle is the bundled one with changes."""
    vehicle = changed(folder / "vehicle.toml", VEHICLE, *changes)
    return changed(folder / "flight.toml", FLIGHT, ('vehicle = "bundled"', f'vehicle = "{vehicle}"'))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fligh"], "No such command 'fligh'; try 'companion --help'"),
        (["--verbose"], "No such option: --verbose"),
        (["simulate", "--speed", "2"], "companion simulate: No such option: --speed"),
        (["certify"], "companion certify: Missing argument"),
        (["fly"], "companion fly: Missing argument"),
        (["report"], "companion report: Missing argument"),
        (["demo", "--seed", "one"], "Invalid value for '--seed'"),
        (["demo", "--time-scale", "fast"], "Invalid value for '--time-scale'"),
        (["demo", "paper"], "unexpected extra argument"),
    ],
)
def test_what_the_command_line_does_not_know(refusal: Refusal, arguments: list[str], words: str) -> None:
    line = refusal(*arguments)
    assert words in line
    assert line.endswith("--help'")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "papr"], "neither a path nor one of the bundled ones (eight, paper, waypoints, windtest)"),
        (["demo", "--flight", "papr"], "no flight file 'papr'"),
        (["check", "/", "--vehicle", "bundled"], "/: is a folder; a trajectory file is wanted"),
        (["certify", "papr"], "file 'papr': neither a path nor one of the bundled ones"),
        (["fly", "papr", "--vehicle", "bundled"], "no trajectory file 'papr'"),
        (["fly", "circle", "--vehicle", "papr"], "no vehicle file 'papr': neither a path nor one of the bundled ones"),
        (["fly", "circle"], "--vehicle NAME"),
        (["simulate", "eight", "--vehicle", "papr"], "no vehicle file 'papr'"),
        (["report", "papr"], "papr: there is no flight record"),
        (["simulate", "eight", "--engine", "gpu"], "engine 'gpu': must be one of auto, python, numba"),
        (["simulate", "eight", "--time-scale", "0"], "time_scale = 0.0"),
        (["simulate", "eight", "--time-scale", "nan"], "time_scale = nan"),
        (
            ["demo", "--output", "torque"],
            "output.kind = 'torque': input should be 'auto', 'rates', 'attitude' or 'actuators'",
        ),
        (["demo", "--state-age", "-0.1"], "state_age_s = -0.1"),
        (["demo", "--wind", "-12,0"], "--wind '-12,0': expected three numbers north,east,down in m/s"),
        (["demo", "--wind", "nan,0,0"], "world.wind_m_s.0 = nan"),
        (["demo", "--turbulence", "-0.1"], "world.turbulence = -0.1"),
        (["demo", "--controller", "pid"], "output.controller = 'pid': input should be 'law', 'px4' or 'calibration'"),
        (["demo", "--controller", "px4", "--output", "rates"], "the reference itself is sent: leave one out"),
        (["fly", "circle", "--vehicle", "bundled", "--controller", "px4", "--output", "rates"], "leave one out"),
        (["certify", "eight", "--start", "1,2"], "--start '1,2': expected three numbers"),
    ],
)
def test_names_and_values_that_cannot_be_used(refusal: Refusal, arguments: list[str], words: str) -> None:
    assert words in refusal(*arguments)


@pytest.mark.parametrize("command", [["simulate"], ["certify"], ["demo", "--flight"]])
def test_a_syntax_error_is_named_with_its_line(refusal: Refusal, tmp_path: Path, command: list[str]) -> None:
    path = changed(tmp_path / "bad.toml", FLIGHT, ("duration_s = 120.0", "duration_s = = 120.0"))
    number = FLIGHT[: FLIGHT.index("duration_s")].count("\n") + 1
    line = refusal(*command, path)
    assert f"{path}: not valid TOML" in line
    assert f"line {number}" in line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[acceptance]", "[acceptence]", "acceptence"),
        ("position_rms_m = 0.03", "position_rms_cm = 3.0", "acceptance.position_rms_cm = 3.0 is not a known key"),
        ("position_m = [1.5, -1.0, -9.0]", "position_m = [1.5, -1.0]", "start.position_m"),
        ("seed = 1", "seed = 1\nforce_n = 4.76", "world.force_n = 4.76"),
        ("seed = 1", "seed = 1.5", "world.seed = 1.5"),
        ('vehicle = "bundled"', "", "vehicle is missing"),
        ('shape = "lemniscate"', 'shape = "figure"', "shape = 'figure'"),
        ("amplitude_m = [5.0, 2.5]", "amplitude_ft = [5.0, 2.5]", "amplitude_ft"),
    ],
)
def test_a_flight_file_is_validated_as_a_whole(
    refusal: Refusal, tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = changed(tmp_path / "some.toml", FLIGHT, (old, new))
    for command in (["simulate"], ["demo", "--flight"]):
        assert words in refusal(*command, path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass_kg = 1.0", "mass_kg = 0.0", "body.mass_kg = 0.0: input should be greater than 0"),
        ("mass_kg = 1.0", "mass_kg = -1.0", "body.mass_kg = -1.0"),
        ("mass_kg = 1.0", 'mass_kg = "1.0"', "body.mass_kg = '1.0'"),
        ("mass_kg = 1.0", "mass_g = 1000.0", "body.mass_kg is missing; body.mass_g = 1000.0 is not a known key"),
        ("drag_1_s = 1.0", "drag_1_s = nan", "body.drag_1_s = nan"),
        ("k2 = 3.0", "k2 = 0.0", "controller.k2 = 0.0"),
        ('heading = "sideslip"', 'heading = "north"', "controller.heading = 'north'"),
        ("thrust_max_n = 17.0", "thrust_max_n = 9.0", "must enclose the weight 9.81 N"),
        ("thrust_max_n = 17.0", "thrust_max_n = 27.0", "more than four rotors give"),
        ("tilt_max_rad = 1.0", "tilt_max_rad = 57.0", "limits.tilt_max_rad = 57.0"),
    ],
)
def test_a_vehicle_file_is_validated_as_a_whole(
    refusal: Refusal, tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = flight_with(tmp_path, (old, new))
    for command in (["simulate", path], ["fly", "circle", "--vehicle", str(tmp_path / "vehicle.toml")]):
        line = refusal(*command)
        assert words in line
        assert str(tmp_path / "vehicle.toml") in line


UNSTABLE = ("gamma_1_s3 = 4.0", "gamma_1_s3 = 90.0")
SLUGGISH = (
    ("state_age_s = 0.020", "state_age_s = 0.060"),
    ('heading = "sideslip"', 'heading = "sideslip"\nprediction = false'),
)


@pytest.mark.parametrize("command", [["simulate"], ["demo", "--flight"]])
def test_gains_that_fail_are_refused_with_the_figure(refusal: Refusal, tmp_path: Path, command: list[str]) -> None:
    line = refusal(*command, flight_with(tmp_path, UNSTABLE), code=ExitCode.REFUSED)
    assert "not certified: the smallest eigenvalue of Q (inside p_max, estimator on) is -" in line
    assert "companion certify" in line


def test_a_delay_margin_that_is_too_small_is_refused_with_the_figure(refusal: Refusal, tmp_path: Path) -> None:
    path = flight_with(tmp_path, *SLUGGISH)
    line = refusal("simulate", path, code=ExitCode.REFUSED)
    assert "delay margin of" in line
    assert "10 ms are required" in line
    line = refusal("fly", "circle", "--vehicle", str(tmp_path / "vehicle.toml"), code=ExitCode.REFUSED)
    assert "delay margin of" in line


def test_a_reference_beyond_the_limits_is_refused(refusal: Refusal) -> None:
    for command in (["simulate", "eight"], ["demo", "--flight", "eight"]):
        line = refusal(*command, "--time-scale", "6", code=ExitCode.REFUSED)
        assert "trajectory 'eight'" in line
        assert "m/s" in line


def test_a_start_from_which_the_limits_would_be_left_is_refused(refusal: Refusal, tmp_path: Path) -> None:
    far = ("position_m = [1.5, -1.0, -9.0]", "position_m = [90.0, -1.0, -9.0]")
    law = ('join = "smooth"', 'join = "law"')
    narrow = ("tilt_max_rad = 1.0", "tilt_max_rad = 0.5")
    path = flight_with(tmp_path, narrow)
    path = changed(Path(path), Path(path).read_text(encoding="utf-8"), far, law)
    line = refusal("demo", "--flight", path, code=ExitCode.REFUSED)
    assert "predicted to leave its limits: tilt" in line
    assert "limits.tilt_max_rad" in line


@pytest.mark.parametrize(
    ("connection", "words"),
    [
        ("14540", "expected something like udpin:127.0.0.1:14540"),
        ("tcp:127.0.0.1:5760", "expected something like"),
        ("udpin:127.0.0.1:70000", "port 70000 is not within 1..65535"),
        ("udpin:127.0.0.1:mavlink", "udpin:127.0.0.1:mavlink"),
    ],
)
def test_a_connection_that_is_none(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    connection: str,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fly", "circle", "--vehicle", "bundled", "--engine", "python", "--connect", connection]) == 2
    error = capfd.readouterr().err.splitlines()[-1]
    assert words in error
    assert connection in error


CERTIFY = [sys.executable, "-m", "companion", "certify", "paper"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk that is always full")
def test_a_full_disk_behind_the_output_is_said_in_one_line() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(CERTIFY, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert done.stderr == (
        "companion: what this command says or writes: No space left on device; make room, or write elsewhere\n"
    )


def test_a_reader_that_has_gone_is_no_miss_and_no_fault() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as gone:
        done = subprocess.run(CERTIFY, stdout=gone, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")
