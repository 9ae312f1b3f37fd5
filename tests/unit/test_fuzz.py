"""What `tools/fuzz.py` runs for long, for a moment: made-up inputs, and all that once were findings."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import fuzz
import fuzz_targets
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

TOOLS = Path(__file__).parents[2] / "tools"
NAMES = sorted(fuzz_targets.TARGETS)
_made: dict[str, fuzz_targets.Target] = {}


def target(name: str) -> fuzz_targets.Target:
    if name not in _made:
        _made[name] = fuzz_targets.TARGETS[name]()
    return _made[name]


@pytest.mark.parametrize("name", NAMES)
def test_good_inputs_and_findings_of_before(name: str) -> None:
    for data in fuzz_targets.seeds(name):
        target(name)(data)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_made_up_inputs(name: str, data: st.DataObject) -> None:
    seeds = fuzz_targets.seeds(name) or [b""]
    content = bytearray(data.draw(st.binary(max_size=400) | st.sampled_from(seeds)))
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            at = data.draw(st.integers(0, len(content) - 1))
            content[at : at + 1] = data.draw(st.binary(max_size=3))
    target(name)(bytes(content))


def test_every_target_has_a_share() -> None:
    assert set(fuzz.SHARES) == set(NAMES)
    assert sum(fuzz.SHARES.values()) == pytest.approx(1.0)


def test_a_finding_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("atheris")
    broken = tmp_path / "fuzz_targets.py"
    broken.write_text(
        "from pathlib import Path\n"
        f"DATA = Path({str(tmp_path / 'found')!r})\n"
        "def seeds(name):\n    return [b'abd']\n"
        "def one():\n    def run(data):\n        if len(data) > 3 and data[0] % 2:\n            raise ValueError\n"
        "    return run\n"
        "TARGETS = {'one': one}\n"
    )
    copy = tmp_path / "fuzz.py"
    copy.write_text((TOOLS / "fuzz.py").read_text().replace("SHARES = {", 'SHARES = {"one": 1.0,', 1))
    done = subprocess.run(
        [sys.executable, str(copy), "--runs", "200000", "--seconds", "60", "one"],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 1, done.stdout
    assert "ValueError" in done.stdout
    (found,) = (tmp_path / "found" / "one").iterdir()
    assert len(found.read_bytes()) > 3
