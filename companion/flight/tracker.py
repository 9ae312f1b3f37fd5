"""One control step as every flight makes it: predict, evaluate the law at the time of effect, remember what was sent.

The same object flies over MAVLink (`flight.loop`) and in `companion simulate`; it knows nothing of sockets. Its time is
the vehicle's. The arithmetic is an engine's (`flight.engines`); what is sent is worked out first, and everything else
that is known of the step when it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from companion.config import Vehicle
from companion.control import flat
from companion.control.heading import HeadingState
from companion.control.history import THRUST, Attitude, refreshed
from companion.control.law import LIMIT_THRUST_MAX, LIMIT_THRUST_MIN, ControllerState, Parameters, start
from companion.control.model import PIECE, Factors, advance, factors
from companion.control.output import (
    Conversion,
    Setpoint,
    actuator_output,
    attitude_output,
    lead,
    rates_output,
)
from companion.control.types import GRAVITY_M_S2, State, Vec3
from companion.control.vectors import add, axes, norm
from companion.control.vectors import scale as scale_vector
from companion.flight.course import Timed
from companion.flight.engines import (
    CompiledEngine,
    Engine,
    Kernels,
    Numbers,
    PlainEngine,
    ReferenceAt,
    Stepped,
    WholeSteps,
)
from companion.flight.prediction import Prediction
from companion.flight.reflex import DECLINED, Reflex
from companion.flight.resets import Reset, about_vertical
from companion.flight.retuning import Transition, Turning, between
from companion.flight.thrust_scale import ThrustScale

ZERO: Vec3 = (0.0, 0.0, 0.0)
THRUST_LIMITS = LIMIT_THRUST_MIN | LIMIT_THRUST_MAX


class Target(NamedTuple):
    """Where the reference is at an instant."""

    p: Vec3
    """Position, NED [m]."""
    v: Vec3
    """Velocity, NED [m/s]."""


class TrackerStep(NamedTuple):
    """What one control step did."""

    setpoint: Setpoint
    numbers: Numbers
    """Everything else, in the order that `control.flat` names."""
    target: Target | None = None
    """The reference at the state's stamp, where the step has found it on the way."""

    @property
    def errors(self) -> tuple[Vec3, Vec3, Vec3, Vec3]:
        """e1 to e4 at the time of effect [m]."""
        n = self.numbers[flat.ERRORS]
        return (n[0], n[1], n[2]), (n[3], n[4], n[5]), (n[6], n[7], n[8]), (n[9], n[10], n[11])

    @property
    def rates(self) -> Vec3:
        """Body rate setpoint [rad/s]."""
        return _vec3(self.numbers[flat.RATES])

    @property
    def tau(self) -> Vec3:
        """Angular acceleration [rad/s^2]."""
        return _vec3(self.numbers[flat.TAU])

    @property
    def b_hat(self) -> Vec3:
        """Disturbance estimate after the step, NED [m/s^2]."""
        return _vec3(self.numbers[flat.B_HAT])


