"""What may go from the ground process to the vehicle: a list of messages that cannot steer it, and not too many.

The control process asks here before it sends anything for the ground process, which handles bytes from strangers. A
setpoint is not on the list, nor a mode, arming, a parameter, a mission or a restart: what an operator's order needs of
these, the control process sends itself.
"""

from __future__ import annotations

from typing import Final

from companion.link import codec
from companion.link.operations import Command

NAMED_VALUE_FLOAT: Final = 251
DEBUG_VECT: Final = 250
FILE_TRANSFER_PROTOCOL: Final = 110

PASSING: Final = frozenset(
    {
        codec.COMMAND_ACK,
        codec.STATUSTEXT,
        NAMED_VALUE_FLOAT,
        DEBUG_VECT,
        codec.AUTOPILOT_VERSION,
        codec.PARAM_VALUE,
        codec.PARAM_ERROR,
        322,  # PARAM_EXT_VALUE
        324,  # PARAM_EXT_ACK
        codec.PARAM_REQUEST_READ,
        43,  # MISSION_REQUEST_LIST: reading the mission that is there
        51,  # MISSION_REQUEST_INT
        47,  # MISSION_ACK
    }
)
"""Messages that pass as they are: answers, reports, and questions."""

COMMANDS: Final = frozenset({Command.REQUEST_MESSAGE})
"""The only commands that pass: asking for a message once."""

RATE_1_S: Final = 100.0
BURST: Final = 50.0
BYTES_1_S: Final = 20_000.0
BYTES_BURST: Final = 10_000.0
_FRAME_BYTES: Final = 12
_AUTOPILOT_COMPONENTS: Final = (0, 1)


class Bucket:
    """Lets so much pass per second, and so much at once.

    Args:
        rate_1_s: what comes in per second.
        burst: what it holds, full at first.
    """

    def __init__(self, rate_1_s: float, burst: float) -> None:
        self._rate_1_s, self._burst = rate_1_s, burst
        self._level = burst
        self._at_s: float | None = None

    def fill(self, now_s: float) -> float:
        """Lets time pass; returns what may pass now."""
        if self._at_s is not None:
            self._level = min(self._burst, self._level + max(0.0, now_s - self._at_s) * self._rate_1_s)
        self._at_s = now_s
        return self._level

    def take(self, amount: float) -> None:
        """Takes what has passed."""
        self._level -= amount


def harmless(msgid: int, payload: bytes, system: int | None) -> bool:
    """Whether a message cannot steer the vehicle.

    Args:
        msgid: the message.
        payload: its payload; trailing zeros may be missing.
        system: the vehicle's system id, if known.
    """
    if msgid in PASSING:
        return msgid in codec.message_formats()
    if msgid == FILE_TRANSFER_PROTOCOL:  # an answer to a ground tool; the autopilot's own files are none of ours
        target = payload[1:3].ljust(2, b"\0")
        return target[0] not in {0, system} or target[1] not in _AUTOPILOT_COMPONENTS
    if msgid == codec.COMMAND_LONG:
        return int.from_bytes(payload[28:30].ljust(2, b"\0"), "little") in COMMANDS
    return False


class Gate:
    """Decides message by message, and counts what it keeps back."""

    def __init__(self) -> None:
        self.refused = 0
        """Messages that may not be sent."""
        self.too_many = 0
        """Messages beyond the rate."""
        self._messages = Bucket(RATE_1_S, BURST)
        self._bytes = Bucket(BYTES_1_S, BYTES_BURST)

    def passes(self, msgid: int, payload: bytes, system: int | None, now_s: float) -> bool:
        """Whether this message may be sent now; arguments as of `harmless`, and the monotonic time [s]."""
        if not harmless(msgid, payload, system):
            self.refused += 1
            return False
        size = float(len(payload) + _FRAME_BYTES)
        if self._messages.fill(now_s) < 1.0 or self._bytes.fill(now_s) < size:
            self.too_many += 1
            return False
        self._messages.take(1.0)
        self._bytes.take(size)
        return True
