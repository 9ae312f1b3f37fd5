"""What several commands share: options with one meaning everywhere, and the display of a flight."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from companion.flight.launch import Flown

OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="The flight's folder; default ./flights/<UTC>-<name>.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
EngineOption = Annotated[
    str, typer.Option("--engine", help='"auto", "python" or "numba" (needs the extra [fast]); same numbers.')
]
VehicleOption = Annotated[
    str | None, typer.Option("--vehicle", metavar="NAME", help="Vehicle file, or the name of a bundled one.")
]
TimeScaleOption = Annotated[
    float | None, typer.Option("--time-scale", metavar="X", help="Fly the trajectory X times as fast.")
]


def say(text: str, *, quiet: bool = False) -> None:
    """A line for people, on stderr when stdout belongs to JSON."""
    print(text, file=sys.stderr if quiet else sys.stdout, flush=True)


class FlightDisplay:
    """Shows the status messages of a control process: lines as they come, a progress bar while tracking."""

    def __init__(self, quiet: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        self._console = Console(stderr=quiet, highlight=False)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:5.1f} of {task.total:.0f} s, error {task.fields[error]:.3f} m"),
            console=self._console,
            refresh_per_second=5,
            transient=True,
        )
        self._task: Any = None

    def __enter__(self) -> FlightDisplay:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, message: Mapping[str, Any]) -> None:
        """Shows one message."""
        if "line" in message:
            self._console.print(f"  {message['line']}", markup=False, soft_wrap=True)
        progress = message.get("progress")
        if progress and progress["phase"] == "track":
            if self._task is None:
                self._task = self._bar.add_task("tracking", total=progress["duration_s"], error=0.0)
            self._bar.update(self._task, completed=progress["t_s"], error=progress["error_m"])


def report_flight(flown: Flown, *, as_json: bool) -> int:
    """Builds the report, prints what came out, and returns the exit code."""
    from companion.record.folder import SUMMARY_FILE, read_summary
    from companion.record.report import build_report

    if not (flown.folder / SUMMARY_FILE).exists():
        say(f"companion: {flown.sentence}", quiet=True)
        if as_json:
            outcome = {"ended": flown.sentence, "folder": str(flown.folder), "exit_code": flown.exit_code}
            print(json.dumps(outcome, indent=2))
        return flown.exit_code
    summary = read_summary(flown.folder)
    page = build_report(flown.folder)
    if as_json:
        print(json.dumps({**summary, "folder": str(flown.folder), "exit_code": flown.exit_code}, indent=2))
        return flown.exit_code
    say(f"{flown.sentence}; {summary['steps']} control steps at {_figure(summary['control_rate_hz'], 'Hz', 0)}")
    print_summary(summary)
    say(f"report:  {page}")
    return flown.exit_code


def print_summary(summary: Mapping[str, Any]) -> None:
    """The figures that people look at first."""
    say(f"verdict: {summary['verdict']}")
    rows: list[tuple[str, str]] = [
        ("settled within 0.2 m at", _figure(summary["settled_at_s"], "s", 2)),
        ("statistics from", _figure(summary["statistics_from_s"], "s", 2)),
        ("position error rms", _figure(summary["position_rms_m"], "m", 4)),
        ("  95 % / largest", " / ".join(_figure(summary[k], "m", 4) for k in ("position_p95_m", "position_max_m"))),
        ("vertical error rms", _figure(summary["vertical_rms_m"], "m", 4)),
        ("heading error rms", _figure(summary["heading_rms_rad"], "rad", 4)),
        ("disturbance (north, east, down)", _vector(summary["disturbance_m_s2"], "m/s^2")),
        ("thrust", " to ".join(_figure(summary[k], "N", 1) for k in ("thrust_min_n", "thrust_max_n"))),
        ("largest tilt", _figure(summary["tilt_max_rad"], "rad", 2)),
    ]
    for name, value in rows:
        say(f"  {name:32s} {value}")


def _figure(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}"


def _vector(value: Any, unit: str) -> str:
    return "-" if value is None else "(" + ", ".join(f"{x:.3f}" for x in value) + f") {unit}"


def adjustments(**changes: Any) -> Callable[[dict[str, Any]], None]:
    """A function that sets values in a flight's data before validation; keys are paths with "__", None is left out."""

    def adjust(data: dict[str, Any]) -> None:
        for key, value in changes.items():
            if value is None:
                continue
            *path, last = key.split("__")
            table = data
            for name in path:
                table = table.setdefault(name, {})
            table[last] = value

    return adjust


def vehicle_changes(vehicle: str | None) -> dict[str, Any]:
    """The flight's `vehicle` replaced by another file's contents."""
    if vehicle is None:
        return {}
    from companion.config import find, read_toml

    return {"vehicle": read_toml(find(vehicle, "vehicles"))}
