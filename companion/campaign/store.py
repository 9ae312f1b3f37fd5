"""A campaign's folder: the study, one Parquet file per finished batch, and in the end one for all flights.

A part is written under another name and moved into place, so that what bears a part's name is whole: an interrupted
campaign goes on with the batches that are missing. A part that is not whole all the same (a disk that broke, a computer
that lost its power) is one of them.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.campaign.outcome import BINS, MEASURES, Outcome
from companion.campaign.study import Study, from_json
from companion.campaign.variables import NAMES
from companion.errors import InputError

STUDY_FILE: Final = "study.json"
FLIGHTS_FILE: Final = "flights.parquet"
SUMMARY_FILE: Final = "campaign.json"
REPORT_FILE: Final = "report.html"
PARTS: Final = "parts"
ROWS_TOGETHER: Final = 5000
"""Of the one file, so that its columns are read at once."""
BYTES_PER_FLIGHT: Final = 2 * (4 * BINS + 8 * (len(MEASURES) + 48))
"""Room that a flight's row needs, while its part and the whole both exist."""


def require_pyarrow() -> None:
    """Raise InputError when what writes Parquet is not installed."""
    if importlib.util.find_spec("pyarrow") is None:
        raise InputError("campaigns write Parquet, which needs pyarrow: pip install 'offboard-companion[campaign]'")


def schema(study: Study) -> Any:
    """The columns of a campaign's flights."""
    import pyarrow as pa

    values = [pa.field(name, pa.string() if name in NAMES else pa.float64()) for name in study.spreads]
    measures = [pa.field(name, pa.float64()) for name in MEASURES]
    return pa.schema(
        [
            pa.field("flight", pa.int64()),
            pa.field("seed", pa.int64()),
            *values,
            pa.field("ended", pa.string()),
            pa.field("reason", pa.string()),
            pa.field("converged", pa.bool_()),
            pa.field("certified", pa.bool_()),
            *measures,
            pa.field("error_m", pa.list_(pa.float32(), BINS)),
        ]
    )


