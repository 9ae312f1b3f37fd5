"""PX4's flight modes as numbers and names (px4_custom_mode.h): only the ones that this program asks for or meets.

HEARTBEAT.custom_mode holds main mode << 16 | sub mode << 24. MAV_CMD_DO_SET_MODE takes the two separately.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple


class MainMode(IntEnum):
    """PX4_CUSTOM_MAIN_MODE."""

    MANUAL = 1
    ALTITUDE = 2
    POSITION = 3
    AUTO = 4
    ACRO = 5
    OFFBOARD = 6
    STABILIZED = 7
    TERMINATION = 10


class AutoMode(IntEnum):
    """PX4_CUSTOM_SUB_MODE_AUTO; 0 stands for no sub mode."""

    NONE = 0
    READY = 1
    TAKEOFF = 2
    HOLD = 3
    """PX4 calls it LOITER."""
    MISSION = 4
    RETURN = 5
    """PX4 calls it RTL."""
    LAND = 6
    DESCEND = 20


class Mode(NamedTuple):
    """A flight mode; compares equal by its two numbers."""

    main: int
    sub: int = 0

    @classmethod
    def from_custom_mode(cls, custom_mode: int) -> Mode:
        """Unpack HEARTBEAT.custom_mode."""
        return cls(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)

    @property
    def custom_mode(self) -> int:
        """The packed number, as in HEARTBEAT.custom_mode."""
        return self.main << 16 | self.sub << 24

    @property
    def label(self) -> str:
        """What ground stations call it; "mode 4/19" for one that we do not know."""
        return _LABELS.get(self) or f"mode {self.main}/{self.sub}"


MANUAL: Final = Mode(MainMode.MANUAL)
ALTITUDE: Final = Mode(MainMode.ALTITUDE)
POSITION: Final = Mode(MainMode.POSITION)
ACRO: Final = Mode(MainMode.ACRO)
STABILIZED: Final = Mode(MainMode.STABILIZED)
OFFBOARD: Final = Mode(MainMode.OFFBOARD)
TERMINATION: Final = Mode(MainMode.TERMINATION)
READY: Final = Mode(MainMode.AUTO, AutoMode.READY)
TAKEOFF: Final = Mode(MainMode.AUTO, AutoMode.TAKEOFF)
HOLD: Final = Mode(MainMode.AUTO, AutoMode.HOLD)
MISSION: Final = Mode(MainMode.AUTO, AutoMode.MISSION)
RETURN: Final = Mode(MainMode.AUTO, AutoMode.RETURN)
LAND: Final = Mode(MainMode.AUTO, AutoMode.LAND)
DESCEND: Final = Mode(MainMode.AUTO, AutoMode.DESCEND)

_LABELS: Final = {
    MANUAL: "Manual",
    ALTITUDE: "Altitude",
    POSITION: "Position",
    ACRO: "Acro",
    STABILIZED: "Stabilized",
    OFFBOARD: "Offboard",
    TERMINATION: "Termination",
    READY: "Ready",
    TAKEOFF: "Takeoff",
    HOLD: "Hold",
    MISSION: "Mission",
    RETURN: "Return",
    LAND: "Land",
    DESCEND: "Descend",
}
