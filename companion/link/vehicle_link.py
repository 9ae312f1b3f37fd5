"""How the vehicle is reached, as it is handed to other processes: connection, key file, and which system it is."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from companion.errors import InputError
from companion.link.key_file import load_key
from companion.link.transport import parse_connection
from companion.link.wire import Tap, Wire

DEFAULT_CONNECTION = "udpin:127.0.0.1:14540"


@dataclass(frozen=True)
class VehicleLink:
    """The link to the autopilot."""

    connection: str = DEFAULT_CONNECTION
    """`udpin:HOST:PORT`, `udpout:HOST:PORT` or `serial:DEVICE:BAUD`."""
    key: str | None = None
    """File with the key that messages are signed with; only its path is ever passed on."""
    system: int | None = None
    """System id of the only autopilot that is listened to; None: the first one that is heard."""

    def check(self) -> None:
        """Checks what can be checked before anything connects.

        Raises:
            InputError: the connection string or the key file cannot be used.
        """
        parse_connection(self.connection)
        if self.system is not None and not 1 <= self.system <= 255:
            raise InputError(f"--system {self.system}: must be 1 to 255")
        if self.key is not None:
            load_key(self.key)

    def open(self, tap: Tap | None = None) -> Wire:
        """Opens it; raises as `Wire.open`."""
        return Wire.open(self.connection, tap=tap, key=self.key, only_system=self.system)

    def as_json(self) -> str:
        """For a command line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> VehicleLink:
        """Reads `as_json` again."""
        return cls(**json.loads(text))
