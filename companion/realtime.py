"""What the system can do for the control process, each on its own.

Unasked, for every vehicle whose time passes by itself: a priority above ordinary processes, where that is permitted.
Without it a process that wakes in the middle of a step takes the core until the scheduler's next tick, 4 ms later: with
a busy ground link the step's 99th percentile is two to three times what it is without. And a way out of it for others:
`make_way` when a setpoint has gone out. On a computer with two cores, shared with the vehicle that it goes to, its 99th
percentile there is 0.6 of what it is without.

With `--realtime`, and each said: a scheduling class above everything ordinary, memory that is not swapped out, timers
without slack, a core to stay on. Nothing of it is needed for a flight.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

PRIORITY: Final = 20
"""Of SCHED_FIFO, 1 to 99: above all ordinary processes, below the kernel's own threads (50)."""
NICENESS: Final = -10
"""Of the control process in flight: a step is one to ten per cent of a core, whoever waits for it waits shortly."""
CORES_VARIABLE: Final = "COMPANION_CORES"
"""Tells children on which cores this process might run before it chose one."""

_PR_SET_TIMERSLACK: Final = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_CAP_IPC_LOCK: Final = 14


class Measure(NamedTuple):
    """One thing that was asked of the system."""

    name: str
    taken: bool
    detail: str
    """What holds now, or why not and what to do about it."""

    @property
    def sentence(self) -> str:
        """For people."""
        return f"realtime: {self.name}: {self.detail}"


def take_priority() -> bool:
    """Gives the calling thread `NICENESS`, where it has less; what it starts afterwards, threads too, is ordinary.

    Returns:
        Whether it has it: as an ordinary user it needs a nice limit of 30 (`ulimit -e 30`, LimitNICE=-10 in a unit).
    """
    try:
        if os.sched_getscheduler(0) == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
        if os.getpriority(os.PRIO_PROCESS, 0) > NICENESS:
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    except (OSError, AttributeError):  # not permitted; not Linux
        return False
    return True


def make_way() -> None:
    """Lets those go first who wait for this core: a setpoint is out, and what is left to do with its step can wait.

    A vehicle or a router on the same computer may wake where this thread still runs, and is behind it in priority.
    """
    with contextlib.suppress(AttributeError):  # not everywhere
        os.sched_yield()


def take_core_of_two(port: int) -> None:
    """Keeps the calling thread off the core of a vehicle in lockstep, on a machine with two; `rejoin` ends it.

    Two programs that wait for each other are never busy at the same time for long. A scheduler likes to put them on one
    core, where each wake of the one stops the other, and a flight takes up to twice as long; with more cores it finds
    idle ones. The vehicle does the same with the other core (`sim_link.cores`).

    Args:
        port: the UDP port at which the vehicle is heard: whose core is which goes by it, so that pairs are spread.
    """
    with contextlib.suppress(OSError, AttributeError):  # not permitted; not Linux
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) == 2:
            _stay_on(cores[port % 2], cores)


def prepare() -> list[Measure]:
    """Asks for all of it, for the calling thread and the memory of its process; never raises.

    Call it when all that is to run beside the control loop (the recorder) has been started: children do not get the
    scheduling class, and `rejoin` gives them the cores back.
    """
    measures = (("cores", _stay_on_a_core), ("timer slack", _no_slack), ("memory", _lock_memory))
    return [_taken(name, ask) for name, ask in (*measures, ("scheduling class", _fifo))]


def rejoin() -> None:
    """For a process that a real-time one started: it may run on all cores again."""
    cores = os.environ.pop(CORES_VARIABLE, "")
    with contextlib.suppress(OSError, ValueError):
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})


class _NotPermittedError(Exception):
    """Why one of them is not to be had."""


def _taken(name: str, ask: Callable[[], str]) -> Measure:
    try:
        return Measure(name, True, ask())
    except _NotPermittedError as error:
        return Measure(name, False, f"not permitted: {error}")
    except (OSError, AttributeError) as error:  # not Linux, or a system that lacks it
        return Measure(name, False, f"not available here: {error}")


def _fifo() -> str:
    try:
        # Children start in the ordinary class: a recorder or a planner there would compete with the loop itself.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError:
        raise _NotPermittedError(
            f"it needs CAP_SYS_NICE or an rtprio limit of {PRIORITY} (ulimit -r, LimitRTPRIO={PRIORITY} in a unit)"
        ) from None
    return f"SCHED_FIFO, priority {PRIORITY}"


def _lock_memory() -> str:
    needs = _NotPermittedError(
        "it needs CAP_IPC_LOCK or no memlock limit (ulimit -l unlimited, LimitMEMLOCK=infinity in a unit)"
    )
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    # Under a limit the lock may be granted now and an allocation in flight fail: then rather none.
    if soft != resource.RLIM_INFINITY and not _capable(_CAP_IPC_LOCK):
        raise needs
    if _libc().mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise needs
    return "locked, what is there and what comes"


def _no_slack() -> str:
    if _libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        raise _NotPermittedError(os.strerror(ctypes.get_errno()))
    return "1 ns instead of 50 us"


def _stay_on_a_core() -> str:
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise _NotPermittedError("there is one core only, nothing to choose")
    _stay_on(cores[-1], cores)  # interrupts are mostly served by the first
    return f"stays on {cores[-1]} of {len(cores)}"


def _stay_on(core: int, cores: list[int]) -> None:
    """Keeps the calling thread on one of the cores that it has; `rejoin` knows them all."""
    os.sched_setaffinity(0, {core})
    os.environ[CORES_VARIABLE] = ",".join(map(str, cores))


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _capable(capability: int) -> bool:
    """Whether this process has a capability, by its number."""
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        effective = next(line.split()[1] for line in lines if line.startswith("CapEff"))
        return bool(int(effective, 16) >> capability & 1)
    return False
