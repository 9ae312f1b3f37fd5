"""The faults of one vehicle: which act when, scripted ones and those that are ordered while it runs.

Times are vehicle time since the start, and go on through a reboot. A fault begins and ends between two states: before
the first state that comes after its time.
"""

from __future__ import annotations

import heapq
import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from .autopilot import Result
from .fault_effects import Effects
from .fault_file import check_parameters
from .fault_keys import FaultError
from .fault_kinds import Fault, check_together, from_table, over_s

if TYPE_CHECKING:
    from .vehicle import Vehicle

LOG_COLUMNS = ("t_s", "number", "event", "fault", "remark")
AT_ONCE_MAX, ALL_MAX = 200, 10_000
"""Of the faults that are ordered: more of them would take the vehicle's time."""
_NEVER_US = 1 << 62
_BEGIN, _END = 1, 0
"""At the same time what ends does so first."""
_UNIT_GPS, _UNIT_MOTOR = 4, 101
_OK, _OFF, _STUCK, _WRONG = 0, 1, 2, 4
"""FAILURE_UNIT and FAILURE_TYPE of MAV_CMD_INJECT_FAILURE."""
_ROTORS = 4
GPS_LOST_DRIFT_M_S = (0.3, 0.2, 0.1)
"""NED. How the estimate runs away without GPS."""


def _silent(sentence: str) -> None:
    """Tell nobody."""


