"""What all formats of sampled paths share: columns become arrays, and what no vehicle can have flown is refused."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Vec3
from companion.frames import Frame, ned_from
from companion.trajectory.formats.contents import Sampled
from companion.trajectory.formats.reading import (
    ACCELERATION_MAX_M_S2,
    DURATION_MAX_S,
    POSITION_MAX_M,
    SPEED_MAX_M_S,
    Row,
    Source,
    within,
)

SAMPLES_MIN = 12
"""Fewer do not determine a spline with its derivatives; they are waypoints."""

AXES = "xyz"


def vectors(rows: Sequence[Row], columns: tuple[int, int, int], frame: Frame) -> NDArray[np.float64]:
    """Return three columns of every row as north-east-down, shape (n, 3)."""
    i, j, k = columns
    return np.array([ned_from(frame, (row.values[i], row.values[j], row.values[k])) for row in rows])


def sampled(
    source: Source,
    rows: Sequence[Row],
    t_s: Sequence[float],
    positions: tuple[int, int, int],
    frame: Frame,
    *,
    velocities: tuple[int, int, int] | None = None,
    accelerations: tuple[int, int, int] | None = None,
    yaw_rad: Sequence[float] | None = None,
    notes: tuple[str, ...] = (),
) -> Sampled:
    """Return the samples of a table.

    Args:
        source: the file, for messages.
        rows: its rows.
        t_s: the time of each [s].
        positions: columns of x, y, z [m].
        frame: of all vectors.
        velocities: columns of the velocity [m/s].
        accelerations: columns of the acceleration [m/s^2].
        yaw_rad: heading of each row, clockwise from north; unwrapped here.
        notes: what the format has to say.

    Raises:
        InputError: too few rows, time that does not increase, or values that must be in another unit.

    """
    if len(rows) < SAMPLES_MIN:
        raise source.fault(
            rows[-1].line,
            f"the file ends after {len(rows)} samples, at least {SAMPLES_MIN} are needed; a few points to fly through"
            " are a waypoint file (x,y,z)",
        )
    _check_steps(source, rows, t_s, positions)
    for name, columns, limit, unit in (
        ("velocity", velocities, SPEED_MAX_M_S, "m/s"),
        ("acceleration", accelerations, ACCELERATION_MAX_M_S2, "m/s^2"),
    ):
        for row in rows if columns is not None else ():
            for axis, column in zip(AXES, columns or (), strict=True):
                within(source, row.line, row.values[column], limit, f"the {name} along {axis}", unit)
    return Sampled(
        t_s=np.array(t_s),
        p_m=vectors(rows, positions, frame),
        v_m_s=None if velocities is None else vectors(rows, velocities, frame),
        a_m_s2=None if accelerations is None else vectors(rows, accelerations, frame),
        yaw_rad=None if yaw_rad is None else np.unwrap(np.array(yaw_rad)),
        lines=tuple(row.line for row in rows),
        notes=notes,
    )


def _check_steps(source: Source, rows: Sequence[Row], t_s: Sequence[float], columns: tuple[int, int, int]) -> None:
    """Time must increase, and nothing may be farther or faster than a vehicle can be."""
    i, j, k = columns
    before_p: Vec3 | None = None
    before = rows[0]
    before_s = t_s[0]
    for row, at_s in zip(rows, t_s, strict=True):
        p = (row.values[i], row.values[j], row.values[k])
        for axis, value in zip(AXES, p, strict=True):
            within(source, row.line, value, POSITION_MAX_M, f"the position along {axis}", "m")
        if before_p is not None:
            step_s = at_s - before_s
            if step_s <= 0.0:
                verb = "is the same as" if step_s == 0.0 else "goes back behind that"
                raise source.fault(row.line, f"the time {at_s:.9g} s {verb} in line {before.line} ({before_s:.9g} s)")
            speed = dist(p, before_p) / step_s
            if not speed <= SPEED_MAX_M_S:
                raise source.fault(
                    row.line,
                    f"moves {dist(p, before_p):.4g} m in {step_s:.4g} s since line {before.line}: a speed of"
                    f" {speed:.4g} m/s is not believed; are time or position in another unit?",
                )
        before_p, before, before_s = p, row, at_s
    within(source, rows[-1].line, t_s[-1] - t_s[0], DURATION_MAX_S, "the time since the first sample", "s")
