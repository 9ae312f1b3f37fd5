"""MAVSDK and MAVProxy, with nothing special-cased, against the file server at component 191."""

import importlib.util
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from file_host import host
from test_mavproxy import Console

CLIENT = Path(__file__).with_name("ftp_client.py")
LINES = b"".join(b"%d,%f,%f,0.0\n" % (i, i * 0.1, i * 0.01) for i in range(4000))


@pytest.fixture
def files(tmp_path):
    (tmp_path / "lap.csv").write_bytes(LINES)
    (tmp_path / "bad.csv").write_bytes(b"bad\n")
    return tmp_path


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="the MAVSDK package is not installed")
def test_mavsdk(files):
    with host(files / "vehicle") as port:
        command = [sys.executable, str(CLIENT), str(port), str(files)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    assert (files / "burst False" / "lap.csv").read_bytes() == LINES
    assert (files / "burst True" / "lap.csv").read_bytes() == LINES
    (index, lap) = seen.pop("listed")
    assert index[0] == "index.json" and lap == ["lap.csv", len(LINES)]
    assert seen == {
        "upload": "SUCCESS",
        "identical": True,
        "download False": "SUCCESS",
        "download True": "SUCCESS",
        "refused": "PROTOCOL_ERROR",
        "directory": "FILE_PROTECTED",
        "rename": "SUCCESS",
        "remove": "SUCCESS",
        "remove none": "FILE_DOES_NOT_EXIST",
        "outside": "PROTOCOL_ERROR",
    }
    assert not [p for p in (files / "vehicle").iterdir() if not p.name.startswith(".")]


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed")
def test_mavproxy(files):
    stored = files / "vehicle" / "lap.csv"
    with host(files / "vehicle") as port:
        # the parameter module would end our sessions: it fetches parameters by FTP, of which MAVProxy has one at a time
        more = ("--default-modules", "ftp", "--target-system", "1", "--target-component", "191")
        console = Console(f"udpout:127.0.0.1:{port}", files, *more)
        try:
            console.wait("Detected vehicle 1:191")
            console.do(f"ftp put {files}/lap.csv lap.csv", "Sent file of length")
            console.do("ftp list /", f"lap.csv\t{len(LINES)}")
            assert stored.read_bytes() == LINES
            console.do("ftp crc lap.csv", "crc: lap.csv 0x")
            console.do(f"ftp get lap.csv {files}/back.csv", "Wrote")
            for _ in range(50):  # it says so before the last of it is on the disk
                if (files / "back.csv").read_bytes() == LINES:
                    break
                time.sleep(0.1)
            assert (files / "back.csv").read_bytes() == LINES
            console.do(f"ftp put {files}/bad.csv lap.csv", "Sent file of length", "lap.csv refused")
            assert stored.read_bytes() == LINES
            console.do("ftp rename lap.csv new.csv")
            console.do("ftp rm new.csv")
            console.do("ftp list /", "index.json")
            for _ in range(50):
                if not stored.with_name("new.csv").exists():
                    break
                time.sleep(0.1)
            assert not [p for p in (files / "vehicle").iterdir() if not p.name.startswith(".")]
        finally:
            console.close()
