"""What is watched and measured while the controller flies: the guards' eyes, the clocks, the delay, the resets.

The loop tells it of every step after its setpoint is out, so nothing here delays a command. Whatever comes of it (a
delay to predict over, a reference that moves along with a reset) acts from the next step on.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, MutableSequence, Sequence
from typing import NamedTuple

import numpy as np

from companion.config import Flight
from companion.control import flat
from companion.control.types import State, Vec3, new_record
from companion.flight.clearance import own_fence_margins
from companion.flight.controller import Controller
from companion.flight.course import Course
from companion.flight.delay import Delay
from companion.flight.following import Following
from companion.flight.guards import Finding, Guards, Slow
from companion.flight.phases import Autopilot
from companion.flight.resets import Resets
from companion.flight.tracker import Tracker, TrackerStep
from companion.link.offset import OffsetFilter
from companion.link.telemetry import VehicleState

SLOWLY_S = 0.1
"""What changes slowly is looked at so often."""
RATES_OVER = 10
"""Looks that a rate is taken over: one second."""
ASK_TIME_NS = 100_000_000
"""Our own TIMESYNC requests go out at the rate of PX4's."""
_MAV_STATES = {5: "critical", 6: "emergency", 8: "terminating"}


class Seen(NamedTuple):
    """A control step, as far as it is watched."""

    state: VehicleState
    error: Vec3
    """Position less reference, NED [m]."""
    out: TrackerStep
    skipped: int
    """States that were not answered before this one."""
    late: bool
    """Whether the setpoint went out late, by the wall clock."""
    age_s: float | None
    """Of the state at its arrival; None: not known."""
    arrival_ns: int
    """When that was, by our clock."""
    paced: bool
    """In lockstep: nothing is judged by the wall clock."""


class Calm(NamedTuple):
    """By what a step is found to need no judging (`flight.reckoning`)."""

    limits: tuple[float, float, float]
    """`Guards.calm`."""
    delay_s: float
    """From a stamp to the effect of its command."""
    envelope: Sequence[float]
    following: MutableSequence[float]


BEHIND_NS = 5_000_000
"""Two clocks whose offset is followed are nearer to each other."""


class _Count(NamedTuple):
    at_s: float
    steps: int
    late: int


