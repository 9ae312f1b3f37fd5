"""MAVSDK, MAVProxy and pymavlink's helper, with nothing special-cased, against the parameters of component 191."""

import importlib.util
import json
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
from parameter_host import host
from pymavlink import mavparm, mavutil
from test_mavproxy import Console

from companion.ground.tuning import ENTRIES

CLIENT = Path(__file__).with_name("parameter_client.py")
REAL32, INT32 = 9, 6


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="the MAVSDK package is not installed")
def test_mavsdk(tmp_path):
    with host(tmp_path) as ground:
        command = [sys.executable, str(CLIENT), str(ground.port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen == {
        "ints": 2,
        "floats": len(ENTRIES) - 1,
        "differ": [],
        "set": "SUCCESS",
        "heading": "SUCCESS",
        "refused": "VALUE_OUT_OF_RANGE",
        "type": "WRONG_TYPE",
        "unknown": "DOES_NOT_EXIST",
        "values": [2.2, 2, 4.0],
        "reset": "SUCCESS",
        "after": [2.0, 1],
    }


def received(connection, name, fresh=True):
    """The value of a parameter as pymavlink keeps it, read anew."""
    if fresh:
        connection.param_fetch_one(name)
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        message = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=1.0)
        if message is not None and message.param_id == name:
            return message
    raise AssertionError(f"{name} did not come")


def test_pymavlinks_helper(tmp_path):
    with host(tmp_path) as ground:
        connection = mavutil.mavlink_connection(f"udpout:127.0.0.1:{ground.port}", dialect="development")
        try:
            connection.target_system, connection.target_component = 1, 191
            connection.param_fetch_all()
            names = set()
            while len(names) < len(ENTRIES) + 1:
                message = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=5.0)
                assert message is not None, sorted(names)
                names.add(message.param_id)
                assert message.param_count == len(ENTRIES) + 1
            values = mavparm.MAVParmDict()
            assert values.mavset(connection, "OC_K1", 2.2, parm_type=REAL32)
            assert received(connection, "OC_K1").param_value == pytest.approx(2.2)
            assert values.mavset(connection, "OC_HDG_KIND", 2, parm_type=INT32)
            assert struct.pack("<f", received(connection, "OC_HDG_KIND").param_value) == struct.pack("<i", 2)
            assert values.mavset(connection, "OC_GAMMA", 500.0, parm_type=REAL32)  # any answer is one to this helper
            assert received(connection, "OC_GAMMA").param_value == 4.0
            assert any("OC_GAMMA refused" in text for text in ground.texts)
        finally:
            connection.close()


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed")
def test_mavproxy(tmp_path):
    with host(tmp_path) as ground:
        more = ("--default-modules", "param", "--target-system", "1", "--target-component", "191")
        console = Console(f"udpout:127.0.0.1:{ground.port}", tmp_path, *more)
        try:
            console.wait("Detected vehicle 1:191", "parameters to")
            console.do("param set OC_K1 2.2")
            for _ in range(20):
                if "OC_K1            2.2" in console.do("param show OC_K1", "OC_K1 "):
                    break
                time.sleep(0.2)
            else:
                pytest.fail("the parameter was not set")
            console.do("param set OC_GAMMA 500")
            end = time.monotonic() + 10.0
            while not any("OC_GAMMA refused" in text for text in ground.texts):
                assert time.monotonic() < end
                time.sleep(0.05)
            assert "OC_GAMMA         4.0" in console.do("param show OC_GAMMA", "OC_GAMMA ")
        finally:
            console.close()
