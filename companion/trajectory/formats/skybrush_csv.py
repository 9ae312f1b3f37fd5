"""Sampled paths as Skybrush Studio exports them, one file per drone.

Columns: Time [msec], x [m], y [m], z [m], Red, Green, Blue. Z up; where shows are flown, y counts to the west.
"""

from __future__ import annotations

from companion.frames import Frame
from companion.trajectory.formats.contents import Sampled
from companion.trajectory.formats.reading import Source, header_of, table
from companion.trajectory.formats.samples import sampled

COLUMNS = ("time [msec]", "x [m]", "y [m]", "z [m]", "red", "green", "blue")


def matches(source: Source) -> bool:
    """Whether the header begins like that of such a file."""
    return header_of(source).names[:2] == COLUMNS[:2]


def read(source: Source, frame: Frame) -> Sampled:
    """Return the samples of a file, in north-east-down. Raises InputError."""
    line, header = header_of(source)
    if header not in (COLUMNS, COLUMNS[:4]):
        raise source.fault(line, f"the header must be {','.join(COLUMNS)}; the colours may be left out")
    rows = table(source, header)
    return sampled(
        source,
        rows,
        [row.values[0] / 1000.0 for row in rows],
        (1, 2, 3),
        frame,
        notes=("the colours are not used",) if len(header) > 4 else (),
    )
