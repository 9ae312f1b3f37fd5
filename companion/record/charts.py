"""The drawing style of a report's figures: lines, axes, phases and levels, and the thinning of long series.

Everything here returns plain dictionaries in the terms of plotly.js, with arrays in them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.record.columns import TRACK_PHASE

Array = npt.NDArray[np.float64]

BUCKETS: Final = 700
"""Series are thinned to the extremes of this many pieces: about one per pixel column of a page."""

INK: Final = "#1d2939"
FAINT: Final = "#98a2b3"
GRID: Final = "#e9edf2"
BAND: Final = "#c3cedb"
AXES: Final = ("#0b6fb8", "#d9580d", "#12805c")
"""North or forward, east or right, down."""
ERRORS: Final = ("#0b6fb8", "#8250c4", "#c4337a", "#dd8a13")
"""e1 to e4."""
ALARM: Final = "#d9580d"
"""A guard that acted, a limit that was reached."""
RESET: Final = "#8250c4"
"""A reset of the autopilot's estimate."""
_MARKS_MOST: Final = 60
"""More marks than this would only colour a figure."""
_SHADE: Final = "rgba(71, 104, 145, 0.07)"
_LABELLED: Final = 0.09
_TIME: Final = "Time on the track [s]"
TIME: Final = "time"
"""Marks a layout whose x axis is zoomed together with the others of its kind."""


class Phase(NamedTuple):
    """A phase on the figures' time axis."""

    name: str
    from_s: float
    to_s: float
    reason: str


class Mark(NamedTuple):
    """Something that happened at an instant of the figures' time axis."""

    at_s: float
    colour: str
    text: str


def thin(series: Array, buckets: int = BUCKETS) -> npt.NDArray[np.intp]:
    """Indices of the rows that draw the same picture: each piece's extremes, the ends, and the borders of gaps.

    Args:
        series: shape (len, columns); NaN is a gap.
        buckets: how many pieces.
    """
    length = len(series)
    if length <= 2 * buckets:
        return np.arange(length)
    finite = np.isfinite(series)
    gaps = np.flatnonzero(np.any(finite[1:] != finite[:-1], axis=1))
    keep = [np.array([0, length - 1]), gaps, gaps + 1]
    edges = np.linspace(0, length, buckets + 1).astype(np.intp)
    low = np.where(finite, series, np.inf)
    high = np.where(finite, series, -np.inf)
    for begin, end in itertools.pairwise(edges):
        keep.append(begin + np.argmin(low[begin:end], axis=0))
        keep.append(begin + np.argmax(high[begin:end], axis=0))
    return np.unique(np.concatenate(keep))


def line(x: Array, y: Array, name: str, colour: str, **more: Any) -> dict[str, Any]:
    """A line; single precision shows the same and halves the file."""
    style = {"color": colour, "width": more.pop("width", 1.6), "dash": more.pop("dash", "solid")}
    return {
        "type": "scatter",
        "mode": "lines",
        "x": x.astype(np.float32),
        "y": y.astype(np.float32),
        "name": name,
        "line": style,
        "hovertemplate": "%{y:.4~g}",
        **more,
    }


def lines(
    time_s: Array, values: Array, names: Sequence[str], colours: Sequence[str], row: int = 1, width: float = 1.2
) -> list[Any]:
    """Several lines over the same, thinned times in one row of a figure."""
    rows = thin(values)
    axis = _axis("y", row)
    return [
        line(
            time_s[rows],
            values[rows, column],
            name,
            colour,
            width=width,
            xaxis="x",
            yaxis=axis,
            legend=_axis("legend", row),
        )
        for column, (name, colour) in enumerate(zip(names, colours, strict=True))
    ]


def _axis(kind: str, row: int) -> str:
    return kind if row == 1 else f"{kind}{row}"


def axis_style(title: str) -> dict[str, Any]:
    """An axis with this title (which says the unit)."""
    return {
        "title": {"text": title, "standoff": 6, "font": {"size": 12}},
        "gridcolor": GRID,
        "zerolinecolor": "#cfd6df",
        "zerolinewidth": 1,
        "linecolor": "#cfd6df",
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": "#cfd6df",
        "automargin": True,
        "exponentformat": "power",
    }


