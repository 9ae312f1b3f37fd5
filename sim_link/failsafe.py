"""What the vehicle does when something that its flight needs is gone (PX4: commander/failsafe/failsafe.cpp).

A failsafe never changes what the pilot or the companion asked for: it lasts as long as its cause, and then the mode
that was asked for comes back by itself.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from .modes import Mode
from .parameters import Parameters

EXCEPT_OFFBOARD = 1 << 2
EXCEPT_HOLD = 1 << 1
EXCEPT_MISSION = 1 << 0


class Action(Enum):
    """What a failsafe does; the value is the mode that it flies, None where it flies none."""

    NONE = (None, "no action")
    POSITION = (Mode.POSITION, "Position")
    ALTITUDE = (Mode.ALTITUDE, "Altitude")
    STABILIZED = (Mode.STABILIZED, "Stabilized")
    HOLD = (Mode.HOLD, "Hold")
    RETURN = (Mode.RETURN, "Return")
    LAND = (Mode.LAND, "Land")
    DESCEND = (Mode.DESCEND, "Descend")
    TERMINATE = (Mode.TERMINATION, "Termination")
    DISARM = (None, "Disarm")

    @property
    def mode(self) -> Mode | None:
        """The mode that the action flies."""
        mode: Mode | None = self.value[0]
        return mode

    @property
    def label(self) -> str:
        """The action's name for people."""
        return str(self.value[1])


class Cause(Enum):
    """Why a failsafe acts; the value is the sentence for people."""

    OFFBOARD_LOST = "Offboard signal lost"
    STICKS_LOST = "Manual control signal lost"
    GROUND_LOST = "Ground station connection lost"
    FENCE = "Geofence violation"
    BATTERY = "Battery low"
    ESTIMATE_LOST = "Position estimate lost"


class Decision(NamedTuple):
    """The action in charge, and why."""

    action: Action
    cause: Cause


class Health(NamedTuple):
    """What the failsafe looks at."""

    offboard_ok: bool
    sticks_ok: bool
    """A source of manual control is there."""
    sticks_at_arming: bool
    ground_ok: bool
    """A ground station's heartbeat is there."""
    fence_ok: bool = True
    """The vehicle is within the geofence, or the pilot has overruled it."""
    battery: int = 1
    """MAV_BATTERY_CHARGE_STATE."""


# COM_OBL_RC_ACT. The first three need sticks.
_OFFBOARD_LOSS = {
    0: Action.POSITION,
    1: Action.ALTITUDE,
    2: Action.STABILIZED,
    3: Action.RETURN,
    4: Action.LAND,
    5: Action.HOLD,
    6: Action.TERMINATE,
    7: Action.DISARM,
}
# NAV_RCL_ACT and NAV_DLL_ACT; 0 is "disabled", and NAV_RCL_ACT's 7 "Hold, no failsafe" gives no action here either.
_LINK_LOSS = {1: Action.HOLD, 2: Action.RETURN, 3: Action.LAND, 5: Action.TERMINATE, 6: Action.DISARM}
# GF_ACTION: 0 none, 1 a warning.
_FENCE = {2: Action.HOLD, 3: Action.RETURN, 4: Action.TERMINATE, 5: Action.LAND}
BATTERY_CRITICAL, BATTERY_EMERGENCY = 3, 4
_SEVERITY = (
    Action.NONE,
    Action.POSITION,
    Action.ALTITUDE,
    Action.STABILIZED,
    Action.HOLD,
    Action.RETURN,
    Action.LAND,
    Action.DESCEND,
    Action.DISARM,
    Action.TERMINATE,
)
"""Of several failsafes the one with the gravest action acts."""
_STICK_ACTIONS = (Action.POSITION, Action.ALTITUDE, Action.STABILIZED)


def offboard_loss_action(parameters: Parameters, sticks_ok: bool) -> Action:
    """Give the action for a lost offboard signal.

    A stick mode without sticks is replaced by NAV_RCL_ACT's action. When that one is none (0 or 7), NOTHING happens:
    the vehicle stays in OFFBOARD and holds its last setpoint. That hole is PX4's, and companions must know of it.
    """
    action = _OFFBOARD_LOSS.get(parameters.integer("COM_OBL_RC_ACT"), Action.NONE)
    if action in _STICK_ACTIONS and not sticks_ok:
        return _LINK_LOSS.get(parameters.integer("NAV_RCL_ACT"), Action.NONE)
    return action


