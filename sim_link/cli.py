"""The command line of the simulated vehicle: `sim-link run`."""

from __future__ import annotations

import gc
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from math import radians
from pathlib import Path
from typing import Annotated

import typer

from . import fault_cli, hil_cli
from .cli_values import (
    ENGINES,
    InputError,
    Stop,
    choice,
    number,
    numbers,
    port_or,
    refuse,
    tell,
    vector,
)
from .cores import take_core_of_two
from .fault_file import load as load_faults
from .fault_keys import FaultError
from .fleet import SPACING_M, SYSTEMS_MAX, Fleet, siblings
from .parameters import ParameterError, Parameters
from .peer import Peer, PeerOptions
from .rotation import Vec3
from .signing import KeyFileError, load_key
from .truth_log import TruthLog
from .vehicle import PX4_VERSIONS, Vehicle, VehicleError, VehicleOptions
from .vehicle_file import VehicleFile, VehicleFileError, load
from .wind import World

FAULTS_SUFFIX = ".faults.csv"
"""In the place of the truth file's own."""
STATE_RATE_MIN_HZ = 1.0
"""Between two states nobody is heard, and no Ctrl-C either."""
_SITL_SECOND_RANGE = 10
"""From this instance on PX4's ports would run into one another; ours go on 10000 higher."""

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


