"""What a gate finds: its name, how it stands, the figure, its limit, a sentence for people, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from companion.config import Flight
from companion.flight.measure import LinkFigures
from companion.flight.phases import Autopilot
from companion.link.version import AutopilotVersion


class Gate(StrEnum):
    """The gates, in the order in which they are told; the first needs no vehicle."""

    GAINS = "gains"
    CALIBRATION = "calibration"
    PARAMETERS = "parameters"
    VERSION = "version"
    OUTPUT = "output"
    LOOP_HEALTH = "loop health"
    SETPOINTS = "setpoints"
    VEHICLE_TYPE = "vehicle type"
    LOSS_TIME = "offboard loss time"
    LOSS_ACTION = "offboard loss action"
    PILOT = "pilot"
    GROUND_LINK = "ground link"
    TERMINATION = "flight termination"
    THRUST_CURVE = "thrust curve"
    THRUST_SCALING = "thrust scaling"
    HOVER_THRUST = "hover thrust"
    STATE_RATE = "state rate"
    STATE_AGE = "state age"
    STATE_JITTER = "state jitter"
    STATE_GAPS = "state gaps"
    STATE_SOUND = "state soundness"
    ROUND_TRIP = "round trip"
    CLOCK = "clock"
    ESTIMATOR = "estimator"
    ESTIMATOR_TESTS = "estimator tests"
    ESTIMATOR_ACCURACY = "estimator accuracy"
    ESTIMATOR_RESETS = "estimator resets"
    BATTERY = "battery"
    FENCE = "fence"
    LANDED_STATE = "landed state"
    MODE = "mode"
    ARMING = "arming"


class Verdict(StrEnum):
    """What a gate says."""

    PASSED = "passed"
    WARNING = "warning"
    """People should know, and may fly."""
    REFUSED = "refused"


@dataclass(frozen=True)
class Finding:
    """What one gate found."""

    gate: Gate
    verdict: Verdict
    value: str
    """The figure, with its unit."""
    limit: str
    """What is asked of it; "" for none."""
    sentence: str
    fix: str = ""
    """What to do, for a warning or a refusal."""

    @property
    def told(self) -> str:
        """The sentence with what to do."""
        return f"{self.sentence}; {self.fix}" if self.fix else self.sentence


class Measured(NamedTuple):
    """All that the gates judge by."""

    flight: Flight
    autopilot: Autopilot
    version: AutopilotVersion | None
    link: LinkFigures
    unread: Mapping[str, str] = {}
    """Why parameters that a flight must know are not known."""
    rate_refusal: str = ""
    """Why the autopilot does not send states at the rate that was asked for."""
    complaints: Sequence[str] = ()
    """What the autopilot says against arming."""

    def parameter(self, name: str) -> float | None:
        """A parameter of the autopilot; None: it has none of this name, or did not tell."""
        return self.autopilot.parameters.get(name)


def passed(gate: Gate, value: str, limit: str, sentence: str) -> Finding:
    """Nothing speaks against a flight."""
    return Finding(gate, Verdict.PASSED, value, limit, sentence)


def warning(gate: Gate, value: str, limit: str, sentence: str, fix: str) -> Finding:
    """Something to know before a flight."""
    return Finding(gate, Verdict.WARNING, value, limit, sentence, fix)


def refused(gate: Gate, value: str, limit: str, sentence: str, fix: str) -> Finding:
    """Something that forbids a flight."""
    return Finding(gate, Verdict.REFUSED, value, limit, sentence, fix)


def refusal(findings: Sequence[Finding]) -> str:
    """Why a flight is refused, in one line; "" when it is not."""
    against = [finding for finding in findings if finding.verdict is Verdict.REFUSED]
    if not against:
        return ""
    more = len(against) - 1
    also = f" (and {more} more: `companion doctor` shows all)" if more else ""
    return against[0].told + also
