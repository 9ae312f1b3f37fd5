"""Flies a vehicle through small steps and straight runs, finds its hover thrust, thrust curve, motor lag, rate loops,
delay and drag from the record, and writes a dated vehicle file that `--vehicle` accepts.

The vehicle must be there and holding in the air, or ready to take off. It needs free space of --radius around where it
holds, and as much height and 2 m more. The mass is entered (10 % will do); nothing else about the vehicle needs to be
known. --vehicle names a file to begin with: its gains, limits and geometry stay.

It ends in Hold, or there at once when the vehicle leaves its space, tilts, or the pilot takes over. With --from-flight
nothing is flown: a flight's folder tells what it can. With --sim the bundled vehicle is calibrated. docs/calibration.md
says how it works.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.common import (
    Display,
    EngineOption,
    FaultsOption,
    JsonOption,
    OutOption,
    VehicleKeyOption,
    VehicleSystemOption,
    adjustments,
    fault_file,
    flight_display,
    fly_bundled,
    say,
)

if TYPE_CHECKING:
    from companion.config import Flight
    from companion.flight.launch import Flown
    from companion.identification.identify import Identified
    from companion.identification.vehicle_file import Entered
    from companion.link.vehicle_link import VehicleLink

EXAMPLE = "Example: companion calibrate --mass 1.2 --vehicle bundled --connect udpin:127.0.0.1:14540"
CONNECTION = "udpin:127.0.0.1:14540"
TILT_MAX_RAD = 0.7
HEIGHT_ROOM_M = 2.0
STATE_AGE_MAX_S = 0.15
START_M = (0.0, 0.0)
OF_THE_FLIGHT = (
    *("key", "system", "timeout", "out", "engine"),
    *("height", "radius", "speed", "rate_step", "thrust_step", "repeats"),
)
"""Options that say how it is flown: they mean nothing for a flight that is there."""


def run(
    context: typer.Context,
    mass: Annotated[float, typer.Option("--mass", metavar="KG", help="Take-off mass, known to 10 %.")],
    vehicle: Annotated[
        str, typer.Option("--vehicle", metavar="NAME", help="Vehicle file to begin with: gains, limits, geometry.")
    ] = "bundled",
    name: Annotated[
        str | None, typer.Option("--name", help="The vehicle's name; default: that of the file it begins with.")
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option(
            "--connect",
            help="udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; default udpin:127.0.0.1:14540.",
        ),
    ] = None,
    key: VehicleKeyOption = None,
    system: VehicleSystemOption = None,
    sim: Annotated[
        bool, typer.Option("--sim", help="Start the bundled vehicle of --vehicle and calibrate it.")
    ] = False,
    faults: FaultsOption = None,
    from_flight: Annotated[
        Path | None, typer.Option("--from-flight", metavar="FOLDER", help="Fly nothing: use this flight.")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE", help="The new vehicle file; default: in the flight's folder."),
    ] = None,
    height: Annotated[float, typer.Option("--height", metavar="M", help="Of the take-off, where it stands.")] = 10.0,
    radius: Annotated[float, typer.Option("--radius", metavar="M", help="Free space around the hover.")] = 6.0,
    speed: Annotated[float, typer.Option("--speed", metavar="M/S", help="Largest of the straight runs.")] = 2.5,
    rate_step: Annotated[
        float, typer.Option("--rate-step", metavar="RAD/S", help="Of roll and pitch; yaw gets a third.")
    ] = 0.8,
    thrust_step: Annotated[
        float, typer.Option("--thrust-step", metavar="SHARE", help="Of the thrust that hovers.")
    ] = 0.3,
    repeats: Annotated[int, typer.Option("--repeats", help="Of the steps.")] = 2,
    simulator: Annotated[
        bool, typer.Option("--simulator", help="The vehicle is a simulator: the new file says so.")
    ] = False,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    out: OutOption = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Calibrates a vehicle and leaves a vehicle file."""
    from companion.errors import InputError
    from companion.identification.vehicle_file import Entered, template_of
    from companion.link.vehicle_link import VehicleLink

    template = template_of(vehicle)
    if not (isfinite(mass) and mass > 0.0):
        raise InputError(f"--mass {mass:g}: must be a number of kilograms above 0")
    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    if sum((sim, connect is not None, from_flight is not None)) > 1:
        raise InputError("--sim, --connect and --from-flight say where the flight comes from: leave all but one out")
    if from_flight is not None:
        _refuse_idle(context)
    if faults is not None and not sim:
        raise InputError(f"--faults {faults}: only for the bundled vehicle; add --sim")
    if save is not None:
        _check_free(save)
    entered = Entered(name or template.name, mass, 0.1, sim or simulator)
    if from_flight is not None:
        folder = from_flight
    else:
        link = VehicleLink(connect or CONNECTION, key, system)
        link.check()
        plan = {
            **{"rate_step_rad_s": rate_step, "thrust_step": thrust_step, "run_speed_m_s": speed, "repeats": repeats},
            "run_length_m": min(5.0, radius),
        }
        flight = configured(vehicle, entered, plan, height_m=height, radius_m=radius, start=sim)
        flown = _fly(
            *(flight, link),
            sim=sim,
            out=out,
            engine=engine,
            timeout_s=timeout,
            quiet=as_json,
            faults=fault_file(faults),
        )
        if flown.exit_code != 0:
            _tell_failure(flown, as_json=as_json)
        say(f"{flown.sentence}; flight folder {flown.folder}", quiet=as_json)
        folder = flown.folder
    _identify(folder, vehicle, entered, save, as_json=as_json)


