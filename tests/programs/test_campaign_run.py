"""Campaigns as they run: parts, going on, workers that die, Dask, the folder, the page, the command line."""

import json
import math
import os
import re
import signal
import socket

import numpy as np
import pytest

from companion.campaign import engines, run, store
from companion.campaign.outcome import MEASURES, Outcome, fly_number
from companion.campaign.sensitivity import ranking
from companion.campaign.store import Store, open_folder, read_flights
from companion.campaign.worker import fly_batch
from companion.cli import main
from companion.errors import InputError, LinkError
from tests.unit.campaign_cases import die, tiny, tiny_file

pq = pytest.importorskip("pyarrow.parquet")


def flown(study, folder, fleet=engines.Here):
    return run.run(study, folder, fleet, "python")


def test_a_campaign_leaves_one_file_with_every_flight(tmp_path):
    study = tiny(tmp_path, count=3)
    seen = []
    ran = run.run(study, tmp_path / "out", engines.Here, "python", seen.append)
    table = read_flights(ran.folder)
    assert table["flight"].to_pylist() == [0, 1, 2] and ran.flown == 3 and seen[-1].done == seen[-1].total == 3
    assert table["vehicle.mass_factor"].to_pylist() == [study.values(i)["vehicle.mass_factor"] for i in range(3)]
    assert set(MEASURES) <= set(table.column_names) and not (ran.folder / store.PARTS).exists()
    assert json.loads((ran.folder / store.SUMMARY_FILE).read_text()) == ran.summary
    assert open_folder(ran.folder).digest == study.digest
    again = run.run(study, ran.folder, lambda: pytest.fail("nothing is missing"), "python")
    assert again.flown == 0 and again.summary == ran.summary


class Interrupted(engines.Here):
    """Ends as the operator's Ctrl-C does, after two batches."""

    def run(self, tasks):
        for index, done in enumerate(super().run(tasks)):
            if index == 2:
                raise KeyboardInterrupt
            yield done


