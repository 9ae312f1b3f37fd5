"""The path against its reference: from above, and in space."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from companion.record.charts import AXES, BAND, INK, Array, axis_style, base_layout, line, thin
from companion.record.columns import TRACK_PHASE
from companion.record.flight_data import FlightData

_SPACE_POINTS: Final = 1500
"""A line in space is drawn point by point: so many are smooth enough, and light enough for a phone."""

_THICKNESS: Final = 0.12
"""Share of the longest side that every side of the scene in space has at least: there must be room for its ticks."""


def _reference(flight: FlightData) -> Array:
    """North and east of the reference, shape (len, 2); NaN outside of the track phase."""
    on_track = flight.record.in_phase(TRACK_PHASE)
    return np.where(on_track[:, None], flight.record.columns("ref_n", "ref_e"), np.nan)


def plan_view(flight: FlightData) -> dict[str, Any]:
    """The path against its reference, north up and east to the right."""
    path, reference = flight.record.columns("p_n", "p_e"), _reference(flight)
    flown, wanted = thin(path), thin(reference)
    hover = {"hovertemplate": "north %{y:.2f} m, east %{x:.2f} m"}
    data = [
        line(reference[wanted, 1], reference[wanted, 0], "reference", BAND, width=6, **hover),
        line(path[flown, 1], path[flown, 0], "flown", AXES[0], width=1.6, **hover),
    ]
    if len(path):
        marker = {"symbol": "circle", "size": 11, "color": "white", "line": {"color": AXES[0], "width": 2.5}}
        start = line(path[:1, 1], path[:1, 0], "start", AXES[0], **hover)
        data.append(start | {"mode": "markers", "marker": marker})
    layout = base_layout() | {"hovermode": "closest", "showlegend": True}
    layout["legend"] = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1, "yanchor": "bottom"}
    layout["xaxis"] = axis_style("East [m]") | {"constrain": "domain"}
    layout["yaxis"] = axis_style("North [m]") | {"scaleanchor": "x", "scaleratio": 1, "constrain": "domain"}
    _show(layout, _extent(np.concatenate((path, reference))))
    return {"data": data, "layout": layout}


def plan_close(flight: FlightData) -> dict[str, Any] | None:
    """The plan view around the reference; None where the whole one shows as much."""
    whole, reference = _extent(flight.record.columns("p_n", "p_e")), _extent(_reference(flight))
    if whole is None or reference is None or np.all(np.diff(whole, axis=0) < 1.3 * np.diff(reference, axis=0)):
        return None
    figure = plan_view(flight)
    _show(figure["layout"], reference)
    figure["layout"]["showlegend"] = False
    return figure


def _extent(points: Array) -> Array | None:
    """The lowest and the highest north and east with a margin, shape (2, 2); None without any point."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.06 * float(np.max(high - low)) + 0.1
    return np.stack((low - margin, high + margin))


def _show(layout: dict[str, Any], extent: Array | None) -> None:
    """Let the axes of a plan view span this."""
    if extent is not None:
        layout["yaxis"]["range"], layout["xaxis"]["range"] = extent.T.tolist()


def path_in_space(flight: FlightData) -> dict[str, Any]:
    """The path against its reference in three dimensions, true to scale; up is up."""
    path = flight.record.columns("p_n", "p_e", "p_d")
    on_track = flight.record.in_phase(TRACK_PHASE)
    reference = np.where(on_track[:, None], flight.record.columns("ref_n", "ref_e", "ref_d"), np.nan)
    data = [
        _space_line(reference, "reference", BAND, 7.0),
        _space_line(path, "flown", AXES[0], 3.0),
    ]
    if len(path):
        start = _space_line(path[:1], "start", INK, 1.0)
        data.append(start | {"mode": "markers", "marker": {"size": 4, "color": INK}})
    layout = base_layout() | {"showlegend": True, "hovermode": "closest"}
    layout["margin"] = {"l": 0, "r": 0, "t": 24, "b": 0}
    layout["legend"] = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1, "yanchor": "bottom"}
    axes = {f"{letter}axis": {"title": {"text": text}, "gridcolor": "#dfe4ea", "zeroline": False}
            for letter, text in (("x", "East [m]"), ("y", "North [m]"), ("z", "Up [m]"))}  # fmt: skip
    layout["scene"] = {**axes, "camera": {"eye": {"x": 0.75, "y": -0.98, "z": 0.62}, "center": {"z": -0.1}}}
    _fill(layout["scene"], np.concatenate((path, reference)) * (1.0, 1.0, -1.0))
    return {"data": data, "layout": layout}


def _fill(scene: dict[str, Any], points: Array) -> None:
    """Let a scene span north, east and up of these, true to scale, its longest side as long as the camera sees whole.

    Plotly's own true scale makes a flat path so large that its ends are cut off on a phone.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    longest = max(float(np.max(high - low)), 0.5)
    spans = 1.08 * np.maximum(high - low, _THICKNESS * longest)
    for letter, middle, span in zip("yxz", ((low + high) / 2.0).tolist(), spans.tolist(), strict=True):
        scene[f"{letter}axis"]["range"] = [middle - span / 2.0, middle + span / 2.0]
        scene[f"{letter}axis"]["nticks"] = 3 if span < 0.25 * longest else 7
        scene.setdefault("aspectratio", {})[letter] = span / longest
    scene["aspectmode"] = "manual"


def _space_line(points: Array, name: str, colour: str, width: float) -> dict[str, Any]:
    """A line through NED points, shape (len, 3)."""
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _SPACE_POINTS)).astype(np.intp))
    north, east, down = points[rows].T
    return {
        **{"type": "scatter3d", "mode": "lines", "name": name, "line": {"color": colour, "width": width}},
        **{"x": east.astype(np.float32), "y": north.astype(np.float32), "z": (-down).astype(np.float32)},
        "hovertemplate": "east %{x:.2f} m, north %{y:.2f} m, up %{z:.2f} m",
    }
