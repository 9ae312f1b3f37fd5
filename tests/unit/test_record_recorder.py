"""The recorder process: nothing blocks, nothing is lost that was taken, and nothing that ends a command ends it."""

import contextlib
import math
import os
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import ulog_reader
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2
from record_cases import row

from companion.errors import InputError
from companion.record.columns import COLUMNS
from companion.record.flight_log import Entry
from companion.record.flight_record import FlightRecord
from companion.record.recorder import Recorder, _DiskWriter
from companion.record.tlog import Direction, encode_datagrams, read_tlog

PATIENCE_S = 30.0


def frame(sequence: int = 0) -> bytes:
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    link.seq = sequence % 256
    return mavlink2.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link)


def state(t_us: int) -> bytes:
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    none = [0.0] * 21
    message = mavlink2.MAVLink_odometry_message(t_us, 1, 1, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, none, none)
    return bytes(message.pack(link))


def offer_steps(recorder: Recorder, record: FlightRecord, count: int) -> None:
    """States and rows as a flight gives them, from 1 s on."""
    record.sink = recorder.offer_row
    for index in range(count):
        t_us = 1_000_000 + 4000 * index
        recorder.offer(Direction.IN, state(t_us), time.monotonic_ns())
        record.append(row(t_s=1e-6 * t_us, phase=4.0, e1_n=float(index)))


def logged_steps(folder: Path) -> list[float]:
    """e1 north of the steps in a flight's log."""
    try:
        return [record[1] for record in ulog_reader.read(folder / "flight.ulg").data.get("companion_errors", [])]
    except (AssertionError, OSError):  # not begun yet
        return []


def until(condition: Callable[[], bool]) -> bool:
    """Wait for a condition, long enough for a busy machine."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


@pytest.fixture
def recorder(tmp_path, monkeypatch) -> Iterator[Recorder]:
    monkeypatch.setattr("companion.record.recorder._RING_BYTES", 1 << 20)
    recorder = Recorder.start(tmp_path)
    yield recorder
    with contextlib.suppress(ProcessLookupError):
        recorder._process.send_signal(signal.SIGCONT)
    recorder.close()


def test_everything_offered_is_in_the_log(tmp_path, recorder):
    wall_ns, epoch_ns = time.monotonic_ns(), time.time_ns()
    for index in range(200):
        direction = Direction.OUT if index % 2 else Direction.IN
        recorder.offer(direction, frame(index), wall_ns + index * 4_000_000)
    recorder.close()
    assert (recorder.recorded, recorder.dropped, recorder.problem) == (200, 0, None)
    entries = list(read_tlog(tmp_path / "link.tlog"))
    assert [entry.raw for entry in entries] == [frame(index) for index in range(200)]
    assert [entry.direction for entry in entries[:2]] == [Direction.IN, Direction.OUT]
    # Two readings of two clocks lie between: milliseconds on a busy machine, not seconds.
    assert entries[0].epoch_us == pytest.approx(epoch_ns / 1000, abs=2e6)
    assert entries[199].epoch_us - entries[0].epoch_us == pytest.approx(199 * 4000, abs=8)
    log = mavutil.mavlink_connection(str(tmp_path / "link.tlog"))
    assert log.recv_match().get_type() == "HEARTBEAT"
    log.close()


def test_entries_reach_the_file_during_the_flight(tmp_path, recorder):
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    assert until(lambda: len(list(read_tlog(tmp_path / "link.tlog"))) == 1)


def test_one_that_gives_way_writes_everything_at_the_end(tmp_path, recorder):
    recorder.give_way()
    for index in range(50):
        recorder.offer(Direction.IN, frame(index), time.monotonic_ns())
    time.sleep(0.3)  # it looks twenty times per second
    assert recorder.behind == 50
    recorder.close()
    assert (recorder.recorded, recorder.dropped, recorder.problem) == (50, 0, None)
    assert len(list(read_tlog(tmp_path / "link.tlog"))) == 50


def test_in_lockstep_a_ring_that_is_nearly_full_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.record.recorder._RING_BYTES", 4 << 20)
    monkeypatch.setattr("companion.record.recorder._WAIT_MAX_S", PATIENCE_S)  # a busy machine
    content = struct.pack(f"={len(COLUMNS)}d", *range(len(COLUMNS)))
    for name, waits in (("waits", True), ("does-not", False)):
        folder = tmp_path / name
        folder.mkdir()
        recorder = Recorder.start(folder)
        recorder.give_way()
        offer = recorder.offer_row_in_lockstep if waits else recorder.offer_row
        for _ in range(20_000):  # two rings and a half
            offer(content)
        recorder.close()
        assert (recorder.dropped == 0, recorder.problem is None) == (waits, waits)


def test_in_lockstep_a_recorder_that_takes_nothing_is_waited_for_once(monkeypatch, recorder):
    monkeypatch.setattr("companion.record.recorder._WAIT_MAX_S", 0.05)
    sleeps, real = [], time.sleep
    monkeypatch.setattr("companion.record.recorder.time.sleep", lambda s: sleeps.append(s) or real(s))
    recorder._process.send_signal(signal.SIGSTOP)
    recorder.give_way()
    content = bytes(8 * len(COLUMNS))
    for _ in range(10_000):  # five times what the ring holds
        recorder.offer_row_in_lockstep(content)
    assert 1 <= len(sleeps) <= 6
    assert recorder.dropped > 0
    recorder._process.send_signal(signal.SIGCONT)


def test_signals_that_end_a_command_do_not_end_the_recorder(tmp_path, recorder):
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        recorder._process.send_signal(number)
    assert os.getpgid(recorder._process.pid) != os.getpgid(0)
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    recorder.close()
    assert (recorder.recorded, recorder.problem) == (1, None)


def test_a_full_buffer_drops_and_counts_instead_of_blocking(tmp_path, recorder):
    recorder._process.send_signal(signal.SIGSTOP)
    raw = frame() * 50
    offered = 0
    while recorder.dropped < 10 and offered < 100_000:
        recorder.offer(Direction.IN, raw, time.monotonic_ns())
        offered += 1
    assert recorder.dropped == 10
    recorder._process.send_signal(signal.SIGCONT)
    recorder.close()
    assert recorder.recorded == offered - 10
    assert len(list(read_tlog(tmp_path / "link.tlog"))) == 50 * (offered - 10)
    assert recorder.problem is not None
    assert "10 entries are missing" in recorder.problem


def test_a_recorder_that_dies_does_not_disturb_the_flight(recorder):
    recorder._process.kill()
    recorder._process.wait()
    for _ in range(5):
        recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    recorder.close()
    assert recorder.dropped == 5
    assert recorder.problem is not None
    assert "incomplete" in recorder.problem
    recorder.offer(Direction.IN, frame(), 0)
    assert recorder.dropped == 6


def test_the_child_holds_no_socket_but_its_own(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.set_inheritable(True)
        recorder = Recorder.start(tmp_path)
        try:
            opened = [os.readlink(entry) for entry in Path(f"/proc/{recorder._process.pid}/fd").iterdir()]
            assert sum(name.startswith("socket:") for name in opened) == 1
            assert os.readlink(f"/proc/self/fd/{vehicle.fileno()}") not in opened
            assert os.getpriority(os.PRIO_PROCESS, recorder._process.pid) > os.getpriority(os.PRIO_PROCESS, 0)
        finally:
            recorder.close()


CONTROL = """
import sys, time
from pathlib import Path
from companion.record.recorder import Recorder
recorder = Recorder.start(Path(sys.argv[1]))
raw = bytes.fromhex(sys.argv[2])
for index in range(300):
    recorder.offer(0, raw, time.monotonic_ns())
