"""The report: the figures are there and true, it opens offline, and it copes with what may be missing."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from record_cases import DISTURBANCE, MASS_KG, PHASES, synthetic_flight, track_record, write_truth

from companion.errors import InputError
from companion.record.charts import thin
from companion.record.compare import build_comparison, table
from companion.record.figures import FIGURES
from companion.record.figures_vehicle import attitude, wanted_axis
from companion.record.flight_data import FlightData
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import FlightSource
from companion.record.folder import write_configuration, write_summary
from companion.record.report import build_report
from companion.record.summary import FlightMeta, PhaseChange, summarise

CONFIGURATION = {
    "name": "paper <in> wind",
    "acceptance": {"position_rms_m": 0.01, "position_max_m": 0.001},
    "vehicle": {
        "body": {"mass_kg": MASS_KG},
        "limits": {"thrust_min_n": 9.0, "thrust_max_n": 80.0, "rate_max_rad_s": [6.0, 6.0, 3.0]},
        "controller": {"k1_1_s": 0.7, "k2": 4.0},
    },
    "limits": {"thrust_max_n": 70.0},
}
ALL = [
    *("events", "position-error", "plan-view", "plan-view-close", "path", "body-velocities", "force-estimates"),
    *("errors", "actuation", "rates", "attitude", "heading", "timing"),
]


class Page(HTMLParser):
    """What a browser would see: elements, their attributes, the scripts' text, and the visible text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.text = ""
        self._inside = ""
        self.feed(path.read_text(encoding="utf-8"))
        self.figures = {figure["key"]: figure for figure in json.loads(self.scripts[1])}

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data + " "

    def trace(self, key: str, name: str, axis: str = "y") -> tuple[np.ndarray, np.ndarray]:
        found = [
            trace for trace in self.figures[key]["data"] if trace["name"] == name and trace.get("yaxis", "y") == axis
        ]
        assert len(found) == 1
        return tuple(np.frombuffer(base64.b64decode(found[0][name]["bdata"]), dtype="<f4") for name in "xy")


@pytest.fixture(scope="module")
def record() -> FlightRecord:
    return synthetic_flight()


def fill(folder: Path, record: FlightRecord, phases=PHASES) -> Path:
    record.save(folder)
    meta = FlightMeta("paper", "quad", acceptance=CONFIGURATION["acceptance"])
    write_summary(folder, summarise(record, phases, meta))
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory, record) -> Page:
    folder = fill(tmp_path_factory.mktemp("flight"), record)
    write_configuration(folder, CONFIGURATION)
    write_truth(folder / "truth.csv")
    path = build_report(folder)
    assert path == folder / "report.html"
    assert path.stat().st_size < 8_000_000
    return Page(path)


