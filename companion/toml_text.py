"""Tables as TOML text, in a time that grows with their size and no faster."""

from __future__ import annotations

import json
from collections.abc import Mapping

import tomlkit


def toml_text(table: Mapping[str, object]) -> str:
    """Return a table as TOML, laid out as `tomlkit.dumps` does it.

    Args:
        table: of what TOML can hold; its strings without halves of surrogate pairs.
    """
    return tomlkit.dumps({key: _escaped(value) for key, value in table.items()})


def _escaped(value: object) -> object:
    """The value with every string in it as an item that is written as it stands.

    tomlkit's own escaping copies the rest of a string at each of its characters: a trajectory file of 2 MB takes it a
    minute. JSON's differs in one character: it leaves DEL as it is, which TOML does not allow.
    """
    if isinstance(value, str):
        written = json.dumps(value, ensure_ascii=False)[1:-1].replace("\x7f", "\\u007f")
        return tomlkit.string(written, escape=False)
    if isinstance(value, Mapping):
        return {key: _escaped(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_escaped(entry) for entry in value]
    return value
