"""What a process of `companion serve` tells its supervisor."""

from __future__ import annotations

from companion.flight.process import Status


class Report(Status):
    """To the supervisor; knows when that is gone."""

    @property
    def closed(self) -> bool:
        """Whether the supervisor is gone."""
        try:
            return self._channel.recv(1) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True
