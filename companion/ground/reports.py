"""What ground tools are told without having asked: heartbeat, texts, and the figures of the flight."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from companion import __version__
from companion.ground.links import GroundPort
from companion.ground.messages import (
    DEBUG_VECT,
    NAMED_VALUE_FLOAT,
    Severity,
    encode_autopilot_version,
    encode_debug_vect,
    encode_named_value,
    encode_texts,
)
from companion.ground.service import GroundLink
from companion.ground.standing import Standing
from companion.link import codec

HEARTBEAT_INTERVAL_S: Final = 1.0
GROUND_INTERVAL_S: Final = 0.25
"""Between reports of the figures on the ground links."""
VEHICLE_INTERVAL_S: Final = 1.0
"""The same through the autopilot's radio, which is slow."""

STATE_STANDBY, STATE_ACTIVE = 3, 4
"""MAV_STATE: no flight of ours, and one under way."""

ERROR: Final = "pos_error"
TO_GO: Final = "time_to_go"
LYAPUNOV: Final = "lyapunov"
DISTURBANCE: Final = "disturb"
TRACK_TIME: Final = "track_time"
REFUSED: Final = "refused"


class Reports:
    """Implements `commands.Reporter`.

    Args:
        ports: the ground links.
        vehicle: the way through the autopilot's radio.
        standing: asked for how things stand.
    """

    def __init__(self, ports: list[GroundPort], vehicle: GroundLink, standing: Callable[[], Standing]) -> None:
        self._ports = ports
        self._vehicle = vehicle
        self._standing = standing
        self.refused: Callable[[], int] = lambda: 0
        """Asked for the messages of all links that were not used because of who sent them."""
        self._begun_s = time.monotonic()
        self._text = 0
        self._heartbeat_s = self._ground_s = self._radio_s = -1e9

    def say(self, severity: Severity, text: str) -> None:
        """A text to everybody, the radio included."""
        self._text = self._text % 65535 + 1
        for payload in encode_texts(severity, text, self._text):
            self._everywhere(codec.STATUSTEXT, payload)
            if self._standing().system is not None:
                self._vehicle.send(codec.STATUSTEXT, payload)

    def send_message(self, msgid: int, link: GroundLink) -> bool:
        """HEARTBEAT and AUTOPILOT_VERSION are to be had."""
        if msgid == codec.HEARTBEAT:
            link.send(codec.HEARTBEAT, self.heartbeat())
        elif msgid == codec.AUTOPILOT_VERSION:
            link.send(codec.AUTOPILOT_VERSION, encode_autopilot_version(_version()))
        else:
            return False
        return True

    def tick(self, now_s: float) -> None:
        """Sends what is due."""
        if now_s - self._heartbeat_s >= HEARTBEAT_INTERVAL_S:
            self._heartbeat_s = now_s
            self._everywhere(codec.HEARTBEAT, self.heartbeat())
            since_ms = int((now_s - self._begun_s) * 1e3)
            self._everywhere(NAMED_VALUE_FLOAT, encode_named_value(since_ms, REFUSED, float(self.refused())))
        if not self._standing().flying:
            return
        if now_s - self._ground_s >= GROUND_INTERVAL_S:
            self._ground_s = now_s
            for msgid, payload in self._figures(now_s):
                self._everywhere(msgid, payload)
        if now_s - self._radio_s >= VEHICLE_INTERVAL_S:
            self._radio_s = now_s
            for msgid, payload in self._figures(now_s):
                self._vehicle.send(msgid, payload)

    def beat(self) -> None:
        """The heartbeat at once: something has changed."""
        self._heartbeat_s = -1e9

    def heartbeat(self) -> bytes:
        """HEARTBEAT as it is now."""
        standing = self._standing()
        state = STATE_ACTIVE if standing.flying else STATE_STANDBY
        return codec.encode_heartbeat(custom_mode=standing.custom_code, system_status=state)

    def _figures(self, now_s: float) -> list[tuple[int, bytes]]:
        """The figures of the flight, as far as there are any."""
        standing = self._standing()
        since_s = now_s - self._begun_s
        values = {
            LYAPUNOV: standing.lyapunov,
            TO_GO: standing.to_go_s,
            TRACK_TIME: standing.track_s,
            ERROR: standing.error_m,  # the last one: whoever has it has the others
        }
        found = []
        if standing.disturbance_m_s2 is not None:
            found.append((DEBUG_VECT, encode_debug_vect(int(since_s * 1e6), DISTURBANCE, standing.disturbance_m_s2)))
        return found + [
            (NAMED_VALUE_FLOAT, encode_named_value(int(since_s * 1e3), name, value))
            for name, value in values.items()
            if value is not None
        ]

    def _everywhere(self, msgid: int, payload: bytes) -> None:
        for port in self._ports:
            for peer in port.peers:
                peer.send(msgid, payload)


def _version() -> tuple[int, int, int]:
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    return major, minor, patch
