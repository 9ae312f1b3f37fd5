"""A page with a flight's record and PX4's own log of it over each other."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from companion.errors import InputError
from companion.record.alignment import Fit
from companion.record.charts import AXES, BAND, ERRORS, INK, Array, lines, time_layout
from companion.record.figures_vehicle import bar, name_rows, turned
from companion.record.flight_data import FlightData
from companion.record.flight_source import read_source
from companion.record.folder import write_whole
from companion.record.page import compose
from companion.record.px4_log import POSITION, Px4Log, Series, at, broken, clipped, read_px4_log
from companion.record.report import flight_name, listing, notes, read_flight, section, tile

PX4_FILE: Final = "px4.html"
_SHOWN_TEXTS: Final = 100
_SEVERITIES: Final = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_MOTOR_COLOURS: Final = (*ERRORS, *AXES, INK)


class Overlay(NamedTuple):
    """What was made."""

    page: Path
    fit: Fit
    missing: tuple[str, ...]


class _Figure(NamedTuple):
    key: str
    title: str
    caption: str
    height_px: int
    build: Callable[[FlightData, Px4Log], dict[str, Any] | None]
    """None where PX4's log does not have what it shows."""


def build_overlay(log: Path, flown: Path, out: Path | None = None) -> Overlay:
    """Lay PX4's log over a flight and write the page: `px4.html` in the flight's folder, or `out`.

    Raises:
        InputError: one of them cannot be read, they do not show the same flight, or the page cannot be written.
    """
    source = read_source(flown)
    flight, configuration = read_flight(source)
    px4 = read_px4_log(log, flight.record)
    drawn, sections = [], []
    for figure in FIGURES:
        built = figure.build(flight, px4)
        if built is not None:
            drawn.append({"key": figure.key, **built})
            sections.append(section(figure.title, figure.caption, [figure.key], figure.height_px))
    fit, missing = px4.fit, (*source.missing, *px4.missing)
    sure = fit.clear and fit.same_flight
    parts = {
        "TITLE": f"{html.escape(flight_name(configuration, flown))}, with the autopilot's own log",
        "SUBTITLE": f"{html.escape(log.name)} moved by <b>{fit.offset_s + 0.0:+.4f} s</b> onto the companion's clock",
        "VERDICT": "one flight" if sure else "ambiguous offset" if fit.same_flight else "perhaps another flight",
        "VERDICT_CLASS": "passed" if sure else "missed",
        "THRESHOLDS": notes(missing) + f"<p>Time offset {html.escape(fit.sentence)}.</p>",
        "TILES": _tiles(fit, px4.delay_s(flight.record)),
        "FIGURES": "".join(sections),
        "TABLES": _texts(flight, px4),
    }
    path = out or source.folder / PX4_FILE
    try:
        return Overlay(write_whole(path, compose(parts, drawn)), fit, missing)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another with --out") from None


def _tiles(fit: Fit, delay_s: float | None) -> str:
    offset = ", ".join(f"{round(100.0 * x, 1) + 0.0:.1f}" for x in fit.position_offset_m)
    return "".join(
        tile(*map(html.escape, entry))
        for entry in (
            ("Time offset", f"{1000.0 * fit.offset_s:+.1f} ms", "from PX4's clock to the companion's"),
            ("Agreement", f"{100.0 * fit.agreement:.2f} %", "of the velocity's variance"),
            ("Velocities differ by", f"{100.0 * fit.velocity_rms_m_s:.2g} cm/s", "rms"),
            ("Positions differ by", f"{100.0 * fit.position_rms_m:.2g} cm", f"rms about ({offset}) cm"),
            ("In both logs", f"{fit.overlap_s:.1f} s", ""),
            (
                "Setpoints arrive after",
                "–" if delay_s is None else f"{1000.0 * delay_s:.1f} ms",
                "from the state's stamp to PX4's rate setpoint",
            ),
        )
    )


def _texts(flight: FlightData, px4: Px4Log) -> str:
    said = [(f"{t_s - flight.start_s:.2f}", _SEVERITIES[min(max(level, 0), 7)], text) for t_s, level, text in px4.texts]
    title = "What the autopilot said" + (f", the last {_SHOWN_TEXTS}" if len(said) > _SHOWN_TEXTS else "")
    return listing(title, ("at, s", "severity", "text"), said[-_SHOWN_TEXTS:])


