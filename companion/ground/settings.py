"""What `companion serve` was told, as its processes hand it on: one JSON document."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from typing import Any, Final

from companion.link.vehicle_link import VehicleLink

GROUND_SYSTEMS: Final = (245, 254, 255)
"""Who may use the companion by default: MAVSDK, our own tools, QGroundControl and MAVProxy."""


@dataclass(frozen=True)
class Settings:
    """The whole configuration of `companion serve`."""

    connection: str
    """Of the vehicle link."""
    ground: tuple[str, ...]
    """The ground links."""
    trajectories: str
    """Folder of the trajectories that may be started."""
    flights: str
    """Folder that gets a folder per flight."""
    engine: str
    """"auto", "python" or "numba"."""
    realtime: bool = False
    """Whether the control process asks the system for what `companion.realtime` names."""
    reports: bool = True
    """Whether a flight's report.html is built when the flight is over."""
    flight: dict[str, Any] = field(default_factory=dict)
    """Contents of a flight file but for name and trajectory: the vehicle as a table, output, take-off height, ..."""
    key: str | None = None
    """File with the key of the vehicle link."""
    system: int | None = None
    """System id of the only autopilot that is listened to; None: the first one that is heard."""
    ground_keys: tuple[str | None, ...] = ()
    """File with the key of each ground link; none where there are fewer."""
    ground_systems: tuple[int, ...] = GROUND_SYSTEMS
    """System ids of the ground tools that may use the companion, by a ground link or through the autopilot's radio."""
    again: bool = False
    """Told by the supervisor: the process has worked before and was started again. What it could have then and cannot
    have now is away for a while and not mistyped."""

    @property
    def link(self) -> VehicleLink:
        """The vehicle link."""
        return VehicleLink(self.connection, self.key, self.system)

    @property
    def ground_links(self) -> tuple[tuple[str, str | None], ...]:
        """Connection and key file of each ground link."""
        return tuple(zip_longest(self.ground, self.ground_keys[: len(self.ground)]))

    def as_json(self) -> str:
        """For a command line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Settings:
        """Reads `as_json` again."""
        content = json.loads(text)
        for name in ("ground", "ground_keys", "ground_systems"):
            content[name] = tuple(content[name])
        return cls(**content)
