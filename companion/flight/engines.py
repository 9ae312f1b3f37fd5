"""The arithmetic of the control steps: called as it is written, or compiled.

Both engines call the very same `control.model.through` and `control.law.step_plain`, and make whole steps: with the
history of commands and the reference, which the compiled one works out in the same call (`flight.fused`) where it is on
a curve. A tracker whose steps are all alike asks for the next one with hardly more than the state.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, MutableSequence, Sequence
from typing import Any, NamedTuple, Protocol

from companion import accelerate
from companion.control import flat, history
from companion.control.history import THRUST, Attitude, follow, gather, remember
from companion.control.law import (
    ControllerState,
    Parameters,
    PlainCommand,
    PlainController,
    PlainEvaluation,
    PlainParameters,
    controller_of,
    step_plain,
)
from companion.control.model import PIECE, Factors, through
from companion.control.output import RateSetpoint, thrust_fraction
from companion.control.types import PlainState, Quat, Reference, State, Vec3, new_record
from companion.flight import fused
from companion.flight.course import Curve, Timed
from companion.flight.prediction import PIECES_MAX

Numbers = tuple[float, ...]
ReferenceAt = Callable[[float], Reference]
_SENT, _RESULTS, _TARGET = 8 * fused.SENT, 8 * fused.RESULTS, 8 * fused.TARGET
_REFERENCE, _COURSE = 8 * (fused.INPUT + flat.REFERENCE), 8 * fused.ON_CURVE
"""Where things stand in the memory, in bytes."""


Stepped = tuple[PlainCommand, Quat, Vec3]
"""What one step of an engine gives to be sent and remembered: the command, and the attitude and the body rates [rad/s]
for which it was computed."""


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
    ) -> Stepped:
        """One step.

        Args:
            state: as received.
            reference: at the time of effect.
            thrust: that acts at the state's stamp [N].
            pieces: what acts from the stamp to the time of effect, `model.PIECE` numbers each.
            frozen: hold the estimator still.
            integrate: whether the controller's state goes on.
            dt_s: since the last step [s].
        """
        ...

    def numbers(self) -> Numbers:
        """All of the last step: the numbers that `control.flat` names (flat.THRUST ...)."""
        ...


class WholeSteps(Engine, Protocol):
    """An engine that makes whole steps: with the history of commands and the reference."""

    @property
    def refreshed(self) -> bool:
        """Whether the last step predicted from an attitude newer than its state."""
        ...

    def convert(self, thrust_full_n: float, curve_factor: float) -> None:
        """Turns thrust into commands so from now on (`output.Conversion`)."""
        ...

    def predict(
        self, commands: MutableSequence[float], lags_s: Vec3, delay_s: float, interval_s: float, gap_max_s: float
    ) -> None:
        """How whole steps are made from now on.

        Args:
            commands: the history (`control.history`).
            lags_s: of roll, pitch and yaw rate behind their setpoints [s].
            delay_s: from a stamp to the effect of its command [s].
            interval_s: in place of the time since the last step, where there is none to integrate over [s].
            gap_max_s: the longest one to integrate over [s].
        """
        ...

    def fly(
        self,
        stamp_s: float,
        state: State,
        last_s: float | None,
        reference_at: ReferenceAt,
        attitude: Attitude | None,
        frozen: bool,
    ) -> Stepped:
        """A whole step.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            last_s: stamp of the step before [s]; None: this is the first.
            reference_at: the reference as a function of vehicle time [s].
            attitude: newer than the state.
            frozen: hold the estimator still.
        """
        ...

    def again(self, stamp_s: float, state: State, timed: Timed) -> RateSetpoint | None:
        """A whole step like the last one, which had the same reference, nothing newer than its state and no reason to
        hold the estimator still; None, and nothing is changed, where it cannot be like it.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            timed: the reference.
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


