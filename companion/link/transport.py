"""The sockets and lines under the vehicle link: connection strings, opening, and errors that say what to do.

A transport never blocks: it reads what is there and writes what the system takes at once.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
import termios
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from companion.errors import InputError, LinkError

Address = tuple[str, int]

EXAMPLES: Final = "udpin:127.0.0.1:14540, udpout:192.168.1.10:14550 or serial:/dev/ttyAMA0:921600"
_DATAGRAM_BYTES = 16384
_SERIAL_READ_BYTES = 4096
_RECEIVE_BUFFER_BYTES = 1 << 20
_SERIAL_BACKLOG_S = 0.02  # what may wait in a line's output queue: behind more, a setpoint would be old before it left
_SERIAL_BACKLOG_MIN_BYTES = 300  # one frame of the largest size must always fit
_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit


class Connection(NamedTuple):
    """A parsed connection string."""

    kind: str
    """"udpin", "udpout" or "serial"."""
    target: str
    """Host, or the device's path."""
    number: int
    """Port, or the baud rate."""


class Transport(Protocol):
    """What `wire` needs of a socket or a line."""

    stream: bool
    """Bytes without borders (serial) instead of datagrams."""
    fixed_peer: Address | None
    """Where to send to when that does not depend on who wrote first."""

    def fileno(self) -> int:
        """File descriptor to wait on."""

    def read(self) -> tuple[bytes, Address | None] | None:
        """One datagram or piece of stream and where it came from; None when nothing is there.

        Raises:
            OSError: the network reports that something sent before cannot arrive.
            LinkError: the line is gone.
        """

    def write(self, data: bytes, to: Address | None) -> bool:
        """Hand over one frame; False when it was not taken.

        Raises:
            OSError: the network reports that something sent before, or this, cannot arrive.
        """

    def close(self) -> None:
        """Release the socket or the line."""


def parse_connection(connection: str) -> Connection:
    """Take a connection string apart.

    Raises:
        InputError: it is none; the message gives examples.
    """
    kind, _, rest = connection.partition(":")
    target, _, number_text = rest.rpartition(":")
    if kind not in {"udpin", "udpout", "serial"} or not target:
        raise InputError(f'connection "{connection}": expected something like {EXAMPLES}')
    if not (number_text.isascii() and number_text.isdigit()):
        what = "baud rate" if kind == "serial" else "port"
        raise InputError(f'connection "{connection}": "{number_text}" is no {what}; expected something like {EXAMPLES}')
    number = int(number_text)
    if kind == "serial":
        if number not in _baud_rates():
            rates = ", ".join(str(rate) for rate in _baud_rates() if rate >= 57600)
            raise InputError(f'connection "{connection}": no baud rate {number}; use one of {rates}')
    elif not 1 <= number <= 65535:
        raise InputError(f'connection "{connection}": port {number} is not within 1..65535')
    return Connection(kind, target, number)


def open_transport(connection: str) -> Transport:
    """Open what a connection string names.

    Raises:
        InputError: the string, the host or the device's name is wrong.
        LinkError: the port or the device exists but cannot be had; the message says who probably holds it.
    """
    parsed = parse_connection(connection)
    if parsed.kind == "serial":
        return SerialTransport(parsed.target, parsed.number)
    return UdpTransport(parsed.target, parsed.number, listen=parsed.kind == "udpin")


# ---- UDP -----------------------------------------------------------------------------------------------------------


class UdpTransport:
    """One nonblocking IPv4 datagram socket, bound (`udpin`) or connected (`udpout`)."""

    stream = False

    def __init__(self, host: str, port: int, listen: bool) -> None:
        address = _resolve(host, port, "udpin" if listen else "udpout")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.fixed_peer: Address | None = None if listen else address
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            if listen:
                self._socket.bind(address)
            else:
                self._socket.connect(address)  # the kernel then tells when nobody listens, and filters other senders
        except OSError as error:
            self._socket.close()
            raise _explain_udp(error, host, port, listen) from error

    @property
    def local_address(self) -> Address:
        """Address and port of our side."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def read(self) -> tuple[bytes, Address | None] | None:
        """One datagram and its sender, or None.

        Raises:
            OSError: the network reports that something sent before cannot arrive.
            LinkError: the socket is gone.
        """
        try:
            return self._socket.recvfrom(_DATAGRAM_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            if error.errno in {errno.EBADF, errno.ENOTSOCK}:  # nothing will ever come here again
                raise LinkError("the link's socket was closed underneath this program") from error
            raise

    def write(self, data: bytes, to: Address | None) -> bool:
        """Send one datagram to `to`, or to the connected peer."""
        try:
            if self.fixed_peer is not None:
                self._socket.send(data)
            elif to is None:
                return False
            else:
                self._socket.sendto(data, to)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Close the socket; one that is gone already is no matter."""
        with contextlib.suppress(OSError):
            self._socket.close()


def _resolve(host: str, port: int, kind: str) -> Address:
    """The IPv4 address of a host name."""
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (socket.gaierror, UnicodeError) as error:
        raise InputError(f'connection {kind}:{host}:{port}: no IPv4 address is known for "{host}"') from error
    resolved_host, resolved_port = found[0][4][:2]
    return str(resolved_host), int(resolved_port)


