"""Whether the vehicle turns as it is told: measured body rates against the commanded ones behind delay and lag.

A vehicle whose commands arrive late, go to somebody else's wishes or act the wrong way round shows it here first, a few
tenths of a second before its errors do. Roll and pitch are compared; yaw has little authority and is often short of it.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence

from companion import accelerate
from companion.control.types import Vec3

_COMMANDS_MAX = 500
_EPSILON_S = 1e-6

# where things stand among the numbers
LAG_ROLL, LAG_PITCH = 0, 1
"""From the rate setpoint to the rate [s]."""
LAST = 2
"""Stamp of the last state [s]."""
ACTS = 3
"""1: a command acts, and the two below are known."""
TO_ROLL, TO_PITCH = 4, 5
"""What the vehicle turns towards [rad/s]."""
ROLL, PITCH = 6, 7
"""What it should turn with [rad/s]."""
BEGIN, END = 8, 9
"""Where the commands stand that do not act yet."""
COMMANDS = 10
"""Where they begin: stamp of their state [s], roll and pitch rate [rad/s]."""
COMMAND = 3
SIZE = COMMANDS + 2 * _COMMANDS_MAX * COMMAND
_ACTED_MAX = 32 * COMMAND
"""So much room at the front is used again: what is in use stays small."""


class Following:
    """Follows one vehicle's rates.

    Args:
        lag_s: from the rate setpoint to the rate, first order, per axis (the vehicle file's) [s].
        engine: "python" or "numba".
    """

    def __init__(self, lag_s: Vec3, engine: str = "python") -> None:
        roll_s, pitch_s, _ = lag_s
        self.numbers = n = accelerate.numbers(SIZE, engine)
        """What the kernels below work on."""
        n[LAG_ROLL], n[LAG_PITCH] = max(roll_s, _EPSILON_S), max(pitch_s, _EPSILON_S)
        self._follow = accelerate.choose(follow, engine)
        self.begin()
        self.error(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)  # whatever is compiled is compiled now
        self.begin()

    def begin(self) -> None:
        """The commands begin anew: what the vehicle turns with is where it starts from."""
        n = self.numbers
        n[BEGIN], n[END], n[ACTS], n[LAST] = float(COMMANDS), float(COMMANDS), 0.0, -math.inf

    def error(self, t_s: float, rates: Vec3, commanded: Vec3, delay_s: float) -> float:
        """How far the rates are off what was commanded, roll and pitch together [rad/s]; 0 until a command can act.

        Args:
            t_s: stamp of the state [s].
            rates: measured, FRD [rad/s].
            commanded: in answer to this state, FRD [rad/s].
            delay_s: from a state's stamp to the effect of its command [s].
        """
        off: float = self._follow(self.numbers, t_s, rates[0], rates[1], commanded[0], commanded[1], delay_s)
        return off


def model(n: Sequence[float], t_s: float) -> tuple[float, float]:
    """The roll and pitch rate that the commands explain at a stamp [s], once one acts [rad/s]."""
    past_s = n[LAST] - t_s
    roll = n[TO_ROLL] + (n[ROLL] - n[TO_ROLL]) * math.exp(past_s / n[LAG_ROLL])
    pitch = n[TO_PITCH] + (n[PITCH] - n[TO_PITCH]) * math.exp(past_s / n[LAG_PITCH])
    return roll, pitch


def off_by(n: Sequence[float], t_s: float, roll: float, pitch: float) -> float:
    """How far measured rates are off at a stamp [rad/s]; 0 until a command acts. A kernel; changes nothing."""
    if n[ACTS] < 0.5:
        return 0.0
    x, y = model(n, t_s)
    return math.sqrt((roll - x) * (roll - x) + (pitch - y) * (pitch - y))


def follow(
    n: MutableSequence[float],
    t_s: float,
    roll: float,
    pitch: float,
    to_roll: float,
    to_pitch: float,
    delay_s: float,
) -> float:
    """Goes on to a state; returns `off_by` of it. A kernel.

    Args:
        n: SIZE numbers.
        t_s: stamp of the state [s].
        roll: measured [rad/s].
        pitch: measured [rad/s].
        to_roll: commanded in answer [rad/s].
        to_pitch: commanded in answer [rad/s].
        delay_s: from a state's stamp to the effect of its command [s].
    """
    off = off_by(n, t_s, roll, pitch)
    n[ROLL], n[PITCH] = (roll, pitch) if n[ACTS] < 0.5 else model(n, t_s)
    n[LAST] = t_s
    begin, end = int(n[BEGIN]), int(n[END])
    if end + COMMAND > SIZE or begin >= COMMANDS + _ACTED_MAX:  # what is under way moves to the front again
        for i in range(end - begin):
            n[COMMANDS + i] = n[begin + i]
        begin, end = COMMANDS, COMMANDS + end - begin
    if end - begin == _COMMANDS_MAX * COMMAND:
        begin += COMMAND
    n[end], n[end + 1], n[end + 2] = t_s, to_roll, to_pitch
    end += COMMAND
    acts_s = t_s + _EPSILON_S - delay_s
    while begin < end and n[begin] <= acts_s:
        n[ACTS], n[TO_ROLL], n[TO_PITCH] = 1.0, n[begin + 1], n[begin + 2]
        begin += COMMAND
    n[BEGIN], n[END] = float(begin), float(end)
    return off