def fence_action(parameters: Parameters) -> Action:
    """Give GF_ACTION's action."""
    return _FENCE.get(parameters.integer("GF_ACTION"), Action.NONE)


def battery_action(parameters: Parameters, charge: int) -> Action:
    """Give COM_LOW_BAT_ACT's action: 2 lands when critical, 3 returns when critical and lands in an emergency."""
    act = parameters.integer("COM_LOW_BAT_ACT")
    if act == 2 and charge >= BATTERY_CRITICAL:
        return Action.LAND
    if act == 3 and charge == BATTERY_CRITICAL:
        return Action.RETURN
    return Action.LAND if act == 3 and charge >= BATTERY_EMERGENCY else Action.NONE


def decide(intended: Mode, health: Health, parameters: Parameters) -> Decision | None:
    """Give the failsafe for an armed vehicle in the mode it was asked to fly; None when nothing is lost."""
    if intended is Mode.TERMINATION:
        return None
    decision = _link_decision(intended, health, parameters)
    fence = Action.NONE if health.fence_ok else fence_action(parameters)
    battery = battery_action(parameters, health.battery)
    if intended is Mode.LAND and battery is Action.RETURN:
        battery = Action.NONE
    for action, cause in ((fence, Cause.FENCE), (battery, Cause.BATTERY)):
        graver = decision is None or _SEVERITY.index(action) > _SEVERITY.index(decision.action)
        if action is not Action.NONE and graver:
            decision = Decision(action, cause)
    return decision


def without_estimate(intended: Mode, decision: Decision | None, sticks_ok: bool) -> Decision | None:
    """Replace what cannot be flown without an estimate of position and height by the next mode that can.

    Position and Altitude fall back to Stabilized, as long as there are sticks. Every other mode falls back to Return,
    Land and Descend (failsafe.cpp, checkModeFallback), of which only Descend can run: level, going down.
    """
    acts = decision is not None and decision.action is not Action.NONE
    flown = decision.action.mode if decision is not None and acts else intended
    if flown is None or not flown.needs_estimate:
        return decision
    cause = decision.cause if decision is not None and acts else Cause.ESTIMATE_LOST
    by_hand = sticks_ok and flown in (Mode.POSITION, Mode.ALTITUDE)
    return Decision(Action.STABILIZED if by_hand else Action.DESCEND, cause)


def _link_decision(intended: Mode, health: Health, parameters: Parameters) -> Decision | None:
    """Give the failsafe for a lost link."""
    if intended is Mode.OFFBOARD and not health.offboard_ok:
        return Decision(offboard_loss_action(parameters, health.sticks_ok), Cause.OFFBOARD_LOST)
    # A stick mode needs its sticks; the others lose them only if they were there at arming.
    sticks_lost = not health.sticks_ok and (health.sticks_at_arming or intended.needs_sticks)
    if sticks_lost and not _excepted(intended, parameters.integer("COM_RCL_EXCEPT")):
        action = _LINK_LOSS.get(parameters.integer("NAV_RCL_ACT"), Action.NONE)
        return Decision(action, Cause.STICKS_LOST)
    if not health.ground_ok and not _excepted(intended, parameters.integer("COM_DLL_EXCEPT")):
        action = _LINK_LOSS.get(parameters.integer("NAV_DLL_ACT"), Action.NONE)
        if action is not Action.NONE:
            return Decision(action, Cause.GROUND_LOST)
    return None


def _excepted(intended: Mode, mask: int) -> bool:
    """Tell whether COM_RCL_EXCEPT or COM_DLL_EXCEPT lets the mode fly on without its link."""
    bit = {Mode.MISSION: EXCEPT_MISSION, Mode.HOLD: EXCEPT_HOLD, Mode.OFFBOARD: EXCEPT_OFFBOARD}.get(intended, 0)
    return bool(mask & bit)
