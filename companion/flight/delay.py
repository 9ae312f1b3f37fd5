"""The delay from a state's stamp to the effect of its command, as it is rather than as the vehicle file says.

A state's age at its arrival comes from the clocks (`link.offset`; in lockstep from the vehicle's own time), and the
vehicle file's command delay is added. What the prediction uses follows slowly, in small steps, and within bounds: the
reference is taken at the time of effect, so a step of the delay would be a step of the reference.
"""

from __future__ import annotations

from companion.config import Vehicle

CHANGE_MAX_S = 0.020
"""The delay in use stays this near to the vehicle file's."""
SMOOTHING_S = 2.0
"""Time constant of the age that is followed."""
STEP_S = 0.0002
EVERY_S = 0.1
"""A step of the delay in use is no larger and comes no more often: 2 ms per second."""
BEGIN_S, DONE_S = 0.001, 0.0002
"""It begins to follow when it is off by the first, and until it is by less than the second."""
AGE_MAX_S = 1.0
"""A larger age is no age: the clocks are wrong."""


class Delay:
    """Follows the delay of one flight.

    Args:
        vehicle: the vehicle file.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.file_s = vehicle.delay_s
        """What the vehicle file says [s]."""
        self.used_s = vehicle.delay_s
        """What the prediction uses [s]."""
        self.age_s: float | None = None
        """How old states are when they come, smoothed [s]; None: nobody knows."""
        link = vehicle.link
        self._follows = vehicle.controller.measured_delay and vehicle.controller.prediction
        self._command_s = link.command_delay_s
        self._low_s = max(vehicle.delay_s - CHANGE_MAX_S, link.command_delay_s)
        self._high_s = vehicle.delay_s + CHANGE_MAX_S
        self._last_s: float | None = None
        self._stepped_s = 0.0
        self._following = False

    def on_age(self, age_s: float, now_s: float) -> float | None:
        """A state was so old when it came.

        Args:
            age_s: at its arrival [s].
            now_s: vehicle time [s].

        Returns:
            the delay to use from now on [s]; None: the same as before.
        """
        if not 0.0 <= age_s <= AGE_MAX_S:
            return None
        if self.age_s is None or self._last_s is None:
            self.age_s, self._last_s, self._stepped_s = age_s, now_s, now_s
            return None
        passed_s = now_s - self._last_s
        share = 0.0 if passed_s <= 0.0 else 1.0 if passed_s >= SMOOTHING_S else passed_s / SMOOTHING_S
        self._last_s = now_s
        self.age_s += share * (age_s - self.age_s)
        if not self._follows or now_s - self._stepped_s < EVERY_S:
            return None
        self._stepped_s = now_s
        wanted = min(max(self.age_s + self._command_s, self._low_s), self._high_s)
        gap = wanted - self.used_s
        self._following = abs(gap) > (DONE_S if self._following else BEGIN_S)
        if not self._following:
            return None
        self.used_s += min(max(gap, -STEP_S), STEP_S)
        return self.used_s
