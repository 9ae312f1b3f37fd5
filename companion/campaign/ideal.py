"""The paper's own setting: perfect state, the law inside the integrator, torque realised exactly, no limits.

The ODE is that of docs/law.md, vehicle and controller in one state vector, integrated by scipy's DOP853.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.control.heading import HeadingState
from companion.control.law import ControllerState, Evaluation, Parameters, evaluate
from companion.control.types import Reference, State, Vec3
from companion.control.vectors import axes, quat_multiply, quat_normalise

FloatArray = NDArray[np.float64]


class World(NamedTuple):
    """What acts on the vehicle beside its thrust."""

    force_n: Vec3
    """Constant force, NED [N]."""
    gravity_m_s2: float
    drag_1_s: float
    """True linear drag in still air [1/s]."""


class Sample(NamedTuple):
    """One instant of an ideal flight."""

    t_s: float
    state: State
    controller: ControllerState
    evaluation: Evaluation
    reference: Reference


def _pack(state: State, controller: ControllerState) -> FloatArray:
    c = controller
    return np.array([*state.p, *state.v, *quat_normalise(state.q), *state.w, c.thrust, c.thrust_rate, *c.b_hat])


def _vec(y: list[float], i: int) -> Vec3:
    return (y[i], y[i + 1], y[i + 2])


def unpack(y: FloatArray, heading: HeadingState) -> tuple[State, ControllerState]:
    """The vehicle's and the controller's state of one ODE state vector (18 numbers)."""
    n = y.tolist()
    q = quat_normalise((n[6], n[7], n[8], n[9]))
    return State(_vec(n, 0), _vec(n, 3), q, _vec(n, 10)), ControllerState(
        n[13], n[14], _vec(n, 15), heading, (0.0, 0.0, 0.0)
    )


def derivative(
    state: State, controller: ControllerState, evaluation: Evaluation, world: World, mass: float
) -> FloatArray:
    """d/dt of the ODE state: (1), (2), (4), (5) with drag, and the law's own derivatives."""
    r3 = axes(state.q)[2]
    thrust = controller.thrust / mass
    v = state.v
    acceleration = [world.force_n[i] / mass - thrust * r3[i] - world.drag_1_s * v[i] for i in range(3)]
    acceleration[2] += world.gravity_m_s2
    w = state.w
    q_rate = [0.5 * x for x in quat_multiply(state.q, (0.0, w[0], w[1], w[2]))]
    rates = [controller.thrust_rate, evaluation.thrust_acceleration, *evaluation.b_hat_rate]
    return np.array([*v, *acceleration, *q_rate, *evaluation.tau, *rates])


def fly(
    reference: Callable[[float], Reference],
    start: State,
    controller: ControllerState,
    parameters: Parameters,
    world: World,
    times_s: FloatArray,
    *,
    frozen: bool = False,
    tolerance: float = 1e-10,
) -> list[Sample]:
    """Integrates the closed loop and returns it at the given times.

    Args:
        reference: p_d with its derivatives as a function of time [s].
        start: the vehicle at times_s[0].
        controller: T, T', b_hat at that time.
        parameters: gains, model, limits (only the thrust floor, the disturbance ball and the heading's hold act here).
        world: what really acts.
        times_s: increasing times [s], shape (n,).
        frozen: keep the estimator still.
        tolerance: relative and absolute tolerance of the integrator.

    Raises:
        FloatingPointError: the integrator gave up (thrust through zero, for instance).
    """
    from scipy.integrate import solve_ivp

    heading = controller.heading

    def rhs(t: float, y: FloatArray) -> FloatArray:
        state, ctrl = unpack(y, heading)
        out = evaluate(state, reference(t), ctrl, parameters, frozen, 0.0)
        return derivative(state, ctrl, out, world, parameters.model.mass)

    span = (float(times_s[0]), float(times_s[-1]))
    solution: Any = solve_ivp(
        rhs, span, _pack(start, controller), method="DOP853", t_eval=times_s, rtol=tolerance, atol=tolerance
    )
    if not solution.success:
        raise FloatingPointError(
            f"the ideal loop cannot be integrated beyond {solution.t[-1]:.3f} s: {solution.message}"
        )
    samples = []
    for t, y in zip(solution.t.tolist(), solution.y.T, strict=True):
        state, ctrl = unpack(y, heading)
        ref = reference(t)
        samples.append(Sample(t, state, ctrl, evaluate(state, ref, ctrl, parameters, frozen, 0.0), ref))
    return samples
