"""Gates of how the autopilot is set up: version, parameters, what it does when setpoints cease, its thrust."""

from __future__ import annotations

from datetime import UTC, date, datetime
from math import degrees, isfinite
from typing import Final

from companion.config import Flight
from companion.control.output import thrust_fraction
from companion.control.types import GRAVITY_M_S2
from companion.flight.findings import Finding, Gate, Measured, passed, refused, warning
from companion.flight.silence import when_silent

NEEDED: Final = ("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NAV_RCL_ACT", "MAV_TYPE")
"""What the gates and the loop's own silence go by: a flight must know them."""

LOSS_TIME_MAX_S: Final = 1.0
LOSS_TIME_WANTED_S: Final = 0.5
"""PX4 holds the last body rates for so long when the companion dies."""
VERSION_MIN: Final = (1, 13, 0)
MAV_TYPES: Final = {2: "quadrotor", 3: "coaxial", 4: "helicopter", 13: "hexarotor", 14: "octorotor", 15: "tricopter"}
"""Whose thrust PX4 takes from SET_ATTITUDE_TARGET."""
VTOL_TYPES: Final = range(19, 26)
SET_ATTITUDE_TARGET: Final = 1 << 6  # MAV_PROTOCOL_CAPABILITY, as the next one
SET_POSITION_TARGET: Final = 1 << 7
HOVER_TOLERANCE: Final = 0.25
TERMINATION_OFF: Final = 121212.0
OVERRIDE_IN_OFFBOARD: Final = 2
"""Bit of COM_RC_OVERRIDE, before PX4 1.18."""
EXCEPT_OFFBOARD: Final = 4
"""Bit of COM_DLL_EXCEPT."""
CALIBRATION_DAYS: Final = 180
"""Older, propellers and batteries have aged with it."""
STICKS_DISABLED: Final = 4.0
"""COM_RC_IN_MODE."""


def calibrated(flight: Flight, today: date) -> Finding:
    """The law flies with numbers that were found on this vehicle, or on a simulator."""
    gate, limit = Gate.CALIBRATION, "[calibration] in the vehicle file, or a simulator"
    vehicle = flight.vehicle
    record = vehicle.calibration
    if flight.output.controller != "law":
        return passed(gate, "not needed", limit, "nothing that flies needs the vehicle file's model")
    if record is None and vehicle.simulated:
        return passed(gate, "a simulator", limit, "the vehicle file says that this is a simulator")
    if record is None:
        sentence = f"vehicle {vehicle.name!r} was never calibrated: its file has no [calibration]"
        fix = "fly `companion calibrate`, or say that this is a simulator: simulated = true, or --simulator"
        return refused(gate, "none", limit, sentence, fix)
    days = record.days_old(today)
    if days < -1:
        sentence = f"the calibration is of {record.date}, which has not come yet"
        return warning(gate, record.date, limit, sentence, "set this machine's clock, or look at the file")
    if days > CALIBRATION_DAYS:
        return warning(
            gate, record.date, limit, f"the calibration is {days} days old", "fly `companion calibrate` again"
        )
    return passed(gate, record.date, limit, f"the vehicle was calibrated on {record.date}")


def calibration(m: Measured) -> Finding:
    """The same, today."""
    return calibrated(m.flight, datetime.now(UTC).date())


def parameters(m: Measured) -> Finding:
    """Those that decide about a flight were read."""
    gate, limit = Gate.PARAMETERS, ", ".join(NEEDED)
    known = f"{len(m.autopilot.parameters)} read"
    if m.unread:
        sentence = next(iter(m.unread.values()))
        return refused(gate, known, limit, sentence, "a flight must know it: check that the link carries both ways")
    return passed(gate, known, limit, "the parameters that decide about a flight are known")


def version(m: Measured) -> Finding:
    """The autopilot's software is one that this program knows."""
    gate, limit = Gate.VERSION, "1.13 or newer"
    found = m.version
    if found is None or found.version == (0, 0, 0):
        sentence = "the autopilot does not tell its version"
        if m.flight.vehicle.simulated:
            return passed(gate, "unknown", limit, sentence)
        return warning(gate, "unknown", limit, sentence, "find out which PX4 this is")
    if found.version < VERSION_MIN:
        sentence = f"PX4 {found.label} is older than this program knows"
        return warning(gate, found.label, limit, sentence, "update the autopilot, or try everything without propellers")
    return passed(gate, found.label, limit, f"the autopilot is PX4 {found.label}")


