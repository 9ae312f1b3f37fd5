"""What goes wrong with the body and the air of a vehicle that a real PX4 flies.

Of the kinds in `fault_kinds` those that act on the world: rotors, thrust, wind, force. Links, estimator, modes and
parameters are PX4's own here, and what concerns them is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .airframe import Airframe
from .fault_effects import BODY_KINDS, apply_to_body
from .fault_keys import FaultError
from .fault_kinds import Fault, check_together


def check_kinds(faults: Sequence[Fault]) -> None:
    """Raise FaultError when a fault is none of the body or the air, or when two cannot be at the same time."""
    for index, fault in enumerate(faults):
        if fault.kind not in BODY_KINDS:
            raise FaultError(
                f"fault[{index}].kind",
                f" = {fault.kind!r}: a real PX4 has its own links, estimator and modes; allowed are "
                f"{', '.join(BODY_KINDS)}",
            )
    check_together(faults)


class HilFaults:
    """Lets faults act on an airframe at their times since its start."""

    def __init__(self, airframe: Airframe, faults: Sequence[Fault], tell: Callable[[str], None]) -> None:
        """Plan the faults; `tell` gets a sentence whenever one begins or ends. Raises FaultError."""
        check_kinds(faults)
        self._airframe = airframe
        self._start_us = airframe.t_us
        self._tell = tell
        times = sorted({t for fault in faults for t in (fault.start_s, fault.end_s)}, reverse=True)
        self._times_s = times
        """When something changes, the next one last."""
        self._faults = faults
        self._active: list[Fault] = []

    def advance(self) -> None:
        """Begin and end what is due now."""
        now_s = (self._airframe.t_us - self._start_us) * 1e-6
        if not self._times_s or now_s < self._times_s[-1]:
            return
        while self._times_s and now_s >= self._times_s[-1]:
            self._times_s.pop()
        active = [fault for fault in self._faults if fault.start_s <= now_s < fault.end_s]
        for fault in self._active:
            if fault not in active:
                self._tell(f"{now_s:.3f} s: ends: {fault}")
        for fault in active:
            if fault not in self._active:
                self._tell(f"{now_s:.3f} s: begins: {fault} ({fault.until})")
        self._active = active
        apply_to_body(self._airframe, active)