class Stepping(Protocol):
    """Answers every state with one setpoint, and tells the rest when it is asked."""

    def command(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> Setpoint:
        """The setpoint for one state.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            reference_at: the reference as a function of vehicle time [s].
            frozen: hold what is estimated still.
        """
        ...

    def last_step(self) -> TrackerStep:
        """All that is known of the last step; for what can wait until its setpoint is out."""
        ...

    def step(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> TrackerStep:
        """Both at once, where nobody waits for the setpoint."""
        self.command(stamp_s, state, reference_at, frozen=frozen)
        return self.last_step()


def conversion(vehicle: Vehicle) -> Conversion:
    """The vehicle's normalisation; full torque is what the rotors give with half of them at full command, per axis."""
    rotors = vehicle.rotors
    half = 0.5 * rotors.thrust_max_n
    x, y, z = (half * sum(abs(arm) for arm in axis) for axis in (rotors.y_m, rotors.x_m, rotors.yaw_moment_m))
    return Conversion(
        vehicle.thrust_full_n,
        rotors.curve_factor,
        vehicle.autopilot.attitude_gain_1_s,
        vehicle.autopilot.attitude_lag_s,
        vehicle.body.inertia_kg_m2,
        (x, y, z),
    )


class Tracker(Stepping):
    """The controller of one flight.

    Args:
        vehicle: the vehicle file.
        output: "rates", "attitude" or "actuators".
        compiled: the engine.
    """

    def __init__(self, vehicle: Vehicle, output: str, compiled: Kernels) -> None:
        self.vehicle = vehicle
        self.engine = compiled.engine
        self.parameters = vehicle.parameters()
        self._output, self._by_rates = output, output == "rates"
        x, y, z = vehicle.autopilot.rate_lag_s
        self._lags_s = (x, y, z, vehicle.rotors.lag_s)
        self._conversion = conversion(vehicle)
        self._interval_s = 1.0 / vehicle.link.state_rate_hz
        self._gap_max_s = vehicle.limits.state_gap_max_s
        self._last_s: float | None = None
        self._slow_tau: Vec3 = ZERO
        self.delay_s = vehicle.delay_s if vehicle.controller.prediction else 0.0
        self._prediction = Prediction(vehicle.rotors.lag_s, self.delay_s, 0.0, compiled.engine)
        self._lags = self._factors()
        self._same: Timed | None = None
        """The reference of the last step, if nothing but its state need be new in the next one."""
        self._build: Callable[[Parameters], Engine] = lambda parameters: compiled.build(parameters, self._lags)
        self._use(self._build(self.parameters))
        self._scale = ThrustScale(vehicle) if vehicle.controller.thrust_scale_estimate else None
        self._transition: Transition | None = None
        self.transitions: list[Transition] = []
        """The ways to other parameters so far, the one under way among them."""
        self.delays: list[tuple[float, float]] = []
        """The delays that were predicted over after the vehicle file's, each with the stamp of its first state [s]."""
        self._delay_wanted_s: float | None = None
        self._seen: State | None = None
        self._setpoint: Setpoint | None = None
        self._attitude: Attitude | None = None
        self.refreshed = 0
        """States whose rotation was predicted from a newer attitude."""

    def _factors(self) -> Factors:
        return factors(self._lags_s, self._prediction.length_s or self._interval_s)

    def _use(self, engine: Engine) -> None:
        """Steps with this engine from now on."""
        self._engine = engine
        self._compiled = engine if isinstance(engine, CompiledEngine) else None
        self._whole: WholeSteps | None = engine if isinstance(engine, PlainEngine | CompiledEngine) else None
        self._same = None
        self._inform()

    def _inform(self) -> None:
        """Tells an engine that makes whole steps what it needs for them."""
        if self._whole is not None:
            x, y, z, _ = self._lags_s
            self._whole.convert(self._conversion.thrust_full_n, self._conversion.curve_factor)
            self._whole.predict(self._prediction.numbers, (x, y, z), self.delay_s, self._interval_s, self._gap_max_s)

    def begin(self, state: State, thrust_n: float | None = None) -> None:
        """Starts the controller's state from a hover: T(0), T'(0) = 0 and b_hat(0) such that nothing steps (section 8).

        Args:
            state: the vehicle now.
            thrust_n: the thrust that acts [N]; when unknown, the one that carries the weight.
        """
        model, limits = self.parameters.model, self.parameters.limits
        r1, r2, r3 = axes(state.q)
        thrust = thrust_n
        if thrust is None:  # what carries the weight at this tilt
            thrust = model.mass * GRAVITY_M_S2 / max(r3[2], 0.5)
        thrust = min(max(thrust, limits.thrust_min), limits.thrust_max)
        b_hat: Vec3 = ZERO
        if self.vehicle.controller.disturbance_start == "hover":
            _, b_hat = start(thrust, state.q, model.mass, model.gravity, limits.disturbance_max)
        self._engine.begin(ControllerState(thrust, 0.0, b_hat, HeadingState(r2, r1, False), ZERO))
        self._prediction.begin(thrust)
        if self._scale is not None:
            self._scale = ThrustScale(self.vehicle)
            self._conversion = conversion(self.vehicle)
            self._inform()
        self._slow_tau = ZERO
        self._last_s = self._same = None
        self._attitude = None

    def command(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> Setpoint:
        """The command for one state.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            reference_at: the reference as a function of vehicle time [s]; it is asked for the time of effect.
            frozen: hold the estimator still.
        """
        timed = self._same
        if timed is not None and timed is reference_at and self._attitude is None and not frozen:
            assert self._whole is not None
            sent = self._whole.again(stamp_s, state, timed)
            if sent is not None:
                self._last_s, self._seen, self._setpoint = stamp_s, state, sent
                return sent
        last_s = self._last_s
        self._last_s, self._seen, self._same = stamp_s, state, None
        gap = last_s is not None and not 0.0 < stamp_s - last_s <= self._gap_max_s  # the controller's state waits
        if self._delay_wanted_s is not None:
            self._retime(self._delay_wanted_s, stamp_s)
        if self._transition is not None:
            self._follow(self._transition, stamp_s, state)
        if self._scale is not None:
            self._prediction.follow(stamp_s)
            self._weigh(self._scale, stamp_s, state, not gap)
        if self._attitude is not None and self._attitude.at_s <= stamp_s:
            self._attitude = None
        dt_s = self._interval_s if gap or last_s is None else stamp_s - last_s
        if self._whole is None:
            out = self._step(stamp_s, state, dt_s, gap, reference_at, frozen)
        else:
            out = self._fly(self._whole, stamp_s, state, last_s, reference_at, frozen)
        self._setpoint = self._convert(out, dt_s)
        if self._scale is not None:
            (_, _, _, _, limits), _, _ = out
            if limits & THRUST_LIMITS:
                self._scale.interrupt()
        return self._setpoint

    def last_step(self) -> TrackerStep:
        """All that is known of the last step."""
        whole, setpoint = self._compiled, self._setpoint
        target = None if whole is None else whole.target
        if setpoint is None:
            assert whole is not None
            setpoint = whole.sent
        return TrackerStep(setpoint, self._engine.numbers(), None if target is None else Target(*target))

    def answer(self, reflex: Reflex, timed: Timed) -> int:
        """Lets a reflex make the next step from the datagram that it took, if all is as it was for the last one.

        Returns:
            what `reflex.reflex` does.
        """
        whole = self._compiled
        same = self._delay_wanted_s is None and self._transition is None and self._scale is None
        if whole is None or self._last_s is None or not (same and self._by_rates):
            return DECLINED
        whole.give_attitude(self._attitude)
        whole.refer(timed, reflex.stamp_us * 1e-6)
        return reflex.run(whole.memory, self._prediction.numbers, whole.curve)

    def answered(self, stamp_s: float, state: State) -> None:
        """The step that `answer` has made was for this state."""
        assert self._compiled is not None
        self._last_s, self._seen, self._setpoint = stamp_s, state, None
        if self._attitude is not None:
            if self._attitude.at_s <= stamp_s:
                self._attitude = None
            self.refreshed += self._compiled.refreshed

    @property
    def memory(self) -> tuple[Any, Any] | None:
        """What the last step worked on, and its curve (`fused.flight_step`), where it was one call and its reference on
        a curve; else None."""
        whole = self._compiled
        return (whole.memory, whole.curve) if whole is not None and whole.on is not None else None

    def _step(
        self, stamp_s: float, state: State, dt_s: float, gap: bool, reference_at: ReferenceAt, frozen: bool
    ) -> Stepped:
        """The step of two engines at once, put together here; `gap`: it is too long to integrate over."""
        prediction = self._prediction
        pieces = prediction.pieces(stamp_s)
        if self._attitude is not None:
            x, y, z, _ = self._lags_s
            count = len(pieces) // PIECE
            state, used = refreshed(state, stamp_s, self._attitude, pieces, 0, count, (x, y, z))
            self.refreshed += used
        reference = reference_at(stamp_s + self.delay_s)
        thrust = prediction.numbers[THRUST]
        out = self._engine.step(state, reference, thrust, pieces, frozen or gap, not gap, dt_s)
        (thrust, _, rates_model, _, _), _, _ = out
        prediction.sent(stamp_s, thrust, rates_model)
        return out

    def _fly(
        self,
        whole: WholeSteps,
        stamp_s: float,
        state: State,
        last_s: float | None,
        reference_at: ReferenceAt,
        frozen: bool,
    ) -> Stepped:
        """The step as one call; whether the next one may be like it, is remembered."""
        out = whole.fly(stamp_s, state, last_s, reference_at, self._attitude, frozen)
        self.refreshed += whole.refreshed
        steady = self._transition is None and self._scale is None and not frozen
        if steady and self._by_rates and isinstance(reference_at, Timed):
            self._same = reference_at
        return out

    # -- the thrust's scale ---------------------------------------------------------------------------------------

    @property
    def thrust_scale(self) -> float | None:
        """What a thrust command gives, over what the vehicle file says; None: it is not followed."""
        return None if self._scale is None else self._scale.used

    def _weigh(self, scale: ThrustScale, stamp_s: float, state: State, whole: bool) -> None:
        """Shows a state to the estimate of the thrust's scale, and takes a new scale over without a step.

        What goes out stays: T, T' and the thrust that is under way become as much larger as the command for them gets
        smaller. What is believed stays: b_hat takes up the difference, so that a of section 2 does not change.
        """
        if not whole:
            scale.interrupt()
        ratio = scale.on_state(stamp_s, state, self._prediction.thrust)
        if ratio == 1.0:
            return
        controller, limits = self._engine.controller, self.parameters.limits
        thrust = ratio * controller.thrust
        r3 = axes(state.q)[2]
        b_hat = add(controller.b_hat, scale_vector((thrust - controller.thrust) / self.parameters.model.mass, r3))
        if not (limits.thrust_min < thrust < limits.thrust_max and norm(b_hat) < limits.disturbance_max):
            return
        scale.take(ratio)
        self._prediction.rescale(ratio)
        self._engine.begin(controller._replace(thrust=thrust, thrust_rate=ratio * controller.thrust_rate, b_hat=b_hat))
        self._conversion = self._conversion._replace(thrust_full_n=self.vehicle.thrust_full_n * scale.used)
        self._inform()

    # -- what the states alone do not tell ------------------------------------------------------------------------

    def refresh(self, attitude: Attitude) -> None:
        """An attitude that may be newer than the next state: the prediction's rotation then starts from it."""
        self._attitude = attitude

    def retime(self, delay_s: float) -> None:
        """Predicts over another delay from the next state on [s]; nothing changes where nothing is predicted."""
        if self.vehicle.controller.prediction and delay_s > 0.0:
            self._delay_wanted_s, self._same = delay_s, None

    def _retime(self, delay_s: float, stamp_s: float) -> None:
        self._delay_wanted_s = None
        self.delay_s = delay_s
        self.delays.append((stamp_s, delay_s))
        self._prediction.retime(delay_s)
        self._lags = self._factors()
        self._engine.relag(self._lags)
        self._inform()

    def foresee(self, stamp_s: float) -> tuple[State, float] | None:
        """The state at a stamp, from the last one and the commands since, and the thrust over the mass [m/s^2]; None
        before the first state."""
        state, thrust, model = self._seen, self._prediction.thrust, self.parameters.model
        if state is None or self._last_s is None:
            return None
        vehicle, b_hat = (model.mass, model.gravity, model.drag), self._engine.controller.b_hat
        for setpoint, rates, duration_s in self._prediction.between(self._last_s, stamp_s):
            lags = factors(self._lags_s, duration_s)
            state, thrust = advance(state, thrust, rates, setpoint, b_hat, vehicle, lags, duration_s)
        return state, thrust / model.mass

    def carry(self, reset: Reset) -> None:
        """Goes on after a reset of the autopilot's estimate as if nothing had happened: what is remembered in the
        inertial frame turns along."""
        controller, yaw = self._engine.controller, reset.turned_rad
        heading, b_hat = controller.heading, add(controller.b_hat, reset.disturbance_m_s2)
        size, bound = norm(b_hat), self.parameters.limits.disturbance_max
        if size > bound:
            b_hat = scale_vector(bound / size, b_hat)
        heading = HeadingState(about_vertical(yaw, heading.r2d), about_vertical(yaw, heading.forward), heading.held)
        self._engine.begin(controller._replace(b_hat=b_hat, heading=heading))
        self._attitude = self._same = None  # an answer that was declined has given it already
        if self._scale is not None:
            self._scale.interrupt()

    # -- other parameters in flight -------------------------------------------------------------------------------

    @property
    def changing(self) -> bool:
        """Whether the parameters are on their way to others."""
        return self._transition is not None

    def retune(self, parameters: Parameters, ramp_s: float) -> None:
        """Moves the law's parameters to others: linearly over `ramp_s` [s] of vehicle time, from the next step on.

        Whether they and the way there are sound is the caller's affair (`retuning.Retuning`).

        Args:
            parameters: with the model that flies; `retuning.flown` makes them.
            ramp_s: above 0 [s].

        Raises:
            ValueError: one change is under way, or this one has another model.
        """
        if self.changing:
            raise ValueError("the parameters are on their way to others")
        if parameters.model != self.parameters.model or not ramp_s > 0.0:
            raise ValueError("the model does not change in flight, and nothing changes in no time")
        self._transition, self._same = Transition(math.nan, ramp_s, self.parameters, parameters), None

    def _follow(self, way: Transition, stamp_s: float, state: State) -> None:
        """The parameters for the state with this stamp."""
        if math.isnan(way.begin_s):
            self._transition = way = way._replace(begin_s=stamp_s)
            self.transitions.append(way)
            if way.new.gains.heading_kind != way.old.gains.heading_kind:
                self._turn(way.old.gains.heading_kind, state)
        share = min(max((stamp_s - way.begin_s) / way.duration_s, 0.0), 1.0)
        self.parameters = between(way.old, way.new, share)
        self._engine.retune(self.parameters)
        engine = self._engine
        if isinstance(engine, Turning):
            engine.share = share
            if share == 1.0:
                self._use(engine.new)
        if share == 1.0:
            self._transition = None

    def _turn(self, kind: int, state: State) -> None:
        """Another kind of heading begins; where it defines no direction it holds the one in which the nose points."""
        r1, r2, _ = axes(state.q)
        engine = self._build(self.parameters)
        engine.begin(self._engine.controller._replace(heading=HeadingState(r2, r1, False)))
        self._use(Turning(self._engine, engine, kind))

    def _convert(self, out: Stepped, dt_s: float) -> Setpoint:
        (thrust, rates, _, tau, _), q, w = out
        if self._by_rates:
            return rates_output(thrust, rates, self._conversion)  # as `fused.flight_step` does
        if self._output == "actuators":
            ahead, self._slow_tau = lead(tau, self._slow_tau, self.vehicle.rotors.lag_s, dt_s)
            return actuator_output(thrust, ahead, w, self._conversion)
        return attitude_output(thrust, rates, tau, q, w, self._conversion)


def _vec3(numbers: Numbers) -> Vec3:
    x, y, z = numbers
    return x, y, z
