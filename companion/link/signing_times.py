"""Signing times across restarts: what has been sent is never sent again, what was accepted is never accepted again.

Every process that uses a key has a place of its own in the folder of that key, locked while it lives, with a link id of
its own. A place begins after everything that any place of the key has on the disk. On the disk is more than was used:
times up to `RESERVE_S` ahead count as used when the process did not end in order, of everybody's messages too, because
what came in its last seconds is not there. Everybody who hears us takes our time over, so nobody is locked out by that
but for who does not hear us, for so long. What only may have been used is not reserved on top of again: processes that
end soon and out of order, one after the other, would lock those out for longer every time.

The disk is written every few seconds by a thread that sleeps otherwise: a write can take longer than control steps.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from companion.errors import InputError
from companion.link.key_file import load_key
from companion.link.signing import NS_PER_UNIT, TIME_END, UNITS_PER_S, Signer, SigningKey, SigningTimes, time_now

KEEP_EVERY_S: Final = 5.0
RESERVE_S: Final = 15.0
PLACES_MAX: Final = 64
"""Processes that may use one key at the same time on one machine."""
_RESERVE: Final = int(RESERVE_S * UNITS_PER_S)
_SIGNED: Final = UNITS_PER_S
"""Signing takes less than this until the next writing, while time is ahead of the clock: one unit for a frame."""
_LOOK_S: Final = 1.0


def state_folder() -> Path:
    """Where the times of all keys are: systemd's StateDirectory, or the user's folder for state."""
    systemd = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if systemd:
        return Path(systemd) / "signing"
    own = os.environ.get("XDG_STATE_HOME", "")
    base = Path(own) if own.startswith("/") else Path.home() / ".local" / "state"
    return base / "offboard-companion" / "signing"


class KeptSigner(Signer):
    """A signer whose times survive the process; a context manager."""

    def __init__(self, key: SigningKey, place: Place) -> None:
        self._place = place
        super().__init__(key, place.load())
        self._begun = self.times.newest
        self._done = False
        self._wake = threading.Event()
        self.problem = ""
        """Why the times cannot be kept at present."""
        self._storing = threading.Lock()
        self.keep()
        if self.problem:
            place.release()
            raise InputError(f"signing times: {self.problem}; without them a recording could be replayed")
        self._thread = threading.Thread(target=self._run, name="signing times", daemon=True)
        self._thread.start()

    def keep(self) -> None:
        """Writes the times, and those ahead that count as used, to the disk; from any thread."""
        now = self.now()
        used = max(self._used(), (self._zero_ns + time.monotonic_ns()) // NS_PER_UNIT)
        reserved = max(used + _RESERVE, now + _SIGNED)
        try:
            with self._storing:
                self._place.store(self.times, used, reserved, ended=False)
            self.times.reserved = reserved
            self.problem = ""
        except OSError as error:
            self.problem = f"{self._place.path}: cannot be written ({error.strerror})"

    def _used(self) -> int:
        """The latest time that was really sent or accepted, as far as is known."""
        times = self.times
        last = times.newest if times.newest > self._begun else times.used
        return max(last, *times.streams.copy().values(), 0)

    def _passed(self) -> None:
        self._wake.set()

    def _run(self) -> None:
        kept_s = time.monotonic()
        while True:
            self._wake.wait(_LOOK_S)
            self._wake.clear()
            if self._done:
                return
            now_s = time.monotonic()
            if now_s - kept_s >= KEEP_EVERY_S or self.now() > self.times.reserved - _SIGNED // 2:
                kept_s = now_s
                self.keep()

    def close(self) -> None:
        """Ends in order: nothing more is signed or verified, and nothing ahead counts as used."""
        if self._done:
            return
        self._done = True
        self._wake.set()
        self._thread.join()
        used = self._used()
        with contextlib.suppress(OSError):  # then the reserve counts as used
            self._place.store(self.times, used, used, ended=True)
        self._place.release()

    def __enter__(self) -> KeptSigner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Place:
    """The file of one process in the folder of one key.

    Raises:
        InputError: the folder cannot be used, or all places are taken.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            folder.chmod(0o700)
            self.path, self._lock = self._take()
        except OSError as error:
            raise InputError(f"signing times: {folder}: cannot be used ({error.strerror})") from None

    def _take(self) -> tuple[Path, int]:
        for number in range(PLACES_MAX):
            path = self._folder / f"{number}.json"
            lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(lock)
                continue
            return path, lock
        raise InputError(f"signing times: {self._folder}: {PLACES_MAX} processes use this key already")

    def load(self) -> SigningTimes:
        """The times to begin with.

        Raises:
            InputError: a file there is damaged.
        """
        times = SigningTimes(newest=time_now(), streams={}, link_id=-1)
        taken = set()
        for path, kept in self._all():
            alive = path != self.path and self._is_alive(path)  # which knows its own times, and ends on its own
            times.used = max(times.used, kept["newest"])
            times.floor = max(times.floor, kept.get("floor", -1))  # of one who began after a crash, and goes on
            if not kept["ended"] and not alive:
                times.floor = max(times.floor, kept["reserved"])
            times.newest = max(times.newest, kept["newest"] if alive else kept["reserved"], times.floor)
            for stream, last in kept["streams"].items():
                times.streams[int(stream)] = max(times.streams.get(int(stream), 0), last)
            if path == self.path:
                times.link_id = kept["link_id"]
            else:
                taken.add(kept["link_id"])
        if times.link_id < 0:
            times.link_id = next(number for number in os.urandom(4096) if number not in taken)
        return times

    def _is_alive(self, path: Path) -> bool:
        """Whether the process of another place is there."""
        lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: two who look at once are not each other's life
        except BlockingIOError:
            return True
        finally:
            os.close(lock)
        return False

    def _all(self) -> Iterator[tuple[Path, dict[str, Any]]]:
        for path in sorted(self._folder.glob("*.json")):
            try:
                kept = json.loads(path.read_text())
                numbers = (kept["newest"], kept["reserved"], *kept["streams"].values(), *map(int, kept["streams"]))
                if not all(isinstance(number, int) and 0 <= number <= TIME_END for number in numbers):
                    raise ValueError
                if not isinstance(floor := kept.get("floor", -1), int) or not -1 <= floor <= TIME_END:
                    raise ValueError
                if kept["link_id"] not in range(256) or not isinstance(kept["ended"], bool):
                    raise ValueError
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                raise InputError(
                    f"signing times: {path}: is damaged; without it a recording could be replayed. With a new key"
                    " (`companion key new`, `companion key install`) it is not needed any more"
                ) from None
            yield path, kept

    def store(self, times: SigningTimes, newest: int, reserved: int, *, ended: bool) -> None:
        """Writes: the old file stays until the new one is on the disk as a whole.

        Raises:
            OSError: it cannot be written.
        """
        newest, reserved = min(newest, TIME_END), min(reserved, TIME_END)  # what is later would count as damaged
        kept = {
            **{"newest": newest, "reserved": reserved, "ended": ended, "link_id": times.link_id},
            "floor": times.floor,
            "streams": {str(stream): last for stream, last in times.streams.copy().items()},
        }
        beside = self.path.with_suffix(".new")
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600), "w") as file:
            file.write(json.dumps(kept))
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, self.path)
        folder = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def release(self) -> None:
        """Lets another process have the place."""
        os.close(self._lock)


def open_signer(key_file: str | None) -> KeptSigner | None:
    """The signer for a key file, with its times; None without a file.

    Raises:
        InputError: the key file or the folder of the times cannot be used.
    """
    if key_file is None:
        return None
    key = load_key(key_file)
    return KeptSigner(key, Place(state_folder() / key.fingerprint))
