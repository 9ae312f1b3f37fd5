"""The traffic log of a flight in the hands of others: MAVProxy takes every message in, pymavlink's tools open it."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from flight_cases import HOVER, Stand, make_flight
from pymavlink import mavutil
from test_mavproxy import Console

from companion.flight.bundled import free_udp_port
from companion.flight.launch import control
from companion.record.folder import write_configuration
from companion.record.tlog import read_tlog

AT_ONCE = 20
"""Frames that MAVProxy gets at a time: it must not lose any."""


@pytest.fixture(scope="module")
def tlog(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The link.tlog of a flight over a point."""
    base = tmp_path_factory.mktemp("flight")
    flight = make_flight(trajectory=HOVER | {"duration_s": 0.5})
    folder = base / "out"
    folder.mkdir()
    write_configuration(folder, flight.model_dump(exclude_none=True))
    with Stand(flight, base) as stand:
        control(folder, f"udpin:127.0.0.1:{stand.port}", "python", 30.0, lambda message: None)
    return folder / "link.tlog"


def frames(path: Path) -> list[bytes]:
    return [bytes(entry.raw) for entry in read_tlog(path)]


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed")
def test_mavproxy_takes_in_every_message(tlog: Path, tmp_path: Path) -> None:
    """It writes a log of its own of all that it understood."""
    sent, port = frames(tlog), free_udp_port()
    assert len(sent) > 200
    console = Console(f"udpin:127.0.0.1:{port}", tmp_path, "--default-modules", "link,mode")
    own = tmp_path / "mav.tlog"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            console.wait("Waiting for heartbeat")
            beat = next(raw for raw in sent if raw[7:10] == b"\0\0\0" and raw[6] == 1)
            end_s = time.monotonic() + 60.0
            while not own.exists() or own.stat().st_size == 0:  # it asks before it listens to all
                assert time.monotonic() < end_s
                out.sendto(beat, ("127.0.0.1", port))
                time.sleep(0.1)
            for first in range(0, len(sent), AT_ONCE):
                out.sendto(b"".join(sent[first : first + AT_ONCE]), ("127.0.0.1", port))
                time.sleep(0.01)
            console.wait("Mode OFFBOARD")
            missing = Counter(sent)
            while missing and time.monotonic() < end_s:
                out.sendto(beat * AT_ONCE, ("127.0.0.1", port))  # its file has a buffer
                time.sleep(0.1)
                missing = Counter(sent) - Counter(frames(own))
    finally:
        console.close()
    assert not missing, sum(missing.values())


def test_pymavlink_and_its_tools_open_it(tlog: Path) -> None:
    link = mavutil.mavlink_connection(str(tlog))
    seen: Counter[str] = Counter()
    while (message := link.recv_msg()) is not None:
        seen[message.get_type()] += 1
    assert "BAD_DATA" not in seen and not any(name.startswith("UNKNOWN") for name in seen)
    assert sum(seen.values()) == len(frames(tlog))
    assert min(seen[name] for name in ("HEARTBEAT", "ODOMETRY", "SET_ATTITUDE_TARGET", "COMMAND_LONG")) > 0
    tool = Path(sys.executable).with_name("mavflightmodes.py")
    said = subprocess.run([sys.executable, tool, tlog], capture_output=True, text=True, timeout=60, check=True).stdout
    assert "OFFBOARD" in said
