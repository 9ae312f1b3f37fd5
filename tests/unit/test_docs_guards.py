"""docs/guards.md has every guard with its times and responses, and names only keys and functions that exist."""

from __future__ import annotations

import re

import pytest
from test_docs_law import REFERENCE, ROOT, is_key, names_of

from companion.config import load_vehicle
from companion.flight.envelope import ROOM, Envelope
from companion.flight.guards import BATTERY_CRITICAL, EASY_S, Guard, disturbance_step

TEXT = (ROOT / "docs" / "guards.md").read_text(encoding="utf-8")
ROWS = {row[0]: row[-1] for row in (line.strip("| \n").split(" | ") for line in TEXT.splitlines()) if row[0].isupper()}


def test_every_guard_is_there_with_its_stages() -> None:
    assert set(ROWS) == {guard.name for guard in Guard}
    for guard in Guard:
        stages = [
            f"{'at once' if stage.after_s == 0.0 else f'{stage.after_s:g} s'}: {stage.response.name.lower()}"
            for stage in guard.value.stages
        ]
        assert ROWS[guard.name] == "; ".join(stages)
    assert BATTERY_CRITICAL == 0.5
    assert f"wrong for {EASY_S:g} s" in TEXT


def test_keys_and_functions_exist() -> None:
    import ast

    keys = set(re.findall(r"`((?:limits|controller|link)\.[a-z0-9_]+)(?: = false)?`", TEXT))
    assert len(keys) > 20
    assert all(is_key(key) for key in keys)
    for path, name in REFERENCE.findall(TEXT):
        assert name in names_of(ast.parse((ROOT / "companion" / path).read_text(encoding="utf-8")))
    limits = load_vehicle("bundled").limits
    for key, default in re.findall(r"`limits\.([a-z0-9_]+)` \(([0-9.]+)(?: [a-z]+)?\)", TEXT):
        assert getattr(limits, key) == float(default), key


def test_the_envelope_of_the_bundled_vehicle() -> None:
    vehicle = load_vehicle("bundled")
    parameters = vehicle.parameters()
    envelope = Envelope(parameters.gains, parameters.model.drag, disturbance_step(vehicle.limits))
    assert [root * root for root in envelope.step_roots] == pytest.approx([0.48, 0.0034], rel=0.02)
    assert f"sqrt({ROOM:g} max V_step)" in TEXT
