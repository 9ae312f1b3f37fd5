"""What a flight will demand of the vehicle, from the simulated nominal loop: the thrust bound (38) alone often says
nothing.

Nominal: the vehicle file's own lags, delay and noise, no wind, the gravity that the law assumes.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.campaign.simulate import Trace, fly_sampled
from companion.config import Flight, SimulatedWorld, Start, Vehicle
from companion.control import flat
from companion.control.certificate import ThrustBounds, thrust_bounds
from companion.control.heading import HeadingState
from companion.control.law import ControllerState, evaluate, lyapunov, torque
from companion.control.types import GRAVITY_M_S2, State, Vec3
from companion.control.vectors import norm
from companion.errors import RefusedError
from companion.flight.engines import Kernels
from companion.flight.envelope import Envelope
from companion.flight.guards import Guard, disturbance_step
from companion.frames import degrees, quat_from_yaw, radians, tilt_from_quat
from companion.record.columns import LIMIT_RATE_ROLL_PITCH, LIMIT_RATE_YAW, LIMIT_THRUST_MAX, LIMIT_THRUST_MIN
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.pieces import sample

PREDICTED_S = 15.0
"""The violent part of a flight is its beginning; the rest is the reference's own demand, which has its own gate."""


class Extreme(NamedTuple):
    """A largest or smallest value and when it occurs."""

    value: float
    at_s: float


class Excess(NamedTuple):
    """V_H above the envelope that the flight's guard LYAPUNOV watches, for as long as that guard bears it."""

    value_m2: float
    most_m2: float
    part: str
    """"horizontal", "vertical" or "all axes"."""
    at_s: float
    """When the guard answers."""


class Prediction(NamedTuple):
    """The extremes of a simulated flight; times from the moment of engaging."""

    thrust_min_n: Extreme
    thrust_max_n: Extreme
    tilt_max_rad: Extreme
    rate_max_rad_s: Extreme
    """Largest component of the body rates."""
    torque_max_n_m: Extreme
    """Largest component of the torque."""
    error_max_m: Extreme
    thrust_limited_s: float
    """How long the thrust stands at a limit."""
    rate_limited_s: float
    """How long a commanded rate is cut."""
    excess: Excess | None = None
    """None: the guard of V_H stays silent."""


def _largest(values: list[float], times: list[float]) -> Extreme:
    index = max(range(len(values)), key=values.__getitem__)
    return Extreme(values[index], times[index])


def extremes(trace: Trace, vehicle: Vehicle) -> Prediction:
    """The extremes of a simulated flight."""
    rows = trace.rows
    times = [row.t_s for row in rows]
    thrust = [row.thrust_n for row in rows]
    low = min(range(len(thrust)), key=thrust.__getitem__)
    inertia = vehicle.body.inertia_kg_m2
    torques = [max(abs(x) for x in torque(row.tau, row.state.w, inertia)) for row in rows]
    flags = trace.record.column("limits").astype(int)
    interval = 1.0 / vehicle.link.state_rate_hz
    return Prediction(
        Extreme(thrust[low], times[low]),
        _largest(thrust, times),
        _largest([tilt_from_quat(row.state.q) for row in rows], times),
        _largest([max(abs(x) for x in row.state.w) for row in rows], times),
        _largest(torques, times),
        _largest([norm(row.errors[0]) for row in rows], times),
        float((flags & (LIMIT_THRUST_MIN | LIMIT_THRUST_MAX) != 0).sum()) * interval,
        float((flags & (LIMIT_RATE_ROLL_PITCH | LIMIT_RATE_YAW) != 0).sum()) * interval,
        _excess(trace, vehicle),
    )


