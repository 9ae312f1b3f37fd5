"""Starts the bundled vehicle as a second process where the flight file says, and flies over UDP in lockstep: as fast as
this machine allows, and the same for the same seed."""

from __future__ import annotations

from collections.abc import Mapping
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

CONNECT_TIMEOUT_S = 15.0
EXAMPLE = "Example: companion demo --output attitude --out my-first-flight"


def run(
    flight: Annotated[str, typer.Option("--flight", help="Flight file with [start] and [world].")] = "paper",
    vehicle: VehicleOption = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    px4: Annotated[str | None, typer.Option("--px4", help="1.13 or 1.18: which PX4 the vehicle behaves like.")] = None,
    state_age: Annotated[
        float | None, typer.Option("--state-age", metavar="S", help="Age of the vehicle's states when they arrive.")
    ] = None,
    time_scale: TimeScaleOption = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of noise and gusts.")] = None,
    real_time: Annotated[bool, typer.Option("--real-time", help="Fly at real time instead of in lockstep.")] = False,
    out: OutOption = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Flies the demo and leaves a flight folder with report.html."""
    from companion.accelerate import resolve
    from companion.config import load_flight
    from companion.errors import InputError
    from companion.flight.bundled import PX4_VERSIONS, BundledVehicle, start_of
    from companion.flight.launch import control, prepare
    from companion.trajectory.load import embedded

    resolve(engine)
    if px4 is not None and px4 not in PX4_VERSIONS:
        raise InputError(f"--px4 {px4!r}: allowed are {', '.join(PX4_VERSIONS)}")
    changes: dict[str, Any] = {
        **vehicle_changes(vehicle),
        "output__kind": output,
        "vehicle__link__state_age_s": state_age,
        "world__seed": seed,
    }
    configured = embedded(load_flight(flight, adjustments(**changes)), time_scale)
    start_of(configured)
    folder = prepare(configured, out)
    version = px4 or ("1.13" if configured.output.kind == "actuators" else "1.18")
    with BundledVehicle(configured, folder, px4=version, engine=engine, lockstep=not real_time) as bundled:
        say(f"the bundled vehicle ({configured.vehicle.name}) waits in Hold; flight folder {folder}", quiet=as_json)
        with FlightDisplay(quiet=as_json) as display:

            def listen(message: Mapping[str, Any]) -> None:
                display(message)
                if "flown" in message:  # it would wait for a companion that has gone
                    bundled.stop()

            flown = control(folder, bundled.connection, engine, CONNECT_TIMEOUT_S, listen)
    raise typer.Exit(report_flight(flown, as_json=as_json))
