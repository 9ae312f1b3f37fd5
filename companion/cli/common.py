"""What several commands share: options with one meaning everywhere, and the display of a flight."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.errors import CompanionError, InputError

if TYPE_CHECKING:
    from companion.config import Flight
    from companion.flight.launch import Flown
    from companion.frames import Frame

OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="The flight's folder; default ./flights/<UTC>-<name>.")
]
VehicleKeyOption = Annotated[
    str | None,
    typer.Option(
        "--key", metavar="FILE", help="The key that messages of the vehicle link are signed with (`companion key new`)."
    ),
]
VehicleSystemOption = Annotated[
    int | None,
    typer.Option("--system", metavar="ID", min=1, max=255, help="Listen to the autopilot of this system id alone."),
]
WindOption = Annotated[
    str | None,
    typer.Option("--wind", metavar="N,E,D", help="Velocity of the air in m/s, where it moves to; acts by the drag."),
]
TurbulenceOption = Annotated[
    float | None,
    typer.Option("--turbulence", metavar="SHARE", help="Dryden gusts: standard deviation as a share of the mean wind."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
EngineOption = Annotated[
    str, typer.Option("--engine", help='"auto", "python" or "numba" (needs the extra [fast]); same numbers.')
]
RealtimeOption = Annotated[
    bool,
    typer.Option(
        "--realtime",
        help="Ask the system for a real-time scheduling class, locked memory, exact timers and a core of its own"
        " choice; what is not permitted is said.",
    ),
]
VehicleOption = Annotated[
    str | None, typer.Option("--vehicle", metavar="NAME", help="Vehicle file, or the name of a bundled one.")
]
FaultsOption = Annotated[
    str | None,
    typer.Option(
        "--faults", metavar="FILE", help="What goes wrong with the bundled vehicle: a fault file, or a bundled name."
    ),
]
ControllerOption = Annotated[
    str | None,
    typer.Option(
        "--controller", metavar="WHO", help='"law", or "px4": PX4\'s own position controller gets the reference.'
    ),
]
FrameOption = Annotated[
    str | None,
    typer.Option("--frame", metavar="FRAME", help='Of the trajectory file: "enu", "nwu" (z up) or "ned".'),
]
TrajectoryOption = Annotated[
    str | None,
    typer.Option("--trajectory", metavar="FILE", help="Fly this instead: a trajectory file, or a bundled one's name."),
]
TimeScaleOption = Annotated[
    float | None, typer.Option("--time-scale", metavar="X", help="Fly the trajectory X times as fast.")
]
LapsOption = Annotated[
    int | None,
    typer.Option("--laps", metavar="N", min=1, help="Fly it N times, with a smooth way back where it does not close."),
]


def say(text: str, *, quiet: bool = False) -> None:
    """A line for people, on stderr when stdout belongs to JSON."""
    print(text, file=sys.stderr if quiet else sys.stdout, flush=True)


LiveOption = Annotated[
    bool, typer.Option("--live", help="Show the flight in the terminal while it lasts: figures and a small plan.")
]
RerunOption = Annotated[
    bool, typer.Option("--rerun", help="Stream the flight to the rerun viewer (needs the extra [live]).")
]
RerunFileOption = Annotated[
    Path | None, typer.Option("--rerun-file", metavar="FILE", help="The same into a .rrd file, for later.")
]
Display = Callable[[Mapping[str, Any]], None]
"""Gets every message of the control process."""


@contextlib.contextmanager
def flight_display(*, quiet: bool, live: bool, rerun: bool, rerun_file: Path | None) -> Iterator[Display]:
    """What shows a flight, as the options ask; to be opened before anything connects.

    Raises:
        InputError: rerun cannot be used.
    """
    if rerun and rerun_file is not None:
        raise InputError(f"--rerun starts the viewer, --rerun-file {rerun_file} keeps the flight: leave one out")
    with contextlib.ExitStack() as stack:
        displays: list[Display] = []
        if rerun or rerun_file is not None:
            from companion.cli.rerun_stream import RerunStream

            displays.append(stack.enter_context(RerunStream(rerun_file)))
        if live and (sys.stderr if quiet else sys.stdout).isatty():
            from companion.cli.live import LiveDisplay

            displays.append(stack.enter_context(LiveDisplay(quiet)))
        else:
            if live:
                say("--live needs a terminal; the flight's lines are shown", quiet=quiet)
            displays.append(stack.enter_context(FlightDisplay(quiet)))

        def show(message: Mapping[str, Any]) -> None:
            for display in list(displays):
                try:
                    display(message)
                except Exception as error:
                    displays.remove(display)
                    say(f"companion: a display failed ({error}); the flight goes on", quiet=True)

        yield show


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
            disable=not self._console.is_terminal,  # in a file it would leave an empty line
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


def fly_bundled(
    flight: Flight,
    folder: Path,
    *,
    px4: str,
    engine: str,
    lockstep: bool,
    faults: Path | None,
    timeout_s: float,
    quiet: bool,
    display: Display,
    key: str | None = None,
    realtime: bool = False,
) -> Flown:
    """Starts the bundled vehicle, flies it, and ends it; with a key both sign.

    Raises:
        InputError, LinkError: the vehicle does not start; it has said why.
    """
    from companion.flight.bundled import BundledVehicle
    from companion.flight.launch import control
    from companion.link.vehicle_link import VehicleLink

    where = "on the ground" if flight.start is None else "in Hold"
    with BundledVehicle(flight, folder, px4=px4, engine=engine, lockstep=lockstep, faults=faults, key=key) as bundled:
        say(f"the bundled vehicle ({flight.vehicle.name}) waits {where}; flight folder {folder}", quiet=quiet)

        def listen(message: Mapping[str, Any]) -> None:
            display(message)
            if "flown" in message:  # it would wait for a companion that has gone
                bundled.stop()

        return control(folder, VehicleLink(bundled.connection, key), engine, timeout_s, listen, realtime=realtime)


def fault_file(name: str | None) -> Path | None:
    """The file of --faults, which the bundled vehicle has checked.

    Raises:
        InputError: there is none, or it cannot be.
    """
    if name is None:
        return None
    import subprocess

    from companion.config import find

    path = find(name, "faults")
    command = [sys.executable, "-m", "sim_link", "fault", "check", str(path)]
    checked = subprocess.run(command, check=False, capture_output=True, text=True)
    if checked.returncode != 0:
        raise InputError(checked.stderr.strip().removeprefix("sim-link: ") or f"{path}: could not be checked")
    return path


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
    page: Path | None = None
    try:
        page = build_report(flown.folder)
    except CompanionError as error:  # the flight is flown, whatever becomes of its page
        say(f"companion: {error}", quiet=True)
    if as_json:
        print(json.dumps({**summary, "folder": str(flown.folder), "exit_code": flown.exit_code}, indent=2))
        return flown.exit_code
    say(f"{flown.sentence}; {summary['steps']} control steps at {_figure(summary['control_rate_hz'], 'Hz', 0)}")
    print_summary(summary)
    if page is not None:
        say(f"report:  {page}")
    return flown.exit_code


def print_summary(summary: Mapping[str, Any]) -> None:
    """The figures that people look at first."""
    say(f"verdict: {summary['verdict']}")
    by_law = summary.get("controller", "law") == "law"
    rows: list[tuple[str, str]] = [
        ("controller", "the law" if by_law else "PX4's own position controller"),
        ("settled within 0.2 m at", _figure(summary["settled_at_s"], "s", 2)),
        ("statistics from", _figure(summary["statistics_from_s"], "s", 2)),
        ("position error rms", _figure(summary["position_rms_m"], "m", 4)),
        ("  95 % / largest", " / ".join(_figure(summary[k], "m", 4) for k in ("position_p95_m", "position_max_m"))),
        ("  rms of the whole track", _figure(summary.get("track_rms_m"), "m", 4)),
        ("vertical error rms", _figure(summary["vertical_rms_m"], "m", 4)),
        ("heading error rms", _figure(summary["heading_rms_rad"], "rad", 4)),
    ]
    if by_law:
        rows += [
            ("disturbance (north, east, down)", _vector(summary["disturbance_m_s2"], "m/s^2")),
            ("thrust", " to ".join(_figure(summary[k], "N", 1) for k in ("thrust_min_n", "thrust_max_n"))),
        ]
    refused = summary.get("refused_messages") or {}
    if refused:
        told = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in refused.items())
        rows.append(("messages refused", told))
    rows.append(("largest tilt", _figure(summary["tilt_max_rad"], "rad", 2)))
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


def controller_changes(controller: str | None, output: str | None) -> dict[str, Any]:
    """--controller and --output as they go into [output].

    Raises:
        InputError: both, where they contradict each other.
    """
    if controller == "px4" and output is not None:
        raise InputError(
            f"--output {output} says what the law sends; with --controller px4 the reference itself is sent:"
            " leave one out"
        )
    return {"output__controller": controller, "output__kind": output}


def wind_changes(wind: str | None, turbulence: float | None) -> dict[str, Any]:
    """--wind and --turbulence as they go into [world].

    Raises:
        InputError: --wind is not three numbers.
    """
    if wind is None:
        return {"world__turbulence": turbulence}
    try:
        blows = tuple(float(x) for x in wind.split(","))
    except ValueError:
        blows = ()
    if len(blows) != 3:
        raise InputError(f"--wind {wind!r}: expected three numbers north,east,down in m/s, where the air moves to")
    return {"world__wind_m_s": blows, "world__turbulence": turbulence}


def trajectory_changes(trajectory: str | None, frame: str | None) -> dict[str, Any]:
    """--trajectory and --frame as they go into a flight: the table that stands for the file.

    Raises:
        InputError: no such frame or file, or --frame without --trajectory.
    """
    if trajectory is None:
        if frame is not None:
            raise InputError(f"--frame {frame}: says the frame of the file that --trajectory names; add that")
        return {}
    from companion.trajectory.load import table_of

    return {"trajectory": table_of(trajectory, frame_named(frame))}


def frame_named(name: str | None) -> Frame | None:
    """The frame of that name.

    Raises:
        InputError: there is none.
    """
    from companion.frames import FRAMES

    if name is None:
        return None
    for frame in FRAMES:
        if name == frame:
            return frame
    raise InputError(f"--frame {name!r}: allowed are " + ", ".join(f"{f} ({axes})" for f, axes in FRAMES.items()))


def say_notes(notes: Sequence[str], *, quiet: bool) -> None:
    """What people should know about where a trajectory comes from."""
    for note in notes:
        say(f"  {note}", quiet=quiet)


def vehicle_changes(vehicle: str | None) -> dict[str, Any]:
    """The flight's `vehicle` replaced by another file's contents."""
    if vehicle is None:
        return {}
    from companion.config import find, read_toml

    return {"vehicle": read_toml(find(vehicle, "vehicles"))}