def _excess(trace: Trace, vehicle: Vehicle) -> Excess | None:
    """What the guard of V_H would answer first."""
    parameters = vehicle.parameters()
    envelope = Envelope(parameters.gains, parameters.model.drag, disturbance_step(vehicle.limits))
    bears_s = Guard.LYAPUNOV.value.stages[0].after_s
    numbers = [0.0] * (max(flat.ERRORS.stop, flat.LYAPUNOV + 1))
    begun_s: float | None = None
    for row, level in zip(trace.rows, trace.record.column("lyapunov").tolist(), strict=True):
        numbers[flat.ERRORS], numbers[flat.LYAPUNOV] = (x for e in row.errors for x in e), level
        found = envelope.excess(tuple(numbers), row.t_s)
        if found is None:
            begun_s = None
            continue
        begun_s = row.t_s if begun_s is None else begun_s
        if row.t_s - begun_s >= bears_s:
            return Excess(*found, row.t_s)
    return None


def start_at(flight: Flight, trajectory: Trajectory) -> Start:
    """The flight's [start], or, without one, at rest at the trajectory's beginning."""
    if flight.start is not None:
        return flight.start
    begin = anchored(trajectory, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).at(0.0)
    return Start(position_m=begin.p, yaw_deg=degrees(begin.yaw))


def predict(flight: Flight, trajectory: Trajectory, compiled: Kernels, duration_s: float = PREDICTED_S) -> Prediction:
    """Simulates the nominal loop from the flight's start.

    Raises:
        RefusedError: it diverges.
    """
    changes = {"world": SimulatedWorld(), "start": start_at(flight, trajectory)}
    nominal = flight.model_copy(update=changes)
    return extremes(fly_sampled(nominal, trajectory, compiled, duration_max_s=duration_s), flight.vehicle)


def gate_prediction(flight: Flight, trajectory: Trajectory, compiled: Kernels) -> Prediction:
    """Refuses a flight whose nominal prediction leaves its limits, with time and size of the violation.

    Raises:
        RefusedError: tilt, position error or V_H leave their limits, or the loop diverges.
    """
    found = predict(flight, trajectory, compiled)
    limits = flight.vehicle.limits
    for name, extreme, limit, unit, key in (
        ("tilt", found.tilt_max_rad, limits.tilt_max_rad, "rad", "tilt_max_rad"),
        ("position error", found.error_max_m, limits.position_error_abort_m, "m", "position_error_abort_m"),
    ):
        if extreme.value > limit:
            raise RefusedError(
                f"flight {flight.name!r} is predicted to leave its limits: {name} {extreme.value:.2f} {unit} at"
                f' {extreme.at_s:.2f} s, limit {limit:g} {unit} (limits.{key}); start nearer, or use join = "smooth"'
            )
    if found.excess is not None:
        value, most, part, at_s = found.excess
        raise RefusedError(
            f"flight {flight.name!r} is predicted to be ended by its guard LYAPUNOV at {at_s:.2f} s: V_H ({part})"
            f" {value:.3g} m^2, envelope {most:.3g} m^2; fly it slower, with the nose along the path at the start, or"
            " with lower heading gains"
        )
    return found


def bounds(flight: Flight, trajectory: Trajectory) -> ThrustBounds:
    """The thrust bounds (38) of a flight from its start."""
    vehicle = flight.vehicle
    parameters = vehicle.parameters()
    gains, model = parameters.gains, parameters.model
    start = start_at(flight, trajectory)
    position: Vec3 = start.position_m
    path = anchored(trajectory, position, (0.0, 0.0, 0.0))
    samples = sample(path, 2000)
    q2 = samples.a + model.drag * samples.v
    q2_max = float((q2 * q2).sum(axis=1).max()) ** 0.5
    first = path.at(0.0)
    if trajectory.join == "smooth":  # the join starts at rest where the vehicle is
        first = first._replace(p=position, v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), j=(0.0, 0.0, 0.0))
    zero = (0.0, 0.0, 0.0)
    state = State(position, zero, quat_from_yaw(radians(start.yaw_deg)), zero)
    ahead = HeadingState((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), False)
    hover = ControllerState(model.mass * GRAVITY_M_S2, 0.0, zero, ahead, zero)
    e = evaluate(state, first, hover, parameters, True, 0.0).errors
    return thrust_bounds(
        gains, model.mass, model.gravity, q2_max, vehicle.limits.disturbance_max_m_s2, lyapunov(e, gains.p_max), 0.0
    )
