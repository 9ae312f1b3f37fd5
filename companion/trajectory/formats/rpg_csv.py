"""Sampled states and inputs as RPG's and Agilicious' planners write them; TOGT and other time-optimal planners too.

Columns: t, position, attitude, velocity, body rate, linear and angular acceleration, rotor thrusts, jerk, snap; files
end after any of these groups from the attitude on. A world with z up, SI, attitudes w first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.control.types import Quat
from companion.frames import Frame, yaw_from_quat, yaw_ned_from
from companion.trajectory.formats.contents import Sampled
from companion.trajectory.formats.reading import Row, Source, header_of, table
from companion.trajectory.formats.samples import sampled

COLUMNS = (
    *("t", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z", "v_x", "v_y", "v_z", "w_x", "w_y", "w_z"),
    *("a_lin_x", "a_lin_y", "a_lin_z", "a_rot_x", "a_rot_y", "a_rot_z", "u_1", "u_2", "u_3", "u_4"),
    *("jerk_x", "jerk_y", "jerk_z", "snap_x", "snap_y", "snap_z"),
)
LENGTHS = (8, 11, 14, 17, 20, 24, 27, 30)
"""Of the short and full forms: the number of columns at the end of each group."""

NORM_TOLERANCE = 0.02
"""How far a quaternion's length may be from 1."""

TILT_CORRELATION = -0.5
LEAN_MIN = 0.02
"""Below this horizontal part of the thrust direction, attitudes say nothing about the frame."""


def matches(source: Source) -> bool:
    """Whether the header begins like that of such a file."""
    return header_of(source).names[:5] == COLUMNS[:5]


def read(source: Source, frame: Frame) -> Sampled:
    """Return the samples of a file, in north-east-down. Raises InputError."""
    line, header = header_of(source)
    if len(header) not in LENGTHS or header != COLUMNS[: len(header)]:
        raise source.fault(
            line,
            f"{len(header)} columns in the header that are not those of the format; it ends after q_z, v_z, w_z,"
            " a_lin_z, a_rot_z, u_4, jerk_z or snap_z",
        )
    rows = table(source, header)
    attitudes = [_attitude(source, row) for row in rows]
    has_acceleration = len(header) >= 17
    if has_acceleration:
        _check_z_up(source, rows, attitudes)
    return sampled(
        source,
        rows,
        [row.values[0] for row in rows],
        (1, 2, 3),
        frame,
        velocities=(8, 9, 10) if len(header) >= 11 else None,
        accelerations=(14, 15, 16) if has_acceleration else None,
        yaw_rad=[yaw_ned_from(frame, yaw_from_quat(q)) for q in attitudes],
        notes=("the attitudes count only for the heading; rates and inputs of the file are not used",),
    )


def _attitude(source: Source, row: Row) -> Quat:
    w, x, y, z = row.values[4:8]
    norm = (w * w + x * x + y * y + z * z) ** 0.5
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise source.fault(row.line, f"the attitude q_w .. q_z has the length {norm:.4g}; it must be 1")
    return w / norm, x / norm, y / norm, z / norm


def _check_z_up(source: Source, rows: Sequence[Row], attitudes: Sequence[Quat]) -> None:
    """The thrust must lean to where the path accelerates: with z down it leans the other way."""
    q = np.array(attitudes)
    lean = 2.0 * np.stack([q[:, 1] * q[:, 3] + q[:, 0] * q[:, 2], q[:, 2] * q[:, 3] - q[:, 0] * q[:, 1]], axis=1)
    pulled = np.array([row.values[14:16] for row in rows])
    size = float(np.sqrt((lean**2).sum() * (pulled**2).sum()))
    if size == 0.0 or float(np.abs(lean).max()) < LEAN_MIN:
        return
    if float((lean * pulled).sum()) / size < TILT_CORRELATION:
        raise source.fault(
            None,
            "its attitudes lean away from where its path accelerates, as they do in a frame with z down; this format"
            " has z up",
        )
