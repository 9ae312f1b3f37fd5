"""MAVSDK as it comes from the registry, with nothing special-cased, against the vehicle's ground link.

It runs in a process of its own: its library hangs the process that ends while a callback is on its way.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from client_tools import vehicle

pytest.importorskip("mavsdk", reason="the MAVSDK package is not installed")

CLIENT = Path(__file__).with_name("mavsdk_client.py")


def run(scenario, *options, speed=5.0):
    """Run a scenario of the client against a vehicle; gives what it saw."""
    with vehicle(*options, speed=speed) as ready:
        command = [sys.executable, str(CLIENT), scenario, str(ready["ground_remote_port"])]
        done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_health_arm_takeoff_goto_hold_land_disarm():
    seen = run("flight")
    assert seen["version"] == 1
    assert seen["odometry"]
    assert seen["down_m_s2"] == pytest.approx(-9.8, abs=0.5)
    assert seen["battery_v"] > 15.0
    assert seen["satellites"] >= 6
    assert seen["goto"] == pytest.approx([10.0, 0.0, -6.0], abs=0.4)


def test_every_parameter_is_listed_read_and_set():
    seen = run("parameters")
    assert seen["ints"] > 40 and seen["floats"] > 80
    assert seen["read_only"] == []
    assert seen["changed"] == [3.5, 5]
    assert seen["refused"] == ["DOES_NOT_EXIST", "WRONG_TYPE"]


def test_missions_and_fences_come_back_as_they_went_and_are_flown():
    seen = run("plan")
    assert seen["same"] and seen["count"] == 50
    assert seen["fence"]
    assert seen["cleared"] == 0
    assert seen["total"] == 6


def test_offboard_position_velocity_and_attitude_rates():
    seen = run("offboard")
    assert seen["without_setpoint"] == "NO_SETPOINT_SET"
    assert seen["sideways"] < 1.0
    assert seen["yaw_rate_deg_s"] == pytest.approx(30.0, abs=3.0)