def test_nothing_is_loaded_from_anywhere(page):
    assert all("src" not in attributes and "href" not in attributes for _, attributes in page.elements)
    assert not {"link", "img", "iframe", "object", "embed", "base"} & {tag for tag, _ in page.elements}
    policies = [
        attributes["content"]
        for tag, attributes in page.elements
        if tag == "meta" and attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    assert len(policies) == 1
    assert policies[0].startswith("default-src 'none';")
    assert "http" not in policies[0]
    assert len(page.scripts) == 3
    assert sum("plotly.js v" in script for script in page.scripts) == 1


def test_every_figure_has_its_place_and_plotly_accepts_it(page):
    places = [attributes["id"] for tag, attributes in page.elements if tag == "div" and "id" in attributes]
    assert places == list(page.figures) == ALL
    for figure in page.figures.values():
        go.Figure(data=figure["data"], layout=figure["layout"])  # raises for what plotly.js would not know


def test_every_axis_says_its_unit(page):
    for key, figure in page.figures.items():
        layout = figure["layout"] | figure["layout"].get("scene", {})
        axes = [value for name, value in layout.items() if name.startswith(("xaxis", "yaxis", "zaxis"))]
        named = [axis for axis in axes if axis.get("type") != "category"]
        assert len(named) >= (1 if key == "events" else 2)
        assert all(axis["title"]["text"].endswith("]") for axis in named)


def test_titles_captions_and_numbers_are_on_the_page(page, record):
    for figure in FIGURES:
        if figure.key == "battery":  # there is no log beside the record
            continue
        assert figure.title in page.text
        assert figure.caption in page.text
    assert "paper <in> wind" in page.text
    assert "missed: position_max_m" in page.text
    assert "thrust at its maximum" in page.text
    for change in PHASES:
        assert change.reason in page.text
    for key, value in (("rate_max_rad_s", "6, 6, 3"), ("thrust_max_n", "70"), ("thrust_min_n", "9"), ("k2", "4")):
        assert f"{key} {value}" in " ".join(page.text.split())


def test_the_plan_shows_the_path_with_north_up(page, record):
    east, north = page.trace("plan-view", "flown")
    assert north.max() == pytest.approx(record.column("p_n").max(), rel=1e-6)
    assert east.min() == pytest.approx(record.column("p_e").min(), rel=1e-6)
    start_east, start_north = page.trace("plan-view", "start")
    assert (start_north[0], start_east[0]) == pytest.approx((record.column("p_n")[0], record.column("p_e")[0]))
    layout = page.figures["plan-view"]["layout"]
    assert (layout["yaxis"]["scaleanchor"], layout["yaxis"]["scaleratio"]) == ("x", 1)
    low, high = page.figures["plan-view-close"]["layout"]["yaxis"]["range"]
    assert -12.0 < low < -10.0 < 0.0 < high < 2.0


def test_forces_are_newtons_against_the_truth(page):
    time_s, truth = page.trace("force-estimates", "truth")
    assert truth[0] == pytest.approx(MASS_KG * DISTURBANCE[0], rel=1e-6)
    assert time_s[0] == pytest.approx(-3.0, abs=1e-4)
    _, estimate = page.trace("force-estimates", "estimate", "y3")
    assert estimate[-1] == pytest.approx(MASS_KG * DISTURBANCE[2], abs=0.2)
    assert page.figures["force-estimates"]["layout"]["yaxis3"]["title"]["text"] == "Down [N]"


def test_thinning_keeps_the_peaks_of_the_flight(page, record):
    for name, column in (("|e₁|", "e1"), ("|e₄|", "e4")):
        size = np.linalg.norm(record.columns(f"{column}_n", f"{column}_e", f"{column}_d"), axis=1)
        assert np.nanmax(page.trace("errors", name)[1]) == pytest.approx(np.nanmax(size), rel=1e-6)
    _, thrust = page.trace("actuation", "thrust")
    assert thrust.min() == pytest.approx(record.column("thrust_n").min(), rel=1e-6)
    assert len(thrust) < len(record) / 2


def test_phases_are_marked_in_time_figures(page):
    layout = page.figures["body-velocities"]["layout"]
    shaded = [(shape["x0"], shape["x1"]) for shape in layout["shapes"] if shape["type"] == "rect"]
    assert shaded == [pytest.approx((-3.0, 0.0)), pytest.approx((60.0, 65.0), abs=0.01)]
    assert [note["text"] for note in layout["annotations"]] == ["track"]
    assert "OFFBOARD confirmed" in layout["annotations"][0]["hovertext"]


def test_events_are_bands_in_time(page, record):
    bars = {trace["name"]: trace for trace in page.figures["events"]["data"] if trace["name"] != "phase"}
    assert "thrust at its maximum" in bars
    begin, length = bars["thrust at its maximum"]["base"][0], bars["thrust at its maximum"]["x"][0]
    bits = record.column("limits")
    active = record.column("t_s")[(np.where(np.isfinite(bits), bits, 0).astype(int) & 2) != 0]
    assert begin == pytest.approx(active[0] - 104.0, abs=1e-6)
    assert 0.0 < length <= active[-1] - active[0] + 0.1
    phases = [trace for trace in page.figures["events"]["data"] if trace["name"] == "phase"]
    assert [trace["text"][0] for trace in phases] == [phase.name for phase in PHASES[-len(phases) :]]


def test_the_attitude_that_the_law_wants_is_where_its_acceleration_error_vanishes():
    """By hand: 2 kg under 20 N, level, and e3 = (0.5, 0, 0) m with k1^2 k2 = 4 per s^2: thrust along (2, 0, 10)."""
    record = track_record([(0.0, 0.0, 0.0)] * 2)
    numbers = {"predicted_q_w": 1.0, "predicted_q_x": 0.0, "predicted_q_y": 0.0, "predicted_q_z": 0.0}
    numbers |= {"thrust_n": 20.0, "e3_n": 0.5, "e3_e": 0.0, "e3_d": 0.0}
    for name, value in numbers.items():
        record.column(name)[:] = value
    flight = FlightData(record, {}, {}, 2.0, {}, gains={"k1_1_s": 1.0, "k2": 4.0})
    assert wanted_axis(flight) == pytest.approx(np.array([[2.0, 0.0, 10.0]] * 2) / np.sqrt(104.0))
    drawn = {trace["name"]: trace["y"] for trace in attitude(flight)["data"]}
    angle = np.degrees(np.arctan(0.2))
    assert drawn["pitch wanted"] == pytest.approx(angle, rel=1e-6)
    assert drawn["tilt wanted"] == pytest.approx(angle, rel=1e-6)
    assert drawn["roll wanted"] == pytest.approx(0.0, abs=1e-6)
    assert wanted_axis(FlightData(record, {}, {}, None, {})) is None


def test_time_figures_and_no_others_are_zoomed_together(page):
    linked = [key for key, figure in page.figures.items() if figure["layout"].get("meta") == "time"]
    assert linked == [key for key in ALL if key not in {"plan-view", "plan-view-close", "path"}]
    assert len({tuple(page.figures[key]["layout"]["xaxis"]["range"]) for key in linked}) == 1


def test_the_path_in_space_is_true_to_scale_with_up_upwards(page, record):
    figure = page.figures["path"]
    scene = figure["layout"]["scene"]
    assert scene["aspectmode"] == "manual"
    for letter, name in (("x", "p_e"), ("y", "p_n"), ("z", "p_d")):
        low, high = scene[f"{letter}axis"]["range"]
        sign = -1.0 if letter == "z" else 1.0
        assert low < (sign * record.column(name)).min() <= (sign * record.column(name)).max() < high
        scale = (high - low) / scene["aspectratio"][letter]
        assert scale == pytest.approx(scene["xaxis"]["range"][1] - scene["xaxis"]["range"][0], rel=1.0)
    flown = next(trace for trace in figure["data"] if trace["name"] == "flown")
    up = np.frombuffer(base64.b64decode(flown["z"]["bdata"]), dtype="<f4")
    assert up.max() == pytest.approx(-record.column("p_d").min(), abs=0.05)


def test_thin_keeps_spikes_ends_and_gaps():
    series = np.zeros((100_000, 2))
    series[43_210, 0], series[77_777, 1] = 5.0, -3.0
    series[50_000:50_010, 1] = np.nan
    rows = thin(series, 100)
    assert len(rows) < 500
    assert {0, 43_210, 49_999, 50_000, 50_009, 50_010, 77_777, 99_999} <= set(rows.tolist())
    assert thin(series[:50], 100).tolist() == list(range(50))


def test_ten_minutes_at_250_hz_stay_small_and_keep_their_peaks(tmp_path, record):
    rows = np.tile(record.rows[record.in_phase("track")], (26, 1))[:150_000]
    long = record.select(np.zeros(len(rows), dtype=np.intp))
    long.rows[:] = rows
    long.column("track_s")[:] = 0.004 * np.arange(len(rows))
    long.column("t_s")[:] = 104.0 + long.column("track_s")
    spikes = {"error_n": 77_777, "thrust_n": 123_456, "step_us": 9, "w_x": 149_990}
    for column, at in spikes.items():
        long.column(column)[at] = 5e4
    summary = summarise(long, PHASES, FlightMeta("paper", "quad"))
    path = build_report(FlightSource(tmp_path, long, summary, {}, "none"))
    assert path.stat().st_size < 8_000_000
    page = Page(path)
    for (key, name, axis), scale in {
        ("position-error", "distance from the reference", "y"): 1.0,
        ("actuation", "thrust", "y"): 1.0,
        ("timing", "control step", "y"): 1e-3,
        ("rates", "actual", "y2"): 1.0,
    }.items():
        time_s, values = page.trace(key, name, axis)
        assert values.max() == pytest.approx(5e4 * scale, rel=1e-4)
        assert len(time_s) < 4000
    time_s, values = page.trace("actuation", "thrust")
    assert time_s[values.argmax()] == pytest.approx(0.004 * spikes["thrust_n"], abs=1e-3)


def test_without_truth_and_configuration(tmp_path, record):
    page = Page(build_report(fill(tmp_path, record.select(np.arange(0, len(record), 10)))))
    assert list(page.figures) == ALL
    names = [trace["name"] for trace in page.figures["force-estimates"]["data"]]
    assert names == ["estimate"] * 3
    assert page.figures["force-estimates"]["layout"]["yaxis"]["title"]["text"] == "North [m/s²]"
    assert tmp_path.name in page.text


@pytest.mark.parametrize("rows", [[], [0], list(range(100))])
def test_a_flight_that_never_tracked(tmp_path, record, rows):
    page = Page(build_report(fill(tmp_path, record.select(np.array(rows, dtype=np.intp)))))
    assert "did not track" in page.text
    assert list(page.figures) == [key for key in ALL if key != "plan-view-close"]
    for figure in page.figures.values():
        go.Figure(data=figure["data"], layout=figure["layout"])


def test_text_from_outside_stays_text(tmp_path, record):
    nasty = '</script><script src="x">@@DATA@@&'
    write_configuration(tmp_path, {"name": nasty})
    page = Page(build_report(fill(tmp_path, record, [PhaseChange("track", 104.0, nasty)])))
    assert len(page.scripts) == 3
    assert page.text.count(nasty) == 3  # title, heading, and the phases' table
    assert nasty in page.figures["errors"]["layout"]["annotations"][0]["hovertext"]


def test_a_truth_that_was_cut_off_is_used_up_to_there(tmp_path, record):
    write_truth(tmp_path / "truth.csv")
    whole = (tmp_path / "truth.csv").read_text()
    (tmp_path / "truth.csv").write_text(whole[: whole.rindex(",") - 3])
    page = Page(build_report(fill(tmp_path, record)))
    assert len(page.trace("force-estimates", "truth")[0]) > 2


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("truth.csv", "time,p_n\n1,2\n", "t_s among them"),
        ("truth.csv", "t_s,p_n\n1,two\n", "cannot be read"),
        ("flight.toml", "name = ", "cannot be read"),
        ("summary.json", "{", "not a summary"),
        ("record.npz", "PK", "not a flight record"),
    ],
)
def test_broken_files_are_refused_by_name(tmp_path, record, name, text, message):
    fill(tmp_path, record.select(np.arange(100)))
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        build_report(tmp_path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_flight_is_refused(tmp_path):
    with pytest.raises(InputError, match="no flight record"):
        build_report(tmp_path)


def test_two_flights_side_by_side(tmp_path, record):
    law, px4 = (fill(tmp_path / name, record) for name in map(_made(tmp_path), ("law", "px4")))
    write_configuration(law, CONFIGURATION)
    write_configuration(px4, CONFIGURATION)
    summary = json.loads((px4 / "summary.json").read_text()) | {"controller": "px4", "position_rms_m": 0.5}
    write_summary(px4, summary)
    page = Page(build_comparison(law, px4))
    assert {"errors-a", "timing-a", "timing-b"} <= set(page.figures)
    assert "errors-b" not in page.figures  # PX4's controller has none
    linked = [figure["layout"]["xaxis"]["range"] for figure in page.figures.values() if figure["layout"].get("meta")]
    assert len(linked) > 10
    assert all(span == linked[0] for span in linked)
    assert "position rms [cm]" in page.text
    assert " 50 " in page.text
    rows = table([law, px4])
    assert [row["controller"] for row in rows] == ["law", "px4"]
    assert rows[1]["position rms [cm]"] == pytest.approx(50.0)
    with pytest.raises(InputError, match="cannot be written"):
        build_comparison(law, px4, tmp_path / "missing" / "page.html")


def _made(base):
    def make(name):
        (base / name).mkdir()
        return name

    return make
