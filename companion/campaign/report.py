"""A campaign's page: one self-contained HTML file, like a flight's report."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from companion.campaign import pictures
from companion.campaign.outcome import MEASURES, RAISED
from companion.campaign.sensitivity import Sensitivity
from companion.campaign.store import REPORT_FILE, SUMMARY_FILE, open_folder, read_flights
from companion.campaign.study import Study
from companion.campaign.summary import summarise
from companion.errors import InputError
from companion.record.folder import write_whole
from companion.record.page import compose

BANDS_MAX = 20_000
"""Flights whose error over time goes into the bands; of larger campaigns every n-th."""
_TALL_PX, _LOW_PX = 420, 340


def write_report(folder: Path) -> Path:
    """Write the page of a campaign, finished or not, and return its path.

    Raises:
        InputError: there are no flights, or the page cannot be written.
    """
    study = open_folder(folder)
    columns = ["flight", "ended", "reason", "converged", "certified", *study.spreads, *MEASURES]
    table = read_flights(folder, columns)
    path = folder / REPORT_FILE
    summary = _summary(study, folder)
    figures, sections = _figures(study, folder, table, summary)
    share = 100.0 * summary["converged_share"]
    whole = len(table) == study.total
    parts = {
        "KIND": "Campaign",
        "TITLE": html.escape(study.name),
        "SUBTITLE": f"<b>{len(table)}</b> simulated flights of <b>{html.escape(study.flight.name)}</b> on"
        f" <b>{html.escape(study.flight.vehicle.name)}</b>, seed {study.file.seed}"
        + ("" if whole else f"; {study.total - len(table)} are still to be flown"),
        "VERDICT": f"{share:.1f} % converged",
        "VERDICT_CLASS": "passed" if summary["converged"] == len(table) else "missed",
        "THRESHOLDS": f"<p>Converged: the position error stays below {study.file.converged.below_m:g} m until the end."
        f" The share is {100 * summary['converged_share_95'][0]:.1f} to {100 * summary['converged_share_95'][1]:.1f} %"
        " with 95 % confidence.</p>",
        "TILES": _tiles(summary),
        "FIGURES": "".join(sections),
        "TABLES": _varied(study) + _worst(folder, table, summary),
    }
    try:
        write_whole(path, compose(parts, figures))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def _summary(study: Study, folder: Path) -> dict[str, Any]:
    path = folder / SUMMARY_FILE
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found
    return summarise(study, folder)


def _figures(
    study: Study, folder: Path, table: Any, summary: dict[str, Any]
) -> tuple[list[pictures.Figure], list[str]]:
    figures: list[pictures.Figure] = []
    sections: list[str] = []

    def add(title: str, caption: str, found: Sequence[pictures.Figure | None], height_px: int) -> None:
        there = [figure for figure in found if figure is not None]
        if not there:
            return
        figures.extend(there)
        plots = "".join(f'<div class="plot" id="{f["key"]}" style="height:{height_px}px"></div>' for f in there)
        sections.append(
            f'<section class="figure"><h2>{html.escape(title)}</h2><p class="caption">{html.escape(caption)}</p>'
            f'<div class="plots">{plots}</div></section>\n'
        )

    for index, picture in enumerate(study.file.slices):
        add(
            f"Where it converges: {picture.x} and {picture.y}",
            "Left: share of the flights of each cell that converged; all other variables are drawn as the study says."
            " Right: the flights themselves.",
            [
                pictures.slice_share(study, table, picture, f"slice_{index}"),
                pictures.slice_flights(table, picture, f"flights_{index}"),
            ],
            _TALL_PX,
        )
    planned_s = _planned_s(study, table)
    step = max(1, len(table) // BANDS_MAX)
    errors = read_flights(folder, ["ended", "error_m"])
    some = errors if step == 1 else errors.take(list(range(0, len(errors), step)))
    add(
        "The error over time",
        "Percentiles over all flights; one that has ended counts as infinitely far. Dotted: the bound of convergence.",
        [pictures.bands(study, some, planned_s)] if planned_s is not None else [],
        _TALL_PX,
    )
    ranked = {
        name: [Sensitivity(**row) for row in summary["sensitivity"][name]]
        for name in ("converged", "rms_m", "saturated_s")
    }
    bars = max((len(rows) for rows in ranked.values()), default=0)
    add(
        "What matters",
        "Spearman's rank correlation with the effect of the other variables taken out. Positive: more of it, more of"
        " the outcome. Within the grey band it may be chance. Hatched: by the distance from the"
        " variable's median, to either side.",
        [pictures.sensitivities({k: v for k, v in ranked.items() if v})],
        120 + 44 * bars,
    )
    add(
        "Error against actuation",
        "Every flight by its gains; the line joins those of certified gain sets that no other beats in both.",
        [pictures.pareto(study, table)],
        _TALL_PX,
    )
    add("How many are below", "Of all flights, those without a value among them.",
        pictures.shares(table, ("settled_at_s", "rms_m", "saturated_s", "tilt_max_rad")), _LOW_PX)  # fmt: skip
    return figures, sections


def _planned_s(study: Study, table: Any) -> float | None:
    """Length of the flights' time axis: that of the first one that was flown; of a study that varies it, about.

    None: none was flown.
    """
    from companion.campaign.whole import clock_of, course_of, simulated

    flown = (number for number, ended in zip(table["flight"], table["ended"], strict=True) if ended.as_py() != RAISED)
    first = next(flown, None)
    if first is None:
        return None
    case = study.case(first.as_py())
    course = course_of(case, clock_of(case, simulated(case.vehicle)))
    return min(course.duration_s, case.duration_s)


def _tiles(summary: dict[str, Any]) -> str:
    tiles = [
        ("converged", f"{summary['converged']} of {summary['flights']}", "flights"),
        *((kind, str(count), "flights") for kind, count in summary["ended"].items() if kind != "flown"),
    ]
    for name, percent in (("settled_at_s", "p50"), ("rms_m", "p50"), ("rms_m", "p95"), ("saturated_s", "p50"),
                          ("thrust_min_n", "p5"), ("tilt_max_rad", "p95")):  # fmt: skip
        found = summary["measures"][name]
        if found is not None:
            tiles.append((MEASURES[name].meaning, f"{found[percent]:.3g} {MEASURES[name].unit}", _percent(percent)))
    return "".join(
        f'<div class="tile"><span>{html.escape(name)}</span><b>{html.escape(value)}</b><small>{note}</small></div>'
        for name, value, note in tiles
    )


def _percent(name: str) -> str:
    return "median" if name == "p50" else f"{name[1:]} % are below"


def _varied(study: Study) -> str:
    rows = []
    for name, spread in study.spreads.items():
        value = getattr(spread, spread.kind)
        numbers = (
            ", ".join(f"{x:g}" if isinstance(x, float | int) else str(x) for x in value)
            if isinstance(value, tuple)
            else f"{value}"
        )
        cells = (name, f"{spread.kind} {numbers}", pictures.meaning(name))
        rows.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>")
    return (
        '<section class="listing"><h3>What is varied</h3><table><tr><th>Variable</th><th>Spread</th><th></th></tr>'
        + "".join(rows)
        + "</table></section>"
    )


def _worst(folder: Path, table: Any, summary: dict[str, Any]) -> str:
    numbers = list(table["flight"].to_pylist())
    rows = []
    for number in summary["worst"]:
        place = numbers.index(number)
        reason = table["reason"][place].as_py()
        rms = table["rms_m"][place].as_py()
        what = "converged" if table["converged"][place].as_py() else table["ended"][place].as_py()
        text = reason or (f"rms {rms:.3g} m" if isfinite(rms) else what)
        rows.append(f"<tr><td>{number}</td><td>{html.escape(what)}</td><td>{html.escape(text)}</td></tr>")
    shown = html.escape(f"companion campaign replay {folder} {summary['worst'][0]}")
    return (
        '<section class="listing"><h3>To look at first</h3><table><tr><th>Flight</th><th></th><th></th></tr>'
        + "".join(rows)
        + f"</table><p><code>{shown}</code></p></section>"
    )
