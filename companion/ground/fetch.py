"""Reading a small file from the companion over MAVLink FTP: what `start NAME` needs to find the number of a name."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from companion.errors import InputError, LinkError
from companion.ground.ftp import DATA_MAX, FILE_TRANSFER_PROTOCOL, SEQ_MODULUS, Opcode, Packet, decode, encode
from companion.link.framing import Frame

TRIES: Final = 6
TRY_S: Final = 0.5
SIZE_MAX: Final = 4 << 20
_EOF: Final = 6

Exchange = Callable[[int, bytes, Callable[[Frame], bytes | None], float], bytes | None]
"""Sends a message and hands the frames that come to a function until that returns something, or for a time [s]."""


class Reader:
    """Reads files of one server.

    Args:
        exchange: sends and receives.
        system: the server's system id.
        component: its component id.
        own: system and component id of ours.
    """

    def __init__(self, exchange: Exchange, system: int, component: int, own: tuple[int, int]) -> None:
        self._exchange = exchange
        self._server = (system, component)
        self._own = own
        self._seq = time.monotonic_ns() % SEQ_MODULUS

    def read(self, name: str) -> bytes:
        """The whole file.

        Raises:
            InputError: the server does not give it.
            LinkError: no answer came.
        """
        opened = self._ask(Opcode.OPEN_FILE_RO, data=name.encode())
        if opened.opcode != Opcode.ACK:
            raise InputError(f"{name}: the companion does not give this file")
        content = b""
        try:
            while len(content) < SIZE_MAX:
                part = self._ask(Opcode.READ_FILE, opened.session, len(content), DATA_MAX)
                if part.opcode != Opcode.ACK:
                    if part.data[:1] == bytes([_EOF]):
                        return content
                    raise InputError(f"{name}: the companion stopped giving this file")
                content += part.data
            raise InputError(f"{name}: is too long")
        finally:
            self._ask(Opcode.TERMINATE_SESSION, opened.session)

    def _ask(
        self, opcode: int, session: int = 0, offset: int = 0, size: int | None = None, data: bytes = b""
    ) -> Packet:
        """One request and its answer; repeated under the same number while none comes."""
        self._seq = (self._seq + 1) % SEQ_MODULUS
        request = Packet(self._seq, session, opcode, len(data) if size is None else size, 0, 0, offset, data)
        expected = (self._seq + 1) % SEQ_MODULUS

        def answers(frame: Frame) -> bytes | None:
            if frame.msgid != FILE_TRANSFER_PROTOCOL or (frame.sysid, frame.compid) != self._server:
                return None
            system, component, packet = decode(frame.payload)
            return frame.payload if (system, component) == self._own and packet.seq == expected else None

        for _ in range(TRIES):
            payload = self._exchange(FILE_TRANSFER_PROTOCOL, encode(*self._server, request), answers, TRY_S)
            if payload is not None:
                return decode(payload)[2]
        raise LinkError(f"no answer to a file request within {TRIES * TRY_S:g} s")
