"""What `companion serve` was told, as its processes hand it on: one JSON document."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Settings:
    """The whole configuration of `companion serve`."""

    connection: str
    """The vehicle link."""
    ground: tuple[str, ...]
    """The ground links."""
    trajectories: str
    """Folder of the trajectories that may be started."""
    flights: str
    """Folder that gets a folder per flight."""
    engine: str
    """"auto", "python" or "numba"."""
    reports: bool = True
    """Whether a flight's report.html is built when the flight is over."""
    flight: dict[str, Any] = field(default_factory=dict)
    """Contents of a flight file but for name and trajectory: the vehicle as a table, output, take-off height, ..."""

    def as_json(self) -> str:
        """For a command line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Settings:
        """Reads `as_json` again."""
        content = json.loads(text)
        content["ground"] = tuple(content["ground"])
        return cls(**content)
