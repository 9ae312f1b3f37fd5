"""The phases of a flight, the ways it ends, and what is known about the autopilot meanwhile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any, NamedTuple

from companion.control.types import Quat, Vec3
from companion.errors import ExitCode
from companion.flight.adaptation import Adaptation
from companion.flight.health import EstimatorHealth, SystemHealth
from companion.flight.resets import Reset
from companion.flight.retuning import Transition
from companion.flight.tempo import Ramp
from companion.frames import GeoPoint
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
    PAUSE = "pause"
    """The course is slowed to rest, at rest, or getting back to its pace, as an operator asked."""

    __hash__ = str.__hash__
    """An enumeration's own is a call into Python, at every step."""


PHASE_NAMES = tuple(phase.value for phase in Phase)
PHASE_INDEX = {phase: float(index) for index, phase in enumerate(Phase)}


class Ending(NamedTuple):
    """A way to end: what people are told, and the exit code."""

    sentence: str
    exit_code: int


class Cause(Enum):
    """Why a flight ended."""

    COMPLETED = Ending("the flight was completed", ExitCode.DONE)
    INSPECTED = Ending("a flight would not be refused", ExitCode.DONE)
    INTERRUPTED = Ending("interrupted by the operator", ExitCode.INTERRUPTED)
    STOPPED = Ending("stopped by the operator", ExitCode.DONE)
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
    LYAPUNOV = Ending("the vehicle does not behave as its model says (V_H left its envelope)", ExitCode.LOST)
    NOT_FOLLOWING = Ending("the vehicle does not turn as it is told", ExitCode.LOST)
    DISTURBANCE = Ending("the disturbance estimate is at its bound", ExitCode.LOST)
    THRUST = Ending("the thrust is at its limit", ExitCode.LOST)
    RATES = Ending("the commanded rates are at their limit", ExitCode.LOST)
    STATE_RATE = Ending("states come too rarely", ExitCode.LOST)
    STATE_AGE = Ending("states come too late", ExitCode.LOST)
    LATE_STEPS = Ending("this machine is too slow for the control loop", ExitCode.LOST)
    ESTIMATOR = Ending("the autopilot's estimate is not sound", ExitCode.LOST)
    FENCE = Ending("the vehicle left its fence", ExitCode.LOST)
    BATTERY = Ending("the battery is nearly empty", ExitCode.LOST)
    LINK_ONE_WAY = Ending("the autopilot does not answer any more, its states still come", ExitCode.LOST)
    FAILSAFE = Ending("the autopilot is in a failsafe", ExitCode.LOST)
    DISARMED = Ending("the vehicle was disarmed in flight", ExitCode.LOST)
    UNSENDABLE = Ending("the controller gave a setpoint that must not be sent", ExitCode.INTERNAL)
    FAULT = Ending("a fault of the program", ExitCode.INTERNAL)


class Order(StrEnum):
    """What an operator may ask of a flight that is under way."""

    PAUSE = "pause"
    RESUME = "resume"
    STOP = "stop"
    """To rest on the course, then Hold."""
    LAND = "land"
    """The same, then landing where it is."""


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
    home_global: GeoPoint | None = None
    """The same on the Earth, altitude above mean sea level; None while the vehicle has no global position."""
    home_amsl_m: float | None = None
    """Its altitude above mean sea level [m]."""
    battery: float | None = None
    """Share that is left in the first battery; None: unknown."""
    hold_thrust: float | None = None
    """Thrust setpoint while the autopilot itself held the vehicle, smoothed (0 to 1)."""
    hold_thrusts: list[float] = field(default_factory=list)
    """The same as they came while somebody gathers them; see `gathers`."""
    gathers: bool = False
    """Whether the thrust setpoints of the autopilot's own hover are kept."""
    battery_v: float | None = None
    """Voltage of the battery."""
    parameters: dict[str, float] = field(default_factory=dict)
    system_status: int | None = None
    """MAV_STATE, of HEARTBEAT; None before the first."""
    health: SystemHealth | None = None
    """As SYS_STATUS told it last."""
    estimator: EstimatorHealth | None = None
    """As ESTIMATOR_STATUS told it last."""


