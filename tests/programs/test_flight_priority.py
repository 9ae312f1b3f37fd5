"""The control process takes a priority in flight where time passes by itself, and none from a vehicle in lockstep:
there it takes the core that the vehicle leaves, on a machine with two."""

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
from sim_link.cores import take_core_of_two

class Status:
    def line(self, text): pass
    def progress(self, progress): pass

cores = set(list(os.sched_getaffinity(0))[:2])
os.sched_setaffinity(0, cores)  # as if there were no more
before = os.getpriority(os.PRIO_PROCESS, 0)
ready = Ready.made(Path(sys.argv[1]), "python", lambda line: None)
loop = ready.loop(None, Status(), connection="udpin:127.0.0.1:14541", timeout_s=1.0)  # nothing is said over a link here
loop._paced(sys.argv[2] == "waits")
companion = os.sched_getaffinity(0)
os.sched_setaffinity(0, cores)
take_core_of_two(14541)  # the vehicle's own thread
vehicle = os.sched_getaffinity(0)
print(before, os.getpriority(os.PRIO_PROCESS, 0), len(cores), len(companion), len(vehicle), len(companion | vehicle))
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
    before, after, cores, companion, vehicle, both = map(int, done.stdout.split())
    assert after == (NICENESS if time == "passes" and priority_permitted() else before)
    assert companion == (1 if time == "waits" else cores)
    assert (vehicle, both) == (1, cores), "on one that is the vehicle's alone, where there are two"
