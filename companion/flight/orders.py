"""What an operator's orders do to a flight that is under way: pause, resume, stop, land.

While the controller follows the course, an order first brings the course to rest by its pace (`flight.tempo`); before
that there is nothing to slow down and the autopilot is asked at once. An order that makes no sense where the flight is
gets a sentence that says so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from companion.flight.pacing import Pacing
from companion.flight.phases import Autopilot, Cause, FlightEnded, LandedState, Order, Phase

if TYPE_CHECKING:
    from companion.flight.course import Course
    from companion.flight.sequence import Sequence

_ON_COURSE = {Phase.JOIN, Phase.TRACK, Phase.PAUSE}


class Orders:
    """The operator's hand on one flight.

    Args:
        sequence: of the flight.
        autopilot: what it says of itself.
        state_rate_hz: how many states come per second.
    """

    def __init__(self, sequence: Sequence, autopilot: Autopilot, state_rate_hz: float) -> None:
        self.ended_by: Order | None = None
        """STOP or LAND, once one of them was given: how the flight is to end."""
        self._sequence = sequence
        self._autopilot = autopilot
        self._rate_hz = state_rate_hz
        self._pacing: Pacing | None = None
        self._given: list[Order] = []
        self._going_on = False
        self._pace = 1.0
        """Of the course while nobody asks for rest."""

    def follow(self, course: Course) -> None:
        """From now on the controller follows this course."""
        self._pacing = Pacing(course, self._rate_hz)

    @property
    def resting(self) -> bool:
        """Whether the course has come to rest for a pause."""
        sequence = self._sequence
        return sequence.phase is Phase.PAUSE and sequence.course is not None and sequence.course.resting(self._t_s)

    def give(self, order: Order) -> str:
        """Takes an order, which acts at the next `tick`; giving it twice is giving it once.

        Returns:
            "" or why it cannot be followed, for people.
        """
        phase = self._sequence.phase
        if self._sequence.ending is not None:
            return "" if order is Order.STOP else "the flight is ending"
        if order in {Order.PAUSE, Order.RESUME}:
            if self.ended_by is not None:
                return f"the flight is coming to its end ({self.ended_by.value})"
            if self._pacing is None or phase not in _ON_COURSE:
                return f"there is nothing to {order.value} in the phase {phase.value}"
            if order is Order.RESUME and phase is not Phase.PAUSE:
                return "the flight is not paused"
        self._given.append(order)
        return ""

    def tick(self, now_s: float) -> None:
        """Follows what was ordered.

        Raises:
            FlightEnded: there is nothing to be handed over.
        """
        if self._given:
            given, self._given = self._given, []
            for order in given:
                if self._sequence.ending is None:
                    self._follow(order, now_s)
        pacing = self._pacing
        if pacing is None:
            return
        if pacing.plan is not None:
            pacing.tick(self._t_s)
        if self._going_on and self._sequence.phase is Phase.PAUSE and pacing.reached(self._t_s):
            self._sequence.enter(self._sequence.phase_on_course(self._t_s), now_s, "back at the course's own pace")

    @property
    def _t_s(self) -> float:
        """Time since engaging, of the newest state [s]."""
        return self._sequence.stamp_s - self._sequence.engaged_at_s

    def _follow(self, order: Order, now_s: float) -> None:
        sequence, pacing = self._sequence, self._pacing
        on_course = pacing is not None and sequence.phase in _ON_COURSE
        if order is Order.RESUME and pacing is not None and sequence.phase is Phase.PAUSE:
            self._going_on = True
            pacing.want(self._pace, self._t_s)
        elif order is Order.PAUSE and pacing is not None and on_course:
            self._going_on = False
            pacing.want(0.0, self._t_s)
            if sequence.phase is not Phase.PAUSE:
                sequence.enter(Phase.PAUSE, now_s, "the operator asks for a pause")
        elif order in {Order.STOP, Order.LAND}:
            self.ended_by = order
            if pacing is not None and on_course:
                pacing.want(0.0, self._t_s)
                sequence.enter(Phase.HOLD, now_s, f"the operator ends the flight ({order.value})")
            elif sequence.phase is not Phase.HOLD:
                self._end_before(order, now_s)

    # -- guards -------------------------------------------------------------------------------------------------

    def set_pace(self, pace: float, why: str) -> None:
        """The course is to be flown at this share of its own pace; a pause or an end goes before.

        Args:
            pace: above 0, at most 1.
            why: for people.
        """
        if pace == self._pace or self._pacing is None:
            return
        self._pace = pace
        phase = self._sequence.phase
        if phase in {Phase.JOIN, Phase.TRACK} or (phase is Phase.PAUSE and self._going_on):
            self._pacing.want(pace, self._t_s)
            how = "gets its own pace back" if pace == 1.0 else f"slows down to {pace:.0%} of its pace"
            self._sequence.tell(f"the reference {how}: {why}")

    def come_to_rest(self, now_s: float, why: str) -> bool:
        """The course is to end at rest; False where nothing is flown that could come to rest.

        Args:
            now_s: vehicle time [s].
            why: for people.
        """
        if self._pacing is None or self._sequence.phase not in {*_ON_COURSE, Phase.HOLD}:
            return False
        if self._sequence.phase is not Phase.HOLD:
            self.ended_by = Order.STOP
            self._pacing.want(0.0, self._t_s)
            self._sequence.enter(Phase.HOLD, now_s, why)
        return True

    def _end_before(self, order: Order, now_s: float) -> None:
        """Before the course, or after it: nothing of ours is flying.

        In a take-off the autopilot may have armed and not said so yet: it is asked for Hold, or to land, all the same.
        """
        sequence, autopilot = self._sequence, self._autopilot
        asked_nothing = sequence.phase in {Phase.CONNECT, Phase.PREFLIGHT}
        grounded = autopilot.landed is LandedState.ON_GROUND
        if grounded and (sequence.phase is Phase.LAND or (asked_nothing and not autopilot.armed)):
            raise FlightEnded(Cause.STOPPED, "the vehicle is on the ground")
        if order is Order.LAND:
            if sequence.phase is not Phase.LAND:
                sequence.land_from_here(now_s)
        elif asked_nothing:
            raise FlightEnded(Cause.STOPPED, "before anything was asked of the vehicle")
        else:
            sequence.end(Cause.STOPPED, "", now_s)
