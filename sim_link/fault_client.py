"""Orders faults of a vehicle that runs somewhere else, over its MAVLink port (see `fault_shell`)."""

from __future__ import annotations

import socket
import time
from types import TracebackType
from typing import Any

from .codec import ID_SERIAL_CONTROL, Decoder, Encoder, frames, mavlink
from .fault_keys import FaultError
from .udp import LOOPBACK

ANSWER_WITHIN_S = 5.0
_DATA_BYTES = 70
_SYSTEM, _COMPONENT = 254, 190
_QUIET_S = 0.05
"""An answer is whole when its last piece is not full, or nothing more comes for this long."""


class NoVehicleError(FaultError):
    """Nobody answers."""


class FaultClient:
    """Speaks to one vehicle; a context manager.

    Args:
        port: of the vehicle's companion link or ground link (sim-link run: 14580 + i, 18570 + i).
        host: where it runs.
    """

    def __init__(self, port: int, host: str = LOOPBACK) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = (host, port)
        self._socket.connect(self._address)  # so that it is told when nobody is there
        self._encoder = Encoder(_SYSTEM, _COMPONENT)
        self._decoder = Decoder()

    def __enter__(self) -> FaultClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def inject(self, kind: str, **keys: Any) -> int:
        """Let a fault act: `inject("wind", wind_m_s=(0, 8, 0), for_s=2.0)`; gives its number.

        Args:
            kind: its kind.
            **keys: start_s, end_s (vehicle time since the start) or for_s, and the kind's own keys. Without start_s it
                acts at once.

        Raises:
            FaultError: it cannot be, or no vehicle answers.
        """
        items = [kind, *(f"{key} = {_toml(value)}" for key, value in keys.items())]
        return int(self.order(f"fault {', '.join(items)}").split()[1])

    def end(self, number: int | None = None) -> None:
        """End a fault, None: all of them. Raises FaultError when there is no such fault, or no vehicle answers."""
        self.order(f"fault end {'all' if number is None else number}")

    def list(self) -> str:
        """Give the faults that act or will, one line each. Raises FaultError when no vehicle answers."""
        return self.order("fault list")

    def order(self, line: str) -> str:
        """Send one line to the shell; gives its answer.

        Raises:
            FaultError: the vehicle did not obey, or none answers.
        """
        data = f"{line}\n".encode()
        try:
            for at in range(0, len(data), _DATA_BYTES):
                self._socket.send(self._framed(data[at : at + _DATA_BYTES]))
            answer = self._answer()
        except OSError:  # an ICMP answer: nobody is there
            answer = ""
        if not answer:
            raise NoVehicleError("", f"no answer from a simulated vehicle at {self._address[0]}:{self._address[1]}")
        if answer.startswith("error: "):
            raise FaultError("", answer.removeprefix("error: ").strip())
        return answer.rstrip("\n")

    def _framed(self, part: bytes) -> bytes:
        flags = mavlink.SERIAL_CONTROL_FLAG_RESPOND | mavlink.SERIAL_CONTROL_FLAG_EXCLUSIVE
        message = mavlink.MAVLink_serial_control_message(
            mavlink.SERIAL_CONTROL_DEV_SHELL, flags, 0, 0, len(part), list(part.ljust(_DATA_BYTES, b"\0"))
        )
        return self._encoder.cold(message)

    def _answer(self) -> str:
        """Wait for the pieces of an answer."""
        text = b""
        deadline_s = time.monotonic() + ANSWER_WITHIN_S
        while True:
            self._socket.settimeout(max(_QUIET_S if text else deadline_s - time.monotonic(), 1e-3))
            try:
                datagram = self._socket.recv(2048)
            except TimeoutError:
                return text.decode("utf-8", "replace")
            for frame in frames(datagram):
                if frame.msg_id != ID_SERIAL_CONTROL:
                    continue
                message = self._decoder.message(frame)
                if message is not None:
                    text += bytes(message.data[: message.count])
                    if message.count < _DATA_BYTES:
                        return text.decode("utf-8", "replace")


def _toml(value: Any) -> str:
    """Write a value as TOML has it."""
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)
