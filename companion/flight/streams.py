"""Which messages the autopilot sends a flight beside ODOMETRY: what is of no use is left out where nobody else listens.

At PX4's usual rates six datagrams in seven are of no use to a flight, and each wakes both sides. ATTITUDE_QUATERNION is
asked for at the rate of the autopilot's estimator: it can be newer than the state that is answered, and the
prediction's rotation then starts from it. On PX4 one comes right behind nearly every state and is (docs/px4.md). Where
states are as new as attitudes none ever is: every attitude is then something more to wake up for, just before a state.
So that stream is given up where nothing comes of it.
"""

from __future__ import annotations

import contextlib
from typing import Final

from companion.flight.preflight import ATTITUDE_TARGET
from companion.link import codec
from companion.link.operations import DEFAULT_INTERVAL, STOP_MESSAGE, Command, Operations
from companion.link.wire import Wire

NOT_NEEDED: Final = (24, 30, 32, 33, 36, 62, 65, 74, 85, 87, 105, 141)
"""GPS_RAW_INT, ATTITUDE, LOCAL_POSITION_NED, GLOBAL_POSITION_INT, SERVO_OUTPUT_RAW, NAV_CONTROLLER_OUTPUT, RC_CHANNELS,
VFR_HUD, POSITION_TARGET_LOCAL_NED, POSITION_TARGET_GLOBAL_INT, HIGHRES_IMU, ALTITUDE."""
ATTITUDE_INTERVAL_US: Final = 3_200
"""PX4 has an attitude at each of its 4 ms."""
STATES_JUDGED: Final = 300
SHARE_MIN: Final = 0.1
"""Of the states must have had a newer attitude with them; fewer are accidents of a busy machine."""
TOGETHER_NS: Final = 1_000_000
"""What comes behind a state within this time is read before that is answered, mostly."""


class Streams:
    """The streams of one flight.

    Args:
        exclusive: nobody else listens on this link.
        paced: the vehicle is in lockstep: each state is answered before anything newer comes.
        predicts: attitudes that are newer than a state are of use.
    """

    def __init__(self, *, exclusive: bool, paced: bool, predicts: bool) -> None:
        self._exclusive, self._paced = exclusive or paced, paced
        self.intervals_us: dict[int, int] = dict.fromkeys(NOT_NEEDED, STOP_MESSAGE) if self._exclusive else {}
        """What is asked for at the beginning, by message (`Operations.set_message_interval`)."""
        if paced:
            self.intervals_us[codec.ATTITUDE_QUATERNION] = STOP_MESSAGE
        elif predicts:
            self.intervals_us[codec.ATTITUDE_QUATERNION] = ATTITUDE_INTERVAL_US
        if self._exclusive:  # a flight before this one may have left it switched off
            self.intervals_us[ATTITUDE_TARGET] = DEFAULT_INTERVAL
        self._attitudes = Attitudes() if predicts and not paced else None

    def on_attitude(self, t_us: int, wall_ns: int) -> None:
        """ATTITUDE_QUATERNION has come: its vehicle time [us], and its arrival by our clock [ns]."""
        if self._attitudes is not None:
            self._attitudes.on_attitude(t_us, wall_ns)

    def on_state(self, t_us: int, wall_ns: int, ops: Operations, now_s: float) -> None:
        """A state has come; an attitude stream that brings nothing is given up.

        Args:
            t_us: its vehicle time [us].
            wall_ns: its arrival, by our clock.
            ops: requests to the autopilot.
            now_s: vehicle time [s].
        """
        if self._attitudes is not None and self._attitudes.waste(t_us, wall_ns):
            self._attitudes = None
            interval_us = STOP_MESSAGE if self._exclusive else DEFAULT_INTERVAL
            ops.set_message_interval(codec.ATTITUDE_QUATERNION, interval_us, now_s)

    def on_engaged(self, ops: Operations, now_s: float) -> None:
        """The controller has taken over: what the autopilot's own hover was told by is of no use any more."""
        if self._exclusive:
            ops.set_message_interval(ATTITUDE_TARGET, STOP_MESSAGE, now_s)

    def leave(self, wire: Wire, system: int, component: int) -> None:
        """Asks for what was left out at its usual rate again, if the requests arrive: nobody waits. Never raises."""
        if not self._exclusive or self._paced:
            return
        with contextlib.suppress(Exception):
            for msgid in (ATTITUDE_TARGET, codec.ATTITUDE_QUATERNION, *NOT_NEEDED):
                params = (float(msgid), float(DEFAULT_INTERVAL), *(0.0,) * 5)
                payload = codec.encode_command_long(system, component, Command.SET_MESSAGE_INTERVAL, 0, params)
                wire.send(codec.COMMAND_LONG, payload)


class Attitudes:
    """Judges whether ATTITUDE_QUATERNION is worth its datagrams, once."""

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
