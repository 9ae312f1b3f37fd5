"""A dated vehicle file from what was identified: the file that it began with, with other numbers.

What the flight told replaces the numbers of that file, each with a comment that says so. What no flight tells
(geometry, gains, noise) stays; limits in newtons keep their shares of weight and full thrust.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final

import tomlkit

from companion.config import Vehicle, find, read_toml, validate
from companion.control.types import GRAVITY_M_S2
from companion.errors import InputError
from companion.identification.identify import Identified

FOUND: Final = "calibrated"
_PARAMETER_AXES: Final = ("ROLL", "PITCH", "YAW")


@dataclass(frozen=True)
class Entered:
    """What the flight cannot tell."""

    name: str
    mass_kg: float
    mass_relative_error: float
    simulated: bool


def vehicle_values(template: Vehicle, entered: Entered, found: Identified, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a vehicle file that a calibration sets, by their dotted names.

    Args:
        template: the file that it began with.
        entered: mass and name.
        found: by the flight.
        facts: what the autopilot told (`flight.reports.vehicle_facts`).
    """
    motion, mass = found.motion, entered.mass_kg
    full_n = motion.full_m_s2 * mass
    limits, body = template.limits, template.body
    scale = mass / body.mass_kg
    rotor_n = _rounded(0.25 * full_n)
    share_n = limits.thrust_max_n / template.thrust_full_n * full_n
    most_n = _rounded(max(share_n, min(1.3 * mass * GRAVITY_M_S2, 0.95 * full_n)))
    values: dict[str, Any] = {
        "name": entered.name,
        "simulated": entered.simulated,
        "body.mass_kg": mass,
        "body.inertia_kg_m2": [_rounded(scale * x) for x in body.inertia_kg_m2],
        "body.drag_1_s": _rounded(max(motion.drag_1_s, 0.0)),
        "rotors.thrust_max_n": rotor_n,
        "rotors.lag_s": _rounded(motion.lag_s),
        "rotors.curve_factor": _rounded(motion.curve_factor),
        "limits.thrust_min_n": _rounded(limits.thrust_min_n * scale),
        "limits.thrust_max_n": min(most_n, 4.0 * rotor_n),  # rounded by itself it can be more than they give
        "link.state_age_s": _rounded(found.age_s if found.age_s is not None else found.delay_s),
        "link.command_delay_s": _rounded(found.delay_s if found.age_s is not None else 0.0),
        "controller.measured_delay": found.age_s is not None,
        "controller.thrust_scale_estimate": True,
    }
    lags = [
        fit.lag_s if fit is not None else assumed
        for fit, assumed in zip(found.rates, template.autopilot.rate_lag_s, strict=True)
    ]
    values["autopilot.rate_lag_s"] = [_rounded(lag) for lag in lags]
    values["autopilot.rate_integral_1_s"] = [_rounded(x) for x in found.integral_1_s]
    return values | _attitude_loops(facts.get("parameters", {}))


def _attitude_loops(parameters: Mapping[str, float]) -> dict[str, Any]:
    """The autopilot's attitude loops, by its parameters."""
    values: dict[str, Any] = {}
    gains = [parameters.get(f"MC_{axis}_P") for axis in _PARAMETER_AXES]
    if all(gain is not None and gain > 0.0 for gain in gains):
        values["autopilot.attitude_gain_1_s"] = [_rounded(gain or 0.0) for gain in gains]
        model = parameters.get("MC_REF_W_N")
        values["autopilot.attitude_lag_s"] = _rounded(2.0 / model) if model else 0.0
    return values


def provenance(found: Identified, facts: Mapping[str, Any], entered: Entered, flown: Path, day: date) -> dict[str, Any]:
    """The table [calibration]: when, with what, and how well the model fits."""
    own, own_motion = found.own, found.motion_own
    known = [fit for fit in own if fit is not None]
    table: dict[str, Any] = {
        "date": day.isoformat(),
        "autopilot": str(facts.get("autopilot") or ""),
        "flight": str(flown),
        "battery_v": _known(facts.get("battery_v")),
        "battery_share": _known(facts.get("battery_share")),
        "mass_relative_error": entered.mass_relative_error,
        "hover_thrust": _rounded(found.motion.hover_share),
        "hover_thrust_hold": _known(facts.get("hold_thrust")),
        "thrust_delay_s": _rounded(own_motion.delay_s),
        "velocity_residual_m_s": _rounded(found.motion.residual_m_s),
    }
    if len(known) == len(own):
        table["rate_delay_s"] = [_rounded(fit.delay_s) for fit in known]
        table["rate_lag_own_s"] = [_rounded(fit.lag_s) for fit in known]
        table["rate_residual_rad_s"] = [_rounded(fit.residual_rad_s) for fit in known]
    return {key: value for key, value in table.items() if value is not None}


def written(template: str, values: Mapping[str, Any], calibration: Mapping[str, Any]) -> str:
    """The text of the new file.

    Args:
        template: name or path of the file that it began with.
        values: `vehicle_values`.
        calibration: `provenance`.

    Raises:
        InputError: the result is no valid vehicle file.
    """
    path = find(template, "vehicles")
    lines = path.read_text(encoding="utf-8").splitlines()
    while lines and (not lines[0].strip() or lines[0].startswith("#")):  # what is said there is of another vehicle
        del lines[0]
    document = tomlkit.parse("\n".join(lines) + "\n")
    link: Any = document["link"]
    link.pop("exclusive", None)  # whether anybody else listens was known of another vehicle's link
    for dotted, value in values.items():
        *tables, key = dotted.split(".")
        table: Any = document
        for name in tables:
            table = table[name]
        item = tomlkit.item(value)
        if table.get(key) != value and key != "name":
            item.comment(_said(dotted, calibration))
        table[key] = item
    if "calibration" in document:
        document.remove("calibration")
    added = tomlkit.table()
    added.comment("by `companion calibrate`; docs/calibration.md")
    for key, value in calibration.items():
        added[key] = value
    document["calibration"] = added
    head = f"# Calibrated on {calibration['date']} by `companion calibrate`, beginning with {path.name}:\n"
    text = head + tomlkit.dumps(document)
    validate(Vehicle, tomlkit.parse(text).unwrap(), "the calibrated vehicle file")
    return text


def _said(dotted: str, calibration: Mapping[str, Any]) -> str:
    """The comment of a number."""
    if dotted in {"body.mass_kg", "simulated"}:
        return "entered"
    if dotted.startswith("limits.") or dotted == "body.inertia_kg_m2":
        return "scaled with the mass and the thrust found"
    if dotted in {"autopilot.rate_integral_1_s", "autopilot.attitude_gain_1_s", "autopilot.attitude_lag_s"}:
        return "by the autopilot's parameters"
    if dotted.startswith("controller."):
        return "set by the calibration"
    return f"{FOUND} {calibration['date']}"


def template_of(name: str) -> Vehicle:
    """The file that a calibration begins with. Raises InputError."""
    path = find(name, "vehicles")
    return validate(Vehicle, read_toml(path), str(path))


def save(path: Path, text: str) -> None:
    """Writes the file; one that is there stays.

    Raises:
        InputError: it is there already, or cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path}: is there already; name another with --save") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _known(value: Any) -> float | None:
    return _rounded(float(value)) if isinstance(value, int | float) and value > 0 else None


def _rounded(value: float) -> float:
    """Five digits: more than any of it is worth."""
    return float(f"{value:.5g}")
