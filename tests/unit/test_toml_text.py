"""TOML text: any string comes back, the layout is tomlkit's, and long strings do not pass through its escaping."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import tomlkit
import tomlkit.items
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.record.folder import write_configuration
from companion.toml_text import toml_text
from companion.trajectory.portable import Portable

CONTROLS = "".join(map(chr, range(0x20))) + '\x7f\x80\x9f\x85\u2028\u2029\ufeff"\\/\\u0041'
STRINGS = st.text(st.characters(exclude_categories=["Cs"]))
SHORT_MAX = 100
"""Longest string that may still be escaped by tomlkit [characters]."""


@settings(max_examples=500)
@given(STRINGS, st.text("\x00\x08\t\n\x0c\r\x1b\x1f\x7f\"\\'#ué", max_size=40))
@example(CONTROLS, CONTROLS)
def test_any_string_comes_back(text: str, controls: str) -> None:
    table = {"text": text, "controls": controls, "inner": {"text": controls}, "list": [text, [controls, {"a": text}]]}
    written = toml_text(table)
    assert tomllib.loads(written) == table
    assert tomllib.loads(written.encode().decode()) == table


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "config").glob("*/*.toml")), ids=lambda p: p.name)
def test_the_layout_is_that_of_tomlkit(path: Path) -> None:
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    assert toml_text(table) == tomlkit.dumps(table)


def test_the_layout_of_what_the_bundled_files_do_not_have() -> None:
    table: dict[str, Any] = {
        "name with spaces": CONTROLS,
        "tables": [{"a": "x", "inner": {"b": "y"}, "c": "z"}, {}],
        "mixed": [1, "a", {"b": "c"}],
        "empty": {},
        "when": datetime(2026, 1, 2, tzinfo=UTC),
        "after": "x",
    }
    assert toml_text(table) == tomlkit.dumps(table)


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> str:
    """A long text; its escaping by tomlkit, whose time grows with the square of the length, is a failure."""
    escape = tomlkit.items.escape_string

    def only_short(text: str, *arguments: Any) -> str:
        assert len(text) <= SHORT_MAX, f"{len(text)} characters are escaped by tomlkit"
        return escape(text, *arguments)

    monkeypatch.setattr(tomlkit.items, "escape_string", only_short)
    with pytest.raises(AssertionError):
        tomlkit.dumps({"text": "x" * (SHORT_MAX + 1)})
    return "".join(f"{0.1 * i:.3f},0.0,5.0\n" for i in range(500))


def test_a_long_text_goes_into_the_file_for_the_vehicle(tmp_path: Path, lines: str) -> None:
    (tmp_path / "lap.csv").write_text(lines)
    content = Portable(str(tmp_path / "lap.csv"), frame="enu", laps=2).content
    assert tomllib.loads(content.decode())["text"] == lines


def test_a_long_text_goes_into_the_configuration_of_a_flight(tmp_path: Path, lines: str) -> None:
    table = {"name": "x", "trajectory": {"text": lines, "frame": "enu"}}
    assert tomllib.loads(write_configuration(tmp_path, table).read_text(encoding="utf-8")) == table
