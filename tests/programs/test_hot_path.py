"""A flight in lockstep, looked at from within: nothing is compiled after the warm-up, nothing is left for the garbage
collector, and memory does not grow with the steps. In a process of its own, where nothing is compiled yet."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CASES = Path(__file__).parents[1] / "loopback"
FLY = """
import gc, json, sys, tracemalloc
from pathlib import Path

from flight_cases import make_flight
from companion import accelerate
from companion.flight.bundled import BundledVehicle
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES
from companion.flight.process import warm_up
from companion.flight.engines import kernels
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight

folder, engine = Path(sys.argv[1]), sys.argv[2]
BEGIN, END = 60, 260
hover = dict(shape="hover", anchor="here", duration_s=2.5, name="hover", hover=dict(point_m=[0.0, 0.0, 0.0]))
flight = make_flight(trajectory=hover, start=dict(position_m=[0.0, 0.0, -20.0]))
compiled = kernels(engine)
warm_up(flight, compiled)


class Watched(FlightRecord):
    seen = {}

    def append(self, row):
        super().append(row)
        n = len(self)
        if n in (BEGIN, END):
            frozen, enabled = gc.get_freeze_count(), gc.isenabled()
            cyclic = gc.collect()
            self.seen[n] = dict(frozen=frozen, enabled=enabled, cyclic=cyclic, objects=len(gc.get_objects()),
                                bytes=tracemalloc.get_traced_memory()[0], signatures=signatures())


def signatures():
    return [len(twin.signatures) for twin in accelerate._compiled.values()]


def fly():
    record = Watched(2000, PHASE_NAMES)
    with BundledVehicle(flight, folder, px4="1.18", engine="python", lockstep=True) as vehicle:
        with Wire.open(vehicle.connection) as wire:
            tracemalloc.start()
            outcome = FlightLoop(flight, of_flight(flight), wire, record, compiled).run()
    return outcome, record


result = {"warm": signatures(), "compiled": 0, "counts": True}
if engine == "numba":
    import numba
    from numba.core import event

    with event.install_recorder("numba:compile") as recorder:
        outcome, record = fly()
        result["compiled"] = len(recorder.buffer)
        numba.njit(lambda x: x + 1)(1)  # does the recorder see anything at all
        result["counts"] = len(recorder.buffer) > result["compiled"]
else:
    outcome, record = fly()
result |= {"cause": outcome.cause.name, "begin": record.seen[BEGIN], "end": record.seen[END], "steps": END - BEGIN}
print(json.dumps(result))
"""
ENGINES = [
    "python",
    pytest.param("numba", marks=pytest.mark.numba),
]


@pytest.mark.parametrize("engine", ENGINES)
def test_nothing_is_compiled_collected_or_kept(engine, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(CASES)}
    command = [sys.executable, "-c", FLY, str(tmp_path), engine]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    begin, end, steps = seen["begin"], seen["end"], seen["steps"]
    assert seen["cause"] == "COMPLETED"
    assert seen["counts"]
    assert seen["compiled"] == 0
    assert seen["warm"] == begin["signatures"] == end["signatures"]
    assert (engine == "numba") == (len(seen["warm"]) > 0)
    for at in (begin, end):
        assert not at["enabled"]
        assert at["frozen"] > 10_000
    # What a step makes and drops again goes away by itself; what a second makes is not worth a collection.
    assert end["cyclic"] < steps / 50
    assert end["objects"] - begin["objects"] < steps / 10
    assert end["bytes"] - begin["bytes"] < 40 * steps
