"""New gains, limits or another heading in flight: the law's parameters move to them over a time, never at once.

What moves are the gains and those limits that are the law's own (`flown`). The limits by which the reference was
checked before the flight, thrust and body rates among them, stay what they were. Every point of the way is looked at
with the certificate before the way is taken (`Retuning`); the certificate speaks of parameters that stand still, so the
way takes seconds. A heading of another kind cannot be interpolated: for the length of the way both are computed and
what they ask of the yaw axis is mixed (`Turning`); the other axes know nothing of the heading.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from companion.config import Vehicle, merged, validate
from companion.control import flat
from companion.control.certificate import certify, disturbance_overcome
from companion.control.law import ControllerState, Gains, Limits, Model, Parameters
from companion.control.model import Factors
from companion.control.types import Reference, State
from companion.errors import InputError
from companion.flight.engines import Engine, Numbers, Stepped, stepped

if TYPE_CHECKING:
    from companion.flight.tracker import Tracker

RAMP_S: Final = 2.0
"""How long the way to new parameters takes."""
RAMP_MAX_S: Final = 60.0
POINTS: Final = 10
"""Parts of the way; the certificate is computed at every point between them, and at the end."""
WAITING_MAX: Final = 64
"""Changes that may wait for the one that is under way."""
_UNLIMITED_RAD_S: Final = 1e6
_YAW: Final = (flat.RATES.stop - 1, flat.RATES_MODEL.stop - 1, flat.TAU.stop - 1)


@dataclass(frozen=True)
class ParameterChange:
    """What the vehicle's parameters are to be from now on."""

    controller: Mapping[str, Any] = field(default_factory=dict)
    """Keys of [controller] with their values; all that were ever changed, so that the newest change is the whole of
    it."""
    limits: Mapping[str, Any] = field(default_factory=dict)
    """The same of [limits]."""
    ramp_s: float = RAMP_S
    """How long a flight that is under way takes to follow [s]."""

    @property
    def overrides(self) -> dict[str, Any]:
        """As the top level of a flight file takes them."""
        return {"controller": dict(self.controller), "limits": dict(self.limits)}

    def applied(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle file with the change.

        Raises:
            InputError: that is no valid vehicle.
        """
        return validate(Vehicle, merged(vehicle.model_dump(), self.overrides), "changed parameters")

    def as_note(self) -> dict[str, Any]:
        """As the content of a note between processes."""
        return asdict(self)

    @classmethod
    def from_note(cls, content: Any) -> ParameterChange:
        """Reads `as_note` again.

        Raises:
            InputError: it is none.
        """
        known = content if isinstance(content, Mapping) else {}
        tables = (known.get("controller"), known.get("limits"))
        ramp_s = known.get("ramp_s")
        if not all(isinstance(table, Mapping) for table in tables) or not isinstance(ramp_s, int | float):
            raise InputError("a change of parameters has the tables controller and limits, and ramp_s")
        if not 0.0 < ramp_s <= RAMP_MAX_S:
            raise InputError(f"a change of parameters: ramp_s = {ramp_s!r} must be above 0 and at most {RAMP_MAX_S:g}")
        controller, limits = (dict(table) for table in tables if isinstance(table, Mapping))
        return cls(controller, limits, float(ramp_s))


class Transition(NamedTuple):
    """One way from parameters to others; with these a flight can be computed again."""

    begin_s: float
    """Vehicle time of the first state on it [s]."""
    duration_s: float
    old: Parameters
    new: Parameters

    @classmethod
    def from_numbers(cls, entry: Any) -> Transition:
        """Reads what JSON made of one. Raises TypeError or ValueError."""
        begin_s, duration_s, old, new = entry
        return cls(float(begin_s), float(duration_s), _parameters(old), _parameters(new))


def _parameters(entry: Any) -> Parameters:
    gains, model, limits = entry
    return Parameters(_tuples(Gains, gains), _tuples(Model, model), _tuples(Limits, limits))


def _tuples(kind: Any, entry: Any) -> Any:
    return kind(*(tuple(value) if isinstance(value, list) else value for value in entry))


def flown(wanted: Parameters, flying: Parameters) -> Parameters:
    """What of the wanted parameters a flight that is under way takes: all gains, and the limits of the law's own."""
    limits = wanted.limits
    own = flying.limits._replace(
        disturbance_max=limits.disturbance_max,
        heading_rate_max=limits.heading_rate_max,
        heading_speed_min=limits.heading_speed_min,
    )
    return Parameters(wanted.gains, flying.model, own)


def between(old: Parameters, new: Parameters, share: float) -> Parameters:
    """The parameters on the straight way, `share` (0 to 1) of it done; kind of heading and model are the new ones."""
    if share >= 1.0:
        return new
    keep = 1.0 - share
    a, b = old.gains, new.gains
    gains = Gains(
        keep * a.k1 + share * b.k1,
        keep * a.k2 + share * b.k2,
        keep * a.k3 + share * b.k3,
        keep * a.k4 + share * b.k4,
        keep * a.gamma + share * b.gamma,
        keep * a.p_max + share * b.p_max,
        b.heading_kind,
        keep * a.l1 + share * b.l1,
        keep * a.l2 + share * b.l2,
        keep * a.damping + share * b.damping,
    )
    c, d = old.limits, new.limits
    x, y, z = (keep * p + share * q for p, q in zip(c.rate_max, d.rate_max, strict=True))
    limits = Limits(
        keep * c.thrust_min + share * d.thrust_min,
        keep * c.thrust_max + share * d.thrust_max,
        (x, y, z),
        keep * c.disturbance_max + share * d.disturbance_max,
        keep * c.heading_rate_max + share * d.heading_rate_max,
        keep * c.heading_speed_min + share * d.heading_speed_min,
    )
    return Parameters(gains, new.model, limits)


def unsound(parameters: Parameters) -> str:
    """Why the certificate refuses these parameters, in words; "" when it does not (docs/law.md section 4)."""
    failure = certify(parameters.gains, parameters.model.drag).failure()
    if failure:
        return f"the gains are not certified: {failure}"
    overcome, ball = disturbance_overcome(parameters.gains), parameters.limits.disturbance_max
    if ball > overcome:
        return (
            f"disturbance_max {ball:.4g} m/s^2 is more than the {overcome:.4g} m/s^2 that the bounded position error"
            " holds against"
        )
    return ""


def points(old: Parameters, new: Parameters) -> list[Parameters]:
    """The points of the way that are looked at, the end the last."""
    return [between(old, new, i / POINTS) for i in range(1, POINTS + 1)]


class Turning:
    """Two engines that differ in the kind of heading; implements `engines.Engine`.

    Their other axes are the same numbers, since thrust, roll and pitch do not depend on the heading. The new one wants
    its direction from its first step on: what it asks of the yaw axis is bounded, and its share grows; a wanted
    direction that is turned there at a limited rate would stop abruptly.

    Args:
        old: has flown so far.
        new: has begun from the same controller state.
        kind: of the old one's heading.
    """

    def __init__(self, old: Engine, new: Engine, kind: int) -> None:
        self.new = new
        self.share = 0.0
        """Of the new engine in what goes out on the yaw axis."""
        self._old, self._kind = old, kind
        self._first = True
        self._numbers: Numbers = ()

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        self._old.begin(controller)
        self.new.begin(controller)

    @property
    def controller(self) -> ControllerState:
        """The newer one's."""
        return self.new.controller

    def retune(self, parameters: Parameters) -> None:
        """From now on with these parameters."""
        limits = parameters.limits
        if self._first:
            limits = limits._replace(heading_rate_max=_UNLIMITED_RAD_S)
            self._first = False
        self.new.retune(parameters._replace(limits=limits))
        self._old.retune(parameters._replace(gains=parameters.gains._replace(heading_kind=self._kind)))

    def relag(self, lags: Factors) -> None:
        """Steps of both with pieces of another length from now on."""
        self._old.relag(lags)
        self.new.relag(lags)

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: Sequence[float],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Stepped:
        """One step of both, mixed."""
        for engine in (self._old, self.new):
            engine.step(state, reference, thrust, pieces, frozen, integrate, dt_s)
        before, numbers = self._old.numbers(), list(self.new.numbers())
        for index in _YAW:
            numbers[index] = (1.0 - self.share) * before[index] + self.share * numbers[index]
        self._numbers = tuple(numbers)
        return stepped(self._numbers)

    def numbers(self) -> Numbers:
        """All of the last step, mixed."""
        return self._numbers


class _Wanted(NamedTuple):
    parameters: Parameters
    ramp_s: float


class Retuning:
    """Follows changes one after the other, each as soon as the one before is done; of several the newest that can be.

    Args:
        tracker: of the flight.
        notify: gets lines for people.
    """

    def __init__(self, tracker: Tracker, notify: Callable[[str], None]) -> None:
        self._tracker, self._notify = tracker, notify
        self._waiting: deque[_Wanted] = deque()
        self._last = tracker.parameters
        self._tried = -1
        """Index of the waiting change whose way is being looked at; -1: none."""
        self._way: list[Parameters] = []

    def want(self, change: ParameterChange) -> str:
        """Takes a change.

        Returns:
            "" or why it is not followed, for people.
        """
        try:
            wanted = flown(change.applied(self._tracker.vehicle).parameters(), self._last)
        except InputError as error:
            return str(error)
        if wanted == self._last:
            return ""
        refusal = unsound(wanted)
        if refusal:
            return refusal
        if len(self._waiting) >= WAITING_MAX:
            return f"{WAITING_MAX} changes wait already; try again in a moment"
        self._waiting.append(_Wanted(wanted, change.ramp_s))
        self._last = wanted
        return ""

    def tick(self) -> None:
        """Looks at one more point of the way; called once per state, when its setpoint is out."""
        if not self._waiting or self._tracker.changing:
            return
        if self._tried < 0:
            self._try(len(self._waiting) - 1)
        elif self._way:
            refusal = unsound(self._way.pop())
            if refusal and self._tried > 0:
                self._try(self._tried - 1)
            elif refusal:
                self._give_up(refusal)
        else:
            self._go()

    def _try(self, index: int) -> None:
        self._tried = index
        self._way = points(self._tracker.parameters, self._waiting[index].parameters)

    def _give_up(self, refusal: str) -> None:
        self._waiting.clear()
        self._last, self._tried = self._tracker.parameters, -1
        self._notify(f"the parameters stay as they are, on the way to the new ones {refusal}")

    def _go(self) -> None:
        wanted = self._waiting[self._tried]
        for _ in range(self._tried + 1):
            self._waiting.popleft()
        self._tried = -1
        self._tracker.retune(wanted.parameters, wanted.ramp_s)
        self._notify(f"the law's parameters change over {wanted.ramp_s:g} s")
