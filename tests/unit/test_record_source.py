"""Flights are read from their log alone: a whole one gives all, a damaged one what is in it, others one line."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink2
from record_cases import MASS_KG, PHASES, synthetic_flight
from typer.testing import CliRunner

from companion.cli import app, main
from companion.errors import InputError
from companion.flight.phases import Cause, Engagement, Outcome
from companion.record import ulog
from companion.record.columns import COLUMN_INDEX
from companion.record.compare import table
from companion.record.figures import FIGURES
from companion.record.flight_log import Entry, FlightLog
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import read_source
from companion.record.folder import write_configuration, write_summary
from companion.record.report import build_report, read_flight
from companion.record.summary import FlightMeta, note_end, summarise
from companion.record.tlog import Direction
from companion.record.ulog import Level

CONFIGURATION = f"""name = "paper"
statistics_from_s = 1.0
[acceptance]
position_rms_m = 40.0
[output]
controller = "law"
[vehicle]
name = "quad"
[vehicle.body]
mass_kg = {MASS_KG}
[trajectory]
name = "eight"
"""
ENGAGEMENT = Engagement(104.0, (1.0, 2.0, -10.0), 0.5, None, (1.0, 0.0, 0.0, 0.0), 46.0)
OUTCOME = Outcome(Cause.COMPLETED, "Hold", PHASES, 3, {"STALE": 2}, parameters={"COM_OF_LOSS_T": 1.0})
ENGAGED = json.dumps(
    {**vars(ENGAGEMENT), "ramps": [], "transitions": []} if hasattr(ENGAGEMENT, "transitions") else vars(ENGAGEMENT)
)


def frames(t_us: int) -> list[bytes]:
    """A heartbeat and a state."""
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    none = [0.0] * 21
    odometry = mavlink2.MAVLink_odometry_message(t_us, 1, 1, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, none, none)
    return [mavlink2.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link), odometry.pack(link)]


def battery(remaining: int) -> bytes:
    """What is left, in percent, at 15.2 V and an unknown current."""
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    cells = [3800] * 4 + [65535] * 6
    return bytes(mavlink2.MAVLink_battery_status_message(0, 0, 1, 32767, cells, -1, -1, -1, remaining).pack(link))


class Log(bytes):
    """Bytes that nobody wants to see in a failure."""

    def __repr__(self) -> str:
        return f"<log of {len(self)} bytes>"


def logged(record: FlightRecord, *, ended: bool = True, configuration: str = CONFIGURATION) -> bytes:
    """The log that a flight with this record leaves."""
    log = FlightLog(configuration, 0)
    log.take_frames(Direction.IN, frames(99_000_000), 1)
    for phase in PHASES:
        log.take(Entry.TEXT, bytes((Level.NOTICE,)) + f"{phase.name}: {phase.reason}".encode(), 0)
    log.take(Entry.FACT, f"engagement\0{ENGAGED}".encode(), 0)
    for index, row in enumerate(record.rows):
        if index % 500 == 0:
            log.take_frames(Direction.IN, frames(round(1e6 * row[0])), 1)
        log.take(Entry.ROW, row.tobytes(), 0)
    if not ended:
        return log.taken()
    log.take(Entry.FACT, f"outcome\0{json.dumps(OUTCOME.told())}".encode(), 0)
    return log.end()


@pytest.fixture(scope="module")
def record() -> FlightRecord:
    return synthetic_flight(6.0)


@pytest.fixture(scope="module")
def whole(record: FlightRecord) -> bytes:
    return Log(logged(record))


@pytest.fixture(scope="module")
def short(record: FlightRecord) -> bytes:
    return Log(logged(record.select(np.arange(300, 360))))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_a_whole_log_is_as_good_as_the_folder(tmp_path: Path, record: FlightRecord, whole: bytes) -> None:
    source = read_source(written(tmp_path / "some.ulg", whole))
    assert source.missing == ()
    assert source.record.rows.tobytes() == record.rows.tobytes()
    assert source.record.phase_names == record.phase_names
    wanted = summarise(record, PHASES, FlightMeta("eight", "quad", 3, 1.0, {"position_rms_m": 40.0}))
    note_end(wanted, OUTCOME.told(), json.loads(ENGAGED), {})
    assert source.summary == wanted
    assert Engagement.from_numbers(source.summary["engagement"]) == ENGAGEMENT
    assert source.configuration["vehicle"]["body"]["mass_kg"] == MASS_KG
    page = build_report(source)
    assert page == tmp_path / "some.html"
    text = page.read_text(encoding="utf-8")
    assert "Not everything could be read" not in text
    assert "all checks passed; already airborne in Hold" in text


def test_a_folder_that_a_killed_flight_left_is_read_from_its_log(
    tmp_path: Path, record: FlightRecord, whole: bytes
) -> None:
    cut = whole[: 2 * len(whole) // 3]
    written(tmp_path / "flight.ulg", cut)
    source = read_source(tmp_path)
    assert "record.npz and summary.json: not there" in source.missing[0]
    assert any("ends inside a message" in sentence for sentence in source.missing)
    assert any("does not have the flight's end" in sentence for sentence in source.missing)
    rows = len(source.record)
    assert 0.5 * len(record) < rows < 0.75 * len(record)
    assert source.record.rows.tobytes() == record.rows[:rows].tobytes()
    assert source.summary["verdict"].startswith("incomplete")
    assert [phase["name"] for phase in source.summary["phases"]] == [phase.name for phase in PHASES]
    text = build_report(tmp_path).read_text(encoding="utf-8")
    assert "Not everything could be read" in text
    assert all(sentence.replace("'", "&#x27;") in text for sentence in source.missing)
    (row,) = table([tmp_path])
    assert row["verdict"].startswith("incomplete")


def test_a_record_that_is_cut_off_is_read_from_the_log(tmp_path: Path, record: FlightRecord, whole: bytes) -> None:
    record.save(tmp_path)
    path = tmp_path / "record.npz"
    path.write_bytes(path.read_bytes()[:50_000])
    write_summary(tmp_path, {"verdict": "passed"})
    with pytest.raises(InputError, match="cut off"):
        read_source(tmp_path)
    written(tmp_path / "flight.ulg", whole)
    source = read_source(tmp_path)
    assert source.record.rows.tobytes() == record.rows.tobytes()
    assert "record.npz" in source.missing[0] and "this is read from flight.ulg" in source.missing[0]


def test_the_delays_of_a_killed_flight_are_put_together(tmp_path: Path, record: FlightRecord) -> None:
    told = [[[105.0, 0.021], [106.0, 0.022]], [[107.5, 0.023]]]
    log = logged(record, ended=False) + b"".join(ulog.long_info("delays", json.dumps(piece)) for piece in told)
    source = read_source(written(tmp_path / "some.ulg", log))
    engagement = Engagement.from_numbers(source.summary["engagement"])
    assert engagement == replace(ENGAGEMENT, delays=((105.0, 0.021), (106.0, 0.022), (107.5, 0.023)))


def test_the_folders_own_files_come_first(tmp_path: Path, record: FlightRecord, whole: bytes) -> None:
    record.select(np.arange(50)).save(tmp_path)
    write_summary(tmp_path, {"verdict": "passed"})
    write_configuration(tmp_path, {"name": "folder"})
    written(tmp_path / "flight.ulg", whole)
    source = read_source(tmp_path)
    assert (len(source.record), source.configuration, source.missing) == (50, {"name": "folder"}, ())


RESET = "the autopilot's estimate was reset: moved by 0.30 m; the reference moves along"
GUARD = "the reference slows down to 50 % of its pace: the thrust is at its limit: at 80 N for 0.5 s"
WORDS = "autopilot: low <battery>"


def test_battery_and_messages_come_from_the_log_of_a_folder_or_alone(tmp_path: Path, record: FlightRecord) -> None:
    """And the report shows them: guards and resets in every figure over time, the rest in the events' band."""
    settings_ = CONFIGURATION + "[vehicle.controller]\nk1_1_s = 0.5\nk2 = 4.0\ngamma_1_s3 = 2.0\n"
    log = FlightLog(settings_ + "[vehicle.limits]\ndisturbance_max_m_s2 = 3.0\n", 0)
    log.take_frames(Direction.IN, frames(99_000_000), 1)
    for index, row in enumerate(record.rows):
        if index % 100 == 0:
            log.take_frames(Direction.IN, [*frames(round(1e6 * row[0])), battery(90 - index // 100)], 1)
        log.take(Entry.ROW, row.tobytes(), 0)
        if index in {400, 500, 600}:
            said = {400: RESET, 500: GUARD, 600: WORDS}[index]
            log.take(Entry.TEXT, bytes((Level.NOTICE,)) + said.encode(), 0)
    content = log.end()
    alone = read_source(written(tmp_path / "alone.ulg", content))
    record.save(tmp_path)
    write_summary(tmp_path, alone.summary)
    write_configuration(tmp_path, alone.configuration)
    written(tmp_path / "flight.ulg", content)
    folder = read_source(tmp_path)
    assert folder.missing == ()
    assert folder.messages == alone.messages
    assert [(message.at_s, message.text) for message in folder.messages if message.level == Level.NOTICE] == [
        *((105.0, RESET), (106.0, GUARD), (107.0, WORDS))
    ]
    assert folder.battery.keys() == alone.battery.keys()
    assert all(np.array_equal(folder.battery[name], alone.battery[name], equal_nan=True) for name in folder.battery)
    assert folder.battery["remaining"][:3] == pytest.approx([0.90, 0.89, 0.88])
    assert folder.battery["voltage_v"] == pytest.approx(15.2)

    flight, _ = read_flight(folder)
    figures = {figure.key: figure.build(flight) for figure in FIGURES if figure.shown(flight)}
    rows = {trace["name"]: trace for trace in figures["events"]["data"] if trace["type"] == "scatter"}
    assert {name: trace["x"] for name, trace in rows.items() if name != "messages"} == {
        **{"resets": [pytest.approx(1.0)], "guards": [pytest.approx(2.0)], "autopilot's words": [pytest.approx(3.0)]}
    }
    assert rows["autopilot's words"]["text"] == ["autopilot: low &lt;battery&gt;"]
    for figure in figures.values():
        if figure["layout"].get("meta"):
            drawn = [shape["x0"] for shape in figure["layout"]["shapes"] if shape.get("line", {}).get("width") == 1]
            assert {1.0, 2.0} <= {round(x, 3) for x in drawn}
    names = [trace["name"] for trace in figures["battery"]["data"]]
    assert names == ["voltage", "current", "left"]
    bound = next(trace for trace in figures["errors"]["data"] if trace["name"].startswith("envelope"))
    first = record.rows[0]
    value, b_hat = first[COLUMN_INDEX["lyapunov"]], record.columns("b_hat_n", "b_hat_e", "b_hat_d")[0]
    assert np.nanmax(bound["y"]) == pytest.approx(value + (3.0 + np.linalg.norm(b_hat)) ** 2 / 2.0, rel=1e-6)
    text = build_report(folder).read_text(encoding="utf-8")
    assert "the thrust is at its limit: at 80 N" in text
    assert "low <battery>" not in text


def test_a_folder_whose_log_is_damaged_is_shown_without_what_only_the_log_has(
    tmp_path: Path, record: FlightRecord, whole: bytes
) -> None:
    record.save(tmp_path)
    write_summary(tmp_path, {"verdict": "passed"})
    for content, said in ((b"", "is empty"), (b"no log" * 9, "is no ULog"), (whole[:-7], "ends inside a message")):
        source = read_source(written(tmp_path / "flight.ulg", content).parent)
        assert len(source.record) == len(record)
        assert len(source.missing) == 1
        assert "flight.ulg" in source.missing[0]
        assert said in source.missing[0]


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0.0, 1.0))
def test_a_log_cut_at_any_byte_gives_what_is_in_it(
    place: Path, record: FlightRecord, short: bytes, share: float
) -> None:
    path = written(place / "cut.ulg", short[: int(share * (len(short) - 1))])
    try:
        source = read_source(path)
    except InputError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)
        return
    rows = source.record.rows
    assert rows.tobytes() == record.rows[300 : 300 + len(rows)].tobytes()
    assert source.missing
    assert not source.summary["verdict"].startswith("passed")


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_anywhere_ends_in_one_line_or_a_report(place: Path, short: bytes, data: st.DataObject) -> None:
    content = bytearray(short)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        patch = data.draw(st.binary(min_size=1, max_size=40))
        content[at : at + len(patch)] = patch
    path = written(place / "damaged.ulg", bytes(content))
    try:
        flight, _ = read_flight(path)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert len(flight.record) <= 60
    for figure in FIGURES[:2]:
        json.dumps(figure.build(flight)["layout"], allow_nan=False)


