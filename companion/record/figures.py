"""The figures of a flight's report over time: position error, the paper's, and what the law made of the state.

Each function takes the flight and returns a figure as a plain dictionary in the terms of plotly.js, with arrays in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from companion.record.charts import (
    AXES,
    ERRORS,
    FAINT,
    INK,
    Array,
    add_level,
    lines,
    logarithmic,
    time_layout,
)
from companion.record.columns import TRACK_PHASE
from companion.record.figures_path import path_in_space, plan_close, plan_view
from companion.record.figures_vehicle import attitude, battery, events, heading, rates, timing
from companion.record.flight_data import Figure, FlightData
from companion.record.summary import SETTLED_BELOW_M, body_velocity


def _time_layout(flight: FlightData, titles: Sequence[str]) -> dict[str, Any]:
    return time_layout(flight.time_s, flight.phases, titles, flight.marks)


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
    """The four errors of the law: their sizes, the components of the first, and the Lyapunov function."""
    layout = _time_layout(flight, ["Size [m]", "e₁ [m]", "V [m²]"])
    sizes = _norms(flight, "e1", "e2", "e3", "e4")
    layout["yaxis"] |= logarithmic(sizes)
    data = lines(flight.time_s, sizes, ["|e₁|", "|e₂|", "|e₃|", "|e₄|"], ERRORS)
    components = flight.record.columns("e1_n", "e1_e", "e1_d")
    data += lines(flight.time_s, components, ["north", "east", "down"], AXES, row=2)
    lyapunov = flight.record.columns("lyapunov")
    bound = np.full((len(flight.record), 1), flight.envelope_m2)
    bound[~np.isfinite(lyapunov)] = math.nan
    layout["yaxis3"] |= logarithmic(np.concatenate((lyapunov, bound)))
    data += lines(flight.time_s, lyapunov, ["V, without the estimate's own error"], [INK], row=3)
    if np.isfinite(bound).any():
        data += lines(flight.time_s, bound, ["envelope: V stays below, by the proof"], [FAINT], row=3, width=1.6)
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
        "events",
        "Events",
        "What happened when: phases, limits that acted, late and skipped steps, guards, resets, and what was said. "
        "Guards (orange) and resets (violet) are lines in all figures over time.",
        300,
        events,
    ),
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
        "path",
        "The path in space",
        "True to scale; turn it with the mouse or a finger.",
        520,
        path_in_space,
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
        "Position, velocity, acceleration and jerk errors of the law at the predicted time, all scaled to metres, and "
        "the Lyapunov function that bounds them, below its envelope as long as the proof's conditions hold.",
        760,
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
    Figure(
        "rates",
        "Thrust and body rates, commanded and actual",
        "What the autopilot was asked for, and what the vehicle did; thrust as a share of full thrust.",
        660,
        rates,
        of_law=True,
    ),
    Figure(
        "attitude",
        "Attitude",
        "Roll, pitch and the tilt between the vehicle's axis and the vertical: as received, and (dotted) where the law "
        "wants the thrust, so that the acceleration error e₃ would vanish.",
        520,
        attitude,
    ),
    Figure(
        "heading",
        "Heading",
        "The heading, the direction of the path, and the angle to the desired heading where one is wanted.",
        440,
        heading,
    ),
    Figure(
        "timing",
        "Timing",
        "By the wall clock: from a state's arrival to its setpoint's departure, and the state's age at that moment.",
        440,
        timing,
    ),
    Figure(
        "battery",
        "Battery",
        "As the autopilot reported it.",
        440,
        battery,
        shown=lambda flight: "t_s" in flight.battery and len(flight.battery["t_s"]) > 1,
    ),
)
"""The figures in the order of the report."""