def _refuse_idle(context: typer.Context) -> None:
    """Raise InputError where an option of the flight is given, and none is flown."""
    from companion.errors import InputError

    sources = ((name, context.get_parameter_source(name)) for name in OF_THE_FLIGHT)
    given = [f"--{name.replace('_', '-')}" for name, source in sources if source and source.name == "COMMANDLINE"]
    if given:
        raise InputError(f"{', '.join(given)}: with --from-flight nothing is flown; leave out what says how")


def configured(
    vehicle: str, entered: Entered, plan: Mapping[str, Any], *, height_m: float, radius_m: float, start: bool
) -> Flight:
    """The flight of a calibration.

    Args:
        vehicle: the file to begin with.
        entered: the mass.
        plan: the table [calibration].
        height_m: of the take-off, or where the bundled vehicle waits.
        radius_m: free space around the hover.
        start: whether the bundled vehicle waits in the air.

    Raises:
        InputError: a value is not allowed.
    """
    from companion.config import CalibrationFlight, build_flight, validate
    from companion.errors import InputError
    from companion.flight.manoeuvres import length_s
    from companion.flight.manoeuvres import plan as manoeuvres

    if not (isfinite(radius_m) and radius_m >= 2.0):
        raise InputError(f"--radius {radius_m:g}: at least 2 m are needed")
    if not (isfinite(height_m) and height_m >= radius_m + HEIGHT_ROOM_M):
        raise InputError(f"--height {height_m:g}: --radius and {HEIGHT_ROOM_M:g} m are needed, {radius_m + 2.0:g} m")
    settings = validate(CalibrationFlight, plan, "command line: calibration")
    duration_s = length_s(manoeuvres(settings))
    hover = {"name": "hover", "shape": "hover", "duration_s": duration_s, "hover": {"point_m": [0.0, 0.0, 0.0]}}
    data: dict[str, Any] = {
        "name": "calibration",
        "vehicle": vehicle,
        "trajectory": hover,
        "output": {"controller": "calibration", "kind": "rates"},
        "calibration": dict(plan),
        "takeoff_altitude_m": height_m,
        "height_min_m": radius_m + HEIGHT_ROOM_M - 0.5,
        "limits": {
            **{"position_error_abort_m": radius_m, "tilt_max_rad": TILT_MAX_RAD},
            "state_age_max_s": STATE_AGE_MAX_S,
        },
    }
    if start:
        data["start"] = {"position_m": [*START_M, -height_m]}
    # What the file to begin with says of its own vehicle's link need not hold for this one.
    return build_flight(data, "command line", adjustments(vehicle__link__exclusive=False))


