"""A vehicle in a process of its own with a ground link on a free port, for clients that know nothing of us."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from companion.flight.bundled import free_udp_port


@contextlib.contextmanager
def vehicle(*options: str, speed: float = 5.0) -> Iterator[dict[str, Any]]:
    """Run a vehicle that first speaks to a free port; gives what it says about itself once it is ready."""
    command = [sys.executable, "-m", "sim_link", "run", "--vehicle", "paper", "--engine", "python"]
    command += ["--state-rate", "50", "--port", "0", "--remote-port", "0", "--no-truth-stream", "--json-ready"]
    command += ["--ground-remote-port", str(free_udp_port()), "--speed", str(speed), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield json.loads(process.stdout.readline())
    finally:
        process.terminate()
        _, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (0, ""), err


def mission(count: int) -> list[dict[str, float]]:
    """A mission of `count` items: takeoff, a spiral of waypoints with a jump and a change of speed, landing."""
    latitude, longitude = 473977420, 85455940
    items: list[dict[str, float]] = [
        {"command": 22, "x": latitude, "y": longitude, "z": 5.0, "params": (0.0, 0.0, 0.0, math.nan)},
        {"command": 178, "frame": 2, "x": 0, "y": 0, "z": 0.0, "params": (1.0, 4.0, -1.0, 0.0)},
    ]
    for k in range(count - 4):
        north, east = 50 * (k + 1) * math.cos(0.3 * k), 70 * (k + 1) * math.sin(0.3 * k)
        items.append(
            {
                "command": 16,
                "x": latitude + round(north),
                "y": longitude + round(east),
                "z": 5.0 + 0.125 * (k % 8),
                "params": (0.5 * (k % 3), 0.0, 0.0, math.nan if k % 2 else 90.0),
            }
        )
    items.append({"command": 177, "frame": 2, "x": 0, "y": 0, "z": 0.0, "params": (2.0, 0.0, 0.0, 0.0)})
    items.append({"command": 21, "x": latitude, "y": longitude, "z": 0.0, "params": (0.0, 0.0, 0.0, math.nan)})
    return items
