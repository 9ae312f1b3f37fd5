"""Gates of the link and of the estimate: are the states such that the certified loop may be closed over them?"""

from __future__ import annotations

from math import isfinite
from typing import Final

from companion.flight.findings import Finding, Gate, Measured, passed, refused, warning
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S
from companion.flight.measure import CLOCK_ERROR_MAX_S, silence_limit_s
from companion.flight.phases import LandedState

RATE_FLOOR: Final = 0.8
"""Share of the vehicle file's state rate below which the loop is another one than the file's: its gains are not
flown over it."""
SCHEDULED_RATE_FLOOR: Final = 0.4
"""The same where `flight.schedule` may lower the gains."""
JITTER_WANTED_S: Final = 0.010
GAPS_MAX: Final = 2
"""Of a measurement; the machine may have been busy once."""
LONG_GAP: Final = 5.0
"""Over the time that a flight waits for a state: such a gap is no busy machine."""
REJECTED_MAX: Final = 0.02
"""Share of the states."""
TEST_RATIO_MAX: Final = 1.0
"""From here on PX4's estimator rejects what it measures."""
TEST_RATIO_WANTED: Final = 0.5
ACCURACY_MAX_M: Final = 5.0
"""COM_POS_FS_EPH where it is not known."""
CALIBRATION_DELAY_MAX_S: Final = 0.1
"""For the hover of a calibration, which needs no model."""
NO_STATES = "no usable ODOMETRY within 5 s"


def state_rate(m: Measured) -> Finding:
    """States come as often as the loop was certified for."""
    gate, link = Gate.STATE_RATE, m.link
    wanted = m.flight.vehicle.link.state_rate_hz
    floor = RATE_FLOOR * wanted
    limit = f"at least {floor:.0f} Hz"
    if m.rate_refusal:
        fix = "the flight needs ODOMETRY as its one state"
        return refused(gate, "-", limit, m.rate_refusal, fix)
    if link.rate_hz is None:
        why = f" ({link.rejected[0].sentence})" if link.rejected else ""
        fix = "the estimator is not ready, or the link does not carry it"
        return refused(gate, "none", limit, NO_STATES + why, fix)
    shown = f"{link.rate_hz:.0f} Hz"
    sentence = f"ODOMETRY comes at {shown}"
    if link.rate_hz < floor:
        why = f"{sentence}, {floor:.0f} Hz are required for the vehicle file's {wanted:.0f} Hz"
        if m.flight.output.controller == "law":
            why += f", {SCHEDULED_RATE_FLOOR * wanted:.0f} Hz with lower gains"
        return refused(gate, shown, limit, why, "check the link's data rate, or lower link.state_rate_hz and certify")
    return passed(gate, shown, limit, f"{sentence}, {wanted:.0f} Hz were asked for")


def state_age(m: Measured) -> Finding:
    """States are no older than the loop was certified for."""
    gate, age = Gate.STATE_AGE, m.link.age_s
    assumed = m.flight.vehicle.link.state_age_s
    most = assumed + DELAY_MARGIN_MIN_S + _paced_s(m)
    if m.flight.calibration is not None:  # the file's figure is what is to be found
        most = max(most, CALIBRATION_DELAY_MAX_S)
    limit = f"at most {most * 1e3:.0f} ms"
    if age is None:
        return _unmeasured(gate, limit)
    shown = f"{age * 1e3:.1f} ms"
    sentence = f"states are {shown} old when they come, the vehicle file says {assumed * 1e3:g} ms"
    if age > most:
        fix = "set link.state_age_s to what is measured and certify again, or make the link faster"
        return refused(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, sentence)


def state_jitter(m: Measured) -> Finding:
    """States come evenly."""
    gate, jitter = Gate.STATE_JITTER, m.link.jitter_s
    most = _silence_s(m)
    limit = f"at most {most * 1e3:.0f} ms, {JITTER_WANTED_S * 1e3:.0f} ms wanted"
    if jitter is None:
        return _unmeasured(gate, limit)
    shown = f"{jitter * 1e3:.1f} ms"
    sentence = f"one state in ten comes more than {shown} later than the promptest"
    fix = "look for what holds datagrams up: radio, router, other programs on this machine"
    if jitter > most:
        return refused(gate, shown, limit, sentence, fix)
    if jitter > JITTER_WANTED_S:
        return warning(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, f"nine states in ten come within {shown} of the promptest")


def state_gaps(m: Measured) -> Finding:
    """No gaps that would end a flight."""
    gate, link = Gate.STATE_GAPS, m.link
    most = _silence_s(m)
    limit = f"at most {GAPS_MAX} above {most * 1e3:.0f} ms, none above {LONG_GAP * most * 1e3:.0f} ms"
    if link.longest_gap_s is None:
        return _unmeasured(gate, limit)
    shown = f"{link.gaps}, longest {link.longest_gap_s * 1e3:.0f} ms"
    sentence = f"the longest time without a state was {link.longest_gap_s * 1e3:.0f} ms"
    if link.gaps:
        sentence += f", a flight ends after {most * 1e3:.0f} ms"
        fix = "look for what stops the link or this machine for so long"
        grave = link.gaps > GAPS_MAX or link.longest_gap_s > LONG_GAP * most
        return (refused if grave else warning)(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, sentence)


def state_sound(m: Measured) -> Finding:
    """The states can be used."""
    gate, link = Gate.STATE_SOUND, m.link
    limit = f"below {REJECTED_MAX:.0%} unusable"
    if not link.rejections:
        return passed(gate, "0 unusable", limit, "every state could be used")
    share = link.rejections / (link.rejections + link.states)
    shown = f"{link.rejections} unusable"
    sentence = f"{share:.0%} of the states could not be used: {link.rejected[0].sentence}"
    if share > REJECTED_MAX:
        return refused(gate, shown, limit, sentence, "look at the estimator, and at who else sends on this link")
    return passed(gate, shown, limit, sentence)


