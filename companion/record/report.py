"""`report.html`: a flight on one page that opens offline, on a phone, and in print."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.errors import InputError
from companion.record.columns import LIMIT_NAMES, TRACK_PHASE
from companion.record.figures import FIGURES
from companion.record.flight_data import FlightData
from companion.record.flight_log import envelope
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import FlightSource, read_source
from companion.record.folder import write_whole
from companion.record.page import compose
from companion.record.summary import met
from companion.record.ulog import Level

REPORT_FILE: Final = "report.html"
_ROTORS: Final = 4
_MESSAGES_SHOWN: Final = 200


def build_report(flown: FlightSource | Path, out: Path | None = None) -> Path:
    """Write `report.html` (or `out`) of a flight and return its path; a log's page stands beside it, under its name.

    Args:
        flown: the flight, or its folder or log. Of a folder `record.npz` and `summary.json` are read, or `flight.ulg`
            where they are missing; `flight.toml` (thresholds, limits, gains, mass) and `truth.csv` when they are there.
        out: the page.

    Raises:
        InputError: a file is missing that must be there, or one cannot be read, or the report cannot be written.
    """
    flight, configuration = read_flight(flown)
    source = flown if isinstance(flown, Path) else flown.path
    page = _page(flight_name(configuration, source), flight, configuration)
    path = out or (source / REPORT_FILE if source.is_dir() else source.with_suffix(".html"))
    try:
        return write_whole(path, page)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); name another with --out") from None


def read_flight(flown: FlightSource | Path) -> tuple[FlightData, dict[str, Any]]:
    """What a flight's folder or log holds, and its configuration. Raises InputError."""
    read = read_source(flown) if isinstance(flown, Path) else flown
    configuration = read.configuration
    mass_kg = next((value for value in _find(configuration, "mass_kg") if isinstance(value, int | float)), None)
    gains = _merged(configuration, "controller")
    flight = FlightData(
        record=read.record,
        summary=read.summary,
        truth=read.truth,
        mass_kg=None if mass_kg is None else float(mass_kg),
        limits=_merged(configuration, "limits"),
        thrust_full_n=_rotors(configuration)[0],
        curve_factor=_rotors(configuration)[1],
        missing=read.missing,
        gains=gains,
        envelope_m2=_envelope(read.record, configuration),
        battery=read.battery,
        messages=read.messages,
        guards=_guard_sentences(),
    )
    return flight, configuration


def _envelope(record: FlightRecord, configuration: Mapping[str, Any]) -> float:
    """The envelope of the Lyapunov function, as the log has it: from the first step."""
    if not len(record):
        return math.nan
    b_hat = record.columns("b_hat_n", "b_hat_e", "b_hat_d")[0]
    return envelope(configuration, float(record.column("lyapunov")[0]), [float(x) for x in b_hat])


def _guard_sentences() -> frozenset[str]:
    from companion.flight.guards import Guard

    return frozenset(guard.value.cause.value.sentence for guard in Guard)


def flight_name(configuration: Mapping[str, Any], source: Path) -> str:
    """What the flight file calls the flight, or the name of its folder or log."""
    flight = configuration.get("flight")
    for table in (configuration, flight if isinstance(flight, Mapping) else {}):
        if isinstance(name := table.get("name"), str) and name:
            return name
    return source.resolve().name


# --- the configuration -----------------------------------------------------------------------------------------------


def _find(configuration: Mapping[str, Any], key: str) -> Iterator[Any]:
    """Every value with this key, however deep: the outer ones first."""
    if key in configuration:
        yield configuration[key]
    for value in configuration.values():
        if isinstance(value, Mapping):
            yield from _find(value, key)


def _merged(configuration: Mapping[str, Any], key: str) -> dict[str, Any]:
    """All tables with this name as one; the outer ones win, as a flight file wins over its vehicle's."""
    merged: dict[str, Any] = {}
    for table in reversed([found for found in _find(configuration, key) if isinstance(found, Mapping)]):
        merged.update(table)
    return merged


def _rotors(configuration: Mapping[str, Any]) -> tuple[float | None, float]:
    """Full thrust of all rotors [N], if known, and the factor of their thrust curve."""
    rotors = _merged(configuration, "rotors")
    most, curve = rotors.get("thrust_max_n"), rotors.get("curve_factor")
    full_n = _ROTORS * float(most) if isinstance(most, int | float) else None
    return full_n, float(curve) if isinstance(curve, int | float) else 0.0


# --- the page --------------------------------------------------------------------------------------------------------


