"""Fault files: TOML with one table [[fault]] per fault, checked as a whole before anything flies."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .fault_keys import FaultError
from .fault_kinds import Fault, check_together, from_table
from .parameter_set import READ_ONLY
from .parameters import ParameterError, Parameters
from .vehicle_file import bundled_folder

_TOP_KEYS = ("description", "fault")


def find(name_or_path: str) -> Path:
    """Return the file for a path or for the name of a bundled fault file. Raises FaultError without either."""
    path = Path(name_or_path)
    try:
        if path.is_file():
            return path
    except (OSError, ValueError):
        raise FaultError("", f"{name_or_path!r}: not a usable path") from None
    folder = bundled_folder().parent / "faults"
    bundled = folder / f"{name_or_path}.toml"
    if path.name == name_or_path and bundled.is_file():
        return bundled
    names = ", ".join(sorted(p.stem for p in folder.glob("*.toml"))) or "none"
    raise FaultError("", f"{name_or_path}: no such fault file, and not one of the bundled ones ({names})")


def load(name_or_path: str, *px4: str) -> tuple[Fault, ...]:
    """Read and check a fault file: a path first, then a bundled name such as "windy_link".

    `px4`: it must be right for one of these versions at least; without any, parameters are not looked at.

    Raises:
        FaultError: there is none, or it cannot be; with the path of the key.
    """
    path = find(name_or_path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise FaultError("", f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise FaultError("", f"{path}: not valid TOML: {error}") from error
    faults = parse(document, str(path))
    refused: FaultError | None = None
    for version in px4:
        try:
            check_parameters(faults, version)
        except FaultError as error:
            refused = refused or FaultError(f"{path}: {error.key}", error.sentence)
        else:
            return faults
    if refused is not None:
        raise refused
    return faults


def parse(document: Mapping[str, Any], path: str) -> tuple[Fault, ...]:
    """Check a fault file's content; `path` is for messages. Raises FaultError with the path of the key."""
    for key in document:
        if key not in _TOP_KEYS:
            raise FaultError(f"{path}: {key}", f"unknown; allowed are {', '.join(_TOP_KEYS)}")
    if not isinstance(document.get("description", ""), str):
        raise FaultError(f"{path}: description", f" = {document['description']!r}: must be a text")
    tables = document.get("fault")
    if not isinstance(tables, list) or not tables:
        raise FaultError(f"{path}: fault", "missing; a fault file holds one table [[fault]] per fault")
    faults = []
    for index, table in enumerate(tables):
        try:
            faults.append(from_table(table))
        except FaultError as error:
            raise error.inside(f"{path}: fault[{index}]") from None
    try:
        check_together(faults)
    except FaultError as error:
        raise FaultError(f"{path}: {error.key}", error.sentence) from None
    return tuple(faults)


def check_parameters(faults: Sequence[Fault], px4: str) -> None:
    """Raise FaultError when a fault changes a parameter that the autopilot of this version does not have."""
    trial = Parameters(px4)
    for index, item in enumerate(faults):
        if item.kind != "parameter":
            continue
        name = item["name"]
        if name in READ_ONLY:
            raise FaultError(f"fault[{index}].name", f" = {name!r}: is fixed by the vehicle file")
        try:
            trial.set(name, item["value"])
        except ParameterError as error:
            key = "name" if error.code == ParameterError.DOES_NOT_EXIST else "value"
            raise FaultError(f"fault[{index}].{key}", f" = {item[key]!r}: {error} (PX4 {px4})") from None
