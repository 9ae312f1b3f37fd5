"""The record of a flight: a preallocated table with one row per control step.

The control loop writes it, so that writing costs about a microsecond, never takes memory that stays, and cannot
end a flight: rows beyond the capacity are counted and left out.
"""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from companion.errors import InputError
from companion.record.columns import COLUMN_INDEX, COLUMNS, DEFAULT_PHASE_NAMES

Array = npt.NDArray[np.float64]

RECORD_FILE: Final = "record.npz"
"""Name of the record in a flight's folder."""

_ROW = struct.Struct(f"={len(COLUMNS)}d")
_FORMAT = 1


class FlightRecord:
    """A table of float64 with the columns of `columns.COLUMNS`.

    A row of 63 numbers takes 504 bytes: ten minutes at 250 Hz need 76 MB. Reserve on the ground what the flight may
    take.
    """

    def __init__(self, capacity: int, phase_names: Sequence[str] = DEFAULT_PHASE_NAMES) -> None:
        """Allocate and touch all memory at once, so that no page fault waits in the air.

        Args:
            capacity: rows that fit, >= 0.
            phase_names: what the numbers in the column `phase` stand for.
        """
        self.phase_names: tuple[str, ...] = tuple(phase_names)
        self.overflow: int = 0
        """Rows that found no place."""
        self.sink: Callable[[bytes], object] | None = None
        """Called with the bytes of every row, also of one that finds no place; must not block."""
        self._length = 0
        self._allocate(capacity)

    def _allocate(self, capacity: int) -> None:
        table = np.full((capacity, len(COLUMNS)), np.nan)
        if self._length:
            table[: self._length] = self._table[: self._length]
        self._table: Array = table
        # A cast of an empty buffer is not allowed; nothing is ever written to it.
        self._bytes = table.data.cast("B") if capacity else memoryview(bytearray())
        self._capacity = capacity

    def append(self, row: tuple[float, ...]) -> None:
        """Write one row: as many numbers as there are columns, in their order.

        A full record only counts (`overflow`). A row of another length or with something else than numbers is a fault
        of the program and raises struct.error.
        """
        self.append_packed(_ROW.pack(*row))

    def append_packed(self, content: bytes) -> None:
        """Write one row that is packed already: a float64 per column, in the machine's own byte order."""
        length = self._length
        if length < self._capacity:
            at = length * _ROW.size
            self._bytes[at : at + _ROW.size] = content
            self._length = length + 1
        else:
            self.overflow += 1
        if self.sink is not None:
            self.sink(content)

    def reserve(self, rows: int) -> None:
        """Make room for `rows` more rows than there are now. Allocates and copies: on the ground only."""
        wanted = self._length + rows
        if wanted > self._capacity:
            self._allocate(wanted)

    def __len__(self) -> int:
        return self._length

    @property
    def capacity(self) -> int:
        """Rows that fit."""
        return self._capacity

    @property
    def rows(self) -> Array:
        """The rows written so far, shape (len, columns): a view that later rows do not extend."""
        return self._table[: self._length]

    def column(self, name: str) -> Array:
        """One column, shape (len,): a view. Raises KeyError for a name that is not a column."""
        return self._table[: self._length, COLUMN_INDEX[name]]

    def columns(self, *names: str) -> Array:
        """Several columns side by side, shape (len, names): a copy."""
        return self._table[: self._length, [COLUMN_INDEX[name] for name in names]]

    def as_dict(self) -> dict[str, Array]:
        """All columns by name."""
        return {name: self.column(name) for name in COLUMNS}

    def in_phase(self, name: str) -> npt.NDArray[np.bool_]:
        """Which rows belong to the phase of this name, shape (len,); none when the flight knows no such phase."""
        if name not in self.phase_names:
            return np.zeros(self._length, dtype=np.bool_)
        return np.asarray(self.column("phase") == self.phase_names.index(name))

    def select(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> FlightRecord:
        """A new record of some of the rows: a mask of shape (len,), or their indices. It has no room for more."""
        return self._of_rows(self.rows[rows], self.phase_names)

    @classmethod
    def _of_rows(cls, rows: Array, phase_names: Sequence[str]) -> FlightRecord:
        record = cls(len(rows), phase_names)
        record._table[:] = rows
        record._length = len(rows)
        return record

    def save(self, folder: Path) -> Path:
        """Write `record.npz` into the flight's folder, whole or not at all, and return its path."""
        path = folder / RECORD_FILE
        unfinished = folder / f".{RECORD_FILE}.part"
        with unfinished.open("wb") as file:
            np.savez_compressed(
                file,
                format=np.int64(_FORMAT),
                columns=np.array(COLUMNS),
                phase_names=np.array(self.phase_names, dtype=np.str_),
                overflow=np.int64(self.overflow),
                rows=self.rows,
            )
        os.replace(unfinished, path)
        return path

    @classmethod
    def load(cls, path: Path) -> FlightRecord:
        """Read a record: the file itself, or the flight's folder that holds it.

        Raises:
            InputError: no such file, or not a record that this version can read.
        """
        path = path / RECORD_FILE if path.is_dir() else path
        try:
            with np.load(path, allow_pickle=False) as file:
                parts = {name: file[name] for name in ("format", "columns", "phase_names", "overflow", "rows")}
        except FileNotFoundError:
            raise InputError(f"{path}: there is no flight record; give the folder of a flight") from None
        except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
            raise InputError(
                f"{path}: not a flight record; it may be cut off, fly again or take another folder"
            ) from None
        if int(parts["format"]) != _FORMAT or tuple(str(name) for name in parts["columns"]) != COLUMNS:
            raise InputError(f"{path}: written by another version of the program; read it with that version")
        record = cls._of_rows(parts["rows"], [str(name) for name in parts["phase_names"]])
        record.overflow = int(parts["overflow"])
        return record
