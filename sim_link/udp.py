"""A UDP socket of the vehicle with PX4's partner lock."""

from __future__ import annotations

import errno
import socket

from .codec import ID_SERIAL_CONTROL, Frame, frames

LOOPBACK = "127.0.0.1"
_DATAGRAM_MAX = 2048
_BUFFER_BYTES = 1 << 20
_TOGETHER_MAX = 1400

Address = tuple[str, int]


class PortError(OSError):
    """A port that cannot be used; the message is one line for people."""


class UdpEndpoint:
    """One socket. It sends to `remote` until somebody speaks; the first one who does is its partner for good.

    Whoever speaks later is heard, but gets nothing: so does PX4. Unlike PX4's, the lock needs a valid MAVLink message,
    not just any datagram.
    """

    def __init__(self, port: int, remote_port: int, option: str) -> None:
        """Bind the socket on the loopback interface.

        Args:
            port: local port; 0: any free one.
            remote_port: port that is spoken to first; 0: nobody, until a partner speaks.
            option: the command line's name for `port`, for the message.

        Raises:
            PortError: the port is in use or not allowed.
        """
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        try:
            self.socket.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            self.socket.close()
            in_use = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            why = "is in use" if in_use else f"cannot be used ({error})"
            raise PortError(f"UDP port {port} on {LOOPBACK} {why}; choose another with {option}") from None
        self.port: int = self.socket.getsockname()[1]
        self.descriptor = self.socket.fileno()
        """As a wait tells it."""
        self.partner: Address | None = None
        self._remote: Address | None = (LOOPBACK, remote_port) if remote_port else None
        self.together = False
        """Put several frames into one datagram, as far as a network takes it whole."""
        self.unsent = 0
        """Datagrams that the system did not take."""

    def send(self, outbox: list[bytes]) -> None:
        """Send every frame as one datagram, and empty the list. What the system does not take is lost, as by radio."""
        address = self.partner or self._remote
        if address is not None:
            sendto = self.socket.sendto
            for frame in _joined(outbox) if self.together and len(outbox) > 1 else outbox:
                try:
                    sendto(frame, address)
                except OSError:
                    self.unsent += 1
        outbox.clear()

    def take(self) -> tuple[bytes, Address] | None:
        """Give the next datagram as it came, and its sender; None when nothing is waiting. Never blocks."""
        try:
            return self.socket.recvfrom(_DATAGRAM_MAX)
        except BlockingIOError:
            return None
        except OSError:
            return b"", (LOOPBACK, 0)  # an ICMP answer to something sent: nobody is there

    def receive(self) -> tuple[list[Frame], Address] | None:
        """Give the next datagram's messages and its sender; None when nothing is waiting. Never blocks."""
        taken = self.take()
        return None if taken is None else self.read(*taken)

    def read(self, datagram: bytes, sender: Address) -> tuple[list[Frame], Address]:
        """Give the messages of a datagram that was taken, and its sender, who may be the partner from now on."""
        found = frames(datagram)
        if self.partner is None and found and found[0].msg_id != ID_SERIAL_CONTROL:
            self.partner = sender  # whoever orders faults is no partner
        return found, sender

    def answer(self, outbox: list[bytes], sender: Address) -> None:
        """Send frames to somebody who need not be the partner."""
        for frame in outbox:
            try:
                self.socket.sendto(frame, sender)
            except OSError:
                self.unsent += 1

    def close(self) -> None:
        """Give the port back."""
        self.socket.close()


def _joined(outbox: list[bytes]) -> list[bytes]:
    """Put frames together to datagrams of bounded size."""
    datagrams = [outbox[0]]
    for frame in outbox[1:]:
        if len(datagrams[-1]) + len(frame) <= _TOGETHER_MAX:
            datagrams[-1] += frame
        else:
            datagrams.append(frame)
    return datagrams
