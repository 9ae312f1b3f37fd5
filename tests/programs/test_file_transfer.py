"""The file server behind a real socket: our client, the commands, and pymavlink's mavftp."""

from __future__ import annotations

import json
import subprocess
import sys
import threading

import pytest
from file_host import host

from companion.errors import LinkError
from companion.ground.upload import Files

LINES = b"".join(b"%d,%f,%f,0.0\n" % (i, i * 0.1, i * 0.01) for i in range(60_000))
MEGABYTE = LINES[:1_000_000]


def test_a_megabyte(tmp_path):
    with host(tmp_path / "t") as port, Files(f"udpout:127.0.0.1:{port}") as files:
        verdict = files.upload_bytes(MEGABYTE, "lap.csv")
        assert verdict.accepted and verdict.resumed_from == 0
        assert (tmp_path / "t" / "lap.csv").read_bytes() == MEGABYTE
        assert files.read("lap.csv") == MEGABYTE


def test_ten_percent_loss_each_way(tmp_path):
    content = LINES[:200_000]
    with host(tmp_path / "t", 0.1, 5) as port, Files(f"udpout:127.0.0.1:{port}") as files:
        assert files.upload_bytes(content, "lap.csv").accepted
        assert (tmp_path / "t" / "lap.csv").read_bytes() == content


def test_several_at_once(tmp_path):
    done = []

    def upload(port, number):
        with Files(f"udpout:127.0.0.1:{port}") as files:
            for i in range(3):
                content = LINES[number : 20_000 + number]
                assert files.upload_bytes(content, f"{number}.csv").accepted
                assert files.read(f"{number}.csv") == content
                done.append((number, i))

    with host(tmp_path / "t", 0.02, 6) as port:
        threads = [threading.Thread(target=upload, args=(port, number)) for number in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30.0)
    assert sorted(done) == [(number, i) for number in range(3) for i in range(3)]


def test_the_server_is_killed_in_the_middle(tmp_path):
    with host(tmp_path / "t") as port:

        def stop(there, total):
            if there > 100_000:
                raise InterruptedError

        with Files(f"udpout:127.0.0.1:{port}") as files, pytest.raises(InterruptedError):
            files.upload_bytes(MEGABYTE, "lap.csv", progress=stop)
    assert [p.name for p in (tmp_path / "t").iterdir() if not p.name.startswith(".")] == []
    with host(tmp_path / "t") as port, Files(f"udpout:127.0.0.1:{port}") as files:
        verdict = files.upload_bytes(MEGABYTE, "lap.csv")
    assert verdict.accepted and verdict.resumed_from > 50_000
    assert (tmp_path / "t" / "lap.csv").read_bytes() == MEGABYTE


def test_nobody_listens():
    with pytest.raises(LinkError, match="does `companion serve` run"):
        Files("udpout:127.0.0.1:9", patience_s=0.5)


def command(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "companion", *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout, done.stderr


def test_the_commands(tmp_path):
    good, bad = tmp_path / "lap.csv", tmp_path / "bad.csv"
    good.write_bytes(LINES[:5000])
    bad.write_bytes(b"bad\n")
    with host(tmp_path / "t") as port:
        to = ("--to", f"udpout:127.0.0.1:{port}")
        code, out, err = command("upload", str(good), *to, "--json")
        assert (code, err) == (0, "")
        assert json.loads(out)["verdict"] == "may be flown"
        code, out, _ = command("upload", str(bad), *to)
        assert code == 3 and "REFUSED by the vehicle: bad.csv: asks for too much" in out
        code, out, _ = command("list", *to, "--json")
        assert code == 0 and [file["name"] for file in json.loads(out)] == ["lap.csv"]


class Ftp:
    """pymavlink's client."""

    def __init__(self, port):
        from pymavlink import mavftp, mavutil

        self.link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=255, source_component=190)
        self.link.mav.heartbeat_send(6, 8, 0, 0, 0)
        self.errors = mavftp.FtpError
        quick = [("debug", int, 0), ("pkt_loss_tx", int, 0), ("pkt_loss_rx", int, 0), ("max_backlog", int, 5)]
        quick += [("burst_read_size", int, 80), ("write_size", int, 80), ("write_qsize", int, 5)]
        quick += [("idle_detection_time", float, 0.4), ("read_retry_time", float, 0.3), ("retry_time", float, 0.25)]
        settings = mavftp.MAVFTPSettings(quick)
        self.ftp = mavftp.MAVFTP(self.link, target_system=1, target_component=191, settings=settings)

    def do(self, *arguments):
        result = self.ftp.cmd_ftp(list(arguments))
        if arguments[0] in {"get", "put"}:
            result = self.ftp.process_ftp_reply(arguments[0], timeout=30)
        return result

    def close(self):
        self.link.close()


def test_pymavlink(tmp_path):
    pytest.importorskip("pymavlink.mavftp")
    content, back = LINES[: LINES.index(b"\n", 20_000) + 1], tmp_path / "back.csv"
    (tmp_path / "lap.csv").write_bytes(content)
    (tmp_path / "bad.csv").write_bytes(b"bad\n")
    with host(tmp_path / "t") as port:
        client = Ftp(port)
        assert client.do("put", str(tmp_path / "lap.csv"), "/lap.csv").error_code == client.errors.Success
        assert (tmp_path / "t" / "lap.csv").read_bytes() == content
        listing = client.do("list", "/").directory_listing
        assert [(e.name, e.size_b) for e in listing if e.name != "index.json"] == [("lap.csv", len(content))]
        assert client.do("crc", "/lap.csv").error_code == client.errors.Success
        assert client.do("get", "/lap.csv", str(back)).error_code == client.errors.Success
        assert back.read_bytes() == content
        client.do("put", str(tmp_path / "bad.csv"), "/lap.csv")
        assert (tmp_path / "t" / "lap.csv").read_bytes() == content
        assert client.do("put", str(tmp_path / "lap.csv"), "../lap.csv").error_code != client.errors.Success
        assert client.do("mkdir", "/sub").error_code == client.errors.FileProtected
        assert client.do("rename", "/lap.csv", "/new.csv").error_code == client.errors.Success
        assert client.do("rm", "/new.csv").error_code == client.errors.Success
        assert client.do("rm", "/none.csv").error_code == client.errors.FileNotFound
        client.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["back.csv", "bad.csv", "lap.csv", "t"]
