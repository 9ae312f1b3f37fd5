"""Several flights beside one another: two on one page, any number as a table."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.errors import InputError
from companion.record.figures import FIGURES
from companion.record.flight_source import FlightSource, read_source_summary
from companion.record.folder import write_whole
from companion.record.page import compose
from companion.record.report import flight_name, notes, read_flight, section
from companion.record.summary import met

COMPARE_FILE: Final = "compare.html"


class Measure(NamedTuple):
    """A number of a summary that flights are compared by."""

    title: str
    path: tuple[str, ...]
    """Keys in the summary."""
    scale: float
    unit: str


MEASURES: Final = (
    Measure("position rms", ("position_rms_m",), 100.0, "cm"),
    Measure("95 %", ("position_p95_m",), 100.0, "cm"),
    Measure("largest", ("position_max_m",), 100.0, "cm"),
    Measure("vertical rms", ("vertical_rms_m",), 100.0, "cm"),
    Measure("heading rms", ("heading_rms_rad",), 57.29577951308232, "deg"),
    Measure("settled", ("settled_at_s",), 1.0, "s"),
    Measure("tilt", ("tilt_max_rad",), 57.29577951308232, "deg"),
    Measure("state age", ("state_age_ms", "p50"), 1.0, "ms"),
    Measure("step 99 %", ("step_us", "p99"), 0.001, "ms"),
    Measure("late", ("late_steps",), 1.0, ""),
    Measure("lost", ("lost_setpoints",), 1.0, ""),
)


def value_of(summary: Mapping[str, Any], measure: Measure) -> float | None:
    """The measure in its unit; None where the flight has none."""
    found: Any = summary
    for key in measure.path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return float(found) * measure.scale if isinstance(found, int | float) else None


def table(flights: Sequence[Path | FlightSource]) -> list[dict[str, Any]]:
    """One entry per flight: folder (or log), trajectory, vehicle, controller, verdict and every measure by its title.

    Raises:
        InputError: one holds no flight.
    """
    rows = []
    for flight in flights:
        summary = read_source_summary(flight) if isinstance(flight, Path) else flight.summary
        row: dict[str, Any] = {"folder": str(flight if isinstance(flight, Path) else flight.path)}
        row |= {key: summary.get(key, "?") for key in ("trajectory", "vehicle", "verdict")}
        row["controller"] = summary.get("controller", "law")
        row |= {_heading(measure): value_of(summary, measure) for measure in MEASURES}
        rows.append(row)
    return rows


def _heading(measure: Measure) -> str:
    return f"{measure.title} [{measure.unit}]" if measure.unit else measure.title


def build_comparison(first: Path, second: Path, out: Path | None = None) -> Path:
    """Write a page with two flights side by side and return its path: `compare.html` in the first one's folder, or out.

    Raises:
        InputError: a folder holds no flight, or the page cannot be written.
    """
    flights = [read_flight(folder) for folder in (first, second)]
    names = [
        flight_name(configuration, folder) for (_, configuration), folder in zip(flights, (first, second), strict=True)
    ]
    if names[0] == names[1]:
        names = [first.resolve().name, second.resolve().name]
    drawn, sections = [], []
    for figure in FIGURES:
        keys = []
        for index, (flight, _) in enumerate(flights):
            by_law = flight.summary.get("controller", "law") == "law"
            if (figure.of_law and not by_law) or not figure.shown(flight):
                continue
            panel = {"key": f"{figure.key}-{'ab'[index]}", **figure.build(flight)}
            panel["layout"]["title"] = {
                "text": names[index],
                "font": {"size": 13},
                "x": 0.5,
                "y": 0.995,
                "yanchor": "top",
            }
            drawn.append(panel)
            keys.append(panel["key"])
        if keys:
            sections.append(section(figure.title, figure.caption, keys, figure.height_px))
    _share_ranges(drawn)
    passed = [met(flight.summary.get("verdict")) for flight, _ in flights]
    parts = {
        "TITLE": " and ".join(html.escape(name) for name in names),
        "SUBTITLE": "two flights side by side; time zooms in all figures together",
        "VERDICT": " · ".join(html.escape(str(flight.summary.get("verdict", "unknown"))) for flight, _ in flights),
        "VERDICT_CLASS": "passed" if all(passed) else "missed",
        "THRESHOLDS": notes(
            [
                f"{name}: {sentence}"
                for name, (flight, _) in zip(names, flights, strict=True)
                for sentence in flight.missing
            ]
        )
        + _measures(names, [flight.summary for flight, _ in flights]),
        "TILES": "",
        "FIGURES": "".join(sections),
        "TABLES": "",
    }
    path = out or (first if first.is_dir() else first.parent) / COMPARE_FILE
    try:
        return write_whole(path, compose(parts, drawn))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another with --out") from None


def _share_ranges(drawn: Sequence[dict[str, Any]]) -> None:
    """Give the time axes of both flights the same range, so that the same time stands at the same place."""
    axes = [panel["layout"]["xaxis"] for panel in drawn if panel["layout"].get("meta") == "time"]
    if axes:
        common = [min(axis["range"][0] for axis in axes), max(axis["range"][1] for axis in axes)]
        for axis in axes:
            axis["range"] = list(common)


def _measures(names: Sequence[str], summaries: Sequence[Mapping[str, Any]]) -> str:
    """The measures of both flights, and the second over the first."""
    rows = []
    for measure in MEASURES:
        values = [value_of(summary, measure) for summary in summaries]
        cells = [_heading(measure), *("–" if value is None else f"{value:.3g}" for value in values)]
        before, after = values
        cells.append(f"{after / before:.2f}" if before and after is not None else "–")
        rows.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>")
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in ("", *names, "second / first"))
    return f'<table class="numbers"><tr>{heads}</tr>{"".join(rows)}</table>'
