"""What the commands print when all is well: help with an example, the version, JSON alone on stdout, exit codes."""

from __future__ import annotations

import csv
import itertools
import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from companion import __version__
from companion.cli import COMMANDS, main
from companion.config import bundled_root

SHORT = """
name = "short"
vehicle = "bundled"
statistics_from_s = 0.0

[trajectory]
shape = "hover"
duration_s = 1.0

[trajectory.hover]
point_m = [0.0, 0.0, 0.0]

[start]
position_m = [1.0, 2.0, -5.0]

[acceptance]
position_max_m = {bound}
"""


@pytest.fixture
def short(tmp_path: Path) -> str:
    """A flight of one second that keeps its bound."""
    path = tmp_path / "short.toml"
    path.write_text(SHORT.format(bound=0.1), encoding="utf-8")
    return str(path)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"companion {__version__}\n"


def test_the_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    overview = capsys.readouterr().out
    for name, line in COMMANDS.items():
        assert f"  {name}" in overview
        assert line.split()[0] in overview
    assert main([]) == 0
    assert capsys.readouterr().out == overview


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_has_an_example_that_parses(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert "Usage: companion " + name in text
    example = " ".join(text.rpartition("Example: ")[2].split())
    program, command, *options = shlex.split(example)
    assert (program, command) == ("companion", name)
    # asked for help at its end, the example is parsed and not run
    assert main([command, *options, "--help"]) == 0
    for option in (o for o in options if o.startswith("--")):
        assert option in text


def document(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The one JSON document on stdout; json.loads refuses anything after it."""
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_simulate_prints_one_json_document(short: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", short, "--engine", "python", "--json"]) == 0
    summary = document(capsys)
    assert summary["verdict"] == "passed"
    assert summary["vehicle"] == "bundled"
    assert summary["position_max_m"] < 0.1
    assert main(["simulate", short, "--ideal", "--json"]) == 0
    assert document(capsys)["position_max_m"] < 1e-6


def test_simulate_ends_with_1_when_thresholds_are_missed(short: str, tmp_path: Path, capsys) -> None:
    strict = tmp_path / "strict.toml"
    strict.write_text(SHORT.format(bound=1e-5), encoding="utf-8")
    assert main(["simulate", str(strict), "--engine", "python", "--json"]) == 1
    assert document(capsys)["verdict"].startswith("missed")
    assert main(["simulate", str(strict), "--engine", "python"]) == 1
    assert "verdict: missed" in capsys.readouterr().out


def test_simulate_refuses_states_that_fall_between_the_steps(short: str, tmp_path: Path, capsys) -> None:
    """Rounded, 300 Hz would be flown as 250."""
    odd = tmp_path / "odd.toml"
    text = (bundled_root() / "vehicles" / "bundled.toml").read_text(encoding="utf-8")
    odd.write_text(text.replace("state_rate_hz = 250.0", "state_rate_hz = 300.0"), encoding="utf-8")
    assert main(["simulate", short, "--engine", "python", "--vehicle", str(odd)]) == 2
    assert "whole multiple of link.state_rate_hz = 300" in capsys.readouterr().err


def test_the_mean_wind_blows_in_the_ideal_setting_too(short: str, tmp_path: Path, capsys) -> None:
    """3 m/s through a drag of 1 1/s are 3 m/s^2, most of which the estimate has found after a second."""
    windy = tmp_path / "windy.toml"
    world = "\n[world]\nwind_m_s = [3.0, 0.0, 0.0]\nturbulence = 0.2\n"
    windy.write_text(Path(short).read_text(encoding="utf-8") + world, encoding="utf-8")
    main(["simulate", str(windy), "--ideal"])
    out = " ".join(capsys.readouterr().out.split())
    assert "the ideal setting has no gusts" in out and "true disturbance (3.000, 0.000, 0.000) m/s^2" in out
    assert "disturbance (north, east, down) (2." in out


def test_simulate_writes_one_row_per_control_step(
    short: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rows.csv"
    assert main(["simulate", short, "--engine", "python", "--csv", str(out)]) == 0
    assert f"to {out}" in capsys.readouterr().out
    with out.open(encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    assert header[:4] == ["t_s", "p_n", "p_e", "p_d"]
    assert header[-3:] == ["e4_n", "e4_e", "e4_d"]
    times = [float(row[0]) for row in rows]
    assert all(b - a == pytest.approx(0.004) for a, b in itertools.pairwise(times))
    assert float(rows[-1][3]) == pytest.approx(-5.0, abs=0.1)


def test_csv_that_cannot_be_written(short: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "no" / "rows.csv"
    assert main(["simulate", short, "--ideal", "--csv", str(out)]) == 2
    assert f"companion: {out}: cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["eight", "bundled", "px4_sih"])
def test_every_bundled_gain_set_is_certified_with_margin(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["certify", name, "--json"]) == 0
    found = document(capsys)
    assert found["refused"] is None
    assert all(values[0] > 0.2 for values in found["eigenvalues"].values())
    assert found["sampled_loop"]["delay_margin_s"] >= 0.020
    assert found["sampled_loop"]["spectral_radius"] < 1.0


def test_certify_refuses_with_the_figure_and_still_prints_all_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (bundled_root() / "vehicles" / "bundled.toml").read_text(encoding="utf-8")
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace("gamma_1_s3 = 4.0", "gamma_1_s3 = 90.0"), encoding="utf-8")
    assert main(["certify", str(bad), "--json"]) == 3
    found = document(capsys)
    assert "smallest eigenvalue" in found["refused"]
    assert found["eigenvalues"]["q_estimator_on"][0] < 0.0
    assert main(["certify", str(bad)]) == 3
    assert "REFUSED" in capsys.readouterr().out
    assert main(["certify", str(bad), "--allow-uncertified"]) == 2  # it exists for simulation only


@pytest.mark.parametrize("option", [("--start", "1,2,-3"), ("--time-scale", "2")])
def test_certify_of_a_vehicle_refuses_what_needs_a_trajectory(option: tuple[str, str], capsys) -> None:
    assert main(["certify", "bundled", *option]) == 2
    assert f"{option[0]}: there is no flight to predict, bundled.toml is a vehicle file" in capsys.readouterr().err


def test_uncertified_gains_can_be_simulated_when_asked_for(
    tmp_path: Path, short: str, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = tmp_path / "changed.toml"
    text = Path(short).read_text(encoding="utf-8")
    changed.write_text(text + "\n[controller]\nk1_1_s = 0.4\n", encoding="utf-8")
    assert main(["simulate", str(changed), "--engine", "python"]) == 3
    assert "not certified" in capsys.readouterr().err
    assert main(["simulate", str(changed), "--engine", "python", "--allow-uncertified", "--json"]) == 0
    assert document(capsys)["verdict"] == "passed"


def test_the_same_flight_twice_as_fast_takes_half_the_time(short: str, capsys: pytest.CaptureFixture[str]) -> None:
    steps = []
    for scale in ("1", "2"):
        assert main(["simulate", short, "--engine", "python", "--time-scale", scale, "--json"]) == 0
        steps.append(document(capsys)["steps"])
    assert steps[1] == pytest.approx(steps[0] / 2, abs=6)
