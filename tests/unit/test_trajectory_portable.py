"""A trajectory as one file for the vehicle: what names another file takes its text in, all else goes as it is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from format_cases import DATA

from companion.config import bundled_root, load_vehicle
from companion.errors import InputError
from companion.frames import Frame
from companion.trajectory.load import load
from companion.trajectory.portable import Portable

OTHERS: list[tuple[str, Frame | None]] = [
    ("eight-mavsdk.csv", None),
    ("eight-polynomial.csv", None),
    ("eight-rpg.csv", "enu"),
    ("eight-skybrush.csv", None),
    ("square.csv", "enu"),
    ("square.plan", None),
    ("square.waypoints", None),
]


@pytest.mark.parametrize(("name", "frame"), OTHERS)
def test_every_format_flies_the_same_from_the_one_file(tmp_path: Path, name: str, frame: Frame | None) -> None:
    vehicle = load_vehicle("bundled")
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    shutil.copy(DATA / name, here / name)
    declared = "" if frame is None else f'frame = "{frame}"\n'
    (here / "trip.toml").write_text(f'name = "trip"\nfile = "{name}"\nanchor = "local"\n{declared}')
    brought = Portable(str(here / "trip.toml"))
    assert brought.file_name == "trip.toml"
    (there / "trip.toml").write_bytes(brought.content)
    a, b = load(here / "trip.toml", vehicle=vehicle), load(there / "trip.toml", vehicle=vehicle, confined=True)
    assert (b.name, b.anchor, b.duration_s, b.notes) == ("trip", "local", a.duration_s, a.notes)
    for share in (0.0, 0.3, 1.0):
        assert b.at(share * b.duration_s) == a.at(share * a.duration_s)


def test_options_make_a_file_around_another_programs(tmp_path: Path) -> None:
    vehicle = load_vehicle("bundled")
    brought = Portable(str(DATA / "square.csv"), frame="enu", laps=2)
    assert brought.file_name == "square.toml"
    (tmp_path / "square.toml").write_bytes(brought.content)
    twice = load(tmp_path / "square.toml", vehicle=vehicle, confined=True)
    assert twice.name == "square"
    assert twice.at(1.0) == load(DATA / "square.csv", vehicle=vehicle, frame="enu", laps=2).at(1.0)
    circle = tmp_path / "circle.toml"
    circle.write_bytes(Portable("circle", laps=5).content)
    assert load(circle).duration_s == pytest.approx(load("circle", laps=5).duration_s)


@pytest.mark.parametrize("path", [DATA / "eight-mavsdk.csv", bundled_root() / "trajectories" / "circle.toml"])
def test_what_needs_nothing_goes_as_it_is(path: Path) -> None:
    brought = Portable(str(path))
    assert (brought.file_name, brought.content) == (path.name, path.read_bytes())


def test_what_the_reader_says_is_known_without_a_vehicle(tmp_path: Path) -> None:
    (tmp_path / "wp.csv").write_text("x,y,z,yaw_deg\n0,0,5,0\n5,0,5,0\n")
    (tmp_path / "around.toml").write_text('file = "wp.csv"\nframe = "nwu"\n')
    (note,) = Portable(str(tmp_path / "wp.csv"), frame="enu", laps=2).notes()
    assert note.startswith("yaw_deg counts from east to north in this frame")
    around = Portable(str(tmp_path / "around.toml"))
    (note,) = around.notes()
    assert note.startswith("yaw_deg counts from north to west in this frame")
    (tmp_path / "whole.toml").write_bytes(around.content)
    assert Portable(str(tmp_path / "whole.toml")).notes() == (note,)
    assert any("home position" in said for said in Portable(str(DATA / "square.waypoints")).notes())
    assert Portable(str(tmp_path / "wp.csv")).notes() == ()  # without its frame it cannot be read
    assert Portable("circle").notes() == ()


def test_what_cannot_be_read_is_said_here(tmp_path: Path) -> None:
    (tmp_path / "trip.toml").write_text('file = "nothing.csv"\n')
    with pytest.raises(InputError, match=r"nothing\.csv: cannot be read"):
        Portable(str(tmp_path / "trip.toml"))
    with pytest.raises(InputError, match="--frame is for other programs' files"):
        Portable("circle", frame="enu")
