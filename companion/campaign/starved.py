"""A flight whose companion is starved: steps come late or not at all, whole stretches are missed, and the vehicle holds
its last setpoint meanwhile.

The very controller that flies, its guards and the bundled physics with its estimator's delay, without sockets and on
vehicle time, so that the same seed gives the same flight on any machine. The process looks at its link when it gets
the processor: it answers the newest state, which has waited by then, and its setpoint goes out later still. What it
does not get to is skipped. Where the guards would end the flight, or a setpoint would come after more than half of
COM_OF_LOSS_T, is noted; the simulation goes on, so that what they guard against can be seen too.
"""

from __future__ import annotations

import math
from random import Random
from typing import Final, NamedTuple

from companion.campaign.simulate import loop_setpoint, simulated_vehicle, simulated_world, start_of
from companion.config import Flight
from companion.control import flat
from companion.control.output import RateSetpoint, thrust_fraction
from companion.control.types import GRAVITY_M_S2, State
from companion.flight.course import Course, Timed
from companion.flight.engines import Kernels
from companion.flight.following import Following
from companion.flight.guards import Guards, Response
from companion.flight.tracker import Tracker
from companion.frames import quat_from_yaw, tilt_from_quat
from companion.trajectory.anchored import Trajectory
from sim_link import inner_loops
from sim_link.airframe import Airframe

LATE_SHARE: Final = (0.2, 1.5)
"""A late setpoint goes out after this part of a state's period, uniformly."""
LOST_M: Final = 5.0
"""A larger error is no tracking any more; the simulation ends."""


class Starvation(NamedTuple):
    """How badly a process is off."""

    rate_hz: tuple[float, float] = (40.0, 60.0)
    """How often it gets the processor, least and most; each time drawn uniformly."""
    late_share: float = 0.3
    """Of its steps, whose setpoint goes out late."""
    gap_s: tuple[float, float] = (0.1, 0.4)
    """Stretches without the processor, shortest and longest."""
    gap_every_s: float = 5.0
    """From one of those to the next, on average; 0: none."""
    loss_s: float = 0.5
    """COM_OF_LOSS_T."""


class Starved(NamedTuple):
    """How such a flight went; errors are of the vehicle itself, from `from_s` on, as if nobody watched it."""

    rms_m: float
    """Of the position; NaN: it was lost, the error grew beyond `LOST_M`."""
    max_m: float
    tilt_max_rad: float
    handed_over_s: float | None
    """When its guards, or its own silence, would have ended the flight; None: it flew to its end."""
    why: str
    """For people."""
    error_then_m: float
    """How far off it was at that moment."""
    steps_hz: float
    """Setpoints that went out."""


class _Process:
    """When the process answers a state, and when its setpoint goes out; times in seconds."""

    def __init__(self, starvation: Starvation, begin_s: float, period_s: float, seed: int) -> None:
        self._how, self._period_s, self._random = starvation, period_s, Random(seed)
        self._free_s = begin_s
        self._gap_s = begin_s + self._until_gap()

    def answers(self, now_s: float) -> float | None:
        """When the setpoint for the newest state of this moment goes out; None: the process is away."""
        how, random = self._how, self._random
        if now_s < self._free_s - 1e-9:
            return None
        if now_s >= self._gap_s:
            self._free_s = now_s + random.uniform(*how.gap_s)
            self._gap_s = self._free_s + self._until_gap()
            return None
        self._free_s = now_s + 1.0 / random.uniform(*how.rate_hz)
        late = random.random() < how.late_share
        return now_s + (random.uniform(*LATE_SHARE) * self._period_s if late else 0.0)

    def _until_gap(self) -> float:
        every_s = self._how.gap_every_s
        return self._random.expovariate(1.0 / every_s) if every_s > 0.0 else math.inf


