"""Writes the link's traffic to `link.tlog` and the flight to `flight.ulg` from a process of its own.

The control process hands over every datagram, every row of its record and every text through a ring in shared memory:
no system call, nothing that blocks, and what finds no room is dropped and counted. A pair of Unix sockets says when the
logs begin and end. The child has low priority, no socket but its end of the pair, and ignores the signals that end a
command, so that neither Ctrl-C nor the death of the control process loses the logs: it writes what was handed over and
ends when the pair closes. One of the files may fail without the other.
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
from collections.abc import Callable, Iterator, Sequence
from io import FileIO
from pathlib import Path
from typing import Final

from companion.errors import CompanionError, InputError
from companion.link.codec import dialect
from companion.realtime import rejoin
from companion.record import ring
from companion.record.flight_log import Entry, FlightLog, Level
from companion.record.ring import RingReader, RingWriter
from companion.record.tlog import TLOG_FILE, Direction, encode_datagrams, split_frames
from companion.record.ulog import ULOG_FILE

_REPORT = struct.Struct("=QQQ")  # datagrams in link.tlog, datagrams dropped by the child, entries not in flight.ulg
_READY: Final = b"ready"
_RING_BYTES: Final = 24 << 20  # a minute and a half of a usual link, should the child get no processor
_PENDING_MAX: Final = 64 << 20  # bytes that wait for a disk that does not answer
_FLUSH_S: Final = 0.5
_ROUND_S: Final = 0.1
_START_TIMEOUT_S: Final = 20.0
_NICE: Final = 10
_LOOK_EVERY: Final = 256  # rows
_NEARLY_FULL: Final = 0.875
_ROOM_AGAIN: Final = 0.76  # the child goes on down to three quarters, and may rest there
_WAIT_MAX_S: Final = 0.5
_WAIT_STEP_S: Final = 0.01
_ROW: Final = int(Entry.ROW)
_DIRECTIONS: Final = {int(Direction.IN), int(Direction.OUT)}
_FAILED_TLOG: Final = 64  # bits of the exit code; the interpreter's own failures are 1 and 2
_FAILED_ULOG: Final = 128


class Recorder:
    """The control process's handle on the recorder."""

    def __init__(self, process: subprocess.Popen[bytes], link: socket.socket, writer: RingWriter) -> None:
        self._process = process
        self._link = link
        self._writer = writer
        self._closed = False
        self._lost = 0
        self._rows = 0
        self._stuck = False
        self.offer: Callable[[int, bytes, int], object] = writer.put
        """Hand over one datagram (on a serial line: whole frames). Never blocks, never raises for a lost one.

        Arguments: a `tlog.Direction` or its number; the bytes on the link; time.monotonic_ns() when they came or went.
        It is the ring's own method: a call between would cost as much as what it does.
        """
        self.recorded: int | None = None
        """Datagrams that the recorder took; known after `close`, None when it did not say."""
        self.problem: str | None = None
        """After `close`: what kept the logs from being complete, in one line."""

    @classmethod
    def start(cls, folder: Path) -> Recorder:
        """Start the child and wait until it listens: on the ground, before binding to a core or raising priorities.

        The relation of the monotonic to the wall clock is fixed here: a later step of the wall clock does not show in
        the log.

        Args:
            folder: the flight's folder; it must not hold logs yet. Its flight.toml goes into the log as it is.

        Raises:
            InputError: a log cannot be created.
            CompanionError: the child does not start.
        """
        from companion.record.folder import CONFIGURATION_FILE  # not for the child, which starts this module too

        tlog, log = _create(folder / TLOG_FILE), _create(folder / ULOG_FILE)
        epoch_minus_wall_ns = time.time_ns() - time.monotonic_ns()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        memory = ring.create(_RING_BYTES)
        try:
            writer = RingWriter(memory)
            process = cls._spawn(theirs, tlog, log, memory, epoch_minus_wall_ns, folder / CONFIGURATION_FILE)
        finally:
            theirs.close()
            tlog.close()
            log.close()
            os.close(memory)
        _await_ready(process, ours)
        ours.setblocking(False)
        return cls(process, ours, writer)

    @staticmethod
    def _spawn(
        link: socket.socket, tlog: FileIO, log: FileIO, memory: int, epoch_minus_wall_ns: int, configuration: Path
    ) -> subprocess.Popen[bytes]:
        # The package's own root as working directory: `-m` finds the package from there, installed or not, and the
        # folder from which the command was called stays free.
        inherited = (link.fileno(), tlog.fileno(), log.fileno(), memory)
        arguments = (*map(str, inherited), str(epoch_minus_wall_ns), str(configuration.resolve()))
        return subprocess.Popen(
            [sys.executable, "-m", __name__, *arguments],
            pass_fds=inherited,
            cwd=Path(__file__).resolve().parents[2],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._process.pid

    @property
    def dropped(self) -> int:
        """Datagrams, rows and texts that are not in the logs, because the recorder was too slow or gone."""
        return self._writer.refused + self._lost

    @property
    def behind(self) -> int:
        """Entries that the child has not taken yet."""
        return self._writer.waiting

    def offer_row(self, row: bytes) -> None:
        """Hand over the bytes of a row of the flight's record, as `FlightRecord.sink` gives them. Never blocks."""
        self.offer(_ROW, row, 0)

    def offer_row_in_lockstep(self, row: bytes) -> None:
        """The same where the vehicle waits for us: a ring that is nearly full is waited for, and nothing is missing.

        For half a second at most, which the vehicle bears, and not again where the child has taken nothing meanwhile.
        """
        self.offer(_ROW, row, 0)
        self._rows += 1
        if self._rows % _LOOK_EVERY == 0 and self._writer.used > _NEARLY_FULL and not self._stuck:
            taken, end_s = self._writer.taken, time.monotonic() + _WAIT_MAX_S
            while self._writer.used > _ROOM_AGAIN and time.monotonic() < end_s:
                time.sleep(_WAIT_STEP_S)
            self._stuck = self._writer.taken == taken

    def note(self, text: str, level: int = Level.NOTICE) -> None:
        """Hand over a line for the log: what happened to the flight. Never blocks; the time is that of the traffic."""
        self.offer(Entry.TEXT, bytes((level,)) + text.encode("utf-8", "replace"), 0)

    def state(self, key: str, fact: str) -> None:
        """Hand over what is known under a key from now on, for the log. Never blocks.

        The last one of a key counts; of "delays" all of them, one after the other.
        """
        self.offer(Entry.FACT, f"{key}\0{fact}".encode("utf-8", "replace"), 0)

    def follow(self, system: int) -> None:
        """Tell whose the flight is: the autopilot's system id. Never blocks.

        Without this the log follows the first autopilot that sends a heartbeat; one that was known before the recorder
        was started may send others first.
        """
        self.offer(Entry.SYSTEM, bytes((system,)), 0)

    def give_way(self) -> None:
        """The vehicle is in lockstep: the logs are written whenever three quarters of the ring are full, all of it at
        once, and at the end: the child leaves the processors to the two processes that wait for each other."""
        self._writer.be_patient()

    def close(self, timeout_s: float = 30.0) -> None:
        """End the logs: the child writes what it has and ends. Waits for `timeout_s` at most; again does nothing."""
        if self._closed:
            return
        self._closed = True
        self._writer.close()
        lost = missing = 0
        both = f"{TLOG_FILE}, {ULOG_FILE}"
        try:
            self._link.shutdown(socket.SHUT_WR)
            self._link.settimeout(timeout_s)
            report = self._link.recv(_REPORT.size)
            if len(report) == _REPORT.size:
                self.recorded, lost, missing = _REPORT.unpack(report)
            code = self._process.wait(timeout_s)
            if self.recorded is None or code & ~(_FAILED_TLOG | _FAILED_ULOG):
                self.problem = f"{both}: the recorder ended early (code {code}); the logs are incomplete"
                lost = self._writer.waiting
            elif code:
                failed = [name for bit, name in ((_FAILED_TLOG, TLOG_FILE), (_FAILED_ULOG, ULOG_FILE)) if code & bit]
                self.problem = f"{', '.join(failed)}: incomplete, the disk did not take everything"
        except (TimeoutError, subprocess.TimeoutExpired):
            self.problem = f"{both}: the recorder is still writing; wait before reading the logs"
        except OSError as error:
            self.problem = f"{both}: the recorder is gone ({error.strerror}); the logs are incomplete"
            lost = self._writer.waiting
            self._process.poll()
        finally:
            self._link.close()
        self._lost = lost
        if self.problem is None and (self.dropped or missing):
            count = max(self.dropped, missing)
            self.problem = f"{both}: {count} entries are missing, the recorder was too slow"


def _create(path: Path) -> FileIO:
    """A new file, or an InputError."""
    try:
        return path.open("xb", buffering=0)
    except OSError as error:
        raise InputError(f"{path}: cannot be created ({error.strerror}); choose another folder with --out") from None


def _await_ready(process: subprocess.Popen[bytes], link: socket.socket) -> None:
    """Wait for the child's first word. Raises CompanionError after ending it when none comes."""
    link.settimeout(_START_TIMEOUT_S)
    with contextlib.suppress(OSError):
        if link.recv(len(_READY)) == _READY:
            return
    process.kill()
    process.wait()
    link.close()
    raise CompanionError(f"the recorder of {ULOG_FILE} did not start; try `{sys.executable} -m {__name__}`")


class _DiskWriter:
    """Takes bytes at once and writes them from a thread, so that a slow disk does not stop the reading."""

    def __init__(self, file: int, name: str) -> None:
        self._file = file
        self._name = name
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
                print(f"{self._name}: {error.strerror}; nothing more is written, the flight goes on", file=sys.stderr)


def _write_all(file: int, entries: bytearray) -> None:
    """Write everything and bring it to the disk: a crash of the vehicle often ends with its power."""
    view = memoryview(entries)
    while view:
        view = view[os.write(file, view) :]
    with contextlib.suppress(OSError):  # not every kind of file can be synchronised
        os.fdatasync(file)


_Datagram = tuple[int, int, list[bytes]]  # as a `ring.Entry`, with the frames that are in it


class _TrafficFile:
    """link.tlog."""

    def __init__(self, file: int, epoch_minus_wall_ns: int) -> None:
        self.writer = _DiskWriter(file, TLOG_FILE)
        self.dropped = 0
        """Datagrams that the disk did not take."""
        self.taken = 0
        """Datagrams in the file."""
        self._epoch_minus_wall_ns = epoch_minus_wall_ns

    def take(self, datagrams: Sequence[_Datagram]) -> None:
        """Hands datagrams to the disk: all of them, or nothing."""
        if self.writer.put(encode_datagrams(datagrams, self._epoch_minus_wall_ns)):
            self.taken += len(datagrams)
        else:
            self.dropped += len(datagrams)


class _FlightFile:
    """flight.ulg. Whatever goes wrong with it leaves the traffic's log alone."""

    def __init__(self, file: int, log: FlightLog) -> None:
        self.writer = _DiskWriter(file, ULOG_FILE)
        self.missing = 0
        """Entries that are not in the file."""
        self._log = log
        self._unreadable = 0

    def take(self, entries: Sequence[ring.Entry]) -> list[_Datagram]:
        """Hands what entries amount to to the disk: whole messages, or nothing of them.

        Returns:
            The datagrams among them.
        """
        take, take_frames = self._log.take, self._log.take_frames
        datagrams = []
        left_out = 0
        for wall_ns, kind, content in entries:
            try:
                if kind in _DIRECTIONS:
                    frames = split_frames(content)
                    datagrams.append((wall_ns, kind, frames))
                    take_frames(kind, frames, wall_ns)
                else:
                    take(kind, content, wall_ns)
            except Exception as error:
                left_out += 1
                self._say_once(error)
        self.missing += left_out
        self._hand_over(self._log.taken(), len(entries) - left_out)
        return datagrams

    def _say_once(self, error: Exception) -> None:
        self._unreadable += 1
        if self._unreadable == 1:
            print(f"{ULOG_FILE}: an entry is left out ({type(error).__name__}: {error})", file=sys.stderr)

    def _hand_over(self, content: bytes, count: int) -> None:
        if content and not self.writer.put(content):
            self.missing += count

    def refused(self, count: int) -> None:
        """So many entries found no room in the ring."""
        self._log.missed(count + self.missing)

    def end(self) -> None:
        """The end of the flight."""
        self._hand_over(self._log.end(), 1)


def _receive(link: socket.socket, reader: RingReader, traffic: _TrafficFile, flight: _FlightFile) -> None:
    """Take entries until the other side closes.

    This process looks from time to time instead of waiting: handing over an entry then wakes nobody and costs the
    control process less.
    """

    def write(batches: Iterator[list[ring.Entry]]) -> None:
        for batch in batches:
            traffic.take(flight.take(batch))
        flight.refused(reader.refused)

    while not select.select([link], [], [], _ROUND_S)[0]:
        if not reader.may_wait:
            write(reader.take())
    write(reader.take_rest())
    flight.end()


def _lower_priority() -> None:
    """Get out of the control loop's way, also when it was started with real-time priority."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(_NICE)


def main(arguments: list[str]) -> int:
    """The child: inherited socket, files and memory by number, what turns monotonic into epoch nanoseconds, and the
    path of the flight's configuration."""
    if len(arguments) != 6:
        print("This program is started by `companion`; it records the traffic of a flight.", file=sys.stderr)
        return 2
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    rejoin()
    _lower_priority()
    pair, tlog, log, memory, epoch_minus_wall_ns = map(int, arguments[:5])
    reader = RingReader(memory)
    with socket.socket(fileno=pair) as link:
        traffic = _TrafficFile(tlog, epoch_minus_wall_ns)
        flight = _FlightFile(log, FlightLog(_configuration(Path(arguments[5])), epoch_minus_wall_ns))
        with contextlib.suppress(OSError):  # the control process died meanwhile: the end of the pair follows
            link.send(_READY)
        with contextlib.suppress(ImportError):  # on the ground, and not when the first seldom message comes
            dialect()
        _receive(link, reader, traffic, flight)
        traffic.writer.close()
        flight.writer.close()
        with contextlib.suppress(OSError):  # nobody listens when the control process died
            link.send(_REPORT.pack(traffic.taken, traffic.dropped, flight.missing))
    return _FAILED_TLOG * (traffic.writer.error is not None) | _FAILED_ULOG * (flight.writer.error is not None)


def _configuration(path: Path) -> str:
    """The flight's configuration; a log without it is better than none."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
