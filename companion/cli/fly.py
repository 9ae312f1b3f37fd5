"""The vehicle must be there: this waits for its heartbeat, checks its gates, takes off if it stands on the ground, and
flies.

Without --flight the vehicle file says everything: gains, limits, rates + thrust as output, Hold at the end.
"""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Any

import typer

from companion.cli.common import (
    EngineOption,
    FlightDisplay,
    JsonOption,
    OutOption,
    TimeScaleOption,
    VehicleOption,
    adjustments,
    report_flight,
    say,
    vehicle_changes,
)

EXAMPLE = "Example: companion fly circle --vehicle bundled --connect udpin:127.0.0.1:14540"


def run(
    trajectory: Annotated[str, typer.Argument(help="Trajectory file, or the name of a bundled one.")],
    connect: Annotated[
        str, typer.Option("--connect", help="udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD.")
    ] = "udpin:127.0.0.1:14540",
    vehicle: VehicleOption = None,
    flight: Annotated[
        str | None, typer.Option("--flight", metavar="NAME", help="Flight file with output, limits, acceptance.")
    ] = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    land: Annotated[bool, typer.Option("--land", help="Land at the end instead of holding.")] = False,
    time_scale: TimeScaleOption = None,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    out: OutOption = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Flies the trajectory and leaves a flight folder."""
    from companion.accelerate import resolve
    from companion.config import build_flight, find, load_flight
    from companion.errors import InputError
    from companion.flight.launch import control, prepare
    from companion.link.transport import parse_connection
    from companion.trajectory.load import embedded

    if flight is None and vehicle is None:
        raise InputError("say which vehicle this is: --vehicle NAME (a vehicle file), or --flight NAME (a flight file)")
    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    resolve(engine)
    parse_connection(connect)
    path = find(trajectory, "trajectories")
    changes: dict[str, Any] = {"trajectory": trajectory, "output__kind": output, "after": "land" if land else None}
    if flight is None:
        base = {"name": path.stem, "vehicle": vehicle, "trajectory": trajectory}
        configured = build_flight(base, "command line", adjustments(**changes))
    else:
        configured = load_flight(flight, adjustments(**changes, **vehicle_changes(vehicle)))
    folder = prepare(embedded(configured, time_scale), out)
    say(f"{configured.name}: {path.stem} on {configured.vehicle.name}, listening on {connect}", quiet=as_json)
    with FlightDisplay(quiet=as_json) as display:
        flown = control(folder, connect, engine, timeout, display)
    raise typer.Exit(report_flight(flown, as_json=as_json))
