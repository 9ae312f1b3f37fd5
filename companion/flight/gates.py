"""The table of gates between connecting and flying: pure functions from what was read and measured to what is found.

`companion doctor` prints what they find; a flight (`fly`, `demo`, `serve`) is refused by the very same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from companion.flight import gates_setup as setup
from companion.flight import gates_state as state
from companion.flight.findings import Finding, Gate, Measured, passed, refused, warning
from companion.flight.phases import LandedState
from companion.link import modes

BATTERY_MIN: Final = 0.15
"""BAT_LOW_THR where it is not known."""
BATTERY_WANTED: Final = 0.3
MAV_STATE_TERMINATED: Final = 8
FENCE_ACTIONS: Final = {0: "no action", 1: "a warning", 2: "Hold", 3: "Return", 4: "termination", 5: "Land"}
DOWN: Final = {modes.LAND, modes.RETURN, modes.DESCEND}
"""Modes that somebody chose to get the vehicle down. PX4 does not arm in them, but a take-off leaves them."""


def battery(m: Measured) -> Finding:
    """There is charge to fly with."""
    gate, health = Gate.BATTERY, m.autopilot.health
    left = None if health is None else health.battery
    told = m.parameter("BAT_LOW_THR")
    least = BATTERY_MIN if told is None else told
    limit = f"above {least:.0%}, {BATTERY_WANTED:.0%} wanted"
    if left is None:
        sentence = "the charge of the battery is not known"
        if m.flight.vehicle.simulated:
            return passed(gate, "unknown", limit, sentence)
        return warning(gate, "unknown", limit, sentence, "measure it, and fly short")
    shown = f"{left:.0%}"
    if left <= least:
        return refused(gate, shown, limit, f"the battery has {shown} left", "charge it")
    if left < BATTERY_WANTED:
        return warning(gate, shown, limit, f"the battery has {shown} left", "fly short, or charge it")
    return passed(gate, shown, limit, f"the battery has {shown} left")


def fence(m: Measured) -> Finding:
    """The vehicle is within the autopilot's fence."""
    gate, health, told = Gate.FENCE, m.autopilot.health, m.parameter("GF_ACTION")
    action = None if told is None else FENCE_ACTIONS.get(int(told), f"action {told:g}")
    wide, high = m.parameter("GF_MAX_HOR_DIST") or 0.0, m.parameter("GF_MAX_VER_DIST") or 0.0
    sizes = [f"{size:g} m {name}" for size, name in ((wide, "wide"), (high, "high")) if size > 0.0]
    shown = f"GF_ACTION {'unknown' if action is None else action}" + (f", {', '.join(sizes)}" if sizes else "")
    limit = "within it"
    if health is not None and health.fence_kept is False:
        sentence = "the vehicle is outside of the autopilot's fence"
        if action in {"no action", "a warning"}:
            return warning(gate, shown, limit, sentence, "bring it back, or change the fence")
        return refused(gate, shown, limit, sentence, "bring it back, or change the fence: it would end the flight")
    if action == "termination":
        sentence = "leaving the autopilot's fence stops the motors in the air"
        return warning(gate, shown, limit, sentence, "set GF_ACTION to 2 (Hold) unless this is meant")
    return passed(gate, shown, limit, "the vehicle is within the autopilot's fence, or there is none")


def landed_state(m: Measured) -> Finding:
    """Whether it stands or flies is known: that decides whether it takes off."""
    gate, landed = Gate.LANDED_STATE, m.autopilot.landed
    limit = "known"
    if landed is LandedState.UNDEFINED:
        sentence = "the autopilot does not say whether it stands on the ground or flies"
        return refused(gate, "unknown", limit, sentence, "check that the link carries EXTENDED_SYS_STATE")
    where = "stands on the ground" if landed is LandedState.ON_GROUND else "is in the air"
    return passed(gate, landed.name.lower().replace("_", " "), limit, f"the vehicle {where}")


