"""On which core a vehicle runs that is in lockstep with a companion on the same machine."""

from __future__ import annotations

import contextlib
import os


def take_core_of_two(companion_port: int) -> None:
    """Keep the calling thread off its companion's core, on a machine with two.

    Two programs that wait for each other are never busy at the same time for long. A scheduler likes to put them on one
    core, where each wake of the one stops the other; with more cores it finds idle ones. The companion does the same
    with the other core. Which one is whose goes by the port between them, so that several pairs are spread.

    Args:
        companion_port: the companion's UDP port.
    """
    with contextlib.suppress(OSError, AttributeError):  # not permitted; not Linux
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) == 2:
            os.sched_setaffinity(0, {cores[1 - companion_port % 2]})
