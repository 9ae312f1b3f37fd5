"""`companion calibrate` over real sockets, in lockstep: what it does with a vehicle, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from flight_cases import HOLD, Stand, read_toml, set_mode_from_elsewhere

from companion.cli import main
from companion.cli.calibrate import configured
from companion.config import find, load_vehicle
from companion.errors import ExitCode
from companion.flight.bundled import free_udp_port
from companion.flight.phases import Cause
from companion.identification.vehicle_file import Entered
from sim_link.modes import Mode

PLAN = {"repeats": 1, "hold_s": 2.0, "run_length_m": 3.0, "run_speed_m_s": 2.0}


def calibration(tmp_path: Path, **changes: Any):
    vehicle = read_toml(find("bundled", "vehicles"))
    vehicle["link"]["state_rate_hz"] = 100.0
    for key, value in changes.items():
        section, name = key.split("__")
        vehicle[section][name] = value
    path = tmp_path / "template.toml"
    path.write_text(tomlkit.dumps(vehicle))
    return configured(str(path), Entered("x", 1.0, 0.1, False), PLAN, height_m=8.0, radius_m=6.0, start=True)


AT = ((0.0, 0.0, -12.0), 0.3)


def fly(tmp_path: Path, prepare=lambda stand: None, start: Any = AT, **options: Any):
    with Stand(calibration(tmp_path), tmp_path, start=start, **options) as stand:
        prepare(stand)
        flown = stand.fly(timeout_s=20.0)
    return stand, flown


def test_it_is_refused_near_the_ground(tmp_path) -> None:
    stand, flown = fly(tmp_path, start=((0.0, 0.0, -4.0), 0.0))
    assert flown.cause is Cause.REFUSED
    assert "falls to 4.00 m above home" in flown.outcome.sentence
    assert stand.setpoints() == [] and stand.mode is Mode.HOLD


def test_it_is_refused_where_the_height_is_not_known(tmp_path) -> None:
    def homeless(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        return [] if msg_id == 242 else [raw]

    stand, flown = fly(tmp_path, alter=homeless)
    assert flown.cause is Cause.REFUSED
    assert "home position is not known" in flown.outcome.sentence
    assert stand.setpoints() == []


def test_the_pilot_takes_over_in_the_middle(tmp_path) -> None:
    def pilot(stand: Stand) -> None:
        stand.after_offboard(5.0, lambda: set_mode_from_elsewhere(stand, Mode.LAND))

    stand, flown = fly(tmp_path, pilot)
    assert flown.cause is Cause.TAKEN_OVER
    assert stand.mode is Mode.LAND
    assert stand.setpoints(5.15) == [] and len(stand.mode_requests(0.5)) == 1  # the pilot's own


def test_leaving_the_free_space_ends_in_hold(tmp_path) -> None:
    """A gale: more than the hover can hold against."""

    def gale(stand: Stand) -> None:
        stand.after_offboard(2.0, lambda: stand.vehicle.faults.inject("wind", wind_m_s=[9.0, 0.0, 0.0]))

    stand, flown = fly(tmp_path, gale)
    assert flown.cause is Cause.POSITION_ERROR
    assert "limit 6 (limits.position_error_abort_m)" in flown.outcome.sentence or "limit 6 m" in flown.outcome.sentence
    assert stand.mode is Mode.HOLD and stand.mode_requests(2.0)[0][1] == HOLD


def test_an_interruption_ends_in_hold(tmp_path) -> None:
    with Stand(calibration(tmp_path), tmp_path, start=AT) as stand, stand.loop(timeout_s=20.0) as (loop, _, _):
        stand.after_offboard(4.5, loop.interrupt)
        outcome = loop.run()
    assert outcome.cause is Cause.INTERRUPTED
    assert stand.mode is Mode.HOLD


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], ExitCode.BAD_INPUT, "--mass"),
        (["--mass", "0"], ExitCode.BAD_INPUT, "--mass 0: must be a number of kilograms above 0"),
        (["--mass", "1", "--sim", "--connect", "udpin:127.0.0.1:1"], ExitCode.BAD_INPUT, "leave all but one out"),
        (["--mass", "1", "--height", "5"], ExitCode.BAD_INPUT, "--height 5: --radius and 2 m are needed, 8 m"),
        (["--mass", "1", "--thrust-step", "0.9"], ExitCode.BAD_INPUT, "thrust_step = 0.9"),
        (["--mass", "1", "--vehicle", "nobody"], ExitCode.BAD_INPUT, "no vehicle file 'nobody'"),
        (["--mass", "1", "--from-flight", "nowhere"], ExitCode.BAD_INPUT, "nowhere"),
        (
            ["--mass", "1", "--from-flight", "x", "--rate-step", "1", "--out", "y"],
            ExitCode.BAD_INPUT,
            "--out, --rate-step:",
        ),
        (["--mass", "1", "--sim", "--save", "nowhere/x.toml"], ExitCode.BAD_INPUT, "there is no folder nowhere"),
    ],
)
def test_bad_input(arguments: list[str], code: ExitCode, says: str, capsys) -> None:
    assert main(["calibrate", *arguments]) == code
    assert says in capsys.readouterr().err


def test_fly_refuses_a_vehicle_that_was_never_calibrated(tmp_path, capfd) -> None:
    vehicle = read_toml(find("bundled", "vehicles")) | {"simulated": False}
    path = tmp_path / "mine.toml"
    path.write_text(tomlkit.dumps(vehicle))
    connection = f"udpin:127.0.0.1:{free_udp_port()}"
    command = ["fly", "circle", "--vehicle", str(path), "--timeout", "0.2", "--connect", connection]
    assert main([*command, "--out", str(tmp_path / "a")]) == ExitCode.REFUSED
    assert "vehicle 'bundled' was never calibrated: its file has no [calibration]" in capfd.readouterr().err
    assert not (tmp_path / "a").exists()
    assert main([*command, "--simulator", "--out", str(tmp_path / "b")]) == ExitCode.LOST
    vehicle["calibration"] = {"date": "2026-11-01"}
    path.write_text(tomlkit.dumps(vehicle))
    assert main([*command, "--out", str(tmp_path / "c")]) == ExitCode.LOST


@pytest.mark.long
def test_a_calibration_over_sockets_gives_a_file_that_flies(tmp_path, capfd) -> None:
    """The whole way: fly, fit, write, and fly the figure of eight with nothing but the file."""
    out, file = tmp_path / "calibration", tmp_path / "found.toml"
    arguments = ["--mass", "1.1", "--repeats", "2", "--out", str(out), "--save", str(file), "--json"]
    assert main(["calibrate", "--sim", *arguments]) == ExitCode.DONE
    document = json.loads(capfd.readouterr().out)
    assert document["warnings"] == []
    assert document["thrust"]["hover_share"] == pytest.approx(0.4905, rel=0.01)
    assert document["calibration"]["hover_thrust_hold"] == pytest.approx(0.4905, rel=0.02)
    assert load_vehicle(str(file)).calibration is not None
    summary = {}
    for name, vehicle in (("truth", "bundled"), ("found", str(file))):
        command = ["simulate", "eight", "--vehicle", vehicle, "--json"]
        assert main(command) == ExitCode.DONE
        summary[name] = json.loads(capfd.readouterr().out)
    assert summary["found"]["position_rms_m"] < 1.2 * summary["truth"]["position_rms_m"]
