"""Polynomial pieces as uav_trajectories and Crazyswarm write them.

Columns: duration, x^0 .. x^7, y^0 .. y^7, z^0 .. z^7, yaw^0 .. yaw^7, and often a comma behind the last; one row per
piece, ascending powers of the time since the piece's start; metres, radians, seconds, z up.
"""

from __future__ import annotations

from itertools import accumulate, pairwise
from math import isfinite

from companion.frames import Frame, ned_from, yaw_ned_from
from companion.trajectory.formats.contents import Polynomials
from companion.trajectory.formats.reading import (
    DURATION_MAX_S,
    POSITION_MAX_M,
    SPEED_MAX_M_S,
    Row,
    Source,
    cells_of,
    header_of,
    lines_of,
    table,
    within,
)
from companion.trajectory.formats.rounding import close, last_digit
from companion.trajectory.piecewise import PathPiece, Piecewise, coefficients
from companion.trajectory.polynomial import Coefficients

POWERS = 8
COLUMNS = ("duration", *(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(POWERS)))
PROBES = 8
"""Instants of a piece at which its speed is looked at."""
YAW_MAX_RAD = 1e4


def matches(source: Source) -> bool:
    """Whether the header is that of such a file, however many columns are left of it."""
    return header_of(source).names[:2] == COLUMNS[:2]


def read(source: Source, frame: Frame) -> Polynomials:
    """Return the pieces of a file, in north-east-down. Raises InputError."""
    line, header = header_of(source)
    if header != COLUMNS:
        raise source.fault(
            line, f"{len(header)} columns in the header, {len(COLUMNS)} are expected: duration, x^0 .. yaw^7"
        )
    rows = table(source, COLUMNS)
    path = []
    yaw = []
    for row in rows:
        duration_s = row.values[0]
        if not duration_s > 0.0:
            raise source.fault(row.line, f"duration is {duration_s:g} s; it must be above zero")
        within(source, row.line, duration_s, DURATION_MAX_S, "duration", "s")
        piece, turn = _piece(row, frame)
        _check(source, row, piece, turn)
        path.append(piece)
        yaw.append(turn)
    knots_s = tuple(accumulate((row.values[0] for row in rows), initial=0.0))
    within(source, rows[-1].line, knots_s[-1], DURATION_MAX_S, "the duration of all pieces", "s")
    if any(after <= before for before, after in pairwise(knots_s)):
        raise source.fault(None, "has a piece that is too short to count beside the others")
    durations_s = [row.values[0] for row in rows]
    quanta = _quanta(source)
    axes = [close([piece[axis] for piece in path], durations_s, quanta) for axis in range(3)]
    turned = close(yaw, durations_s, quanta)
    notes = [] if any(any(row.values[25:]) for row in rows) else ["the file's heading is zero throughout"]
    if any(closed.joints for closed in axes):
        jumps = max(closed.largest for closed in axes)
        notes.append(f"pieces that meet but for rounding were joined: they were up to {jumps:.1g} m apart")
    return Polynomials(
        shape=Piecewise(
            knots_s=knots_s,
            pieces=tuple(PathPiece(*piece) for piece in zip(*(closed.pieces for closed in axes), strict=True)),
            yaw_knots_s=knots_s,
            yaw_pieces=turned.pieces,
        ),
        notes=tuple(notes),
    )


def _quanta(source: Source) -> list[float]:
    """Return the size of the last digit that each row writes its coefficients with."""
    lines = list(lines_of(source))[1:]
    return [max(last_digit(cell) for cell in cells_of(line)) for _, line in lines]


def _piece(row: Row, frame: Frame) -> tuple[PathPiece, Coefficients]:
    """Return position and heading of a row, in powers of the piece's normalised time."""
    duration_s = row.values[0]
    scales = [duration_s**power for power in range(POWERS)]
    x, y, z, yaw = (row.values[1 + POWERS * i : 1 + POWERS * (i + 1)] for i in range(4))
    moved = [ned_from(frame, (x[k] * scales[k], y[k] * scales[k], z[k] * scales[k])) for k in range(POWERS)]
    # A heading turns into another by an offset and a sign: the offset belongs to the constant term alone.
    offset = yaw_ned_from(frame, 0.0)
    turned = [yaw_ned_from(frame, yaw[k] * scales[k]) - (offset if k else 0.0) for k in range(POWERS)]
    north, east, down = (coefficients([vector[axis] for vector in moved]) for axis in range(3))
    return PathPiece(north, east, down), coefficients(turned)


def _check(source: Source, row: Row, piece: PathPiece, yaw: Coefficients) -> None:
    """Refuse what overflows, and what must be in another unit."""
    if not all(isfinite(c) for axis in (*piece, yaw) for c in axis):
        raise source.fault(row.line, "the coefficients are too large for the duration")
    duration_s = row.values[0]
    single = Piecewise(knots_s=(0.0, duration_s), pieces=(piece,), yaw_knots_s=(0.0, duration_s), yaw_pieces=(yaw,))
    for i in range(PROBES + 1):
        reference = single.at(duration_s * i / PROBES)
        for value in reference.p:
            within(source, row.line, value, POSITION_MAX_M, "the position", "m")
        for value in reference.v:
            within(source, row.line, value, SPEED_MAX_M_S, "the speed", "m/s")
        within(source, row.line, reference.yaw, YAW_MAX_RAD, "the heading", "rad")