def fly_starved(
    flight: Flight,
    trajectory: Trajectory,
    compiled: Kernels,
    starvation: Starvation,
    *,
    duration_max_s: float,
    from_s: float = 5.0,
    seed: int = 1,
) -> Starved:
    """Flies from a hover at [start] along the course.

    Args:
        flight: the configuration with [start] and [world].
        trajectory: what is to be flown.
        compiled: the kernels of the control step.
        starvation: of the process.
        duration_max_s: simulate no more of the course than this.
        from_s: errors before do not count.
        seed: of the starvation.
    """
    vehicle, (position, yaw) = flight.vehicle, start_of(flight)
    airframe = Airframe(
        *(simulated_vehicle(flight), simulated_world(flight)),
        seed=flight.world.seed,
        engine=compiled.engine,
        start=(position, yaw),
        px4="1.18",
    )
    course = Course(trajectory, vehicle, position, yaw, (0.0, 0.0, 0.0), flight.height_min_m)
    tracker = Tracker(vehicle, flight.output.sends, compiled)
    tracker.begin(State(position, (0.0, 0.0, 0.0), quat_from_yaw(yaw), (0.0, 0.0, 0.0)))
    guards = Guards(vehicle, tracker.parameters)
    following = Following(vehicle.autopilot.rate_lag_s) if flight.output.sends == "rates" else None
    begin_s, dt_s = airframe.t_us * 1e-6, airframe.dt_us * 1e-6
    period_s = 1.0 / vehicle.link.state_rate_hz
    process = _Process(starvation, begin_s, period_s, seed)
    reference_at = Timed(course, begin_s)
    command_s = vehicle.link.command_delay_s
    waiting: list[tuple[float, inner_loops.Setpoint]] = []
    weight = thrust_fraction(vehicle.body.mass_kg * GRAVITY_M_S2, vehicle.thrust_full_n, vehicle.rotors.curve_factor)
    acting = loop_setpoint(RateSetpoint(weight, (0.0, 0.0, 0.0)))
    sent_s, answered_s, steps = begin_s, -math.inf, 0
    squares, count, largest, tilt, apart = 0.0, 0, 0.0, 0.0, 0.0
    ended: tuple[float, str, float] | None = None
    end_s = begin_s + min(course.duration_s, duration_max_s)
    believed, every, index = airframe.believed(), max(1, round(period_s / dt_s)), 0
    while (now_s := airframe.t_us * 1e-6) < end_s and apart < LOST_M:
        if index % every == 0:  # a state comes
            believed = airframe.believed()
        index += 1
        stamp_s = believed.t_us * 1e-6
        goes_s = process.answers(now_s) if stamp_s > max(answered_s, begin_s - 1e-9) else None
        if goes_s is not None:
            if ended is None and stamp_s - sent_s > 0.5 * starvation.loss_s:
                ended = now_s - begin_s, f"no setpoint for {stamp_s - sent_s:.2f} s", apart
            answered_s = sent_s = stamp_s
            steps += 1
            state = State(believed.p, believed.v, believed.q, believed.w)
            out = tracker.step(stamp_s, state, reference_at)
            waiting.append((goes_s + command_s, loop_setpoint(out.setpoint)))
            wanted = course.at(stamp_s - begin_s).p
            error = (state.p[0] - wanted[0], state.p[1] - wanted[1], state.p[2] - wanted[2])
            rates = out.numbers[flat.RATES]
            off = 0.0
            if following is not None:
                off = following.error(stamp_s, state.w, (rates[0], rates[1], rates[2]), tracker.delay_s)
            found = guards.step(state.q, error, out.numbers, stamp_s, off)
            if ended is None and found is not None and found.guard is not None and found.response >= Response.REST:
                ended = now_s - begin_s, f"{found.guard.value.cause.value.sentence}: {found.detail}", apart
        fresh = False
        while waiting and waiting[0][0] <= now_s + 1e-9:
            acting, fresh = waiting.pop(0)[1], True
        airframe.advance(acting, fresh, 1)
        truth, since_s = airframe.truth(), airframe.t_us * 1e-6 - begin_s
        apart = math.dist(truth.p, course.at(since_s).p)
        if since_s >= from_s:
            squares, count, largest = squares + apart * apart, count + 1, max(largest, apart)
            tilt = max(tilt, tilt_from_quat(truth.q))
    flown_s = airframe.t_us * 1e-6 - begin_s
    rms = math.sqrt(squares / count) if count and apart < LOST_M else math.nan
    at_s, why, then_m = (None, "", 0.0) if ended is None else ended
    return Starved(rms, max(largest, apart), tilt, at_s, why, then_m, steps / max(flown_s, dt_s))
