"""One control step as every flight makes it: predict, evaluate the law at the time of effect, remember what was sent.

The same object flies over MAVLink (`flight.loop`) and in `companion simulate`; it knows nothing of sockets. Its time is
the vehicle's. The arithmetic is `control.history`, `control.model.advance` and `control.law.step` with either engine:
called as they are, or compiled as one kernel (`flight.fused`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from companion import accelerate
from companion.config import Vehicle
from companion.control import flat, history
from companion.control.heading import HeadingState
from companion.control.history import PIECE, Attitude, refreshed
from companion.control.law import (
    LIMIT_THRUST_MAX,
    LIMIT_THRUST_MIN,
    ControllerState,
    Parameters,
    start,
    step,
)
from companion.control.model import Factors, advance, factors
from companion.control.output import (
    Conversion,
    RateSetpoint,
    Setpoint,
    actuator_output,
    attitude_output,
    lead,
    rates_output,
)
from companion.control.types import GRAVITY_M_S2, Reference, State, Vec3, new_record
from companion.control.vectors import add, axes, norm
from companion.control.vectors import scale as scale_vector
from companion.flight import fused
from companion.flight.course import Timed
from companion.flight.prediction import Prediction
from companion.flight.reflex import DECLINED, Reflex
from companion.flight.resets import Reset, about_vertical
from companion.flight.retuning import Transition, Turning, between
from companion.flight.thrust_scale import ThrustScale

ZERO: Vec3 = (0.0, 0.0, 0.0)
_GIVEN = (0.0,) * fused.INPUT
"""Neither on a curve nor with a history."""
_RESULTS, _REST, _REFERENCE = 8 * fused.RESULTS, 8 * fused.SHARE, 8 * (fused.INPUT + flat.REFERENCE)
"""Where results and the reference stand, in bytes."""
THRUST_LIMITS = LIMIT_THRUST_MIN | LIMIT_THRUST_MAX
ReferenceAt = Callable[[float], Reference]
Numbers = tuple[float, ...]


class Target(NamedTuple):
    """Where the reference is at an instant."""

    p: Vec3
    """Position, NED [m]."""
    v: Vec3
    """Velocity, NED [m/s]."""


class WholeStep(NamedTuple):
    """What a control step starts from."""

    stamp_s: float
    """Vehicle time of the state [s]."""
    state: State
    """As received."""
    delay_s: float
    """From the stamp to the effect of the command [s]."""
    frozen: bool
    """Hold the estimator still."""
    integrate: bool
    """Whether the controller's state goes on."""
    dt_s: float
    """Since the last step [s]."""


