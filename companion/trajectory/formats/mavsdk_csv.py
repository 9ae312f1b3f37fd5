"""Sampled paths as MAVSDK's trajectory examples and the MAVSDK drone show write them.

Columns: idx, t, px, py, pz, vx, vy, vz, ax, ay, az, yaw, mode; of the show also ledr, ledg, ledb. North-east-down,
metres, seconds, the heading in degrees clockwise from north; `mode` is the phase of the show (0, 10 .. 100).
"""

from __future__ import annotations

from companion.frames import Frame, radians
from companion.trajectory.formats.contents import Sampled
from companion.trajectory.formats.reading import Source, header_of, table, within
from companion.trajectory.formats.samples import sampled

COLUMNS = ("idx", "t", "px", "py", "pz", "vx", "vy", "vz", "ax", "ay", "az", "yaw", "mode")
LEDS = ("ledr", "ledg", "ledb")
YAW_MAX_DEG = 3600.0
ON_GROUND_MODES = (0.0, 100.0)
"""Waiting on the ground, and landing."""


def matches(source: Source) -> bool:
    """Whether the header begins like that of such a file."""
    return header_of(source).names[:5] == COLUMNS[:5]


def read(source: Source, frame: Frame) -> Sampled:
    """Return the samples of a file. Raises InputError."""
    line, header = header_of(source)
    if header not in (COLUMNS, COLUMNS + LEDS):
        raise source.fault(line, f"the header must be {','.join(COLUMNS)} with or without {','.join(LEDS)}")
    rows = table(source, header)
    for row in rows:
        within(source, row.line, row.values[11], YAW_MAX_DEG, "yaw", "deg")
    modes = sorted({row.values[12] for row in rows})
    notes = [f"the mode codes ({', '.join(f'{mode:g}' for mode in modes[:12])}) are not followed: all rows are flown"]
    if any(mode in ON_GROUND_MODES for mode in modes):
        notes.append("the file has rows on the ground or of a landing (mode 0 or 100): they are part of what is flown")
    if len(header) > len(COLUMNS):
        notes.append("the LED colours are not used")
    return sampled(
        source,
        rows,
        [row.values[1] for row in rows],
        (2, 3, 4),
        frame,
        velocities=(5, 6, 7),
        accelerations=(8, 9, 10),
        yaw_rad=[radians(row.values[11]) for row in rows],
        notes=tuple(notes),
    )
