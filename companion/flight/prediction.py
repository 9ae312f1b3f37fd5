"""The state at the time a command takes effect, predicted with the commands already sent (paper.md section 8, "Delay").

A command computed from a state stamped s acts from s + delay until the next one does. So between a stamp and its time
of effect the commands of the last delay/interval samples act one after the other; `Prediction` remembers them with
their times and runs the law's own model (`control.model.advance`) through them. The thrust that acts at the stamp is
not measured: it is followed with the same model.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.control.law import Command, Parameters
from companion.control.model import advance, lagged
from companion.control.types import State, Vec3

SHORTEST_S = 1e-6
"""Pieces shorter than this are rounding errors of the stamps."""


class Acting(NamedTuple):
    """A command and the vehicle time from which it acts."""

    from_s: float
    thrust: float
    rates: Vec3


class Prediction:
    """Remembers what was sent and predicts states; one per flight.

    Args:
        parameters: the law's model (mass, gravity, drag).
        lags: time constants of roll, pitch, yaw rate and thrust behind their setpoints [s].
        delay_s: from the stamp of a state to the effect of its command [s].
        thrust_n: the thrust that acts at the start [N].
        advance_kernel: `control.model.advance` or its compiled twin.
    """

    def __init__(
        self,
        parameters: Parameters,
        lags: tuple[float, float, float, float],
        delay_s: float,
        thrust_n: float,
        advance_kernel: Callable[..., Any] = advance,
    ) -> None:
        self._vehicle = (parameters.model.mass, parameters.model.gravity, parameters.model.drag)
        self._lags = lags
        self._advance = advance_kernel
        self._delay_s = delay_s
        self._thrust = thrust_n
        self._thrust_at_s: float | None = None
        self._acting: deque[Acting] = deque()

    def sent(self, stamp_s: float, command: Command) -> None:
        """Remembers a command computed from the state stamped `stamp_s` (vehicle time)."""
        self._acting.append(Acting(stamp_s + self._delay_s, command.thrust, command.rates_model))

    def predict(self, stamp_s: float, state: State, b_hat: Vec3) -> State:
        """The state `delay_s` after its stamp; the state itself when there is no delay or nothing was sent yet."""
        self._follow_thrust(stamp_s)
        end_s = stamp_s + self._delay_s
        acting = self._acting
        if not acting or self._delay_s <= 0.0:
            return state
        thrust = self._thrust
        at = stamp_s
        for i, command in enumerate(acting):
            until = acting[i + 1].from_s if i + 1 < len(acting) else end_s
            duration = min(until, end_s) - at
            if duration <= SHORTEST_S:
                continue
            state, thrust = self._advance(
                state, thrust, command.rates, command.thrust, b_hat, self._vehicle, self._lags, duration
            )
            at += duration
        return state

    def _follow_thrust(self, stamp_s: float) -> None:
        """Brings the modelled thrust to the stamp and forgets commands that have ceased to act."""
        acting = self._acting
        last = self._thrust_at_s
        self._thrust_at_s = stamp_s
        if last is None or not acting:
            return
        at = max(last, acting[0].from_s)
        while True:
            until = min(stamp_s, acting[1].from_s) if len(acting) > 1 else stamp_s
            if until - at > SHORTEST_S:
                self._thrust = lagged(self._thrust, acting[0].thrust, self._lags[3], until - at)[0]
                at = until
            if len(acting) < 2 or acting[1].from_s > stamp_s + SHORTEST_S:
                return
            acting.popleft()
