"""MAVLink FTP on the wire: the payload of FILE_TRANSFER_PROTOCOL (110), its operations, errors and checksum.

Both sides use it: the server at component 191 and the command line. Layout and numbers are those of the protocol as
PX4, QGroundControl, MAVSDK and pymavlink speak it. Two additions of ours fit into data that the others leave empty and
ignore: `EXPECTED` in TerminateSession says what the whole file must be, `RECEIVED` in the answer to OpenFileWO says
what of it is there already.
"""

from __future__ import annotations

import errno
import struct
import zlib
from enum import IntEnum
from typing import Final, NamedTuple

FILE_TRANSFER_PROTOCOL: Final = 110
"""Message id."""
DATA_MAX: Final = 239
"""Bytes of data that one message carries."""
SEQ_MODULUS: Final = 1 << 16
OFFSET_MAX: Final = (1 << 32) - 1

INDEX_NAME: Final = "index.json"
"""The file that no upload made: what is stored, with verdicts."""

EXPECTED: Final = struct.Struct("<II")
"""Data of our TerminateSession after an upload: size [bytes] and `crc32` of the whole file."""
RECEIVED: Final = struct.Struct("<II")
"""Data of our answer to OpenFileWO: bytes that are there from the beginning on without a hole, and their `crc32`."""
SIZE: Final = struct.Struct("<I")
"""Data of the answer to OpenFileRO: size [bytes]; of CalcFileCRC32: the checksum."""

_HEADER = struct.Struct("<HBBBBBxI")
_TARGET = struct.Struct("<xBB")  # network 0, system, component
_MESSAGE_BYTES = _TARGET.size + _HEADER.size + DATA_MAX
_NO_XOR = 0xFFFFFFFF


class Opcode(IntEnum):
    """What is asked for, or the kind of an answer."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    LIST_DIRECTORY_WITH_TIME = 16
    ACK = 128
    NAK = 129


class Failure(IntEnum):
    """First data byte of a NAK."""

    FAIL = 1
    FAIL_ERRNO = 2
    """The second byte is an errno."""
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class Packet(NamedTuple):
    """One request or answer."""

    seq: int
    """Of a request; its answer has the next."""
    session: int
    opcode: int
    size: int
    """Bytes of data that there are (in an answer, a request that brings data), or that are wanted (in a read)."""
    req_opcode: int
    """In an answer: what was asked."""
    burst_complete: int
    """In a burst: 1 in its last answer."""
    offset: int
    """Bytes in a file, or entries in a directory."""
    data: bytes
    """At most `DATA_MAX` bytes; `size` of them in what a well-behaved sender sent."""

    @property
    def path(self) -> bytes:
        """The data as a path: up to the first NUL, which some senders count and others do not."""
        return self.data.split(b"\0", 1)[0]


def encode(target_system: int, target_component: int, packet: Packet) -> bytes:
    """The payload of FILE_TRANSFER_PROTOCOL for a packet."""
    head = _HEADER.pack(
        packet.seq % SEQ_MODULUS,
        packet.session,
        packet.opcode,
        packet.size,
        packet.req_opcode,
        packet.burst_complete,
        packet.offset,
    )
    return (_TARGET.pack(target_system, target_component) + head + packet.data).ljust(_MESSAGE_BYTES, b"\0")


def decode(payload: bytes) -> tuple[int, int, Packet]:
    """Target system, target component and packet of a payload; what is missing of it counts as zeros. Never raises.

    A size above `DATA_MAX` stays as it came, for the reader to refuse.
    """
    if len(payload) < _MESSAGE_BYTES:
        payload = payload.ljust(_MESSAGE_BYTES, b"\0")
    system, component = _TARGET.unpack_from(payload)
    seq, session, opcode, size, req_opcode, complete, offset = _HEADER.unpack_from(payload, _TARGET.size)
    begin = _TARGET.size + _HEADER.size
    data = payload[begin : begin + min(size, DATA_MAX)]
    return system, component, Packet(seq, session, opcode, size, req_opcode, complete, offset, data)


def ack(request: Packet, data: bytes = b"") -> Packet:
    """The answer that grants a request."""
    return Packet(request.seq + 1, request.session, Opcode.ACK, len(data), request.opcode, 0, request.offset, data)


def nak(request: Packet, data: bytes) -> Packet:
    """The answer that refuses a request; the data is a `Failure`, or comes from `errno_data`."""
    return Packet(request.seq + 1, request.session, Opcode.NAK, len(data), request.opcode, 0, request.offset, data)


_OWN_CODES: Final = {
    errno.ENOENT: Failure.FILE_NOT_FOUND,
    errno.EEXIST: Failure.FILE_EXISTS,
    errno.EPERM: Failure.FILE_PROTECTED,
}


def errno_data(number: int) -> bytes:
    """The data of a NAK for an errno: its own code where the protocol has one."""
    own = _OWN_CODES.get(number)
    return bytes([Failure.FAIL_ERRNO, number & 0xFF]) if own is None else bytes([own])


def crc32(data: bytes, before: int = 0) -> int:
    """The checksum of CalcFileCRC32: the polynomial of zip's CRC-32, but without its inversions (as PX4 and MAVSDK).

    Args:
        data: bytes.
        before: checksum of the bytes before these.
    """
    return zlib.crc32(data, before ^ _NO_XOR) ^ _NO_XOR