def output(m: Measured) -> Finding:
    """The autopilot takes the setpoints that will be sent."""
    gate, sends, found = Gate.OUTPUT, m.flight.output.sends, m.version
    if sends == "actuators":
        limit = "before 1.14"
        if found is not None and found.accepts_actuator_control:
            return passed(gate, sends, limit, "this PX4 takes SET_ACTUATOR_CONTROL_TARGET")
        label = "an unknown version" if found is None else f"version {found.label}"
        sentence = f"output actuators: the autopilot is {label}, and PX4 ignores SET_ACTUATOR_CONTROL_TARGET since 1.14"
        return refused(gate, sends, limit, sentence, "use output rates")
    name, bit = ("SET_ATTITUDE_TARGET", SET_ATTITUDE_TARGET)
    if sends == "position":
        name, bit = ("SET_POSITION_TARGET_LOCAL_NED", SET_POSITION_TARGET)
    if found is not None and found.capabilities and not found.capabilities & bit:
        sentence = f"the autopilot says that it does not take {name}"
        return refused(gate, sends, name, sentence, "use an autopilot that does: PX4 with offboard control")
    return passed(gate, sends, name, f"the autopilot takes {name}")


def setpoints(m: Measured) -> Finding:
    """PX4 listens to setpoints from outside."""
    gate, value = Gate.SETPOINTS, m.parameter("MAV_FWDEXTSP")
    shown = "MAV_FWDEXTSP " + ("unknown" if value is None else f"{value:g}")
    if value == 0.0:
        sentence = "parameter MAV_FWDEXTSP is 0: PX4 does not listen to setpoints"
        return refused(gate, shown, "1", sentence, "set MAV_FWDEXTSP to 1")
    return passed(gate, shown, "1", "PX4 listens to setpoints")


def vehicle_type(m: Measured) -> Finding:
    """PX4 takes the thrust of an attitude setpoint only for some types of vehicle, and else as zero."""
    gate, value = Gate.VEHICLE_TYPE, m.parameter("MAV_TYPE")
    limit = "2, 3, 4, 13, 14, 15 or a VTOL"
    if value is None:
        return warning(gate, "MAV_TYPE unknown", limit, "parameter MAV_TYPE is not known", "read it by other means")
    number, shown = int(value), f"MAV_TYPE {value:g}"
    if number in MAV_TYPES or number in VTOL_TYPES:
        return passed(gate, shown, limit, f"the vehicle is a {MAV_TYPES.get(number, 'VTOL')}")
    if m.flight.output.sends not in {"rates", "attitude"}:
        return passed(gate, shown, limit, "no thrust goes out in SET_ATTITUDE_TARGET")
    kind = " (generic)" if number == 0 else ""
    sentence = f"parameter MAV_TYPE is {number}{kind}: PX4 then takes the thrust of SET_ATTITUDE_TARGET as zero"
    return refused(gate, shown, limit, sentence, "set it to the vehicle's type (2 for a quadrotor)")


def loss_time(m: Measured) -> Finding:
    """How long PX4 holds the last setpoint when this program dies."""
    gate, value = Gate.LOSS_TIME, m.parameter("COM_OF_LOSS_T")
    limit = f"at most {LOSS_TIME_MAX_S:g} s, {LOSS_TIME_WANTED_S:g} s wanted"
    if value is None:
        return refused(gate, "unknown", limit, "parameter COM_OF_LOSS_T is not known", "set COM_OF_LOSS_T to 0.5")
    shown = f"{value:g} s"
    sentence = f"parameter COM_OF_LOSS_T is {value:g} s: so long PX4 holds the last setpoint when setpoints cease"
    if not 0.0 < value <= LOSS_TIME_MAX_S:
        return refused(gate, shown, limit, sentence, "set COM_OF_LOSS_T to 0.5")
    if value > LOSS_TIME_WANTED_S:
        return warning(gate, shown, limit, sentence, "0.5 is safer")
    return passed(gate, shown, limit, sentence)


