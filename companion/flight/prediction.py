"""The commands between a state's stamp and the time at which the next command takes effect (docs/law.md section 8,
"Delay").

A command computed from a state stamped s acts from s + delay until the next one does. So between a stamp and its time
of effect the commands of the last delay/interval samples act one after the other. `Prediction` remembers them with
their times and gives them as a few pieces (`control.model.advance` runs through them). The thrust that acts at the
stamp is not measured: it is followed with the same model.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from companion.control.model import lag_factors, lagged
from companion.control.types import Quat, State, Vec3
from companion.control.vectors import quat_exp, quat_multiply, quat_normalise

PIECE_MAX_S = 0.010
"""Commands are averaged over pieces of at most this length: the rates lag by more, and every piece costs time."""
APART_COSINE = math.cos(0.05)
"""Of half the angle: attitudes further apart than 0.1 rad are of different estimates, with a reset between them."""
SHORTEST_S = 1e-6
"""Shorter pieces are rounding errors of the stamps."""

Piece = tuple[float, Vec3, float]
"""Mean thrust setpoint [N], mean rate setpoints [rad/s], duration [s]."""


class Attitude(NamedTuple):
    """Attitude and rates at an instant, without the rest of a state."""

    at_s: float
    """Vehicle time [s]."""
    q: Quat
    """Body to inertial."""
    w: Vec3
    """Body rates [rad/s]."""


class Acting(NamedTuple):
    """A command and the vehicle time from which it acts."""

    from_s: float
    thrust: float
    rates: Vec3


class Prediction:
    """Remembers what was sent; one per flight.

    Args:
        thrust_lag_s: time constant of the thrust behind its setpoint [s].
        delay_s: from the stamp of a state to the effect of its command [s].
        thrust_n: the thrust that acts at the start [N].
    """

    def __init__(self, thrust_lag_s: float, delay_s: float, thrust_n: float) -> None:
        self.thrust = thrust_n
        """The thrust that acts at the last stamp [N], by the model."""
        self._thrust_lag_s = thrust_lag_s
        self._at_s: float | None = None
        # until the first command acts, what holds the hover does
        self._acting: deque[Acting] = deque([Acting(-math.inf, thrust_n, (0.0, 0.0, 0.0))])
        self.length_s = 0.0
        """Length of the pieces [s]; 0 without a delay."""
        self.retime(delay_s)

    def retime(self, delay_s: float) -> None:
        """Another delay from now on; it must not change by as much as a sample interval at once."""
        self._delay_s = delay_s
        self._count = math.ceil(delay_s / PIECE_MAX_S - 1e-9)
        self.length_s = delay_s / self._count if self._count else 0.0

    def rescale(self, ratio: float) -> None:
        """The same commands are believed to give `ratio` times as much thrust as until now."""
        self.thrust *= ratio
        self._acting = deque(acting._replace(thrust=ratio * acting.thrust) for acting in self._acting)

    def sent(self, stamp_s: float, thrust_n: float, rates: Sequence[float]) -> None:
        """Remembers a command (thrust [N], body rates [rad/s]) computed from the state stamped `stamp_s`."""
        self._acting.append(Acting(stamp_s + self._delay_s, thrust_n, (rates[0], rates[1], rates[2])))

    def pieces(self, stamp_s: float) -> list[Piece]:
        """What acts from a stamp until its own command will; empty without a delay or before the first command."""
        self._follow_thrust(stamp_s)
        acting, length = self._acting, self.length_s
        if not acting or not self._count:
            return []
        out: list[Piece] = []
        at, edge = stamp_s, stamp_s + length
        thrust = x = y = z = 0.0
        last = len(acting) - 1
        for index, (_, t, (p, q, r)) in enumerate(acting):
            until = acting[index + 1].from_s if index < last else math.inf
            while until > edge - SHORTEST_S:  # the piece ends within this command
                share = edge - at
                k = 1.0 / length
                mean = (k * (x + share * p), k * (y + share * q), k * (z + share * r))
                out.append((k * (thrust + share * t), mean, length))
                if len(out) == self._count:
                    return out
                thrust = x = y = z = 0.0
                at, edge = edge, edge + length
            share = until - at
            if share > 0.0:
                thrust += share * t
                x, y, z = x + share * p, y + share * q, z + share * r
                at = until
        return out

    def between(self, begin_s: float, end_s: float) -> list[Piece]:
        """What acts from the stamp that `pieces` was asked for last to a later time [s]."""
        acting, out = self._acting, []
        for index, (from_s, thrust, rates) in enumerate(acting):
            until = acting[index + 1].from_s if index + 1 < len(acting) else math.inf
            duration_s = min(until, end_s) - max(from_s, begin_s)
            if duration_s > SHORTEST_S:
                out.append((thrust, rates, duration_s))
        return out

    def _follow_thrust(self, stamp_s: float) -> None:
        """Brings the modelled thrust to the stamp and forgets commands that have ceased to act."""
        acting = self._acting
        last, self._at_s = self._at_s, stamp_s
        if last is None or not acting:
            return
        at = max(last, acting[0].from_s)
        while True:
            until = min(stamp_s, acting[1].from_s) if len(acting) > 1 else stamp_s
            if until - at > SHORTEST_S:
                self.thrust = lagged(self.thrust, acting[0].thrust, self._thrust_lag_s, until - at)[0]
                at = until
            if len(acting) < 2 or acting[1].from_s > stamp_s + SHORTEST_S:
                return
            acting.popleft()


def refreshed(state: State, stamp_s: float, attitude: Attitude, pieces: Sequence[Piece], lags_s: Vec3) -> State:
    """The state at its stamp from which the model comes by a newer attitude; the state itself where that is none.

    Position and velocity stay: attitude and rates are followed back from the newer ones to the stamp.

    Args:
        state: as received.
        stamp_s: its stamp [s].
        attitude: after the stamp.
        pieces: what acts from the stamp on.
        lags_s: of roll, pitch and yaw rate behind their setpoints [s].
    """
    left_s, spans = attitude.at_s - stamp_s, []
    for _, rates, length_s in pieces:
        span_s = min(left_s, length_s)
        if span_s > SHORTEST_S:
            spans.append((rates, span_s))
            left_s -= span_s
    if left_s > SHORTEST_S:  # beyond what is predicted
        return state
    q, w = attitude.q, attitude.w
    for rates, span_s in reversed(spans):
        before, turned = zip(*map(_back, w, rates, lags_s, (span_s,) * 3), strict=True)
        w = (before[0], before[1], before[2])
        a, b, c, d = quat_exp((turned[0], turned[1], turned[2]))
        q = quat_multiply(q, (a, -b, -c, -d))
    apart = abs(sum(a * b for a, b in zip(q, state.q, strict=True)))
    if apart < APART_COSINE:
        return state
    return State(state.p, state.v, quat_normalise(q), w)


def _back(w: float, rate: float, lag_s: float, span_s: float) -> tuple[float, float]:
    """A rate before a span at the end of which it is `w`, and the angle turned meanwhile."""
    decay, share = lag_factors(lag_s, span_s)
    if decay <= 0.0:
        return w, rate * span_s
    gap = (w - rate) / decay
    return rate + gap, span_s * (rate + gap * share)
