"""Runs a campaign: the batches that are missing, flown by a fleet, kept as they come, merged at the end."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.campaign.engines import Fleet, Task
from companion.campaign.store import SUMMARY_FILE, Store
from companion.campaign.study import Study
from companion.campaign.summary import summarise

BATCH: Final = 25
"""Flights per part of a large study: a second of work or so."""
BATCHES_WANTED: Final = 40
"""Smaller studies are divided into so many, for the progress and the cores."""


class Progress(NamedTuple):
    """How far a campaign is."""

    done: int
    """Flights."""
    total: int


@dataclass(frozen=True)
class Ran:
    """A campaign that is complete."""

    folder: Path
    summary: dict[str, Any]
    flown: int
    """Flights of this call."""
    wall_s: float
    memory_mb: float
    """The most that a worker took; 0 where nothing was flown."""


def batch_size(total: int) -> int:
    """Flights per batch: a function of the study alone, so that every engine makes the same parts."""
    return max(1, min(BATCH, total // BATCHES_WANTED))


def run(
    study: Study,
    folder: Path,
    fleet: Callable[[], Fleet],
    engine: str,
    progress: Callable[[Progress], None] = lambda done: None,
) -> Ran:
    """Fly what is missing of a study.

    Args:
        study: what to fly.
        folder: its folder; what is finished in it is kept.
        fleet: makes what flies; not called when nothing is missing.
        engine: "python" or "numba", as resolved.
        progress: called with every batch.

    Raises:
        InputError: the folder cannot be used.
        LinkError: the workers cannot be reached, or die again and again.
    """
    store = Store(folder, study, batch_size(study.total))
    text = study.to_json()
    done = study.total - sum(b - a for a, b in map(store.flights_of, store.missing()))
    before, began = done, time.monotonic()
    progress(Progress(done, study.total))
    memory_mb = 0.0
    if done < study.total:
        tasks = (Task(i, text, *store.flights_of(i), engine) for i in list(store.missing()))
        crew = fleet()
        try:
            for task, batch in crew.run(tasks):
                store.keep(task.batch, batch.part)
                memory_mb = max(memory_mb, batch.memory_mb)
                done += task.after - task.first
                progress(Progress(done, study.total))
        finally:
            crew.close()
    wall_s = time.monotonic() - began
    store.merge()
    summary = summarise(study, folder)
    (folder / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return Ran(folder, summary, done - before, wall_s, memory_mb)
