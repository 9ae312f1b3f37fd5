"""Whether ATTITUDE_QUATERNION is worth its datagrams.

Asked for at the rate of the autopilot's estimator, an attitude can be newer than the state that is answered, and the
prediction's rotation then starts from it. On PX4 one comes right behind nearly every state and is (docs/px4.md). Where
states are as new as attitudes none ever is: every attitude is then something more to wake up for, just before a state.
So the stream is asked for, and given up where nothing comes of it.
"""

from __future__ import annotations

from typing import Final

STATES_JUDGED: Final = 300
SHARE_MIN: Final = 0.1
"""Of the states must have had a newer attitude with them; fewer are accidents of a busy machine."""
TOGETHER_NS: Final = 1_000_000
"""What comes behind a state within this time is read before that is answered, mostly."""


class Attitudes:
    """Judges one stream, once."""

    def __init__(self) -> None:
        self._newest_us: int | None = None
        self._state_us = self._state_wall_ns = 0
        self._states = self._newer = 0
        self._found = False
        """Whether the last state had a newer one with it."""

    def on_attitude(self, t_us: int, wall_ns: int) -> None:
        """One has come.

        Args:
            t_us: its vehicle time [us].
            wall_ns: its arrival, by our clock.
        """
        self._newest_us = t_us
        if wall_ns - self._state_wall_ns <= TOGETHER_NS and t_us > self._state_us:
            self._found = True

    def waste(self, t_us: int, wall_ns: int) -> bool:
        """A state has come; whether it is known from now on that the stream brings nothing. Said once.

        Args:
            t_us: its vehicle time [us].
            wall_ns: its arrival, by our clock.
        """
        if self._newest_us is None or self._states > STATES_JUDGED:
            return False
        self._states += 1
        self._newer += self._found
        self._state_us, self._state_wall_ns, self._found = t_us, wall_ns, self._newest_us > t_us
        return self._states > STATES_JUDGED and self._newer < SHARE_MIN * STATES_JUDGED