def round_trip(m: Measured) -> Finding:
    """Commands arrive as soon as the loop was certified for: half of a round trip is theirs."""
    gate, link, delay_s = Gate.ROUND_TRIP, m.link, m.flight.vehicle.link.command_delay_s
    most = 2.0 * (delay_s + DELAY_MARGIN_MIN_S) + _paced_s(m)
    if m.flight.calibration is not None:
        most = max(most, CALIBRATION_DELAY_MAX_S)
    limit = f"at most {most * 1e3:.0f} ms"
    if link.round_trip_s is None:
        sentence = "the vehicle does not answer TIMESYNC: how long commands take is not known"
        return warning(gate, "no answer", limit, sentence, "check that the link carries TIMESYNC both ways")
    shown = f"{link.round_trip_s * 1e3:.1f} ms"
    sentence = f"a message and its answer take {shown}"
    if link.round_trip_s > most:
        fix = "set link.command_delay_s to half of it and certify again, or make the link faster"
        return refused(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, sentence)


def clock(m: Measured) -> Finding:
    """The vehicle's time is told the same in two ways."""
    gate, error = Gate.CLOCK, m.link.clock_error_s
    limit = f"at most {CLOCK_ERROR_MAX_S * 1e3:.0f} ms apart"
    if error is None:
        sentence = "the vehicle does not answer TIMESYNC: its time is known from its own requests and states alone"
        return warning(gate, "no answer", limit, sentence, "check that the link carries TIMESYNC both ways")
    shown = f"{error * 1e3:.1f} ms"
    if abs(error) > CLOCK_ERROR_MAX_S:
        sentence = f"the vehicle's answers to TIMESYNC and its own requests differ by {shown}"
        fix = "look for a second program that synchronises time on this link, or a routing loop"
        return refused(gate, shown, limit, sentence, fix)
    return passed(gate, shown, limit, f"two ways of telling the vehicle's time differ by {shown}")


def estimator(m: Measured) -> Finding:
    """The estimator has what a flight needs."""
    gate, health, limit = Gate.ESTIMATOR, m.autopilot.estimator, "attitude, velocity, position, height"
    fix = "wait until the estimator is ready (GNSS or vision, standing still), or look at what it says"
    if health is None:
        return refused(gate, "not told", limit, "the autopilot does not tell its estimator's health", fix)
    lacking = health.lacking(in_air=m.autopilot.landed is not LandedState.ON_GROUND)
    if lacking:
        sentence = f"the autopilot's estimator is not ready: {', '.join(lacking)}"
        return refused(gate, ", ".join(lacking), limit, sentence, fix)
    return passed(gate, "ready", limit, "the estimator has attitude, velocity, position and height")


def estimator_tests(m: Measured) -> Finding:
    """The estimator believes its sensors."""
    gate, health = Gate.ESTIMATOR_TESTS, m.autopilot.estimator
    limit = f"below {TEST_RATIO_MAX:g}, {TEST_RATIO_WANTED:g} wanted"
    if health is None:
        return _unmeasured(gate, limit)
    name, worst = health.worst
    shown = f"{worst:.2f} ({name})"
    sentence = f"the estimator's largest test ratio is {worst:.2f}, of the {name}"
    if worst >= TEST_RATIO_MAX:
        return refused(gate, shown, limit, f"{sentence}: it rejects this measurement", "find out which sensor is wrong")
    if worst > TEST_RATIO_WANTED:
        return warning(gate, shown, limit, sentence, "wait until it has settled; find out which sensor is worse")
    return passed(gate, shown, limit, sentence)


def estimator_accuracy(m: Measured) -> Finding:
    """The position is known as well as PX4 itself wants to know it."""
    gate, health = Gate.ESTIMATOR_ACCURACY, m.autopilot.estimator
    eph = m.parameter("COM_POS_FS_EPH")
    most = eph if eph is not None and eph > 0.0 else ACCURACY_MAX_M
    limit = f"at most {most:g} m"
    if health is None:
        return _unmeasured(gate, limit)
    shown = f"{health.accuracy_m:.2f} m"
    sentence = f"the estimator knows the position to {shown}"
    if not (isfinite(health.accuracy_m) and health.accuracy_m <= most):
        return refused(gate, shown, limit, sentence, "wait for a better fix: beyond the limit PX4 gives it up")
    return passed(gate, shown, limit, sentence)


def estimator_resets(m: Measured) -> Finding:
    """The estimate does not jump."""
    gate, resets = Gate.ESTIMATOR_RESETS, m.link.resets
    shown, limit = f"{resets}", "0"
    if resets:
        sentence = "the estimate jumped while it was watched (its reset counter changed)"
        return refused(gate, shown, limit, sentence, "wait until the estimator has settled")
    return passed(gate, shown, limit, "the estimate did not jump while it was watched")


def _silence_s(m: Measured) -> float:
    """How long the flight waits for a state [s]."""
    return silence_limit_s(m.flight.vehicle.link.state_rate_hz, calibrates=m.flight.calibration is not None)


def _paced_s(m: Measured) -> float:
    """In lockstep whatever is late comes with the next state: so much later [s]."""
    return 1.0 / m.flight.vehicle.link.state_rate_hz if m.link.paced else 0.0


def _unmeasured(gate: Gate, limit: str) -> Finding:
    """Another gate refuses for want of it."""
    return warning(gate, "not measured", limit, f"{gate.value}: nothing came to judge it by", "see the gates beside it")
