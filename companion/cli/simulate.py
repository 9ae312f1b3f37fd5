"""The law that flies against the physics of the bundled vehicle, in this process. The flight file needs [start].
Exit code 1: it missed the thresholds of [acceptance].
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.common import (
    EngineOption,
    FrameOption,
    JsonOption,
    LapsOption,
    TimeScaleOption,
    TrajectoryOption,
    adjustments,
    print_summary,
    say,
    say_notes,
    trajectory_changes,
    vehicle_changes,
)

if TYPE_CHECKING:
    from companion.campaign.simulate import Trace
    from companion.config import Flight

EXAMPLE = "Example: companion simulate paper --ideal --csv paper.csv"


def run(
    flight: Annotated[str, typer.Argument(help="Flight file, or the name of a bundled one.")] = "paper",
    ideal: Annotated[
        bool, typer.Option("--ideal", help="The paper's setting: perfect state, law inside the integrator, no limits.")
    ] = False,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write one row per control step.")] = None,
    vehicle: Annotated[str | None, typer.Option("--vehicle", help="Another vehicle file for this flight.")] = None,
    trajectory: TrajectoryOption = None,
    frame: FrameOption = None,
    time_scale: TimeScaleOption = None,
    laps: LapsOption = None,
    allow_uncertified: Annotated[
        bool, typer.Option("--allow-uncertified", help="Try gains that no flight would be allowed with.")
    ] = False,
    engine: EngineOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Computes the flight and prints its summary."""
    from rich.console import Console
    from rich.progress import Progress

    from companion.campaign.simulate import fly_ideal, fly_sampled, write_csv
    from companion.campaign.whole import simulated, steps_per_state
    from companion.config import load_flight
    from companion.errors import ExitCode, InputError
    from companion.flight.engines import kernels
    from companion.flight.preflight import gate_gains, gate_reference
    from companion.record.summary import met
    from companion.trajectory.load import embedded, of_flight

    changes = {**vehicle_changes(vehicle), **trajectory_changes(trajectory, frame)}
    configured = embedded(load_flight(flight, adjustments(**changes)), time_scale, laps)
    if configured.output.controller != "law":
        raise InputError(
            f"flight {configured.name!r} is PX4's own controller's (output.controller); simulate computes the law"
            " alone: fly it with `companion demo`"
        )
    if not ideal:
        steps_per_state(simulated(configured.vehicle))  # rounded, it would be another vehicle
    elif configured.world.turbulence > 0.0:
        say("the ideal setting has no gusts: the mean wind alone blows", quiet=as_json)
    path = of_flight(configured)
    say_notes(path.notes, quiet=as_json)
    gate_gains(configured.vehicle, configured.output.by_law, allow_uncertified=allow_uncertified)
    gate_reference(path, configured.vehicle)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("simulating", total=1.0)

        def progress(share: float) -> None:
            bar.update(task, completed=share)

        if ideal:
            trace = fly_ideal(configured, path, progress)
        else:
            trace = fly_sampled(configured, path, kernels(engine), progress)
    if csv is not None:
        write_csv(trace, csv)
    missed = not met(trace.summary["verdict"])
    if as_json:
        print(json.dumps(trace.summary, indent=2))
    else:
        _print(configured, path.name, trace, csv, ideal=ideal)
    if missed:
        raise typer.Exit(int(ExitCode.MISSED))


def _print(configured: Flight, name: str, trace: Trace, csv: Path | None, *, ideal: bool) -> None:
    setting = "the paper's ideal setting" if ideal else "sampled, with the vehicle file's lags, delay and noise"
    say(f"{configured.name}: {name} on {configured.vehicle.name}, {setting}")
    print_summary(trace.summary)
    truth = ", ".join(f"{x:.3f}" for x in trace.truth_disturbance_m_s2)
    say(f"  {'true disturbance':32s} ({truth}) m/s^2")
    if csv is not None:
        say(f"wrote {len(trace.rows)} rows to {csv}")
