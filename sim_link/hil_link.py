"""The TCP port at which a real PX4 in simulation finds its world: one PX4 at a time, MAVLink as a stream of bytes.

PX4 is the client: it tries until somebody listens at port 4560 + instance, and it never connects again once that
connection is gone.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import struct
import time
from collections.abc import Callable
from typing import NamedTuple

from .codec import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED_FLAG, Frame, frames, padded
from .udp import PortError

ID_HIL_ACTUATOR_CONTROLS = 93
HIL_ACTUATOR_CONTROLS = struct.Struct("<QQ16fB")
"""time_usec, flags, controls, mode."""
_ARMED = 128
_RECEIVED_MAX = 65536
_HEADER_MAX = 10
_SLICE_S = 0.1
"""Longest single wait, so that a stop is noticed."""
_SEND_S = 2.0
"""A PX4 that takes nothing for so long is gone."""


class Controls(NamedTuple):
    """HIL_ACTUATOR_CONTROLS as received."""

    t_us: int
    """PX4's time: that of the newest HIL_SENSOR."""
    controls: tuple[float, ...]
    """Outputs 1 to 16: 0..1 of a motor, after PX4's own thrust curve; all 0 while disarmed."""
    armed: bool


class Px4GoneError(Exception):
    """PX4 has closed the connection, or does not take any more."""


class HilServer:
    """Listens for PX4."""

    def __init__(self, port: int, address: str = "127.0.0.1") -> None:
        """Open the port.

        Args:
            port: 4560 + PX4's instance; 0: any free one.
            address: of the interface to listen at.

        Raises:
            PortError: the port is in use or cannot be had.
        """
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            # A connection that ended a moment ago must not keep the port.
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.socket.bind((address, port))
            self.socket.listen(1)
        except (OSError, OverflowError) as error:
            self.socket.close()
            in_use = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            why = "is in use" if in_use else f"cannot be used ({error})"
            raise PortError(
                f"TCP port {port} on {address} {why}; another simulator? End it, or choose another --instance"
            ) from None
        self.socket.setblocking(False)
        self.port: int = self.socket.getsockname()[1]

    def accept(self, stopped: Callable[[], bool]) -> Px4Link | None:
        """Wait for PX4; None: told to stop before."""
        while not stopped():
            link = self.accept_now()
            if link is not None:
                return link
            select.select([self.socket], [], [], _SLICE_S)
        return None

    def accept_now(self) -> Px4Link | None:
        """Take a PX4 that is waiting; None when there is none."""
        try:
            connection, _ = self.socket.accept()
        except OSError:
            return None  # nobody there, or gone again already
        return Px4Link(connection)

    def close(self) -> None:
        """Give the port back."""
        self.socket.close()


class Px4Link:
    """The connection to one PX4."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._poll = select.poll()
        self._poll.register(connection.fileno(), select.POLLIN)
        self._rest = b""

    def send(self, data: bytes) -> None:
        """Send frames. Raises Px4GoneError when PX4 does not take them."""
        give_up_s = time.monotonic() + _SEND_S
        view = memoryview(data)
        while view:
            try:
                view = view[self._socket.send(view) :]
            except BlockingIOError:
                left_s = give_up_s - time.monotonic()
                if left_s <= 0.0:
                    raise Px4GoneError(f"takes no data for {_SEND_S:g} s") from None
                select.select([], [self._socket], [], min(left_s, _SLICE_S))
            except OSError as error:
                raise _gone(error) from None

    def receive(self, timeout_s: float) -> list[Frame]:
        """Wait for data, at most timeout_s; gives the frames that are whole. Raises Px4GoneError when PX4 has left."""
        if not self._poll.poll(max(0.0, timeout_s) * 1e3):
            return []
        try:
            data = self._socket.recv(_RECEIVED_MAX)
        except BlockingIOError:
            return []
        except OSError as error:
            raise _gone(error) from None
        if not data:
            raise Px4GoneError("closed the connection")
        whole, self._rest = split(self._rest + data)
        return [frame for piece in whole for frame in frames(piece)]

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _gone(error: OSError) -> Px4GoneError:
    """Whoever leaves with something unread resets the connection, which is no other way to close it."""
    closed = isinstance(error, ConnectionError)
    return Px4GoneError("closed the connection" if closed else f"cannot be reached ({error.strerror or error})")


def controls_of(frame: Frame) -> Controls:
    """Read HIL_ACTUATOR_CONTROLS."""
    t_us, _, *controls, mode = HIL_ACTUATOR_CONTROLS.unpack(padded(frame.payload, HIL_ACTUATOR_CONTROLS.size))
    return Controls(t_us, tuple(controls), bool(mode & _ARMED))


def split(data: bytes) -> tuple[list[bytes], bytes]:
    """Cut a stream into pieces that look like frames, and what is not whole yet.

    A piece that fails its checksum is looked through for others by `codec.frames`; what is no frame is dropped.
    """
    pieces: list[bytes] = []
    at, end = 0, len(data)
    while at < end:
        length = _length(data, at)
        if length == 0:
            at += 1
        elif length < 0 or at + length > end:
            return pieces, data[at:]
        else:
            pieces.append(data[at : at + length])
            at += length
    return pieces, b""


def _length(data: bytes, at: int) -> int:
    """Give how long the frame that begins at `at` is; 0: none begins there, -1: too little of it is here."""
    magic = data[at]
    if magic not in (MAGIC_V1, MAGIC_V2):
        return 0
    if at + 3 > len(data):
        return -1
    if magic == MAGIC_V1:
        return data[at + 1] + 8
    signed = SIGNATURE_LENGTH if data[at + 2] & SIGNED_FLAG else 0
    return data[at + 1] + _HEADER_MAX + 2 + signed
