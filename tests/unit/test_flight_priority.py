"""The control process takes a priority in flight where time passes by itself, and none from a vehicle in lockstep."""

import subprocess
import sys
from pathlib import Path

import pytest
from test_realtime import priority_permitted

from companion.config import build_flight, find, read_toml
from companion.flight.launch import prepare
from companion.realtime import NICENESS

FLY = """
import os, sys
from pathlib import Path
from companion.flight.process import Ready

class Status:
    def line(self, text): pass
    def progress(self, progress): pass

before = os.getpriority(os.PRIO_PROCESS, 0)
ready = Ready.made(Path(sys.argv[1]), "python", lambda line: None)
loop = ready.loop(None, Status(), connection="none", timeout_s=1.0)  # nothing is said over a link here
loop._paced(sys.argv[2] == "waits")
print(before, os.getpriority(os.PRIO_PROCESS, 0))
ready.recorder.close()
"""


@pytest.mark.parametrize("time", ["waits", "passes"])
def test_priority(time: str, tmp_path: Path) -> None:
    path = find("windtest", "flights")
    folder = prepare(build_flight(read_toml(path), str(path)), tmp_path / "flight")
    done = subprocess.run(
        [sys.executable, "-c", FLY, str(folder), time], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    before, after = map(int, done.stdout.split())
    assert after == (NICENESS if time == "passes" and priority_permitted() else before)
