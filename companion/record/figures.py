"""The figures of a flight's report: the paper's five, and the position error over time.

Each function takes the flight and returns a figure as a plain dictionary in the terms of plotly.js, with arrays in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from companion.record.charts import (
    AXES,
    BAND,
    ERRORS,
    FAINT,
    INK,
    Array,
    Phase,
    add_level,
    axis_style,
    base_layout,
    line,
    lines,
    logarithmic,
    thin,
    time_layout,
)
from companion.record.columns import TRACK_PHASE
from companion.record.flight_record import FlightRecord
from companion.record.summary import SETTLED_BELOW_M, body_velocity


@dataclass(frozen=True)
class FlightData:
    """A flight as the figures need it."""

    record: FlightRecord
    summary: Mapping[str, Any]
    truth: Mapping[str, Array]
    """Columns of the simulated vehicle's truth.csv; empty when there is none."""
    mass_kg: float | None
    limits: Mapping[str, Any]
    """The table [limits] that was used."""

    @property
    def start_s(self) -> float:
        """Vehicle time at which the trajectory began, or the record when it never did."""
        on_track = np.flatnonzero(self.record.in_phase(TRACK_PHASE) & np.isfinite(self.record.column("track_s")))
        if len(on_track):
            return float(self.record.column("t_s")[on_track[0]] - self.record.column("track_s")[on_track[0]])
        return float(self.record.column("t_s")[0]) if len(self.record) else 0.0

    @property
    def time_s(self) -> Array:
        """The figures' time axis, shape (len,)."""
        return self.record.column("t_s") - self.start_s

    @property
    def phases(self) -> list[Phase]:
        """The phases within the record."""
        if not len(self.record):
            return []
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        known = [entry for entry in self.summary.get("phases", []) if entry["at_s"] is not None]
        begins = [max(entry["at_s"] - self.start_s, first) for entry in known]
        ends = [*begins[1:], last]
        return [
            Phase(entry["name"], begin, min(end, last), entry["reason"])
            for entry, begin, end in zip(known, begins, ends, strict=True)
            if begin < min(end, last)
        ]


class Figure(NamedTuple):
    """A figure with the text around it."""

    key: str
    title: str
    caption: str
    height_px: int
    build: Callable[[FlightData], dict[str, Any]]
    close: Callable[[FlightData], dict[str, Any] | None] | None = None
    """A second panel beside it, where it adds something."""
    of_law: bool = False
    """Whether it shows numbers that only the law has."""


def _time_layout(flight: FlightData, titles: Sequence[str]) -> dict[str, Any]:
    return time_layout(flight.time_s, flight.phases, titles)


def _norms(flight: FlightData, *names: str) -> Array:
    """Euclidean norms of the vectors with these names, shape (len, names)."""
    parts = [flight.record.columns(f"{name}_n", f"{name}_e", f"{name}_d") for name in names]
    return np.column_stack([np.sqrt((part * part).sum(axis=1)) for part in parts])


def position_error(flight: FlightData) -> dict[str, Any]:
    """Distance from the reference over time with its rms, and its components once settled."""
    distance = _norms(flight, "error")
    components = 100.0 * flight.record.columns("error_n", "error_e", "error_d")
    layout = _time_layout(flight, ["Distance [m]", "Components [cm]"])
    layout["yaxis"] |= logarithmic(distance)
    data = lines(flight.time_s, distance, ["distance from the reference"], [INK])
    data += lines(flight.time_s, components, ["north", "east", "down"], AXES, row=2)
    rms, from_s = flight.summary.get("position_rms_m"), flight.summary.get("statistics_from_s")
    add_level(layout, SETTLED_BELOW_M, f"settled below {SETTLED_BELOW_M:g} m", colour=FAINT)
    if rms and from_s is not None:
        window = (flight.record.column("track_s") >= from_s) & flight.record.in_phase(TRACK_PHASE)
        largest = float(np.nanmax(np.abs(components[window]))) if window.any() else 1.0
        layout["yaxis2"]["range"] = [-3.0 * largest, 3.0 * largest]
        ends = np.array([flight.time_s[window][0], flight.time_s[window][-1]]) if window.any() else np.empty(0)
        name = f"rms {rms:.2g} m from {from_s:.0f} s on"
        data += lines(ends, np.full((len(ends), 1), rms), [name], [ERRORS[2]], width=2.4)
    return {"data": data, "layout": layout}


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


