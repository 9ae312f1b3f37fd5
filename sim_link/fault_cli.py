"""`sim-link fault`: lets something go wrong with a simulated vehicle that runs already."""

from __future__ import annotations

import tomllib
from typing import Annotated

import typer

from .fault_client import FaultClient, NoVehicleError
from .fault_file import find, load
from .fault_keys import FaultError
from .loop_gains import PX4_VERSIONS

EXAMPLE = "Example: sim-link fault wind wind_m_s=[0,8,0] for_s=3"
_EXIT_BAD_INPUT, _EXIT_NOBODY = 2, 4
_SITL_SECOND_RANGE = 10


def run(
    order: Annotated[
        list[str],
        typer.Argument(
            metavar="KIND [KEY=VALUE]... | list | end NUMBER|all | check FILE",
            help="A kind and its keys, or what else.",
        ),
    ],
    instance: Annotated[int, typer.Option(min=0, max=249, help="Number i of the vehicle.")] = 0,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the vehicle's companion link; default 14580 + i.")
    ] = None,
) -> None:
    """Let a fault act in a running `sim-link run`, tell which act, or end them; or check a fault file.

    for_s=2 lets it act for two seconds, start_s and end_s are vehicle time since the start. Exit code 2: not a fault
    that can be; 4: no vehicle answers.
    """
    if order[0] == "check":
        _check(order[1:])
        return
    shift = instance if instance < _SITL_SECOND_RANGE else instance + 10_000
    with FaultClient(14580 + shift if port is None else port) as client:
        try:
            typer.echo(client.order(line_of(order)))
        except FaultError as error:
            typer.echo(f"sim-link: {error}", err=True)
            raise typer.Exit(_EXIT_NOBODY if isinstance(error, NoVehicleError) else _EXIT_BAD_INPUT) from None


def _check(files: list[str]) -> None:
    """Tell the faults of files that are right for one PX4 at least."""
    try:
        if not files:
            raise FaultError("", "check: expected a fault file")
        for name in files:
            faults = load(name, *PX4_VERSIONS)
            typer.echo("\n".join((f"{find(name)}:", *(f"  {fault.span}: {fault}" for fault in faults))))
    except FaultError as error:
        typer.echo(f"sim-link: {error}", err=True)
        raise typer.Exit(_EXIT_BAD_INPUT) from None


def line_of(order: list[str]) -> str:
    """Give the shell's line for the words of a command line; a value that is no TOML is taken as text."""
    if order[0] in ("list", "end"):
        return " ".join(("fault", *order))
    items = [order[0]]
    for word in order[1:]:
        key, separator, value = word.partition("=")
        if not separator:
            raise FaultError("", f"{word!r}: expected KEY=VALUE")
        items.append(f"{key} = {value if _is_toml(value) else _quoted(value)}")
    return "fault " + ", ".join(items)


def _is_toml(value: str) -> bool:
    try:
        return "value" in tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return False


def _quoted(value: str) -> str:
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