recorder.note("the last words")
print(recorder._process.pid, flush=True)
time.sleep(60)
"""


def test_the_log_survives_the_death_of_the_control_process(tmp_path):
    command = [sys.executable, "-c", CONTROL, str(tmp_path), frame().hex()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as control:
        assert control.stdout is not None
        child = int(control.stdout.readline())
        control.send_signal(signal.SIGKILL)
    assert until(lambda: _ended(child))
    assert [entry.raw for entry in read_tlog(tmp_path / "link.tlog")] == [frame()] * 300
    log = ulog_reader.read(tmp_path / "flight.ulg")
    assert log.left_over == 0
    assert log.texts[-1] == (5, 0, "the last words")


def _ended(pid: int) -> bool:
    """Gone, or dead and not yet collected by whoever adopted it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_a_log_is_never_overwritten(tmp_path):
    (tmp_path / "link.tlog").write_bytes(b"another flight")
    with pytest.raises(InputError, match=r"link\.tlog: cannot be created \(File exists\)"):
        Recorder.start(tmp_path)
    assert (tmp_path / "link.tlog").read_bytes() == b"another flight"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "flight.ulg").write_bytes(b"another flight")
    with pytest.raises(InputError, match=r"flight\.ulg: cannot be created \(File exists\)"):
        Recorder.start(tmp_path / "other")
    with pytest.raises(InputError, match="No such file or directory"):
        Recorder.start(tmp_path / "missing")


def test_a_full_disk_is_said_once_and_ends_the_writing(capfd):
    full = os.open("/dev/full", os.O_WRONLY)
    writer = _DiskWriter(full, "link.tlog")
    entry = encode_datagrams([(4000, Direction.IN, [frame()])], 0)
    assert writer.put(entry)
    assert until(lambda: writer.error is not None)
    assert not writer.put(entry)
    writer.close()
    os.close(full)
    said = "link.tlog: No space left on device; nothing more is written, the flight goes on\n"
    assert capfd.readouterr().err == said


