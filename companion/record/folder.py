"""The folder that a flight leaves behind, and the small files in it."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from companion.errors import InputError
from companion.toml_text import toml_text

FLIGHTS_FOLDER: Final = Path("flights")
"""Where flights go unless told otherwise, relative to the folder from which the command is called."""

SUMMARY_FILE: Final = "summary.json"
CONFIGURATION_FILE: Final = "flight.toml"

_SUFFIX_MAX: Final = 1000
_NAME_MAX: Final = 60


def create_flight_folder(name: str, out: Path | None = None, started: datetime | None = None) -> Path:
    """Make a new, empty folder for a flight and make sure that it can be written to. Do this before anything connects.

    Nothing that exists is ever overwritten: when the name is taken, the next free one of `<folder>-2`, `<folder>-3`,
    ... is used. An empty folder that the user names is used as it is.

    Args:
        name: the flight's name; characters that file systems dislike become "-".
        out: the folder itself, as given by the user; by default ./flights/<UTC>-<name>.
        started: the time for the default name; now when absent.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    if out is None:
        stamp = (started or datetime.now(UTC)).astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
        wanted = FLIGHTS_FOLDER / f"{stamp}-{_file_name(name)}"
    else:
        wanted = out.expanduser()
    try:
        folder = _make_free(wanted, take_empty=out is not None)
        _probe(folder)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{wanted}: cannot write the flight's folder ({reason}); choose another with --out") from None
    return folder


def _file_name(name: str) -> str:
    """A name that every file system takes."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")[:_NAME_MAX] or "flight"


def _make_free(wanted: Path, take_empty: bool) -> Path:
    """Create the folder or the first free one with a number; take an empty one only on request: it may be another's."""
    wanted.parent.mkdir(parents=True, exist_ok=True)
    for number in range(1, _SUFFIX_MAX):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if number == 1 and take_empty and folder.is_dir() and not any(folder.iterdir()):
            return folder
        with contextlib.suppress(FileExistsError):  # a file of that name is left alone like a folder
            folder.mkdir()
            return folder
    raise OSError(f"{_SUFFIX_MAX} folders of this name exist")


def _probe(folder: Path) -> None:
    """Write something and take it away again."""
    probe = folder / ".writable"
    probe.write_bytes(b"flight\n")
    probe.unlink()


def write_summary(folder: Path, summary: Mapping[str, object]) -> Path:
    """Write `summary.json`, whole or not at all. Raises ValueError for NaN or infinity, which JSON does not have."""
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return write_whole(folder / SUMMARY_FILE, text)


def read_summary(folder: Path) -> dict[str, Any]:
    """Read `summary.json`. Raises InputError when the folder has none that can be read."""
    path = folder / SUMMARY_FILE
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the folder of a flight") from None
    except ValueError as error:
        raise InputError(f"{path}: not a summary ({error}); give the folder of a flight") from None
    if not isinstance(summary, dict):
        raise InputError(f"{path}: not a summary (no object at the top); give the folder of a flight")
    return summary


def write_configuration(folder: Path, configuration: Mapping[str, object]) -> Path:
    """Write `flight.toml`: all configuration as it was used. TOML knows no None: such entries are left out."""
    return write_whole(folder / CONFIGURATION_FILE, toml_text(_without_none(configuration)))


def _without_none(table: Mapping[str, object]) -> dict[str, object]:
    return {str(key): _toml_value(value) for key, value in table.items() if value is not None}


def _toml_value(value: object) -> object:
    """The value with everything in it that TOML can hold: paths as text, tuples as arrays, tables without None."""
    if isinstance(value, Mapping):
        return _without_none(value)
    if isinstance(value, list | tuple):
        return [_toml_value(item) for item in value if item is not None]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value


def write_whole(path: Path, text: str) -> Path:
    """Write beside the file and move it there, so that nobody ever reads half of it."""
    unfinished = path.with_name(f".{path.name}.part")
    try:
        unfinished.write_text(text, encoding="utf-8")
        os.replace(unfinished, path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    return path
