"""What stands in the way of arming."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .failsafe import Action, fence_action
from .modes import Mode

if TYPE_CHECKING:
    from .autopilot import Autopilot


def arming_obstacle(autopilot: Autopilot) -> str | None:
    """Give the reason why arming is denied; None when it is not."""
    if autopilot.terminated:
        return "flight is terminated"
    if autopilot.parameters.integer("COM_ARMABLE") == 0:
        return "COM_ARMABLE is 0"
    if not autopilot.intended.can_arm:
        return f"mode {autopilot.intended.label} prevents it, switch to another one first"
    if not autopilot.estimate_ok:
        return "no valid attitude and position estimate"
    if autopilot.intended is Mode.OFFBOARD and not autopilot.offboard_ok:
        return "no offboard signal"
    if autopilot.intended is Mode.MISSION and not autopilot.guidance.mission.can_run:
        return "no valid mission"
    if autopilot.intended.needs_sticks and not autopilot.sticks_ok:
        return "no manual control input"
    if not autopilot.ground_ok:
        return "no connection to the ground control station"
    if autopilot.breach is not None and fence_action(autopilot.parameters) is not Action.NONE:
        return f"geofence violation, {autopilot.breach}"
    if autopilot.battery_charge > 1:
        return "low battery"
    return None
