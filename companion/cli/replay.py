"""The recorded states are given to the controller again, and its commands compared with the recorded ones.

Without options nothing is changed and nothing may differ; with --vehicle or --set the difference is what other gains
would have commanded at the same states.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.common import EngineOption, JsonOption, VehicleOption, say, vehicle_changes
from companion.errors import InputError

EXAMPLE = "Example: companion replay flights/20260801T120000Z-paper --set controller.k1_1_s=0.8"


def run(
    flight: Annotated[Path, typer.Argument(metavar="FLIGHT", help="A flight's folder, or its flight.ulg.")],
    vehicle: VehicleOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Another value in the vehicle file, as controller.k1_1_s=0.8."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Also draw both into one self-contained HTML page.")
    ] = None,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Replays a flight."""
    from rich.console import Console
    from rich.progress import Progress

    from companion.campaign.replay import configuration_of, replay
    from companion.config import build_flight
    from companion.flight.engines import kernels
    from companion.record.flight_source import read_source

    source = read_source(flight)
    changed = None
    if vehicle is not None or settings:
        document = configuration_of(source)
        document.update(vehicle_changes(vehicle))
        for setting in settings or []:
            _set(document["vehicle"], setting)
        changed = build_flight(document, source.configuration_name)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("replaying", total=1.0)
        done = replay(source, kernels(engine), changed, lambda share: bar.update(task, completed=share))
    differences = done.differences
    if page is not None:
        from companion.record.replay_page import write_page

        write_page(done.time_s, done.recorded, done.replayed, differences, done.flight.name, page)
    if as_json:
        rows = [vars(found) for found in differences]
        print(json.dumps({"identical": done.identical, "steps": len(done.time_s), "differences": rows}, indent=2))
        return
    for sentence in source.missing:
        say(f"  {sentence}")
    verdict = "every command is the recorded one" if done.identical else "the commands differ"
    say(f"{done.flight.name}: {len(done.time_s)} states replayed, {verdict}")
    for found in differences:
        begin = "equal" if found.first_s is None else f"differs from {found.first_s:.3f} s on"
        say(f"  {found.name:24s} largest {found.largest:.3g}, rms {found.rms:.3g} {found.unit}: {begin}")
    if page is not None:
        say(f"page: {page}")


def _set(vehicle: dict[str, Any], setting: str) -> None:
    """Put one KEY=VALUE into a vehicle's table. Raises InputError."""
    import tomllib

    key, sign, text = setting.partition("=")
    if not sign or not key.strip():
        raise InputError(f"--set {setting!r}: expected KEY=VALUE, as controller.k1_1_s=0.8")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()  # a name without quotes
    table: Any = vehicle
    *path, last = key.strip().split(".")
    for name in path:
        table = table.get(name) if isinstance(table, dict) else None
    if not isinstance(table, dict) or last not in table:
        raise InputError(f"--set {setting!r}: the vehicle file has no {key.strip()}")
    table[last] = value
