"""`companion mission` against the bundled vehicle: what a ground station uploaded is what is flown through."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from companion.cli import main
from companion.flight.bundled import free_udp_port
from companion.trajectory.formats import read
from companion.trajectory.formats.contents import Route

LATITUDE, LONGITUDE, HEIGHT = 473977420, 85455940, 489.4
"""Home of the bundled vehicle."""
METRE = 1e7 * math.degrees(1.0 / 6371000.0)


def upload(link: Any, items: list[tuple[int, float, float, float, float]], kind: int) -> None:
    """Command, first parameter, metres to the north, degrees of heading, height."""
    link.mav.mission_count_send(link.target_system, 1, len(items), kind)
    for _ in range(200):
        asked = link.recv_match(type=["MISSION_REQUEST_INT", "MISSION_ACK"], blocking=True, timeout=5.0)
        assert asked is not None
        if asked.get_type() == "MISSION_ACK":
            assert asked.type == 0
            return
        command, first, north, yaw, up = items[asked.seq]
        params = (first, 0.0, 0.0, yaw)
        place = (LATITUDE + round(north * METRE), LONGITUDE + 100 * asked.seq, up)
        frame = 0 if kind else 6
        link.mav.mission_item_int_send(link.target_system, 1, asked.seq, frame, command, 0, 1, *params, *place, kind)
    raise AssertionError("no end")


@pytest.fixture
def port() -> Any:
    port = free_udp_port()
    command = [sys.executable, "-m", "sim_link", "run", "--vehicle", "bundled", "--engine", "python", "--port", "0"]
    command += ["--remote-port", str(port), "--no-ground", "--no-truth-stream", "--with-parent"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield port
        process.terminate()


def test_what_was_uploaded_comes_back_as_a_file(port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255, source_component=190)
    assert link.wait_heartbeat(timeout=10.0) is not None
    upload(link, [(22, 0.0, 0.0, math.nan, 5.0), (16, 3.0, 20.0, 90.0, 6.0), (16, 0.0, 40.0, math.nan, 5.0)], 0)
    upload(link, [(5003, 80.0, 0.0, 0.0, 0.0)], 1)
    link.close()
    path = tmp_path / "field.waypoints"
    assert main(["mission", str(path), "--connect", f"udpin:127.0.0.1:{port}", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["mission_items"], document["fence_items"]) == (3, 1)
    assert document["home"]["altitude_m"] == pytest.approx(HEIGHT, abs=0.5)
    route = read(path)
    assert isinstance(route, Route)
    assert [leg.waypoint.p_m[0] for leg in route.legs] == pytest.approx([0.0, 20.0, 40.0], abs=0.05)
    assert [leg.waypoint.p_m[2] for leg in route.legs] == pytest.approx([-5.0, -6.0, -5.0], abs=1e-6)
    assert [leg.hold_s for leg in route.legs] == [0.0, 3.0, 0.0]
    assert route.legs[1].waypoint.yaw_rad == pytest.approx(math.pi / 2.0)
    assert route.fence is not None
    # It is not overwritten.
    assert main(["mission", str(path), "--connect", f"udpin:127.0.0.1:{port}"]) == 2
    assert "is there already" in capsys.readouterr().err


def test_no_vehicle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    connection = f"udpin:127.0.0.1:{free_udp_port()}"
    assert main(["mission", str(tmp_path / "a"), "--connect", connection, "--timeout", "0.3"]) == 4
    assert "nothing came at" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
