"""What a worker does: fly one batch of a study. The same function for every engine that runs it."""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import time
from typing import NamedTuple

PARENT_CHECK_S = 1.0


class Batch(NamedTuple):
    """A finished batch."""

    part: bytes
    """The contents of its Parquet file."""
    memory_mb: float
    """The most that the worker has taken so far."""


def fly_batch(study_json: str, first: int, after: int, engine: str) -> Batch:
    """Fly the flights `first` to `after` - 1 of a study."""
    from companion.campaign.outcome import fly_number
    from companion.campaign.store import to_parquet
    from companion.campaign.study import from_json

    study = from_json(study_json)
    part = to_parquet(study, [fly_number(study, number, engine) for number in range(first, after)])
    unit = 1024.0 if sys.platform != "darwin" else 1024.0 * 1024.0
    return Batch(part, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def begin() -> None:
    """Prepare a worker process: the operator's Ctrl-C is for the parent, and without the parent there is no work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def identity() -> tuple[str, str]:
    """What must be equal on all workers: the program's version and its sources."""
    import hashlib
    from pathlib import Path

    import companion
    from sim_link import vehicle_file

    digest = hashlib.sha256()
    for member in (companion, vehicle_file):
        root = Path(str(member.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return companion.__version__, digest.hexdigest()[:16]
