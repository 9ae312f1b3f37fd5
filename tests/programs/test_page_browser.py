"""The pages in a real browser: nothing is complained about, all figures are drawn, and time zooms in all of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from chromium import Chromium, installed
from record_cases import MASS_KG, PHASES, synthetic_flight, write_truth

from companion.record.charts import lines, time_layout
from companion.record.compare import build_comparison
from companion.record.folder import write_configuration, write_summary
from companion.record.page import compose
from companion.record.report import build_report, section
from companion.record.summary import FlightMeta, summarise

BROWSER = installed()
pytestmark = pytest.mark.skipif(BROWSER is None, reason="chromium is not installed")

RANGES = """Object.fromEntries([...document.querySelectorAll(".plot")].filter(plot => plot.layout.meta === "time")
  .map(plot => [plot.id, plot.layout.xaxis.range]))"""
LINKED = 10


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    record = synthetic_flight(30.0)
    record.save(folder)
    write_summary(folder, summarise(record, PHASES, FlightMeta("paper", "quad", acceptance={"position_rms_m": 0.01})))
    write_configuration(folder, {"name": "paper", "vehicle": {"body": {"mass_kg": MASS_KG}}})
    write_truth(folder / "truth.csv", seconds=38.0)
    build_report(folder)
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    assert BROWSER is not None
    with Chromium(BROWSER) as browser:
        yield browser


def settled(script: str) -> str:
    """The script, and time for what follows it."""
    return f"(async () => {{ await {script}; await new Promise(done => setTimeout(done, 50)); }})()"


def outside(browser: Chromium) -> list[str]:
    """What reaches beyond the screen."""
    parts = """[...document.querySelectorAll(".plot .main-svg, .tile, h1, h2, .caption")].filter(part => {
      const box = part.getBoundingClientRect(); return box.left < 0 || box.right > innerWidth + 0.5; })
      .map(part => part.className.baseVal || part.textContent)"""
    found = list(browser.run(parts))
    wide = browser.run("document.documentElement.scrollWidth - innerWidth")
    return found + [f"the page, by {wide} px"] * (wide > 0)


def test_on_a_desk(browser: Chromium, flight: Path, tmp_path: Path) -> None:
    browser.complaints.clear()
    browser.size(1200, 900)
    browser.open(flight / "report.html")
    # what is on the screen comes first; a zoom reaches also what is not drawn yet
    drawn = 'document.querySelectorAll(".plot.js-plotly-plot").length'
    assert 0 < browser.run(drawn) < 13
    browser.run(settled('Plotly.relayout("events", {"xaxis.range": [3, 7]})'))
    assert browser.run("window.everythingDrawn") == browser.run(drawn) == 13
    ranges = browser.run(RANGES)
    assert len(ranges) == LINKED
    assert {tuple(span) for span in ranges.values()} == {(3, 7)}
    empty = """[...document.querySelectorAll(".plot")]
      .filter(plot => !plot.querySelector("canvas, path.js-line, .point path")).map(plot => plot.id)"""
    assert browser.run(empty) == []
    assert outside(browser) == []
    # the time axes of all figures stand below one another
    lefts = browser.run("""[...document.querySelectorAll(".plot")].filter(plot => plot.layout.meta === "time")
      .map(plot => plot._fullLayout._size.l)""")
    assert max(lefts) - min(lefts) <= 8
    # zooming with the mouse says the ends one by one, a double click that all is to be shown
    browser.run(settled('Plotly.relayout("timing", {"xaxis.range[0]": 5, "xaxis.range[1]": 6.5})'))
    assert {tuple(span) for span in browser.run(RANGES).values()} == {(5, 6.5)}
    browser.run(settled('Plotly.relayout("heading", {"xaxis.autorange": true})'))
    others = {key: span for key, span in browser.run(RANGES).items() if key != "heading"}
    assert all(span == pytest.approx([-3.0, 34.99], abs=0.02) for span in others.values())
    assert browser.picture(tmp_path / "page.png").read_bytes()[:4] == b"\x89PNG"
    # on paper
    heights = '[...document.querySelectorAll(".plot")].map(plot => plot.clientHeight)'
    before = browser.run(heights)
    paper = browser.print(tmp_path / "page.pdf").read_bytes()
    assert paper[:5] == b"%PDF-"
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b", paper)) <= 12
    assert browser.run(heights) == before
    assert browser.complaints == []


def test_on_a_phone(browser: Chromium, flight: Path) -> None:
    browser.complaints.clear()
    browser.size(390, 844, phone=True)
    browser.open(flight / "report.html")
    assert browser.run("window.everythingDrawn") == 13
    assert browser.run("innerWidth") == 390
    assert outside(browser) == []
    # a finger on a figure scrolls the page
    assert browser.run('document.getElementById("errors").layout.dragmode') is False
    assert browser.complaints == []


def test_two_flights_side_by_side_are_drawn_and_linked(browser: Chromium, flight: Path, tmp_path: Path) -> None:
    browser.complaints.clear()
    browser.size(1200, 900)
    browser.open(build_comparison(flight, flight, tmp_path / "compare.html"))
    browser.run(settled('Plotly.relayout("events-a", {"xaxis.range": [1, 2]})'))
    browser.run("window.everythingDrawn")
    ranges = browser.run(RANGES)
    assert len(ranges) == 2 * LINKED
    assert {tuple(span) for span in ranges.values()} == {(1, 2)}
    assert browser.complaints == []


def test_a_complaint_would_be_seen(browser: Chromium, tmp_path: Path) -> None:
    time_s = np.arange(10.0)
    layout = time_layout(time_s, [], ["Height [m]"])
    figure = {"key": "height", "data": lines(time_s, time_s[:, None], ["up"], ["red"]), "layout": layout}
    marks = ("TITLE", "SUBTITLE", "VERDICT", "VERDICT_CLASS", "THRESHOLDS", "TILES", "TABLES")
    parts = dict.fromkeys(marks, "") | {"FIGURES": section("Height", "of it", ["height"], 200)}
    path = tmp_path / "bad.html"
    bad = '<script>console.error("bad"); setTimeout(() => { throw new Error("worse"); });</script></body>'
    path.write_text(compose(parts, [figure]).replace("</body>", bad + '<img src="http://127.0.0.1:9/x.png">'))
    browser.complaints.clear()
    browser.open(path)
    browser.run("window.everythingDrawn")
    assert any("bad" in said for said in browser.complaints)
    assert any("worse" in said for said in browser.complaints)
    browser.complaints.clear()
