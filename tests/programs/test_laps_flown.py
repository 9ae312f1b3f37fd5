"""Laps as a user flies them: the bundled vehicle, in lockstep, along another program's points and back, twice."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from flight_cases import flight_data

from companion.cli import main
from companion.record.flight_record import FlightRecord

POINTS = ((0.0, 0.0, 10.0), (2.0, 0.0, 10.5), (2.0, 1.0, 10.0))
"""North, west, up."""
LAPS = 2


def test_two_laps_of_another_programs_points(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points = tmp_path / "points.csv"
    points.write_text("".join(f"{x},{y},{z}\n" for x, y, z in POINTS))
    wrapped = tmp_path / "trip.toml"
    wrapped.write_text('name = "round trip"\nfile = "points.csv"\nframe = "nwu"\nanchor = "local"\n')
    flight = flight_data(start={"position_m": [0.0, 0.0, -10.0], "yaw_deg": 0.0}, statistics_from_s=1.0)
    del flight["trajectory"]
    path = tmp_path / "flight.toml"
    path.write_text(tomlkit.dumps({**flight, "trajectory": "trip.toml"}))
    vehicle = tmp_path / "vehicle.toml"
    vehicle.write_text(tomlkit.dumps(flight["vehicle"]))
    options = ("--laps", str(LAPS), "--json")

    assert main(["check", str(wrapped), "--vehicle", str(vehicle), *options]) == 0
    checked = json.loads(capfd.readouterr().out)["files"][0]
    assert checked["name"] == "round trip"
    assert any(note.startswith("2 laps, ") for note in checked["notes"])

    out = tmp_path / "out"
    command = ["fly", str(wrapped), "--flight", str(path), "--sim", "--engine", "python", "--out", str(out)]
    assert main([*command, *options]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["trajectory"] == "round trip"
    assert summary["duration_s"] == pytest.approx(checked["duration_s"], abs=0.05)
    assert summary["position_max_m"] < 0.05

    record = FlightRecord.load(out / "record.npz")
    track = record.in_phase("track")
    flown = np.stack([record.column(f"p_{axis}")[track] for axis in "ned"], axis=1)
    for x, y, z in POINTS[1:]:
        near = np.linalg.norm(flown - np.array([x, -y, -z]), axis=1) < 0.1
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) == LAPS  # times that it comes by
