"""The phases of a flight, the ways it ends, and what is known about the autopilot meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import NamedTuple

from companion.control.types import Vec3
from companion.errors import ExitCode
from companion.link.modes import Mode
from companion.record.summary import PhaseChange


class Phase(StrEnum):
    """Where in a flight we are; every change has a reason."""

    CONNECT = "connect"
    PREFLIGHT = "preflight"
    TAKEOFF = "takeoff"
    JOIN = "join"
    TRACK = "track"
    HOLD = "hold"
    LAND = "land"


PHASE_NAMES = tuple(phase.value for phase in Phase)
PHASE_INDEX = {phase: float(index) for index, phase in enumerate(Phase)}


class Ending(NamedTuple):
    """A way to end: what people are told, and the exit code."""

    sentence: str
    exit_code: int


class Cause(Enum):
    """Why a flight ended."""

    COMPLETED = Ending("the flight was completed", ExitCode.DONE)
    INTERRUPTED = Ending("interrupted by the operator", ExitCode.INTERRUPTED)
    REFUSED = Ending("refused by a gate", ExitCode.REFUSED)
    NO_VEHICLE = Ending("no vehicle was found", ExitCode.LOST)
    STATE_LOST = Ending("no usable state came from the vehicle any more", ExitCode.LOST)
    LINK_LOST = Ending("the vehicle went silent", ExitCode.LOST)
    REBOOTED = Ending("the autopilot restarted", ExitCode.LOST)
    OWN_SILENCE = Ending("no setpoint went out for too long", ExitCode.LOST)
    TAKEN_OVER = Ending("another hand took the vehicle over", ExitCode.LOST)
    ESTIMATE_JUMPED = Ending("the autopilot's position estimate was reset", ExitCode.LOST)
    POSITION_ERROR = Ending("the position error left its limit", ExitCode.LOST)
    TILT = Ending("the tilt left its limit", ExitCode.LOST)
    UNSENDABLE = Ending("the law gave a setpoint that must not be sent", ExitCode.INTERNAL)
    FAULT = Ending("a fault of the program", ExitCode.INTERNAL)


class FlightEnded(Exception):  # noqa: N818 - it names what happened, not a fault
    """Ends the loop at once, before setpoints are due or after they have ceased."""

    def __init__(self, cause: Cause, detail: str) -> None:
        super().__init__(detail)
        self.cause = cause
        self.detail = detail


class LandedState(Enum):
    """MAV_LANDED_STATE, as far as it matters."""

    UNDEFINED = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


@dataclass
class Autopilot:
    """What the autopilot has said of itself; None until it did."""

    mode: Mode | None = None
    """What it flies, a failsafe's mode included."""
    intended: Mode | None = None
    """What was asked of it; PX4 goes back there when a failsafe's reason is gone. None before it told."""
    armed: bool = False
    landed: LandedState = LandedState.UNDEFINED
    home: Vec3 | None = None
    """Home position in the local frame, NED [m]."""
    home_amsl_m: float | None = None
    """Its altitude above mean sea level [m]."""
    hold_thrust: float | None = None
    """Thrust setpoint while the autopilot itself held the vehicle, smoothed (0 to 1)."""
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass
class Outcome:
    """How a flight ended."""

    cause: Cause
    detail: str
    phases: list[PhaseChange]
    lost_setpoints: int
    rejected_states: dict[str, int]
    fault: str = ""
    """The traceback, when the program itself failed."""

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.cause.value.sentence}: {self.detail}" if self.detail else self.cause.value.sentence
