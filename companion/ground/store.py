"""The trajectories on the vehicle: one folder of files that the vehicle's own check has seen.

What arrives goes to a hidden file first, is checked there, and takes its name by a rename: an upload that is cut off
or refused leaves no half file, and the trajectory that had the name before stays as it is. No sockets, no threads, no
waiting: a check runs apart (`examine`), and `update` takes in what came of it.

What somebody changes in the folder by hand is noticed when it is asked for, by size and time of change: such a file is
read anew, and not accepted until it is checked again.

Hidden files: `.part-NAME` is an upload that is under way, or was cut off and can be gone on with; `.check-N-NAME` is
one that is being checked; `.catalogue.json` is what is known of the others; `.lock` keeps a second store out.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import time
from collections import deque
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.ground.by_hand import FileState, Newcomers, file_state
from companion.ground.catalogue import Catalogue, Entry, file_crc32, sync_folder
from companion.ground.checks import Checks, Job, Submission
from companion.ground.examine import Examiner, Finding
from companion.ground.folder_lock import FolderLock
from companion.ground.names import StoreError, usable
from companion.ground.staging import Upload

NOT_CHECKED: Final = "not checked yet"
BEGINNING: Final = "it is the beginning of the file that is stored: remove that one first, or use `companion upload`"
_PART, _CHECK = ".part-", ".check-"
_RECENT_MAX = 8
_QUEUE_MAX = 8
_NAMING_BYTES_MAX = 1 << 20
"""A file of ours that names another one is shorter than this."""
_READ_BYTES = 8 << 20
"""Of files that changed by hand so much is read in one turn, and the file that this ends in: some milliseconds."""


class Limits(NamedTuple):
    """How much the store takes."""

    files: int = 200
    file_bytes: int = 32 << 20
    """The longest trajectory file that is read at all."""
    total_bytes: int = 256 << 20
    """With uploads that are under way or were cut off."""
    uploads: int = 16
    """At the same time."""
    parts: int = 8
    """Uploads that were cut off and are kept to be gone on with; the oldest goes first."""


DEFAULT_LIMITS: Final = Limits()


class TrajectoryStore:
    """One folder of trajectory files."""

    def __init__(
        self,
        folder: Path,
        examiner: Examiner,
        limits: Limits = DEFAULT_LIMITS,
        checked_by: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the folder, making it if need be; see what is in it.

        Args:
            folder: belongs to this store; files that others put there are found, numbered and checked, too.
            examiner: the vehicle's own check, see `examine.Apart` and `examine.Here`.
            limits: how much is taken.
            checked_by: what a verdict depends on beside the file; verdicts given under another one are given anew.
            clock: seconds, for how often to look for new files.

        Raises:
            InputError: another process has it open.
            OSError: the folder cannot be made, read or written.
        """
        self.folder = folder
        self.limits = limits
        self._checked_by = checked_by
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = FolderLock(folder)
        self._catalogue = Catalogue(folder)
        self._live: dict[str, Upload] = {}
        self._parts: dict[str, int] = {}
        """Sizes of the uploads that were cut off [bytes], by name, oldest first."""
        self._checks = Checks(examiner)
        self._recent: deque[Submission] = deque(maxlen=_RECENT_MAX)
        self._serial = 0
        self._newcomers = Newcomers(folder, clock)
        self._unread: dict[str, None] = {}
        """Names of files that changed or came by hand and are still to be read, in their order."""
        try:
            self._scan()
        except BaseException:
            self._lock.release()
            raise

    @property
    def problem(self) -> str:
        """Why another process may use the folder, too; "" where it may not."""
        return self._lock.problem

    # ---- what is there ---------------------------------------------------------------------------------------------

    def entries(self) -> list[Entry]:
        """All stored files, by number; not those of which too many changed at once to be read yet."""
        self._look()
        self._read_some()
        return sorted(entry for name, entry in self._catalogue.entries.items() if name not in self._unread)

    def entry(self, name: str) -> Entry:
        """The stored file of that name.

        Raises:
            StoreError: there is none.
        """
        self._look()
        found = self._current(name)
        if found is None:
            raise StoreError(errno.ENOENT, f"{name}: there is no such file")
        return found

    def numbered(self, number: int) -> Entry | None:
        """The stored file with that number."""
        self._look()
        name = next((entry.name for entry in self._catalogue.entries.values() if entry.id == number), None)
        return None if name is None else self._current(name)

    def path(self, name: str) -> Path:
        """Where a stored file is.

        Raises:
            StoreError: there is none of that name.
        """
        return self.folder / self.entry(name).name

    def open(self, name: str) -> tuple[int, Entry]:
        """A descriptor to read a stored file from, the caller's to close: it stays the file that it is now.

        Raises:
            StoreError: there is none of that name.
            OSError: it cannot be opened.
        """
        entry = self.entry(name)
        return os.open(self.folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), entry

    def index(self) -> bytes:
        """`/index.json`: what is stored, and how the last uploads ended."""
        files = [
            {
                "id": entry.id,
                "name": entry.name,
                "size_bytes": entry.size_bytes,
                "crc32": entry.crc32,
                "accepted": entry.accepted,
                "verdict": entry.verdict,
            }
            for entry in self.entries()
        ]
        document = {"trajectories": files, "uploads": [_told(submission) for submission in self._recent]}
        return json.dumps(document, ensure_ascii=False).encode()

    # ---- changes ---------------------------------------------------------------------------------------------------

    def remove(self, name: str) -> None:
        """Remove a stored file, and what was cut off of an upload under its name.

        Raises:
            StoreError: there is none of that name.
            OSError: it cannot be removed.
        """
        self.entry(name)
        (self.folder / name).unlink(missing_ok=True)
        if name not in self._live:
            self._drop_part(name)
        del self._catalogue.entries[name]
        self._recheck_users([name])
        self._save()

    def rename(self, old: str, new: str) -> None:
        """Give a stored file another name; its number stays. With another ending it is checked anew.

        Raises:
            StoreError: there is none of that name, or one of the new name.
            OSError: it cannot be renamed.
        """
        entry = self.entry(old)
        if new in self._catalogue.entries or os.path.lexists(self.folder / new):  # also one that nobody told us of
            raise StoreError(errno.EEXIST, f"{new}: there is a file of that name already")
        os.rename(self.folder / old, self.folder / new)
        del self._catalogue.entries[old]
        same = Path(old).suffix == Path(new).suffix
        changed = entry._replace(name=new) if same else entry._replace(name=new, accepted=None, verdict=NOT_CHECKED)
        self._catalogue.entries[new] = changed
        self._save()
        if changed.accepted is None:
            self._recheck(new)
        self._recheck_users([old, new])

    # ---- uploads ---------------------------------------------------------------------------------------------------

    def begin(self, name: str, *, resume: bool = False) -> Upload:
        """Begin an upload, or go on with one that was cut off.

        Args:
            name: checked by `names.checked_name`.
            resume: keep what is there of it already.

        Raises:
            StoreError: no room, or somebody else uploads under that name.
            OSError: the disk does not take it.
        """
        if name in self._live:
            raise StoreError(errno.EBUSY, f"{name}: is being uploaded by somebody else")
        if len(self._live) >= self.limits.uploads:
            raise StoreError(errno.EMFILE, f"more than {self.limits.uploads} uploads at a time are not taken")
        coming = {job.name for job in self._checks.submitted()} | set(self._live) | {name}
        if len(self._catalogue.entries.keys() | coming) > self.limits.files:
            raise StoreError(errno.EDQUOT, f"{self.limits.files} files are stored, which is the most; remove some")
        upload = Upload(name, self.folder / f"{_PART}{name}", self.limits.file_bytes, resume=resume)
        self._parts.pop(name, None)
        self._live[name] = upload
        return upload

    def write(self, upload: Upload, offset: int, data: bytes) -> None:
        """Take one block of an upload.

        Raises:
            StoreError: no room, or too long.
            OSError: the disk does not take it.
        """
        growth = offset + len(data) - upload.extent
        if growth > 0 and self._used_bytes() + growth > self.limits.total_bytes:
            upload.failed = True
            raise StoreError(errno.EDQUOT, f"the store has no room for {upload.name}: remove other files")
        upload.write(offset, data)

    def leave(self, upload: Upload) -> None:
        """End an upload that is not complete; what is there of it is kept for `begin(..., resume=True)`."""
        if self._live.get(upload.name) is not upload:
            return
        del self._live[upload.name]
        received = upload.received
        with contextlib.suppress(OSError):
            upload.close()
        if received:
            self._parts[upload.name] = received
        while len(self._parts) > self.limits.parts:
            self._drop_part(next(iter(self._parts)))

    def submit(self, upload: Upload, expected: tuple[int, int] | None) -> Submission:
        """End an upload that is complete: it is checked, and stored when the check accepts it.

        Args:
            upload: what `begin` gave.
            expected: size [bytes] and checksum of the whole, from a sender that says them.

        Raises:
            StoreError: it is not complete (and can be gone on with), or too many wait for a check already.
            OSError: the disk does not take it.
        """
        missing = upload.missing(expected)
        if missing is None and expected is None and self._shortens(upload):
            missing = BEGINNING
        if missing is None and len(self._checks.submitted()) >= _QUEUE_MAX:
            missing = "too many files wait to be checked"
        if missing is not None:
            self.leave(upload)
            raise StoreError(errno.EAGAIN, f"{upload.name}: {missing}")
        del self._live[upload.name]
        submission = Submission(upload.name, upload.received, upload.crc32)
        self._serial += 1
        checked = self.folder / f"{_CHECK}{self._serial}-{upload.name}"
        upload.close(whole=True)
        os.rename(upload.path, checked)
        self._recent.append(submission)
        self._checks.add(Job(checked, upload.name, submission))
        self.update()
        return submission

    def update(self) -> None:
        """Take in what the check found, and begin the next one. To be called often; never waits for a check."""
        self._read_some()
        while (done := self._checks.next()) is not None:
            job, finding = done
            if job.submission is None:
                self._judge(job, finding)
            else:
                self._settle(job, job.submission, finding)

    def close(self) -> None:
        """End what is under way and let another store have the folder; uploads are kept to be gone on with."""
        for upload in list(self._live.values()):
            self.leave(upload)
        self._checks.close()
        self._lock.release()

    def _shortens(self, upload: Upload) -> bool:
        """Whether an upload is the beginning of what is stored under its name, or about to be."""
        before = [job.path for job in self._checks.submitted() if job.name == upload.name]
        return any(upload.begins(path) for path in [self.folder / upload.name, *before])

    # ---- within ----------------------------------------------------------------------------------------------------

    def _settle(self, job: Job, submission: Submission, finding: Finding) -> None:
        """Store an upload, or throw it away."""
        submission.finding = finding
        if finding.accepted:
            try:
                self._store(job, submission, finding)
                return
            except OSError as error:
                submission.finding = Finding(False, f"{job.name} could not be stored: {error.strerror}")
        with contextlib.suppress(OSError):
            job.path.unlink(missing_ok=True)

    def _store(self, job: Job, submission: Submission, finding: Finding) -> None:
        """Give a checked file its name."""
        name = job.name
        known = self._catalogue.entries.get(name)
        number = self._catalogue.number() if known is None else known.id
        entry = self._entry(number, name, job.path, submission.crc32, finding)
        os.replace(job.path, self.folder / name)
        self._catalogue.entries[name] = entry
        self._unread.pop(name, None)
        submission.id = number
        with contextlib.suppress(OSError):  # the file is whole in any case; only a loss of power could undo its name
            sync_folder(self.folder)
        self._recheck_users([name])
        self._save()

    def _recheck(self, name: str) -> None:
        """Have a stored file checked anew."""
        known = self._catalogue.entries[name]
        self._catalogue.entries[name] = known._replace(accepted=None, verdict=NOT_CHECKED)
        self._checks.add(Job(self.folder / name, name, mtime_ns=known.mtime_ns))

    def _recheck_users(self, names: list[str]) -> None:
        """Have the files checked anew that name others, which have changed."""
        if not names:
            return
        changed = [name.encode() for name in names]
        for entry in sorted(self._catalogue.entries.values()):
            ours = entry.name.lower().endswith(".toml") and entry.size_bytes <= _NAMING_BYTES_MAX
            if ours and entry.name not in names:
                with contextlib.suppress(OSError):
                    text = (self.folder / entry.name).read_bytes()
                    if any(name in text for name in changed):
                        self._recheck(entry.name)

    def _judge(self, job: Job, finding: Finding) -> None:
        """Write down what was found about a file that is there already."""
        name = job.name
        known = self._catalogue.entries.get(name)
        if known is None or known.accepted is not None or known.mtime_ns != job.mtime_ns:
            return  # it has been replaced or removed meanwhile
        if self._state(name) != (known.size_bytes, known.mtime_ns):
            return  # nobody knows which contents were checked; the next look has the new ones checked
        self._catalogue.entries[name] = known._replace(
            accepted=finding.accepted, verdict=finding.verdict, checked_by=self._checked_by
        )
        self._save()

    def _entry(self, number: int, name: str, path: Path, crc: int, finding: Finding) -> Entry:
        found = path.stat()
        return Entry(
            number, name, found.st_size, found.st_mtime_ns, crc, finding.accepted, finding.verdict, self._checked_by
        )

    def _save(self) -> None:
        """Write the catalogue; without it the files are only numbered anew after a restart."""
        with contextlib.suppress(OSError):
            self._catalogue.write()

    def _used_bytes(self) -> int:
        stored = sum(entry.size_bytes for entry in self._catalogue.entries.values())
        waiting = sum(job.submission.size_bytes for job in self._checks.submitted() if job.submission is not None)
        return stored + waiting + sum(self._parts.values()) + sum(upload.extent for upload in self._live.values())

    def _drop_part(self, name: str) -> None:
        if self._parts.pop(name, None) is not None:
            (self.folder / f"{_PART}{name}").unlink(missing_ok=True)

    # ---- what others did to the folder -----------------------------------------------------------------------------

    def _state(self, name: str) -> FileState | None:
        return file_state(f"{self.folder}/{name}", self.limits.file_bytes)  # for all of them at once: Path is slow

    def _look(self) -> None:
        """Notice what somebody did by hand since the last look. Files are read later: this takes a moment only."""
        entries = self._catalogue.entries
        gone, changed = [], []
        for name, entry in entries.items():
            state = self._state(name)
            if state is None:
                gone.append(name)
            elif state != (entry.size_bytes, entry.mtime_ns) and name not in self._unread:
                changed.append(name)
        for name in gone:
            del entries[name]
            self._unread.pop(name, None)
        for name in changed:  # the old size and time stay until it is read: a restart finds the difference again
            entries[name] = entries[name]._replace(accepted=None, verdict=NOT_CHECKED)
        known = entries.keys() | self._unread.keys()
        candidates = (name for name in self._newcomers.names() if name not in known and self._state(name) is not None)
        new = list(islice(candidates, max(0, self.limits.files - len(known))))
        self._unread |= dict.fromkeys(changed + new)
        if gone or changed or new:
            self._recheck_users(gone + changed + new)
            self._save()

    def _read_some(self) -> None:
        """Read of the files that changed or came by hand as many as a turn has time for."""
        if not self._unread:
            return
        left = _READ_BYTES
        while self._unread and left > 0:
            entry = self._read(next(iter(self._unread)))
            left -= 0 if entry is None else entry.size_bytes
        self._save()  # now: a number that was told must not be given again

    def _current(self, name: str) -> Entry | None:
        """What is known of a file, after reading it if it has changed."""
        if name not in self._unread:
            return self._catalogue.entries.get(name)
        entry = self._read(name)
        self._save()
        return entry

    def _read(self, name: str) -> Entry | None:
        """Take in a file that changed or came by hand; None when it is gone again, or cannot be read."""
        del self._unread[name]
        state, known = self._state(name), self._catalogue.entries.pop(name, None)
        if state is not None:
            self._adopt(name, state, known)
        if name not in self._catalogue.entries:
            self._newcomers.look_again()
        return self._catalogue.entries.get(name)

    def _scan(self) -> None:
        """See what is in the folder after a start: files, their changes, and what an earlier run left behind."""
        seen: list[tuple[str, FileState]] = []
        left: list[tuple[float, str, int]] = []
        with os.scandir(self.folder) as found:
            for item in found:
                state = item.stat(follow_symlinks=False)
                if not stat.S_ISREG(state.st_mode):
                    continue
                if item.name.startswith((_PART, _CHECK)):
                    name = item.name.removeprefix(_PART)
                    if item.name.startswith(_CHECK):  # checked, but for the verdict: it can be submitted again
                        name = item.name.removeprefix(_CHECK).partition("-")[2]
                        os.replace(item.path, self.folder / f"{_PART}{name}")
                    left.append((state.st_mtime, name, state.st_size))
                elif usable(item.name) and state.st_size <= self.limits.file_bytes:
                    seen.append((item.name, FileState(state.st_size, state.st_mtime_ns)))
        self._adopt_parts(left)
        known = self._catalogue.entries
        seen.sort(key=lambda pair: (pair[0] not in known, pair[0]))
        self._catalogue.entries = {}
        for name, found_state in seen[: self.limits.files]:
            self._adopt(name, found_state, known.get(name))
        entries = self._catalogue.entries
        kept = {name for name, entry in entries.items() if name in known and entry.crc32 == known[name].crc32}
        self._recheck_users([name for name in sorted(entries.keys() | known.keys()) if name not in kept])
        self._save()

    def _adopt_parts(self, left: list[tuple[float, str, int]]) -> None:
        for _, name, size in sorted(left):
            self._parts.pop(name, None)
            self._parts[name] = size
            if not usable(name) or size > self.limits.file_bytes:
                self._drop_part(name)
        while len(self._parts) > self.limits.parts:
            self._drop_part(next(iter(self._parts)))

    def _adopt(self, name: str, state: FileState, known: Entry | None) -> None:
        """Take a file that is there; what changed about it is checked anew."""
        path = self.folder / name
        if known is not None and (known.size_bytes, known.mtime_ns) == state:
            if known.checked_by == self._checked_by and known.accepted is not None:
                self._catalogue.entries[name] = known
                return
            checksum = known.crc32
        else:
            try:
                checksum = file_crc32(path)
            except OSError:
                return
        number = self._catalogue.number() if known is None else known.id
        self._catalogue.entries[name] = Entry(
            number, name, state.size_bytes, state.mtime_ns, checksum, None, NOT_CHECKED, self._checked_by
        )
        self._checks.add(Job(path, name, mtime_ns=state.mtime_ns))


def _told(submission: Submission) -> dict[str, Any]:
    """An upload as the index tells it."""
    finding = submission.finding
    state = "checking" if finding is None else "accepted" if finding.accepted else "refused"
    return {
        "name": submission.name,
        "size_bytes": submission.size_bytes,
        "crc32": submission.crc32,
        "state": state,
        "verdict": "being checked" if finding is None else finding.verdict,
        "id": submission.id,
    }