def base_layout() -> dict[str, Any]:
    """What all figures share."""
    return {
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "margin": {"l": 66, "r": 14, "t": 48, "b": 44},
        "hoverlabel": {"font": {"size": 12}},
    }


def time_layout(
    time_s: Array, phases: Sequence[Phase], titles: Sequence[str], marks: Sequence[Mark] = ()
) -> dict[str, Any]:
    """A layout of rows over one time axis, with a legend over each row, and phases and marks behind all of them."""
    rows = len(titles)
    gap = 0.0 if rows == 1 else 0.30 / rows
    height = (1.0 - gap * (rows - 1)) / rows
    layout = base_layout() | {"hovermode": "x unified", "meta": TIME}
    ends = [float(time_s[0]), float(time_s[-1])] if len(time_s) else [0.0, 1.0]
    layout["xaxis"] = axis_style(_TIME) | {"range": ends, "anchor": _axis("y", rows), "zeroline": False}
    for row, title in enumerate(titles, start=1):
        top = 1.0 - (row - 1) * (height + gap)
        domain = [max(top - height, 0.0), min(top, 1.0)]
        layout[_axis("yaxis", row)] = axis_style(title) | {"domain": domain, "anchor": "x"}
        layout[_axis("legend", row)] = {
            **{"orientation": "h", "x": 0, "xanchor": "left", "y": domain[1], "yanchor": "bottom"},
            **{"bgcolor": "rgba(255,255,255,0)", "font": {"size": 12}, "itemwidth": 30},
        }
    layout["shapes"], layout["annotations"] = _phase_marks(phases, ends)
    for mark in marks[:_MARKS_MOST]:
        place = {"type": "line", "x0": mark.at_s, "x1": mark.at_s, "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
        layout["shapes"].append(place | {"line": {"color": mark.colour, "width": 1}})
    return layout


def _phase_marks(phases: Sequence[Phase], ends: Sequence[float]) -> tuple[list[Any], list[Any]]:
    """A shade behind everything that is not the track, a line at each change, and the names where there is room."""
    shapes: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for phase in phases:
        place = {"yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
        if phase.name != TRACK_PHASE:
            shade = {"type": "rect", "x0": phase.from_s, "x1": phase.to_s, "fillcolor": _SHADE, "line": {"width": 0}}
            shapes.append(place | shade)
        if phase.from_s > ends[0]:
            style = {"color": FAINT, "width": 1, "dash": "dot"}
            shapes.append(place | {"type": "line", "x0": phase.from_s, "x1": phase.from_s, "line": style})
        if phase.to_s - phase.from_s >= _LABELLED * (ends[1] - ends[0]):
            annotations.append(
                {
                    **{"text": phase.name, "hovertext": f"{phase.name}: {phase.reason}", "showarrow": False},
                    **{"x": phase.to_s, "xanchor": "right", "y": 1, "yref": "paper", "yanchor": "top"},
                    "font": {"size": 11, "color": "#667085"},
                }
            )
    return shapes, annotations


def add_level(layout: dict[str, Any], value: float, text: str, row: int = 1, colour: str = INK) -> None:
    """Draw a dashed horizontal line across a row, with its label at the right end."""
    axis = _axis("y", row)
    style = {"color": colour, "width": 1, "dash": "dash"}
    layout["shapes"].append(
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": axis, "y0": value, "y1": value, "line": style}
    )
    # On a logarithmic axis shapes take the value, but annotations its logarithm.
    height = math.log10(value) if layout[_axis("yaxis", row)].get("type") == "log" else value
    layout["annotations"].append(
        {
            **{"text": text, "showarrow": False, "xref": "paper", "x": 0.995, "yref": axis},
            **{"y": height, "xanchor": "right", "yanchor": "bottom"},
            "font": {"size": 11, "color": colour},
        }
    )


def logarithmic(values: Array) -> dict[str, Any]:
    """An axis over whole decades that leaves out the rare dips towards zero."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if not len(positive):
        return {"type": "log"}
    low = math.floor(math.log10(float(np.percentile(positive, 2.0))))
    high = math.log10(float(positive.max())) + 0.15
    return {"type": "log", "range": [min(low, high - 1.0), high], "dtick": 1}
