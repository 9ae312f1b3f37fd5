"""Starts the bundled vehicle as a second process where the flight file says, and flies over UDP in lockstep: as fast as
this machine allows, and the same for the same seed."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from companion.cli.common import (
    ControllerOption,
    EngineOption,
    FaultsOption,
    FrameOption,
    JsonOption,
    LapsOption,
    LiveOption,
    OutOption,
    RealtimeOption,
    RerunFileOption,
    RerunOption,
    TimeScaleOption,
    TrajectoryOption,
    TurbulenceOption,
    VehicleKeyOption,
    VehicleOption,
    WindOption,
    adjustments,
    controller_changes,
    fault_file,
    flight_display,
    fly_bundled,
    report_flight,
    say_notes,
    trajectory_changes,
    vehicle_changes,
    wind_changes,
)

CONNECT_TIMEOUT_S = 15.0
EXAMPLE = "Example: companion demo --output attitude --out my-first-flight"


def run(
    flight: Annotated[str, typer.Option("--flight", help="Flight file with [start] and [world].")] = "paper",
    trajectory: TrajectoryOption = None,
    frame: FrameOption = None,
    vehicle: VehicleOption = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    controller: ControllerOption = None,
    px4: Annotated[str | None, typer.Option("--px4", help="1.13 or 1.18: which PX4 the vehicle behaves like.")] = None,
    state_age: Annotated[
        float | None, typer.Option("--state-age", metavar="S", help="Age of the vehicle's states when they arrive.")
    ] = None,
    wind: WindOption = None,
    turbulence: TurbulenceOption = None,
    time_scale: TimeScaleOption = None,
    laps: LapsOption = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of noise and gusts.")] = None,
    faults: FaultsOption = None,
    key: VehicleKeyOption = None,
    wall_clock: Annotated[
        bool, typer.Option("--wall-clock", help="Fly at the pace of the wall clock instead of as fast as possible.")
    ] = False,
    real_time: Annotated[bool, typer.Option("--real-time", hidden=True)] = False,  # what --wall-clock was called
    out: OutOption = None,
    engine: EngineOption = "auto",
    realtime: RealtimeOption = False,
    live: LiveOption = False,
    rerun: RerunOption = False,
    rerun_file: RerunFileOption = None,
    as_json: JsonOption = False,
) -> None:
    """Flies the demo and leaves a flight folder with report.html."""
    from companion.accelerate import resolve
    from companion.config import load_flight
    from companion.errors import InputError
    from companion.flight.bundled import PX4_VERSIONS, start_of
    from companion.flight.launch import prepare
    from companion.link.vehicle_link import VehicleLink
    from companion.trajectory.load import embedded, of_flight

    resolve(engine)
    if px4 is not None and px4 not in PX4_VERSIONS:
        raise InputError(f"--px4 {px4!r}: allowed are {', '.join(PX4_VERSIONS)}")
    changes: dict[str, Any] = {
        **vehicle_changes(vehicle),
        **trajectory_changes(trajectory, frame),
        **controller_changes(controller, output),
        **wind_changes(wind, turbulence),
        "vehicle__link__state_age_s": state_age,
        "vehicle__simulated": True,
        "world__seed": seed,
    }
    configured = embedded(load_flight(flight, adjustments(**changes)), time_scale, laps)
    start_of(configured)
    VehicleLink(key=key).check()
    say_notes(of_flight(configured).notes, quiet=as_json)
    faults_path = fault_file(faults)
    version = px4 or ("1.13" if configured.output.sends == "actuators" else "1.18")
    with flight_display(quiet=as_json, live=live, rerun=rerun, rerun_file=rerun_file) as display:
        folder = prepare(configured, out)
        flown = fly_bundled(
            configured,
            folder,
            px4=version,
            engine=engine,
            lockstep=not (wall_clock or real_time),
            faults=faults_path,
            timeout_s=CONNECT_TIMEOUT_S,
            quiet=as_json,
            display=display,
            realtime=realtime,
            key=key,
        )
    raise typer.Exit(report_flight(flown, as_json=as_json))