def test_an_interrupted_campaign_goes_on_with_what_is_missing(tmp_path):
    study = tiny(tmp_path, count=4)
    whole = flown(study, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        flown(study, tmp_path / "halves", Interrupted)
    (tmp_path / "halves" / store.PARTS / "00000003.parquet.part").write_bytes(b"half of a part")
    assert len(read_flights(tmp_path / "halves")) == 2
    rest = flown(study, tmp_path / "halves")
    assert rest.flown == 2
    assert (tmp_path / "halves" / store.FLIGHTS_FILE).read_bytes() == (whole.folder / store.FLIGHTS_FILE).read_bytes()


@pytest.mark.parametrize("broken", [b"", b"PAR1 and half of it"])
def test_a_part_that_is_broken_is_flown_again(broken, tmp_path):
    study = tiny(tmp_path, count=4)
    whole = flown(study, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        flown(study, tmp_path / "halves", Interrupted)
    (tmp_path / "halves" / store.PARTS / "00000001.parquet").write_bytes(broken)
    with pytest.raises(InputError, match="holds flights that cannot be read"):
        read_flights(tmp_path / "halves")
    assert flown(study, tmp_path / "halves").flown == 3
    assert (tmp_path / "halves" / store.FLIGHTS_FILE).read_bytes() == (whole.folder / store.FLIGHTS_FILE).read_bytes()


def test_a_worker_that_is_killed_loses_nothing(tmp_path):
    study = tiny(tmp_path, count=12)
    here = flown(study, tmp_path / "here")
    fleet = engines.Processes(1)
    killed = []

    def kill(done):
        if done.done == 3 and not killed:
            killed.extend(fleet.pids)
            os.kill(killed[0], signal.SIGKILL)

    ran = run.run(study, tmp_path / "out", lambda: fleet, "python", kill)
    assert killed and fleet.deaths == 1 and ran.flown == 12
    assert (ran.folder / store.FLIGHTS_FILE).read_bytes() == (here.folder / store.FLIGHTS_FILE).read_bytes()


def test_workers_that_die_again_and_again_are_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(engines.worker, "fly_batch", die)  # spawned workers get it by its name
    monkeypatch.setattr(engines, "DEATHS_MAX", 1)
    fleet = engines.Processes(1)
    with pytest.raises(LinkError, match=r"workers died 2 times.*what is finished is kept"):
        list(fleet.run(iter([engines.Task(0, "", 0, 1, "python")])))
    fleet.close()


def test_dask_gives_the_same_to_the_bit(tmp_path):
    pytest.importorskip("distributed")
    study = tiny(tmp_path, count=6)
    here = flown(study, tmp_path / "here")
    ran = flown(study, tmp_path / "dask", lambda: engines.Dask("local", 1))
    assert (ran.folder / store.FLIGHTS_FILE).read_bytes() == (here.folder / store.FLIGHTS_FILE).read_bytes()
    assert ran.memory_mb > 50.0


def test_a_flight_that_raises_is_a_result(tmp_path):
    study = tiny(tmp_path, more="inertia_factor = { constant = 1e-9 }\nthrust_factor = { constant = 0.1 }\n")
    outcome = fly_number(study, 1, "python")
    assert outcome.ended == "raised" and not outcome.converged and "must be above a quarter" in outcome.reason
    assert all(math.isnan(value) for value in outcome.measures.values())
    assert fly_batch(study.to_json(), 0, 2, "python").part[:4] == b"PAR1"


def test_the_folder_of_another_study_is_left_alone(tmp_path):
    flown(tiny(tmp_path, count=2), tmp_path / "out")
    with pytest.raises(InputError, match=r"holds another study.*--out"):
        Store(tmp_path / "out", tiny(tmp_path, count=3), 1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letters.txt").write_text("dear")
    with pytest.raises(InputError, match="no campaign's folder"):
        Store(tmp_path / "full", tiny(tmp_path), 1)


def test_more_flights_than_disk_are_refused_before_anything_is_written(tmp_path, monkeypatch):
    usage = type("Usage", (), {"free": 5000})
    monkeypatch.setattr(store.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match=r"100 flights need up to .* GB.*lower count"):
        Store(tmp_path / "out", tiny(tmp_path, count=100), 1)
    assert not (tmp_path / "out").exists()


def table_of(study, outcomes):
    return pq.read_table(__import__("io").BytesIO(store.to_parquet(study, outcomes)))


def test_sensitivity_finds_what_matters_and_by_its_size(tmp_path):
    study = tiny(tmp_path, count=400, more="[vary.world]\nwind_towards_deg = { uniform = [-90.0, 90.0] }\n")
    outcomes = []
    for i in range(400):
        values = study.values(i)
        rms = values["vehicle.mass_factor"] + 1e-3 * abs(values["world.wind_towards_deg"])
        measures = {name: 1.0 for name in MEASURES} | {"rms_m": rms}
        outcomes.append(Outcome(i, 1, values, "flown", "", True, True, measures, np.zeros(120, np.float32)))
    found = {row.variable: row for row in ranking(study, table_of(study, outcomes), "rms_m")}
    assert found["vehicle.mass_factor"].partial > 0.6 and not found["vehicle.mass_factor"].by_distance
    assert found["world.wind_towards_deg"].partial > 0.6 and found["world.wind_towards_deg"].by_distance
    assert abs(found["start.north_m"].partial) < 2.0 * found["start.north_m"].noise
    assert ranking(study, table_of(study, outcomes), "max_m") == []


def test_the_command_flies_says_and_draws(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    more = '[[slices]]\nx = "start.north_m"\ny = "vehicle.mass_factor"\n'
    path = tiny_file(tmp_path, count=2, more=more)
    assert main(["campaign", str(path), "--workers", "1", "--engine", "python", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["flights"] == 2 and document["folder"] == "campaigns/tiny"
    page = (tmp_path / "campaigns/tiny/report.html").read_text()
    assert "converged" in page and not re.search(r'(src|href)="', page.split("<script>")[0])
    assert main(["campaign", "replay", "1", "--no-mavlink", "--engine", "python", "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["identical"] is True and row["flight"] == 1


@pytest.mark.parametrize(("factors", "raised"), [("[0.1, 0.11]", 6), ("[0.1, 1.0]", 3)])
def test_flights_that_cannot_be_built_leave_a_page_all_the_same(factors, raised, tmp_path, capsys, monkeypatch):
    """Flight 0 among them: the length of the time axis is that of one that was flown."""
    monkeypatch.chdir(tmp_path)
    path = tiny_file(tmp_path, count=6, more=f"thrust_factor = {{ choice = {factors} }}\n")
    assert main(["campaign", str(path), "--workers", "1", "--engine", "python", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["ended"]["raised"] == raised
    assert read_flights(tmp_path / "campaigns/tiny")["ended"][0].as_py() == "raised"
    assert ("The error over time" in (tmp_path / "campaigns/tiny/report.html").read_text()) is (raised < 6)


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["campaign", "nowhere"], 2, "no study file 'nowhere'"),
        (["campaign", "region", "robustness"], 2, "one study at a time"),
        (["campaign", "replay", "x"], 2, "not the number of a flight"),
        (["campaign", "replay", "nowhere", "1"], 2, "not a campaign's folder"),
        (["campaign", "replay", "1"], 2, "no campaign in ./campaigns"),
        (["campaign", "region", "--count", "0"], 2, "count = 0"),
        (["campaign", "replay", "1", "--seed", "2"], 2, "--seed: means nothing for a replay"),
        (
            ["campaign", "region", "--unguarded", "--no-mavlink"],
            2,
            "--mavlink/--no-mavlink: mean nothing for a campaign",
        ),
        (["campaign", "region", "--scheduler", "here"], 2, 'must be "local" or an address'),
        (["campaign", "region", "--scheduler", "tcp://127.0.0.1:1", "--workers", "2"], 2, "--workers"),
    ],
)
def test_bad_input_is_one_line(words, code, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == code
    captured = capsys.readouterr()
    assert says in captured.err and captured.out == "" and "Traceback" not in captured.err


def test_a_scheduler_that_cannot_be_reached_is_a_lost_link(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(engines, "CONNECT_TIMEOUT_S", 0.3)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"  # nobody listens there
        out = tmp_path / "out"
        assert main(["campaign", str(tiny_file(tmp_path)), "--scheduler", address, "--out", str(out)]) == 4
    assert f"--scheduler {address}: no Dask scheduler answers" in capsys.readouterr().err
