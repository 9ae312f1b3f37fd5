"""Whether the vehicle turns as it is told: measured body rates against the commanded ones behind delay and lag.

A vehicle whose commands arrive late, go to somebody else's wishes or act the wrong way round shows it here first, a few
tenths of a second before its errors do. Roll and pitch are compared; yaw has little authority and is often short of it.
"""

from __future__ import annotations

import math
from collections import deque

from companion.control.types import Vec3

_COMMANDS_MAX = 500
_EPSILON_S = 1e-6


class Following:
    """Follows one vehicle's rates.

    Args:
        lag_s: from the rate setpoint to the rate, first order, per axis (the vehicle file's) [s].
    """

    def __init__(self, lag_s: Vec3) -> None:
        roll_s, pitch_s, _ = lag_s
        self._lag_s = max(roll_s, _EPSILON_S), max(pitch_s, _EPSILON_S)
        self._sent: deque[tuple[float, float, float]] = deque(maxlen=_COMMANDS_MAX)
        """Commands that do not act yet: stamp of their state [s], roll and pitch rate [rad/s]."""
        self._acting: tuple[float, float] | None = None
        self._model: tuple[float, float] = 0.0, 0.0
        self._last_s = -math.inf

    def begin(self) -> None:
        """The commands begin anew: what the vehicle turns with is where it starts from."""
        self._sent.clear()
        self._acting = None
        self._last_s = -math.inf

    def error(self, t_s: float, rates: Vec3, commanded: Vec3, delay_s: float) -> float:
        """How far the rates are off what was commanded, roll and pitch together [rad/s]; 0 until a command can act.

        Args:
            t_s: stamp of the state [s].
            rates: measured, FRD [rad/s].
            commanded: in answer to this state, FRD [rad/s].
            delay_s: from a state's stamp to the effect of its command [s].
        """
        last_s, self._last_s = self._last_s, t_s
        off = 0.0
        if self._acting is None:
            self._model = rates[0], rates[1]
        else:
            past_s = last_s - t_s
            (roll, pitch), (to_roll, to_pitch), (roll_s, pitch_s) = self._model, self._acting, self._lag_s
            roll = to_roll + (roll - to_roll) * math.exp(past_s / roll_s)
            pitch = to_pitch + (pitch - to_pitch) * math.exp(past_s / pitch_s)
            self._model = roll, pitch
            off = math.hypot(rates[0] - roll, rates[1] - pitch)
        sent, acts_s = self._sent, t_s + _EPSILON_S - delay_s
        sent.append((t_s, commanded[0], commanded[1]))
        while sent and sent[0][0] <= acts_s:
            _, roll, pitch = sent.popleft()
            self._acting = roll, pitch
        return off
