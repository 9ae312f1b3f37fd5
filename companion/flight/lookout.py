"""Looking out for the next state without sleeping, for a short time around the moment at which it is due.

A process that sleeps is woken tens to hundreds of microseconds after what it waits for, and then begins with cold
caches: often more than the whole control step takes. States come at a steady rate, so the wait can end in a look that
does not sleep: from shortly before the next one is due until shortly after. How early follows the states' own
unsteadiness; where they are too unsteady for it the loop just sleeps. It costs a few per cent of a core and is part of
`--realtime`. Times are our own clock's (`time.monotonic_ns`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

LOOK_NS: Final = 120_000
"""How long before the next state is due the look begins, where states are perfectly steady."""
LOOK_MAX_NS: Final = 400_000
"""The longest lead: states that need more are slept for."""
SPREAD: Final = 2.0
"""Times the mean unsteadiness: the lead and the patience beyond the state's due time."""
_FOLLOW: Final = 0.1
"""Share of each deviation that due time and interval follow."""
_DRIFT: Final = 0.01
_MISSED_MAX: Final = 20


class Look(NamedTuple):
    """How to wait for the next state."""

    sleep_s: float
    """Sleep at most so long."""
    spin_s: float
    """Then look without sleeping for so long; 0: sleep on."""


SLEEP: Final = Look(0.0, 0.0)


class Lookout:
    """Follows when states come.

    Args:
        interval_s: between two states, as far as it is known [s].
    """

    def __init__(self, interval_s: float) -> None:
        self._nominal_ns = self._interval_ns = interval_s * 1e9
        self._due_ns: float | None = None
        self._off_ns = float(LOOK_MAX_NS)
        """Mean distance of the arrivals from their due times."""

    def on_state(self, arrival_ns: int) -> None:
        """A state has come."""
        due_ns, interval_ns = self._due_ns, self._interval_ns
        missed = 0 if due_ns is None else round((arrival_ns - due_ns) / interval_ns)
        if due_ns is None or missed > _MISSED_MAX:  # the first, or after a gap
            self._due_ns = arrival_ns + interval_ns
            return
        if missed < 0:  # one too many moves nothing
            return
        due_ns += missed * interval_ns
        off_ns = arrival_ns - due_ns
        self._off_ns += _FOLLOW * (min(abs(off_ns), 2.0 * LOOK_MAX_NS) - self._off_ns)
        most_ns = 0.05 * self._nominal_ns
        drift_ns = self._interval_ns + _DRIFT * off_ns - self._nominal_ns
        self._interval_ns = self._nominal_ns + min(max(drift_ns, -most_ns), most_ns)
        self._due_ns = due_ns + _FOLLOW * off_ns + self._interval_ns

    def look(self, now_ns: int) -> Look:
        """How to wait from now on."""
        due_ns = self._due_ns
        room_ns = LOOK_NS + SPREAD * self._off_ns
        if due_ns is None or room_ns > LOOK_MAX_NS:
            return SLEEP
        begin_ns, end_ns = due_ns - room_ns, due_ns + room_ns
        if now_ns >= end_ns:
            return SLEEP
        return Look(max(0.0, begin_ns - now_ns) * 1e-9, (end_ns - max(begin_ns, now_ns)) * 1e-9)
