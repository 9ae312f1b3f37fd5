"""MAVSDK alone starts, pauses, resumes and stops a flight of `companion serve`.

It runs in a process of its own: its library hangs the process that ends while a callback is on its way.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mavsdk", reason="the MAVSDK package is not installed")
from serve_cases import serving

from sim_link.modes import Mode

CLIENT = Path(__file__).with_name("serve_client.py")


def test_a_flight(tmp_path: Path) -> None:
    with serving(tmp_path, ("hover",)) as (serve, stand):
        with serve.client():
            pass
        command = [sys.executable, str(CLIENT), str(serve.port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        assert stand.mode is Mode.HOLD
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen == {"unknown": 2, "start": 0, "pause": 0, "resume": 0, "stop": 0}
