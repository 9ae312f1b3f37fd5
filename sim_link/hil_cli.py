"""`sim-link hil`: the simulated vehicle's body as the world of a real PX4."""

from __future__ import annotations

import gc
import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from .cli_values import ENGINES, InputError, Stop, choice, number, port_or, refuse, tell, vector
from .fault_file import load as load_faults
from .fault_keys import FaultError
from .hil import Hil, HilOptions
from .hil_link import HilServer
from .truth_log import TruthLog
from .vehicle_file import VehicleFileError, load
from .wind import World

EXAMPLE = "Example: sim-link hil --wind 3,0,0 --turbulence 0.15, and PX4 with PX4_SIM_MODEL=none_iris"
_EXIT_LOST = 4


def run(
    vehicle: Annotated[str, typer.Option(help="Vehicle file, or the name of a bundled one.")] = "px4_iris",
    instance: Annotated[int, typer.Option(min=0, max=249, help="Number i of PX4: port 4560 + i.")] = 0,
    wind: Annotated[str, typer.Option(metavar="N,E,D", help="Wind, where it blows to [m/s].")] = "0,0,0",
    turbulence: Annotated[float, typer.Option(min=0.0, help="Gusts: standard deviation over mean wind.")] = 0.0,
    force: Annotated[str, typer.Option(metavar="N,E,D", help="Constant force [N].")] = "0,0,0",
    gravity_factor: Annotated[float, typer.Option(help="Gravity over 9.81 m/s^2.")] = 1.0,
    faults: Annotated[
        str | None, typer.Option(metavar="FILE", help="What goes wrong with body and air: a fault file.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the sensors' noise and of the gusts.")] = 1,
    speed: Annotated[float, typer.Option(help="Vehicle time per wall time, at most.")] = 1.0,
    duration: Annotated[float | None, typer.Option(metavar="S", help="End after this vehicle time [s].")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="FILE", help="Write what really happens as CSV.")] = None,
    once: Annotated[bool, typer.Option("--once", help="End when PX4 leaves; else wait for the next one.")] = False,
    engine: Annotated[str, typer.Option(help="auto, python or numba.")] = "auto",
    listen: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Interface to listen at; 0.0.0.0: PX4 on other machines.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option(help="TCP port; 0: any free; default 4560 + i.")] = None,
    json_ready: Annotated[bool, typer.Option("--json-ready", help="Print one line of JSON once ready.")] = False,
    with_parent: Annotated[bool, typer.Option("--with-parent", help="End when the starting process ends.")] = False,
) -> None:
    """Be the world of a real PX4 in simulation: its sensors, its rotors, the air. Until Ctrl-C.

    PX4 connects by TCP and runs in lockstep; every PX4 that connects finds the vehicle on the ground, at rest, and
    --truth and the times of faults begin anew. docs/hil.md says how to start PX4. Exit code 2: bad input, or a port in
    use; 4: with --once, PX4 left before the time was over.
    """
    stop = Stop(with_parent)
    try:
        options = HilOptions(
            vehicle=load(vehicle),
            world=World(
                force_n=vector(force, "--force"),
                gravity_factor=number(gravity_factor, "--gravity-factor", above=0.0),
                wind_m_s=vector(wind, "--wind"),
                turbulence=number(turbulence, "--turbulence"),
                seed=seed,
            ),
            seed=seed,
            speed=number(speed, "--speed", above=0.0),
            engine=choice(engine, ENGINES, "--engine"),
            faults=() if faults is None else load_faults(faults),
        )
        if duration is not None:
            number(duration, "--duration", above=0.0)
        server = HilServer(port_or(port, 4560 + instance, "--port"), listen)
        hil = Hil(options, server, stopped=stop, notice=tell)
        if truth is not None:
            TruthLog(truth).close()  # refused now, not in the air
    except (InputError, VehicleFileError, FaultError, ImportError) as error:
        refuse(str(error))
    except OSError as error:  # the port, or the truth file
        refuse(str(error) if error.strerror is None else f"{error.filename}: {error.strerror}")
    _announce(hil, listen, json_ready)
    gc.collect()
    gc.freeze()
    try:
        lost = _serve(hil, stop, truth, duration, once)
    finally:
        hil.close()
    if lost:
        raise typer.Exit(_EXIT_LOST)


def _serve(hil: Hil, stop: Stop, truth: Path | None, duration_s: float | None, once: bool) -> bool:
    """Serve one PX4 after the other. True: the only one that was to be served left early."""
    while not stop():
        if truth is not None:
            hil.log_truth(TruthLog(truth))
        complete = hil.run(duration_s)
        if once or (complete and duration_s is not None):
            return not complete and not stop()
    return False


def _announce(hil: Hil, address: str, as_json: bool) -> None:
    """Say where PX4 finds its world."""
    port, name = hil.server.port, hil.options.vehicle.name
    if as_json:
        line = json.dumps({"ready": True, "pid": os.getpid(), "port": port, "vehicle": name})
    else:
        line = f"{name}: waiting for PX4 at TCP {address}:{port}"
    typer.echo(line)
    sys.stdout.flush()
