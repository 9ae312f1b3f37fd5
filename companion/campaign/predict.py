"""What a flight will demand of the vehicle, from the simulated nominal loop: the thrust bound (38) alone often says
nothing.

Nominal: the vehicle file's own lags, delay and noise, no wind, the gravity that the law assumes.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.campaign.simulate import Trace, fly_sampled
from companion.config import Flight, SimulatedWorld, Start, Vehicle
from companion.control.certificate import ThrustBounds, thrust_bounds
from companion.control.law import errors, lyapunov, torque
from companion.control.types import GRAVITY_M_S2, State, Vec3
from companion.control.vectors import norm
from companion.errors import RefusedError
from companion.flight.tracker import Kernels
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
    )


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
        RefusedError: tilt or position error leave their limits, or the loop diverges.
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
    e = errors(state, first, model.mass * GRAVITY_M_S2, 0.0, zero, gains, model)
    return thrust_bounds(
        gains, model.mass, model.gravity, q2_max, vehicle.limits.disturbance_max_m_s2, lyapunov(e, gains.p_max), 0.0
    )
