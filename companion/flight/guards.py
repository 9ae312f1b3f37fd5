"""The guards of a flight: what is watched while the controller flies, by which limit, and what is done about it.

`Guard` is the table. A guard that is broken for as long as a stage says is answered with that stage's response; the
responses are a ladder, each rung harder than the one before (`flight.responses` climbs it). Guards look at a step after
its setpoint is out, and at what changes slowly ten times per second. Their time is the vehicle's, so that in lockstep
the same flight breaks the same guards at the same states; what only the wall clock knows is not judged there.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum
from typing import NamedTuple

from companion.config import FlightLimits, Vehicle
from companion.control import flat
from companion.control.law import (
    LIMIT_DISTURBANCE,
    LIMIT_ROLL_PITCH_RATE,
    LIMIT_THRUST_MAX,
    LIMIT_THRUST_MIN,
    LIMIT_YAW_RATE,
    Parameters,
)
from companion.control.types import Quat, Vec3
from companion.flight.envelope import Envelope
from companion.flight.phases import Cause
from companion.frames import tilt_from_quat

_THRUST = LIMIT_THRUST_MIN | LIMIT_THRUST_MAX
_RATES = LIMIT_ROLL_PITCH_RATE | LIMIT_YAW_RATE
EASY_S = 3.0
"""A reference that was slowed down gets its pace back when nothing is wrong for so long."""
BATTERY_CRITICAL = 0.5
"""Share of limits.battery_min below which the vehicle lands where it is."""


RUNAWAY = 8.0
"""V_H so many times above its envelope is no gust and no weak rotor any more: what is commanded makes it worse. A rotor
that falls to 60 % reaches 7.6 times the vertical part."""


class Response(IntEnum):
    """What is done, from the mildest to the hardest."""

    RESUME = 0
    """The reference gets its own pace back."""
    SLOW = 1
    """The reference slows down to half its pace."""
    REST = 2
    """The reference comes to rest on its path, then the autopilot gets the vehicle in Hold."""
    HOLD = 3
    """The autopilot gets the vehicle in Hold at once; where it refuses it is to land. Then nothing more is sent."""
    LAND = 4
    """The autopilot is to land the vehicle at once."""


class Stage(NamedTuple):
    """A response to what lasts."""

    after_s: float
    response: Response


class Rule(NamedTuple):
    """One guard."""

    cause: Cause
    """What a flight that it ends ended by; its sentence is the guard's."""
    key: str
    """The limit's name in [limits] of the vehicle file, or what else it is."""
    stages: tuple[Stage, ...]
    """In the order of their times."""