def _show_version(wanted: bool) -> None:
    if wanted:
        try:
            number = version("offboard-companion")
        except PackageNotFoundError:
            number = "unknown (not installed)"
        typer.echo(f"sim-link {number}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    """A simulated PX4 multirotor that speaks MAVLink over UDP."""


@app.command(epilog="Example: sim-link run --vehicle paper --start 30,-20,-20 --force 4.76,0,0 --lockstep")
def run(
    vehicle: Annotated[str, typer.Option(help="Vehicle file, or the name of a bundled one.")] = "paper",
    instance: Annotated[int, typer.Option(min=0, max=249, help="Number i: system id 1 + i, ports shifted by i.")] = 0,
    count: Annotated[int, typer.Option(min=1, metavar="N", help="So many vehicles, from instance i on.")] = 1,
    spacing: Annotated[float, typer.Option(metavar="M", help="Between two of --count, eastwards.")] = SPACING_M,
    start: Annotated[
        str | None, typer.Option(metavar="N,E,D[,YAW_DEG]", help="Wait in the air there, armed, in Hold.")
    ] = None,
    force: Annotated[str, typer.Option(metavar="N,E,D", help="Constant force [N].")] = "0,0,0",
    gravity_factor: Annotated[float, typer.Option(help="Gravity over 9.81 m/s^2.")] = 1.0,
    wind: Annotated[str, typer.Option(metavar="N,E,D", help="Wind, where it blows to [m/s].")] = "0,0,0",
    turbulence: Annotated[float, typer.Option(min=0.0, help="Gusts: standard deviation over mean wind.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Of noise and gusts.")] = 1,
    state_rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="States per second; default: the file's.")
    ] = None,
    state_age: Annotated[
        float | None, typer.Option(metavar="S", help="Age of a state [s]; default: the file's.")
    ] = None,
    px4: Annotated[str, typer.Option(help="Whose behaviour: 1.18 or 1.13.")] = "1.18",
    lockstep: Annotated[bool, typer.Option("--lockstep", help="The clock waits for the companion.")] = False,
    speed: Annotated[float, typer.Option(help="Vehicle time per wall time; not with --lockstep.")] = 1.0,
    truth: Annotated[Path | None, typer.Option(metavar="FILE", help="Write what really happens as CSV.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="End after this vehicle time [s].")] = None,
    engine: Annotated[str, typer.Option(help="auto, python or numba.")] = "auto",
    param: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set an autopilot parameter (repeatable).")
    ] = None,
    faults: Annotated[
        str | None, typer.Option(metavar="FILE", help="What goes wrong: a fault file, or the name of a bundled one.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Sign with the key in this file, and believe nobody else.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="Companion link, own port; 0: any free; default 14580 + i.")] = None,
    remote_port: Annotated[
        int | None, typer.Option(help="Companion link, port spoken to first; 0: none; default 14540 + i.")
    ] = None,
    ground_port: Annotated[
        int | None, typer.Option(help="Ground link, own port; default 18570 + i, or any free with --port 0.")
    ] = None,
    ground_remote_port: Annotated[int, typer.Option(help="Ground link, port spoken to first.")] = 14550,
    ground: Annotated[bool, typer.Option("--ground/--no-ground", help="Have a ground link.")] = True,
    truth_port: Annotated[int | None, typer.Option(help="The truth as MAVLink goes there; default 19410 + i.")] = None,
    truth_stream: Annotated[bool, typer.Option("--truth-stream/--no-truth-stream", help="Send the truth.")] = True,
    json_ready: Annotated[bool, typer.Option("--json-ready", help="Print one line of JSON once ready.")] = False,
    with_parent: Annotated[bool, typer.Option("--with-parent", help="End when the starting process ends.")] = False,
) -> None:
    """Fly a simulated PX4 multirotor and speak MAVLink for it, until Ctrl-C.

    Companion link: from port 14580 + i to 127.0.0.1:14540 + i (from i = 10 on 24580 + i and 24540 + i). Ground link:
    18570 + i to 14550. The truth goes to 19410 + i. Exit code 2: bad input, or a port in use.

    With --count N there are N vehicles, side by side, each with its own system id, ports, seed (the next one) and, with
    --truth FILE.csv, file (FILE-2.csv for system 2). Ports given by hand are the first vehicle's. In lockstep each
    follows its own companion.

    With --key FILE, whose 32 bytes (raw or in hexadecimal) nobody else may read, all links are signed (MAVLink 2). A
    vehicle without a key takes one by SETUP_SIGNING while it is disarmed.

    With --truth FILE.csv, what went wrong and when is written to FILE.faults.csv. docs/faults.md lists what can.
    """
    stop = Stop(with_parent)
    try:
        _refuse_what_would_do_nothing(
            ground=ground_port is not None and not ground,
            truth=truth_port is not None and not truth_stream,
            speed=speed != 1.0 and lockstep,
        )
        file = _vehicle_file(vehicle, state_rate, state_age)
        secret, signing_time = (None, 0) if key is None else load_key(key)
        world = World(
            force_n=vector(force, "--force"),
            gravity_factor=number(gravity_factor, "--gravity-factor", above=0.0),
            wind_m_s=vector(wind, "--wind"),
            turbulence=number(turbulence, "--turbulence"),
            seed=seed,
        )
        options = VehicleOptions(
            vehicle=file,
            world=world,
            instance=instance,
            start=_pose(start),
            seed=seed,
            px4=choice(px4, PX4_VERSIONS, "--px4"),
            engine=choice(engine, ENGINES, "--engine"),
            parameters=_parameters(param or [], px4),
            faults=() if faults is None else load_faults(faults, px4),
            signing_key=secret,
            signing_time=signing_time,
        )
        if instance + count > SYSTEMS_MAX:
            raise InputError(f"--count {count}: from --instance {instance} on there are {SYSTEMS_MAX - instance}")
        all_options = siblings(options, count, number(spacing, "--spacing"))
        all_ports = [
            _peer_options(
                instance,
                k,
                companion=(port, remote_port),
                ground=(ground_port, ground_remote_port) if ground else None,
                truth_port=truth_port,
                truth_stream=truth_stream,
                lockstep=lockstep,
                speed=speed,
            )
            for k in range(count)
        ]
        if duration is not None:
            number(duration, "--duration", above=0.0)
        _warm_up(options)
        runner, peers = _open([Vehicle(o) for o in all_options], all_ports, stop)
        if truth is not None:
            _log_truth(peers, truth)
    except (InputError, VehicleFileError, VehicleError, ParameterError, FaultError, KeyFileError, ImportError) as error:
        refuse(str(error))
    except OSError as error:  # a port, or the truth file
        refuse(str(error) if error.strerror is None else f"{error.filename}: {error.strerror}")
    _announce(peers, json_ready)
    gc.collect()
    gc.freeze()
    if lockstep:
        take_core_of_two(all_ports[0].remote_port)
    try:
        runner.run(duration)
    finally:
        runner.close()


def _open(vehicles: list[Vehicle], ports: list[PeerOptions], stop: Stop) -> tuple[Peer | Fleet, Sequence[Peer]]:
    """Open the sockets; gives what runs the vehicles, and the peer of each."""
    if len(vehicles) == 1:
        peer = Peer(vehicles[0], ports[0], stopped=stop, notice=tell)
        return peer, [peer]
    fleet = Fleet(list(zip(vehicles, ports, strict=True)), stopped=stop, notice=tell)
    return fleet, fleet.members


def _log_truth(peers: Sequence[Peer], path: Path) -> None:
    """Begin the truth file of each vehicle, and that of its faults beside it."""
    for peer in peers:
        own = path if len(peers) == 1 else path.with_stem(f"{path.stem}-{peer.vehicle.system}")
        peer.log_truth(TruthLog(own))
        peer.vehicle.faults.log_to(own.with_suffix(FAULTS_SUFFIX))


def _peer_options(
    first: int,
    k: int,
    *,
    companion: tuple[int | None, int | None],
    ground: tuple[int | None, int] | None,
    truth_port: int | None,
    truth_stream: bool,
    lockstep: bool,
    speed: float,
) -> PeerOptions:
    """Check the ports and the time of the vehicle k instances after the first.

    A port that is None is PX4's for the instance, one that is given the first vehicle's; 0 stays 0. `companion`,
    `ground`: own, spoken to. All vehicles speak to the same ground station.
    """
    instance = first + k
    shift = instance if instance < _SITL_SECOND_RANGE else instance + 10_000
    port, remote_port = _after(companion[0], k), _after(companion[1], k)
    own_ground, remote_ground = ground or (None, 0)
    ground_default = 0 if port == 0 else 18570 + instance
    return PeerOptions(
        port=port_or(port, 14580 + shift, "--port"),
        remote_port=port_or(remote_port, 14540 + shift, "--remote-port"),
        ground_port=port_or(_after(own_ground, k), ground_default, "--ground-port") if ground is not None else None,
        ground_remote_port=port_or(remote_ground, 0, "--ground-remote-port"),
        truth_port=port_or(_after(truth_port, k), 19410 + instance, "--truth-port") if truth_stream else None,
        lockstep=lockstep,
        speed=number(speed, "--speed", above=0.0),
    )


def _after(port: int | None, k: int) -> int | None:
    """Give the port k after one that is given; any free one stays that."""
    return port + k if port else port


def _announce(peers: Sequence[Peer], as_json: bool) -> None:
    """Say that the vehicles are there, and where. One is told as one, several as a list."""
    if as_json:
        told = [_address(peer) for peer in peers]
        more = told[0] if len(told) == 1 else {"vehicles": told}
        typer.echo(json.dumps({"ready": True, "pid": os.getpid(), **more}))
    else:
        for peer in peers:
            options, vehicle = peer.options, peer.vehicle
            time = "in lockstep" if options.lockstep else f"at {options.speed:g} times real time"
            typer.echo(
                f"{vehicle.options.vehicle.name}, system {vehicle.system}, {time}: "
                f"companion link 127.0.0.1:{peer.companion.port} -> {options.remote_port or 'whoever speaks first'}"
            )
    sys.stdout.flush()


def _address(peer: Peer) -> dict[str, object]:
    """Give what a program needs to find a vehicle."""
    options, vehicle = peer.options, peer.vehicle
    return {
        "system_id": vehicle.system,
        "port": peer.companion.port,
        "remote_port": options.remote_port,
        "ground_port": None if peer.ground is None else peer.ground.port,
        "ground_remote_port": None if peer.ground is None else options.ground_remote_port,
        "truth_port": options.truth_port,
        "state_rate_hz": 1e6 / vehicle.period_us,
        "lockstep": options.lockstep,
    }


def _warm_up(options: VehicleOptions) -> None:
    """Let numba compile or load what the flight needs before anybody waits for it."""
    trial = Vehicle(options)
    trial.tick()


def _refuse_what_would_do_nothing(*, ground: bool, truth: bool, speed: bool) -> None:
    """Say which option another one leaves without effect.

    Raises:
        InputError: there is one.
    """
    for given, option, other in (
        (ground, "--ground-port", "--no-ground"),
        (truth, "--truth-port", "--no-truth-stream"),
        (speed, "--speed", "--lockstep"),
    ):
        if given:
            raise InputError(f"{option} does nothing with {other}: leave one of them out")


def _vehicle_file(name: str, state_rate_hz: float | None, state_age_s: float | None) -> VehicleFile:
    """Load the vehicle file, with what the command line replaces."""
    file = load(name)
    if state_rate_hz is not None:
        file = replace(file, state_rate_hz=number(state_rate_hz, "--state-rate", above=0.0))
        if state_rate_hz < STATE_RATE_MIN_HZ:
            raise InputError(f"--state-rate {state_rate_hz:g}: at least {STATE_RATE_MIN_HZ:g} Hz")
    if state_age_s is not None:
        file = replace(file, state_age_s=number(state_age_s, "--state-age"))
        if state_age_s > 1.0:
            raise InputError(f"--state-age {state_age_s:g}: allowed are 0 to 1 s")
    return file


def _pose(text: str | None) -> tuple[Vec3, float] | None:
    """Read a start in the air: position, and yaw in degrees."""
    if text is None:
        return None
    values = numbers(text, "--start", (3, 4), "north,east,down in metres and, if wanted, a yaw in degrees")
    if values[2] >= 0.0:
        raise InputError(
            f"--start {text!r}: down must be negative, the ground is at 0; leave --start out for the ground"
        )
    return (values[0], values[1], values[2]), radians(values[3] if len(values) > 3 else 0.0)


def _parameters(items: list[str], px4: str) -> dict[str, int | float]:
    """Read NAME=VALUE items, checked against the parameters that there are."""
    trial = Parameters(px4)
    values: dict[str, int | float] = {}
    for item in items:
        name, separator, text = item.partition("=")
        if not separator:
            raise InputError(f"--param {item!r}: expected NAME=VALUE")
        try:
            trial.set_text(name, text)
        except ParameterError as error:
            raise InputError(f"--param {item!r}: {error}") from None
        values[name] = trial[name]
    return values


app.command("fault", epilog=fault_cli.EXAMPLE)(fault_cli.run)
app.command("hil", epilog=hil_cli.EXAMPLE)(hil_cli.run)


def main() -> None:
    """Run the command line."""
    app(prog_name="sim-link")
