"""Measures the link before a flight: how often states come, how old and how evenly, the round trip and the clock.

All times are the vehicle's, as `flight.clock` follows them. That clock takes the least delayed of the vehicle's own
TIMESYNC requests as if it had not been delayed at all; our own requests tell by how much that is wrong. In lockstep the
vehicle's time stands still while we compute: a state arrives when the request that follows it says, so that the same
seed gives the same figures.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from companion.link.codec import Timesync
from companion.link.telemetry import StateRejection, VehicleState
from companion.link.timesync import ClockOffset, clock_offset

SILENCE_MIN_S: Final = 0.05
"""A state may be late by three of its periods, and by this at least: at 250 Hz three periods are 12 ms, which a busy
machine takes for itself now and then; the prediction bridges that, and PX4 holds the last rates no longer than this."""
CALIBRATION_SILENCE_S: Final = 0.15
"""A calibration waits longer: its steps turn the vehicle by 0.12 rad meanwhile at the most, it is far from anything,
and one that ends at every stall of a busy machine is never done."""
SILENT_PERIODS: Final = 3.0
USUAL: Final = 0.9
"""Jitter is what this share of the states keeps within: one stall of the machine is not the link's."""
CLOCK_ERROR_MAX_S: Final = 0.05
"""The two ways to tell the vehicle's time differ by the delay of its link; by more, something else is wrong."""
_REQUESTS_MAX = 100


def silence_limit_s(state_rate_hz: float, *, calibrates: bool = False) -> float:
    """How long a flight waits for the next state before it ends for want of them [s]."""
    return max(SILENT_PERIODS / state_rate_hz, CALIBRATION_SILENCE_S if calibrates else SILENCE_MIN_S)


class LinkFigures(NamedTuple):
    """What was measured; None where nothing came that it could be measured by."""

    states: int = 0
    rate_hz: float | None = None
    """By the stamps of the states that came, over the time that was watched."""
    age_s: float | None = None
    """Median age of a state at its arrival."""
    jitter_s: float | None = None
    """By how much later than the promptest nine states in ten come."""
    longest_gap_s: float | None = None
    """Longest time from one arrival to the next."""
    gaps: int = 0
    """Arrivals after a longer time than a flight would wait."""
    rejected: tuple[StateRejection, ...] = ()
    """Why states were not used."""
    rejections: int = 0
    """How many were not."""
    resets: int = 0
    """How often the estimator's reset counter changed."""
    round_trip_s: float | None = None
    """Median."""
    clock_error_s: float | None = None
    """The vehicle's time by its answers to us, less by its own requests: median of the half with the shorter trips."""
    paced: bool = False
    """In lockstep."""


class LinkMeter:
    """Takes what comes while it runs.

    Args:
        gap_limit_s: the longest that a flight waits for a state [s].
    """

    def __init__(self, gap_limit_s: float) -> None:
        self._gap_limit_s = gap_limit_s
        self.running = False
        """Between `start` and the end of the checks."""
        self._paced = False
        self._stamps_us: list[int] = []
        self._arrivals_s: list[float] = []
        self._rejected: dict[StateRejection, int] = {}
        self._resets = 0
        self._reset_counter: int | None = None
        self._asked: dict[int, None] = {}
        self._answers: list[ClockOffset] = []

    def start(self) -> None:
        """Begins to measure."""
        self.running = True

    @property
    def first_s(self) -> float | None:
        """When the first state came; None: none has."""
        return self._arrivals_s[0] if self._arrivals_s else None

    def on_state(self, state: VehicleState, arrival_s: float, *, paced: bool) -> None:
        """A usable state has come."""
        if not self.running:
            return
        self._paced = paced
        self._stamps_us.append(state.t_vehicle_us)
        if not paced:
            self._arrive(arrival_s)
        if self._reset_counter not in {None, state.reset_counter}:
            self._resets += 1
        self._reset_counter = state.reset_counter

    def on_rejection(self, why: StateRejection) -> None:
        """A state has come that cannot be used."""
        if self.running:
            self._rejected[why] = self._rejected.get(why, 0) + 1

    def on_paced_request(self, vehicle_ns: int) -> None:
        """The vehicle in lockstep was here when it sent the states before this."""
        if self.running and self._paced:
            self._arrive(vehicle_ns * 1e-9)

    def _arrive(self, at_s: float) -> None:
        self._arrivals_s += [at_s] * (len(self._stamps_us) - len(self._arrivals_s))

    def asks(self, own_ns: int) -> bool:
        """Notes a request of ours that goes out at this time; False while nothing is measured."""
        if self.running and len(self._asked) < _REQUESTS_MAX:
            self._asked[own_ns] = None
            return True
        return False

    def on_answer(self, message: Timesync, arrival_s: float) -> None:
        """An answer to a request; one that nobody sent, or that came already, changes nothing."""
        if message.ts1 in self._asked:
            del self._asked[message.ts1]
            self._answers.append(clock_offset(message, round(arrival_s * 1e9)))

    def figures(self, now_s: float) -> LinkFigures:
        """What came until now [s]."""
        rejected = tuple(sorted(self._rejected, key=lambda why: -self._rejected[why]))
        found = LinkFigures(
            rejected=rejected, rejections=sum(self._rejected.values()), resets=self._resets, paced=self._paced
        )
        if self._answers:
            answers = sorted(self._answers, key=lambda answer: answer.round_trip_ns)
            middle = answers[len(answers) // 2]
            offsets = sorted(answer.offset_ns for answer in answers[: len(answers) // 2 + 1])
            found = found._replace(
                round_trip_s=middle.round_trip_ns * 1e-9, clock_error_s=offsets[len(offsets) // 2] * 1e-9
            )
        return self._of_states(found, now_s)

    def _of_states(self, found: LinkFigures, now_s: float) -> LinkFigures:
        """The figures with those of the states that have arrived."""
        arrivals = self._arrivals_s
        stamps = [t_us * 1e-6 for t_us in self._stamps_us[: len(arrivals)]]
        count = len(arrivals)
        if count < 2:
            return found._replace(states=count)
        watched_s = max(stamps[-1] - stamps[0], now_s - arrivals[0] - self._gap_limit_s)
        late = sorted(arrival - stamp for arrival, stamp in zip(arrivals, stamps, strict=True))
        between = [b - a for a, b in zip(arrivals, [*arrivals[1:], max(now_s, arrivals[-1])], strict=True)]
        # In lockstep the clock is the vehicle's own; a wrong answer must not pass for an age.
        sound = found.clock_error_s is not None and abs(found.clock_error_s) < CLOCK_ERROR_MAX_S
        later_s = found.clock_error_s if sound and not self._paced and found.clock_error_s is not None else 0.0
        return found._replace(
            states=count,
            rate_hz=(count - 1) / watched_s if watched_s > 0.0 else None,
            age_s=late[count // 2] + later_s,
            jitter_s=late[int(USUAL * (count - 1))] - late[0],
            longest_gap_s=max(between),
            gaps=sum(gap > self._gap_limit_s for gap in between),
        )
