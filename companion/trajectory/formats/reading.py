"""Bounded reading of text files and tables: whatever a file holds, it ends in numbers or in a line that says why not.

Nothing here trusts a file: its size, its encoding, its columns and its numbers are checked, and what a message quotes
of it is cut short.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from companion.errors import InputError

FILE_MAX_BYTES = 32 * 2**20
"""Longest file that is read."""

ROWS_MAX = 100_000
"""Most rows of a table: a quarter of an hour at 100 Hz."""

LINE_MAX = 20_000
"""Longest line of a table [characters]."""

SHOWN_MAX = 40
"""As much of a file's own text as a message repeats."""

POSITION_MAX_M = 100e3
SPEED_MAX_M_S = 150.0
"""More than any multirotor flies: what is beyond is taken for another unit."""
ACCELERATION_MAX_M_S2 = 1000.0
DURATION_MAX_S = 6.0 * 3600.0


class Source(NamedTuple):
    """The text of a file and what to call it in messages."""

    name: str
    text: str

    def fault(self, line: int | None, reason: str) -> InputError:
        """The error that says where and why; without a line it concerns the file as a whole."""
        return InputError(f"{self.name}: {reason}" if line is None else f"{self.name}: line {line}: {reason}")


class Row(NamedTuple):
    """A row of a table."""

    line: int
    """Counted from 1, as editors do."""
    values: tuple[float, ...]


def read_source(path: Path, name: str | None = None) -> Source:
    """Return the text of a file.

    Args:
        path: a regular file.
        name: what to call it in messages; its path when absent.

    Raises:
        InputError: it cannot be read, is no regular file, too long, empty or not text.

    """
    return decoded(read_bytes(path, name), shown(str(path)) if name is None else name)


def read_bytes(path: Path, name: str | None = None) -> bytes:
    """Return the bytes of a regular file of at most `FILE_MAX_BYTES`. Raises InputError otherwise."""
    called = shown(str(path)) if name is None else name
    try:
        # Opened before it is looked at, so that both mean the same file; a pipe that nobody writes to must not block.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise InputError(f"{called}: not a regular file")
            data = file.read(FILE_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{called}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{called}: not a usable path") from None
    if len(data) > FILE_MAX_BYTES:
        raise InputError(f"{called}: longer than {FILE_MAX_BYTES // 2**20} MB, which is the most that is read")
    return data


def decoded(data: bytes, name: str) -> Source:
    """Return the bytes of a file as text. Raises InputError when it is empty or not UTF-8 text."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{name}: is UTF-16 text; save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(f"{name}: line {line}: not a text file (UTF-8 expected), byte {error.start}") from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{name}: line {line}: not a text file (it holds a zero byte)")
    if not text.strip():
        raise InputError(f"{name}: is empty")
    return Source(name, text)


def shown(text: str) -> str:
    """Return a name or a text of a file as messages may repeat it: printable, in one line, without half characters."""
    return "".join(c if c.isprintable() else "?" for c in text)


def quoted(text: str) -> str:
    """Return the beginning of a text of a file in quotes."""
    cut = text if len(text) <= SHOWN_MAX else text[:SHOWN_MAX] + "..."
    return repr(shown(cut))


def lines_of(source: Source) -> Iterator[tuple[int, str]]:
    """Yield the lines that say something, with their numbers: neither blank nor a comment (#)."""
    for number, line in enumerate(source.text.split("\n"), start=1):
        stripped = line.strip()
        if not stripped or stripped.startswith("#"):
            continue
        if len(stripped) > LINE_MAX:
            raise source.fault(number, f"{len(stripped)} characters long, at most {LINE_MAX} are read")
        yield number, stripped


def first_line(source: Source) -> tuple[int, str]:
    """Return the first line that says something with its number, as far as `LINE_MAX`; (1, "") when there is none."""
    for number, line in enumerate(source.text[: 4 * LINE_MAX].split("\n"), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            return number, stripped[:LINE_MAX]
    return 1, ""


def cells_of(line: str, separator: str | None = ",") -> list[str]:
    """Return the cells of a line; one empty cell at its end, after a trailing comma, is none."""
    cells = [cell.strip() for cell in line.split(separator)]
    return cells[:-1] if separator is not None and len(cells) > 1 and not cells[-1] else cells


class Header(NamedTuple):
    """The first line of a table."""

    line: int
    names: tuple[str, ...]
    """In lower case, single-spaced."""


def header_of(source: Source) -> Header:
    """Return the first line of a file as the names of columns."""
    line, text = first_line(source)
    return Header(line, tuple(" ".join(cell.lower().split()) for cell in cells_of(text)))


def table(source: Source, columns: Sequence[str], *, header: bool = True) -> list[Row]:
    """Return the rows of a table of finite numbers, separated by commas.

    Args:
        source: the file.
        columns: the name of every column, for messages; each row must have as many.
        header: whether the first line is one, and not a row.

    Raises:
        InputError: a row has another number of columns, something is not a finite number, or there are too many rows
            or none.

    """
    lines = lines_of(source)
    if header:
        next(lines, None)
    rows: list[Row] = []
    for at, line in lines:
        if len(rows) >= ROWS_MAX:
            raise source.fault(at, f"more than {ROWS_MAX} rows, which are the most that are read")
        rows.append(Row(at, _values(source, at, cells_of(line), columns)))
    if not rows:
        raise source.fault(None, "has no rows")
    return rows


def _values(source: Source, line: int, cells: Sequence[str], columns: Sequence[str]) -> tuple[float, ...]:
    if len(cells) != len(columns):
        raise source.fault(
            line,
            f"{len(cells)} columns, {len(columns)} are expected ({columns[0]} to {columns[-1]}); is the file cut off,"
            " or of another format?",
        )
    return tuple(number(source, line, cell, name) for cell, name in zip(cells, columns, strict=True))


def number(source: Source, line: int | None, cell: str, name: str) -> float:
    """Return a cell as a finite number; `name` is the column's. Raises InputError."""
    try:
        # float() also takes underscores and the digits of other scripts; no file has them on purpose.
        value = float(cell) if cell.isascii() and "_" not in cell else None
    except ValueError:
        value = None
    if value is None:
        raise source.fault(line, f"{name} is {quoted(cell)}, not a number")
    if not isfinite(value):
        raise source.fault(line, f"{name} is {quoted(cell)}; it must be finite")
    return value


def within(source: Source, line: int, value: float, limit: float, name: str, unit: str) -> float:
    """Return a value that is not larger than a limit. Raises InputError, which takes it for another unit."""
    if not abs(value) <= limit:
        raise source.fault(
            line, f"{name} is {value:.6g} {unit}, more than {limit:g} {unit} is not believed; is it in another unit?"
        )
    return value
