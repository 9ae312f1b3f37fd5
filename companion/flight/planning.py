"""Plans the course of a flight beside the control loop, so that the loop keeps listening meanwhile.

Planning a join takes up to a second on a slow computer. The autopilot holds the vehicle all that time and no setpoint
is due; but a loop that stands still does not see that the pilot takes over, answers nothing, and begins to stream with
what has piled up. So a thread plans, and the loop asks whether it is done. A vehicle in lockstep waits for the loop by
itself: there the plan is made at once, and the same seed gives the same flight.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from companion.flight.course import Course


class Planning:
    """One plan under way.

    Args:
        plan: makes the course; raises RefusedError where there is none.
        aside: in a thread of its own.
    """

    def __init__(self, plan: Callable[[], Course], *, aside: bool) -> None:
        self._plan = plan
        self._course: Course | None = None
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None
        if aside:
            self._thread = threading.Thread(target=self._run, name="planning", daemon=True)
            self._thread.start()
        else:
            self._run()

    def _run(self) -> None:
        try:
            self._course = self._plan()
        except Exception as error:  # the loop's to judge
            self._error = error

    def course(self) -> Course | None:
        """The course; None while it is being planned.

        Raises:
            RefusedError: there is none within the vehicle's limits.
        """
        if self._thread is not None and self._thread.is_alive():
            return None
        if self._error is not None:
            raise self._error
        return self._course
