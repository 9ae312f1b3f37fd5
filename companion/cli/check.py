"""FILE is a trajectory file of any known format, or the name of a bundled one. Several are checked each, and against
each other: how near they come when all begin at once. Exit code 3: one of them must not be flown.

The figures are those of the reference, flown exactly in still air; "predicted" simulates the beginning of the flight,
with the vehicle file's lags, delay and noise, from where the vehicle holds.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.common import FrameOption, JsonOption, LapsOption, TimeScaleOption, frame_named

if TYPE_CHECKING:
    from companion.campaign.predict import Prediction
    from companion.config import Start, Vehicle
    from companion.control.types import Vec3
    from companion.flight.inspection import Inspection
    from companion.trajectory.anchored import Anchored, Trajectory
    from companion.trajectory.fence import Fence

EXAMPLE = "Example: companion check paper --vehicle paper"


def run(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="Trajectory files, or names of bundled ones.")],
    vehicle: Annotated[
        str, typer.Option("--vehicle", metavar="NAME", help="Vehicle file, or the name of a bundled one.")
    ],
    frame: FrameOption = None,
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="N,E,D[,DEG]", help="Where the vehicle holds before, from home; its heading."),
    ] = None,
    time_scale: TimeScaleOption = None,
    laps: LapsOption = None,
    fence: Annotated[
        Path | None,
        typer.Option("--fence", metavar="FILE", help="Keep to the geofence of this mission file too."),
    ] = None,
    height_min: Annotated[
        float, typer.Option("--height-min", metavar="M", help="Lowest height above home that is allowed.")
    ] = 0.5,
    separation: Annotated[
        float, typer.Option("--separation", metavar="M", help="Several files: nearest that they may come.")
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Prints what the trajectories ask for, against what the vehicle has."""
    from companion.config import load_vehicle
    from companion.errors import ExitCode, InputError
    from companion.trajectory.formats import read_fence
    from companion.trajectory.load import load

    for name, value in (("--height-min", height_min), ("--separation", separation)):
        if not isfinite(value):
            raise InputError(f"{name} {value}: must be a number of metres")
    flown_by = load_vehicle(vehicle)
    own_frame = frame_named(frame)
    other_fence = None if fence is None else read_fence(fence)
    held = _start(start)
    frames = [own_frame if len(files) == 1 or _takes_frame(file) else None for file in files]
    trajectories = [
        load(file, time_scale, vehicle=flown_by, frame=own, laps=laps) for file, own in zip(files, frames, strict=True)
    ]
    gains = _gains(flown_by)
    checked = [_check(trajectory, flown_by, held, other_fence, height_min, gains) for trajectory in trajectories]
    near = _separation(trajectories, separation)
    refused = any(document["problems"] for _, document in checked) or bool(near and near["refused"])
    if as_json:
        whole = {"vehicle": flown_by.name, "files": [document for _, document in checked], "separation": near}
        print(json.dumps({**whole, "refused": refused}, indent=2, allow_nan=False))
    else:
        from companion.cli.check_page import show

        for inspection, document in checked:
            show(inspection, document, flown_by.name)
        _show_separation(near)
    if refused:
        raise typer.Exit(int(ExitCode.REFUSED))


def _takes_frame(file: str) -> bool:
    """Whether --frame can be meant for a file: among several, files of ours are always north, east, down."""
    return Path(file).suffix.lower() not in {"", ".toml"}


def _start(text: str | None) -> Start | None:
    """--start as a pose."""
    if text is None:
        return None
    from companion.config import Start, validate
    from companion.errors import InputError

    try:
        numbers = [float(x) for x in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4):
        raise InputError(f"--start {text!r}: expected north,east,down in metres, and a heading in degrees if wanted")
    yaw_deg = numbers[3] if len(numbers) == 4 else 0.0
    return validate(Start, {"position_m": tuple(numbers[:3]), "yaw_deg": yaw_deg}, "--start")


def _hold(trajectory: Trajectory, held: Start | None) -> Start:
    """Where the vehicle holds before: as told, else where the take-off ends, or where the trajectory begins."""
    from companion.config import Flight, Start
    from companion.frames import degrees
    from companion.trajectory.anchored import anchored

    if held is not None:
        return held
    begin = anchored(trajectory, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).at(0.0)
    if trajectory.anchor == "here":
        height_m = float(Flight.model_fields["takeoff_altitude_m"].default)
        return Start(position_m=(0.0, 0.0, -height_m), yaw_deg=degrees(begin.yaw))
    return Start(position_m=begin.p, yaw_deg=degrees(begin.yaw))


def _gains(vehicle: Vehicle) -> list[dict[str, Any]]:
    """What speaks against the vehicle's gains: nothing is flown with such."""
    from companion.errors import RefusedError
    from companion.flight.preflight import gate_gains

    try:
        gate_gains(vehicle)
    except RefusedError as error:
        return [{"name": "gains", "at_s": None, "sentence": str(error)}]
    return []


