"""Paths that the tests share, and what is left out where numba is not there or hidden."""

import os
import sys
from pathlib import Path

import pytest

from companion import accelerate

# mavutil decides at its import, once for all tests of a process, which version it begins with
os.environ.setdefault("MAVLINK20", "1")
for folder in ("unit", "loopback", "programs"):
    sys.path.insert(0, str(Path(__file__).parent / folder))
sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """What is marked needs numba, also where only COMPANION_TEST_WITHOUT_NUMBA=1 hides it."""
    if item.get_closest_marker("numba") is not None and not accelerate.available():
        pytest.skip("numba is not installed")
