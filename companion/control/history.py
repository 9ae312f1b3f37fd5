"""The commands between a state's stamp and the time at which the next command takes effect, as flat numbers.

A command computed from a state stamped s acts from s + delay until the next one does (docs/law.md section 8, "Delay").
So between a stamp and its time of effect the commands of the last delay/interval samples act one after the other. Here
they are remembered with their times, and given as a few pieces that `model.through` runs through. The thrust that acts
at the stamp is not measured: it is followed with the same model.

A history is a sequence of CAPACITY floats that its owner allocates once (`flight.prediction`): a list for plain Python,
an array for compiled code. All functions are kernels.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

from companion.control.model import PIECE, lag_factors, lagged
from companion.control.types import Quat, State, Vec3
from companion.control.vectors import quat_exp, quat_multiply, quat_normalise

SHORTEST_S = 1e-6
"""Shorter pieces are rounding errors of the stamps."""
APART_COSINE = math.cos(0.05)
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
"""Where commands begin: the time from which it acts [s], thrust setpoint [N], rate setpoints [rad/s]."""
COMMAND = 5
CAPACITY = COMMANDS + 2048 * COMMAND
"""More than the longest delay that a vehicle file may have at 1000 states per second; where more would be under way the
oldest is forgotten."""
FORGOTTEN_MAX = 32 * COMMAND
"""So much room at the front is used again: what is in use stays within a few kilobytes."""


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
    h[THRUST], h[AT], h[LAG] = thrust_n, math.nan, thrust_lag_s
    h[BEGIN], h[END] = float(COMMANDS), float(COMMANDS)
    remember(h, -math.inf, thrust_n, 0.0, 0.0, 0.0)


def remember(h: MutableSequence[float], from_s: float, thrust_n: float, x: float, y: float, z: float) -> None:
    """Appends a command: the time from which it acts [s], thrust setpoint [N] and body rate setpoints [rad/s]."""
    start, end = int(h[BEGIN]), int(h[END])
    if end + COMMAND > CAPACITY and start == COMMANDS:  # full
        start += COMMAND
    if end + COMMAND > CAPACITY or start - COMMANDS >= max(FORGOTTEN_MAX, end - start):
        for i in range(end - start):  # to the front with what is left
            h[COMMANDS + i] = h[start + i]
        end = COMMANDS + end - start
        h[BEGIN] = float(COMMANDS)
    h[end] = from_s
    h[end + 1] = thrust_n
    h[end + 2] = x
    h[end + 3] = y
    h[end + 4] = z
    h[END] = float(end + COMMAND)


def follow(h: MutableSequence[float], stamp_s: float) -> None:
    """Brings the modelled thrust to a stamp [s] and forgets commands that have ceased to act."""
    last_s = h[AT]
    h[AT] = stamp_s
    if math.isnan(last_s):
        return
    begin_at, end = int(h[BEGIN]), int(h[END])
    at_s = max(last_s, h[begin_at])
    thrust = h[THRUST]
    while True:
        following = begin_at + COMMAND
        following_s = h[following] if following < end else math.inf
        until_s = following_s if following_s < stamp_s else stamp_s
        if until_s - at_s > SHORTEST_S:
            thrust = lagged(thrust, h[begin_at + 1], h[LAG], until_s - at_s)[0]
            at_s = until_s
        if following_s > stamp_s + SHORTEST_S:
            break
        begin_at = following
    h[THRUST] = thrust
    h[BEGIN] = float(begin_at)


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
    at_s, edge_s = stamp_s, stamp_s + length_s
    thrust = x = y = z = 0.0
    done = 0
    while True:
        t, p, q, r = h[i + 1], h[i + 2], h[i + 3], h[i + 4]
        i += COMMAND
        until_s = h[i] if i < end else math.inf
        while until_s > edge_s - SHORTEST_S:  # the piece ends within this command
            share_s = edge_s - at_s
            out[at] = k * (thrust + share_s * t)
            out[at + 1] = k * (x + share_s * p)
            out[at + 2] = k * (y + share_s * q)
            out[at + 3] = k * (z + share_s * r)
            out[at + 4] = length_s
            at += PIECE
            done += 1
            if done == count:
                return count
            thrust = x = y = z = 0.0
            at_s, edge_s = edge_s, edge_s + length_s
        if i >= end:  # not with finite times: what comes last acts for ever
            return done
        share_s = until_s - at_s
        if share_s > 0.0:
            thrust += share_s * t
            x, y, z = x + share_s * p, y + share_s * q, z + share_s * r
            at_s = until_s


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
