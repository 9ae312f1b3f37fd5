"""`tools/audit.py` says what it found, and says so when it could not look."""

from __future__ import annotations

import json
import subprocess

import audit
import pytest

FOUND = {"id": "PYSEC-2026-1", "fix_versions": ["1.2", "2.0"], "aliases": [], "description": ""}


def answering(monkeypatch: pytest.MonkeyPatch, out: str, err: str = "") -> None:
    done = subprocess.CompletedProcess([], 1, out, err)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: done)


def test_nothing_known(monkeypatch, capsys):
    answering(monkeypatch, json.dumps({"dependencies": [{"name": "a", "version": "1", "vulns": []}], "fixes": []}))
    assert audit.main() == 0
    assert "1 pinned packages, 0 known" in capsys.readouterr().out


def test_something_known_and_something_not_looked_at(monkeypatch, capsys):
    packages = [{"name": "a", "version": "1", "vulns": [FOUND]}, {"name": "b", "skip_reason": "not found"}]
    answering(monkeypatch, json.dumps({"dependencies": packages}))
    assert audit.main() == 1
    told = capsys.readouterr().out
    assert "a 1: PYSEC-2026-1, fixed in 1.2, 2.0" in told
    assert "not checked: b: not found" in told


@pytest.mark.parametrize("out", ["", "[]", "{}", "null"])
def test_without_a_source_it_does_not_look_like_a_success(monkeypatch, capsys, out):
    answering(monkeypatch, out, "Traceback\nConnectionError: no route to host")
    assert audit.main() == 4
    told = capsys.readouterr().err
    assert "NOTHING was checked" in told
    assert "no route to host" in told


def test_a_source_that_does_not_answer(monkeypatch, capsys):
    def late(*_, **__):
        raise subprocess.TimeoutExpired("pip_audit", 1.0)

    monkeypatch.setattr(subprocess, "run", late)
    assert audit.main() == 4
    assert "no answer" in capsys.readouterr().err


def test_what_is_asked_for_is_what_is_pinned():
    assert audit.PINS.is_file()
    assert str(audit.PINS) in audit.COMMAND