class Guard(Enum):
    """All guards: what is watched, by which limit, for how long, and what follows."""

    POSITION_ERROR = Rule(Cause.POSITION_ERROR, "limits.position_error_abort_m", (Stage(0.0, Response.HOLD),))
    BEHIND = Rule(Cause.POSITION_ERROR, "controller.position_error_max_m", (Stage(0.5, Response.SLOW),))
    TILT = Rule(Cause.TILT, "limits.tilt_max_rad", (Stage(0.2, Response.HOLD),))
    LYAPUNOV = Rule(Cause.LYAPUNOV, "the envelope", (Stage(0.3, Response.REST), Stage(2.5, Response.HOLD)))
    RUNAWAY = Rule(Cause.LYAPUNOV, "8 times the envelope", (Stage(0.1, Response.HOLD),))
    FOLLOWING = Rule(Cause.NOT_FOLLOWING, "limits.rate_error_max_rad_s", (Stage(0.1, Response.HOLD),))
    DISTURBANCE = Rule(
        Cause.DISTURBANCE, "limits.disturbance_max_m_s2", (Stage(2.0, Response.SLOW), Stage(5.0, Response.REST))
    )
    THRUST = Rule(
        *(Cause.THRUST, "limits.thrust_min_n, thrust_max_n"),
        (Stage(0.5, Response.SLOW), Stage(2.0, Response.REST), Stage(6.0, Response.HOLD)),
    )
    RATES = Rule(
        *(Cause.RATES, "limits.rate_max_rad_s"),
        (Stage(1.0, Response.SLOW), Stage(3.0, Response.REST), Stage(6.0, Response.HOLD)),
    )
    STATE_RATE = Rule(Cause.STATE_RATE, "limits.state_rate_min", (Stage(0.5, Response.SLOW), Stage(2.0, Response.HOLD)))
    STATE_AGE = Rule(Cause.STATE_AGE, "limits.state_age_max_s", (Stage(0.3, Response.SLOW), Stage(1.0, Response.HOLD)))
    LATE_STEPS = Rule(Cause.LATE_STEPS, "limits.late_steps_max", (Stage(1.0, Response.SLOW), Stage(5.0, Response.REST)))
    ESTIMATOR = Rule(Cause.ESTIMATOR, "ESTIMATOR_STATUS", (Stage(0.5, Response.HOLD),))
    FENCE = Rule(Cause.FENCE, "the fence", (Stage(0.2, Response.HOLD),))
    BATTERY = Rule(Cause.BATTERY, "limits.battery_min", (Stage(1.0, Response.REST),))
    BATTERY_CRITICAL = Rule(Cause.BATTERY, "half of limits.battery_min", (Stage(1.0, Response.LAND),))
    LINK = Rule(Cause.LINK_ONE_WAY, "limits.link_silence_max_s", (Stage(0.0, Response.HOLD),))
    FAILSAFE = Rule(Cause.FAILSAFE, "MAV_STATE", (Stage(0.0, Response.HOLD),))


class Finding(NamedTuple):
    """A guard that is broken, and what it asks for now."""

    guard: Guard | None
    """None: nothing is wrong any more."""
    response: Response
    detail: str
    """Figures, for people."""


class Slow(NamedTuple):
    """What changes slowly; None where it is not known, or must not be judged."""

    state_rate_hz: float | None = None
    state_age_s: float | None = None
    late_share: float | None = None
    """Of the steps of the last second, those that went out late."""
    estimator: tuple[str, ...] = ()
    """What the estimate lacks, for people."""
    fence: str = ""
    """Which fence is broken, for people; "": none."""
    battery: float | None = None
    """Share that is left."""
    unanswered_s: float | None = None
    """Since the autopilot last answered us."""
    failsafe: str = ""
    """What the autopilot says that is wrong; "": nothing."""


