"""What PX4 does when this companion falls silent, by its parameters (PX4: commander/failsafe/failsafe.cpp)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple


class Reaction(Enum):
    """What PX4 does; the value is the phrase for people."""

    POSITION = "changes to Position, under the pilot's sticks"
    ALTITUDE = "changes to Altitude, under the pilot's sticks"
    STABILIZED = "changes to Stabilized, under the pilot's sticks"
    RETURN = "changes to Return"
    LAND = "changes to Land, where it is"
    HOLD = "changes to Hold"
    TERMINATE = "terminates the flight: the motors stop in the air"
    DISARM = "disarms: the motors stop in the air"
    NOTHING = "goes on with the last setpoint for good"
    UNKNOWN = "does something that this program does not know"

    @property
    def by_hand(self) -> bool:
        """Whether a pilot must take over."""
        return self in {Reaction.POSITION, Reaction.ALTITUDE, Reaction.STABILIZED}

    @property
    def falls(self) -> bool:
        """Whether the vehicle falls."""
        return self in {Reaction.TERMINATE, Reaction.DISARM}


_ON_LOSS = {
    0: Reaction.POSITION,
    1: Reaction.ALTITUDE,
    2: Reaction.STABILIZED,
    3: Reaction.RETURN,
    4: Reaction.LAND,
    5: Reaction.HOLD,
    6: Reaction.TERMINATE,
    7: Reaction.DISARM,
}
"""COM_OBL_RC_ACT."""
_WITHOUT_STICKS = {
    0: Reaction.NOTHING,
    1: Reaction.HOLD,
    2: Reaction.RETURN,
    3: Reaction.LAND,
    5: Reaction.TERMINATE,
    6: Reaction.DISARM,
    7: Reaction.NOTHING,
}
"""NAV_RCL_ACT, which acts instead of the first three of COM_OBL_RC_ACT when there is no manual control."""


class Silence(NamedTuple):
    """What becomes of a flight when setpoints cease."""

    reaction: Reaction
    without_sticks: Reaction
    """The same when manual control is lost as well."""
    sentence: str


def when_silent(parameters: Mapping[str, float], *, sticks: bool) -> Silence:
    """What the autopilot will do.

    Args:
        parameters: COM_OBL_RC_ACT, COM_OF_LOSS_T, NAV_RCL_ACT, RTL_RETURN_ALT, as far as they are known.
        sticks: whether manual control is live.
    """
    reaction = _ON_LOSS.get(_whole(parameters, "COM_OBL_RC_ACT"), Reaction.UNKNOWN)
    fallback = _WITHOUT_STICKS.get(_whole(parameters, "NAV_RCL_ACT"), Reaction.UNKNOWN)
    without = fallback if reaction.by_hand else reaction
    acts = reaction if sticks else without
    phrase = acts.value
    if acts is Reaction.RETURN and "RTL_RETURN_ALT" in parameters:
        phrase += f", climbing to {parameters['RTL_RETURN_ALT']:g} m above home where it is lower"
    loss_s = parameters.get("COM_OF_LOSS_T")
    after = "the time of COM_OF_LOSS_T" if loss_s is None else f"{loss_s:g} s"
    back = "" if acts is Reaction.NOTHING or acts.falls else ", until setpoints come again"
    return Silence(
        acts, without, f"when this companion falls silent PX4 keeps the last setpoint for {after}, then {phrase}{back}"
    )


def _whole(parameters: Mapping[str, float], name: str) -> int:
    value = parameters.get(name)
    return -1 if value is None else int(value)
