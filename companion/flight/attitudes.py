"""Whether ATTITUDE_QUATERNION is worth its datagrams.

Asked for at the rate of the autopilot's estimator it can be newer than the state that is answered, and the prediction's
rotation then starts from it. Where states come as often as attitudes it never is: every state costs one datagram more
to wake up for, and nothing comes of it. So it is asked for, and judged by what comes.
"""

from __future__ import annotations

from typing import Final

STATES_JUDGED: Final = 300
SHARE_MIN: Final = 0.05
"""Of the states must have found a newer attitude there already."""


class Attitudes:
    """Judges one stream, once."""

    def __init__(self) -> None:
        self._newest_us: int | None = None
        self._states = self._newer = 0

    def on_attitude(self, t_us: int) -> None:
        """One has come; t_us: its vehicle time."""
        self._newest_us = t_us

    def waste(self, t_us: int) -> bool:
        """A state has come, stamped t_us; whether it is known from now on that the stream brings nothing. Said once."""
        if self._newest_us is None or self._states == STATES_JUDGED:
            return False
        self._states += 1
        self._newer += self._newest_us > t_us
        return self._states == STATES_JUDGED and self._newer < SHARE_MIN * STATES_JUDGED