def _explain_udp(error: OSError, host: str, port: int, listen: bool) -> InputError | LinkError:
    """The failure to bind or connect as one sentence with an action."""
    if error.errno == errno.EADDRINUSE:
        holder = port_holder(port)
        who = (
            f"process {holder} holds it"
            if holder
            else "probably another companion, MAVSDK, QGroundControl or mavlink-router"
        )
        return LinkError(
            f"port {port} on {host} is in use ({who}): stop that program, or let mavlink-router give each program "
            f"a port of its own (PX4 sends to 14540 for companions, 14550 for ground stations)"
        )
    if error.errno == errno.EADDRNOTAVAIL and listen:
        return InputError(
            f"udpin:{host}:{port}: this machine has no address {host}; "
            f"listen at 127.0.0.1, or at 0.0.0.0 for all networks"
        )
    if error.errno in {errno.EACCES, errno.EPERM}:
        return LinkError(f"port {port} on {host}: not permitted ({error.strerror}); ports below 1024 are the system's")
    direction = "listen at" if listen else "send to"
    return LinkError(f"cannot {direction} {host}:{port}: {error.strerror}")


def port_holder(port: int) -> str | None:
    """Which process holds a UDP port, as "1234 (name)", as far as this user may see it (Linux's /proc)."""
    try:
        rows = Path("/proc/net/udp").read_text().splitlines()[1:]
    except OSError:
        return None
    fields = [row.split() for row in rows]
    wanted = {f"socket:[{row[9]}]" for row in fields if len(row) > 9 and int(row[1].rpartition(":")[2], 16) == port}
    if not wanted:
        return None
    for process in Path("/proc").iterdir():
        if not process.name.isdigit():
            continue
        with contextlib.suppress(OSError):  # other users' processes, and those that end while we look
            for descriptor in (process / "fd").iterdir():
                with contextlib.suppress(OSError):
                    if os.readlink(descriptor) in wanted:
                        return f"{process.name} ({(process / 'comm').read_text().strip()})"
    return None


# ---- serial --------------------------------------------------------------------------------------------------------


def _baud_rates() -> dict[int, int]:
    """The baud rates that this system's termios knows, slowest first."""
    names = [name for name in dir(termios) if name.startswith("B") and name[1:].isdigit() and name != "B0"]
    return {int(name[1:]): int(getattr(termios, name)) for name in sorted(names, key=lambda name: int(name[1:]))}


class SerialTransport:
    """A serial line in raw mode, 8N1, no flow control, for this program alone."""

    stream = True
    fixed_peer: Address | None = None

    def __init__(self, path: str, baud: int) -> None:
        self._path = path
        self._pending = b""
        self._backlog_bytes = max(_SERIAL_BACKLOG_MIN_BYTES, int(baud / _BITS_PER_BYTE * _SERIAL_BACKLOG_S))
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise _explain_serial(error, path) from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.ioctl(self._fd, termios.TIOCEXCL)
            _set_raw(self._fd, _baud_rates()[baud])
            termios.tcflush(self._fd, termios.TCIOFLUSH)  # half frames from before are of no use
        except (OSError, termios.error) as error:
            os.close(self._fd)
            raise _explain_serial(error, path) from error

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._fd

    def read(self) -> tuple[bytes, Address | None] | None:
        """The bytes that have come, or None.

        Raises:
            LinkError: the device is gone.
        """
        try:
            data = os.read(self._fd, _SERIAL_READ_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise LinkError(f"{self._path}: the line is gone ({error.strerror}); is the adapter plugged in?") from error
        if not data:
            raise LinkError(f"{self._path}: the line was hung up; is the adapter plugged in?")
        return data, None

    def write(self, data: bytes, to: Address | None) -> bool:
        """Queue one whole frame, or nothing: behind a backlog it would leave the line too late to be true."""
        del to
        try:
            if self._pending:  # the rest of a frame that the line took in part; nothing may come between
                self._pending = self._pending[os.write(self._fd, self._pending) :]
                if self._pending:
                    return False
            queued = struct.unpack("i", fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(4)))[0]
            if queued + len(data) > self._backlog_bytes:
                return False
            self._pending = data[os.write(self._fd, data) :]
        except OSError:  # full, or gone; when it is gone, reading says so
            return False
        return True

    def close(self) -> None:
        """Close the line."""
        os.close(self._fd)


def _set_raw(fd: int, speed: int) -> None:
    """Eight data bits, no parity, one stop bit, no echo, no translation, no flow control, modem lines ignored."""
    attributes = termios.tcgetattr(fd)
    control_characters: list[bytes | int] = list(attributes[6])
    control_characters[termios.VMIN] = 1  # with 0, "nothing there" and "hung up" would look alike
    control_characters[termios.VTIME] = 0
    control_flags = termios.CS8 | termios.CREAD | termios.CLOCAL
    raw: list[int | list[bytes | int]] = [0, 0, control_flags, 0, speed, speed, control_characters]
    termios.tcsetattr(fd, termios.TCSANOW, raw)


def _explain_serial(error: OSError | termios.error, path: str) -> InputError | LinkError:
    """The failure to open a line as one sentence with an action."""
    number = error.args[0] if error.args else None
    reason = error.args[1] if len(error.args) > 1 else str(error)
    if number in {errno.ENOENT, errno.EISDIR, errno.ENODEV, errno.ENXIO}:
        return InputError(f"{path}: no such serial device; `ls -l /dev/serial/by-id /dev/tty*` shows what there is")
    if number in {errno.EACCES, errno.EPERM}:
        return LinkError(f'{path}: not permitted; join the group that owns it (often "dialout") and log in again')
    if number in {errno.EBUSY, errno.EAGAIN}:
        return LinkError(
            f"{path}: another program has it open (a console, ModemManager, mavlink-router?); stop it first"
        )
    if number == errno.ENOTTY:
        return InputError(f"{path}: is not a serial device")
    return LinkError(f"{path}: cannot be opened as a serial line: {reason}")
