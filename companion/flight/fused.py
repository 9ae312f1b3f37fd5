"""The whole control step of a flight as one kernel: history, reference, prediction, law, and what is sent of it.

What plain Python strings together from `control.history`, `trajectory.curve` and `control.flat` is one call here, on
arrays that are allocated once: between compiled functions every number that passes through Python costs more than what
is done with it.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence
from typing import Any

from companion.control import flat, history
from companion.control.flat import control_step
from companion.control.history import Attitude, follow, gather, refreshed, remember
from companion.control.model import PIECE
from companion.control.output import thrust_fraction
from companion.control.types import State
from companion.flight.prediction import PIECES_MAX
from companion.trajectory.curve import MOVED, on_curve

# where things stand among the numbers
STAMP = 0
"""Vehicle time of the state [s]."""
INPUT = 1
"""What `flat.control_step` reads, state first. Between state and reference, and behind the controller's state, a whole
step writes itself."""
CONSTANTS = INPUT + flat.PIECES + PIECE * PIECES_MAX
CONVERSION = CONSTANTS + flat.CONSTANTS
"""Collective thrust at a command of 1 [N], curve factor (`output.Conversion`)."""
LAGS = CONVERSION + 2
"""Of roll, pitch and yaw rate behind their setpoints [s]."""
DELAY = LAGS + 3
"""From a stamp to the effect of its command [s]."""
INTERVAL = DELAY + 1
"""In place of the time since the last step, where there is none to integrate over [s]."""
GAP_MAX = INTERVAL + 1
"""The longest one to integrate over [s]."""
WHOLE = GAP_MAX + 1
"""1: a whole step; 0: its times, pieces and thrust are given, and nothing is remembered."""
LAST = WHOLE + 1
"""Stamp of the last step [s]; NaN before the first. A whole step replaces it."""
FREEZE = LAST + 1
"""1: hold the estimator still."""
ON_CURVE = FREEZE + 1
"""1: the reference is on the curve; 0: it is given."""
BEGIN = ON_CURVE + 1
"""Vehicle time at which the course began [s]."""
JOIN = BEGIN + 1
"""How long after that the piece does that the curve is of [s]."""
ATTITUDE = JOIN + 1
"""One that is newer than the state: vehicle time [s], quaternion, body rates; its time is 0 when there is none, as it
is after every whole step."""
RESULTS = ATTITUDE + 8
"""What `flat.control_step` gives, then what follows."""
SENT = RESULTS + flat.RESULTS
"""The thrust command, 0 to 1, and the body rates [rad/s]."""
REFRESHED = SENT + 4
"""1: the prediction came from the newer attitude."""
TARGET = REFRESHED + 1
"""Position and velocity of the reference at the stamp; `find_target` writes them."""
SIZE = TARGET + 6
NO_CURVE = MOVED + 3
"""Numbers of a curve that is never read."""
_RATES = RESULTS + flat.RATES.start


def flight_step(m: Any, h: MutableSequence[float], r: Sequence[float]) -> None:
    """One control step.

    Args:
        m: SIZE numbers, an array: its parts are views. The controller's state and the results are replaced.
        h: the history (`control.history`).
        r: the curve (`trajectory.curve`); not read where the reference is given.
    """
    x = m[INPUT:CONSTANTS]
    stamp_s = m[STAMP]
    if m[WHOLE] > 0.5:
        _time(m, x, stamp_s)
        follow(h, stamp_s)
        count = gather(h, stamp_s, x, flat.PIECES)
        x[flat.THRUST_NOW], x[flat.COUNT] = h[history.THRUST], float(count)
        m[REFRESHED] = 0.0
        if m[ATTITUDE] > stamp_s:
            _refresh(m, x, stamp_s, count)
        m[ATTITUDE] = 0.0
    if m[ON_CURVE] > 0.5:
        _ask_curve(m, x, r, stamp_s)
    y = m[RESULTS:SENT]
    control_step(x, m[CONSTANTS:CONVERSION], y)
    if m[WHOLE] > 0.5:
        i = flat.THRUST  # the rates of the model stand behind it
        remember(h, stamp_s + m[DELAY], y[i], y[i + 1], y[i + 2], y[i + 3])
    m[SENT] = thrust_fraction(y[flat.THRUST], m[CONVERSION], m[CONVERSION + 1])
    m[SENT + 1], m[SENT + 2], m[SENT + 3] = m[_RATES], m[_RATES + 1], m[_RATES + 2]


def _time(m: Any, x: MutableSequence[float], stamp_s: float) -> None:
    """Finds out how long to integrate over: over a gap that is too long, or none, the controller's state waits."""
    dt_s, frozen, integrate = stamp_s - m[LAST], m[FREEZE], 1.0
    if not 0.0 < dt_s <= m[GAP_MAX]:
        if not math.isnan(dt_s):
            frozen, integrate = 1.0, 0.0
        dt_s = m[INTERVAL]
    x[flat.DT], x[flat.FROZEN], x[flat.INTEGRATE] = dt_s, frozen, integrate
    m[LAST] = stamp_s


def _refresh(m: Any, x: MutableSequence[float], stamp_s: float, count: int) -> None:
    """Puts the state in the place from which the model comes by the newer attitude."""
    state = State((x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8], x[9]), (x[10], x[11], x[12]))
    i = ATTITUDE
    attitude = Attitude(m[i], (m[i + 1], m[i + 2], m[i + 3], m[i + 4]), (m[i + 5], m[i + 6], m[i + 7]))
    lags_s = (m[LAGS], m[LAGS + 1], m[LAGS + 2])
    state, used = refreshed(state, stamp_s, attitude, x, flat.PIECES, count, lags_s)
    if used:
        x[6], x[7], x[8], x[9] = state.q
        x[10], x[11], x[12] = state.w
        m[REFRESHED] = 1.0


def _ask_curve(m: Any, x: MutableSequence[float], r: Sequence[float], stamp_s: float) -> None:
    """Takes the reference at the time of effect from the curve."""
    p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = on_curve(r, stamp_s + m[DELAY] - m[BEGIN] - m[JOIN])
    i = flat.REFERENCE
    for k in range(3):
        x[i + k], x[i + 3 + k], x[i + 6 + k] = p[k], v[k], a[k]
        x[i + 9 + k], x[i + 12 + k] = j[k], s[k]
    x[i + 15], x[i + 16], x[i + 17] = yaw, yaw_rate, yaw_acceleration


def find_target(m: Any, r: Sequence[float]) -> None:
    """Works out where the reference on a curve is at the stamp of the last step: what its error counts from.

    Args:
        m: as it was left by `flight_step`.
        r: the curve.
    """
    now = on_curve(r, m[STAMP] - m[BEGIN] - m[JOIN])
    for k in range(3):
        m[TARGET + k], m[TARGET + 3 + k] = now.p[k], now.v[k]
