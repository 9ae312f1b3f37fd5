"""Downloads a mission or a geofence from the autopilot: MAVLink's mission protocol, the side that asks.

No sockets and no clock in here: the caller passes frames and the time in, so that tests can lose any of them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any, Final, NamedTuple

from companion.link import codec
from companion.link.framing import Frame

REQUEST_LIST, COUNT, ACK, REQUEST_INT, ITEM_INT = 43, 44, 47, 51, 73
"""MISSION_REQUEST_LIST, MISSION_COUNT, MISSION_ACK, MISSION_REQUEST_INT, MISSION_ITEM_INT."""

AUTOPILOT_COMPONENT: Final = codec.AUTOPILOT_COMPONENT
RETRY_S: Final = 0.5
TRIES: Final = 10
ITEMS_MAX: Final = 5000

_LIST = struct.Struct("<BBB")
_REQUEST = struct.Struct("<HBBB")
_ACK = struct.Struct("<BBBB")

Send = Callable[[int, bytes], object]
"""Takes a message id and a payload."""


class MissionType(IntEnum):
    """MAV_MISSION_TYPE."""

    MISSION = 0
    FENCE = 1


class StoredItem(NamedTuple):
    """An item as the autopilot has it."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    """NaN: not set."""
    latitude_deg: float
    longitude_deg: float
    altitude_m: float


class Download:
    """One list of items that is being downloaded.

    Args:
        send: sends a message to the autopilot.
        system: its system id.
        kind: which of its lists.
        now_s: the time [s], of the clock that `update` gets too.
    """

    def __init__(self, send: Send, system: int, kind: MissionType, now_s: float) -> None:
        self._send = send
        self._system = system
        self._kind = kind
        self._count: int | None = None
        self._items: list[StoredItem] = []
        self._tries = 0
        self._asked_s = now_s
        self.failure = ""
        """Why it failed; empty while it did not."""
        self._ask(now_s)

    @property
    def done(self) -> bool:
        """Whether all items are here."""
        return self._count is not None and len(self._items) == self._count

    @property
    def items(self) -> tuple[StoredItem, ...]:
        """What is here so far, in order."""
        return tuple(self._items)

    def on_frame(self, frame: Frame, now_s: float) -> None:
        """Takes a frame of the link; others than the awaited one change nothing."""
        if frame.sysid != self._system or frame.compid != AUTOPILOT_COMPONENT or self.done or self.failure:
            return
        if frame.msgid not in (COUNT, ITEM_INT, ACK):
            return
        message: Any = codec.decode_cold(frame)
        if message is None or message.mission_type != self._kind:
            return
        if frame.msgid == ACK:
            name = self._kind.name.lower()
            self.failure = f"the autopilot refuses to give its {name} (MAV_MISSION_RESULT {message.type})"
        elif frame.msgid == COUNT and self._count is None:
            self._counted(message.count, now_s)
        elif frame.msgid == ITEM_INT and self._count is not None and message.seq == len(self._items):
            self._items.append(_stored(message))
            self._next(now_s)

    def update(self, now_s: float) -> None:
        """Asks again where no answer came."""
        if self.done or self.failure or now_s - self._asked_s < RETRY_S:
            return
        if self._tries >= TRIES:
            what = "list" if self._count is None else f"item {len(self._items)} of {self._count}"
            self.failure = f"the autopilot does not send its {self._kind.name.lower()} ({what})"
            return
        self._ask(now_s)

    def _counted(self, count: int, now_s: float) -> None:
        if count > ITEMS_MAX:
            self.failure = f"the autopilot has {count} items, at most {ITEMS_MAX} are downloaded"
            return
        self._count = count
        self._next(now_s)

    def _next(self, now_s: float) -> None:
        self._tries = 0
        if self.done:
            self._send(ACK, _ACK.pack(self._system, AUTOPILOT_COMPONENT, 0, self._kind))
        else:
            self._ask(now_s)

    def _ask(self, now_s: float) -> None:
        self._tries += 1
        self._asked_s = now_s
        if self._count is None:
            self._send(REQUEST_LIST, _LIST.pack(self._system, AUTOPILOT_COMPONENT, self._kind))
        else:
            request = _REQUEST.pack(len(self._items), self._system, AUTOPILOT_COMPONENT, self._kind)
            self._send(REQUEST_INT, request)


def _stored(message: Any) -> StoredItem:
    """MISSION_ITEM_INT: latitude and longitude in 1e-7 degrees, but for commands without a position."""
    params = (message.param1, message.param2, message.param3, message.param4)
    return StoredItem(message.command, message.frame, params, message.x * 1e-7, message.y * 1e-7, message.z)