def _check(
    trajectory: Trajectory,
    vehicle: Vehicle,
    held: Start | None,
    fence: Fence | None,
    height_min: float,
    gains: list[dict[str, Any]],
) -> tuple[Inspection, dict[str, Any]]:
    """One trajectory: what was found, and the same as a document."""
    from companion.config import Flight
    from companion.errors import RefusedError
    from companion.flight.inspection import inspect
    from companion.frames import radians

    hold = _hold(trajectory, held)
    inspection = inspect(
        trajectory,
        vehicle,
        hold_point=hold.position_m,
        yaw_rad=radians(hold.yaw_deg),
        fence=fence,
        height_min_m=height_min,
    )
    document = _document(inspection, hold, vehicle.controller.heading)
    problems: list[dict[str, Any]] = document["problems"]
    problems += gains
    if not any(problem["name"] in {"not_finite", "join"} for problem in problems):
        flight = Flight(name=trajectory.name, vehicle=vehicle, trajectory=trajectory.name, start=hold)
        try:
            document["predicted"] = _predicted(flight, trajectory)
        except RefusedError as error:
            problems.append({"name": "predicted", "at_s": None, "sentence": str(error)})
    return inspection, document


def _predicted(flight: Any, trajectory: Trajectory) -> dict[str, Any]:
    from companion.campaign.predict import PREDICTED_S, Extreme, gate_prediction
    from companion.flight.engines import kernels

    found: Prediction = gate_prediction(flight, trajectory, kernels("python"))
    values = found._asdict().items()
    figures = {name: value._asdict() if isinstance(value, Extreme) else value for name, value in values}
    return {"over_s": PREDICTED_S, **figures}


def _document(inspection: Inspection, hold: Start, heading: str) -> dict[str, Any]:
    """What was found, as JSON has it.

    Args:
        inspection: what was found.
        hold: where the vehicle holds before.
        heading: what it does with its nose: of the vehicle file's [controller].
    """
    trajectory = inspection.trajectory
    steps = inspection.snap_steps
    peaks = {peak.name: _plain(peak) for peak in inspection.peaks}
    return {
        "name": trajectory.name,
        "duration_s": trajectory.duration_s,
        "time_scale": trajectory.time_scale,
        "anchor": trajectory.anchor,
        "join": trajectory.join,
        "notes": list(trajectory.notes),
        "start": {"position_m": list(hold.position_m), "yaw_deg": hold.yaw_deg},
        "peaks": {name: {key: x for key, x in peak.items() if key != "name"} for name, peak in peaks.items()},
        "fourth_derivative": {"jumps": len(steps), "largest": _plain(steps[0]) if steps else None},
        "ends": {
            name: None if end is None else {**_plain(end), "step": _plain(end.step)}
            for name, end in (("start", inspection.start), ("end", inspection.end))
        },
        "heading": _headings(inspection, heading),
        "height_above_home": _plain(inspection.ground),
        "fence_margin": _plain(inspection.fence),
        "predicted": None,
        "time_scale_that_passes": inspection.time_scale,
        "problems": [_plain(problem) for problem in inspection.problems],
    }


def _headings(inspection: Inspection, kind: str) -> dict[str, Any] | None:
    """Where the reference's nose points at its ends, as a compass shows it, and whether the vehicle follows it."""
    from companion.frames import compass_deg

    if inspection.start is None:
        return None
    path = inspection.path
    ends = {"start_deg": compass_deg(path.at(0.0).yaw), "end_deg": compass_deg(path.at(path.duration_s).yaw)}
    return {**ends, "followed": kind == "commanded"}


def _plain(value: Any) -> Any:
    """A named tuple as JSON has it; None stays."""
    return None if value is None else {name: _finite(entry) for name, entry in value._asdict().items()}


def _finite(value: Any) -> Any:
    """JSON has no infinity."""
    return None if isinstance(value, float) and not isfinite(value) else value


def _separation(trajectories: list[Trajectory], least_m: float) -> dict[str, Any] | None:
    """How near several trajectories come, in the coordinates of their files, when all begin at once."""
    from companion.flight.surroundings import separation

    found = separation(_together(trajectories))
    if found is None:
        return None
    nearest, pair = found
    return {
        "value_m": nearest.value_m,
        "at_s": nearest.at_s,
        "files": [trajectories[i].name for i in pair],
        "required_m": least_m,
        "refused": not nearest.value_m >= least_m,
    }


def _together(trajectories: list[Trajectory]) -> list[Anchored]:
    """All in one frame: missions by where on the Earth they are, others by their coordinates as they stand."""
    from companion.frames import ned_from_geo
    from companion.trajectory.anchored import anchored

    first = next((t.origin for t in trajectories if t.origin is not None), None)
    placed = []
    for trajectory in trajectories:
        apart: Vec3 = (0.0, 0.0, 0.0)
        if trajectory.origin is not None and first is not None:
            north, east, down = ned_from_geo(trajectory.origin.point, first.point)
            apart = (north, east, 0.0 if trajectory.origin.altitude_above_home else down)
        placed.append(anchored(replace(trajectory, anchor="home"), apart, apart))
    return placed


def _show_separation(near: dict[str, Any] | None) -> None:
    if near is None:
        return
    one, other = near["files"]
    verdict = f"at least {near['required_m']:g} m are required" if near["refused"] else "far enough"
    print(f"separation: {one} and {other} come to {near['value_m']:.2f} m at {near['at_s']:.2f} s; {verdict}")
    sys.stdout.flush()
