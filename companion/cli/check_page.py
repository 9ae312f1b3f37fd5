"""What `companion check` shows to people: a table of what a trajectory asks for, and a small plot of its path."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from companion.cli.sketch import sketch
from companion.flight.inspection import End, Inspection
from companion.trajectory.pieces import sample

if TYPE_CHECKING:
    from companion.trajectory.torque import Step

SAMPLES = 3000
COLUMNS, ROWS, PROFILE_ROWS = 40, 10, 3
PREDICTED = (
    ("thrust_min_n", "thrust, least", "N"),
    ("thrust_max_n", "thrust", "N"),
    ("tilt_max_rad", "tilt", "rad"),
    ("rate_max_rad_s", "body rate, one axis", "rad/s"),
    ("torque_max_n_m", "torque, one axis", "N m"),
    ("error_max_m", "position error", "m"),
)


def show(inspection: Inspection, document: dict[str, Any], vehicle: str) -> None:
    """Print one trajectory's table, remarks, plot and verdict."""
    console = Console(file=sys.stdout, highlight=False, markup=False, soft_wrap=True)
    trajectory = inspection.trajectory
    scale = "" if trajectory.time_scale == 1.0 else f" at a time scale of {trajectory.time_scale:g}"
    console.print(f"{trajectory.name} on {vehicle}: {trajectory.duration_s:.2f} s{scale}, anchor {trajectory.anchor}")
    for note in trajectory.notes:
        console.print(f"  {note}")
    if inspection.peaks:
        console.print(_table(inspection, document))
        for line in _remarks(inspection, document):
            console.print(f"  {line}")
        for line in _plot(inspection, plain=console.options.ascii_only):
            console.print(f"  {line}")
    for problem in document["problems"]:
        console.print(f"refused: {problem['sentence']}")
    console.print("verdict: must not be flown" if document["problems"] else "verdict: can be flown")


def _table(inspection: Inspection, document: dict[str, Any]) -> Table:
    """The extremes of the reference, then those of the predicted beginning."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("  reference", no_wrap=True)
    for name in ("most", "at", "limit", "used"):
        table.add_column(name, justify="right", no_wrap=True)
    for peak in inspection.peaks:
        limit = "-" if peak.limit is None else f"{peak.limit:.3g} {peak.unit}"
        used = "-" if peak.use is None else f"{100.0 * peak.use:.0f} %"
        table.add_row(f"  {peak.name}", f"{peak.value:.3g} {peak.unit}", f"{peak.at_s:.2f} s", limit, used)
    predicted = document["predicted"]
    if predicted is not None:
        table.add_row()
        table.add_row(f"  predicted, first {predicted['over_s']:g} s", style="bold")
        for key, name, unit in PREDICTED:
            extreme = predicted[key]
            table.add_row(f"  {name}", f"{extreme['value']:.3g} {unit}", f"{extreme['at_s']:.2f} s", "", "")
    return table


def _remarks(inspection: Inspection, document: dict[str, Any]) -> list[str]:
    """Continuity, ends, margins and pace, a line each."""
    steps = inspection.snap_steps
    lines = [
        "fourth derivative: continuous"
        if not steps
        else f"fourth derivative: {len(steps)} jumps, the largest {_step(steps[0])} at {steps[0].at_s:.2f} s"
    ]
    for name, end in (("start", inspection.start), ("end", inspection.end)):
        if end is not None:
            lines.append(f"{name}: {_end(end)}")
    if document["heading"] is not None:
        lines.append(_heading(document["heading"]))
    north, east, down = document["start"]["position_m"]
    lines.append(f"held before at ({north:.2f}, {east:.2f}, {down:.2f}) m from home, north, east, down (--start)")
    for name, margin in (("lowest above home", inspection.ground), ("nearest to the fence", inspection.fence)):
        if margin is not None:
            lines.append(f"{name}: {margin.value_m:.2f} m at {margin.at_s:.2f} s")
    pace = inspection.time_scale
    lines.append(
        "no time scale keeps the limits" if pace is None else f"the limits are kept up to a time scale of {pace:.3g}"
    )
    return lines


def _heading(heading: dict[str, Any]) -> str:
    start_deg, end_deg = (round(heading[key], 1) % 360.0 for key in ("start_deg", "end_deg"))
    said = f"heading: {start_deg:g} deg at the start, {end_deg:g} deg at the end, clockwise from north"
    return said if heading["followed"] else f"{said}; not followed: this vehicle chooses its own"


def _end(end: End) -> str:
    moving = (
        f"{end.speed_m_s:.3g} m/s, {end.acceleration_m_s2:.3g} m/s^2, {end.jerk_m_s3:.3g} m/s^3,"
        f" {end.snap_m_s4:.3g} m/s^4"
    )
    return f"{moving}; {end.joined}"


def _step(step: Step) -> str:
    return (
        f"{step.snap_m_s4:.3g} m/s^4, a step of {step.angular_acceleration_rad_s2:.3g} rad/s^2"
        f" ({step.torque_n_m:.3g} N m)"
    )


def _plot(inspection: Inspection, *, plain: bool) -> list[str]:
    """The path from above, north up, and its height over time."""
    samples = sample(inspection.path, SAMPLES)
    north, east, height = samples.p[:, 0].tolist(), samples.p[:, 1].tolist(), (-samples.p[:, 2]).tolist()
    lines = [
        f"from above, north up: {max(east) - min(east):.3g} m east-west, {max(north) - min(north):.3g} m north-south",
        *sketch(east, north, columns=COLUMNS, rows=ROWS, same_scale=True, plain=plain),
        f"height over time: {min(height):.3g} to {max(height):.3g} m",
    ]
    if max(height) - min(height) > 0.01:
        lines += sketch(samples.t_s.tolist(), height, columns=COLUMNS, rows=PROFILE_ROWS, same_scale=False, plain=plain)
    return lines