def test_a_flight_and_its_words_are_in_its_log(tmp_path, recorder):
    record = FlightRecord(60)
    recorder.note("connect: heard the autopilot")
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    offer_steps(recorder, record, 100)
    recorder.note("the flight ended", 3)
    recorder.close()
    assert (recorder.dropped, recorder.problem, record.overflow) == (0, None, 40)
    assert logged_steps(tmp_path) == [float(index) for index in range(100)]
    log = ulog_reader.read(tmp_path / "flight.ulg")
    assert [text for level, _, text in log.texts if level != 6] == ["connect: heard the autopilot", "the flight ended"]
    assert log.texts[-1][:2] == (3, 1_396_000)
    assert len(log.data["vehicle_attitude"]) == 100


def test_entries_that_nobody_can_read_are_left_out_and_counted(tmp_path, capfd):
    recorder = Recorder.start(tmp_path)
    record = FlightRecord(30)
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    offer_steps(recorder, record, 10)
    recorder.offer_row(bytes(24))  # no row
    recorder.offer_row(struct.pack("=d", math.nan) * len(COLUMNS))  # a row without a time
    recorder.offer(Entry.TEXT, b"", 0)
    recorder.offer(99, b"of a kind that is not known: nothing is missing", 0)
    offer_steps(recorder, record, 10)
    recorder.close()
    assert logged_steps(tmp_path) == [float(index) for index in range(10)] * 2
    assert recorder.recorded == 21
    assert recorder.problem == "link.tlog, flight.ulg: 3 entries are missing, the recorder was too slow"
    assert capfd.readouterr().err.count("flight.ulg: an entry is left out (error: ") == 1


def test_a_killed_recorder_leaves_a_log_up_to_the_last_second(tmp_path, recorder):
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    offer_steps(recorder, FlightRecord(100), 100)
    assert until(lambda: len(logged_steps(tmp_path)) == 100)
    recorder._process.kill()
    recorder._process.wait()
    offer_steps(recorder, FlightRecord(10), 10)
    recorder.close()
    assert logged_steps(tmp_path) == [float(index) for index in range(100)]
    assert recorder.problem is not None
    assert "flight.ulg" in recorder.problem


def test_a_full_disk_leaves_logs_that_can_be_read(tmp_path, capfd):
    """A limit of the files' size acts on the recorder like a disk that is full."""
    recorder = Recorder.start(tmp_path)
    resource.prlimit(recorder._process.pid, resource.RLIMIT_FSIZE, (50_000, resource.RLIM_INFINITY))
    record = FlightRecord(500)
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    offer_steps(recorder, record, 500)
    recorder.close()
    assert len(record) == 500
    assert recorder.problem == "link.tlog, flight.ulg: incomplete, the disk did not take everything"
    said = capfd.readouterr().err.splitlines()
    assert sorted(line.partition(":")[0] for line in said) == ["flight.ulg", "link.tlog"]
    assert all(line.endswith("nothing more is written, the flight goes on") for line in said)
    steps = logged_steps(tmp_path)
    assert steps == [float(index) for index in range(len(steps))]
    assert 0 < len(steps) < 500
    assert 0 < len(list(read_tlog(tmp_path / "link.tlog"))) < 501


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 256 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount, umount = shutil.which("mount"), shutil.which("umount")
    if os.geteuid() != 0 or mount is None or umount is None:
        pytest.skip("only root can mount a small file system")
    command = [mount, "-t", "tmpfs", "-o", "size=256k", "none", str(place)]
    made = subprocess.run(command, capture_output=True, check=False)
    if made.returncode:
        pytest.skip("no small file system can be mounted here")
    yield place
    subprocess.run([umount, "--lazy", str(place)], check=True)


def test_a_full_file_system_ends_the_logs_and_nothing_else(small_disk, capfd):
    recorder = Recorder.start(small_disk)
    record = FlightRecord(1000)
    recorder.offer(Direction.IN, frame(), time.monotonic_ns())
    offer_steps(recorder, record, 1000)
    recorder.close()
    assert (len(record), recorder.recorded is not None) == (1000, True)
    assert recorder.problem is not None
    assert "the disk did not take everything" in recorder.problem
    said = capfd.readouterr().err
    assert said.count("No space left on device; nothing more is written, the flight goes on") in {1, 2}
    steps = logged_steps(small_disk)
    assert steps == [float(index) for index in range(len(steps))]
    assert len(steps) < 1000


def test_started_by_hand_it_explains_itself():
    done = subprocess.run(
        [sys.executable, "-m", "companion.record.recorder"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert "started by `companion`" in done.stderr