def _page(name: str, flight: FlightData, configuration: Mapping[str, Any]) -> str:
    figures, sections = _figures(flight)
    verdict = str(flight.summary.get("verdict", "unknown"))
    parts = {
        "TITLE": html.escape(name),
        "SUBTITLE": _subtitle(flight.summary),
        "VERDICT": html.escape(verdict),
        "VERDICT_CLASS": "passed" if met(verdict) else "missed",
        "THRESHOLDS": notes(flight.missing) + _thresholds(flight.summary, _merged(configuration, "acceptance")),
        "TILES": _tiles(flight.summary),
        "FIGURES": sections,
        "TABLES": _tables(flight, configuration),
    }
    return compose(parts, figures)


def _figures(flight: FlightData) -> tuple[list[dict[str, Any]], str]:
    """What plotly.js draws, by the id of the element, and the sections with these elements."""
    drawn: list[dict[str, Any]] = []
    sections = []
    by_law = _by_law(flight.summary)
    for figure in FIGURES:
        if (figure.of_law and not by_law) or not figure.shown(flight):
            continue
        panels = [{"key": figure.key, **figure.build(flight)}]
        if figure.close is not None and (close := figure.close(flight)) is not None:
            panels.append({"key": f"{figure.key}-close", **close})
        sections.append(section(figure.title, figure.caption, [panel["key"] for panel in panels], figure.height_px))
        drawn += panels
    return drawn, "".join(sections)


def section(title: str, caption: str, keys: Sequence[str], height_px: int) -> str:
    """A figure's place on the page: a title, a caption, and an element for each of its panels."""
    plots = "".join(f'<div class="plot" id="{key}" style="height:{height_px}px"></div>' for key in keys)
    return (
        f'<section class="figure"><h2>{html.escape(title)}</h2>'
        f'<p class="caption">{html.escape(caption)}</p><div class="plots">{plots}</div></section>\n'
    )


def notes(missing: Sequence[str]) -> str:
    """What could not be read; nothing when all was."""
    if not missing:
        return ""
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in missing)
    return f'<div class="missing"><b>Not everything could be read.</b><ul>{items}</ul></div>'


def _by_law(summary: Mapping[str, Any]) -> bool:
    """Whether the law flew; else there are no numbers of it."""
    return bool(summary.get("controller", "law") == "law")


def _subtitle(summary: Mapping[str, Any]) -> str:
    rate = summary.get("control_rate_hz")
    words = [
        f"trajectory <b>{html.escape(str(summary.get('trajectory', '?')))}</b>",
        f"vehicle <b>{html.escape(str(summary.get('vehicle', '?')))}</b>",
        "by <b>the law</b>" if _by_law(summary) else "by <b>PX4's own position controller</b>",
        f"{_number(summary.get('duration_s'))} s of tracking",
    ]
    if rate:
        words.append(f"{_number(rate)} Hz")
    return " · ".join(words)


def _thresholds(summary: Mapping[str, Any], acceptance: Mapping[str, Any]) -> str:
    """Each threshold with what was reached."""
    if not acceptance:
        return "<p>The flight file sets no thresholds.</p>"
    rows = []
    for key, most in acceptance.items():
        if not isinstance(most, int | float):
            continue
        value = summary.get(key)
        good = isinstance(value, int | float) and value <= most
        cells = f"<td>{html.escape(key)}</td><td>{_number(value)}</td><td>{_number(most)}</td>"
        rows.append(f'<tr class="{"good" if good else "bad"}">{cells}<td>{"met" if good else "missed"}</td></tr>')
    head = "<tr><th>Threshold</th><th>reached</th><th>allowed</th><th></th></tr>"
    return f'<table class="numbers">{head}{"".join(rows)}</table>'