def body_velocities(flight: FlightData) -> dict[str, Any]:
    """Velocity in the body frame."""
    names = ["forward", "right", "down"]
    layout = _time_layout(flight, ["Velocity [m/s]"])
    return {"data": lines(flight.time_s, body_velocity(flight.record), names, AXES), "layout": layout}


def force_estimates(flight: FlightData) -> dict[str, Any]:
    """The estimated disturbance against the truth where it is known, axis by axis."""
    factor, unit = (flight.mass_kg, "N") if flight.mass_kg else (1.0, "m/s²")
    layout = _time_layout(flight, [f"{axis} [{unit}]" for axis in ("North", "East", "Down")])
    estimate = factor * flight.record.columns("b_hat_n", "b_hat_e", "b_hat_d")
    data = []
    for row, letter in enumerate("ned", start=1):
        values = estimate[:, row - 1 : row]
        data += lines(flight.time_s, values, ["estimate"], AXES[row - 1 : row], row)
        truth = flight.truth.get(f"disturbance_{letter}_m_s2")
        if truth is not None:
            time_s = flight.truth["t_s"] - flight.start_s
            known = lines(time_s, factor * truth[:, None], ["truth"], [INK], row)
            data += [entry | {"line": {"color": INK, "width": 1.4, "dash": "dash"}} for entry in known]
    return {"data": data, "layout": layout}


def law_errors(flight: FlightData) -> dict[str, Any]:
    """The four errors of the law: their sizes, and the components of the first."""
    layout = _time_layout(flight, ["Size [m]", "e₁ [m]"])
    sizes = _norms(flight, "e1", "e2", "e3", "e4")
    layout["yaxis"] |= logarithmic(sizes)
    data = lines(flight.time_s, sizes, ["|e₁|", "|e₂|", "|e₃|", "|e₄|"], ERRORS)
    components = flight.record.columns("e1_n", "e1_e", "e1_d")
    data += lines(flight.time_s, components, ["north", "east", "down"], AXES, row=2)
    return {"data": data, "layout": layout}


def actuation(flight: FlightData) -> dict[str, Any]:
    """What the law asked for: thrust, body rates and angular accelerations."""
    layout = _time_layout(flight, ["Thrust [N]", "Rates [rad/s]", "Acc. [rad/s²]"])
    record, names = flight.record, ["roll", "pitch", "yaw"]
    data = lines(flight.time_s, record.columns("thrust_n"), ["thrust"], [INK])
    data += lines(flight.time_s, record.columns("rate_cmd_x", "rate_cmd_y", "rate_cmd_z"), names, AXES, row=2)
    data += lines(flight.time_s, record.columns("tau_x", "tau_y", "tau_z"), names, AXES, row=3)
    thrust = record.column("thrust_n")
    for key, word in (("thrust_min_n", "least"), ("thrust_max_n", "most")):
        limit = flight.limits.get(key)
        # A limit far from what was flown would only flatten the curve.
        if isinstance(limit, int | float) and len(thrust) and _near(float(limit), thrust):
            add_level(layout, float(limit), f"{word} allowed, {limit:g} N", colour=FAINT)
    return {"data": data, "layout": layout}


def _near(value: float, series: Array) -> bool:
    finite = series[np.isfinite(series)]
    if not len(finite):
        return False
    low, high = float(finite.min()), float(finite.max())
    return low - 0.6 * (high - low) <= value <= high + 0.6 * (high - low)


FIGURES: Final = (
    Figure(
        "position-error",
        "Position error",
        "Distance of the received position from the reference at the same instant; below, the settled part.",
        520,
        position_error,
    ),
    Figure(
        "plan-view",
        "Figure 1: plan view",
        "The path against its reference, seen from above.",
        460,
        plan_view,
        plan_close,
    ),
    Figure(
        "body-velocities",
        "Figure 2: body velocities",
        "Velocity along the vehicle's own axes; with the nose along the path the motion to the right vanishes.",
        360,
        body_velocities,
    ),
    Figure(
        "force-estimates",
        "Figure 3: force estimates",
        "The force that the law believes to act on the vehicle; a wrong mass or gravity shows as a force downwards.",
        600,
        force_estimates,
        of_law=True,
    ),
    Figure(
        "errors",
        "Figure 4: the four errors",
        "Position, velocity, acceleration and jerk errors of the law at the predicted time, all scaled to metres.",
        560,
        law_errors,
        of_law=True,
    ),
    Figure(
        "actuation",
        "Figure 5: actuation",
        "What the law asked the autopilot for: thrust, body rates (after their limit) and angular accelerations.",
        660,
        actuation,
        of_law=True,
    ),
)
"""The figures in the order of the report."""
