"""docs/hil.md says what `sim-link hil` does: its commands exist, its numbers are those of the code."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sim_link.cli import app
from sim_link.fault_effects import BODY_KINDS
from sim_link.hil import PATIENCE_S
from sim_link.hil_sensors import BAROMETER_US, GPS_DELAY_US, GPS_US, MAGNETOMETER_US, SAMPLE_US, Noise
from sim_link.vehicle_file import load

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "hil.md").read_text(encoding="utf-8")
FLAT = " ".join(TEXT.split())


def options_of(command: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-m", "sim_link", command, "--help"], capture_output=True, text=True, timeout=60, check=True
    )
    return set(re.findall(r"--[a-z][a-z0-9-]*", done.stdout))


def test_every_option_that_it_names_exists() -> None:
    known = options_of("hil")
    shell = [line for block in re.findall(r"^```sh\n(.*?)^```", TEXT, re.M | re.S) for line in block.splitlines()]
    ours = [shlex.split(line) for line in shell if line.startswith("sim-link")]
    assert len(ours) >= 2 and all(words[1] == "hil" for words in ours)
    named = {word for words in ours for word in words if word.startswith("--")}
    named |= set(re.findall(r"`(--[a-z-]+)", TEXT))
    assert named <= known, named - known


def test_the_options_that_it_shares_with_run_are_those_of_run() -> None:
    shared = FLAT.split("those of `sim-link run` where both have them:")[1].split(". `sim-link hil --help`")[0]
    names = set(re.findall(r"`(--[a-z-]+)`", shared))
    assert len(names) == 9 and names <= options_of("hil") & options_of("run")


def test_its_numbers_are_those_of_the_code() -> None:
    noise = Noise()
    assert f"Every {SAMPLE_US / 1000:g} ms of PX4's time ({1e6 / SAMPLE_US:g} Hz)" in FLAT
    assert f"| HIL_SENSOR | {1e6 / SAMPLE_US:g} Hz" in TEXT and MAGNETOMETER_US == BAROMETER_US == 20_000
    assert f"| HIL_GPS | {1e6 / GPS_US:g} Hz | {GPS_DELAY_US / 1000:g} ms old" in TEXT
    assert PATIENCE_S == 1.0 and "after one second without them" in FLAT
    for sentence in (
        f"accelerometer {noise.acceleration_m_s2:g} m/s^2 and a constant bias of {noise.acceleration_bias_m_s2:g}",
        f"gyro {noise.rate_rad_s:g} rad/s and a bias of {noise.rate_bias_rad_s:g}",
        f"magnetometer {noise.field_g:g} G; pressure {noise.pressure_hpa:g} hPa",
        f"GPS position {noise.gps_horizontal_m:.2f} m across and {noise.gps_vertical_m:.2f} m up",
        f"slow error of {noise.wander_horizontal_m:.2f} m and {noise.wander_vertical_m:.2f} m with a time constant of "
        f"{noise.wander_time_constant_s:g} s",
        f"velocity {noise.gps_speed_m_s:g} m/s",
    ):
        assert sentence in FLAT, sentence


def test_the_faults_that_it_names_are_those_that_are_taken() -> None:
    sentence = FLAT.split("takes the faults of body and air")[1].split("Their times")[0]
    assert tuple(re.findall(r"`(\w+)`", sentence)) == BODY_KINDS


def test_the_airframe_hovers_where_px4_expects_it() -> None:
    iris = load("px4_iris")
    assert iris.mass_kg * 9.81 / (4.0 * iris.rotor_thrust_max_n) == pytest.approx(0.5, abs=0.01)
    assert iris.curve_factor == 0.0


def test_the_command_is_there() -> None:
    assert "hil" in {command.name for command in app.registered_commands}
