"""Writes the link's traffic to `link.tlog` from a process of its own.

The control process hands over every datagram through a ring in shared memory: no system call, nothing that blocks, and
what finds no room is dropped and counted. A pair of Unix sockets says when the log begins and ends. The child has low
priority, no socket but its end of the pair, and ignores the signals that end a command, so that neither Ctrl-C nor the
death of the control process loses the log: it writes what was handed over and ends when the pair closes.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from io import FileIO
from pathlib import Path
from typing import Final

from companion.errors import CompanionError, InputError
from companion.record import ring
from companion.record.ring import Entry, RingReader, RingWriter
from companion.record.tlog import TLOG_FILE, encode_datagram

_REPORT = struct.Struct("=QQ")  # datagrams taken, datagrams dropped by the child
_READY: Final = b"ready"
_RING_BYTES: Final = 16 << 20  # a minute and more of a usual link, should the child get no processor
_PENDING_MAX: Final = 64 << 20  # bytes that wait for a disk that does not answer
_FLUSH_S: Final = 0.5
_ROUND_S: Final = 0.05
_START_TIMEOUT_S: Final = 20.0
_NICE: Final = 10


class Recorder:
    """The control process's handle on the recorder."""

    def __init__(self, process: subprocess.Popen[bytes], link: socket.socket, writer: RingWriter) -> None:
        self._process = process
        self._link = link
        self._writer = writer
        self._put = writer.put
        self._closed = False
        self.dropped: int = 0
        """Datagrams that are not in the log, because the recorder was too slow or gone."""
        self.recorded: int | None = None
        """Datagrams that the recorder took; known after `close`, None when it did not say."""
        self.problem: str | None = None
        """After `close`: what kept the log from being complete, in one line."""

    @classmethod
    def start(cls, folder: Path) -> Recorder:
        """Start the child and wait until it listens: on the ground, before binding to a core or raising priorities.

        The relation of the monotonic to the wall clock is fixed here: a later step of the wall clock does not show in
        the log.

        Args:
            folder: the flight's folder; it must not hold a log yet.

        Raises:
            InputError: the log cannot be created.
            CompanionError: the child does not start.
        """
        path = folder / TLOG_FILE
        try:
            log = path.open("xb", buffering=0)
        except OSError as error:
            raise InputError(
                f"{path}: cannot be created ({error.strerror}); choose another folder with --out"
            ) from None
        epoch_minus_wall_ns = time.time_ns() - time.monotonic_ns()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        memory = ring.create(_RING_BYTES)
        try:
            writer = RingWriter(memory)
            process = cls._spawn(theirs, log, memory, epoch_minus_wall_ns)
        finally:
            theirs.close()
            log.close()
            os.close(memory)
        _await_ready(process, ours)
        ours.setblocking(False)
        return cls(process, ours, writer)

    @staticmethod
    def _spawn(link: socket.socket, log: FileIO, memory: int, epoch_minus_wall_ns: int) -> subprocess.Popen[bytes]:
        # The package's own root as working directory: `-m` finds the package from there, installed or not, and the
        # folder from which the command was called stays free.
        inherited = (link.fileno(), log.fileno(), memory)
        return subprocess.Popen(
            [sys.executable, "-m", __name__, *map(str, inherited), str(epoch_minus_wall_ns)],
            pass_fds=inherited,
            cwd=Path(__file__).resolve().parents[2],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )

    def offer(self, direction: int, raw: bytes, wall_ns: int) -> None:
        """Hand over one datagram (on a serial line: whole frames). Never blocks, never raises for a lost one.

        Args:
            direction: a `tlog.Direction`, or its number.
            raw: the bytes on the link.
            wall_ns: time.monotonic_ns() when they came or went.
        """
        if self._closed or not self._put(direction, raw, wall_ns):
            self.dropped += 1

    def close(self, timeout_s: float = 10.0) -> None:
        """End the log: the child writes what it has and ends. Waits for `timeout_s` at most; again does nothing."""
        if self._closed:
            return
        self._closed = True
        lost = 0
        try:
            self._link.shutdown(socket.SHUT_WR)
            self._link.settimeout(timeout_s)
            report = self._link.recv(_REPORT.size)
            if len(report) == _REPORT.size:
                self.recorded, lost = _REPORT.unpack(report)
            code = self._process.wait(timeout_s)
            if code != 0 or self.recorded is None:
                self.problem = f"{TLOG_FILE}: the recorder ended early (code {code}); the log is incomplete"
                lost += self._writer.put_count - self._writer.taken
        except (TimeoutError, subprocess.TimeoutExpired):
            self.problem = f"{TLOG_FILE}: the recorder is still writing; wait before reading the log"
        except OSError as error:
            self.problem = f"{TLOG_FILE}: the recorder is gone ({error.strerror}); the log is incomplete"
            lost = self._writer.put_count - self._writer.taken
            self._process.poll()
        finally:
            self._link.close()
        self.dropped += lost
        if self.problem is None and self.dropped:
            self.problem = f"{TLOG_FILE}: {self.dropped} datagrams are missing, the recorder was too slow"


