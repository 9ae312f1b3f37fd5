"""PX4's own log of a flight is laid over it at the right time, or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from record_cases import PHASES, synthetic_flight
from typer.testing import CliRunner

from companion.cli import app, main
from companion.errors import InputError
from companion.record import px4_log as px4_log_module
from companion.record import ulog
from companion.record.alignment import Motion, align
from companion.record.flight_record import FlightRecord
from companion.record.folder import write_configuration, write_summary
from companion.record.px4_log import read_px4_log
from companion.record.px4_page import build_overlay
from companion.record.summary import FlightMeta, summarise
from companion.record.ulog import Field, Series, Topic

OFFSET_S = 71.2345  # the companion's clock less PX4's
DELAY_S = 0.031


def of(name: str, *fields: str) -> Topic:
    return Topic(name, "", tuple(Field(field.split()[1], field.split()[0], "", "") for field in fields))


POSITION = of("vehicle_local_position", *(f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz", "heading")))
ATTITUDE = of("vehicle_attitude", "float[4] q")
ATTITUDE_SETPOINT = of("vehicle_attitude_setpoint", "float[4] q_d")
RATES = of("vehicle_angular_velocity", "float[3] xyz")
RATES_SETPOINT = of("vehicle_rates_setpoint", "float roll", "float pitch", "float yaw", "float[3] thrust_body")
MOTORS = of("actuator_motors", "float[12] control")
BATTERY = of("battery_status", "float voltage_v", "float remaining")
STATUS = of("vehicle_status", "uint8_t nav_state")
ALL = (POSITION, ATTITUDE, ATTITUDE_SETPOINT, RATES, RATES_SETPOINT, MOTORS, BATTERY, STATUS)


@pytest.fixture(scope="module")
def record() -> FlightRecord:
    return synthetic_flight(20.0)


def row_of(topic: Topic, values: dict[str, float], delayed: dict[str, float], index: int) -> list[float]:
    q = [values[name] for name in ("q_w", "q_x", "q_y", "q_z")]
    if topic is POSITION:
        return [values[name] for name in ("p_n", "p_e", "p_d", "v_n", "v_e", "v_d")] + [0.0]
    if topic in {ATTITUDE, ATTITUDE_SETPOINT}:
        return q
    if topic is RATES:
        return [values[f"w_{axis}"] for axis in "xyz"]
    if topic is RATES_SETPOINT:
        return [delayed[f"rate_cmd_{axis}"] for axis in "xyz"] + [0.0, 0.0, -delayed["thrust_cmd"]]
    if topic is MOTORS:
        return [0.5] * 4 + [math.nan] * 8
    if topic is BATTERY:
        return [16.0 - 0.001 * index, 1.0 - 0.0001 * index]
    return [14 if index > 200 else 4]


def px4_log(record: FlightRecord, *, without: tuple[str, ...] = (), system: str = "PX4") -> bytes:
    """What PX4 logs of the flight, at 80 Hz, on its own clock."""
    told = [topic for topic in ALL if topic.name not in without]
    parts = [ulog.header(0), *map(ulog.format_definition, told), ulog.info("sys_name", system)]
    parts += [ulog.subscription(topic, number) for number, topic in enumerate(told)]
    parts.append(ulog.logged(6, round(1e6 * (104.0 - OFFSET_S)), "[commander] Armed by external command"))
    series = [Series(topic, number) for number, topic in enumerate(told)]
    t_s, columns = record.column("t_s"), record.as_dict()
    for index, at_s in enumerate(np.arange(t_s[0] + 0.003, t_s[-1], 0.0125)):
        values = {name: float(np.interp(at_s, t_s, column)) for name, column in columns.items()}
        held = int(np.searchsorted(t_s, at_s - DELAY_S, side="right")) - 1
        delayed = {name: float(column[max(held, 0)]) for name, column in columns.items()}
        for one in series:
            parts.append(one.encode(round(1e6 * (at_s - OFFSET_S)), row_of(one.topic, values, delayed, index)))
    return b"".join(parts)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, record: FlightRecord) -> Path:
    """A flight's folder with PX4's log beside it."""
    folder = tmp_path_factory.mktemp("flight")
    record.save(folder)
    write_summary(folder, summarise(record, PHASES, FlightMeta("paper", "quad")))
    write_configuration(folder, {"name": "paper"})
    (folder / "px4.ulg").write_bytes(px4_log(record))
    return folder


def test_the_offset_is_found_and_all_is_laid_over(flown: Path) -> None:
    overlay = build_overlay(flown / "px4.ulg", flown)
    assert overlay.fit.offset_s == pytest.approx(OFFSET_S, abs=1e-3)
    assert overlay.fit.agreement > 0.999
    assert overlay.fit.clear and overlay.fit.same_flight
    assert overlay.missing == ()
    assert overlay.page == flown / "px4.html"
    text = overlay.page.read_text(encoding="utf-8")
    for key in ("modes", "position", "difference", "attitude", "rates", "thrust", "battery"):
        assert f'id="{key}"' in text
    assert "one flight" in text
    assert "[commander] Armed by external command" in text
    assert overlay.page.stat().st_size < 8_000_000


def test_the_setpoints_delay_and_the_modes_are_found(flown: Path, record: FlightRecord) -> None:
    px4 = read_px4_log(flown / "px4.ulg", record)
    # commands come every 10 ms and are held, logged every 12.5 ms
    assert px4.delay_s(record) == pytest.approx(DELAY_S, abs=1.5e-3)
    assert [name for name, _, _ in px4.modes] == ["Hold", "Offboard"]
    motors = px4.motors
    assert motors is not None
    assert motors[1].values.shape[1] == 4
    other = record.select(np.arange(len(record)))
    other.column("rate_cmd_x")[:] = np.random.default_rng(1).normal(size=len(other))
    other.column("rate_cmd_y")[:] = other.column("rate_cmd_z")[:] = other.column("rate_cmd_x")[::-1]
    assert px4.delay_s(other) is None


def test_the_command_says_offset_and_quality(flown: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    arguments = ["report", "--from-px4", str(flown / "px4.ulg"), str(flown), "--out", str(page)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0
    assert "time offset: +71.23" in done.stdout
    assert "% of the velocity's variance agrees" in done.stdout
    assert page.exists()
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert json.loads(done.stdout)["offset_s"] == pytest.approx(OFFSET_S, abs=1e-3)


def test_a_log_with_less_in_it_shows_less_and_says_so(flown: Path, record: FlightRecord, tmp_path: Path) -> None:
    left_out = tuple(topic.name for topic in ALL[1:])
    content = px4_log(record, without=left_out)
    (tmp_path / "part.ulg").write_bytes(content[: 5 * len(content) // 6])
    overlay = build_overlay(tmp_path / "part.ulg", flown, tmp_path / "page.html")
    assert overlay.fit.offset_s == pytest.approx(OFFSET_S, abs=1e-3)
    assert any("ends inside a message" in sentence for sentence in overlay.missing)
    for name in left_out:
        assert any(name in sentence for sentence in overlay.missing)
    text = overlay.page.read_text(encoding="utf-8")
    assert 'id="position"' in text
    assert 'id="battery"' not in text


@pytest.mark.parametrize("case", ["other", "ours", "nowhere", "folder", "two"])
def test_what_does_not_belong_together_is_refused(
    flown: Path, record: FlightRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    path, flights = tmp_path / "px4.ulg", [str(flown)]
    if case == "other":
        other = record.select(np.arange(len(record)))
        for axis in "ned":
            other.column(f"v_{axis}")[:] = other.column(f"v_{axis}")[::-1].copy()
            other.column(f"p_{axis}")[:] = other.column(f"p_{axis}")[::-1].copy()
        path.write_bytes(px4_log(other, without=tuple(topic.name for topic in ALL[1:])))
        said = "do not show the same flight"
    elif case == "ours":
        path.write_bytes(px4_log(record.select(np.arange(50)), system="companion"))
        said = "is a log of this program"
    elif case == "nowhere":
        path.write_bytes(px4_log(record.select(np.arange(50)), without=("vehicle_local_position",)))
        said = "has no vehicle_local_position"
    elif case == "folder":
        path = tmp_path
        said = "cannot be read"
    else:
        path.write_bytes(b"")
        flights *= 2
        said = "--from-px4 takes one flight"
    assert main(["report", "--from-px4", str(path), *flights]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_what_px4_did_not_log_is_neither_drawn_nor_compared() -> None:
    t_s = np.concatenate((np.arange(0.0, 1.0, 0.01), np.arange(3.0, 4.0, 0.01)))
    series = px4_log_module.Series(t_s, t_s[:, None])
    drawn = px4_log_module.broken(series)
    assert len(drawn.t_s) == len(t_s) + 1
    assert np.isnan(drawn.values[100, 0])
    assert drawn.t_s[100] == pytest.approx(1.995)
    between = px4_log_module.at(series, [-1.0, 0.505, 2.0, 3.505, 5.0])[:, 0]
    assert between == pytest.approx([math.nan, 0.505, math.nan, 3.505, math.nan], nan_ok=True)


def motion(t_s: np.ndarray, rate: float = 0.7, laps: float = 1e9, size: float = 5.0) -> Motion:
    """Around a circle; after some laps straight on."""
    angle = np.minimum(rate * t_s, laps * math.tau)
    on = np.maximum(t_s - laps * math.tau / rate, 0.0)
    p = np.column_stack((size * np.cos(angle), size * np.sin(angle) + size * rate * on, -10.0 + 0.0 * t_s))
    v = np.column_stack((-size * rate * np.sin(angle), size * rate * np.cos(angle), 0.0 * t_s))
    v[on > 0.0, 0] = 0.0
    return Motion(t_s, p, v)


def test_equal_laps_are_called_ambiguous() -> None:
    lap_s = math.tau / 0.7
    fit = align(motion(np.arange(0.0, 6.0 * lap_s, 0.01)), motion(np.arange(1.5 * lap_s, 4.5 * lap_s, 0.013)))
    assert not fit.clear
    assert "ambiguous" in fit.sentence
    laps = fit.offset_s / lap_s
    assert laps == pytest.approx(round(laps), abs=1e-3)
    sure = align(motion(np.arange(0.0, 20.0, 0.01), laps=1.5), motion(np.arange(5.0, 25.0, 0.013), laps=1.5))
    assert sure.clear
    assert sure.offset_s == pytest.approx(0.0, abs=2e-3)


def test_frames_with_another_origin_do_not_matter() -> None:
    t_s = np.arange(0.0, 20.0, 0.01)
    here, there = motion(t_s, laps=1.2), motion(t_s, laps=1.2)
    fit = align(here, Motion(there.t_s + 3.21, there.p + np.array([4.0, -7.0, 1.0]), there.v))
    assert fit.offset_s == pytest.approx(-3.21, abs=1e-3)
    assert fit.position_offset_m == pytest.approx((-4.0, 7.0, -1.0), abs=1e-2)
    assert fit.position_rms_m < 0.01


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (motion(np.arange(0.0, 20.0, 0.01), size=0.0), motion(np.arange(0.0, 20.0, 0.01)), "hardly moves"),
        (motion(np.arange(0.0, 1.0, 0.01)), motion(np.arange(0.0, 20.0, 0.01)), "less than 2 s"),
        (motion(np.array([0.0])), motion(np.arange(0.0, 20.0, 0.01)), "no motion"),
    ],
)
def test_what_cannot_be_aligned_is_said(first: Motion, second: Motion, said: str) -> None:
    with pytest.raises(InputError, match=said):
        align(first, second)
