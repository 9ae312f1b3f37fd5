"""A recorded flight replayed: exact when nothing changed, different where something did, and explained otherwise."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from flight_cases import INDOOR, Stand, make_flight
from typer.testing import CliRunner

from companion.campaign.replay import replay
from companion.cli import app
from companion.errors import InputError
from companion.flight.tracker import kernels
from companion.record.folder import SUMMARY_FILE, write_configuration, write_summary


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A short flight's folder."""
    folder = tmp_path_factory.mktemp("flight")
    flight = make_flight(trajectory=dict(INDOOR) | {"duration_s": 2.0})
    with Stand(flight, folder) as stand:
        flown = stand.fly()
    assert flown.outcome.engagement is not None
    flown.record.save(folder)
    write_configuration(folder, flight.model_dump(exclude_none=True))
    write_summary(folder, flown.summary | {"engagement": asdict(flown.outcome.engagement)})
    return folder


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