def _fly(
    flight: Flight,
    link: VehicleLink,
    *,
    sim: bool,
    out: Path | None,
    engine: str,
    timeout_s: float,
    quiet: bool,
    faults: Path | None,
) -> Flown:
    """Flies the manoeuvres; with `sim` on the bundled vehicle."""
    from companion.flight.launch import control, prepare

    with flight_display(quiet=quiet, live=False, rerun=False, rerun_file=None) as display:
        folder = prepare(flight, out)
        if sim:
            return fly_bundled(
                *(flight, folder),
                px4="1.18",
                engine=engine,
                lockstep=True,
                faults=faults,
                timeout_s=timeout_s,
                quiet=quiet,
                display=display,
                key=link.key,
            )
        where = f"listening on {link.connection}; flight folder {folder}"
        say(f"calibration of {flight.vehicle.name}, {where}", quiet=quiet)
        listen: Display = display
        return control(folder, link, engine, timeout_s, listen)


def _tell_failure(flown: Flown, *, as_json: bool) -> None:
    """A flight that did not come to its end is not fitted.

    Raises:
        Exit: always.
    """
    said = f"{flown.sentence}; nothing was calibrated. The flight folder: {flown.folder}"
    say(f"companion: {said}", quiet=True)
    if as_json:
        print(
            json.dumps({"ended": flown.sentence, "folder": str(flown.folder), "exit_code": flown.exit_code}, indent=2)
        )
    raise typer.Exit(flown.exit_code)


def _identify(folder: Path, template: str, entered: Entered, save: Path | None, *, as_json: bool) -> None:
    """Fits, tells, and writes the file."""
    from companion.errors import RefusedError
    from companion.identification.data import flight_data
    from companion.identification.identify import identify, rate_integrals
    from companion.identification.vehicle_file import provenance, template_of, vehicle_values, written
    from companion.identification.vehicle_file import save as save_file
    from companion.record.flight_source import read_source

    source = read_source(folder)
    facts = source.summary.get("vehicle_facts", {})
    begun = template_of(template)
    parameters = facts.get("parameters", {})
    integrals = rate_integrals(parameters, begun.autopilot.rate_integral_1_s)
    found = identify(
        flight_data(source),
        integrals,
        curved=not parameters.get("THR_MDL_FAC", 0.0) > 0.0,
        progress=lambda what: say(f"  fitting {what}", quiet=as_json),
    )
    if found.rare:
        raise RefusedError(
            f"{folder}: states every {_ms(found.interval_s)} are too far apart to tell the lag of:"
            f" {', '.join(found.rare)}; let them come more often (link.state_rate_hz of the vehicle file)"
        )
    if found.lacking:
        raise RefusedError(
            f"{folder}: the flight does not tell enough about: {', '.join(found.lacking)}; larger steps or more repeats"
            " of `companion calibrate` do"
        )
    day = datetime.now(UTC).date()
    calibration = provenance(found, facts, entered, folder, day)
    text = written(template, vehicle_values(begun, entered, found, facts), calibration)
    path = save or _default_path(folder, entered.name, day.isoformat())
    save_file(path, text)
    document = _document(found, calibration, str(path))
    warnings = _warnings(found, facts, path)
    if as_json:
        print(json.dumps({**document, "warnings": warnings, "exit_code": 0}, indent=2))
        return
    _print(found, begun_with=template, facts=facts)
    for warning in warnings:
        say(f"warning: {warning}")
    say(f"vehicle file: {path}")


def _check_free(path: Path) -> None:
    """Raise InputError where the new file could not be written: nobody wants to hear it after the flight."""
    from companion.errors import InputError

    if path.exists():
        raise InputError(f"{path}: is there already; name another with --save")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: cannot be written: there is no folder {path.parent}; make it, or name another")


def _default_path(folder: Path, name: str, day: str) -> Path:
    parent = folder if folder.is_dir() else folder.parent
    safe = "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
    path, count = parent / f"{safe}-{day}.toml", 1
    while path.exists():
        count += 1
        path = parent / f"{safe}-{day}-{count}.toml"
    return path


