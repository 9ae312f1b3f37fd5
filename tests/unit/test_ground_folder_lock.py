"""The lock of the folder of trajectories: one store at a time, also after a kill, and where there are no locks."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest
from ftp_cases import make_store

from companion.errors import InputError
from companion.ground import folder_lock, hosting
from companion.ground.examine import Apart
from companion.ground.folder_lock import FolderLock
from companion.ground.store import TrajectoryStore

HOLDER = """
import sys, time
from pathlib import Path
from companion.ground.examine import Here
from companion.ground.store import TrajectoryStore
store = TrajectoryStore(Path(sys.argv[1]), Here(str))
print("open", flush=True)
time.sleep(60)
"""


def slow(path):
    time.sleep(60)


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(FolderLock.__init__, "__defaults__", (0.2,))


def test_a_second_store_is_refused_and_touches_nothing(tmp_path, impatient):
    store = make_store(tmp_path)
    (tmp_path / ".check-1-lap.csv").write_bytes(b"being checked\n")
    with pytest.raises(InputError) as caught:
        make_store(tmp_path)
    assert str(caught.value) == (
        f"--folder {tmp_path}: another `companion serve` uses it; give each its own (--folder)"
    )
    assert (tmp_path / ".check-1-lap.csv").exists() and not (tmp_path / ".part-lap.csv").exists()
    store.close()
    make_store(tmp_path).close()


def test_the_lock_is_no_trajectory(tmp_path):
    store = make_store(tmp_path)
    store.update()
    assert store.entries() == [] and (tmp_path / ".lock").exists()


def test_the_lock_of_a_killed_process_is_free(tmp_path, impatient):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "open\n"
    with pytest.raises(InputError):
        make_store(tmp_path)
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    make_store(tmp_path).close()


def test_who_is_just_ending_is_waited_for(tmp_path):
    store = make_store(tmp_path)
    ending = threading.Timer(0.3, store.close)
    ending.start()
    make_store(tmp_path).close()
    ending.join()


def test_a_check_that_is_left_over_does_not_hold_it(tmp_path, impatient):
    """A ground process that is killed leaves the process of its check behind for a while."""
    store = TrajectoryStore(tmp_path, Apart(slow))
    (tmp_path / "lap.csv").write_bytes(b"x\n")
    store.close()
    store = TrajectoryStore(tmp_path, Apart(slow))
    store.update()
    os.close(store._lock._fd)  # as the system does it: the check goes on
    make_store(tmp_path).close()
    store._checks.close()


def test_a_store_that_cannot_begin_gives_it_back(tmp_path, monkeypatch, impatient):
    def fails(self):
        raise OSError(errno.EIO, "broken")

    with monkeypatch.context() as patch:
        patch.setattr(TrajectoryStore, "_scan", fails)
        with pytest.raises(OSError, match="broken"):
            make_store(tmp_path)
    make_store(tmp_path).close()


def test_a_file_system_without_locks_is_used_and_named(tmp_path, monkeypatch):
    def none(fd, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(folder_lock, "fcntl", SimpleNamespace(flock=none, LOCK_EX=fcntl.LOCK_EX, LOCK_NB=fcntl.LOCK_NB))
    store = make_store(tmp_path)
    assert store.problem == f"{tmp_path}: the file system has no locks (No locks available)"
    store.close()


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_written_is_told(tmp_path, monkeypatch, number):
    def refuses(path, flags, mode=0o777, **rest):
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr(folder_lock.os, "open", refuses)
    with pytest.raises(InputError, match=r"cannot be used for trajectories \(.*\); see --folder"):
        hosting.open_store(SimpleNamespace(trajectories=str(tmp_path), flight={}))


def test_a_link_in_its_place_is_not_followed(tmp_path):
    (tmp_path / ".lock").symlink_to(tmp_path.parent / "made elsewhere")
    with pytest.raises(OSError, match=r"\.lock"):
        make_store(tmp_path)
    assert not (tmp_path.parent / "made elsewhere").exists()