def _tiles(summary: Mapping[str, Any]) -> str:
    """The summary as a grid of figures."""
    window = f"from {_number(summary.get('statistics_from_s'))} s to the end"
    age, step = summary.get("state_age_ms") or {}, summary.get("step_us") or {}
    disturbance = summary.get("disturbance_m_s2") or []
    tilt = summary.get("tilt_max_rad")
    heading = summary.get("heading_rms_rad")
    tiles = [
        ("Position error, rms", _length(summary.get("position_rms_m")), window),
        ("Whole track, rms", _length(summary.get("track_rms_m")), "the way to the path included"),
        ("95 % of the time below", _length(summary.get("position_p95_m")), window),
        ("Largest", _length(summary.get("position_max_m")), window),
        ("Vertical error, rms", _length(summary.get("vertical_rms_m")), window),
        ("Settled after", _settled(summary.get("settled_at_s")), "below 0.2 m from then on"),
        ("Heading error, rms", "free" if heading is None else _with(math.degrees(heading), "°"), window),
        ("Sideways speed, rms", _length(summary.get("body_sideways_rms_m_s"), "/s"), window),
        (
            "Disturbance",
            ", ".join("–" if value is None else f"{round(value, 2) + 0.0:.2f}" for value in disturbance) or "–",
            "m/s², north, east, down",
        ),
        (
            "Thrust",
            f"{_number(summary.get('thrust_min_n'), 3)} – {_number(summary.get('thrust_max_n'), 3)} N",
            "whole track",
        ),
        ("Largest tilt", "–" if tilt is None else _with(math.degrees(tilt), "°"), "whole track"),
        ("State age", _with(age.get("p50"), "ms"), f"99 %: {_number(age.get('p99'))} ms"),
        ("Control step", _with(step.get("p50"), "µs"), f"99 %: {_number(step.get('p99'))} µs"),
        ("Steps", f"{summary.get('steps', 0)}", f"{summary.get('late_steps', 0)} late"),
        ("Lost setpoints", f"{summary.get('lost_setpoints', 0)}", "states that got no answer"),
    ]
    if not _by_law(summary):
        tiles = [entry for entry in tiles if entry[0] not in {"Disturbance", "Thrust"}]
    return "".join(tile(*map(html.escape, entry)) for entry in tiles)


def tile(label: str, value: str, note: str) -> str:
    """A figure with what it is, as HTML; the arguments are HTML."""
    return f'<div class="tile"><span>{label}</span><b>{value}</b><small>{note}</small></div>'


def _tables(flight: FlightData, configuration: Mapping[str, Any]) -> str:
    """Phases, limits and gains."""
    phases = [
        (entry["name"], _number(None if entry["at_s"] is None else entry["at_s"] - flight.start_s), entry["reason"])
        for entry in flight.summary.get("phases", [])
    ]
    reached = [(LIMIT_NAMES[bit], share) for bit, share in _limit_shares(flight.record)]
    tables = [listing("Phases", ("phase", "from, s", "because"), phases)]
    said = [
        (_number(message.at_s - flight.start_s), message.text)
        for message in flight.messages
        if flight.kind_of(message) and message.level <= Level.NOTICE
    ]
    tables.append(listing("Messages", ("at, s", "text"), said[-_MESSAGES_SHOWN:]))
    if _by_law(flight.summary):
        gains = listing("Gains used", ("gain", "value"), _settings(_merged(configuration, "controller")))
        tables.append(listing("Limits reached on the track", ("limit", "share of the steps"), reached, empty="None."))
    else:
        read = flight.summary.get("px4_parameters", {})
        gains = listing("Parameters of PX4's controller", ("parameter", "value"), _settings(read))
    return "".join((*tables, listing("Limits used", ("limit", "value"), _settings(flight.limits)), gains))


def _limit_shares(record: FlightRecord) -> list[tuple[int, str]]:
    """The limits that acted on the track, and for how much of it."""
    values = record.column("limits")[record.in_phase(TRACK_PHASE)]
    bits = np.where(np.isfinite(values), values, 0.0).astype(np.int64)
    counts = [(bit, int(np.count_nonzero(bits & bit))) for bit in LIMIT_NAMES]
    return [(bit, f"{100.0 * count / len(bits):.2g} %") for bit, count in counts if count]


def _settings(table: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(key, _setting(value)) for key, value in table.items() if not isinstance(value, Mapping)]


def _setting(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(_setting(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def listing(title: str, head: Sequence[str], rows: Sequence[Sequence[str]], empty: str = "") -> str:
    """A titled table; nothing at all when it has no rows and nothing to say about that."""
    if not rows and not empty:
        return ""
    heads = "".join(f"<th>{html.escape(word)}</th>" for word in head)
    lines = "".join("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    body = f"<table><tr>{heads}</tr>{lines}</table>" if rows else f"<p>{html.escape(empty)}</p>"
    return f'<section class="listing"><h3>{html.escape(title)}</h3>{body}</section>\n'


def _number(value: object, digits: int = 4) -> str:
    return f"{value:.{digits}g}" if isinstance(value, int | float) else "–"


def _with(value: object, unit: str) -> str:
    if not isinstance(value, int | float):
        return "–"
    return f"{_number(value, 3)}{'' if unit == '°' else ' '}{unit}"


def _settled(value: object) -> str:
    """A time at which the flight was within its bound from the start is nought, not some microseconds."""
    return f"{value:.2f} s" if isinstance(value, int | float) else "–"


def _length(value: object, per: str = "") -> str:
    """A length in the unit that people would use for it."""
    if not isinstance(value, int | float):
        return "–"
    if value < 0.01:
        return f"{1000.0 * value:.2g} mm{per}"
    return f"{100.0 * value:.3g} cm{per}" if value < 1.0 else f"{value:.3g} m{per}"
