"""One control step as every flight makes it: predict, evaluate the law at the time of effect, remember what was sent.

The same object flies over MAVLink (`flight.loop`) and in `companion simulate`; it knows nothing of sockets. Its time is
the vehicle's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from companion import accelerate
from companion.config import Vehicle
from companion.control.heading import HeadingState
from companion.control.law import Command, ControllerState, Errors, Evaluation, lyapunov, start, step
from companion.control.model import advance
from companion.control.output import (
    Conversion,
    Setpoint,
    actuator_output,
    attitude_output,
    rates_output,
)
from companion.control.types import GRAVITY_M_S2, Reference, State, Vec3
from companion.control.vectors import axes
from companion.flight.prediction import Prediction

ZERO: Vec3 = (0.0, 0.0, 0.0)
ReferenceAt = Callable[[float], Reference]


class Kernels(NamedTuple):
    """The functions of a control step, plain or compiled."""

    step: Callable[..., tuple[Command, ControllerState, Evaluation]]
    advance: Callable[..., Any]
    engine: str


def kernels(engine: str) -> Kernels:
    """The control step's functions for an engine: "python", "numba", or "auto" (numba where it is installed)."""
    chosen = accelerate.resolve(engine)
    return Kernels(accelerate.choose(step, chosen), accelerate.choose(advance, chosen), chosen)


class TrackerStep(NamedTuple):
    """What one control step did."""

    setpoint: Setpoint
    command: Command
    errors: Errors
    heading_error: float
    predicted: State


def conversion(vehicle: Vehicle) -> Conversion:
    """The vehicle's normalisation; full torque is what the rotors give with half of them at full command, per axis."""
    rotors = vehicle.rotors
    arms = (rotors.y_m, rotors.x_m, rotors.yaw_moment_m)
    half = 0.5 * rotors.thrust_max_n
    torque_full = tuple(half * sum(abs(arm) for arm in axis) for axis in arms)
    return Conversion(
        vehicle.thrust_full_n,
        rotors.curve_factor,
        vehicle.autopilot.attitude_gain_1_s,
        vehicle.autopilot.attitude_lag_s,
        vehicle.body.inertia_kg_m2,
        (torque_full[0], torque_full[1], torque_full[2]),
    )


class Tracker:
    """The controller of one flight.

    Args:
        vehicle: the vehicle file.
        output: "rates", "attitude" or "actuators".
        compiled: the kernels to use.
    """

    def __init__(self, vehicle: Vehicle, output: str, compiled: Kernels) -> None:
        self.vehicle = vehicle
        self.parameters = vehicle.parameters()
        self._output = output
        self._kernels = compiled
        self._conversion = conversion(vehicle)
        self._interval_s = 1.0 / vehicle.link.state_rate_hz
        self._gap_max_s = vehicle.limits.state_gap_max_s
        self._last_s: float | None = None
        self.delay_s = vehicle.delay_s if vehicle.controller.prediction else 0.0
        self.controller = ControllerState(0.0, 0.0, ZERO, HeadingState((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), False), ZERO)
        self._prediction = self._new_prediction(0.0)

    def _new_prediction(self, thrust_n: float) -> Prediction:
        x, y, z = self.vehicle.autopilot.rate_lag_s
        lags = (x, y, z, self.vehicle.rotors.lag_s)
        return Prediction(self.parameters, lags, self.delay_s, thrust_n, self._kernels.advance)

    def begin(self, state: State, thrust_n: float | None = None) -> None:
        """Starts the controller's state from a hover: T(0), T'(0) = 0, b_hat(0) so that nothing steps (paper.md section
        8).

        Args:
            state: the vehicle now.
            thrust_n: the thrust that acts [N]; the weight when unknown.
        """
        model, limits = self.parameters.model, self.parameters.limits
        thrust = model.mass * GRAVITY_M_S2 if thrust_n is None else thrust_n
        thrust = min(max(thrust, limits.thrust_min), limits.thrust_max)
        b_hat: Vec3 = (0.0, 0.0, 0.0)
        if self.vehicle.controller.disturbance_start == "hover":
            _, b_hat = start(thrust, state.q, model.mass, model.gravity, limits.disturbance_max)
        r1, r2, _ = axes(state.q)
        self.controller = ControllerState(thrust, 0.0, b_hat, HeadingState(r2, r1, False), ZERO)
        self._prediction = self._new_prediction(thrust)
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
            if dt > self._gap_max_s:  # too long to integrate over: the controller's state waits
                dt, integrate = self._interval_s, False
        self._last_s = stamp_s
        predicted = self._prediction.predict(stamp_s, state, self.controller.b_hat)
        reference = reference_at(stamp_s + self.delay_s)
        command, after, evaluation = self._kernels.step(
            predicted, reference, self.controller, self.parameters, frozen or not integrate, dt
        )
        if integrate:
            self.controller = after
        self._prediction.sent(stamp_s, command)
        return TrackerStep(
            self._convert(command, predicted), command, evaluation.errors, evaluation.heading_error, predicted
        )

    def _convert(self, command: Command, predicted: State) -> Setpoint:
        if self._output == "attitude":
            return attitude_output(command, predicted.q, predicted.w, self._conversion)
        if self._output == "actuators":
            return actuator_output(command, predicted.w, self._conversion)
        return rates_output(command, self._conversion)

    def lyapunov(self, errors: Errors) -> float:
        """V_H of the last step without its b_tilde term [m^2]."""
        return lyapunov(errors, self.parameters.gains.p_max)
