"""Several vehicles in one thread: each with its own sockets and its own time, none waits for another.

In real time every vehicle has a deadline for its next state, spread over the period so that they do not all come at
once: one after the other, or a few together where they are many. In lockstep every vehicle follows its own companion,
as it would alone: the same seed gives the same flight. Between deadlines the thread sleeps in one wait over all
sockets.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from .peer import HEARTBEAT_WALL_S, PATIENCE_S, SLICE_S, Peer, PeerOptions
from .vehicle import Vehicle, VehicleOptions
from .waiting import Waiter

TOGETHER_S = 0.001
"""Deadlines within this wall time are one: to wake for each of them, with caches that hold what others need, costs a
vehicle a quarter of its time, and to come a few hundred microseconds after the first one harms nobody."""
SPACING_M = 3.0
"""Between neighbours, eastwards."""
SYSTEMS_MAX = 250
"""System ids that vehicles can have: 1 to this."""


def siblings(options: VehicleOptions, count: int, spacing_m: float = SPACING_M) -> list[VehicleOptions]:
    """Give the options of `count` vehicles like one: consecutive instances and seeds, side by side eastwards.

    The first is the one given. Their gusts differ as their noise does.

    Raises:
        ValueError: there are not so many system ids.
    """
    if count < 1 or options.instance + count > SYSTEMS_MAX:
        raise ValueError(f"instances {options.instance} to {options.instance + count - 1}: allowed are 0 to 249")
    found = []
    for k in range(count):
        aside_m = k * spacing_m
        start = options.start
        if start is not None:
            (north, east, down), yaw = start
            start = (north, east + aside_m, down), yaw
        found.append(
            replace(
                options,
                instance=options.instance + k,
                start=start,
                place_m=(options.place_m[0], options.place_m[1] + aside_m),
                seed=options.seed + k,
                world=replace(options.world, seed=options.world.seed + k),
            )
        )
    return found


class Member(Peer):
    """One vehicle of a fleet: it never waits, and tells when it must be attended to at the latest."""

    due_s = 0.0
    """Wall time (monotonic) of that; infinite once it has ended."""
    _row = ""
    """Of the present state, for the truth file: written when the state is over."""

    def begin(self, at_s: float, duration_s: float | None) -> None:
        """Let its time begin at a wall time (monotonic), and end after a time of the vehicle's."""
        self.due_s = self._deadline_s = at_s
        self.companion.together = True  # fewer datagrams: they are most of what a vehicle costs besides its physics
        end_s = math.inf if duration_s is None else duration_s
        self._end_us = self.vehicle.start_us + end_s * 1e6
        self._last_us = None if duration_s is None else self.vehicle.start_us + round(duration_s * 1e6)
        for intake in self._intakes:
            intake.listen()

    @property
    def descriptors(self) -> list[int]:
        """Its sockets, as a wait tells them."""
        return [endpoint.descriptor for endpoint in self._endpoints]

    def hear(self, descriptor: int) -> None:
        """Act on what one of its sockets has received; in lockstep go on once the companion has answered."""
        if self.due_s == math.inf:
            return
        if descriptor != self.companion.descriptor:
            self._hear_ground()
        elif self._started:
            self._hear_companion()
        elif self._hear_first():
            self._go_on()
        self._flush()
        if self._started and self._answered and not self.synchronous:
            self._return_to_lockstep()
        while self._answered and self.synchronous and not self._ended():
            self._go_on()

    def attend(self, now_s: float) -> None:
        """Do what is due at a wall time."""
        if not self._started:
            self.due_s = now_s + HEARTBEAT_WALL_S
            self._refill()
            self.vehicle.heartbeat()
            self._flush()
        elif not self._ended():
            if self.synchronous and not self._answered:
                self._lose_patience()
            self._go_on()

    def _go_on(self) -> None:
        """Complete the present state and advance to the next one."""
        if self._row:
            self._log_row(self._row)
        self._row = self._advance()
        if self.synchronous:
            while self._waiting and not self._answered:
                self._act(*self._waiting.popleft())
            self.due_s = self._ticked_s + PATIENCE_S
        else:
            self._set_deadline()
            self.due_s = self._deadline_s
        self._flush()

    def _ended(self) -> bool:
        """Tell whether the vehicle's time is over; then nobody listens to it any more."""
        if self.vehicle.airframe.t_us < self._end_us:
            return False
        if self.due_s < math.inf:
            self.due_s = math.inf
            for intake in self._intakes:
                intake.ignore()
        return True

    def close(self) -> None:
        """Close the sockets and complete the truth file; what waits for its answer in lockstep is left out of it."""
        if self._row and (self._answered or not self.synchronous):
            self._log_row(self._row)
        self._row = ""
        super().close()


class Fleet:
    """Runs vehicles on real sockets, in the calling thread."""

    def __init__(
        self,
        vehicles: Sequence[tuple[Vehicle, PeerOptions]],
        *,
        stopped: Callable[[], bool] = lambda: False,
        notice: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """Open all sockets.

        Args:
            vehicles: what to run, each with its ports and its time.
            stopped: asked often; once it says yes, `run` returns.
            notice: gets a sentence when something happens to a vehicle (see `Peer`), with its system id before it.

        Raises:
            PortError: a port is in use.
        """
        self._stopped = stopped
        self._waiter = Waiter()
        self.members: list[Member] = []
        try:
            for vehicle, options in vehicles:
                self.members.append(
                    Member(
                        vehicle,
                        options,
                        stopped=stopped,
                        notice=_named(vehicle.system, notice),
                        waiter=self._waiter,
                        sharers=len(vehicles),
                    )
                )
        except OSError:
            self.close()
            raise
        self._owners = {descriptor: member for member in self.members for descriptor in member.descriptors}

    def run(self, duration_s: float | None = None) -> None:
        """Run until told to stop, or until every vehicle's time has reached a duration."""
        clock, wait, owners = time.monotonic, self._waiter.wait, self._owners
        begin_s = clock()
        calendar: list[tuple[float, int]] = []
        for k, member in enumerate(self.members):
            apart_s = member.state_wall_s / len(self.members)
            together = max(1, int(TOGETHER_S / apart_s))
            member.begin(begin_s + (k - k % together) * apart_s, duration_s)
            calendar.append((member.due_s, k))
        flying = set(self.members)
        while flying and not self._stopped():
            left_s = min(calendar[0][0] - clock(), SLICE_S)
            for descriptor in wait(left_s):
                member = owners[descriptor]
                member.hear(descriptor)
                if member.due_s == math.inf:
                    flying.discard(member)
            now_s = clock()
            due = []
            while calendar and calendar[0][0] <= now_s:
                due.append(heapq.heappop(calendar)[1])
            for k in due:  # one state each: whoever is late must not keep the others from being heard
                member = self.members[k]
                if member.due_s <= now_s:
                    member.attend(now_s)
                if member.due_s < math.inf:
                    heapq.heappush(calendar, (member.due_s, k))
                else:
                    flying.discard(member)

    def close(self) -> None:
        """Close all sockets and complete the truth files."""
        for member in self.members:
            member.close()


def _named(system: int, notice: Callable[[str], None]) -> Callable[[str], None]:
    """Say of which vehicle a sentence tells."""
    return lambda sentence: notice(f"system {system}: {sentence}")
