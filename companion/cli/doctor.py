"""Prints every gate that stands between this vehicle and a flight: the figure, its limit, what it means and what to do,
and what the autopilot does when this program falls silent.

It never arms and changes nothing on the vehicle but how often messages come on this link. The same gates refuse in
`fly`, `demo` and `serve`. Exit code 3: a flight would be refused.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.common import (
    ControllerOption,
    JsonOption,
    VehicleKeyOption,
    VehicleOption,
    VehicleSystemOption,
    adjustments,
    controller_changes,
    say,
    vehicle_changes,
)

if TYPE_CHECKING:
    from companion.config import Flight
    from companion.flight.findings import Finding
    from companion.flight.loop import FlightLoop

EXAMPLE = "Example: companion doctor --vehicle px4_sih --connect udpin:127.0.0.1:14540"
CONNECTION = "udpin:127.0.0.1:14540"
COLOURS = {"passed": "green", "warning": "yellow", "refused": "red"}
HOVER = {"name": "hover", "shape": "hover", "duration_s": 1.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}


def run(
    vehicle: VehicleOption = None,
    connect: Annotated[
        str, typer.Option("--connect", help="udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD.")
    ] = CONNECTION,
    key: VehicleKeyOption = None,
    system: VehicleSystemOption = None,
    flight: Annotated[
        str | None, typer.Option("--flight", metavar="NAME", help="Flight file; its trajectory is not looked at.")
    ] = None,
    output: Annotated[str | None, typer.Option("--output", help='"rates", "attitude" or "actuators".')] = None,
    controller: ControllerOption = None,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    as_json: JsonOption = False,
) -> None:
    """Lets the gates judge a connected vehicle."""
    from companion.errors import InputError
    from companion.flight.engines import kernels
    from companion.flight.loop import FlightLoop
    from companion.flight.phases import PHASE_NAMES
    from companion.flight.preflight import gains_finding
    from companion.link.vehicle_link import VehicleLink
    from companion.record.flight_record import FlightRecord
    from companion.trajectory.load import of_flight

    if flight is None and vehicle is None:
        raise InputError("say which vehicle this is: --vehicle NAME (a vehicle file), or --flight NAME (a flight file)")
    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    link = VehicleLink(connect, key, system)
    link.check()
    configured = _configured(vehicle, flight, controller_changes(controller, output))
    by_law = configured.output.controller == "law"
    findings = [gains_finding(configured.vehicle, configured.output.by_law)] if by_law else []
    say(f"{configured.vehicle.name}: listening on {connect}; message rates are asked for there", quiet=as_json)
    record, compiled = FlightRecord(0, PHASE_NAMES), kernels("python")
    with link.open() as wire:
        loop = FlightLoop(
            *(configured, of_flight(configured), wire, record, compiled),
            connect_timeout_s=timeout,
            connection=connect,
            only_gates=True,
        )
        outcome = loop.run()
    if outcome.fault:
        say(outcome.fault, quiet=True)
    found = [] if loop.preflight is None else loop.preflight.findings
    code = int(outcome.cause.value.exit_code)
    document = _document(loop, [*findings, *found] if found else [], connect, configured, outcome.sentence, code)
    if as_json:
        print(json.dumps(document, indent=2))
    elif found:
        _print([*findings, *found], document)
    else:
        say(f"companion: {outcome.sentence}", quiet=True)
    raise typer.Exit(document["exit_code"])


def _configured(vehicle: str | None, flight: str | None, changes: dict[str, Any]) -> Flight:
    """The vehicle with output and limits as they would fly."""
    from companion.config import build_flight, load_flight

    if flight is None:
        base = {"name": "doctor", "vehicle": vehicle, "trajectory": HOVER}
        return build_flight(base, "command line", adjustments(**changes))
    return load_flight(flight, adjustments(**changes, **vehicle_changes(vehicle), trajectory=HOVER))


def _document(
    loop: FlightLoop, findings: Sequence[Finding], connection: str, flight: Flight, sentence: str, code: int
) -> dict[str, Any]:
    """Everything that is known, and the exit code: 3 where any gate refuses."""
    from companion.errors import ExitCode
    from companion.flight.findings import refusal

    autopilot, version = loop.autopilot, loop.version
    against = refusal(findings)
    silence = None if loop.preflight is None or not findings else loop.preflight.silence.sentence
    return {
        "vehicle": flight.vehicle.name,
        "connection": connection,
        "autopilot": {
            "version": None if version is None else version.label,
            "capabilities": None if version is None else version.capabilities,
            "mode": None if autopilot.mode is None else autopilot.mode.label,
            "armed": autopilot.armed,
            "landed": autopilot.landed.name,
        },
        "parameters": autopilot.parameters,
        "gates": [
            {
                **{"gate": f.gate.name, "verdict": f.verdict.value, "value": f.value, "limit": f.limit},
                **{"sentence": f.sentence, "fix": f.fix},
            }
            for f in findings
        ],
        "when_silent": silence,
        "outcome": sentence,
        "refused": against or None,
        "exit_code": int(ExitCode.REFUSED) if against else code,
    }


def _print(findings: Sequence[Finding], document: dict[str, Any]) -> None:
    """The table, and what follows from it."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False)
    for name in ("gate", "", "value", "limit", "what it means"):
        table.add_column(name, no_wrap=name in {"gate", ""}, overflow="fold")
    for finding in findings:
        verdict = finding.verdict.value
        shown = f"[{COLOURS[verdict]}]{verdict}[/]"
        cells = (finding.value, finding.limit or "-", finding.told)
        table.add_row(finding.gate.value, shown, *(escape(cell) for cell in cells))
    console.print(table)
    say(document["when_silent"])
    warnings = sum(finding.verdict.value == "warning" for finding in findings)
    refusals = sum(finding.verdict.value == "refused" for finding in findings)
    if refusals:
        say(f"a flight would be REFUSED: {refusals} of {len(findings)} gates refuse, {warnings} warn")
    else:
        say(f"a flight would not be refused: {len(findings)} gates, {warnings} of them warn")
