"""Giving a key to an autopilot (SETUP_SIGNING), over a local link and while it is disarmed, and taking it away."""

from __future__ import annotations

import struct
import time
from contextlib import ExitStack
from typing import Final

from companion.errors import LinkError, RefusedError
from companion.link import codec
from companion.link.framing import Frame
from companion.link.key_file import load_key
from companion.link.locality import is_local
from companion.link.signing import SETUP_SIGNING, SigningKey, time_now
from companion.link.signing_times import open_signer
from companion.link.transport import open_transport, parse_connection
from companion.link.wire import Wire

AUTOPILOT_COMPONENT: Final = 1
ANSWER_S: Final = 6.0
"""PX4's heartbeat comes every second; the first with the new key ends the wait."""
_HEARTBEAT_S: Final = 1.0
_WAIT_S: Final = 0.1
_SETUP = struct.Struct("<QBB32s")
"""initial_timestamp, target system and component, secret_key."""


class _Link:
    """One socket or line, which is spoken on with one key after the other; a context manager.

    It stays open between them: PX4 goes on talking to the port that spoke first.
    """

    def __init__(self, connection: str, system: int | None) -> None:
        self._system = system
        self._stack = ExitStack()
        self._transport = open_transport(connection)
        self._stack.callback(self._transport.close)

    def wire(self, key_file: str | None) -> Wire:
        """The link with a key, or without one."""
        signer = open_signer(key_file)
        if signer is not None:
            self._stack.enter_context(signer)
        return Wire(self._transport, guard=signer, only_system=self._system)

    def __enter__(self) -> _Link:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class Setup:
    """One autopilot whose key is to be changed.

    Args:
        connection: of the local link.
        system: its system id; None: the first autopilot that is heard.
        timeout_s: how long to wait for it.

    Raises:
        InputError: the connection string is wrong.
        RefusedError: the link leaves this machine.
    """

    def __init__(self, connection: str, system: int | None, timeout_s: float) -> None:
        if not is_local(parse_connection(connection)):
            raise RefusedError(
                f"{connection}: leaves this machine, and the key would be readable on the way; connect the autopilot by"
                " serial line, or run this beside it (udpin:127.0.0.1:PORT)"
            )
        self._connection = connection
        self._system = system
        self._timeout_s = timeout_s

    def install(self, key_file: str, old_key_file: str | None) -> int:
        """Gives it the key; returns its system id once it signs with that.

        Raises:
            InputError: a key file cannot be used.
            RefusedError: the vehicle is armed.
            LinkError: no autopilot, or none that took the key.
        """
        key = load_key(key_file)
        with self._link() as link:
            wire = link.wire(old_key_file)
            system = self._meet(wire, signed=old_key_file is not None)
            self._order(wire, system, key)
            if self._hears(link.wire(key_file), system, signed=True):
                return system
        has_one = "" if old_key_file is not None else "; if it has another key, name that with --old"
        raise LinkError(f"system {system} does not sign with this key within {ANSWER_S:g} s{has_one}")

    def remove(self, key_file: str) -> int:
        """Ends signing; returns the system id once the autopilot is heard unsigned. Raises as `install`."""
        with self._link() as link:
            wire = link.wire(key_file)
            system = self._meet(wire, signed=True)
            self._order(wire, system, None)
            if self._hears(link.wire(None), system, signed=False):
                return system
        raise LinkError(f"system {system} signs still after {ANSWER_S:g} s")

    def _link(self) -> _Link:
        return _Link(self._connection, self._system)

    def _meet(self, wire: Wire, *, signed: bool) -> int:
        """Waits for a disarmed autopilot."""
        end_s = time.monotonic() + self._timeout_s
        spoken_s = 0.0
        others_signed = False
        while time.monotonic() < end_s:
            spoken_s = _speak(wire, spoken_s)
            for frame in wire.receive(_WAIT_S):
                if not self._is_autopilot(frame):
                    continue
                if not signed and _is_signed(frame):
                    others_signed = True  # by a key that this link does not check
                    continue
                if codec.decode_heartbeat(frame.payload).armed:
                    raise RefusedError(f"system {frame.sysid} is armed: its key is changed on the ground, disarmed")
                wire.system_id = frame.sysid
                return frame.sysid
        if others_signed:
            raise LinkError(f"the autopilot at {self._connection} has a key already: name its file with --old")
        told = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in wire.refusals.items() if n)
        raise LinkError(
            f"no autopilot's heartbeat at {self._connection} within {self._timeout_s:g} s"
            + (f"; refused: {told} (is this the key that it has?)" if told else "")
        )

    def _order(self, wire: Wire, system: int, key: SigningKey | None) -> None:
        """Sends SETUP_SIGNING; it is not acknowledged, and may be lost on a serial line: so twice."""
        content = (0, bytes(32)) if key is None else (time_now(), key.secret)
        payload = _SETUP.pack(content[0], system, AUTOPILOT_COMPONENT, content[1])
        for _ in range(2):
            if not wire.send(SETUP_SIGNING, payload):
                raise LinkError(f"{self._connection}: the key did not go out")

    def _hears(self, wire: Wire, system: int, *, signed: bool) -> bool:
        """Whether the autopilot speaks as it should now."""
        wire.system_id = system
        end_s = time.monotonic() + ANSWER_S
        spoken_s = 0.0
        while time.monotonic() < end_s:
            spoken_s = _speak(wire, spoken_s)
            for frame in wire.receive(_WAIT_S):
                if self._is_autopilot(frame) and frame.sysid == system and _is_signed(frame) == signed:
                    return True
        return False

    def _is_autopilot(self, frame: Frame) -> bool:
        ours = self._system in {None, frame.sysid}
        return ours and frame.msgid == codec.HEARTBEAT and frame.compid == AUTOPILOT_COMPONENT


def _speak(wire: Wire, spoken_s: float) -> float:
    """A heartbeat every second, where there is somebody to send it to: PX4 answers whoever speaks first."""
    now_s = time.monotonic()
    if now_s - spoken_s < _HEARTBEAT_S:
        return spoken_s
    wire.send(codec.HEARTBEAT, codec.encode_heartbeat())
    return now_s


def _is_signed(frame: Frame) -> bool:
    return frame.raw[0] == 0xFD and bool(frame.raw[2] & 1)