@settings(max_examples=25, deadline=None)
@given(content=st.binary(max_size=300), headed=st.booleans())
def test_what_is_no_log_is_refused_in_one_line(place: Path, content: bytes, headed: bool) -> None:
    path = written(place / "foreign.ulg", (ulog.header(0) if headed else b"") + content)
    with pytest.raises(InputError) as caught:
        read_source(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_cannot_be_are_left_out(tmp_path: Path, record: FlightRecord) -> None:
    wild = record.select(np.arange(300, 340))
    wild.column("e1_n")[5] = math.inf
    wild.column("thrust_n")[6] = 1e300
    source = read_source(written(tmp_path / "wild.ulg", logged(wild)))
    assert math.isnan(source.record.column("e1_n")[5])
    assert math.isnan(source.record.column("thrust_n")[6])
    build_report(source)


def test_a_configuration_that_cannot_be_read_is_said(tmp_path: Path, record: FlightRecord) -> None:
    content = logged(record.select(np.arange(300, 320)), configuration="name = ")
    source = read_source(written(tmp_path / "some.ulg", content))
    assert source.configuration == {}
    assert "the configuration in the log is damaged" in source.missing[0]


def px4_log() -> bytes:
    return ulog.header(0) + ulog.info("sys_name", "PX4") + ulog.logged(6, 0, "ready")


def test_the_command_says_what_is_missing(tmp_path: Path, whole: bytes) -> None:
    path = written(tmp_path / "cut.ulg", whole[:200_003])
    done = CliRunner().invoke(app, ["report", str(path)])
    assert done.exit_code == 0
    assert "the log ends inside a message" in done.stdout
    assert f"report: {tmp_path / 'cut.html'}" in done.stdout
    done = CliRunner().invoke(app, ["report", str(path), "--json"])
    assert json.loads(done.stdout)[0]["verdict"].startswith("incomplete")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"#!/bin/sh\n", "is no ULog"),
        (ulog.header(0)[:12], "ends within its header"),
        (ulog.header(0), "ends within its definitions"),
        (px4_log(), "written by PX4, not by this program; lay it over a flight with --from-px4"),
    ],
)
def test_the_command_refuses_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, said: str
) -> None:
    path = written(tmp_path / "some.ulg", content)
    for command in ("report", "replay"):
        assert main([command, str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"companion: {path}: ")
        assert said in line
