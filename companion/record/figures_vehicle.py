"""What the vehicle and the program did over time: events, attitude, rates, heading, timing."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from companion.record.charts import ALARM, AXES, ERRORS, FAINT, INK, RESET, Array, lines, time_layout
from companion.record.columns import LIMIT_NAMES
from companion.record.flight_data import FlightData

_ROTORS: Final = ("thrust_1_n", "thrust_2_n", "thrust_3_n", "thrust_4_n")
_SLOW_M_S: Final = 0.1
"""Below this the path has no direction worth drawing."""
_BAND_COLOURS: Final = ("#dbe7f3", "#c9dff0")
_MESSAGES: Final = {"guards": ALARM, "resets": RESET, "autopilot's words": AXES[2], "messages": AXES[0]}
"""The rows of what was said, with their colours."""
ROW_GAP: Final = 0.5
"""Share of a band's row that is left free for its name."""
_SHOWN: Final = 500
"""Messages of a kind that are drawn."""
_BATTERY: Final = (
    ("Voltage [V]", "voltage_v", 1.0, "voltage", AXES[0]),
    ("Current [A]", "current_a", 1.0, "current", AXES[1]),
    ("Left [%]", "remaining", 100.0, "left", AXES[2]),
)
"""Of the topic battery_status: axis, field, scale, name and colour."""
_GAP_S: Final = 0.05
"""Two spells of a limit closer together than this are drawn as one."""


def _layout(flight: FlightData, titles: Sequence[str]) -> dict[str, Any]:
    return time_layout(flight.time_s, flight.phases, titles, flight.marks)


def events(flight: FlightData) -> dict[str, Any]:
    """A band per kind of event: phases, every limit that acted, late steps, skipped states, and what was said."""
    record, time_s = flight.record, flight.time_s
    bits = np.where(np.isfinite(record.column("limits")), record.column("limits"), 0.0).astype(np.int64)
    bands: list[tuple[str, list[tuple[float, float]]]] = [
        (text, _spells(time_s, bits & bit != 0)) for bit, text in LIMIT_NAMES.items() if np.any(bits & bit)
    ]
    for column, text in (("late", "late steps"), ("skipped", "skipped states")):
        if np.any(record.column(column) > 0.0):
            bands.append((text, _spells(time_s, record.column(column) > 0.0)))
    data: list[dict[str, Any]] = []
    for index, phase in enumerate(flight.phases):
        data.append(
            bar("phase", [(phase.from_s, phase.to_s)], _BAND_COLOURS[index % 2], f"{phase.name}: {phase.reason}")
        )
        data[-1] |= {"text": [phase.name], "textposition": "inside", "insidetextanchor": "middle"}
    data += [bar(text, spells, ALARM, text) for text, spells in bands]
    said = _said(flight)
    data += said
    layout = _layout(flight, [""])
    names = [trace["name"] for trace in reversed(said)] + [text for text, _ in reversed(bands)] + ["phase"]
    name_rows(layout, names)
    return {"data": data, "layout": layout}


def _said(flight: FlightData) -> list[dict[str, Any]]:
    """A mark per message within the record, a row per kind; the text shows under the pointer."""
    if not len(flight.record):
        return []
    first, last = float(flight.time_s[0]), float(flight.time_s[-1])
    found: list[dict[str, Any]] = []
    for kind, colour in _MESSAGES.items():
        told = [(m.at_s - flight.start_s, html.escape(m.text)) for m in flight.messages if flight.kind_of(m) == kind]
        told = [(at_s, text) for at_s, text in told if first <= at_s <= last][:_SHOWN]
        if told:
            found.append(
                {
                    **{"type": "scatter", "mode": "markers", "name": kind, "y": [kind] * len(told)},
                    **{"x": [at_s for at_s, _ in told], "text": [text for _, text in told]},
                    **{"marker": {"color": colour, "size": 9, "symbol": "diamond"}},
                    "hovertemplate": "%{x:.2f} s: %{text}<extra></extra>",
                }
            )
    return found


