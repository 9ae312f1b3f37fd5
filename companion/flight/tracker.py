"""One control step as every flight makes it: predict, evaluate the law at the time of effect, remember what was sent.

The same object flies over MAVLink (`flight.loop`) and in `companion simulate`; it knows nothing of sockets. Its time is
the vehicle's. The arithmetic is `control.model.advance` and `control.law.step` with either engine: called as they are,
or compiled as one kernel.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from companion import accelerate
from companion.config import Vehicle
from companion.control import flat
from companion.control.heading import HeadingState
from companion.control.law import ControllerState, Parameters, start, step
from companion.control.model import Factors, advance, factors
from companion.control.output import Conversion, Setpoint, actuator_output, attitude_output, lead, rates_output
from companion.control.types import GRAVITY_M_S2, Reference, State, Vec3
from companion.control.vectors import axes
from companion.flight.prediction import Piece, Prediction

ZERO: Vec3 = (0.0, 0.0, 0.0)
PIECES_MAX = 100
ReferenceAt = Callable[[float], Reference]
Numbers = tuple[float, ...]


class Engine(Protocol):
    """The arithmetic of the control steps, with the controller's state."""

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        ...

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: list[Piece],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step; returns the numbers that `control.flat` names (flat.THRUST ...).

        Args:
            state: as received.
            reference: at the time of effect.
            thrust: that acts at the state's stamp [N].
            pieces: what acts from the stamp to the time of effect.
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

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: list[Piece],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step (see Engine)."""
        controller = self._controller
        assert controller is not None
        for setpoint, rates, duration_s in pieces:
            state, thrust = advance(
                state, thrust, rates, setpoint, controller.b_hat, self._vehicle, self._lags, duration_s
            )
        command, after, out = step(state, reference, controller, self._parameters, frozen, dt_s)
        if integrate:
            self._controller = after
        else:
            after = controller
        return flat.results(command, after, out, self._parameters.gains.p_max, state)


class CompiledEngine:
    """The control step compiled as one kernel over arrays that are allocated once."""

    def __init__(self, parameters: Parameters, lags: Factors) -> None:
        import numpy as np

        self._kernel: Any = accelerate.compile_kernel(flat.control_step)
        self._x = np.zeros(flat.PIECES + flat.PIECE * PIECES_MAX)
        self._y = np.zeros(flat.RESULTS)
        self._c = np.array(flat.constants(parameters, lags))
        self._bytes = self._x.data.cast("B")
        self._result = self._y.data.cast("B")
        self._pack = struct.Struct(f"{flat.INPUTS}d").pack_into
        self._pack_piece = struct.Struct(f"{flat.PIECE}d").pack_into
        self._unpack = struct.Struct(f"{flat.RESULTS}d").unpack_from

    def begin(self, controller: ControllerState) -> None:
        """Takes a new controller state."""
        self._x[flat.CONTROLLER : flat.PIECES] = flat.controller_numbers(controller)

    def step(
        self,
        state: State,
        reference: Reference,
        thrust: float,
        pieces: list[Piece],
        frozen: bool,
        integrate: bool,
        dt_s: float,
    ) -> Numbers:
        """One step (see Engine)."""
        p, v, a, j, s, yaw, yaw_rate, yaw_acceleration = reference
        self._pack(
            self._bytes, 0, *state.p, *state.v, *state.q, *state.w, *p, *v, *a, *j, *s, yaw, yaw_rate, yaw_acceleration,
            thrust, dt_s, frozen, len(pieces), integrate,
        )  # fmt: skip
        at = 8 * flat.PIECES
        for setpoint, rates, duration_s in pieces:
            self._pack_piece(self._bytes, at, setpoint, *rates, duration_s)
            at += 8 * flat.PIECE
        self._kernel(self._x, self._c, self._y)
        return self._unpack(self._result)


class TrackerStep(NamedTuple):
    """What one control step did."""

    setpoint: Setpoint
    numbers: Numbers
    """Everything else, in the order that `control.flat` names."""

    @property
    def errors(self) -> tuple[Vec3, Vec3, Vec3, Vec3]:
        """e1 to e4 at the time of effect [m]."""
        n = self.numbers[flat.ERRORS]
        return (n[0], n[1], n[2]), (n[3], n[4], n[5]), (n[6], n[7], n[8]), (n[9], n[10], n[11])

    @property
    def rates(self) -> Vec3:
        """Body rate setpoint [rad/s]."""
        n = self.numbers
        return (n[1], n[2], n[3])

    @property
    def tau(self) -> Vec3:
        """Angular acceleration [rad/s^2]."""
        n = self.numbers
        return (n[7], n[8], n[9])

    @property
    def b_hat(self) -> Vec3:
        """Disturbance estimate after the step, NED [m/s^2]."""
        n = self.numbers
        return (n[13], n[14], n[15])


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
        self.parameters = vehicle.parameters()
        self._output = output
        x, y, z = vehicle.autopilot.rate_lag_s
        self._conversion = conversion(vehicle)
        self._interval_s = 1.0 / vehicle.link.state_rate_hz
        self._gap_max_s = vehicle.limits.state_gap_max_s
        self._last_s: float | None = None
        self._slow_tau: Vec3 = ZERO
        self.delay_s = vehicle.delay_s if vehicle.controller.prediction else 0.0
        self._prediction = self._new_prediction(0.0)
        length = self._prediction.length_s or self._interval_s
        self._engine = compiled.build(self.parameters, factors((x, y, z, vehicle.rotors.lag_s), length))

    def _new_prediction(self, thrust_n: float) -> Prediction:
        return Prediction(self.vehicle.rotors.lag_s, self.delay_s, thrust_n)

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
        self._prediction = self._new_prediction(thrust)
        self._slow_tau = ZERO
        self._last_s = None

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
        self._last_s = stamp_s
        prediction = self._prediction
        pieces = prediction.pieces(stamp_s)
        reference = reference_at(stamp_s + self.delay_s)
        numbers = self._engine.step(state, reference, prediction.thrust, pieces, frozen or not integrate, integrate, dt)
        prediction.sent(stamp_s, numbers[flat.THRUST], numbers[flat.RATES_MODEL])
        return TrackerStep(self._convert(numbers, dt), numbers)

    def _convert(self, n: Numbers, dt_s: float) -> Setpoint:
        rates = (n[1], n[2], n[3])
        if self._output == "rates":
            return rates_output(n[flat.THRUST], rates, self._conversion)
        tau, w = (n[7], n[8], n[9]), (n[34], n[35], n[36])
        if self._output == "actuators":
            ahead, self._slow_tau = lead(tau, self._slow_tau, self.vehicle.rotors.lag_s, dt_s)
            return actuator_output(n[flat.THRUST], ahead, w, self._conversion)
        return attitude_output(n[flat.THRUST], rates, tau, (n[30], n[31], n[32], n[33]), w, self._conversion)