def mode(m: Measured) -> Finding:
    """The vehicle may be taken over from what it does now."""
    gate, autopilot = Gate.MODE, m.autopilot
    now, wanted, limit = autopilot.mode, autopilot.intended, "Hold, or on the ground"
    if now is None:
        return refused(gate, "unknown", limit, "the autopilot does not tell its mode", "check the link")
    if now == modes.TERMINATION or autopilot.system_status == MAV_STATE_TERMINATED:
        return refused(gate, now.label, limit, "the flight was terminated", "restart the autopilot")
    if not autopilot.armed or autopilot.landed is LandedState.ON_GROUND:
        return passed(gate, now.label, limit, f"the vehicle is in {now.label} on the ground")
    failsafe = wanted is not None and wanted.main != 0 and wanted != now  # 0: it does not tell
    if failsafe and wanted != modes.OFFBOARD:
        sentence = f"a failsafe of the autopilot flies {now.label} instead of {wanted.label if wanted else '-'}"
        return refused(gate, now.label, limit, sentence, "find out why, and let it end first")
    if failsafe:  # a companion has died before; its successor may take the vehicle back when told to
        sentence = f"setpoints have ceased before: a failsafe flies {now.label}"
        return warning(gate, now.label, limit, sentence, "Hold will be asked for first")
    if now in DOWN:
        sentence = f"the vehicle is in {now.label}: somebody wanted it down"
        return warning(gate, now.label, limit, sentence, "Hold will be asked for first")
    if now != modes.HOLD:
        return warning(gate, now.label, limit, f"the vehicle flies {now.label}", "Hold will be asked for first")
    return passed(gate, now.label, limit, "the vehicle holds in the air")


def arming(m: Measured) -> Finding:
    """The autopilot would arm."""
    gate, autopilot, limit = Gate.ARMING, m.autopilot, "ready, or armed"
    health = autopilot.health
    if autopilot.armed:
        return passed(gate, "armed", limit, "the vehicle is armed")
    if health is None:
        return warning(gate, "unknown", limit, "the autopilot does not tell whether it would arm", "see when it arms")
    if health.can_arm:
        return passed(gate, "ready", limit, "the autopilot would arm")
    if autopilot.mode is not None and autopilot.mode in DOWN:
        sentence = f"arming is not possible in {autopilot.mode.label}: take-off leaves it"
        return passed(gate, "not yet", limit, sentence)
    why = "; ".join(m.complaints) or "it does not say why"
    return refused(gate, "not ready", limit, f"the autopilot would not arm: {why}", "put that right first")


GATES: Final[dict[Gate, Callable[[Measured], Finding]]] = {
    Gate.CALIBRATION: setup.calibration,
    Gate.PARAMETERS: setup.parameters,
    Gate.VERSION: setup.version,
    Gate.OUTPUT: setup.output,
    Gate.SETPOINTS: setup.setpoints,
    Gate.VEHICLE_TYPE: setup.vehicle_type,
    Gate.LOSS_TIME: setup.loss_time,
    Gate.LOSS_ACTION: setup.loss_action,
    Gate.PILOT: setup.pilot,
    Gate.GROUND_LINK: setup.ground_link,
    Gate.TERMINATION: setup.termination,
    Gate.THRUST_CURVE: setup.thrust_curve,
    Gate.THRUST_SCALING: setup.thrust_scaling,
    Gate.HOVER_THRUST: setup.hover_thrust,
    Gate.STATE_RATE: state.state_rate,
    Gate.STATE_AGE: state.state_age,
    Gate.STATE_JITTER: state.state_jitter,
    Gate.STATE_GAPS: state.state_gaps,
    Gate.STATE_SOUND: state.state_sound,
    Gate.ROUND_TRIP: state.round_trip,
    Gate.CLOCK: state.clock,
    Gate.ESTIMATOR: state.estimator,
    Gate.ESTIMATOR_TESTS: state.estimator_tests,
    Gate.ESTIMATOR_ACCURACY: state.estimator_accuracy,
    Gate.ESTIMATOR_RESETS: state.estimator_resets,
    Gate.BATTERY: battery,
    Gate.FENCE: fence,
    Gate.LANDED_STATE: landed_state,
    Gate.MODE: mode,
    Gate.ARMING: arming,
}


def judge(measured: Measured) -> list[Finding]:
    """What every gate finds."""
    return [gate(measured) for gate in GATES.values()]
