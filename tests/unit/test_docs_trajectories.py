"""docs/trajectories.md: its commands run, its files load, and its figures are those of the program."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from format_cases import DATA

from companion.campaign import predict
from companion.cli import main
from companion.config import Flight, load_vehicle
from companion.flight.surroundings import HEIGHT_MIN_M
from companion.frames import FRAMES, compass_deg, radians, yaw_ned_from
from companion.trajectory import earth
from companion.trajectory.file_definition import WAYPOINTS_MAX, FileDefinition, LimitsTable, WaypointTable
from companion.trajectory.formats import FORMATS, mission, reading, waypoint_csv
from companion.trajectory.load import load

TEXT = (Path(__file__).parents[2] / "docs" / "trajectories.md").read_text(encoding="utf-8")
COMMANDS = [line for block in re.findall(r"^```sh\n(.*?)^```", TEXT, re.M | re.S) for line in block.splitlines()]
FILES = re.findall(r"^```toml\n(.*?)^```", TEXT, re.M | re.S)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for path in DATA.iterdir():
        shutil.copy(path, tmp_path / path.name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("line", COMMANDS)
@pytest.mark.usefixtures("folder")
def test_the_commands_run(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    program, command, *arguments = shlex.split(line)
    assert program == "companion"
    if command != "check":  # a flight takes too long: its options are parsed, its file is loaded
        assert main([command, *arguments, "--help"]) == 0
        bundled = load_vehicle("bundled")
        for name in (argument for argument in arguments if argument.endswith(".csv")):
            assert load(name, frame="enu" if "enu" in arguments else None, vehicle=bundled).duration_s > 10.0
        return
    figures = predict.Prediction(*(predict.Extreme(1.0, 0.5) for _ in range(6)), 0.0, 0.0)
    monkeypatch.setattr(predict, "gate_prediction", lambda *_: figures)
    assert main([command, *arguments]) == 0, capsys.readouterr()


@pytest.mark.parametrize("text", FILES)
def test_the_files_load(folder: Path, text: str) -> None:
    (folder / "mine.toml").write_text(text)
    trajectory = load(folder / "mine.toml", vehicle=load_vehicle("bundled"))
    assert trajectory.anchor == "local"
    # And with what is commented out.
    keys = {line.partition("=")[0].strip("# ") for line in text.splitlines() if "=" in line}
    known = {
        *FileDefinition.model_fields,
        *WaypointTable.model_fields,
        *LimitsTable.model_fields,
        "shape",
        "along_path",
    }
    assert keys <= known, keys - known


def test_every_format_and_frame_is_there() -> None:
    rows = re.findall(r"^\| `([a-z-]+)`", TEXT, re.M)
    assert sorted(rows) == sorted(entry.name for entry in FORMATS)
    for name, axes in FRAMES.items():
        assert f"`{name}`" in TEXT
        assert axes.split(", ")[1] in TEXT
    for entry in FORMATS:
        if entry.frame is None:
            assert re.search(rf"^\| `{entry.name}`.*to be declared", TEXT, re.M), entry.name


def test_the_headings_of_frames_are_those() -> None:
    rows = re.findall(r"^\| of `([a-z]+)` \| from (\w+) to (\w+) \| (\d+) deg \| (\d+) deg \|$", TEXT, re.M)
    assert sorted(row[0] for row in rows) == sorted(FRAMES)
    for frame, x, y, at_zero, at_ninety in rows:
        assert FRAMES[frame].startswith(f"x {x}, y {y}, ")
        found = [compass_deg(yaw_ned_from(frame, radians(yaw_deg))) for yaw_deg in (0.0, 90.0)]
        assert found == [float(at_zero), float(at_ninety)]
        assert waypoint_csv.TURNS.get(frame, "from north to east") == f"from {x} to {y}"


def test_every_format_says_what_its_headings_are() -> None:
    (section,) = re.findall(r"^### Headings\n(.*?)^### ", TEXT, re.M | re.S)
    for entry in FORMATS:
        assert f"`{entry.name}`" in section, entry.name
    for column in waypoint_csv.EXTRAS:
        assert f"`{column}`" in TEXT


def test_the_limits_on_files_are_those() -> None:
    assert f"At most {reading.FILE_MAX_BYTES // 2**20} MB, {reading.ROWS_MAX:,} rows" in TEXT
    assert f"{reading.LINE_MAX:,} characters a line, {WAYPOINTS_MAX:,} points" in TEXT
    assert WAYPOINTS_MAX == waypoint_csv.WAYPOINTS_MAX == mission.ITEMS_MAX
    assert f"times up to {reading.DURATION_MAX_S / 3600:g} h" in TEXT
    assert f"positions up to {reading.POSITION_MAX_M / 1e3:g} km, speeds up to\n{reading.SPEED_MAX_M_S:g} m/s" in TEXT
    assert f"More than {earth.APART_MAX_M / 1e3:g} km apart is refused" in TEXT
    assert f"first {predict.PREDICTED_S:g} s of the closed loop" in TEXT
    assert f"`--height-min` ({HEIGHT_MIN_M:g} m" in TEXT
    assert Flight.model_fields["height_min_m"].default == HEIGHT_MIN_M
    assert f"holds {Flight.model_fields['takeoff_altitude_m'].default:g} m above home" in TEXT
