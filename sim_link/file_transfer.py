"""MAVLink FTP over a file system without files: every request is answered, nothing is found.

PX4 announces FTP and answers; a client that finds no answer waits and asks again for seconds.
"""

from __future__ import annotations

import struct

_HEADER = struct.Struct("<HBBBBBxI")
"""seq_number, session, opcode, size, req_opcode, burst_complete, padding, offset."""
PAYLOAD_BYTES = 251
_NONE, _TERMINATE_SESSION, _RESET_SESSIONS, _LIST_DIRECTORY = 0, 1, 2, 3
_OPEN_FILE_RO, _CRC32, _LIST_DIRECTORY_WITH_TIME = 4, 14, 16
_ACK, _NAK = 128, 129
_INVALID_SESSION, _END_OF_FILE, _UNKNOWN_COMMAND, _FILE_NOT_FOUND, _PROTECTED = 4, 6, 7, 10, 9
_WRITES = frozenset((6, 7, 8, 9, 10, 11, 12, 13))
_READS = frozenset((5, 15))
_ROOTS = frozenset(("", "/", ".", "@MAV_LOG"))


def answer(payload: bytes) -> bytes:
    """Give the answer's payload to a request's."""
    request = payload[:PAYLOAD_BYTES].ljust(PAYLOAD_BYTES, b"\0")
    sequence, session, opcode, size, _, _, offset = _HEADER.unpack_from(request)
    path = request[_HEADER.size : _HEADER.size + size].split(b"\0", 1)[0].decode("ascii", "replace")
    error = _error(opcode, path)
    body = b"" if error is None else bytes((error,))
    head = _HEADER.pack((sequence + 1) & 0xFFFF, session, _ACK if error is None else _NAK, len(body), opcode, 0, offset)
    return (head + body).ljust(PAYLOAD_BYTES, b"\0")


def _error(opcode: int, path: str) -> int | None:
    """Say what is wrong with a request; None: nothing."""
    if opcode in (_NONE, _TERMINATE_SESSION, _RESET_SESSIONS):
        return None
    if opcode in (_LIST_DIRECTORY, _LIST_DIRECTORY_WITH_TIME):
        return _END_OF_FILE if path.rstrip("/") in _ROOTS else _FILE_NOT_FOUND
    if opcode in (_OPEN_FILE_RO, _CRC32):
        return _FILE_NOT_FOUND
    if opcode in _READS:
        return _INVALID_SESSION
    return _PROTECTED if opcode in _WRITES else _UNKNOWN_COMMAND
