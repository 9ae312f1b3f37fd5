"""A wish for another pace, an operator's or a guard's, planned beside the control steps and then flown."""

from __future__ import annotations

import math

from companion.flight.course import Course
from companion.flight.tempo import LEAD_S, PLANNING_S, RampPlan

LOOK_AHEAD_S = 0.2
"""The control step asks for the reference this far ahead at most; what is nearer must not change any more."""


class Pacing:
    """Brings a course to the pace that is wanted: from 1, its own, to 0, rest.

    Args:
        course: what is flown.
        state_rate_hz: how often `tick` is called.
    """

    def __init__(self, course: Course, state_rate_hz: float) -> None:
        self._course = course
        self._wanted = 1.0
        self.plan: RampPlan | None = None
        """The change of pace that `tick` plans; None: it has nothing to do."""
        plan = course.plan_pace(0.0, 1.0)
        self._samples = math.ceil(plan.samples_max / (PLANNING_S * state_rate_hz))

    def want(self, rate: float, t_s: float) -> None:
        """Wants a pace from now on; wanting what is wanted already changes nothing.

        Args:
            rate: 0 to 1.
            t_s: time since engaging [s].
        """
        if rate != self._wanted:
            self._wanted = rate
            self.plan = self._course.plan_pace(t_s + LEAD_S, rate)

    def tick(self, t_s: float) -> None:
        """Plans on; called once per state, when its setpoint is out."""
        if self.plan is None:
            return
        if t_s > self.plan.begin_s - LOOK_AHEAD_S:  # too late for this one: states came too rarely
            self.plan = self._course.plan_pace(t_s + LEAD_S, self._wanted)
        ramp = self.plan.work(self._samples)
        if ramp is not None:
            self.plan = None
            self._course.change_pace(ramp)

    def reached(self, t_s: float) -> bool:
        """Whether the course has the pace that is wanted."""
        if self.plan is not None:
            return False
        ramps = self._course.ramps
        return not ramps or t_s >= ramps[-1].begin_s + ramps[-1].duration_s