class Watch:
    """Watches one flight.

    Args:
        flight: the configuration.
        controller: that flies.
        autopilot: what it says of itself.
        notify: gets lines for people.
    """

    def __init__(
        self, flight: Flight, controller: Controller, autopilot: Autopilot, notify: Callable[[str], None]
    ) -> None:
        vehicle = flight.vehicle
        self.resets = Resets(vehicle.limits, notify)
        self.delay = Delay(vehicle)
        self.offset = OffsetFilter()
        self._tracker = controller if isinstance(controller, Tracker) else None
        self._controller, self._autopilot, self._limits = controller, autopilot, vehicle.limits
        engine = "python" if self._tracker is None else self._tracker.engine
        self._guards = Guards(vehicle, None if self._tracker is None else self._tracker.parameters, engine)
        by_rates = self._tracker is not None and flight.output.sends == "rates"
        self._following = Following(vehicle.autopilot.rate_lag_s, engine) if by_rates else None
        """None where no body rates are commanded."""
        self._retuned = False
        self._steps = self._late = 0
        self._counts: deque[_Count] = deque(maxlen=RATES_OVER + 1)
        self._slowly_s = -math.inf
        self._asked_ns = 0

    # -- clocks ---------------------------------------------------------------------------------------------------

    def asks_time(self, own_ns: int) -> bool:
        """Whether the autopilot is to be asked for its time now; it is noted that it is."""
        if own_ns - self._asked_ns < ASK_TIME_NS:
            return False
        self._asked_ns = own_ns
        self.offset.asked(own_ns)
        return True

    def age_s(self, t_vehicle_us: int, arrival_ns: int) -> float | None:
        """How old a state was when it arrived [s]; None while the autopilot's clock is not known.

        By the offset of the last second where the one that is followed has fallen behind: the clock of a simulated
        autopilot stalls with its machine, by a second in some minutes, and its states would seem older and older.
        """
        offset_ns, recent_ns = self.offset.offset_ns(arrival_ns), self.offset.recent_ns
        if offset_ns is not None and recent_ns is not None and abs(offset_ns - recent_ns) > BEHIND_NS:
            offset_ns = recent_ns
        return None if offset_ns is None else (arrival_ns + offset_ns - 1000 * t_vehicle_us) * 1e-9

    def delay_figures(self) -> dict[str, float | None]:
        """The delay that is predicted over at the end: by the vehicle file, as used, and the measured age of the states
        [s]; the last is None where no clock told it. Empty where the law does not fly."""
        if self._tracker is None:
            return {}
        return {"file": self.delay.file_s, "used": self._tracker.delay_s, "state_age": self.delay.age_s}

    # -- states ---------------------------------------------------------------------------------------------------

    def on_reset(self, state: VehicleState, course: Course) -> str:
        """The estimate was reset with this state; "" when the flight goes on, or why not."""
        now = State(state.p, state.v, state.q, state.w)
        problem = self.resets.follow(state.t_vehicle_us * 1e-6, now, self._controller, course)
        self._guards.restart()
        return problem

    def begin(self) -> None:
        """The controller has taken over: the next step is the first."""
        self._guards.restart()
        self._counts.clear()
        if self._following is not None:
            self._following.begin()

    def on_step(self, seen: Seen, course: Course, now_s: float) -> Finding | None:
        """Judges a control step whose setpoint is out; what is to be done about it."""
        tracker, (state, error, out, _, late, age_s, _, _) = self._tracker, seen
        if tracker is not None:
            if tracker.changing:
                self._retuned = True
                self._guards.restart()
            elif self._retuned:
                self._retuned = False
                self._guards.retune(tracker.parameters)
        self._steps += 1
        self._late += late
        found = self._guards.step(state.q, error, out.numbers, now_s, self._rate_error(state, out.numbers))
        self._on_age(age_s, now_s)
        if now_s - self._slowly_s < SLOWLY_S - 1e-6:
            return found
        self._slowly_s = now_s
        slow = self._guards.slowly(self._slow(seen, course, now_s), now_s)
        return slow if found is None or (slow is not None and slow.response > found.response) else found

    def calm(self, now_s: float) -> Calm | None:
        """By what a step can be found to need no judging; None: `on_step` is to judge it."""
        following, envelope, limits = self._following, self._guards.envelope, self._guards.calm
        if self._tracker is None or self._tracker.changing or self._retuned:
            return None
        if following is None or envelope is None or limits is None or now_s - self._slowly_s >= SLOWLY_S - 1e-6:
            return None
        return new_record(Calm, (limits, self._tracker.delay_s, envelope.numbers, following.numbers))

    def on_calm_step(self, age_s: float | None, now_s: float, *, late: bool) -> None:
        """A control step was found to need no judging, by `calm`."""
        self._steps += 1
        self._late += late
        self._on_age(age_s, now_s)

    def _on_age(self, age_s: float | None, now_s: float) -> None:
        """Follows the delay by the age of a state."""
        delay_s = None if age_s is None else self.delay.on_age(age_s, now_s)
        if delay_s is not None and self._tracker is not None:
            self._tracker.retime(delay_s)

    def _rate_error(self, state: VehicleState, numbers: tuple[float, ...]) -> float:
        """How far the body rates are off the commanded ones [rad/s]; 0 where it is not known."""
        if self._following is None or self._tracker is None:
            return 0.0
        roll, pitch, yaw = numbers[flat.RATES]
        return self._following.error(state.t_vehicle_us * 1e-6, state.w, (roll, pitch, yaw), self._tracker.delay_s)

    def _slow(self, seen: Seen, course: Course, now_s: float) -> Slow:
        counts = self._counts
        counts.append(_Count(now_s, self._steps, self._late))
        first, passed_s = counts[0], now_s - counts[0].at_s
        steps = self._steps - first.steps
        known = len(counts) > RATES_OVER
        autopilot, health, estimator = self._autopilot, self._autopilot.health, self._autopilot.estimator
        shares = (autopilot.battery, None if health is None else health.battery)
        battery = min((share for share in shares if share is not None), default=None)
        answered_ns = self.offset.answered_ns
        status = _MAV_STATES.get(autopilot.system_status or 0)
        return Slow(
            state_rate_hz=steps / passed_s if known else None,
            state_age_s=seen.age_s if seen.paced else self._age_judged_s(seen),
            late_share=(self._late - first.late) / max(steps, 1) if known and not seen.paced else None,
            estimator=() if estimator is None else tuple(estimator.lacking(in_air=True)),
            fence=self._fence(seen.state.p, course),
            battery=battery,
            unanswered_s=None if seen.paced or answered_ns is None else (self._asked_ns - answered_ns) * 1e-9,
            failsafe="" if status is None else f"its HEARTBEAT says {status}",
        )

    def _age_judged_s(self, seen: Seen) -> float | None:
        """How old a state was when it came, by the clocks of the last second [s]."""
        offset_ns = self.offset.recent_ns
        return None if offset_ns is None else (seen.arrival_ns + offset_ns - 1000 * seen.state.t_vehicle_us) * 1e-9

    def _fence(self, p: Vec3, course: Course) -> str:
        """Which fence is broken: the vehicle file's, the trajectory's own, or the autopilot's.

        The vehicle file's counts from the vehicle's own home, as the course was planned with; while that is not known,
        from the hold point.
        """
        limits, moved = self._limits, course.moved_m
        # after resets of the estimate the same place has other coordinates
        x, y, z = p[0] - moved[0], p[1] - moved[1], p[2] - moved[2]
        (north, east, down), named = (course.home, "home") if course.home else (course.hold_point, "the hold point")
        distance, height = math.hypot(x - north, y - east), down - z
        if limits.fence_radius_m is not None and distance > limits.fence_radius_m:
            return f"{distance:.1f} m from {named}, limit {limits.fence_radius_m:g} m (limits.fence_radius_m)"
        if limits.fence_height_m is not None and height > limits.fence_height_m:
            return f"{height:.1f} m above {named}, limit {limits.fence_height_m:g} m (limits.fence_height_m)"
        own = own_fence_margins(course.path, np.array([[x, y]]))
        if own is not None and own[0] < 0.0:
            return f"{-own[0]:.1f} m beyond the fence of trajectory {course.path.trajectory.name!r}"
        health = self._autopilot.health
        kept = health is None or health.fence_kept is not False
        return "" if kept else "the autopilot says that its own fence is broken"