class Engine(Protocol):
    """The arithmetic of the control steps, with the controller's state."""

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        ...

    @property
    def controller(self) -> ControllerState:
        """The controller's state after the last step."""
        ...

    def retune(self, parameters: Parameters) -> None:
        """Steps with these parameters from now on; the model stays."""
        ...

    def relag(self, lags: Factors) -> None:
        """Steps with pieces of another length from now on: their `model.factors`."""
        ...

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: Sequence[float],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step; returns the numbers that `control.flat` names (flat.THRUST ...).

        Args:
            state: as received.
            reference: at the time of effect.
            thrust: that acts at the state's stamp [N].
            pieces: what acts from the stamp to the time of effect, `history.PIECE` numbers each.
            frozen: hold the estimator still.
            integrate: whether the controller's state goes on.
            dt_s: since the last step [s].
        """
        ...


class Kernels(NamedTuple):
    """The engine of the control steps."""

    engine: str
    """ "python" or "numba"."""
    build: Callable[[Parameters, Factors], Engine]


def kernels(engine: str) -> Kernels:
    """The arithmetic for an engine: "python", "numba", or "auto" (numba where it is installed)."""
    chosen = accelerate.resolve(engine)
    return Kernels(chosen, CompiledEngine if chosen == "numba" else PlainEngine)


class PlainEngine:
    """The control step as plain Python."""

    def __init__(self, parameters: Parameters, lags: Factors) -> None:
        self._parameters = parameters
        self._vehicle = (parameters.model.mass, parameters.model.gravity, parameters.model.drag)
        self._lags = lags
        self._controller: ControllerState | None = None

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        self._controller = controller

    @property
    def controller(self) -> ControllerState:
        """The controller's state after the last step."""
        assert self._controller is not None
        return self._controller

    def retune(self, parameters: Parameters) -> None:
        """Steps with these parameters from now on; the model stays."""
        self._parameters = parameters

    def relag(self, lags: Factors) -> None:
        """Steps with pieces of another length from now on."""
        self._lags = lags

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: Sequence[float],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step (see Engine)."""
        controller = self._controller
        assert controller is not None
        for i in range(0, len(pieces), PIECE):
            setpoint, x, y, z, duration_s = pieces[i : i + PIECE]
            state, thrust = advance(
                state, thrust, (x, y, z), setpoint, controller.b_hat, self._vehicle, self._lags, duration_s
            )
        command, after, out = step(state, reference, controller, self._parameters, frozen, dt_s)
        if integrate:
            self._controller = after
        else:
            after = controller
        return flat.results(command, after, out, self._parameters.gains.p_max, state)


class CompiledEngine:
    """The control step compiled as one kernel over arrays that are allocated once (`flight.fused`)."""

    def __init__(self, parameters: Parameters, lags: Factors) -> None:
        import numpy as np

        self._kernel: Any = accelerate.compile_kernel(fused.flight_step)
        self._m = m = np.zeros(fused.SIZE)
        self._x = m[fused.INPUT : fused.CONSTANTS]
        self._c = m[fused.CONSTANTS : fused.CONVERSION]
        self._no_curve = np.zeros(fused.NO_CURVE)
        self._no_history = np.zeros(history.CAPACITY)
        self._lags = lags
        self.retune(parameters)
        self._doubles: Any = m.data
        self._bytes = m.data.cast("B")
        self._pack = struct.Struct(f"{fused.INPUT + flat.THRUST_NOW}d").pack_into
        self._pack_reference = struct.Struct("18d").pack_into
        self._pack_curve = struct.Struct("3d").pack_into
        self._unpack = struct.Struct(f"{flat.RESULTS}d").unpack_from
        self._unpack_rest = struct.Struct(f"{fused.SIZE - fused.SHARE}d").unpack_from

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        self._x[flat.CONTROLLER : flat.PIECES] = flat.controller_numbers(controller)

    @property
    def controller(self) -> ControllerState:
        """The controller's state after the last step."""
        return flat.controller_of_numbers(self._x[flat.CONTROLLER : flat.PIECES].tolist())

    def retune(self, parameters: Parameters) -> None:
        """Steps with these parameters from now on; the model stays."""
        self._c[:] = flat.constants(parameters, self._lags)

    def relag(self, lags: Factors) -> None:
        """Steps with pieces of another length from now on."""
        self._lags = lags
        self._c[-len(lags) :] = lags

    def convert(self, thrust_full_n: float, curve_factor: float) -> None:
        """Turns thrust into commands so from now on (`output.Conversion`)."""
        self._m[fused.CONVERSION : fused.LAGS] = thrust_full_n, curve_factor

    def predict(self, lags_s: Vec3, delay_s: float) -> None:
        """Predicts over this delay [s] from now on; lags of roll, pitch and yaw rate behind their setpoints [s]."""
        self._m[fused.LAGS : fused.ATTITUDE] = *lags_s, delay_s

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: Sequence[float],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step (see Engine)."""
        x = self._x
        self._pack(self._bytes, 0, *_GIVEN, *state.p, *state.v, *state.q, *state.w, dt_s, frozen, integrate)
        self._give(reference)
        x[flat.THRUST_NOW], x[flat.COUNT] = thrust, len(pieces) / PIECE
        x[flat.PIECES : flat.PIECES + len(pieces)] = pieces
        self._kernel(self._m, self._no_history, self._no_curve)
        return self._unpack(self._bytes, _RESULTS)

    def fly(
        self, step: WholeStep, prediction: Prediction, reference_at: ReferenceAt, attitude: Attitude | None
    ) -> tuple[Numbers, tuple[float, ...], bool]:
        """One step with its history and its reference.

        Args:
            step: what the tracker has decided.
            prediction: gives commands and gets this one.
            reference_at: the reference as a function of vehicle time [s].
            attitude: newer than the state.

        Returns:
            the numbers of `step`, those from `fused.SHARE` on, and whether the last six of them are known.
        """
        stamp_s, (p, v, q, w), delay_s, frozen, integrate, dt_s = step
        timed = reference_at if isinstance(reference_at, Timed) else None
        curve = None if timed is None else timed.curve(stamp_s, delay_s)
        if timed is None or curve is None:
            self._pack(self._bytes, 0, stamp_s, 0.0, 0.0, 0.0, 1.0, *p, *v, *q, *w, dt_s, frozen, integrate)
            self._give(reference_at(stamp_s + delay_s))
        else:
            begin_s, piece_s = timed.begin_s, curve.begin_s
            self._pack(self._bytes, 0, stamp_s, 1.0, begin_s, piece_s, 1.0, *p, *v, *q, *w, dt_s, frozen, integrate)
        self.give_attitude(attitude)
        self._kernel(self._m, prediction.numbers, self._no_curve if curve is None else curve.numbers)
        return *self.results(), curve is not None

    def refer(self, timed: Timed, stamp_s: float, delay_s: float) -> Any:
        """Gives the next step its reference, for a state with this stamp [s]; returns the curve that it is on."""
        curve = timed.curve(stamp_s, delay_s)
        if curve is None:
            self._doubles[fused.ON_CURVE] = 0.0
            self._give(timed(stamp_s + delay_s))
            return self._no_curve
        self._pack_curve(self._bytes, 8 * fused.ON_CURVE, 1.0, timed.begin_s, curve.begin_s)
        return curve.numbers

    @property
    def numbers(self) -> Any:
        """What `fused.flight_step` works on."""
        return self._m

    @property
    def on_curve(self) -> bool:
        """Whether the last step had its reference from a curve."""
        return bool(self._doubles[fused.ON_CURVE] > 0.5)

    @property
    def refreshed(self) -> bool:
        """Whether the last step predicted from an attitude newer than its state."""
        return bool(self._doubles[fused.REFRESHED] > 0.5)

    def give_attitude(self, attitude: Attitude | None) -> None:
        """One that is newer than the next state, if there is one."""
        if attitude is None:
            self._doubles[fused.ATTITUDE] = 0.0
        else:
            self._m[fused.ATTITUDE : fused.RESULTS] = attitude.at_s, *attitude.q, *attitude.w

    def results(self) -> tuple[Numbers, Numbers]:
        """What the last step gave: the numbers of `step`, and those from `fused.SHARE` on."""
        return self._unpack(self._bytes, _RESULTS), self._unpack_rest(self._bytes, _REST)

    def _give(self, reference: Reference) -> None:
        p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = reference
        self._pack_reference(self._bytes, _REFERENCE, *p, *v, *a, *j, *s, yaw, yaw_rate, yaw_acceleration)


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


class Tracker:
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
        self._attitude: Attitude | None = None
        self.refreshed = 0
        """States whose rotation was predicted from a newer attitude."""

    def _factors(self) -> Factors:
        return factors(self._lags_s, self._prediction.length_s or self._interval_s)

    def _use(self, engine: Engine) -> None:
        """Steps with this engine from now on."""
        self._engine = engine
        self._whole = engine if isinstance(engine, CompiledEngine) else None
        self._inform()

    def _inform(self) -> None:
        """Tells an engine that makes whole steps what it needs for them."""
        if self._whole is not None:
            x, y, z, _ = self._lags_s
            self._whole.convert(self._conversion.thrust_full_n, self._conversion.curve_factor)
            self._whole.predict((x, y, z), self.delay_s)

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
        self._last_s = None
        self._attitude = None

    def step(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> TrackerStep:
        """The command for one state.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            reference_at: the reference as a function of vehicle time [s]; it is asked for the time of effect.
            frozen: hold the estimator still.
        """
        dt = self._interval_s
        integrate = True
        if self._last_s is not None:
            dt = stamp_s - self._last_s
            if not 0.0 < dt <= self._gap_max_s:  # too long to integrate over: the controller's state waits
                dt, integrate = self._interval_s, False
        self._last_s, self._seen = stamp_s, state
        prediction = self._prediction
        if self._delay_wanted_s is not None:
            self._retime(self._delay_wanted_s, stamp_s)
        if self._transition is not None:
            self._follow(self._transition, stamp_s, state)
        if self._scale is not None:
            prediction.follow(stamp_s)
            self._weigh(self._scale, stamp_s, state, integrate)
        attitude = self._attitude
        if attitude is not None and attitude.at_s <= stamp_s:
            attitude = self._attitude = None
        start = WholeStep(stamp_s, state, self.delay_s, frozen or not integrate, integrate, dt)
        out = (
            self._step(start, reference_at, attitude)
            if self._whole is None
            else self._fly(self._whole, start, reference_at, attitude)
        )
        if self._scale is not None and int(out.numbers[flat.LIMITS]) & THRUST_LIMITS:
            self._scale.interrupt()
        return out

    def answer(self, reflex: Reflex, timed: Timed) -> int:
        """Lets a reflex make the next step from the datagram that it took, if all is as it was for the last one.

        Returns:
            what `reflex.reflex` does.
        """
        whole, last_s = self._whole, self._last_s
        same = self._delay_wanted_s is None and self._transition is None and self._scale is None
        if whole is None or last_s is None or not (same and self._by_rates):
            return DECLINED
        whole.give_attitude(self._attitude)
        r = whole.refer(timed, reflex.stamp_us * 1e-6, self.delay_s)
        return reflex.run(whole.numbers, self._prediction.numbers, r, last_s, self._gap_max_s)

    def answered(self, stamp_s: float, state: State) -> None:
        """The step that `answer` has made was for this state."""
        assert self._whole is not None
        self._last_s, self._seen = stamp_s, state
        if self._attitude is not None:
            if self._attitude.at_s <= stamp_s:
                self._attitude = None
            self.refreshed += self._whole.refreshed

    @property
    def numbers(self) -> Any:
        """What the last step worked on (`fused.flight_step`), where it was one call and its reference on a curve; else
        None."""
        whole = self._whole
        return whole.numbers if whole is not None and whole.on_curve else None

    def last_step(self) -> TrackerStep:
        """What the last step did, where it was one call."""
        assert self._whole is not None
        return self._whole_step(*self._whole.results(), on_curve=self._whole.on_curve)

    def _step(self, start: WholeStep, reference_at: ReferenceAt, attitude: Attitude | None) -> TrackerStep:
        """The step put together here."""
        stamp_s, state, delay_s, frozen, integrate, dt_s = start
        prediction = self._prediction
        pieces = prediction.pieces(stamp_s)
        if attitude is not None:
            x, y, z, _ = self._lags_s
            state, used = refreshed(state, stamp_s, attitude, pieces, 0, len(pieces) // PIECE, (x, y, z))
            self.refreshed += used
        reference = reference_at(stamp_s + delay_s)
        numbers = self._engine.step(state, reference, prediction.thrust, pieces, frozen, integrate, dt_s)
        prediction.sent(stamp_s, numbers[flat.THRUST], numbers[flat.RATES_MODEL])
        return TrackerStep(self._convert(numbers, dt_s), numbers)

    def _fly(
        self, whole: CompiledEngine, start: WholeStep, reference_at: ReferenceAt, attitude: Attitude | None
    ) -> TrackerStep:
        """The step as one call."""
        n, rest, on_curve = whole.fly(start, self._prediction, reference_at, attitude)
        self.refreshed += whole.refreshed
        return self._whole_step(n, rest, on_curve=on_curve, dt_s=start.dt_s)

    def _whole_step(self, n: Numbers, rest: Numbers, *, on_curve: bool, dt_s: float = 0.0) -> TrackerStep:
        """What a step did that was one call."""
        share, _, px, py, pz, vx, vy, vz = rest
        setpoint = new_record(RateSetpoint, (share, _vec3(n[flat.RATES]))) if self._by_rates else self._convert(n, dt_s)
        return TrackerStep(setpoint, n, Target((px, py, pz), (vx, vy, vz)) if on_curve else None)

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
            self._delay_wanted_s = delay_s

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
        self._attitude = None
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
        self._transition = Transition(math.nan, ramp_s, self.parameters, parameters)

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

    def _convert(self, n: Numbers, dt_s: float) -> Setpoint:
        rates, thrust = _vec3(n[flat.RATES]), n[flat.THRUST]
        if self._by_rates:
            return rates_output(thrust, rates, self._conversion)
        tau, w = _vec3(n[flat.TAU]), _vec3(n[flat.PREDICTED_W])
        if self._output == "actuators":
            ahead, self._slow_tau = lead(tau, self._slow_tau, self.vehicle.rotors.lag_s, dt_s)
            return actuator_output(thrust, ahead, w, self._conversion)
        a, b, c, d = n[flat.PREDICTED_Q]
        return attitude_output(thrust, rates, tau, (a, b, c, d), w, self._conversion)


def _vec3(numbers: Numbers) -> Vec3:
    x, y, z = numbers
    return x, y, z
