"""Two watchers of the autopilot: the timer that disarms on the ground, and the detector of a tilt out of bounds."""

from __future__ import annotations

import math

from .parameters import Parameters
from .rotation import Quat


class DisarmTimer:
    """Automatic disarming: COM_DISARM_LAND after a landing; COM_SPOOLUP_TIME + COM_DISARM_PRFLT without a takeoff."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._since_us: int | None = None

    def reset(self) -> None:
        """Begin anew."""
        self._since_us = None

    def update(self, now_us: int, landed: bool, took_off: bool) -> str | None:
        """Give the sentence to disarm with, None while there is no reason to. Zero or a negative time disables."""
        if not landed:
            self._since_us = None
            return None
        if self._since_us is None:
            self._since_us = now_us
        limit_s = self._parameters.number("COM_DISARM_LAND" if took_off else "COM_DISARM_PRFLT")
        if limit_s <= 0.0:
            return None
        if not took_off:
            limit_s += self._parameters.number("COM_SPOOLUP_TIME")
        if (now_us - self._since_us) * 1e-6 < limit_s:
            return None
        return "Disarmed by landing" if took_off else "Disarmed by auto preflight disarming"


class TiltWatch:
    """PX4's FailureDetector for the attitude: roll or pitch beyond FD_FAIL_R or FD_FAIL_P for their times."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._since_us: dict[str, int] = {}
        self._reported = False

    def failed(self, now_us: int, q: Quat, attitude_controlled: bool) -> bool:
        """Tell whether the attitude has failed; without attitude control it is not looked at."""
        if not attitude_controlled:
            self._since_us.clear()
            return False
        w, x, y, z = q
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
        return self._axis("R", roll, now_us) or self._axis("P", pitch, now_us)

    def first_report(self) -> bool:
        """Tell, once, that the failure has not been reported yet."""
        first = not self._reported
        self._reported = True
        return first

    def _axis(self, axis: str, angle: float, now_us: int) -> bool:
        """Watch one axis; a limit of zero disables it."""
        limit = math.radians(self._parameters.number(f"FD_FAIL_{axis}"))
        if limit <= 0.0 or abs(angle) <= limit:
            self._since_us.pop(axis, None)
            return False
        since = self._since_us.setdefault(axis, now_us)
        return (now_us - since) * 1e-6 >= self._parameters.number(f"FD_FAIL_{axis}_TTRI")
