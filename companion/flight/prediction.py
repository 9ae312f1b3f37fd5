"""What was sent and is still to act: the history of a flight's commands (`control.history`), with its numbers.

The numbers are a list for plain Python and an array for compiled code, which reads and continues them by itself
(`flight.fused`); here is what is asked of them on the way.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence

from companion import accelerate
from companion.control import history
from companion.control.model import PIECE
from companion.control.types import Vec3

PIECE_MAX_S = 0.010
"""Commands are averaged over pieces of at most this length: the rates lag by more, and every piece costs time."""
PIECES_MAX = 128
"""Of 10 ms each, with some room beyond the longest delay that a vehicle file may have and what is followed above it."""

Span = tuple[float, Vec3, float]
"""Thrust setpoint [N], rate setpoints [rad/s], duration [s]."""


class Prediction:
    """Remembers what was sent; one per flight.

    Args:
        thrust_lag_s: time constant of the thrust behind its setpoint [s].
        delay_s: from the stamp of a state to the effect of its command [s].
        thrust_n: the thrust that acts at the start [N].
        engine: "python" or "numba".
    """

    def __init__(self, thrust_lag_s: float, delay_s: float, thrust_n: float, engine: str = "python") -> None:
        self.numbers: MutableSequence[float] = accelerate.numbers(history.CAPACITY, engine)
        """The history, as `control.history` lays it out."""
        self._engine = engine
        self._thrust_lag_s = thrust_lag_s
        self._begin = accelerate.choose(history.begin, engine)
        self._remember = accelerate.choose(history.remember, engine)
        self._follow = accelerate.choose(history.follow, engine)
        self._gather = accelerate.choose(history.gather, engine)
        self._begin(self.numbers, thrust_n, thrust_lag_s)
        self.retime(max(delay_s, PIECE_MAX_S))
        self.pieces(0.0)
        self.sent(0.0, thrust_n, (0.0, 0.0, 0.0))  # whatever is compiled is compiled now
        self.begin(thrust_n)
        self.retime(delay_s)

    def begin(self, thrust_n: float) -> None:
        """Begins anew with a hover at this thrust [N]."""
        self._begin(self.numbers, thrust_n, self._thrust_lag_s)

    def retime(self, delay_s: float) -> None:
        """Another delay from now on; it must not change by as much as a sample interval at once."""
        self.delay_s = delay_s
        count = math.ceil(delay_s / PIECE_MAX_S - 1e-9)
        self.length_s = delay_s / count if count else 0.0
        """Length of the pieces [s]; 0 without a delay."""
        self.numbers[history.COUNT], self.numbers[history.LENGTH] = count, self.length_s
        self._pieces = accelerate.numbers(PIECE * count, self._engine)

    @property
    def thrust(self) -> float:
        """The thrust that acts at the last stamp [N], by the model."""
        return float(self.numbers[history.THRUST])

    def rescale(self, ratio: float) -> None:
        """The same commands are believed to give `ratio` times as much thrust as until now."""
        h = self.numbers
        h[history.THRUST] *= ratio
        for at in self._commands():
            h[at + 1] *= ratio
            h[at + 5] *= ratio

    def sent(self, stamp_s: float, thrust_n: float, rates: Sequence[float]) -> None:
        """Remembers a command (thrust [N], body rates [rad/s]) computed from the state stamped `stamp_s`."""
        self._remember(self.numbers, stamp_s + self.delay_s, thrust_n, rates[0], rates[1], rates[2])

    def follow(self, stamp_s: float) -> None:
        """Brings `thrust` to a stamp [s]; commands that have ceased to act by then are forgotten."""
        self._follow(self.numbers, stamp_s)

    def pieces(self, stamp_s: float) -> Sequence[float]:
        """What acts from a stamp until its own command will, `PIECE` numbers each; empty without a delay.

        They hold until the next call.
        """
        h, pieces = self.numbers, self._pieces
        self._follow(h, stamp_s)
        self._gather(h, stamp_s, pieces, 0)
        return pieces

    def between(self, begin_s: float, end_s: float) -> list[Span]:
        """What acts from the stamp that was asked for last to a later time [s]."""
        h, out, commands = self.numbers, [], self._commands()
        for at in commands:
            until_s = h[at + history.COMMAND] if at != commands[-1] else math.inf
            duration_s = float(min(until_s, end_s) - max(h[at], begin_s))
            if duration_s > history.SHORTEST_S:
                thrust, x, y, z = map(float, h[at + 1 : at + 5])
                out.append((thrust, (x, y, z), duration_s))
        return out

    def _commands(self) -> range:
        """Where the commands stand, the oldest first."""
        return range(int(self.numbers[history.BEGIN]), int(self.numbers[history.END]), history.COMMAND)
