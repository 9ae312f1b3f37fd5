"""The commands between a state's stamp and the time at which the next command takes effect, as flat numbers.

A command computed from a state stamped s acts from s + delay until the next one does (docs/law.md section 8, "Delay").
So between a stamp and its time of effect the commands of the last delay/interval samples act one after the other. Here
they are remembered with their times, and given as a few pieces that `model.through` runs through. The thrust that acts
at the stamp is not measured: it is followed with the same model.

A history is a sequence of CAPACITY floats that its owner allocates once (`flight.prediction`): a list for plain Python,
an array for compiled code. All functions are kernels.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from math import cos, exp, inf, isnan, nan
from typing import NamedTuple

from companion.control.model import PIECE, lag_factors
from companion.control.types import Quat, State, Vec3
from companion.control.vectors import quat_exp, quat_multiply, quat_normalise

SHORTEST_S = 1e-6
"""Shorter pieces are rounding errors of the stamps."""
APART_COSINE = cos(0.05)
"""Of half the angle: attitudes further apart than 0.1 rad are of different estimates, with a reset between them."""

# where things stand in a history
THRUST = 0
"""The thrust that acts at the last stamp [N], by the model."""
AT = 1
"""That stamp [s]; NaN before the first."""
LAG = 2
"""Time constant of the thrust behind its setpoint [s]."""
COUNT = 3
"""Pieces that the delay is divided into."""
LENGTH = 4
"""Of each [s]; 0 without a delay."""
BEGIN = 5
"""Where the oldest command stands."""
END = 6
"""Where the next one will."""
COMMANDS = 7
"""Where commands begin: the time from which it acts [s], thrust setpoint [N], rate setpoints [rad/s], and what the ones
before it have given until then, summed over time [N s, rad]. The first one has acted before its time, too. Behind the
last one there is room for one more, whose time and sums may be known already."""
COMMAND = 9
CAPACITY = COMMANDS + 2048 * COMMAND
"""More than the longest delay that a vehicle file may have at 1000 states per second; where more would be under way the
oldest is forgotten."""
FORGOTTEN_MAX = 14 * COMMAND
"""So much room at the front is used again: the sums stay small, and so do the indices of what is in use (plain Python
has those up to 256 at hand, and makes all others)."""


class Attitude(NamedTuple):
    """Attitude and rates at an instant, without the rest of a state."""

    at_s: float
    """Vehicle time [s]."""
    q: Quat
    """Body to inertial."""
    w: Vec3
    """Body rates [rad/s]."""


def begin(h: MutableSequence[float], thrust_n: float, thrust_lag_s: float) -> None:
    """Begins with a hover: until the first command acts, what holds it does."""
    h[THRUST], h[AT], h[LAG] = thrust_n, nan, thrust_lag_s
    h[BEGIN], h[END] = COMMANDS, COMMANDS + COMMAND
    for i in range(COMMANDS, COMMANDS + COMMAND):
        h[i] = 0.0
    h[COMMANDS + 1] = thrust_n
    h[COMMANDS + COMMAND] = nan


def remember(h: MutableSequence[float], from_s: float, thrust_n: float, x: float, y: float, z: float) -> None:
    """Appends a command: the time from which it acts [s], thrust setpoint [N] and body rate setpoints [rad/s].

    What was to act later than it does not act any more.
    """
    start, end = int(h[BEGIN]), int(h[END])
    while h[end - COMMAND] > from_s and end - start > COMMAND:
        end -= COMMAND
    if end + 2 * COMMAND > CAPACITY or start - COMMANDS >= FORGOTTEN_MAX:
        end = _make_room(h, start, end)
    if not -SHORTEST_S < from_s - h[end] < SHORTEST_S:  # else `gather` has summed already
        i = end - COMMAND
        for_s = from_s - h[i]
        h[end + 5] = h[i + 5] + for_s * h[i + 1]
        h[end + 6] = h[i + 6] + for_s * h[i + 2]
        h[end + 7] = h[i + 7] + for_s * h[i + 3]
        h[end + 8] = h[i + 8] + for_s * h[i + 4]
    h[end] = from_s
    h[end + 1] = thrust_n
    h[end + 2] = x
    h[end + 3] = y
    h[end + 4] = z
    h[END] = end = end + COMMAND
    h[end] = nan


def _make_room(h: MutableSequence[float], start: int, end: int) -> int:
    """Moves what is left to the front, where the sums begin anew; gives where it ends there, or ends now."""
    full = end + 2 * COMMAND > CAPACITY
    if full and start == COMMANDS:
        start += COMMAND
    if not full and start - COMMANDS < end - start:
        return end
    thrust, x, y, z = h[start + 5], h[start + 6], h[start + 7], h[start + 8]
    i = COMMANDS
    for j in range(start, end, COMMAND):
        h[i : i + 5] = h[j : j + 5]
        h[i + 5], h[i + 6] = h[j + 5] - thrust, h[j + 6] - x
        h[i + 7], h[i + 8] = h[j + 7] - y, h[j + 8] - z
        i += COMMAND
    h[BEGIN] = COMMANDS
    h[i] = nan
    return i


def follow(h: MutableSequence[float], stamp_s: float) -> None:
    """Brings the modelled thrust to a stamp [s] and forgets commands that have ceased to act.

    To an earlier stamp it goes on from where it is: such states are not flown by (`link.telemetry`).
    """
    at_s, lag_s, thrust = h[AT], h[LAG], h[THRUST]
    h[AT] = stamp_s
    i, end = int(h[BEGIN]), int(h[END])
    if isnan(at_s):
        if end - i == COMMAND:  # nothing is summed yet
            h[i] = stamp_s
        return
    while True:
        following = i + COMMAND
        following_s = h[following] if following < end else inf
        until_s = following_s if following_s < stamp_s else stamp_s
        if until_s - at_s > SHORTEST_S:
            setpoint = h[i + 1]
            gap = (thrust - setpoint) * exp((at_s - until_s) / lag_s) if lag_s > 0.0 else 0.0
            thrust, at_s = setpoint + gap, until_s
        if following_s > stamp_s + SHORTEST_S:
            break
        i = following
    h[THRUST] = thrust
    h[BEGIN] = i


def gather(h: MutableSequence[float], stamp_s: float, out: MutableSequence[float], at: int) -> int:
    """Writes what acts from a stamp until its own command will, as pieces; `follow` was asked for the stamp before.

    Args:
        h: the history.
        stamp_s: of the state [s].
        out: gets PIECE numbers per piece.
        at: where in `out`.

    Returns:
        the number of pieces; 0 without a delay.
    """
    count = int(h[COUNT])
    if count == 0:
        return 0
    length_s = h[LENGTH]
    k = 1.0 / length_s
    i, end = int(h[BEGIN]), int(h[END])
    last = end - COMMAND
    for_s = stamp_s - h[i]
    t0, x0, y0, z0 = h[i + 5], h[i + 6], h[i + 7], h[i + 8]
    t0, x0, y0, z0 = t0 + for_s * h[i + 1], x0 + for_s * h[i + 2], y0 + for_s * h[i + 3], z0 + for_s * h[i + 4]
    for _ in range(count):
        stamp_s += length_s
        while i < last and h[i + COMMAND] < stamp_s:
            i += COMMAND
        for_s = stamp_s - h[i]
        t, x, y, z = h[i + 5], h[i + 6], h[i + 7], h[i + 8]
        t, x, y, z = t + for_s * h[i + 1], x + for_s * h[i + 2], y + for_s * h[i + 3], z + for_s * h[i + 4]
        out[at] = k * (t - t0)
        out[at + 1] = k * (x - x0)
        out[at + 2] = k * (y - y0)
        out[at + 3] = k * (z - z0)
        out[at + 4] = length_s
        t0, x0, y0, z0 = t, x, y, z
        at += PIECE
    h[end], h[end + 5], h[end + 6], h[end + 7], h[end + 8] = stamp_s, t0, x0, y0, z0  # its own command begins there
    return count


def refreshed(
    state: State, stamp_s: float, attitude: Attitude, pieces: Sequence[float], at: int, count: int, lags_s: Vec3
) -> tuple[State, bool]:
    """The state at its stamp from which the model comes by a newer attitude, and whether there is one.

    Position and velocity stay: attitude and rates are followed back from the newer ones to the stamp.

    Args:
        state: as received.
        stamp_s: its stamp [s].
        attitude: after the stamp.
        pieces: what acts from the stamp on, from `gather`.
        at: where in `pieces`.
        count: the number of pieces.
        lags_s: of roll, pitch and yaw rate behind their setpoints [s].
    """
    left_s, span_s, reached = attitude.at_s - stamp_s, 0.0, 0
    for i in range(count):
        within_s = min(left_s, pieces[at + PIECE * i + 4])
        if within_s > SHORTEST_S:
            left_s -= within_s
            span_s, reached = within_s, i + 1
    if left_s > SHORTEST_S:  # beyond what is predicted
        return state, False
    q, (wx, wy, wz) = attitude.q, attitude.w
    for i in range(reached - 1, -1, -1):
        j = at + PIECE * i
        wx, x = _back(wx, pieces[j + 1], lags_s[0], span_s)
        wy, y = _back(wy, pieces[j + 2], lags_s[1], span_s)
        wz, z = _back(wz, pieces[j + 3], lags_s[2], span_s)
        a, b, c, d = quat_exp((x, y, z))
        q = quat_multiply(q, (a, -b, -c, -d))
        if i > 0:
            span_s = pieces[j - PIECE + 4]
    a, b, c, d = state.q
    if abs(q[0] * a + q[1] * b + q[2] * c + q[3] * d) < APART_COSINE:
        return state, False
    return State(state.p, state.v, quat_normalise(q), (wx, wy, wz)), True


def _back(w: float, rate: float, lag_s: float, span_s: float) -> tuple[float, float]:
    """A rate before a span at the end of which it is `w`, and the angle turned meanwhile."""
    decay, share = lag_factors(lag_s, span_s)
    if decay <= 0.0:
        return w, rate * span_s
    gap = (w - rate) / decay
    return rate + gap, span_s * (rate + gap * share)
