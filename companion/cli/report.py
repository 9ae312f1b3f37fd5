"""Reads a flight's folder, or its flight.ulg alone, also one that was cut off.

One flight: report.html is written into its folder, or a page beside the log. Two with --compare: a page with both side
by side. Several: a table of their figures. --from-px4 lays the autopilot's own log of the same flight over it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.common import JsonOption, say
from companion.errors import InputError

if TYPE_CHECKING:
    from companion.record.flight_source import FlightSource

EXAMPLE = "Example: companion report --compare flights/law flights/px4"


def run(
    flights: Annotated[list[Path], typer.Argument(help="Folders of flights, or their logs (.ulg).")],
    compare: Annotated[bool, typer.Option("--compare", help="Two flights side by side on one page.")] = False,
    from_px4: Annotated[
        Path | None,
        typer.Option("--from-px4", metavar="FILE", help="The autopilot's own log (.ulg) of the same flight."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Where the page goes.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Builds pages and tables of flights."""
    if from_px4 is not None:
        _lay_over(from_px4, flights, compare, out, as_json)
        return
    if compare:
        if len(flights) != 2:
            raise InputError(f"--compare takes two flights, not {len(flights)}")
        from companion.record.compare import build_comparison

        say(f"comparison: {build_comparison(flights[0], flights[1], out)}", quiet=as_json)
    if len(flights) > 1:
        _table(flights, as_json)
        return
    from companion.record.flight_source import read_source
    from companion.record.report import build_report

    source = read_source(flights[0])
    for sentence in source.missing:
        say(f"  {sentence}", quiet=as_json)
    say(f"report: {build_report(source, out)}", quiet=as_json)
    if as_json:
        _table([source], as_json)


def _lay_over(log: Path, flights: list[Path], compare: bool, out: Path | None, as_json: bool) -> None:
    if compare or len(flights) != 1:
        raise InputError("--from-px4 takes one flight, and no --compare")
    from companion.record.px4_page import build_overlay

    overlay = build_overlay(log, flights[0], out)
    for sentence in overlay.missing:
        say(f"  {sentence}", quiet=as_json)
    say(f"time offset: {overlay.fit.sentence}", quiet=as_json)
    say(f"report: {overlay.page}", quiet=as_json)
    if as_json:
        print(json.dumps({**overlay.fit._asdict(), "page": str(overlay.page)}, indent=2))


def _table(flights: Sequence[Path | FlightSource], as_json: bool) -> None:
    from companion.record.compare import table

    rows = table(flights)
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    shown = Table(box=None, header_style="bold", pad_edge=False)
    measures = [key for key in rows[0] if key not in {"folder", "trajectory", "vehicle", "verdict", "controller"}]
    for head in ("flight", "trajectory", "vehicle", "by", *measures, "verdict"):
        shown.add_column(head, justify="right" if head in measures else "left", overflow="fold")
    for row in rows:
        numbers = ["-" if row[key] is None else f"{row[key]:.3g}" for key in measures]
        shown.add_row(
            *(_short(Path(row["folder"])), str(row["trajectory"]), str(row["vehicle"]), row["controller"]),
            *numbers,
            str(row["verdict"]),
        )
    console = Console()
    if not console.is_terminal:  # in a file nothing may be cut off
        console = Console(width=max(200, console.width))
    console.print(shown)


def _short(path: Path) -> str:
    """Of a log with its folder: every flight's has the same name."""
    return f"{path.parent.name}/{path.name}" if path.suffix == ".ulg" else path.name
