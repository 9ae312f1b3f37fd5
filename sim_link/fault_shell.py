"""Faults by hand while the vehicle runs: lines of text in SERIAL_CONTROL, as to PX4's own shell.

`help` tells the orders. A line may come in pieces; it ends with a line feed. Whoever wrote it gets the answer in
SERIAL_CONTROL with the flag REPLY, whether it is the link's partner or not.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

from .autopilot import Result
from .codec import AUTOPILOT_COMPONENT, Decoder, Encoder, Frame, mavlink
from .fault_keys import FaultError
from .fault_kinds import KINDS, Fault
from .faults import Faults

HELP = f"""fault KIND, key = value, ...   let a fault act: for_s = 2 for two seconds, start_s, end_s since the start
fault list                     the faults that act or will
fault end NUMBER|all           end a fault
failure motor|gps off|ok|stuck|wrong [-i N]   as PX4's own order
kinds: {", ".join(KINDS)}"""
_UNITS = {"motor": 101, "gps": 4}
_TYPES = {"ok": 0, "off": 1, "stuck": 2, "wrong": 4}
_ORDER = re.compile(r"(\w*)[\s,]*(.*)", re.DOTALL)
"""A kind, and what follows it."""
_DATA_BYTES = 70
_LINE_MAX = 2000
_WRITERS_MAX = 16
_DEVICE = mavlink.SERIAL_CONTROL_DEV_SHELL
_REPLY = mavlink.SERIAL_CONTROL_FLAG_REPLY


class FaultShell:
    """Obeys the orders of one vehicle's shell."""

    def __init__(self, faults: Faults, system: int) -> None:
        self._faults = faults
        self._system = system
        self._decoder = Decoder()
        self._encoder = Encoder(system, AUTOPILOT_COMPONENT)
        self._begun: dict[Any, bytes] = {}
        """What every writer has written since his last line feed."""

    def take(self, frame: Frame, writer: Any) -> list[bytes]:
        """Take a SERIAL_CONTROL of a writer; gives the frames that answer it."""
        message = self._decoder.message(frame)
        if message is None or message.device != _DEVICE or message.flags & _REPLY:
            return []
        if getattr(message, "target_system", 0) not in (0, self._system):
            return []
        text = self._begun.pop(writer, b"") + bytes(message.data[: min(message.count, _DATA_BYTES)])
        *lines, rest = text.replace(b"\r", b"\n").split(b"\n")
        if 0 < len(rest) <= _LINE_MAX:
            while len(self._begun) >= _WRITERS_MAX:
                self._begun.pop(next(iter(self._begun)))
            self._begun[writer] = rest
        said = [self.obey(line.decode("utf-8", "replace")) for line in lines if line.strip()]
        return self._framed("".join(f"{answer}\n" for answer in said).encode())

    def obey(self, line: str) -> str:
        """Obey one line; gives what there is to say, which begins with "error:" when it was not obeyed."""
        word, _, rest = line.strip().partition(" ")
        try:
            if word == "help":
                return HELP
            if word == "fault":
                return self._fault(rest.strip())
            if word == "failure":
                return self._failure(rest.split())
        except FaultError as error:
            return f"error: {error}"
        return f"error: {word}: no such order; help tells which there are"

    def _fault(self, order: str) -> str:
        words = order.split()
        if words == ["list"]:
            acting = self._faults.active
            lines = [
                f"{number} {'acts' if number in acting else 'waits'} {fault.span}: {fault}"
                for number, fault in self._faults.planned.items()
            ]
            return "\n".join(lines) or "no faults"
        if words[:1] == ["end"]:
            return self._end(words[1:])
        number = self._faults.add(self._read(order))
        return f"fault {number}"

    def _read(self, order: str) -> Fault:
        """Read `KIND, key = value, ...`: what follows the kind is the inside of a TOML table in one line."""
        kind, rest = _ORDER.fullmatch(order).groups()  # type: ignore[union-attr]  # matches everything
        try:
            table = tomllib.loads("fault = {" + rest + "}")["fault"]
        except (tomllib.TOMLDecodeError, RecursionError):
            raise FaultError("", f"{rest!r}: expected key = value, ...") from None
        if "kind" in table:
            raise FaultError("kind", "given twice")
        return self._faults.of_order({"kind": kind, **table})

    def _end(self, words: list[str]) -> str:
        """End one fault, or all."""
        if words == ["all"]:
            for number in self._faults.planned:
                self._faults.end(number)
        elif len(words) == 1 and words[0].isascii() and words[0].isdigit() and len(words[0]) < 10:
            self._faults.end(int(words[0]))
        else:
            raise FaultError("", "fault end: expected a number or all")
        return "ended"

    def _failure(self, words: list[str]) -> str:
        """Obey PX4's own `failure UNIT TYPE [-i INSTANCE]`."""
        instance = "0"
        if len(words) == 4 and words[2] == "-i":
            instance = words[3]
        known = len(words) in (2, 4) and words[0] in _UNITS and words[1] in _TYPES and instance in "01234"
        if not known or not instance:
            raise FaultError("", "failure: expected motor|gps off|ok|stuck|wrong and, if wanted, -i 1 to 4")
        result = self._faults.inject_failure(_UNITS[words[0]], _TYPES[words[1]], int(instance))
        if result is not Result.ACCEPTED:
            raise FaultError("", f"failure: {result.name} (SYS_FAILURE_EN must be 1)")
        return "ok"

    def _framed(self, text: bytes) -> list[bytes]:
        """Put text into SERIAL_CONTROL messages."""
        out = []
        for at in range(0, len(text), _DATA_BYTES):
            part = text[at : at + _DATA_BYTES]
            data = list(part.ljust(_DATA_BYTES, b"\0"))
            message = mavlink.MAVLink_serial_control_message(_DEVICE, _REPLY, 0, 0, len(part), data)
            out.append(self._encoder.cold(message))
        return out
