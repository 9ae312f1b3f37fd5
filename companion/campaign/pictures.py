"""A campaign's pictures, in the terms of plotly.js: where it converges, what matters, how the error goes, its cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.campaign.outcome import BINS, MEASURES
from companion.campaign.sensitivity import Sensitivity
from companion.campaign.study import Slice, Study
from companion.campaign.variables import VARIABLES
from companion.record.charts import AXES, FAINT, GRID, INK, axis_style, base_layout

FloatArray = NDArray[np.float64]
Figure = dict[str, Any]

CELLS_MIN, CELLS_MAX, FLIGHTS_PER_CELL = 5, 20, 12
"""Cells of a slice along each axis, where the variable is not on a grid: so many that each has some flights."""
POINTS_MAX: Final = 4000
"""Flights that are drawn one by one."""
GOOD, SLOW, BAD, GROUND = "#12805c", "#dd8a13", "#b42318", "#6b4e16"
KINDS: Final = (
    ("converged", GOOD),
    ("not settled", SLOW),
    ("diverged", BAD),
    ("ground", GROUND),
    ("raised", FAINT),
)
_SHARES: Final = [[0.0, "#b42318"], [0.25, "#e58a5b"], [0.5, "#f3d9a4"], [0.75, "#8cc7a6"], [1.0, "#12805c"]]


def label(name: str) -> str:
    """A variable or measure with its unit, for an axis."""
    if name in MEASURES:
        unit = MEASURES[name].unit
        ending = "_" + unit.replace("/", "_").replace("^", "").lower()
        return f"{name.removesuffix(ending).replace('_', ' ')} [{unit}]"
    section, _, key = name.partition(".")
    for ending, unit in (("_rad_s", "rad/s"), ("_m_s", "m/s"), ("_deg", "°"), ("_1_s3", "1/s³"), ("_1_s", "1/s"),
                         ("_m", "m"), ("_n", "N"), ("_s", "s")):  # fmt: skip
        if key.endswith(ending):
            return f"{section}: {key.removesuffix(ending).replace('_', ' ')} [{unit}]"
    return f"{section}: {key.replace('_', ' ')}"


def kinds(table: Any) -> NDArray[np.str_]:
    """What became of each flight, one of KINDS."""
    ended = np.array(table["ended"].to_pylist(), dtype=object)
    converged = table["converged"].to_numpy()
    return np.where(converged, "converged", np.where(ended == "flown", "not settled", ended)).astype(str)


def bands(study: Study, table: Any, planned_s: float) -> Figure:
    """Percentiles of the error over time; a flight that has ended counts as infinitely far."""
    errors = np.stack(table["error_m"].to_numpy()).astype(np.float64).reshape(-1, BINS)
    seen = np.isfinite(errors)
    last = BINS - np.argmax(seen[:, ::-1], axis=1)  # nothing is seen after it
    after = np.arange(BINS)[None, :] >= np.where(seen.any(axis=1), last, 0)[:, None]
    flown = np.array(table["ended"].to_pylist(), dtype=object) == "flown"
    errors = np.where(seen, errors, np.where(after & ~flown[:, None], np.inf, np.nan))
    usable = seen.any(axis=0)
    t = ((np.arange(BINS) + 0.5) * planned_s / BINS)[usable]
    with np.errstate(invalid="ignore"):
        found = np.nanpercentile(errors[:, usable], [5, 25, 50, 75, 95], axis=0, method="lower")
    found = np.where(np.isfinite(found), found, np.nan)
    data: list[Figure] = []
    for low, high, colour, name in (
        (0, 4, "rgba(11,111,184,0.16)", "5 to 95 %"),
        (1, 3, "rgba(11,111,184,0.30)", "25 to 75 %"),
    ):
        top = np.where(np.isfinite(found[high]), found[high], study.file.diverged_m)
        data.append(_line(t, found[low], "", "rgba(0,0,0,0)") | {"showlegend": False, "hoverinfo": "skip"})
        data.append(
            _line(t, top, name, "rgba(0,0,0,0)") | {"fill": "tonexty", "fillcolor": colour, "hoverinfo": "skip"}
        )
    data.append(_line(t, found[2], "median", AXES[0]) | {"line": {"color": AXES[0], "width": 2}})
    layout = base_layout() | {"legend": _legend()}
    layout["xaxis"] = axis_style("Time since the law took over [s]")
    layout["yaxis"] = axis_style("Position error [m]") | {"type": "log"}
    layout["shapes"] = [_level(study.file.converged.below_m)]
    return {"key": "bands", "data": data, "layout": layout}


def _edges(study: Study, name: str, values: FloatArray) -> FloatArray:
    """Borders of the cells of a slice along one variable."""
    grid = study.grid.get(name)
    if grid is not None and len(grid) > 1:
        step = grid[1] - grid[0]
        return np.array([grid[0] - step / 2, *(x + step / 2 for x in grid)])
    cells = min(max(CELLS_MIN, int((len(values) / FLIGHTS_PER_CELL) ** 0.5)), CELLS_MAX)
    return np.linspace(float(values.min()), float(values.max()), cells + 1)


def slice_share(study: Study, table: Any, picture: Slice, key: str) -> Figure:
    """Share of the flights of each cell that converged."""
    x, y = (np.asarray(table[name].to_numpy(), dtype=np.float64) for name in (picture.x, picture.y))
    converged = table["converged"].to_numpy()
    bins = (_edges(study, picture.x, x), _edges(study, picture.y, y))
    count = np.histogram2d(x, y, bins=bins)[0]
    good = np.histogram2d(x[converged], y[converged], bins=bins)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 100.0 * good / count
    centres = [0.5 * (b[1:] + b[:-1]) for b in bins]
    text = [
        [f"{g:.0f} of {c:.0f} flights" for g, c in zip(a, b, strict=True)] for a, b in zip(good.T, count.T, strict=True)
    ]
    heat = {
        "type": "heatmap",
        "x": centres[0],
        "y": centres[1],
        "z": [[None if not np.isfinite(v) else float(v) for v in row] for row in share.T],
        "zmin": 0,
        "zmax": 100,
        "colorscale": _SHARES,
        "colorbar": {"title": {"text": "%", "side": "top"}, "thickness": 12, "len": 0.9},
        "text": text,
        "hovertemplate": "%{z:.0f} %: %{text}<extra></extra>",
        "xgap": 1,
        "ygap": 1,
    }
    return {"key": key, "data": [heat], "layout": _plane(picture)}


def slice_flights(table: Any, picture: Slice, key: str) -> Figure:
    """Every flight (at most POINTS_MAX) at its place, by what became of it."""
    what = kinds(table)
    step = max(1, len(what) // POINTS_MAX)
    x, y = (np.asarray(table[name].to_numpy(), dtype=np.float64)[::step] for name in (picture.x, picture.y))
    numbers = table["flight"].to_numpy()[::step]
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "x": x[chosen],
            "y": y[chosen],
            "name": kind,
            "text": [f"flight {n}" for n in numbers[chosen]],
            "hovertemplate": "%{text}: %{x:.4g}, %{y:.4g}<extra></extra>",
            "marker": {"color": colour, "size": 4, "opacity": 0.7},
        }
        for kind, colour in KINDS
        if (chosen := what[::step] == kind).any()
    ]
    return {"key": key, "data": data, "layout": _plane(picture) | {"legend": _legend()}}


def sensitivities(found: dict[str, Sequence[Sensitivity]]) -> Figure | None:
    """Partial rank correlations as bars, one colour per outcome; None where nothing can be said."""
    outcomes = [(name, list(rows)) for name, rows in found.items() if rows]
    if not outcomes:
        return None
    strength: dict[str, float] = {}
    for _, rows in outcomes:
        for row in rows:
            strength[row.variable] = max(strength.get(row.variable, 0.0), abs(row.partial))
    order = sorted(strength, key=strength.__getitem__)
    data = []
    for (name, rows), colour in zip(outcomes, (GOOD, AXES[0], SLOW), strict=False):
        by_name = {row.variable: row for row in rows}
        shown = [v for v in order if v in by_name]
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "y": [v.replace("_", " ") for v in shown],
                "x": [by_name[v].partial for v in shown],
                "name": {"converged": "convergence", "track_rms_m": "rms of the track"}.get(
                    name, name.replace("_", " ")
                ),
                "marker": {
                    "color": colour,
                    "pattern": {"shape": ["/" if by_name[v].by_distance else "" for v in shown], "size": 6},
                },
                "text": ["by its distance from the median" if by_name[v].by_distance else "" for v in shown],
                "textposition": "none",
                "hovertemplate": "%{y}: %{x:.2f} %{text}<extra></extra>",
            }
        )
    noise = max(rows[0].noise for _, rows in outcomes)
    layout = base_layout() | {"barmode": "group", "legend": _legend(), "hovermode": "closest"}
    layout["xaxis"] = axis_style("Partial rank correlation") | {"range": [-1, 1]}
    layout["yaxis"] = axis_style("") | {
        "ticks": "",
        "automargin": True,
        "categoryarray": [v.replace("_", " ") for v in order],
    }
    band = {"type": "rect", "xref": "x", "yref": "paper", "x0": -noise, "x1": noise, "y0": 0, "y1": 1, "layer": "below"}
    layout["shapes"] = [band | {"fillcolor": GRID, "line": {"width": 0}}]
    return {"key": "sensitivity", "data": data, "layout": layout}


def front(error: FloatArray, cost: FloatArray) -> NDArray[np.intp]:
    """Rows that no other beats in both, in the order of the cost."""
    usable = np.flatnonzero(np.isfinite(error) & np.isfinite(cost))
    order = usable[np.lexsort((error[usable], cost[usable]))]
    best = np.minimum.accumulate(np.concatenate([[np.inf], error[order]]))[:-1]
    return np.asarray(order[error[order] < best])


def pareto(study: Study, table: Any) -> Figure | None:
    """Error against actuation where gains are varied; None where they are not."""
    gains = [name for name in study.varied if name.startswith("controller.")]
    if not gains or study.file.pareto == "none":
        return None
    error, cost = table["rms_m"].to_numpy(), table["actuation_rad_s2"].to_numpy()
    certified = table["certified"].to_numpy()
    good = np.isfinite(error) & np.isfinite(cost)
    texts = np.array(
        [
            f"flight {row['flight']}<br>" + "<br>".join(f"{name.partition('.')[2]} = {row[name]:.3g}" for name in gains)
            for row in table.select(["flight", *gains]).to_pylist()
        ],
        dtype=object,
    )
    data: list[Figure] = []
    for name, chosen, colour in (("not certified", good & ~certified, FAINT), ("certified", good & certified, AXES[0])):
        rows = np.flatnonzero(chosen)
        rows = rows[:: max(1, len(rows) // POINTS_MAX)]
        marker = {"color": colour, "size": 5, "opacity": 0.6}
        data.append(_points(cost[rows], error[rows], name, marker, list(texts[rows])))
    best = front(np.where(certified, error, np.nan), cost)
    data.append(
        _points(cost[best], error[best], "front of the certified", {"color": BAD, "size": 7}, list(texts[best]))
        | {"mode": "lines+markers", "line": {"color": BAD, "width": 1.4, "shape": "hv"}}
    )
    layout = base_layout() | {"legend": _legend()}
    layout["xaxis"] = axis_style("Actuation: rms of the commanded angular acceleration [rad/s²]") | {"type": "log"}
    layout["yaxis"] = axis_style("Position error rms after settling [m]") | {"type": "log"}
    return {"key": "pareto", "data": data, "layout": layout}


def shares(table: Any, names: Sequence[str]) -> list[Figure]:
    """For each measure: which share of all flights is below a value."""
    found = []
    for name in names:
        values = table[name].to_numpy()
        finite = np.sort(values[np.isfinite(values)])
        if not len(finite):
            continue
        rows = np.unique(np.linspace(0, len(finite) - 1, 400).astype(np.intp))
        share = 100.0 * (rows + 1.0) / len(values)
        layout = base_layout() | {"showlegend": False}
        spread = finite[-1] > 50.0 * max(finite[0], 1e-9) and finite[0] > 0.0
        layout["xaxis"] = axis_style(label(name)) | ({"type": "log"} if spread else {})
        layout["yaxis"] = axis_style("Share of all flights below [%]") | {"range": [0, 101]}
        found.append({"key": f"share_{name}", "data": [_line(finite[rows], share, name, AXES[0])], "layout": layout})
    return found


def _points(x: FloatArray, y: FloatArray, name: str, marker: Figure, text: list[str]) -> Figure:
    hover = "%{text}<br>%{y:.4g} m at %{x:.4g} rad/s²<extra></extra>"
    return {"type": "scatter", "mode": "markers", "x": x, "y": y, "name": name, "marker": marker, "text": text,
            "hovertemplate": hover}  # fmt: skip


def _line(x: FloatArray, y: FloatArray, name: str, colour: str) -> Figure:
    return {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": name, "line": {"color": colour, "width": 1.6},
            "hovertemplate": "%{y:.4~g}"}  # fmt: skip


def _level(y: float) -> Figure:
    line = {"color": INK, "width": 1, "dash": "dot"}
    return {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "line": line}


def _legend() -> Figure:
    return {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "bgcolor": "rgba(255,255,255,0)"}


def _plane(picture: Slice) -> Figure:
    layout = base_layout() | {"hovermode": "closest"}
    layout["xaxis"] = axis_style(label(picture.x)) | {"zeroline": False}
    layout["yaxis"] = axis_style(label(picture.y)) | {"zeroline": False}
    return layout


def meaning(name: str) -> str:
    """What a variable is, for people."""
    return VARIABLES[name].meaning if name in VARIABLES else "name"