def stepped(n: Numbers) -> Stepped:
    """What a step gave, from its numbers."""
    rates, model, tau = _vec3(n[flat.RATES]), _vec3(n[flat.RATES_MODEL]), _vec3(n[flat.TAU])
    a, b, c, d = n[flat.PREDICTED_Q]
    command = n[flat.THRUST], rates, model, tau, int(n[flat.LIMITS])
    return command, (a, b, c, d), _vec3(n[flat.PREDICTED_W])


class PlainEngine:
    """The control step as plain Python."""

    def __init__(self, parameters: Parameters, lags: Factors) -> None:
        self.retune(parameters)
        model = parameters.model
        self._vehicle = (model.mass, model.gravity, model.drag)
        self._lags = lags
        self._controller: PlainController | None = None
        self._last: tuple[PlainCommand, PlainController, PlainEvaluation] | None = None
        self._predicted: PlainState | None = None
        self._pieces = [0.0] * (PIECE * PIECES_MAX)
        self._last_s = math.nan
        self.refreshed = False

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        thrust, thrust_rate, b_hat, heading, lead_integral = controller
        self._controller = thrust, thrust_rate, b_hat, (*heading,), lead_integral

    @property
    def controller(self) -> ControllerState:
        """The controller's state after the last step."""
        assert self._controller is not None
        return controller_of(self._controller)

    def retune(self, parameters: Parameters) -> None:
        """Steps with these parameters from now on; the model stays."""
        gains, model, limits = parameters
        self._p_max = gains.p_max
        self._parameters: PlainParameters = (*gains,), (*model,), (*limits,)

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
    ) -> Stepped:
        """One step (see Engine)."""
        controller, count = self._controller, len(pieces) // PIECE
        assert controller is not None
        _, _, b_hat, _, _ = controller
        self._predicted, _ = through(state, thrust, pieces, 0, count, b_hat, self._vehicle, self._lags)
        command, after, out = step_plain(self._predicted, reference, controller, self._parameters, frozen, dt_s)
        if integrate:
            self._controller = after
        else:
            after = controller
        self._last = command, after, out
        _, _, q, w = self._predicted
        return command, q, w

    def numbers(self) -> Numbers:
        """All of the last step (see Engine)."""
        assert self._last is not None and self._predicted is not None
        command, after, out = self._last
        return flat.results(command, after, out, self._p_max, self._predicted)

    # -- whole steps (see WholeSteps) -----------------------------------------------------------------------------

    def convert(self, thrust_full_n: float, curve_factor: float) -> None:
        """Turns thrust into commands so from now on."""
        self._conversion = thrust_full_n, curve_factor

    def predict(
        self, commands: MutableSequence[float], lags_s: Vec3, delay_s: float, interval_s: float, gap_max_s: float
    ) -> None:
        """How whole steps are made from now on."""
        self._commands, self._rate_lags_s, self._delay_s = commands, lags_s, delay_s
        self._interval_s, self._gap_max_s = interval_s, gap_max_s

    def fly(
        self,
        stamp_s: float,
        state: State,
        last_s: float | None,
        reference_at: ReferenceAt,
        attitude: Attitude | None,
        frozen: bool,
    ) -> Stepped:
        """A whole step."""
        dt_s, integrate = self._interval_s, True
        if last_s is not None:
            integrate = 0.0 < stamp_s - last_s <= self._gap_max_s  # else the controller's state waits
            dt_s = stamp_s - last_s if integrate else dt_s
        self._last_s = stamp_s
        commands, pieces = self._commands, self._pieces
        follow(commands, stamp_s)
        count = gather(commands, stamp_s, pieces, 0)
        self.refreshed = False
        if attitude is not None:
            lags_s = self._rate_lags_s
            state, self.refreshed = history.refreshed(state, stamp_s, attitude, pieces, 0, count, lags_s)
        reference, thrust = reference_at(stamp_s + self._delay_s), commands[THRUST]
        out = self.step(state, reference, thrust, pieces[: PIECE * count], frozen or not integrate, integrate, dt_s)
        (thrust, _, (x, y, z), _, _), _, _ = out
        remember(commands, stamp_s + self._delay_s, thrust, x, y, z)
        return out

    def again(self, stamp_s: float, state: State, timed: Timed) -> RateSetpoint | None:
        """A whole step like the last one: `fly`, without what makes no difference then."""
        dt_s, controller = stamp_s - self._last_s, self._controller
        if not 0.0 < dt_s <= self._gap_max_s or controller is None:
            return None
        self._last_s = stamp_s
        commands, pieces, effect_s = self._commands, self._pieces, stamp_s + self._delay_s
        follow(commands, stamp_s)
        count = gather(commands, stamp_s, pieces, 0)
        _, _, b_hat, _, _ = controller
        thrust = commands[THRUST]
        self._predicted, _ = through(state, thrust, pieces, 0, count, b_hat, self._vehicle, self._lags)
        reference = timed(effect_s)
        self._last = last = step_plain(self._predicted, reference, controller, self._parameters, False, dt_s)
        (thrust, rates, (x, y, z), _, _), self._controller, _ = last
        remember(commands, effect_s, thrust, x, y, z)
        full_n, curve_factor = self._conversion
        return new_record(RateSetpoint, (thrust_fraction(thrust, full_n, curve_factor), rates))


