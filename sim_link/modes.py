"""PX4's flight modes and how MAVLink names them (px4_custom_mode.h: custom_mode = main << 16 | sub << 24)."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

MAIN_MANUAL = 1
MAIN_ALTCTL = 2
MAIN_POSCTL = 3
MAIN_AUTO = 4
MAIN_ACRO = 5
MAIN_OFFBOARD = 6
MAIN_STABILIZED = 7
MAIN_TERMINATION = 10

FLAG_CUSTOM_MODE = 1
FLAG_AUTO = 4
FLAG_GUIDED = 8
FLAG_STABILIZE = 16
FLAG_MANUAL_INPUT = 64
FLAG_ARMED = 128


class _Row(NamedTuple):
    """What there is to know about a mode."""

    label: str
    main: int
    sub: int
    flags: int
    """MAV_MODE_FLAG bits without the armed bit."""
    needs_sticks: bool
    can_arm: bool
    standard: int = 0
    """MAV_STANDARD_MODE; 0: none."""


class Mode(Enum):
    """The modes that this vehicle knows. `can_arm` follows PX4's mode_requirements.cpp."""

    MANUAL = _Row("Manual", MAIN_MANUAL, 0, FLAG_MANUAL_INPUT | FLAG_STABILIZE, True, True)
    ALTITUDE = _Row("Altitude", MAIN_ALTCTL, 0, FLAG_MANUAL_INPUT | FLAG_STABILIZE, True, True, 4)
    POSITION = _Row("Position", MAIN_POSCTL, 0, FLAG_MANUAL_INPUT | FLAG_STABILIZE | FLAG_GUIDED, True, True, 1)
    ACRO = _Row("Acro", MAIN_ACRO, 0, FLAG_MANUAL_INPUT, True, True)
    STABILIZED = _Row("Stabilized", MAIN_STABILIZED, 0, FLAG_MANUAL_INPUT | FLAG_STABILIZE, True, True)
    OFFBOARD = _Row("Offboard", MAIN_OFFBOARD, 0, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, True)
    TAKEOFF = _Row("Takeoff", MAIN_AUTO, 2, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, True, 8)
    HOLD = _Row("Hold", MAIN_AUTO, 3, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, True)
    MISSION = _Row("Mission", MAIN_AUTO, 4, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, True, 6)
    RETURN = _Row("Return", MAIN_AUTO, 5, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, False, 5)
    LAND = _Row("Land", MAIN_AUTO, 6, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, False, 7)
    DESCEND = _Row("Descend", MAIN_AUTO, 20, FLAG_AUTO | FLAG_STABILIZE | FLAG_GUIDED, False, False)
    TERMINATION = _Row("Termination", MAIN_TERMINATION, 0, 0, False, False)

    @property
    def label(self) -> str:
        """The name that a pilot knows the mode by."""
        return self.value.label

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.value.main << 16 | self.value.sub << 24

    @property
    def base_flags(self) -> int:
        """HEARTBEAT.base_mode without the armed bit."""
        return self.value.flags | FLAG_CUSTOM_MODE

    @property
    def needs_sticks(self) -> bool:
        """Whether the mode cannot run without a source of manual control."""
        return self.value.needs_sticks

    @property
    def can_arm(self) -> bool:
        """Whether the vehicle may be armed while it is selected."""
        return self.value.can_arm

    @property
    def needs_estimate(self) -> bool:
        """Whether the mode cannot run without position or height; Offboard needs them for some setpoints only."""
        return self in _WITH_ESTIMATE

    @property
    def standard(self) -> int:
        """MAV_STANDARD_MODE; 0: none."""
        return self.value.standard


_WITH_ESTIMATE = frozenset(
    (Mode.ALTITUDE, Mode.POSITION, Mode.TAKEOFF, Mode.HOLD, Mode.MISSION, Mode.RETURN, Mode.LAND)
)


def available_modes() -> list[Mode]:
    """Give the modes that can be chosen, in the order of AVAILABLE_MODES; the others come by a failsafe only."""
    return [mode for mode in Mode if mode not in (Mode.TERMINATION, Mode.DESCEND)]


def from_base_mode(flags: int) -> Mode | None:
    """Find the mode of a base mode without custom mode, as PX4 does; None when it names none."""
    if flags & FLAG_AUTO:
        return Mode.MISSION
    if not flags & FLAG_MANUAL_INPUT:
        return None
    if flags & FLAG_GUIDED:
        return Mode.POSITION
    return Mode.STABILIZED if flags & FLAG_STABILIZE else Mode.MANUAL


def from_standard_mode(number: int | None) -> Mode | None:
    """Find the mode of a MAV_STANDARD_MODE."""
    return next((mode for mode in Mode if number and mode.standard == number), None)


_BY_NUMBERS = {(mode.value.main, mode.value.sub): mode for mode in Mode if mode is not Mode.DESCEND}


def from_numbers(main: int, sub: int) -> Mode | None:
    """Find the mode that DO_SET_MODE's param2 and param3 name; None when this vehicle has no such mode.

    A sub mode counts only for AUTO; of POSCTL, orbit (1) and slow (2) are not flown here.
    """
    return _BY_NUMBERS.get((main, sub if main in (MAIN_AUTO, MAIN_POSCTL) else 0))


def from_custom_mode(custom_mode: int) -> Mode | None:
    """Find the mode of a packed custom_mode as the SET_MODE message (11) carries it."""
    return from_numbers(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)
