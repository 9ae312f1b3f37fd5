"""Reads record.npz, summary.json and, where they are, truth.csv and flight.toml."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from companion.cli.common import say

EXAMPLE = "Example: companion report flights/20260801T120000Z-paper"


def run(folder: Annotated[Path, typer.Argument(help="A flight's folder.")]) -> None:
    """Writes report.html into the folder."""
    from companion.record.report import build_report

    say(f"report: {build_report(folder)}")
