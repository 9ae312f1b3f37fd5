"""The accounts of a step that was answered by reflex, in one call: its row, and whether the guards have to look at it.

Almost every step breaks no limit, keeps the envelope of V_H and follows its commands. Then its row is written and the
model of the rates goes on, and nothing else is to be done. What is not so is declined before anything was changed:
`Watch.on_step` looks at it, as at every step that took the usual way.
"""

from __future__ import annotations

import struct
from collections.abc import MutableSequence, Sequence
from typing import Any

import numpy as np

from companion import accelerate
from companion.control import flat
from companion.flight import envelope, following, fused, reflex
from companion.flight.envelope import keeps
from companion.flight.following import follow, off_by
from companion.flight.fused import find_target
from companion.record.columns import COLUMN_INDEX, COLUMNS

# where things stand among the numbers
(
    TRACK_S,  # time on the trajectory [s], NaN outside of the track phase
    PHASE,  # its index
    AGE_MS,  # of the state when its answer went out
    TOOK_US,  # from the state's arrival to its answer
    LATE,  # 1: that was late
    NOW_S,  # vehicle time at the state's arrival
    DELAY_S,  # from a stamp to the effect of its command
    ERROR_MAX_M,
    TILT_COSINE_MIN,
    RATE_ERROR_MAX_RAD_S,
) = range(10)
ROW = 10
SIZE = ROW + len(COLUMNS)
_LAW, _LIMITS = flat.RECORDED
_LAW_AT, _SENT_AT, _LIMITS_AT = (COLUMN_INDEX[name] for name in ("heading_error_rad", "thrust_cmd", "limits"))
_LAW_BEGIN, _LAW_COUNT = fused.RESULTS + _LAW.start, _LAW.stop - _LAW.start
_LIMITS_BEGIN, _LIMITS_COUNT = fused.RESULTS + _LIMITS.start, _LIMITS.stop - _LIMITS.start
_ERRORS = fused.RESULTS + flat.ERRORS.start
_FLAGS = fused.RESULTS + flat.LIMITS
_NEARLY = 1.0 - 1e-12
"""A length is rounded in its last digits: at its limit the guards look themselves."""


def reckon(z: Any, m: Any, r: Sequence[float], g: Any, e: Sequence[float], w: MutableSequence[float]) -> bool:
    """Writes the row of a step and goes on, if there is nothing that the guards would find.

    Args:
        z: of the reflex that made the step (`reflex.reflex`).
        m: of the step (`fused.flight_step`).
        r: the curve that its reference was on.
        g: SIZE numbers; gets the row.
        e: the envelope (`flight.envelope`).
        w: the model of the rates (`flight.following`).

    Returns:
        Whether that is so; otherwise nothing was changed but what is told of the reference at the stamp.
    """
    s = z[reflex.FLOATS : reflex.SIZE].view(np.float64)[reflex.SEEN :]
    stamp_s = m[fused.STAMP]
    find_target(m, r)
    x, y, height = s[0] - m[fused.TARGET], s[1] - m[fused.TARGET + 1], s[2] - m[fused.TARGET + 2]
    most = g[ERROR_MAX_M] * _NEARLY
    if not x * x + y * y + height * height < most * most or m[_FLAGS] != 0.0:
        return False
    if 1.0 - 2.0 * (s[7] * s[7] + s[8] * s[8]) < g[TILT_COSINE_MIN] or not keeps(e, m, _ERRORS, g[NOW_S]):
        return False
    if off_by(w, stamp_s, s[10], s[11]) > g[RATE_ERROR_MAX_RAD_S]:
        return False
    follow(w, stamp_s, s[10], s[11], m[fused.SENT + 1], m[fused.SENT + 2], g[DELAY_S])
    row = g[ROW:]
    row[0], row[1], row[2] = stamp_s, g[TRACK_S], g[PHASE]
    for i in range(13):
        row[3 + i] = s[i]
    for i in range(6):
        row[16 + i] = m[fused.TARGET + i]
    row[22], row[23], row[24] = x, y, height
    for i in range(_LAW_COUNT):
        row[_LAW_AT + i] = m[_LAW_BEGIN + i]
    row[_SENT_AT] = m[fused.SENT]
    row[_SENT_AT + 1], row[_SENT_AT + 2], row[_SENT_AT + 3] = g[AGE_MS], g[TOOK_US], g[LATE]
    row[_SENT_AT + 4] = 0.0  # skipped: a step by reflex has nothing before it
    for i in range(_LIMITS_COUNT):
        row[_LIMITS_AT + i] = m[_LIMITS_BEGIN + i]
    return True


class Reckoner:
    """Keeps the accounts of one flight's steps by reflex."""

    def __init__(self) -> None:
        self._g = np.zeros(SIZE)
        nothing = np.zeros(reflex.SIZE, np.int64), np.zeros(fused.SIZE), np.zeros(fused.NO_CURVE), self._g
        self._kernel = accelerate.compile_for(reckon, *nothing, np.zeros(envelope.SIZE), np.zeros(following.SIZE))
        memory = self._g.data.cast("B")
        self._give = struct.Struct("=10d").pack_into
        self._memory, self._row = memory, memory[8 * ROW :]

    def step(self, z: Any, m: Any, r: Any, given: Sequence[float], e: Any, w: Any) -> bytes | None:
        """The row of a step; None where the guards have to look at it.

        Args:
            z: of the reflex that made it.
            m: of the step.
            r: its curve.
            given: TRACK_S to RATE_ERROR_MAX_RAD_S.
            e: the envelope.
            w: the model of the rates.
        """
        self._give(self._memory, 0, *given)
        return self._row.tobytes() if self._kernel(z, m, r, self._g, e, w) else None
