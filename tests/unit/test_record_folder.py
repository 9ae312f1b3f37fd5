"""The flight's folder: never overwritten, refused early, and its small files."""

import json
import math
import tomllib
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from companion.cli import main
from companion.errors import ExitCode, InputError
from companion.record.folder import create_flight_folder, read_summary, write_configuration, write_summary, write_whole

STARTED = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def test_the_default_folder_carries_utc_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    local = STARTED.astimezone(timezone(timedelta(hours=9)))
    folders = [create_flight_folder("paper", started=local) for _ in range(3)]
    names = ["20260304T050607Z-paper", "20260304T050607Z-paper-2", "20260304T050607Z-paper-3"]
    assert folders == [Path("flights") / name for name in names]
    assert all(folder.is_dir() and not any(folder.iterdir()) for folder in folders)


def test_names_become_file_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert create_flight_folder("../../wind 5 m/s", started=STARTED).name == "20260304T050607Z-wind-5-m-s"
    assert create_flight_folder("..", started=STARTED).name == "20260304T050607Z-flight"
    assert len(list((tmp_path / "flights").iterdir())) == 2


def test_a_named_folder_is_used_when_empty_and_never_overwritten(tmp_path):
    out = tmp_path / "deep" / "result"
    assert create_flight_folder("x", out) == out
    assert create_flight_folder("x", out) == out  # still empty
    (out / "summary.json").write_text("{}")
    assert create_flight_folder("x", out) == out.with_name("result-2")
    (tmp_path / "file").write_text("")
    assert create_flight_folder("x", tmp_path / "file") == tmp_path / "file-2"
    assert (tmp_path / "file").is_file()


def test_a_folder_that_cannot_be_written_is_refused_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "flight", Path("/proc/flight")):
        with pytest.raises(InputError, match="cannot write the flight's folder") as caught:
            create_flight_folder("x", out)
        assert str(out) in str(caught.value)
        assert "--out" in str(caught.value)
        assert "\n" not in str(caught.value)
        assert caught.value.exit_code == ExitCode.BAD_INPUT


@pytest.mark.parametrize("command", [["demo", "--flight", "eight"], ["fly", "circle", "--vehicle", "bundled"]])
def test_a_flight_without_a_place_to_write_is_refused_before_anything_starts(command, monkeypatch, capsys):
    def begun(*_: object, **__: object) -> None:
        raise AssertionError("the flight began")

    monkeypatch.setattr("companion.flight.bundled.BundledVehicle", begun)
    monkeypatch.setattr("companion.flight.launch.control", begun)
    assert main([*command, "--controller", "px4", "--out", "/proc/flight"]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("companion: /proc/flight: cannot write the flight's folder")


def test_summary_round_trip_keeps_order_and_digits(tmp_path):
    summary = {"trajectory": "ä", "position_rms_m": 0.1 + 0.2, "heading_rms_rad": None, "phases": [{"at_s": 1e-9}]}
    path = write_summary(tmp_path, summary)
    assert path.name == "summary.json"
    assert list(read_summary(tmp_path).items()) == list(summary.items())
    with pytest.raises(ValueError, match="JSON"):
        write_summary(tmp_path, {"position_rms_m": math.nan})
    assert read_summary(tmp_path) == json.loads(path.read_text())  # the old one is still whole
    assert [entry.name for entry in tmp_path.iterdir()] == ["summary.json"]


def test_a_missing_or_broken_summary_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"summary\.json: cannot be read"):
        read_summary(tmp_path)
    for text in ("{", "[1]", "\x80"):
        (tmp_path / "summary.json").write_text(text, encoding="latin-1")
        with pytest.raises(InputError, match="not a summary"):
            read_summary(tmp_path)


def test_configuration_is_proper_toml(tmp_path):
    configuration = {
        "name": 'wind "5"\nm/s \\ ü',
        "statistics_from_s": None,
        "vehicle": {
            "body": {"mass_kg": 4.76, "inertia_kg_m2": (0.09, 0.09, 0.15)},
            "name with spaces": True,
            "file": Path("config/vehicles/paper.toml"),
            "empty": {},
        },
        "limits": {"largest": math.inf, "small": 1e-12, "count": 7, "date": STARTED},
        "faults": [{"at_s": 1.0, "kind": None}, {"at_s": 2.0}],
        "acceptance": {},
    }
    path = write_configuration(tmp_path, configuration)
    assert path.name == "flight.toml"
    assert tomllib.loads(path.read_text(encoding="utf-8")) == {
        "name": 'wind "5"\nm/s \\ ü',
        "vehicle": {
            "body": {"mass_kg": 4.76, "inertia_kg_m2": [0.09, 0.09, 0.15]},
            "name with spaces": True,
            "file": "config/vehicles/paper.toml",
            "empty": {},
        },
        "limits": {"largest": math.inf, "small": 1e-12, "count": 7, "date": STARTED},
        "faults": [{"at_s": 1.0}, {"at_s": 2.0}],
        "acceptance": {},
    }


@pytest.mark.parametrize("name", ["vehicles", "trajectories", "flights"])
def test_the_bundled_configuration_survives(tmp_path, name):
    for path in (Path(__file__).parents[2] / "config" / name).glob("*.toml"):
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        assert tomllib.loads(write_configuration(tmp_path, table).read_text(encoding="utf-8")) == table


def test_nothing_is_left_of_a_file_that_could_not_be_written(tmp_path):
    (tmp_path / "page.html").mkdir()
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path / "page.html", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
