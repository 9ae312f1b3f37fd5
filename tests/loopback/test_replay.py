"""A recorded flight replayed: exact when nothing changed, different where something did, and explained otherwise."""

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from flight_cases import INDOOR, Flown, Stand, make_flight
from typer.testing import CliRunner

from companion.campaign.replay import replay
from companion.cli import app
from companion.config import Flight
from companion.errors import InputError
from companion.flight.engines import kernels
from companion.flight.phases import Cause
from companion.frames import EARTH_RADIUS_M
from companion.record.folder import SUMMARY_FILE, write_configuration, write_summary
from sim_link.geodesy import HOME_ALTITUDE_M, HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A short flight's folder."""
    folder = tmp_path_factory.mktemp("flight")
    flight = make_flight(trajectory=dict(INDOOR) | {"duration_s": 2.0})
    with Stand(flight, folder) as stand:
        flown = stand.fly()
    assert flown.outcome.engagement is not None
    keep(folder, flight, flown)
    return folder


def keep(folder: Path, flight: Flight, flown: Flown) -> None:
    """What a replay wants of a flight's folder."""
    flown.record.save(folder)
    write_configuration(folder, flight.model_dump(exclude_none=True))
    write_summary(folder, flown.summary | {"engagement": asdict(flown.outcome.engagement)})


def test_nothing_changed_nothing_differs(folder):
    shares: list[float] = []
    done = replay(folder, kernels("python"), progress=shares.append)
    assert len(done.time_s) > 500
    assert done.identical
    assert {found.first_s for found in done.differences} == {None}
    assert np.array_equal(done.replayed["tau_x"], done.recorded.column("tau_x"))
    assert shares == sorted(shares)


@pytest.mark.numba
def test_compiled_commands_agree_with_the_recorded_ones(folder):
    for found in replay(folder, kernels("numba")).differences:
        assert found.largest < 1e-9


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["replay", *arguments])
    if isinstance(done.exception, InputError):
        return 2, str(done.exception)
    return done.exit_code, done.stdout


def test_other_gains_differ_and_are_drawn(folder, tmp_path):
    page = tmp_path / "replay.html"
    code, text = run(str(folder), "--set", "controller.k1_1_s=0.9", "--page", str(page), "--json", "--engine", "python")
    assert code == 0
    found = json.loads(text)
    assert not found["identical"]
    by_name = {entry["name"]: entry for entry in found["differences"]}
    assert by_name["angular acceleration"]["largest"] > 1e-3
    assert 0.0 <= by_name["angular acceleration"]["first_s"] < 0.1
    html = page.read_text(encoding="utf-8")
    assert "the commands differ" in html
    assert 'id="tau"' in html


def test_what_cannot_be_replayed_is_said(folder, tmp_path):
    assert run(str(tmp_path)) == (
        2,
        f"{tmp_path / 'record.npz'}: there is no flight record; give the folder of a flight",
    )
    code, text = run(str(folder), "--set", "controller.k9=1")
    assert code == 2
    assert "the vehicle file has no controller.k9" in text
    code, text = run(str(folder), "--set", "k1")
    assert code == 2
    assert "expected KEY=VALUE" in text
    old = tmp_path / "old"
    old.mkdir()
    for name in ("flight.toml", "record.npz"):
        (old / name).write_bytes((folder / name).read_bytes())
    summary = json.loads((folder / SUMMARY_FILE).read_text())
    for entry, words in ((None, "too old"), ({"at_s": 1.0}, "engagement")):
        write_summary(
            old, {k: v for k, v in summary.items() if k != "engagement"} | ({"engagement": entry} if entry else {})
        )
        code, text = run(str(old))
        assert code == 2
        assert words in text


def test_a_mission_that_was_planned_from_elsewhere_is_flown_within_the_vehicles_own_fence(tmp_path):
    """Over the vehicle's home, planned 60 m south of it; the record tells the two apart, and older ones do not."""

    def line(index: int, frame: int, north_m: float, altitude_m: float) -> str:
        latitude_deg = HOME_LATITUDE_DEG + math.degrees(north_m / EARTH_RADIUS_M)
        place = f"{latitude_deg:.8f}\t{HOME_LONGITUDE_DEG}\t{altitude_m}"
        return f"{index}\t{int(index == 0)}\t{frame}\t16\t0\t0\t0\t0\t{place}\t1\n"

    mission = tmp_path / "field.waypoints"
    points = line(0, 0, -60.0, HOME_ALTITUDE_M), line(1, 3, 0.0, 20.0), line(2, 3, 3.0, 20.0)
    mission.write_text("QGC WPL 110\n" + "".join(points))
    flight = make_flight(
        trajectory={"file": str(mission)}, vehicle__limits__fence_radius_m=20.0, vehicle__limits__fence_height_m=30.0
    )
    with Stand(flight, tmp_path) as stand:
        flown = stand.fly()
    assert flown.cause is Cause.COMPLETED, flown.outcome.sentence
    engagement = flown.outcome.engagement
    assert engagement is not None and engagement.home_m is not None
    assert engagement.home_m[:2] == pytest.approx((0.0, 0.0), abs=0.1)
    assert engagement.origin_m == pytest.approx((-60.0, 0.0, engagement.home_m[2]), abs=0.1)
    assert flown.record.columns("p_n")[-1] == pytest.approx(3.0, abs=0.5)
    keep(tmp_path, flight, flown)
    assert replay(tmp_path, kernels("python")).identical
    older = {key: value for key, value in asdict(engagement).items() if key != "origin_m"}
    write_summary(tmp_path, flown.summary | {"engagement": older | {"home_m": list(engagement.origin_m)}})
    assert replay(tmp_path, kernels("python")).identical