@dataclass(frozen=True)
class Engagement:
    """How the controller took over: with this and the recorded states its commands can be computed again."""

    at_s: float
    """Vehicle time at which the course began [s]."""
    hold_point_m: Vec3
    """Where the vehicle was held, NED: the course was planned from there."""
    yaw_rad: float
    """The heading there."""
    home_m: Vec3 | None
    """The vehicle's home position, NED, if it was known."""
    attitude: Quat
    """Body to NED, at that moment."""
    thrust_n: float | None
    """The thrust that held the vehicle; None: the weight was taken."""
    ramps: tuple[Ramp, ...] = ()
    """How the course's pace was changed on the way."""
    transitions: tuple[Transition, ...] = ()
    """How the law's parameters were changed on the way."""
    resets: tuple[Reset, ...] = ()
    """Jumps of the autopilot's estimate that the flight went on through."""
    delays: tuple[tuple[float, float], ...] = ()
    """What the prediction's delay became [s], each with the stamp of the first state that it was used for [s]."""

    adaptation: Adaptation | None = None
    """What was flown instead of what the files say; None: as they say."""
    origin_m: Vec3 | None = None
    """Where a trajectory with the anchor "home" counted its coordinates from, NED; None: from `home_m`, as in flights
    that were recorded before the two were told apart: what counted from the origin then counted from there."""

    @classmethod
    def from_numbers(cls, entry: Mapping[str, Any]) -> Engagement:
        """Reads what `dataclasses.asdict` gave, as JSON keeps it. Raises KeyError, TypeError or ValueError."""
        home, thrust, origin = entry["home_m"], entry["thrust_n"], entry.get("origin_m")
        return cls(
            float(entry["at_s"]),
            _vector(entry["hold_point_m"]),
            float(entry["yaw_rad"]),
            None if home is None else _vector(home),
            _quaternion(entry["attitude"]),
            None if thrust is None else float(thrust),
            tuple(Ramp(*(float(x) for x in ramp)) for ramp in entry.get("ramps", ())),
            tuple(Transition.from_numbers(way) for way in entry.get("transitions", ())),
            tuple(Reset.from_numbers(reset) for reset in entry.get("resets", ())),
            tuple((float(at_s), float(delay_s)) for at_s, delay_s in entry.get("delays", ())),
            _adaptation(entry.get("adaptation")),
            None if origin is None else _vector(origin),
        )


def _adaptation(entry: Any) -> Adaptation | None:
    if entry is None:
        return None
    output, share, rate_hz, age_s = entry
    return Adaptation(str(output), float(share), float(rate_hz), float(age_s))


def _vector(numbers: Sequence[float]) -> Vec3:
    north, east, down = numbers
    return float(north), float(east), float(down)


def _quaternion(numbers: Sequence[float]) -> Quat:
    w, x, y, z = numbers
    return float(w), float(x), float(y), float(z)


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
    parameters: dict[str, float] = field(default_factory=dict)
    """The autopilot's parameters that were read."""
    engagement: Engagement | None = None
    """None: the controller never took over."""
    delay_s: dict[str, float | None] = field(default_factory=dict)
    """The delay from a state's stamp to the effect of its command: `flight.watch.Watch.delay_figures`."""
    refused_messages: dict[str, int] = field(default_factory=dict)
    """Messages that were not used because of who sent them, by reason."""
    vehicle: dict[str, Any] = field(default_factory=dict)
    """What the autopilot told of the vehicle: `flight.reports.vehicle_facts`."""

    def told(self) -> dict[str, Any]:
        """What a flight's log keeps of it: JSON types only."""
        return {
            **{"cause": self.cause.name, "sentence": self.sentence, "lost_setpoints": self.lost_setpoints},
            **{"rejected_states": self.rejected_states, "parameters": self.parameters},
            "phases": [list(change) for change in self.phases],
            "delay_s": self.delay_s,
            "refused_messages": self.refused_messages,
            "vehicle_facts": self.vehicle,
        }

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self.cause.value.sentence}: {self.detail}" if self.detail else self.cause.value.sentence
