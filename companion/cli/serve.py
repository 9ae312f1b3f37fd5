"""The program on the vehicle: it waits for commands and trajectories of ground tools, and flies.

Two processes: one owns the vehicle link and flies, the other talks to ground tools; either is started again when it
dies. What it takes is in docs/mavlink.md. Ctrl-C hands a flight over to Hold first.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.common import (
    ControllerOption,
    EngineOption,
    JsonOption,
    RealtimeOption,
    VehicleKeyOption,
    VehicleSystemOption,
    controller_changes,
    say,
)

EXAMPLE = "Example: companion serve --vehicle px4_sih --connect udpin:127.0.0.1:14540"

CONNECTION = "udpin:127.0.0.1:14540"
GROUND = "udpin:127.0.0.1:14590"


def run(
    vehicle: Annotated[str, typer.Option("--vehicle", metavar="NAME", help="Vehicle file, or a bundled one's name.")],
    connect: Annotated[
        str, typer.Option("--connect", help="The vehicle: udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD.")
    ] = CONNECTION,
    ground: Annotated[
        list[str] | None,
        typer.Option("--ground", metavar="CONNECTION", help=f"For ground tools (repeatable); default {GROUND}."),
    ] = None,
    key: VehicleKeyOption = None,
    ground_key: Annotated[
        list[str] | None,
        typer.Option(
            "--ground-key",
            metavar="FILE",
            help="The key of a ground link: one for all of them, or one for each --ground in its order.",
        ),
    ] = None,
    system: VehicleSystemOption = None,
    ground_system: Annotated[
        list[int] | None,
        typer.Option(
            "--ground-system",
            metavar="ID",
            min=1,
            max=255,
            help="System id of a ground tool that may command and upload (repeatable); default 245, 254 and 255.",
        ),
    ] = None,
    allow_unsigned: Annotated[
        bool,
        typer.Option("--allow-unsigned", help="Open ground links without a key to the network: anybody can fly."),
    ] = False,
    folder: Annotated[
        Path, typer.Option("--folder", metavar="DIR", help="The trajectories that may be started.")
    ] = Path("trajectories"),
    flights: Annotated[Path, typer.Option("--flights", metavar="DIR", help="Gets a folder for every flight.")] = Path(
        "flights"
    ),
    flight: Annotated[
        str | None,
        typer.Option(
            "--flight", metavar="NAME", help="Flight file with output, limits, gains; its trajectory is not flown."
        ),
    ] = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    controller: ControllerOption = None,
    reports: Annotated[
        bool, typer.Option("--reports/--no-reports", help="Build report.html after every flight, at a low priority.")
    ] = True,
    engine: EngineOption = "auto",
    realtime: RealtimeOption = False,
    as_json: JsonOption = False,
) -> None:
    """Waits for commands and flies, until it is stopped."""
    from companion.accelerate import resolve
    from companion.cli.steady_output import SteadyOutput
    from companion.ground.exposure import check_ground, ground_keys, open_vehicle_link
    from companion.ground.settings import GROUND_SYSTEMS, Settings
    from companion.ground.supervisor import Supervisor
    from companion.link.vehicle_link import VehicleLink

    resolve(engine)
    links = tuple(ground or [GROUND])
    link = VehicleLink(connect, key, system)
    link.check()
    keys = ground_keys(links, tuple(ground_key or ()))
    check_ground(links, keys, allow_unsigned=allow_unsigned)
    if warning := open_vehicle_link(link):
        say(f"warning: {warning}", quiet=as_json)
    settings = Settings(
        connection=connect,
        ground=links,
        trajectories=str(_usable(folder, "--folder")),
        flights=str(_usable(flights, "--flights")),
        engine=engine,
        realtime=realtime,
        reports=reports,
        key=None if key is None else str(Path(key).absolute()),
        system=system,
        ground_keys=keys,
        ground_systems=tuple(ground_system or GROUND_SYSTEMS),
        flight=_flight(vehicle, flight, controller_changes(controller, output)),
    )

    with contextlib.ExitStack() as outputs:
        documents = outputs.enter_context(SteadyOutput(sys.stdout))
        told = outputs.enter_context(SteadyOutput(sys.stderr)) if as_json else documents

        def ready(control_pid: int, ground_pid: int) -> None:
            facts = {"connect": connect, "ground": list(links), "control_pid": control_pid, "ground_pid": ground_pid}
            if as_json:
                documents.say(json.dumps({"ready": True, **facts}))
            told.say(f"ready: vehicle link {connect}, ground links {', '.join(links)}")

        supervisor = Supervisor(settings, lambda line: told.say(f"  {line}"), ready)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda number, _: supervisor.stop(number))
        code = supervisor.run()
    raise typer.Exit(code)


def _usable(folder: Path, option: str) -> Path:
    """The folder, there and writable.

    Raises:
        InputError: it is not.
    """
    from companion.errors import InputError

    folder = folder.expanduser().absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {folder}: cannot be made ({error.strerror})") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{option} {folder}: may not be written to")
    return folder


def _flight(vehicle: str, flight: str | None, changes: dict[str, Any]) -> dict[str, Any]:
    """What every flight has in common, checked: the gates of the gains are passed before anything connects.

    Raises:
        InputError, RefusedError: a file is wrong, or the gains do not pass.
    """
    from companion.cli.common import adjustments, vehicle_changes
    from companion.config import build_flight, load_flight
    from companion.flight.preflight import gate_gains

    hover = {"name": "hover", "shape": "hover", "duration_s": 1.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}
    adjust = adjustments(**changes)
    if flight is None:
        built = build_flight({"name": "serve", "vehicle": vehicle, "trajectory": hover}, "command line", adjust)
    else:
        built = load_flight(flight, adjustments(**changes, **vehicle_changes(vehicle), trajectory=hover))
    if built.output.controller == "law":
        gate_gains(built.vehicle, built.output.by_law)
    own = {"name", "trajectory", "start", "world", "statistics_from_s"}  # of one flight, or of a simulated vehicle
    return built.model_dump(mode="json", exclude=own, exclude_none=True)
