"""What the control process and the ground process say to each other, over a pair of Unix datagram sockets.

Three kinds of datagrams: notes (JSON: requests, answers, how things stand), copies of frames from the vehicle link, and
messages that the ground process wants to send on it. Neither side ever waits: what finds no room is dropped and
counted, and what cannot be read is left out. The supervisor keeps both ends open, so that either process can be killed
and started again on the same pair.
"""

from __future__ import annotations

import json
import socket
from typing import Any, Final, NamedTuple

_NOTE: Final = b"N"
_COPY: Final = b"C"
_SEND: Final = b"S"
_DATAGRAM_MAX: Final = 65536
_ID_BYTES: Final = 3

Note = dict[str, Any]


class Copy(NamedTuple):
    """A frame that came on the vehicle link."""

    raw: bytes


class Outgoing(NamedTuple):
    """A message for the vehicle link, to be sent as the companion."""

    msgid: int
    payload: bytes


class Channel:
    """One end."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self.dropped = 0
        """Datagrams that the other side had no room for."""
        self.unreadable = 0
        """Datagrams of the other side that made no sense."""
        self.closed = False
        """Whether nobody holds the other end any more: neither the other process nor the supervisor."""

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def note(self, **content: Any) -> bool:
        """Sends a note; False when it did not go out."""
        return self._put(_NOTE + json.dumps(content).encode())

    def copy(self, raw: bytes) -> bool:
        """Sends the copy of a frame."""
        return self._put(_COPY + raw)

    def outgoing(self, msgid: int, payload: bytes) -> bool:
        """Asks for a message to be sent to the vehicle."""
        return self._put(_SEND + msgid.to_bytes(_ID_BYTES, "little") + payload)

    def _put(self, datagram: bytes) -> bool:
        try:
            self._socket.send(datagram)
        except OSError:
            self.dropped += 1
            return False
        return True

    def receive(self, most: int) -> list[Note | Copy | Outgoing]:
        """What has come, `most` datagrams at a time; never waits, never raises for what the other side sends."""
        found: list[Note | Copy | Outgoing] = []
        for _ in range(most):
            try:
                datagram = self._socket.recv(_DATAGRAM_MAX)
            except OSError:
                break
            if not datagram:
                self.closed = True
                break
            item = _read(datagram)
            if item is None:
                self.unreadable += 1
            else:
                found.append(item)
        return found

    def discard(self) -> None:
        """Throws away what was meant for a process that is gone: an order to it is not an order to its successor."""
        while True:
            try:
                if not self._socket.recv(_DATAGRAM_MAX):
                    return
            except OSError:
                return


def _read(datagram: bytes) -> Note | Copy | Outgoing | None:
    kind, content = datagram[:1], datagram[1:]
    if kind == _COPY:
        return Copy(content)
    if kind == _SEND and len(content) >= _ID_BYTES:
        return Outgoing(int.from_bytes(content[:_ID_BYTES], "little"), content[_ID_BYTES:])
    if kind != _NOTE:
        return None
    try:
        note = json.loads(content)
    except (ValueError, RecursionError):
        return None
    return note if isinstance(note, dict) else None