def to_parquet(study: Study, outcomes: Sequence[Outcome]) -> bytes:
    """The outcomes as the contents of a part."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    errors = np.concatenate([o.error_m for o in outcomes])
    columns: list[Any] = [
        pa.array([o.number for o in outcomes], pa.int64()),
        pa.array([o.seed for o in outcomes], pa.int64()),
        *(pa.array([o.values[name] for o in outcomes]) for name in study.spreads),
        pa.array([o.ended for o in outcomes], pa.string()),
        pa.array([o.reason for o in outcomes], pa.string()),
        pa.array([o.converged for o in outcomes], pa.bool_()),
        pa.array([o.certified for o in outcomes], pa.bool_()),
        *(pa.array([o.measures[name] for o in outcomes], pa.float64()) for name in MEASURES),
        pa.FixedSizeListArray.from_arrays(pa.array(errors, pa.float32()), BINS),
    ]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(columns, schema=schema(study)), buffer, compression="zstd")
    return buffer.getvalue()


class Store:
    """The folder of one campaign.

    Args:
        folder: made when it is not there.
        study: what is flown in it.
        batch: flights per part.

    Raises:
        InputError: it holds another study, cannot be written, or the disk is too small.
    """

    def __init__(self, folder: Path, study: Study, batch: int) -> None:
        self.folder, self.study, self.batch = folder, study, batch
        whole = folder / STUDY_FILE
        try:
            known = json.loads(whole.read_text(encoding="utf-8")) if whole.exists() else None
        except (OSError, ValueError):
            raise InputError(f"{whole}: cannot be read; choose another folder with --out") from None
        if known is not None and (known.get("digest") != study.digest or known.get("batch") != batch):
            raise InputError(f"{folder}: holds another study; choose another folder with --out, or remove it")
        if known is None and folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty, and no campaign's folder; choose another with --out")
        self._drop_broken()
        self._check_room()
        try:
            if not self.complete:
                (folder / PARTS).mkdir(parents=True, exist_ok=True)
            if known is None:
                text = json.dumps({"digest": study.digest, "batch": batch, "whole": study.to_json()})
                _write(whole, text.encode())
        except OSError as error:
            raise InputError(f"{folder}: cannot be written: {error.strerror}; choose another with --out") from None

    def _drop_broken(self) -> None:
        """Removes the parts that do not hold their flights. Raises InputError."""
        if self.complete:
            return
        for path in list(self._parts()):
            try:
                first, after = self.flights_of(int(path.stem))
                if _rows(path) != after - first:
                    path.unlink()
            except OSError as error:
                raise InputError(f"{path}: cannot be removed: {error.strerror}; it is broken, remove it") from None

    def _check_room(self) -> None:
        existing = next(p for p in (self.folder.absolute(), *self.folder.absolute().parents) if p.exists())
        needed = (self.study.total - min(self.finished * self.batch, self.study.total)) * BYTES_PER_FLIGHT
        free = shutil.disk_usage(existing).free
        if needed > free:
            raise InputError(
                f"{self.study.source}: {self.study.total} flights need up to {needed / 1e9:.2f} GB, {existing} has"
                f" {free / 1e9:.2f} GB; lower count, or choose another disk with --out"
            )

    @property
    def batches(self) -> int:
        """Number of batches of the whole study."""
        return -(-self.study.total // self.batch)

    @property
    def complete(self) -> bool:
        """Whether all flights are in one file."""
        return (self.folder / FLIGHTS_FILE).exists()

    @property
    def finished(self) -> int:
        """Number of batches that are there."""
        return self.batches if self.complete else sum(1 for _ in self._parts())

    def missing(self) -> Iterator[int]:
        """Numbers of the batches that are still to be flown."""
        if not self.complete:
            there = {int(path.stem) for path in self._parts()}
            yield from (i for i in range(self.batches) if i not in there)

    def flights_of(self, batch: int) -> tuple[int, int]:
        """The first flight of a batch and the one after its last."""
        return batch * self.batch, min((batch + 1) * self.batch, self.study.total)

    def keep(self, batch: int, part: bytes) -> None:
        """Write a finished batch. Raises InputError."""
        path = self.folder / PARTS / f"{batch:08d}.parquet"
        try:
            _write(path, part)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}; make room and call again") from None

    def merge(self) -> Path:
        """All flights in one file, in the order of their numbers; the parts are removed. Raises InputError."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = self.folder / FLIGHTS_FILE
        if self.complete:
            return path
        unfinished = path.with_suffix(".part")
        try:
            with pq.ParquetWriter(unfinished, schema(self.study), compression="zstd") as writer:
                waiting: list[Any] = []
                for part in sorted(self._parts()):
                    waiting.append(pq.read_table(part, partitioning=None))
                    if sum(map(len, waiting)) >= ROWS_TOGETHER:
                        writer.write_table(pa.concat_tables(waiting).combine_chunks())
                        waiting.clear()
                if waiting:
                    writer.write_table(pa.concat_tables(waiting).combine_chunks())
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())  # before the parts go
            unfinished.replace(path)
            shutil.rmtree(self.folder / PARTS)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}; make room and call again") from None
        return path

    def _parts(self) -> Iterator[Path]:
        return (self.folder / PARTS).glob("*.parquet")


def open_folder(folder: Path) -> Study:
    """The study of a campaign's folder. Raises InputError."""
    path = folder / STUDY_FILE
    try:
        return from_json(json.loads(path.read_text(encoding="utf-8"))["whole"])
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{folder}: is not a campaign's folder (no {STUDY_FILE} in it that can be read)") from None


def read_flights(folder: Path, columns: Sequence[str] | None = None) -> Any:
    """The finished flights of a campaign as a pyarrow table, in the order of their numbers. Raises InputError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    whole = folder / FLIGHTS_FILE
    parts = [whole] if whole.exists() else sorted((folder / PARTS).glob("*.parquet"))
    if not parts:
        raise InputError(f"{folder}: holds no finished flights yet")
    chosen = None if columns is None else list(columns)
    try:
        return pa.concat_tables([pq.read_table(part, columns=chosen, partitioning=None) for part in parts])
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            f"{folder}: holds flights that cannot be read ({' '.join(str(error).split())[:160]}); `companion campaign`"
            f" flies those of broken parts again, a broken {FLIGHTS_FILE} must be removed first"
        ) from None


def _rows(part: Path) -> int:
    """Flights in a part; -1 where it cannot be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return int(pq.read_table(part, columns=["flight"], partitioning=None).num_rows)
    except (OSError, pa.ArrowException):
        return -1


def _write(path: Path, data: bytes) -> None:
    """Writes a file that is whole or not there, whenever the power goes."""
    unfinished = path.with_name(path.name + ".part")
    with unfinished.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
