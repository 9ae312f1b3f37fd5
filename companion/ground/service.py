"""What the ground process hosts: services that take MAVLink frames of ground tools and answer them.

The interface is all that a service knows of sockets and processes. Every call comes from one thread, so a service
needs no locks, and none may block: what takes longer is done in parts from `tick`. Times are monotonic wall time.
"""

from __future__ import annotations

from typing import Protocol

from companion.link.framing import Frame


class GroundLink(Protocol):
    """One way to a ground tool: the link that a frame came on. Two frames with the same `name` came the same way."""

    @property
    def name(self) -> str:
        """The connection as people write it, like "udpin:127.0.0.1:14590"; "vehicle" for the autopilot's radio."""
        ...

    def send(self, msgid: int, payload: bytes) -> None:
        """Sends one message as the companion (component 191 of the vehicle's system); never blocks, may be lost."""
        ...


class Service(Protocol):
    """One thing that ground tools can use: files, parameters, commands."""

    def handle(self, frame: Frame, link: GroundLink, now_s: float) -> bool:
        """Takes a frame that came from a ground tool, if it is for this service.

        Only frames that are addressed to the companion or to everybody arrive here; those that a service decodes have
        targets of their own, which it checks no more.

        Args:
            frame: a checked frame; its payload may come from anybody, and hold anything.
            link: where it came from, and where the answer goes; a service may keep it for later messages.
            now_s: monotonic wall time [s].

        Returns:
            Whether the frame was for this service; then no other gets it.
        """
        ...

    def tick(self, now_s: float) -> None:
        """Lets time pass: called at least every 20 ms, and must return within a few milliseconds."""
        ...