def name_rows(layout: dict[str, Any], names: Sequence[str]) -> None:
    """Write the names of bands, from below, over the bands: beside them they would move the time axis."""
    layout["yaxis"] |= {"type": "category", "categoryorder": "array", "categoryarray": list(names), "ticks": ""}
    layout["yaxis"] |= {"showticklabels": False, "showgrid": False}
    layout["annotations"] = [  # on an axis of categories a number is a place among them
        {
            **{"text": name, "showarrow": False, "xref": "paper", "x": 0.0, "xanchor": "left"},
            **{"yref": "y", "y": index + 0.5 * (1.0 - ROW_GAP), "yanchor": "bottom", "borderpad": 0},
            "font": {"size": 11, "color": "#667085"},
        }
        for index, name in enumerate(names)
    ]
    layout |= {"barmode": "overlay", "showlegend": False, "hovermode": "closest", "bargap": ROW_GAP}
    layout["margin"] = layout["margin"] | {"t": 20}


def _spells(time_s: Array, active: npt.NDArray[np.bool_]) -> list[tuple[float, float]]:
    """From and to of each spell [s]."""
    rows = np.flatnonzero(active)
    if not len(rows):
        return []
    breaks = np.flatnonzero(np.diff(time_s[rows]) > _GAP_S)
    firsts, lasts = np.concatenate(([0], breaks + 1)), np.concatenate((breaks, [len(rows) - 1]))
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    return [(float(time_s[rows[a]]), float(time_s[rows[b]]) + step_s) for a, b in zip(firsts, lasts, strict=True)]


def bar(row: str, spells: Sequence[tuple[float, float]], colour: str, hover: str) -> dict[str, Any]:
    """Spells of one row, drawn as horizontal bars."""
    return {
        **{"type": "bar", "orientation": "h", "y": [row] * len(spells), "name": row},
        **{"base": [begin for begin, _ in spells], "x": [end - begin for begin, end in spells]},
        **{"marker": {"color": colour}, "hovertemplate": f"{hover}<br>from %{{base:.2f}} s<extra></extra>"},
    }


