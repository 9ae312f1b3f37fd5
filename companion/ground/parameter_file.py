"""Where changed parameters outlive the program: a file with the tables [controller] and [limits], as flight files have
them, holding only what differs from the vehicle file."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import tomlkit

from companion.config import Vehicle, read_toml
from companion.errors import InputError
from companion.ground.tuning import ENTRIES, Entry, Number, Tuning

_NAME: Final = ".parameters-{}.toml"
"""Hidden: the folder may be one that ground tools list and write files to, and this file is not theirs."""
_HEADER: Final = (
    " Parameters that were changed from the ground; they override the vehicle file.",
    " Without this file everything is as the vehicle file says. See docs/parameters.md.",
)


def file_for(folder: Path, vehicle: str) -> Path:
    """Where changes of this vehicle's parameters are kept; those of another vehicle are not its own."""
    return folder / _NAME.format(re.sub(r"[^A-Za-z0-9_-]+", "-", vehicle)[:60])


def load_tuning(path: Path, base: Vehicle) -> Tuning:
    """The vehicle with what the file changes of it; without a file, nothing.

    Raises:
        InputError: the file cannot be read, or holds something that is no parameter or no value of one.
    """
    tuning = Tuning(base)
    if not path.exists():
        return tuning
    hint = "mend it, or remove it to fly with the vehicle file's values"
    data = read_toml(path)
    try:
        for entry in ENTRIES:
            value = _taken(data, entry)
            if value is not None:
                tuning = tuning.changed(entry, value)
        for section, table in data.items():
            if not isinstance(table, Mapping):
                raise InputError(f"{section} is no table of parameters")
            for key in table:
                raise InputError(f"{section}.{key} is no parameter")
        _ = tuning.vehicle
    except InputError as error:
        raise InputError(f"{path}: {error}; {hint}") from None
    return tuning


def _taken(data: dict[str, Any], entry: Entry) -> Number | None:
    """The value of a parameter, which is taken out of the data with its last element; None when it is not there."""
    table = data.get(entry.section)
    if not isinstance(table, dict) or entry.key not in table:
        return None
    value = table[entry.key]
    if entry.element is not None:
        if not isinstance(value, list) or len(value) != 3:
            raise InputError(f"{entry.section}.{entry.key} = {value!r}: must be three numbers")
        value = value[entry.element]
    if entry.element in {None, 2}:  # the last of a list comes last
        del table[entry.key]
    if entry.words:
        if value not in entry.words:
            raise InputError(f"{entry.path} = {value!r}: must be one of {', '.join(entry.words)}")
        return entry.words.index(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{entry.path} = {value!r}: must be a number")
    try:
        return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        raise InputError(f"{entry.path} is not a number that can be used") from None


def save_tuning(path: Path, tuning: Tuning) -> None:
    """Writes the changes, all or nothing: what is on the disk is the old file or the new one.

    Raises:
        OSError: it cannot be written; then the old file is still there.
    """
    document = tomlkit.document()
    for line in _HEADER:
        document.add(tomlkit.comment(line.strip()))
    for section, table in tuning.overrides.items():
        if table:
            document[section] = {key: list(x) if isinstance(x, tuple) else x for key, x in table.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("w", encoding="utf-8") as file:
            file.write(tomlkit.dumps(document))
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
