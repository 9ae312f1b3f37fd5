"""How things stand on the vehicle: what the control process tells the ground process several times a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from companion.control.types import Vec3
from companion.flight.phases import PHASE_NAMES

IDLE: Final = "idle"
PREPARING: Final = "prepare"
PHASE_CODES: Final = {name: code for code, name in enumerate((IDLE, *PHASE_NAMES, PREPARING))}
"""The phases as numbers, as they stand in HEARTBEAT.custom_mode of the companion."""

PAUSED_BIT: Final = 1 << 8
VEHICLE_BIT: Final = 1 << 9
ARMED_BIT: Final = 1 << 10
_ID_SHIFT: Final = 16


@dataclass(frozen=True)
class Standing:
    """One look at the vehicle and the flight."""

    system: int | None = None
    """The vehicle's system id; None: none was heard since the start."""
    heard: bool = False
    """Whether the autopilot is being heard now."""
    mode: str | None = None
    """The autopilot's flight mode."""
    custom_mode: int = 0
    """The same as the autopilot's number."""
    armed: bool = False
    phase: str = IDLE
    """Of the flight; "idle" without one, "prepare" while one is being checked and prepared."""
    paused: bool = False
    """Whether the reference is at rest for a pause."""
    trajectory: str = ""
    """What is flown, or was flown last."""
    trajectory_id: int = 0
    track_s: float | None = None
    """Time on the trajectory."""
    duration_s: float | None = None
    to_go_s: float | None = None
    """Of the whole course, at its own pace."""
    error_m: float | None = None
    """Distance to the reference."""
    lyapunov: float | None = None
    disturbance_m_s2: Vec3 | None = None
    """As estimated, NED."""
    steps: int = 0
    ended: str = ""
    """How the last flight ended."""
    refused: dict[str, int] = field(default_factory=dict)
    """Messages of the vehicle link that were not used because of who sent them, by reason, since the start."""

    @property
    def flying(self) -> bool:
        """Whether a flight is under way."""
        return self.phase not in {IDLE, PREPARING}

    @property
    def custom_code(self) -> int:
        """HEARTBEAT.custom_mode of the companion: phase, flags, and the trajectory's id."""
        flags = PAUSED_BIT * self.paused | VEHICLE_BIT * self.heard | ARMED_BIT * self.armed
        return PHASE_CODES.get(self.phase, 0) | flags | (self.trajectory_id & 0xFFFF) << _ID_SHIFT

    def as_note(self) -> dict[str, Any]:
        """As the content of a note."""
        return asdict(self)

    @classmethod
    def from_note(cls, content: Mapping[str, Any]) -> Standing:
        """Reads `as_note` again. Raises TypeError when it is none."""
        known = dict(content)
        disturbance = known.get("disturbance_m_s2")
        if disturbance is not None:
            north, east, down = disturbance
            known["disturbance_m_s2"] = (float(north), float(east), float(down))
        return cls(**known)


def phase_of_code(code: int) -> str:
    """The phase in a companion's HEARTBEAT.custom_mode; "unknown" for one of a newer version."""
    wanted = code & 0xFF
    return next((name for name, number in PHASE_CODES.items() if number == wanted), "unknown")


def trajectory_of_code(code: int) -> int:
    """The trajectory's id in a companion's HEARTBEAT.custom_mode."""
    return code >> _ID_SHIFT & 0xFFFF