def turned(q: Array) -> Array:
    """Roll, pitch and heading [rad], shape (len, 3), of quaternions, shape (len, 4)."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack((roll, pitch, yaw))


def wanted_axis(flight: FlightData) -> Array | None:
    """Where the law wants the body's down axis at the predicted time, shape (len, 3), NED; None: not known.

    It is the direction of thrust at which the acceleration error e3 (30) would vanish: (T/m) r3 + k1^2 k2 e3.
    """
    k1, k2 = flight.gains.get("k1_1_s"), flight.gains.get("k2")
    if flight.mass_kg is None or not isinstance(k1, int | float) or not isinstance(k2, int | float):
        return None
    record = flight.record
    w, x, y, z = record.columns("predicted_q_w", "predicted_q_x", "predicted_q_y", "predicted_q_z").T
    r3 = np.column_stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))
    thrust = record.columns("thrust_n") / flight.mass_kg * r3 + k1 * k1 * k2 * record.columns("e3_n", "e3_e", "e3_d")
    length = np.linalg.norm(thrust, axis=1, keepdims=True)
    return np.asarray(thrust / np.where(length > 0.0, length, math.nan))


def attitude(flight: FlightData) -> dict[str, Any]:
    """Roll and pitch, and the tilt, in degrees: as received, and as the law wants them."""
    q = flight.record.columns("q_w", "q_x", "q_y", "q_z")
    degrees = np.degrees(turned(q))
    tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (q[:, 1] ** 2 + q[:, 2] ** 2), -1.0, 1.0)))
    layout = _layout(flight, ["Angle [deg]", "Tilt [deg]"])
    data = lines(flight.time_s, degrees[:, :2], ["roll", "pitch"], AXES[:2])
    data += lines(flight.time_s, tilt[:, None], ["tilt"], [INK], row=2)
    axis = wanted_axis(flight)
    if axis is not None and np.isfinite(axis).any():
        c, s = np.cos(np.radians(degrees[:, 2])), np.sin(np.radians(degrees[:, 2]))
        forward, right = c * axis[:, 0] + s * axis[:, 1], c * axis[:, 1] - s * axis[:, 0]
        roll, pitch = np.degrees(-np.arcsin(np.clip(right, -1.0, 1.0))), np.degrees(np.arctan2(forward, axis[:, 2]))
        wanted = lines(flight.time_s, np.column_stack((roll, pitch)), ["roll wanted", "pitch wanted"], AXES[:2])
        tilted = np.degrees(np.arccos(np.clip(axis[:, 2], -1.0, 1.0)))
        wanted += lines(flight.time_s, tilted[:, None], ["tilt wanted"], [INK], row=2)
        data += [entry | {"line": entry["line"] | {"dash": "dot", "width": 1.0}} for entry in wanted]
    return {"data": data, "layout": layout}


def battery(flight: FlightData) -> dict[str, Any]:
    """Voltage, current and what is left, as the autopilot reported them."""
    data: list[dict[str, Any]] = []
    shown = [
        (title, name, scale, text, colour) for title, name, scale, text, colour in _BATTERY if name in flight.battery
    ]
    layout = _layout(flight, [title for title, *_ in shown] or [_BATTERY[0][0]])
    for row, (_, name, scale, text, colour) in enumerate(shown, start=1):
        values = flight.battery[name]
        known = np.where(values >= 0.0, scale * values, math.nan)  # -1: unknown
        data += lines(flight.battery["t_s"] - flight.start_s, known[:, None], [text], [colour], row)
    return {"data": data, "layout": layout}


def rates(flight: FlightData) -> dict[str, Any]:
    """Thrust and body rates: what was asked for in dashes over what the vehicle did."""
    record = flight.record
    layout = _layout(flight, ["Thrust [1]", "Roll [rad/s]", "Pitch [rad/s]", "Yaw [rad/s]"])
    data = lines(flight.time_s, record.columns("thrust_cmd"), ["commanded"], [INK])
    known = [flight.truth[name] for name in _ROTORS if name in flight.truth]
    if len(known) == len(_ROTORS) and flight.thrust_full_n:
        share = _command(np.sum(known, axis=0) / flight.thrust_full_n, flight.curve_factor)
        data += lines(flight.truth["t_s"] - flight.start_s, share[:, None], ["actual (simulated)"], [AXES[0]])
    for row, axis in enumerate("xyz", start=2):
        data += lines(flight.time_s, record.columns(f"w_{axis}"), ["actual"], [AXES[row - 2]], row)
        wanted = lines(flight.time_s, record.columns(f"rate_cmd_{axis}"), ["commanded"], [INK], row)
        data += [entry | {"line": {"color": INK, "width": 1.0, "dash": "dot"}} for entry in wanted]
    return {"data": data, "layout": layout}


def _command(share: Array, curve: float) -> Array:
    """The command that gives a share of full thrust: share = curve u^2 + (1 - curve) u."""
    if curve <= 0.0:
        return share
    half = (1.0 - curve) / (2.0 * curve)
    return np.sqrt(half * half + np.clip(share, 0.0, None) / curve) - half


def heading(flight: FlightData) -> dict[str, Any]:
    """The heading, the path's direction while there is one, and the heading error, in degrees."""
    record = flight.record
    yaw = np.degrees(turned(record.columns("q_w", "q_x", "q_y", "q_z"))[:, 2])
    north, east = record.column("ref_v_n"), record.column("ref_v_e")
    course = np.where(np.hypot(north, east) > _SLOW_M_S, np.degrees(np.arctan2(east, north)), math.nan)
    layout = _layout(flight, ["Heading [deg]", "Error [deg]"])
    layout["yaxis"] |= {"range": [-190.0, 190.0], "dtick": 90.0}
    data = lines(flight.time_s, _unjumped(course)[:, None], ["direction of the path"], [FAINT])
    data += lines(flight.time_s, _unjumped(yaw)[:, None], ["heading"], [AXES[0]])
    error = np.degrees(record.columns("heading_error_rad"))
    data += lines(flight.time_s, error, ["heading error"], [ERRORS[2]], row=2)
    return {"data": data, "layout": layout}


def _unjumped(degrees: Array) -> Array:
    """The angle with a gap where it passes from 180 to -180 degrees."""
    out = degrees.copy()
    out[1:][np.abs(np.diff(degrees)) > 180.0] = math.nan
    return out


def timing(flight: FlightData) -> dict[str, Any]:
    """Duration of the control steps, and age of the states."""
    record = flight.record
    layout = _layout(flight, ["Step [ms]", "State age [ms]"])
    data = lines(flight.time_s, 1e-3 * record.columns("step_us"), ["control step"], [AXES[0]], width=0.9)
    data += lines(flight.time_s, record.columns("state_age_ms"), ["state age"], [AXES[2]], row=2, width=0.9)
    return {"data": data, "layout": layout}