def _await_ready(process: subprocess.Popen[bytes], link: socket.socket) -> None:
    """Wait for the child's first word. Raises CompanionError after ending it when none comes."""
    link.settimeout(_START_TIMEOUT_S)
    with contextlib.suppress(OSError):
        if link.recv(len(_READY)) == _READY:
            return
    process.kill()
    process.wait()
    link.close()
    raise CompanionError(f"the recorder of {TLOG_FILE} did not start; try `{sys.executable} -m {__name__}`")


class _DiskWriter:
    """Takes bytes at once and writes them from a thread, so that a slow disk does not stop the reading."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._pending = bytearray()
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self.error: OSError | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def put(self, entries: bytes) -> bool:
        """Keep the bytes for the disk; False when the disk failed or too much is waiting for it."""
        with self._lock:
            if self.error is not None or len(self._pending) + len(entries) > _PENDING_MAX:
                return False
            self._pending += entries
            return True

    def close(self) -> None:
        """Write what is left and stop."""
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        ended = False
        while not ended and self.error is None:
            ended = self._ending.wait(_FLUSH_S)
            with self._lock:
                entries, self._pending = self._pending, bytearray()
            if not entries:
                continue
            try:
                _write_all(self._file, entries)
            except OSError as error:
                self.error = error
                print(f"{TLOG_FILE}: {error.strerror}; no more traffic is recorded", file=sys.stderr)


def _write_all(file: int, entries: bytearray) -> None:
    """Write everything and bring it to the disk: a crash of the vehicle often ends with its power."""
    view = memoryview(entries)
    while view:
        view = view[os.write(file, view) :]
    with contextlib.suppress(OSError):  # not every kind of file can be synchronised
        os.fdatasync(file)


def _receive(link: socket.socket, reader: RingReader, writer: _DiskWriter, epoch_minus_wall_ns: int) -> int:
    """Take datagrams until the other side closes; returns how many of them had to be dropped.

    This process looks from time to time instead of waiting: handing over a datagram then wakes nobody and costs the
    control process less.
    """
    dropped = 0

    def write(entries: Iterable[Entry]) -> None:
        nonlocal dropped
        for wall_ns, direction, raw in entries:
            epoch_us = (wall_ns + epoch_minus_wall_ns) // 1000
            dropped += not writer.put(encode_datagram(raw, epoch_us, direction))

    while not select.select([link], [], [], _ROUND_S)[0]:
        write(reader.take())
    write(reader.take_rest())
    return dropped


def _lower_priority() -> None:
    """Get out of the control loop's way, also when it was started with real-time priority."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(_NICE)


def main(arguments: list[str]) -> int:
    """The child: inherited socket, file and memory by number, and what turns monotonic into epoch nanoseconds."""
    if len(arguments) != 4:
        print("This program is started by `companion`; it records the traffic of a flight.", file=sys.stderr)
        return 2
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    _lower_priority()
    log = int(arguments[1])
    reader = RingReader(int(arguments[2]))
    with socket.socket(fileno=int(arguments[0])) as link:
        writer = _DiskWriter(log)
        with contextlib.suppress(OSError):  # the control process died meanwhile: the end of the pair follows
            link.send(_READY)
        dropped = _receive(link, reader, writer, int(arguments[3]))
        writer.close()
        with contextlib.suppress(OSError):  # nobody listens when the control process died
            link.send(_REPORT.pack(reader.taken - dropped, dropped))
    return 0 if writer.error is None else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
