"""The vehicle must be there: this waits for its heartbeat, checks its gates, takes off if it stands on the ground, and
flies. With --sim it starts the bundled vehicle itself, in lockstep, on the ground or at the flight file's [start].
A vehicle whose file has no [calibration] is refused (`companion calibrate`), unless it is a simulator.

Without --flight the vehicle file says everything: gains, limits, rates + thrust as output, Hold at the end.
"""

from __future__ import annotations

from math import isfinite
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
    VehicleKeyOption,
    VehicleOption,
    VehicleSystemOption,
    adjustments,
    controller_changes,
    fault_file,
    flight_display,
    fly_bundled,
    report_flight,
    say,
    say_notes,
    trajectory_changes,
    vehicle_changes,
)

EXAMPLE = "Example: companion fly circle --vehicle bundled --connect udpin:127.0.0.1:14540"

CONNECTION = "udpin:127.0.0.1:14540"


def run(
    trajectory: Annotated[str, typer.Argument(help="Trajectory file, or the name of a bundled one.")],
    connect: Annotated[
        str | None,
        typer.Option(
            "--connect",
            help="udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; default udpin:127.0.0.1:14540.",
        ),
    ] = None,
    key: VehicleKeyOption = None,
    system: VehicleSystemOption = None,
    sim: Annotated[bool, typer.Option("--sim", help="Start the bundled vehicle and fly that.")] = False,
    simulator: Annotated[
        bool, typer.Option("--simulator", help="The vehicle is a simulator: it needs no calibration.")
    ] = False,
    faults: FaultsOption = None,
    vehicle: VehicleOption = None,
    flight: Annotated[
        str | None, typer.Option("--flight", metavar="NAME", help="Flight file with output, limits, acceptance.")
    ] = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    controller: ControllerOption = None,
    takeoff: Annotated[
        str | None,
        typer.Option("--takeoff", help='By the "autopilot" (default), or in "offboard", without a global position.'),
    ] = None,
    land: Annotated[bool, typer.Option("--land", help="Land at the end instead of holding.")] = False,
    time_scale: TimeScaleOption = None,
    laps: LapsOption = None,
    frame: FrameOption = None,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    out: OutOption = None,
    engine: EngineOption = "auto",
    realtime: RealtimeOption = False,
    live: LiveOption = False,
    rerun: RerunOption = False,
    rerun_file: RerunFileOption = None,
    as_json: JsonOption = False,
) -> None:
    """Flies the trajectory and leaves a flight folder."""
    from companion.accelerate import resolve
    from companion.config import build_flight, find, load_flight
    from companion.errors import InputError
    from companion.flight.launch import control, prepare
    from companion.link.vehicle_link import VehicleLink
    from companion.trajectory.formats.reading import shown
    from companion.trajectory.load import embedded, of_flight

    if flight is None and vehicle is None:
        raise InputError("say which vehicle this is: --vehicle NAME (a vehicle file), or --flight NAME (a flight file)")
    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    if sim and connect is not None:
        raise InputError(f"--sim starts the bundled vehicle, --connect {connect} names another: leave one out")
    if sim and system is not None:
        raise InputError(f"--sim starts the bundled vehicle, --system {system} names another: leave one out")
    if faults is not None and not sim:
        raise InputError(f"--faults {faults}: only for the bundled vehicle; add --sim")
    resolve(engine)
    connection = connect or CONNECTION
    link = VehicleLink(connection, key, system)
    link.check()
    faults_path = fault_file(faults)
    name = shown(find(trajectory, "trajectories").stem)
    changes: dict[str, Any] = {
        **trajectory_changes(trajectory, frame),
        "after": "land" if land else None,
        "takeoff": takeoff,
        "vehicle__simulated": True if sim or simulator else None,
        **controller_changes(controller, output),
    }
    if flight is None:
        base = {"name": name, "vehicle": vehicle, "trajectory": trajectory}
        configured = build_flight(base, "command line", adjustments(**changes))
    else:
        configured = load_flight(flight, adjustments(**changes, **vehicle_changes(vehicle)))
    complete = embedded(configured, time_scale, laps)
    say_notes(of_flight(complete).notes, quiet=as_json)
    with flight_display(quiet=as_json, live=live, rerun=rerun, rerun_file=rerun_file) as display:
        folder = prepare(complete, out)
        if sim:
            flown = fly_bundled(
                complete,
                folder,
                px4="1.13" if complete.output.sends == "actuators" else "1.18",
                engine=engine,
                lockstep=True,
                faults=faults_path,
                timeout_s=timeout,
                quiet=as_json,
                display=display,
                realtime=realtime,
                key=key,
            )
        else:
            say(f"{configured.name}: {name} on {configured.vehicle.name}, listening on {connection}", quiet=as_json)
            flown = control(folder, link, engine, timeout, display, realtime=realtime)
    raise typer.Exit(report_flight(flown, as_json=as_json))