def _warnings(found: Identified, facts: Mapping[str, Any], path: Path) -> list[str]:
    """What people should know before they fly with the file."""
    from companion.config import load_vehicle
    from companion.errors import CompanionError
    from companion.flight.preflight import gate_gains

    said = []
    hold, ours = facts.get("hold_thrust"), found.motion.hover_share
    if isinstance(hold, int | float) and abs(hold - ours) > 0.05 * ours:
        said.append(f"Hold hovered at {hold:.3f}, the manoeuvres say {ours:.3f}: wind, or a battery that sags")
    if found.age_s is None:
        said.append("the clocks did not tell the age of the states: the delay is known as a whole only")
    if found.motion.drag_1_s < 0.0:
        said.append(f"the drag came out as {found.motion.drag_1_s:.3f} 1/s and is taken as 0")
    try:
        gate_gains(load_vehicle(str(path)), brief=True)
    except CompanionError as error:
        said.append(f"a flight with this file would be refused: {error}")
    return said


def _document(found: Identified, calibration: Mapping[str, Any], path: str) -> dict[str, Any]:
    """What was found, for programs."""
    return {
        "vehicle_file": path,
        "calibration": dict(calibration),
        "delay_s": found.delay_s,
        "state_age_s": found.age_s,
        "thrust": found.motion._asdict() | {"hover_share": found.motion.hover_share},
        "thrust_own_delay": found.motion_own._asdict(),
        "rates": [None if fit is None else fit._asdict() for fit in found.rates],
        "rates_own_delay": [None if fit is None else fit._asdict() for fit in found.own],
        "duration_s": found.duration_s,
    }


def _print(found: Identified, *, begun_with: str, facts: Mapping[str, Any]) -> None:
    """The table: what was found, how sure it is, and what the file that it began with said."""
    from rich.console import Console
    from rich.table import Table

    from companion.control.output import thrust_fraction
    from companion.control.types import GRAVITY_M_S2
    from companion.identification.identify import AXES
    from companion.identification.vehicle_file import template_of

    before, motion = template_of(begun_with), found.motion
    hover = thrust_fraction(before.body.mass_kg * GRAVITY_M_S2, before.thrust_full_n, before.rotors.curve_factor)
    hold = facts.get("hold_thrust")
    told = f"Hold: {hold:.4f}" if isinstance(hold, int | float) else "Hold: not told"
    rows = [
        ("hover thrust", f"{motion.hover_share:.4f}", told, f"{hover:.4f}"),
        (
            "full thrust over mass",
            f"{motion.full_m_s2:.2f} m/s^2",
            f"{motion.full_sd_m_s2:.2f}",
            f"{before.thrust_full_n / before.body.mass_kg:.2f}",
        ),
        (
            "thrust curve",
            f"{motion.curve_factor:.3f}",
            f"{found.motion_own.curve_sd:.3f}",
            f"{before.rotors.curve_factor:g}",
        ),
        ("motor lag", _ms(motion.lag_s), _ms(motion.lag_sd_s), _ms(before.rotors.lag_s)),
        ("drag", f"{motion.drag_1_s:.3f} 1/s", f"{motion.drag_sd_1_s:.3f}", f"{before.body.drag_1_s:g}"),
    ]
    for axis, fit, own, lag in zip(AXES, found.rates, found.own, before.autopilot.rate_lag_s, strict=True):
        if fit is not None and own is not None:
            rows.append((f"{axis} rate lag", _ms(fit.lag_s), _ms(fit.lag_sd_s), _ms(lag)))
            apart = f"{_ms(own.lag_s)} behind {_ms(own.delay_s)}"
            rows.append(("  with its own delay", apart, f"{1e3 * own.residual_rad_s:.1f} mrad/s left", ""))
    age = "not told" if found.age_s is None else _ms(found.age_s)
    rows += [
        ("age of states", age, "", _ms(before.link.state_age_s)),
        ("delay of commands", _ms(found.delay_s), _ms(found.motion_own.delay_sd_s), _ms(before.link.command_delay_s)),
        ("velocity residual", f"{1e3 * motion.residual_m_s:.1f} mm/s", "", ""),
    ]
    table = Table(box=None, pad_edge=False)
    for column in ("what", "found", "+-", f"in {before.name}"):
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False).print(table)


def _ms(value_s: float) -> str:
    return f"{1e3 * value_s:.1f} ms"
