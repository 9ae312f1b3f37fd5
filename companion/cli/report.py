"""Reads record.npz, summary.json and, where they are, truth.csv and flight.toml.

One folder: report.html is written into it. Two with --compare: a page with both side by side. Several: a table of their
figures.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.common import JsonOption, say
from companion.errors import InputError

EXAMPLE = "Example: companion report --compare flights/law flights/px4"


def run(
    folders: Annotated[list[Path], typer.Argument(help="Folders of flights.")],
    compare: Annotated[bool, typer.Option("--compare", help="Two flights side by side on one page.")] = False,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Where the page goes.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Builds pages and tables of flights."""
    if compare:
        if len(folders) != 2:
            raise InputError(f"--compare takes two folders, not {len(folders)}")
        from companion.record.compare import build_comparison

        say(f"comparison: {build_comparison(folders[0], folders[1], out)}", quiet=as_json)
    if len(folders) > 1:
        _table(folders, as_json)
        return
    from companion.record.report import build_report

    say(f"report: {build_report(folders[0], out)}", quiet=as_json)
    if as_json:
        _table(folders, as_json)


def _table(folders: list[Path], as_json: bool) -> None:
    from companion.record.compare import table

    rows = table(folders)
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
            *(Path(row["folder"]).name, str(row["trajectory"]), str(row["vehicle"]), row["controller"]),
            *numbers,
            str(row["verdict"]),
        )
    console = Console()
    if not console.is_terminal:  # in a file nothing may be cut off
        console = Console(width=max(200, console.width))
    console.print(shown)
