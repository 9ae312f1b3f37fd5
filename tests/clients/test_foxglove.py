"""A second reader of ULog that knows nothing of us: Foxglove's, for node. It finds what pyulog finds."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink2
from pyulog import ULog
from record_cases import PHASES, synthetic_flight

from companion.record.flight_log import Entry, FlightLog
from companion.record.tlog import Direction
from companion.record.ulog import Level

NODE = shutil.which("node")
SCRIPT = Path(__file__).with_name("read_ulog.js")
CONFIGURATION = 'name = "paper"\n[vehicle]\nname = "quad"\n[vehicle.controller]\nk1_1_s = 0.7\nk2 = 4.0\n'


def installed() -> bool:
    """Whether node finds the package (NODE_PATH names the folder that npm installed it in)."""
    if NODE is None:
        return False
    command = [NODE, "-e", 'require("@foxglove/ulog")']
    return subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 0


pytestmark = pytest.mark.skipif(not installed(), reason="node or its package @foxglove/ulog is not installed")


def a_log(path: Path, rows: int) -> Path:
    """What a flight leaves: heartbeats, states, a battery, rows, texts and facts."""
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    none = [0.0] * 21
    log = FlightLog(CONFIGURATION, 0)
    for index, row in enumerate(synthetic_flight(float(rows) / 100.0).rows[:rows]):
        t_us = round(1e6 * row[0])
        state = mavlink2.MAVLink_odometry_message(t_us, 1, 1, 1, 2, -3, [1, 0, 0, 0], 0.1, 0, 0, 0, 0, 0.2, none, none)
        heard = [mavlink2.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3), state] if index % 50 == 0 else [state]
        log.take_frames(Direction.IN, [bytes(message.pack(link)) for message in heard], 1)
        log.take(Entry.ROW, row.tobytes(), 0)
    for phase in PHASES:
        log.take(Entry.TEXT, bytes((Level.NOTICE,)) + f"{phase.name}: {phase.reason} ü".encode(), 0)
    path.write_bytes(log.end())
    return path


def read(path: Path) -> dict[str, Any]:
    assert NODE is not None
    done = subprocess.run([NODE, str(SCRIPT), str(path)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(json.loads(done.stdout))


def numbers(records: list[dict[str, Any]], field: str) -> np.ndarray:
    """A field as pyulog gives it: of arrays one element, null as NaN."""
    name, _, index = field.partition("[")
    found = [record[name][int(index[:-1])] if index else record[name] for record in records]
    return np.array([math.nan if value is None else float(value) for value in found])


@pytest.mark.parametrize("cut", [0, 1000])
def test_it_reads_what_pyulog_reads(tmp_path: Path, cut: int) -> None:
    """A log that was cut off too: up to there."""
    path = a_log(tmp_path / "flight.ulg", 120)
    if cut:
        path.write_bytes(path.read_bytes()[:-cut])
    theirs, known = read(path), ULog(str(path))
    assert set(theirs["topics"]) == {data.name for data in known.data_list}
    compared = 0
    for data in known.data_list:
        records = theirs["topics"][data.name]
        for field, values in data.data.items():
            wanted = np.asarray(values, dtype=np.float64)
            assert np.array_equal(numbers(records, field), wanted, equal_nan=True), (data.name, field)
            compared += len(records)
    assert compared > 5000
    assert [[text, int(t_us)] for _, t_us, text in theirs["texts"]] == [
        [said.message, said.timestamp] for said in known.logged_messages
    ]
    assert {key: entry["value"] for key, entry in theirs["parameters"].items()} == known.initial_parameters
    assert theirs["information"]["sys_name"] == "companion"