class Faults:
    """The faults of a vehicle. What is ordered may come from any thread; it acts with the next state."""

    def __init__(self, vehicle: Vehicle, faults: Sequence[Fault], *, seed: int) -> None:
        """Plan faults from the start on.

        Raises:
            FaultError: two of them cannot be at the same time, or one is of a parameter that there is not.
        """
        self._px4 = vehicle.options.px4
        self._airframe = vehicle.airframe
        self._parameters = vehicle.parameters
        check_together(faults)
        check_parameters(faults, self._px4)
        self.effects = Effects(vehicle, seed)
        self.tell: Callable[[str], None] = _silent
        """Gets a sentence whenever a fault begins or ends."""
        self.next_us = _NEVER_US
        """Time of the physics from which on `advance` is to be called before the next state."""
        self._start_us = self._airframe.t_us
        self._all: list[Fault] = []
        self._over: set[int] = set()
        self._events: list[tuple[int, int, int]] = []
        """Heap of time [us], begin or end, number."""
        self._again_us = _NEVER_US
        self._lock = threading.RLock()
        self._log_path: Path | None = None
        self._log: TextIO | None = None
        self._failures: dict[tuple[int, int], int] = {}
        """Of INJECT_FAILURE: unit and instance, number of the fault."""
        for fault in faults:
            self._plan(fault)

    # What is planned

    @property
    def elapsed_s(self) -> float:
        """Vehicle time since the start [s]."""
        return (self._airframe.t_us - self._start_us) * 1e-6

    @property
    def active(self) -> dict[int, Fault]:
        """The faults that act now, by their numbers."""
        return dict(self.effects.active)

    @property
    def refused(self) -> dict[int, Result]:
        """Commands that are refused now, and how."""
        return self.effects.refused

    @property
    def planned(self) -> dict[int, Fault]:
        """The faults that act now or will, by their numbers."""
        with self._lock:
            return {number: fault for number, fault in enumerate(self._all) if number not in self._over}

    def add(self, fault: Fault) -> int:
        """Plan a fault, or let it act with the next state when its time has come; gives its number.

        Raises:
            FaultError: it cannot be at the same time as another, or its parameter does not exist.
        """
        with self._lock:
            try:
                check_parameters([fault], self._px4)
            except FaultError as error:
                raise FaultError(error.key.removeprefix("fault[0]."), error.sentence) from None
            left = [number for number in range(len(self._all)) if number not in self._over]
            if len(left) >= AT_ONCE_MAX or len(self._all) >= ALL_MAX:
                raise FaultError("", f"too many faults: {AT_ONCE_MAX} can act or wait, and {ALL_MAX} be in all")
            numbers = [*left, len(self._all)]
            check_together(
                [*(self._all[n] for n in left), fault], lambda index: f"fault {numbers[index]}", first=len(left)
            )
            return self._plan(fault)

    def inject(
        self,
        kind: str,
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        for_s: float | None = None,
        **values: Any,
    ) -> int:
        """Plan a fault: `inject("wind", for_s=2.0, wind_m_s=(0, 8, 0))`; gives its number.

        Args:
            kind: its kind.
            start_s: when, vehicle time since the start; None: now.
            end_s: until when; None: for good.
            for_s: for how long, in the place of end_s.
            **values: the kind's own keys.

        Raises:
            FaultError: it cannot be.
        """
        table = {"kind": kind, "start_s": start_s, "end_s": end_s, "for_s": for_s, **values}
        return self.add(self.of_order({key: value for key, value in table.items() if value is not None}))

    def of_order(self, table: dict[str, Any]) -> Fault:
        """Make a fault of the table of an order: as in a file, but start_s may be left out, and for_s may be given.

        Raises:
            FaultError: it cannot be.
        """
        values = dict(table)
        start_s = values.setdefault("start_s", self.elapsed_s)
        if "for_s" in values:
            for_s = values.pop("for_s")
            fits = isinstance(for_s, int | float) and not isinstance(for_s, bool) and 0.0 < for_s < math.inf
            if not fits or "end_s" in values:
                raise FaultError("for_s", f" = {for_s!r}: must be a number of seconds above 0, without end_s")
            if isinstance(start_s, int | float):
                values["end_s"] = start_s + for_s
        return from_table(values)

    def end(self, number: int) -> None:
        """End a fault now; one that was planned does not come. Raises FaultError when there is no such fault."""
        with self._lock:
            if not 0 <= number < len(self._all) or number in self._over:
                raise FaultError("", f"there is no fault {number}")
            if self._all[number].kind == "reboot" and number in self.effects.active:
                raise FaultError("", f"fault {number}: a reboot cannot be ended")
            self._events = [event for event in self._events if event[2] != number]
            heapq.heapify(self._events)
            self._over.add(number)
            if number in self.effects.active:
                heapq.heappush(self._events, (self._airframe.t_us, _END, number))
                self.next_us = 0

    def _plan(self, fault: Fault) -> int:
        """Take a fault in; the lock is held, or nobody else knows of this object yet."""
        number = len(self._all)
        self._all.append(fault)
        at_us = max(self._start_us + round(fault.start_s * 1e6), self._airframe.t_us)
        heapq.heappush(self._events, (at_us, _BEGIN, number))
        end_s = over_s(fault)
        if end_s > fault.start_s and end_s < math.inf:
            heapq.heappush(self._events, (max(self._start_us + round(end_s * 1e6), at_us + 1), _END, number))
        self.next_us = min(self.next_us, at_us)
        return number

    # Time

    def advance(self, now_us: int, period_us: int) -> None:
        """Begin and end what is due at a time of the physics, before the state period_us later."""
        with self._lock:
            for link in self.effects.links.values():
                link.now_us = now_us + period_us
            while self._events and self._events[0][0] <= now_us:
                _, event, number = heapq.heappop(self._events)
                if event == _BEGIN:
                    self._begin(number)
                else:
                    self._end(number)
            again_us = self.effects.advance(now_us, period_us)
            self.next_us = min(again_us, self._events[0][0] if self._events else _NEVER_US)

    def _begin(self, number: int) -> None:
        fault = self._all[number]
        remark = self.effects.begin(number, fault)
        word = "happens" if not fault.until else "begins"
        self._report(number, word, fault, remark or (fault.until if word == "begins" else ""))
        if over_s(fault) <= fault.start_s:
            self.effects.end(number)
            self._over.add(number)

    def _end(self, number: int) -> None:
        fault = self._all[number]
        self.effects.end(number)
        self._over.add(number)
        self._report(number, "ends", fault, "")

    # What there is to see

    def log_to(self, path: Path) -> None:
        """Write a row of CSV for whatever happens from now on; the file is begun when something does."""
        path.unlink(missing_ok=True)
        self._log_path = path

    def close(self) -> None:
        """Complete the log; doing so twice is harmless."""
        log, self._log, self._log_path = self._log, None, None
        if log is not None:
            with suppress(OSError):  # what could not be written before
                log.close()

    def _report(self, number: int, event: str, fault: Fault, remark: str) -> None:
        """Tell that a fault begins, happens or ends."""
        more = f" ({remark})" if remark else ""
        self.tell(f"{self.elapsed_s:.3f} s: fault {number} {event}: {fault}{more}")
        path = self._log_path
        if path is None:
            return
        try:
            if self._log is None:
                self._log = path.open("w", encoding="utf-8", newline="")
                self._write(LOG_COLUMNS)
            self._write((f"{self.elapsed_s:.6f}", str(number), event, str(fault), remark))
        except OSError as error:  # a vehicle does not fall out of the air because a disk is full
            self.close()
            self.tell(f"{path.name}: {error.strerror}; nothing more is written, the flight goes on")

    def _write(self, cells: Sequence[str]) -> None:
        if self._log is not None:
            quoted = [f'"{cell.replace(chr(34), chr(34) * 2)}"' if "," in cell else cell for cell in cells]
            self._log.write(",".join(quoted) + "\n")
            self._log.flush()

    # PX4's own way

    def inject_failure(self, unit: int, kind: int, instance: int) -> Result:
        """Obey MAV_CMD_INJECT_FAILURE: a motor (1 to 4, 0: all) or the GPS, off or well again.

        PX4 knows of a motor "stuck" and "wrong" as well, which break the ESC's telemetry alone. Of what this vehicle
        does not simulate, or while SYS_FAILURE_EN is not 1, nothing is supported.
        """
        if self._parameters.integer("SYS_FAILURE_EN") != 1:
            return Result.UNSUPPORTED
        if unit == _UNIT_MOTOR and kind in (_OK, _OFF, _STUCK, _WRONG) and 0 <= instance <= _ROTORS:
            if kind in (_OK, _OFF):
                for rotor in range(1, _ROTORS + 1) if instance == 0 else (instance,):
                    self._fail((unit, rotor), kind == _OFF, "rotor", rotor=rotor)
            return Result.ACCEPTED
        if unit == _UNIT_GPS and kind in (_OK, _OFF) and instance in (0, 1):
            self._fail((unit, 1), kind == _OFF, "estimator_drift", drift_m_s=GPS_LOST_DRIFT_M_S)
            return Result.ACCEPTED
        return Result.UNSUPPORTED

    def _fail(self, what: tuple[int, int], fails: bool, kind: str, **values: Any) -> None:
        """Let a unit fail, or end that."""
        number = self._failures.get(what)
        failing = number is not None and number not in self._over
        try:
            if fails and not failing:
                self._failures[what] = self.inject(kind, **values)
            elif number is not None and failing and not fails:
                self.end(number)
        except FaultError:
            pass  # a scripted fault has it already