# ---- the figures ----------------------------------------------------------------------------------------------------


def _layout(flight: FlightData, titles: Sequence[str]) -> dict[str, Any]:
    return time_layout(flight.time_s, flight.phases, titles)


def _series(flight: FlightData, px4: Px4Log, topic: str, *fields: str) -> Series | None:
    """A topic's fields around the record, on the figures' time axis; None where there is nothing."""
    found = px4.series(topic, *fields)
    return None if found is None else _shown(flight, found)


def _shown(flight: FlightData, series: Series) -> Series | None:
    t_s = flight.record.column("t_s")
    part = clipped(series, float(t_s[0]), float(t_s[-1]))
    return broken(Series(part.t_s - flight.start_s, part.values)) if len(part.t_s) else None


def _by_axis(
    data: list[Any], time_s: Array, values: Array, name: str, colours: Sequence[str], dash: str = "", width: float = 1.2
) -> None:
    """A line in each of as many rows as there are columns."""
    for row, colour in enumerate(colours, start=1):
        found = lines(time_s, values[:, row - 1 : row], [name], [colour], row, width)
        data += [entry | {"line": entry["line"] | {"dash": dash}} for entry in found] if dash else found


def _position(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    theirs = _series(flight, px4, POSITION, "x", "y", "z")
    if theirs is None:
        return None
    record, data = flight.record, list[Any]()
    _by_axis(data, flight.time_s, record.columns("ref_n", "ref_e", "ref_d"), "reference", [BAND] * 3, width=4.0)
    _by_axis(data, flight.time_s, record.columns("p_n", "p_e", "p_d"), "companion", AXES)
    _by_axis(data, theirs.t_s, theirs.values, "PX4", [INK] * 3, "dot")
    return {"data": data, "layout": _layout(flight, ["North [m]", "East [m]", "Down [m]"])}


def _differences(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    theirs = px4.series(POSITION, "x", "y", "z", "vx", "vy", "vz")
    if theirs is None:
        return None
    ours = flight.record.columns("p_n", "p_e", "p_d", "v_n", "v_e", "v_d")
    apart = 100.0 * (ours - at(theirs, flight.record.column("t_s")))
    names = ["north", "east", "down"]
    data = lines(flight.time_s, apart[:, :3], names, AXES) + lines(flight.time_s, apart[:, 3:], names, AXES, row=2)
    return {"data": data, "layout": _layout(flight, ["Position [cm]", "Velocity [cm/s]"])}


def _attitude(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    theirs = _series(flight, px4, "vehicle_attitude", *(f"q[{index}]" for index in range(4)))
    if theirs is None:
        return None
    data: list[Any] = []
    ours = np.degrees(turned(flight.record.columns("q_w", "q_x", "q_y", "q_z")))
    _by_axis(data, flight.time_s, _gapped(ours), "companion", AXES)
    _by_axis(data, theirs.t_s, _gapped(np.degrees(turned(theirs.values))), "PX4", [INK] * 3, "dot")
    wanted = _series(flight, px4, "vehicle_attitude_setpoint", *(f"q_d[{index}]" for index in range(4)))
    if wanted is not None:
        _by_axis(data, wanted.t_s, _gapped(np.degrees(turned(wanted.values))), "PX4's setpoint", [ERRORS[1]] * 3)
    return {"data": data, "layout": _layout(flight, ["Roll [deg]", "Pitch [deg]", "Heading [deg]"])}


def _gapped(degrees: Array) -> Array:
    """Angles with a gap where they pass from 180 to -180 degrees."""
    out = degrees.copy()
    out[1:][np.abs(np.diff(degrees, axis=0)) > 180.0] = np.nan
    return out


def _rates(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    wanted = _series(flight, px4, "vehicle_rates_setpoint", "roll", "pitch", "yaw")
    actual = _series(flight, px4, "vehicle_angular_velocity", "xyz[0]", "xyz[1]", "xyz[2]")
    if wanted is None and actual is None:
        return None
    data: list[Any] = []
    if actual is not None:
        _by_axis(data, actual.t_s, actual.values, "PX4, actual", AXES)
    sent = flight.record.columns("rate_cmd_x", "rate_cmd_y", "rate_cmd_z")
    _by_axis(data, flight.time_s, sent, "companion's command", [ERRORS[1]] * 3)
    if wanted is not None:
        _by_axis(data, wanted.t_s, wanted.values, "PX4's setpoint", [INK] * 3, "dot")
    return {"data": data, "layout": _layout(flight, ["Roll [rad/s]", "Pitch [rad/s]", "Yaw [rad/s]"])}


def _thrust(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    wanted = _series(flight, px4, "vehicle_rates_setpoint", "thrust_body[2]")
    motors = px4.motors
    shown = None if motors is None else _shown(flight, motors[1])
    if wanted is None and shown is None:
        return None
    data = lines(flight.time_s, flight.record.columns("thrust_cmd"), ["companion's command"], [ERRORS[1]])
    if wanted is not None:
        data += [entry | {"line": entry["line"] | {"dash": "dot"}}
                 for entry in lines(wanted.t_s, -wanted.values, ["PX4's setpoint"], [INK])]  # fmt: skip
    titles = ["Thrust [1]"]
    if shown is not None and motors is not None:
        count = shown.values.shape[1]
        colours = [_MOTOR_COLOURS[index % len(_MOTOR_COLOURS)] for index in range(count)]
        data += lines(shown.t_s, shown.values, [f"motor {index + 1}" for index in range(count)], colours, row=2)
        titles.append("Motors [1]" if motors[0] == "actuator_motors" else "Outputs [us]")
    return {"data": data, "layout": _layout(flight, titles)}


def _battery(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    battery = _series(flight, px4, "battery_status", "voltage_v", "remaining")
    if battery is None:
        return None
    data = lines(battery.t_s, battery.values[:, :1], ["voltage"], [AXES[0]])
    data += lines(battery.t_s, 100.0 * battery.values[:, 1:], ["left"], [AXES[2]], row=2)
    return {"data": data, "layout": _layout(flight, ["Voltage [V]", "Charge [%]"])}


def _modes(flight: FlightData, px4: Px4Log) -> dict[str, Any] | None:
    modes = px4.modes
    if not modes:
        return None
    first_s, last_s = float(flight.time_s[0]), float(flight.time_s[-1])
    data: list[Any] = []
    for phase in flight.phases:
        span = (phase.from_s, phase.to_s)
        data.append(bar("companion", [span], BAND if len(data) % 2 else "#dbe7f3", f"{phase.name}: {phase.reason}"))
        data[-1] |= {"text": [phase.name], "textposition": "inside", "insidetextanchor": "middle"}
    for index, (name, begin_s, end_s) in enumerate(modes):
        span = (max(begin_s - flight.start_s, first_s), min(end_s - flight.start_s, last_s))
        if span[0] < span[1]:
            data.append(bar("PX4", [span], "#dcefe6" if index % 2 else "#c5e3d5", name))
            data[-1] |= {"text": [name], "textposition": "inside", "insidetextanchor": "middle"}
    layout = _layout(flight, [""])
    name_rows(layout, ["PX4", "companion"])
    return {"data": data, "layout": layout}


FIGURES: Final = (
    _Figure("modes", "Phases and modes", "The companion's phases, and the modes that PX4 flew.", 200, _modes),
    _Figure(
        "position",
        "Position",
        "As the companion received it, and as PX4 logged it, each in its own frame.",
        660,
        _position,
    ),
    _Figure(
        "difference",
        "What differs",
        "The companion's states less PX4's at the same instant, after the time offset.",
        440,
        _differences,
    ),
    _Figure("attitude", "Attitude", "As received, as PX4 logged it, and what PX4 aimed at.", 660, _attitude),
    _Figure("rates", "Body rates", "What was sent, what PX4 took for its setpoint, what the vehicle did.", 660, _rates),
    _Figure("thrust", "Thrust and motors", "What was sent, PX4's setpoint, and what went to the motors.", 520, _thrust),
    _Figure("battery", "Battery", "As PX4 logged it.", 400, _battery),
)
"""In the order of the page."""
