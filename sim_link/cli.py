"""The command line of the simulated vehicle: `sim-link run`."""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from math import isfinite, radians
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from .parameters import ParameterError, Parameters
from .peer import Peer, PeerOptions
from .rotation import Vec3
from .truth_log import TruthLog
from .vehicle import PX4_VERSIONS, Vehicle, VehicleError, VehicleOptions
from .vehicle_file import VehicleFile, VehicleFileError, load
from .wind import World

EXIT_DONE, EXIT_BAD_INPUT = 0, 2
_ENGINES = ("auto", "python", "numba")
_SITL_SECOND_RANGE = 10
"""From this instance on PX4's ports would run into one another; ours go on 10000 higher."""

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


class InputError(ValueError):
    """Something on the command line that cannot be used; the message is one line."""


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
    speed: Annotated[float, typer.Option(help="Vehicle time per wall time, without --lockstep.")] = 1.0,
    truth: Annotated[Path | None, typer.Option(metavar="FILE", help="Write what really happens as CSV.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="End after this vehicle time [s].")] = None,
    engine: Annotated[str, typer.Option(help="auto, python or numba.")] = "auto",
    param: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set an autopilot parameter (repeatable).")
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
    """
    stop = _Stop(with_parent)
    try:
        file = _vehicle_file(vehicle, state_rate, state_age)
        world = World(
            force_n=_vector(force, "--force"),
            gravity_factor=_number(gravity_factor, "--gravity-factor", above=0.0),
            wind_m_s=_vector(wind, "--wind"),
            turbulence=_number(turbulence, "--turbulence"),
            seed=seed,
        )
        options = VehicleOptions(
            vehicle=file,
            world=world,
            instance=instance,
            start=_pose(start),
            seed=seed,
            px4=_choice(px4, PX4_VERSIONS, "--px4"),
            engine=_choice(engine, _ENGINES, "--engine"),
            parameters=_parameters(param or [], px4),
        )
        peer_options = _peer_options(
            instance,
            companion=(port, remote_port),
            ground=(ground_port, ground_remote_port) if ground else None,
            truth_port=truth_port,
            truth_stream=truth_stream,
            lockstep=lockstep,
            speed=speed,
        )
        if duration is not None:
            _number(duration, "--duration", above=0.0)
        _warm_up(options)
        peer = Peer(Vehicle(options), peer_options, stopped=stop, notice=_tell)
        if truth is not None:
            peer.log_truth(TruthLog(truth))
    except (InputError, VehicleFileError, VehicleError, ParameterError, ImportError) as error:
        _refuse(str(error))
    except OSError as error:  # a port, or the truth file
        _refuse(str(error) if error.strerror is None else f"{error.filename}: {error.strerror}")
    _announce(peer, json_ready)
    gc.collect()
    gc.freeze()
    try:
        peer.run(duration)
    finally:
        peer.close()


def _peer_options(
    instance: int,
    *,
    companion: tuple[int | None, int | None],
    ground: tuple[int | None, int] | None,
    truth_port: int | None,
    truth_stream: bool,
    lockstep: bool,
    speed: float,
) -> PeerOptions:
    """Check ports and time; a port that is None is PX4's for the instance. `companion`, `ground`: own, spoken to."""
    shift = instance if instance < _SITL_SECOND_RANGE else instance + 10_000
    port, remote_port = companion
    own_ground, remote_ground = ground or (None, 0)
    ground_default = 0 if port == 0 else 18570 + instance
    return PeerOptions(
        port=_port_or(port, 14580 + shift, "--port"),
        remote_port=_port_or(remote_port, 14540 + shift, "--remote-port"),
        ground_port=_port_or(own_ground, ground_default, "--ground-port") if ground is not None else None,
        ground_remote_port=_port_or(remote_ground, 0, "--ground-remote-port"),
        truth_port=_port_or(truth_port, 19410 + instance, "--truth-port") if truth_stream else None,
        lockstep=lockstep,
        speed=_number(speed, "--speed", above=0.0),
    )


class _Stop:
    """Knows whether to stop: a signal came, or the parent process is gone."""

    def __init__(self, with_parent: bool) -> None:
        self._wanted = False
        self._parent = os.getppid() if with_parent else None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._wanted = True

    def __call__(self) -> bool:
        return self._wanted or (self._parent is not None and os.getppid() != self._parent)


def _refuse(sentence: str) -> None:
    """Say what is wrong in one line, and end."""
    typer.echo(f"sim-link: {sentence}", err=True)
    raise typer.Exit(EXIT_BAD_INPUT)


def _tell(sentence: str) -> None:
    typer.echo(f"sim-link: {sentence}", err=True)


def _announce(peer: Peer, as_json: bool) -> None:
    """Say that the vehicle is there, and where."""
    options, vehicle = peer.options, peer.vehicle
    ready = {
        "ready": True,
        "pid": os.getpid(),
        "system_id": vehicle.system,
        "port": peer.companion.port,
        "remote_port": options.remote_port,
        "ground_port": None if peer.ground is None else peer.ground.port,
        "ground_remote_port": None if peer.ground is None else options.ground_remote_port,
        "truth_port": options.truth_port,
        "state_rate_hz": 1e6 / vehicle.period_us,
        "lockstep": options.lockstep,
    }
    if as_json:
        line = json.dumps(ready)
    else:
        time = "in lockstep" if options.lockstep else f"at {options.speed:g} times real time"
        line = (
            f"{vehicle.options.vehicle.name}, system {vehicle.system}, {time}: "
            f"companion link 127.0.0.1:{peer.companion.port} -> {options.remote_port or 'whoever speaks first'}"
        )
    typer.echo(line)
    sys.stdout.flush()


def _warm_up(options: VehicleOptions) -> None:
    """Let numba compile or load what the flight needs before anybody waits for it."""
    trial = Vehicle(options)
    trial.tick()


def _vehicle_file(name: str, state_rate_hz: float | None, state_age_s: float | None) -> VehicleFile:
    """Load the vehicle file, with what the command line replaces."""
    file = load(name)
    if state_rate_hz is not None:
        file = replace(file, state_rate_hz=_number(state_rate_hz, "--state-rate", above=0.0))
    if state_age_s is not None:
        file = replace(file, state_age_s=_number(state_age_s, "--state-age"))
        if state_age_s > 1.0:
            raise InputError(f"--state-age {state_age_s:g}: allowed are 0 to 1 s")
    return file


def _number(value: float, option: str, above: float | None = None) -> float:
    """Check a number: finite, not negative, or above a bound."""
    if not isfinite(value) or value < 0.0 or (above is not None and value <= above):
        allowed = "0 or more" if above is None else f"more than {above:g}"
        raise InputError(f"{option} {value:g}: allowed is {allowed}")
    return value


def _numbers(text: str, option: str, counts: tuple[int, ...], form: str) -> list[float]:
    """Read comma-separated numbers."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        raise InputError(f"{option} {text!r}: expected {form}")
    return values


def _vector(text: str, option: str) -> Vec3:
    n, e, d = _numbers(text, option, (3,), "three numbers north,east,down")
    return n, e, d


def _pose(text: str | None) -> tuple[Vec3, float] | None:
    """Read a start in the air: position, and yaw in degrees."""
    if text is None:
        return None
    values = _numbers(text, "--start", (3, 4), "north,east,down in metres and, if wanted, a yaw in degrees")
    if values[2] >= 0.0:
        raise InputError(
            f"--start {text!r}: down must be negative, the ground is at 0; leave --start out for the ground"
        )
    return (values[0], values[1], values[2]), radians(values[3] if len(values) > 3 else 0.0)


def _choice(value: str, allowed: tuple[str, ...], option: str) -> str:
    if value not in allowed:
        raise InputError(f"{option} {value!r}: allowed are {', '.join(allowed)}")
    return value


def _port_or(number: int | None, default: int, option: str) -> int:
    """Check a port; None is the default."""
    if number is None:
        return default
    if not 0 <= number <= 65535:
        raise InputError(f"{option} {number}: allowed are 0 to 65535")
    return number


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


def main() -> None:
    """Run the command line."""
    app(prog_name="sim-link")