def loss_action(m: Measured) -> Finding:
    """What PX4 does then."""
    gate, sticks = Gate.LOSS_ACTION, _sticks(m)
    action, fallback = m.parameter("COM_OBL_RC_ACT"), m.parameter("NAV_RCL_ACT")
    limit = "COM_OBL_RC_ACT 3, 4 or 5"
    fix = "set COM_OBL_RC_ACT to 5 (Hold), 4 (Land) or 3 (Return)"
    silence = when_silent(m.autopilot.parameters, sticks=sticks)
    if action is None:
        return refused(gate, "unknown", limit, "parameter COM_OBL_RC_ACT is not known", fix)
    shown = f"COM_OBL_RC_ACT {action:g}"
    if silence.without_sticks.falls:  # sticks may be lost together with this companion
        worst = when_silent(m.autopilot.parameters, sticks=False)
        return refused(gate, shown, limit, f"parameter {shown}: {worst.sentence}", fix)
    if action in {0.0, 1.0, 2.0}:
        other = "unknown" if fallback is None else f"{fallback:g}"
        both = f"parameters COM_OBL_RC_ACT {action:g} and NAV_RCL_ACT {other}"
        if fallback in {None, 0.0, 7.0}:
            sentence = f"{both}: without sticks PX4 would go on with the last setpoint when setpoints cease"
            return refused(gate, shown, limit, sentence, fix)
        if not sticks:
            sentence = f"parameter {shown} needs a pilot, and there is no live manual control"
            return refused(gate, shown, limit, sentence, fix + ", or switch the transmitter on")
        return warning(gate, shown, limit, silence.sentence, "the pilot must be ready to fly; 5 (Hold) needs no pilot")
    if action not in {3.0, 4.0, 5.0}:
        return refused(gate, shown, limit, f"parameter {shown} is none that this program knows", fix)
    return passed(gate, shown, limit, silence.sentence)


def pilot(m: Measured) -> Finding:
    """Somebody with sticks can take the vehicle over."""
    gate, limit = Gate.PILOT, "sticks that can take over"
    speed, before = m.parameter("MAN_OVERRIDE_SPD"), m.parameter("COM_RC_OVERRIDE")
    if not _sticks(m):
        disabled = m.parameter("COM_RC_IN_MODE") == STICKS_DISABLED
        sentence = "there is no live manual control" + (" (COM_RC_IN_MODE 4 disables it)" if disabled else "")
        if m.flight.vehicle.simulated:
            return passed(gate, "no sticks", limit, f"{sentence}; a change of mode takes over")
        return warning(gate, "no sticks", limit, sentence, "only a change of mode takes over: have one at hand")
    if speed is not None and speed < 0.0:
        sentence = f"MAN_OVERRIDE_SPD {speed:g}: moving the sticks does not take over in Offboard"
        return warning(gate, "mode switch alone", limit, sentence, "set MAN_OVERRIDE_SPD to 1, or know the mode switch")
    if speed is None and before is not None and not int(before) & OVERRIDE_IN_OFFBOARD:
        sentence = f"COM_RC_OVERRIDE {before:g}: moving the sticks does not take over in Offboard"
        return warning(gate, "mode switch alone", limit, sentence, "set its bit 1 (value 2), or know the mode switch")
    return passed(gate, "sticks", limit, "manual control is live: moving the sticks or the mode switch takes over")


def ground_link(m: Measured) -> Finding:
    """Losing the ground station may end a flight."""
    gate, action = Gate.GROUND_LINK, m.parameter("NAV_DLL_ACT")
    shown = "NAV_DLL_ACT " + ("unknown" if action is None else f"{action:g}")
    if action is None or action <= 0.0:
        return passed(gate, shown, "", "a lost ground station changes nothing")
    if int(m.parameter("COM_DLL_EXCEPT") or 0.0) & EXCEPT_OFFBOARD:
        return passed(gate, shown, "", "a ground station is needed for arming; losing it does not end Offboard")
    sentence = "a ground station is needed for arming, and losing it ends Offboard"
    return passed(gate, shown, "", sentence)


