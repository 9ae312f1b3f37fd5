"""The vehicle file: what is read, what is passed over, and what is refused with which words."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest
from sim_cases import PAPER

from companion.config import Noise
from sim_link import vehicle_file
from sim_link.vehicle_file import VehicleFileError, find, load, parse

TEXT = Path(PAPER.path).read_text(encoding="utf-8")


def document() -> dict[str, Any]:
    return tomllib.loads(TEXT)


def refusal(content: dict[str, Any]) -> str:
    with pytest.raises(VehicleFileError) as caught:
        parse(content, "some.toml")
    message = str(caught.value)
    assert message.startswith("some.toml: ")
    assert "\n" not in message
    return message


def test_bundled_vehicle_is_read() -> None:
    assert PAPER.name == "paper"
    assert PAPER.mass_kg == 4.76
    assert PAPER.inertia_kg_m2 == (0.09, 0.09, 0.15)
    assert PAPER.rotor_y_m == (0.25, -0.25, -0.25, 0.25)
    assert PAPER.rate_lag_s == (0.040, 0.040, 0.080)
    assert PAPER.noise_attitude_rad == 0.0005


def test_the_bias_walk_may_be_left_out() -> None:
    names = ["position_walk_m_per_sqrt_s", "velocity_walk_m_s_per_sqrt_s", "yaw_walk_rad_per_sqrt_s"]
    names += ["rate_walk_rad_s_per_sqrt_s", "walk_time_constant_s"]
    content = document()
    for name in names:
        content["noise"].pop(name, None)
    v = parse(content, "some.toml")
    walk = (v.walk_position_m, v.walk_velocity_m_s, v.walk_yaw_rad, v.walk_rate_rad_s, v.walk_time_constant_s)
    assert walk == (0.0,) * 5
    content["noise"].update(zip(names, (1, 2.0, 3.0, 4.0, 5.0), strict=True))
    v = parse(content, "some.toml")
    walk = (v.walk_position_m, v.walk_velocity_m_s, v.walk_yaw_rad, v.walk_rate_rad_s, v.walk_time_constant_s)
    assert walk == (1.0, 2.0, 3.0, 4.0, 5.0)
    content["noise"]["yaw_walk_rad_per_sqrt_s"] = -0.1
    assert "noise.yaw_walk_rad_per_sqrt_s = -0.1: must be 0 or more" in refusal(content)
    assert set(names) <= set(Noise.model_fields), "the companion reads the same file"
    assert set(names) <= set(tomllib.loads(find("bundled").read_text(encoding="utf-8"))["noise"])


def test_every_bundled_vehicle_can_be_simulated() -> None:
    files = sorted(vehicle_file.bundled_folder().glob("*.toml"))
    assert files
    for file in files:
        assert load(file.stem).name


def test_whole_numbers_count_as_numbers_and_foreign_sections_are_passed_over() -> None:
    content = document()
    content["body"]["mass_kg"] = 5
    content["controller"] = {"anything": True}
    content["something_new"] = 1
    del content["limits"]
    vehicle = parse(content, "some.toml")
    assert vehicle.mass_kg == 5.0
    assert isinstance(vehicle.mass_kg, float)


@pytest.mark.parametrize(
    ("section", "key", "value", "words"),
    [
        ("body", "mass_kg", 0.0, "body.mass_kg = 0.0: must be greater than 0"),
        ("body", "mass_kg", float("nan"), "body.mass_kg = nan: must be finite"),
        ("body", "mass_kg", "4.76", "body.mass_kg = '4.76': must be a number"),
        ("body", "mass_kg", True, "body.mass_kg = True: must be a number"),
        ("body", "inertia_kg_m2", [0.1, 0.1], "body.inertia_kg_m2 = [0.1, 0.1]: must be an array of 3 numbers"),
        ("body", "inertia_kg_m2", [0.1, -0.1, 0.1], "body.inertia_kg_m2[1] = -0.1: must be greater than 0"),
        ("body", "inertia_kg_m2", [0.1, 0.1, 0.3], "none above the sum of the others"),
        ("body", "drag_1_s", -0.1, "body.drag_1_s = -0.1: must be 0 or more"),
        ("rotors", "x_m", 0.25, "rotors.x_m = 0.25: must be an array of 4 numbers"),
        ("rotors", "y_m", [0.0, 0.0, 0.0, 0.0], "rotors.y_m = [0.0, 0.0, 0.0, 0.0]: must not be all zero"),
        ("rotors", "yaw_moment_m", [0.05, -0.05, 0.05, -0.05], "independently of one another"),
        ("rotors", "thrust_max_n", 11.0, "must be above a quarter of the weight, 11.7 N"),
        ("rotors", "curve_factor", 1.1, "rotors.curve_factor = 1.1: must be 0 to 1"),
        ("rotors", "lag_s", -0.01, "rotors.lag_s = -0.01: must be 0 to 1"),
        ("autopilot", "rate_lag_s", [0.04, 0.04, 0.01], "autopilot.rate_lag_s[2] = 0.01: must be at least 0.01667 s"),
        (
            "autopilot",
            "loop_rate_hz",
            600.0,
            "autopilot.loop_rate_hz = 600.0: must be 50 to 8000 with a period of whole",
        ),
        (
            "autopilot",
            "attitude_gain_1_s",
            [6.0, 6.0, 0.0],
            "autopilot.attitude_gain_1_s[2] = 0.0: must be greater than 0",
        ),
        ("link", "state_rate_hz", 1000.0, "link.state_rate_hz = 1000: must be at most autopilot.loop_rate_hz, 500"),
        ("link", "state_age_s", 20.0, "link.state_age_s = 20.0: must be 0 to 1"),
        ("noise", "rate_rad_s", float("inf"), "noise.rate_rad_s = inf: must be finite"),
        (
            "noise",
            "position",
            0.1,
            "noise.position: unknown; allowed are position_m, velocity_m_s, attitude_rad, rate_rad_s",
        ),
    ],
)
def test_bad_values_are_named(section: str, key: str, value: Any, words: str) -> None:
    content = document()
    content[section][key] = value
    assert words in refusal(content)


def test_missing_things_are_named() -> None:
    content = document()
    del content["rotors"]["lag_s"]
    assert "rotors.lag_s: missing; [rotors] must hold x_m" in refusal(content)
    content = document()
    del content["noise"]
    assert "noise: missing; the section must hold position_m" in refusal(content)
    content = document()
    content["link"] = 3
    assert "link = 3: must be a section [link]" in refusal(content)
    content = document()
    content["name"] = ""
    assert "name = '': must be a text" in refusal(content)


def test_a_path_comes_before_a_bundled_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "paper").write_text(TEXT.replace("mass_kg = 4.76", "mass_kg = 4.5"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load("paper").mass_kg == 4.5
    assert load(str(tmp_path / "paper")).mass_kg == 4.5


def test_unknown_names_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(
        VehicleFileError, match=r"papr: no such vehicle file, and not one of the bundled vehicles \(.*paper"
    ):
        find("papr")
    bad = tmp_path / "bad.toml"
    bad.write_text("name = 'x'\nmass = = 3\n", encoding="utf-8")
    with pytest.raises(VehicleFileError, match=r"bad\.toml: not valid TOML: .*line 2"):
        load(str(bad))
    bad.write_bytes(b"\xff\xfe")
    with pytest.raises(VehicleFileError, match="cannot be read"):
        load(str(bad))


def test_bundled_files_are_found_when_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "companion" / "_config" / "vehicles"
    folder.mkdir(parents=True)
    shutil.copy(PAPER.path, folder / "special.toml")
    monkeypatch.setattr(vehicle_file, "__file__", str(tmp_path / "sim_link" / "vehicle_file.py"))
    assert load("special").mass_kg == 4.76
