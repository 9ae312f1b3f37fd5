"""Where batches are flown: in this process, in processes of this machine, or on a Dask cluster.

All of them call `worker.fly_batch` and give what it returns, as it is done; none loses a batch when a worker dies.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any, Final, NamedTuple, Protocol

from companion.campaign import worker
from companion.campaign.worker import Batch
from companion.errors import InputError, LinkError

AHEAD: Final = 3
"""Batches that wait per worker: memory does not grow with the study."""
DEATHS_MAX: Final = 3
"""So often a pool may break without a batch done in between."""
CONNECT_TIMEOUT_S: Final = 5.0


class Task(NamedTuple):
    """One batch to be flown."""

    batch: int
    study_json: str
    first: int
    after: int
    engine: str

    def arguments(self) -> tuple[str, int, int, str]:
        """For `worker.fly_batch`."""
        return self.study_json, self.first, self.after, self.engine


class Fleet(Protocol):
    """What flies batches; a context manager."""

    name: str

    def run(self, tasks: Iterator[Task]) -> Iterator[tuple[Task, Batch]]:
        """The batches as they are done, in any order."""
        ...

    def close(self) -> None:
        """End the workers."""
        ...


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Here:
    """In this process, one after the other."""

    name = "this process"

    def run(self, tasks: Iterator[Task]) -> Iterator[tuple[Task, Batch]]:
        """Fly the batches (see Fleet)."""
        for task in tasks:
            yield task, worker.fly_batch(*task.arguments())

    def close(self) -> None:
        """Nothing is open."""


class Processes:
    """In processes of this machine.

    Args:
        count: of processes; None: one per core.
    """

    def __init__(self, count: int | None = None) -> None:
        self.count = count or cores()
        self.name = f"{self.count} process{'es' if self.count != 1 else ''}"
        self.deaths = 0
        """Times that a worker died so far."""
        self._pool: ProcessPoolExecutor | None = None

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers that live."""
        return [*(getattr(self._pool, "_processes", None) or {})]

    def run(self, tasks: Iterator[Task]) -> Iterator[tuple[Task, Batch]]:
        """Fly the batches (see Fleet).

        Raises:
            LinkError: workers die again and again.
        """
        running: dict[Future[Batch], Task] = {}
        again: list[Task] = []
        in_a_row = 0
        while True:
            wanted = AHEAD * self.count - len(running)
            new = [again.pop(0) for _ in range(min(wanted, len(again)))]
            new += islice(tasks, max(0, wanted - len(new)))
            broken = False
            for index, task in enumerate(new):
                try:
                    running[self._alive().submit(worker.fly_batch, *task.arguments())] = task
                except BrokenProcessPool:
                    again += new[index:]
                    broken = True
                    break
            if not running and not again:
                return
            done, _ = wait(running, timeout=0.0 if broken else None, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    batch = future.result()
                except BrokenProcessPool:
                    again.append(task)
                    broken = True
                else:
                    in_a_row = 0
                    yield task, batch
            if broken:  # all that was under way is lost with it
                again += running.values()
                running.clear()
                self.deaths += 1
                in_a_row += 1
                self._end()
                if in_a_row > DEATHS_MAX:
                    raise LinkError(
                        f"workers died {in_a_row} times without finishing a batch (out of memory?); what is finished"
                        " is kept: use fewer with --workers and call again"
                    )

    def _alive(self) -> ProcessPoolExecutor:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.count, mp_context=context, initializer=worker.begin)
        return self._pool

    def _end(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)

    def close(self) -> None:
        """End the workers, each after the batch that it flies."""
        self._end()


def check_scheduler(where: str) -> None:
    """Raises InputError when this names no scheduler; nothing is asked of it."""
    if where != "local" and "://" not in where:
        raise InputError(f'--scheduler {where!r}: must be "local" or an address such as tcp://127.0.0.1:8786')


class Dask:
    """On a Dask cluster.

    Args:
        where: "local" starts one on this machine, "tcp://HOST:PORT" is one that runs.
        count: workers of a local one; None: one per core.

    Raises:
        InputError: Dask is not installed, or the address makes no sense.
        LinkError: the scheduler cannot be reached, has no workers, or they have another version of this program.
    """

    def __init__(self, where: str, count: int | None = None) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError:
            raise InputError("--scheduler needs dask.distributed: pip install 'offboard-companion[campaign]'") from None
        check_scheduler(where)
        self._cluster: Any = None
        address = where
        if where == "local":
            self._cluster = distributed.LocalCluster(
                n_workers=count or cores(), threads_per_worker=1, processes=True, dashboard_address=None,
                host="127.0.0.1", silence_logs=50,
            )  # fmt: skip
            address = self._cluster.scheduler_address
        try:
            self._client: Any = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise LinkError(
                f"--scheduler {where}: no Dask scheduler answers there within {CONNECT_TIMEOUT_S:g} s"
                f" ({' '.join(str(error).split())[:120]}); is it running?"
            ) from None
        try:
            self._check(where)
        except BaseException:
            self.close()
            raise
        self.name = f"a Dask cluster of {self.count} workers"

    def _check(self, where: str) -> None:
        threads = self._client.nthreads()
        self.count = sum(threads.values())
        if not threads:
            raise LinkError(f"--scheduler {where}: the cluster has no workers; start some with `dask worker`")
        try:
            found = self._client.run(worker.identity)
        except Exception as error:
            raise LinkError(
                f"--scheduler {where}: a worker cannot run this program ({' '.join(str(error).split())[:120]});"
                " install offboard-companion[campaign] there"
            ) from None
        ours = worker.identity()
        for address, theirs in found.items():
            if theirs != ours:
                raise LinkError(
                    f"--scheduler {where}: worker {address} has another version of this program ({theirs[0]},"
                    f" {theirs[1]}) than this machine ({ours[0]}, {ours[1]}); install the same"
                )

    def run(self, tasks: Iterator[Task]) -> Iterator[tuple[Task, Batch]]:
        """Fly the batches (see Fleet).

        Raises:
            LinkError: the cluster is lost.
        """
        distributed: Any = importlib.import_module("distributed")
        running: dict[Any, Task] = {}
        deaths = 0
        try:
            while True:
                for task in islice(tasks, max(0, AHEAD * self.count - len(running))):
                    running[self._submit(task)] = task
                if not running:
                    return
                with self._client.as_current():
                    done = distributed.wait(list(running), return_when="FIRST_COMPLETED").done
                for future in done:
                    task = running.pop(future)
                    try:
                        batch = future.result()
                    except distributed.KilledWorker:  # several workers died with it: once more, by itself
                        deaths += 1
                        if deaths > DEATHS_MAX:
                            raise
                        running[self._submit(task)] = task
                    else:
                        deaths = 0
                        yield task, Batch(*batch)
        except (OSError, distributed.comm.CommClosedError, distributed.KilledWorker, TimeoutError) as error:
            raise LinkError(
                f"the Dask cluster was lost ({' '.join(str(error).split())[:120]}); what is finished is kept: call"
                " again"
            ) from None

    def _submit(self, task: Task) -> Any:
        return self._client.submit(worker.fly_batch, *task.arguments(), pure=False, retries=2)

    def close(self) -> None:
        """Leave the cluster; a local one ends."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()