def termination(m: Measured) -> Finding:
    """PX4's failure detector watches the tilt in attitude control; where termination is on, it stops the motors."""
    gate, breaker = Gate.TERMINATION, m.parameter("CBRK_FLIGHTTERM")
    shown = "CBRK_FLIGHTTERM " + ("unknown" if breaker is None else f"{breaker:.0f}")
    angles = [x for x in (m.parameter("FD_FAIL_R"), m.parameter("FD_FAIL_P")) if x]
    tilt_deg = degrees(m.flight.vehicle.limits.tilt_max_rad)
    if breaker is None or breaker == TERMINATION_OFF or m.flight.output.sends == "rates" or not angles:
        return passed(gate, shown, "", "no tilt of this flight terminates it")
    limit = f"tilt below {min(angles):g} deg"
    if tilt_deg >= min(angles):
        sentence = f"PX4 stops the motors from {min(angles):g} deg of tilt, limits.tilt_max_rad is {tilt_deg:.0f} deg"
        fix = "lower limits.tilt_max_rad, raise FD_FAIL_R and FD_FAIL_P, or set CBRK_FLIGHTTERM to 121212"
        return refused(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, f"PX4 stops the motors beyond {min(angles):g} deg, the flight stays below")


def thrust_curve(m: Measured) -> Finding:
    """The curve of the rotors is made straight once, by PX4 or by this program."""
    gate, factor = Gate.THRUST_CURVE, m.parameter("THR_MDL_FAC")
    ours = m.flight.vehicle.rotors.curve_factor
    shown = "THR_MDL_FAC " + ("unknown" if factor is None else f"{factor:g}")
    limit = "in one place"
    if m.flight.calibration is not None:
        return passed(gate, shown, limit, "the thrust curve is what the calibration finds")
    if factor is not None and factor > 0.0 and ours > 0.0:
        sentence = f"THR_MDL_FAC is {factor:g} and rotors.curve_factor is {ours:g}: the thrust curve is undone twice"
        return refused(gate, shown, limit, sentence, "set rotors.curve_factor to 0, PX4 makes the thrust linear")
    return passed(gate, shown, limit, "the thrust curve is undone at most once")


def thrust_scaling(m: Measured) -> Finding:
    """PX4 may scale thrust with the battery's voltage."""
    gate, scaled = Gate.THRUST_SCALING, m.parameter("MC_BAT_SCALE_EN")
    shown = "MC_BAT_SCALE_EN " + ("unknown" if scaled is None else f"{scaled:g}")
    if scaled == 1.0:
        sentence = "PX4 scales the thrust with the battery's voltage"
        return warning(gate, shown, "0", sentence, "thrust at full command must have been measured with it")
    return passed(gate, shown, "0", "the battery's voltage does not change what a command means")


def hover_thrust(m: Measured) -> Finding:
    """What PX4 and the vehicle file take for the command that hovers, through the curve of the rotors."""
    gate, theirs = Gate.HOVER_THRUST, m.parameter("MPC_THR_HOVER")
    vehicle = m.flight.vehicle
    weight_n = vehicle.body.mass_kg * GRAVITY_M_S2
    ours = thrust_fraction(weight_n, vehicle.thrust_full_n, vehicle.rotors.curve_factor)
    limit = f"{ours:.2f} within {HOVER_TOLERANCE:.0%}"
    if theirs is None or not isfinite(theirs):
        return passed(gate, "MPC_THR_HOVER unknown", limit, "PX4's own hover thrust is not known")
    shown = f"MPC_THR_HOVER {theirs:.2f}"
    if m.flight.calibration is not None:
        return passed(gate, shown, "-", "the thrust of a hover is what the calibration finds")
    if abs(theirs - ours) > HOVER_TOLERANCE * ours:
        sentence = f"PX4 hovers with a thrust of {theirs:.2f}, by the vehicle file it is {ours:.2f}"
        return warning(gate, shown, limit, sentence, "one of them is wrong: check body.mass_kg and rotors.thrust_max_n")
    return passed(gate, shown, limit, "PX4 and the vehicle file agree about the thrust of a hover")


def _sticks(m: Measured) -> bool:
    health = m.autopilot.health
    return health is not None and health.sticks