class Guards:
    """Watches one flight.

    Args:
        vehicle: for the limits.
        parameters: the law's; None where it does not fly.
        engine: "python" or "numba".
    """

    def __init__(self, vehicle: Vehicle, parameters: Parameters | None, engine: str = "python") -> None:
        self._engine = engine
        self._vehicle, self._limits = vehicle, vehicle.limits
        self._since: dict[Guard, float] = {}
        self._answered: dict[Guard, int] = {}
        """How many of its stages a guard that is broken has had."""
        self._slowed = False
        self._wrong_s = 0.0
        self._near = False
        """Whether the error was within the bound of the law once: a start from afar is not behind."""
        self._tilt_cosine = math.cos(vehicle.limits.tilt_max_rad)
        self.envelope: Envelope | None = None
        """Of V_H; None where the law does not fly."""
        self._p_max, self._ball = vehicle.controller.position_error_max_m, vehicle.limits.disturbance_max_m_s2
        self._calm = self._calm_limits()
        if parameters is not None:
            self.retune(parameters)

    def retune(self, parameters: Parameters) -> None:
        """Other gains are flown from now on."""
        self._p_max, self._ball = parameters.gains.p_max, parameters.limits.disturbance_max
        self._calm = self._calm_limits()
        self.envelope = Envelope(parameters.gains, parameters.model.drag, disturbance_step(self._limits), self._engine)

    def _calm_limits(self) -> tuple[float, float, float]:
        limits = self._limits
        return min(limits.position_error_abort_m, self._p_max), self._tilt_cosine, limits.rate_error_max_rad_s

    @property
    def calm(self) -> tuple[float, float, float] | None:
        """The largest error [m], smallest cosine of the tilt and largest error of the rates [rad/s] with which `step`
        finds nothing, if the envelope is kept and nothing is saturated; None: `step` must look itself."""
        return self._calm if self._near and not self._since else None

    def restart(self) -> None:
        """The flight begins anew for the guards of the errors: the estimate was reset."""
        if self.envelope is not None:
            self.envelope.restart()

    def step(
        self, q: Quat, error: Vec3, numbers: tuple[float, ...], now_s: float, rate_error: float = 0.0
    ) -> Finding | None:
        """Judges a control step.

        Args:
            q: attitude.
            error: position less reference, NED [m].
            numbers: of the step (`control.flat`).
            now_s: vehicle time [s].
            rate_error: how far the body rates are off the commanded ones [rad/s] (`flight.following`).

        Returns:
            what is to be done now, the hardest of several.
        """
        limits, flags = self._limits, int(numbers[flat.LIMITS])
        since = self._since  # empty in almost all steps, and then not searched
        found: Finding | None = None
        size = math.hypot(*error)
        broken = size > limits.position_error_abort_m
        if broken or (since and Guard.POSITION_ERROR in since):
            found = self._judge(Guard.POSITION_ERROR, broken, size, limits.position_error_abort_m, "m", now_s)
        _, x, y, _ = q
        if 1.0 - 2.0 * (x * x + y * y) < self._tilt_cosine or (since and Guard.TILT in since):
            tilt = tilt_from_quat(q)
            found = _harder(
                found, self._judge(Guard.TILT, tilt > limits.tilt_max_rad, tilt, limits.tilt_max_rad, "rad", now_s)
            )
        limit = limits.rate_error_max_rad_s
        broken = rate_error > limit
        if broken or (since and Guard.FOLLOWING in since):
            found = _harder(found, self._judge(Guard.FOLLOWING, broken, rate_error, limit, "rad/s", now_s))
        bound = self._p_max
        self._near = self._near or size < bound
        if flags or size > bound or since:
            found = _harder(found, self._strained(flags, size, numbers, now_s))
        if self.envelope is not None:
            excess = self.envelope.excess(numbers, now_s)
            if excess is not None:
                found = _harder(found, self._beyond_envelope(excess, now_s))
            elif since and Guard.LYAPUNOV in since:
                self._clear(Guard.LYAPUNOV)
                self._clear(Guard.RUNAWAY)
        return found

    def _beyond_envelope(self, excess: tuple[float, float, str], now_s: float) -> Finding | None:
        """V_H is above its envelope, or far above it."""
        value, most, part = excess
        detail = f"V_H ({part}) {value:.3g} m^2, envelope {most:.3g} m^2"
        found = self._broken(Guard.LYAPUNOV, detail, now_s)
        if value > RUNAWAY * most:
            return _harder(found, self._broken(Guard.RUNAWAY, detail, now_s))
        self._clear(Guard.RUNAWAY)
        return found

    def _strained(self, flags: int, size: float, numbers: tuple[float, ...], now_s: float) -> Finding | None:
        """Saturation, and an error beyond what the law reacts to."""
        limits, bound = self._limits, self._p_max
        behind = self.envelope is not None and self._near and size > bound  # the bound is the law's
        found = self._judge(Guard.BEHIND, behind, size, bound, "m", now_s)
        disturbance = math.hypot(*numbers[flat.B_HAT])
        for guard, mask, value, limit, unit in (
            (Guard.DISTURBANCE, LIMIT_DISTURBANCE, disturbance, self._ball, "m/s^2"),
            (Guard.THRUST, _THRUST, numbers[flat.THRUST], limits.thrust_max_n, "N"),
            (Guard.RATES, _RATES, max(map(abs, numbers[flat.RATES])), max(limits.rate_max_rad_s), "rad/s"),
        ):
            found = _harder(found, self._judge(guard, bool(flags & mask), value, limit, unit, now_s))
        return found

    def slowly(self, seen: Slow, now_s: float) -> Finding | None:
        """Judges what changes slowly; ten times per second.

        Args:
            seen: what is known.
            now_s: vehicle time [s].
        """
        limits, vehicle = self._limits, self._vehicle
        rate_min = limits.state_rate_min * vehicle.link.state_rate_hz
        age_max, silence_max = vehicle.state_age_max_s, limits.link_silence_max_s
        found: Finding | None = None
        for guard, value, limit, unit, below in (
            (Guard.STATE_RATE, seen.state_rate_hz, rate_min, "Hz", True),
            (Guard.STATE_AGE, seen.state_age_s, age_max, "s", False),
            (Guard.LATE_STEPS, seen.late_share, limits.late_steps_max, "of the steps", False),
            (Guard.BATTERY, seen.battery, limits.battery_min, "of the charge", True),
            (Guard.BATTERY_CRITICAL, seen.battery, BATTERY_CRITICAL * limits.battery_min, "of the charge", True),
            (Guard.LINK, seen.unanswered_s, silence_max, "s without an answer", False),
        ):
            broken = value is not None and (value < limit if below else value > limit)
            found = _harder(found, self._judge(guard, broken, value or 0.0, limit, unit, now_s))
        for guard, words in (
            (Guard.ESTIMATOR, ", ".join(seen.estimator)),
            (Guard.FENCE, seen.fence),
            (Guard.FAILSAFE, seen.failsafe),
        ):
            if words:
                found = _harder(found, self._broken(guard, words, now_s))
            else:
                self._clear(guard)
        return found or self._ease(now_s)

    def _judge(self, guard: Guard, broken: bool, value: float, limit: float, unit: str, now_s: float) -> Finding | None:
        if not broken:
            self._clear(guard)
            return None
        return self._broken(guard, f"{value:.3g} {unit}, limit {limit:.3g} ({guard.value.key})", now_s)

    def _broken(self, guard: Guard, detail: str, now_s: float) -> Finding | None:
        """The response that is due, once per stage."""
        begun_s = self._since.setdefault(guard, now_s)
        self._wrong_s = now_s
        stages, answered = guard.value.stages, self._answered.get(guard, 0)
        due = [stage for stage in stages[answered:] if now_s - begun_s >= stage.after_s]
        if not due:
            return None
        self._answered[guard] = answered + len(due)
        response = due[-1].response
        self._slowed = self._slowed or response is Response.SLOW
        lasted = f" for {now_s - begun_s:.1f} s" if due[-1].after_s > 0.0 else ""
        return Finding(guard, response, detail + lasted)

    def _clear(self, guard: Guard) -> None:
        if self._since and guard in self._since:
            del self._since[guard]
            self._answered.pop(guard, None)

    def _ease(self, now_s: float) -> Finding | None:
        if not self._slowed or self._since or now_s - self._wrong_s < EASY_S:
            return None
        self._slowed = False
        return Finding(None, Response.RESUME, f"nothing was wrong for {EASY_S:g} s")


def _harder(a: Finding | None, b: Finding | None) -> Finding | None:
    if a is None or b is None:
        return a or b
    return b if b.response > a.response else a


def disturbance_step(limits: FlightLimits) -> tuple[float, float]:
    """The disturbance step that a flight must bear, horizontal and vertical [m/s^2]."""
    horizontal = limits.disturbance_step_m_s2
    return limits.disturbance_max_m_s2 if horizontal is None else horizontal, limits.disturbance_step_vertical_m_s2