class CompiledEngine:
    """The control step compiled as one kernel over arrays that are allocated once (`flight.fused`)."""

    def __init__(self, parameters: Parameters, lags: Factors) -> None:
        import numpy as np

        self._m = m = np.zeros(fused.SIZE)
        self._x = m[fused.INPUT : fused.CONSTANTS]
        self._c = m[fused.CONSTANTS : fused.CONVERSION]
        self._no_curve = np.zeros(fused.NO_CURVE)
        self._no_history = np.zeros(history.CAPACITY)
        self._kernel = accelerate.compile_for(fused.flight_step, m, self._no_history, self._no_curve)
        self._find_target = accelerate.compile_for(fused.find_target, m, self._no_curve)
        self._lags = lags
        self.retune(parameters)
        self._doubles: Any = m.data
        self._bytes = m.data.cast("B")
        self._pack = struct.Struct("14d").pack_into
        self._pack_given = struct.Struct(f"{1 + flat.THRUST_NOW}d").pack_into
        self._pack_reference = struct.Struct("18d").pack_into
        self._pack_course = struct.Struct("3d").pack_into
        self._unpack_sent = struct.Struct("4d").unpack_from
        self._unpack = struct.Struct(f"{flat.RESULTS}d").unpack_from
        self._unpack_target = struct.Struct("6d").unpack_from
        self._history: MutableSequence[float] = self._no_history  # type: ignore[assignment]
        self.on: Curve | None = None
        """The curve that the last step had its reference from."""
        self.curve: Any = self._no_curve
        """The same as numbers; not read where there is none."""

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
        """One step (see Engine)."""
        x = self._x
        self._pack_given(self._bytes, 0, 0.0, *state.p, *state.v, *state.q, *state.w, dt_s, frozen, integrate)
        self._doubles[fused.ON_CURVE], self.on = 0.0, None
        self._give(reference)
        x[flat.THRUST_NOW], x[flat.COUNT] = thrust, len(pieces) / PIECE
        x[flat.PIECES : flat.PIECES + len(pieces)] = pieces
        self._m[fused.WHOLE] = 0.0
        self._kernel(self._m, self._no_history, self._no_curve)
        return stepped(self.numbers())

    def numbers(self) -> Numbers:
        """All of the last step (see Engine)."""
        return self._unpack(self._bytes, _RESULTS)

    # -- whole steps (see WholeSteps) -----------------------------------------------------------------------------

    def convert(self, thrust_full_n: float, curve_factor: float) -> None:
        """Turns thrust into commands so from now on."""
        self._m[fused.CONVERSION : fused.LAGS] = thrust_full_n, curve_factor

    def predict(
        self, commands: MutableSequence[float], lags_s: Vec3, delay_s: float, interval_s: float, gap_max_s: float
    ) -> None:
        """How whole steps are made from now on."""
        self._history, self._delay_s = commands, delay_s
        self._m[fused.LAGS : fused.WHOLE] = *lags_s, delay_s, interval_s, gap_max_s

    def fly(
        self,
        stamp_s: float,
        state: State,
        last_s: float | None,
        reference_at: ReferenceAt,
        attitude: Attitude | None,
        frozen: bool,
    ) -> Stepped:
        """A whole step."""
        self.refer(reference_at, stamp_s)
        self.give_attitude(attitude)
        self._m[fused.WHOLE : fused.ON_CURVE] = 1.0, math.nan if last_s is None else last_s, frozen
        self._pack(self._bytes, 0, stamp_s, *state.p, *state.v, *state.q, *state.w)
        self._kernel(self._m, self._history, self.curve)
        return stepped(self.numbers())

    def again(self, stamp_s: float, state: State, timed: Timed) -> RateSetpoint | None:
        """A whole step like the last one: on the same curve."""
        if self.on is None or timed.on is not self.on or not timed.goes_on(stamp_s, self._delay_s):
            return None
        (px, py, pz), (vx, vy, vz), (a, b, c, d), (x, y, z) = state
        self._pack(self._bytes, 0, stamp_s, px, py, pz, vx, vy, vz, a, b, c, d, x, y, z)
        self._kernel(self._m, self._history, self.curve)
        return self.sent

    def refer(self, reference_at: ReferenceAt, stamp_s: float) -> None:
        """Gives the next step its reference, for a state with this stamp [s]: a curve where there is one."""
        delay_s = self._doubles[fused.DELAY]
        timed = reference_at if isinstance(reference_at, Timed) else None
        self.on = curve = None if timed is None else timed.curve(stamp_s, delay_s)
        if timed is None or curve is None:
            self._doubles[fused.ON_CURVE], self.curve = 0.0, self._no_curve
            self._give(reference_at(stamp_s + delay_s))
        else:
            self._pack_course(self._bytes, _COURSE, 1.0, timed.begin_s, curve.begin_s)
            self.curve = curve.numbers

    def _give(self, reference: Reference) -> None:
        p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = reference
        self._pack_reference(self._bytes, _REFERENCE, *p, *v, *a, *j, *s, yaw, yaw_rate, yaw_acceleration)

    def give_attitude(self, attitude: Attitude | None) -> None:
        """One that is newer than the next state, if there is one."""
        if attitude is None:
            self._doubles[fused.ATTITUDE] = 0.0
        else:
            self._m[fused.ATTITUDE : fused.RESULTS] = attitude.at_s, *attitude.q, *attitude.w

    @property
    def memory(self) -> Any:
        """What `fused.flight_step` works on."""
        return self._m

    @property
    def sent(self) -> RateSetpoint:
        """What the last whole step sends, where body rates are what is sent."""
        share, x, y, z = self._unpack_sent(self._bytes, _SENT)
        return new_record(RateSetpoint, (share, (x, y, z)))

    @property
    def target(self) -> tuple[Vec3, Vec3] | None:
        """Position and velocity of the reference at the last stamp, where it was on a curve."""
        if self.on is None:
            return None
        self._find_target(self._m, self.curve)
        px, py, pz, vx, vy, vz = self._unpack_target(self._bytes, _TARGET)
        return (px, py, pz), (vx, vy, vz)

    @property
    def refreshed(self) -> bool:
        """Whether the last step predicted from an attitude newer than its state."""
        return bool(self._doubles[fused.REFRESHED] > 0.5)


def _vec3(numbers: Numbers) -> Vec3:
    x, y, z = numbers
    return x, y, z
