"""Times across restarts: ended in order, killed, damaged, several at once."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from companion.errors import InputError
from companion.link import codec, signing_times
from companion.link.framing import FrameParser, LinkCounters, build_frame
from companion.link.key_file import new_key
from companion.link.signing import TIME_END, UNITS_PER_S, Signer, SigningKey, SigningTimes, stream_of, time_now
from companion.link.signing_times import RESERVE_S, KeptSigner, Place, open_signer, state_folder

KEY = SigningKey(bytes(range(32)))
FORMATS = codec.message_formats()
RESERVE = int(RESERVE_S * UNITS_PER_S)


def opened(folder) -> KeptSigner:
    return KeptSigner(KEY, Place(folder))


def sent_at(signer) -> int:
    return int.from_bytes(signer.sign(b"frame")[1:7], "little")


def heartbeat(sender) -> bytes:
    return build_frame(0, codec.encode_heartbeat(2, 12, 0, 5), 0, 1, 1, FORMATS[0].crc_extra, sender)


def accepts(signer, raw) -> bool:
    frames = []
    FrameParser(FORMATS, LinkCounters(), signer).parse(raw, 1, frames, [])
    return bool(frames)


def vehicle(at=None) -> Signer:
    return Signer(KEY, SigningTimes(newest=time_now() if at is None else at, streams={}))


def test_a_recording_is_worth_nothing_after_a_restart(tmp_path):
    raw = heartbeat(vehicle())
    with opened(tmp_path) as signer:
        assert accepts(signer, raw)
    with opened(tmp_path) as signer:
        assert not accepts(signer, raw)
        assert signer.counters.replayed == 1
        assert accepts(signer, heartbeat(vehicle()))


def test_times_go_on_after_a_restart_though_the_clock_went_back(tmp_path, monkeypatch):
    with opened(tmp_path) as signer:
        last, link = sent_at(signer), signer.times.link_id
    monkeypatch.setattr(signing_times, "time_now", lambda: 0)
    monkeypatch.setattr("companion.link.signing.time_now", lambda: 0)
    with opened(tmp_path) as signer:
        assert sent_at(signer) > last
        assert signer.times.link_id == link


def test_in_order_nothing_ahead_counts_as_used(tmp_path):
    for _ in range(20):
        with opened(tmp_path) as signer:
            assert sent_at(signer) < time_now() + UNITS_PER_S


def test_who_only_looks_is_not_taken_for_a_process_that_lives(tmp_path):
    first, killed = Place(tmp_path), Place(tmp_path)
    reserved = time_now() + RESERVE
    killed.store(SigningTimes(newest=0, streams={}), time_now(), reserved, ended=False)
    killed.release()
    first.release()
    with killed.path.with_suffix(".lock").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)  # another process looks at the same moment
        place = Place(tmp_path)
        assert place.path == first.path
        assert place.load().floor == reserved  # of what came before the other was killed nothing is known
    place.release()


KILLED = """
import sys, time
sys.path.insert(0, {tests!r})
from test_link_signing_times import opened, accepts, heartbeat, vehicle, sent_at
from pathlib import Path
signer = opened(Path({folder!r}))
raw = heartbeat(vehicle())
assert accepts(signer, raw)
print(sent_at(signer), raw.hex(), flush=True)
time.sleep(60)
"""


def test_after_a_kill_nothing_is_used_twice(tmp_path):
    script = KILLED.format(tests=os.path.dirname(__file__), folder=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    last, raw = process.stdout.readline().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with opened(tmp_path) as signer:
        assert sent_at(signer) > int(last)
        assert not accepts(signer, bytes.fromhex(raw))  # that it was accepted is not on the disk
        assert signer.counters.stale == 1
        assert signer.now() <= time_now() + 2 * RESERVE
        assert accepts(signer, heartbeat(vehicle(signer.now())))  # whoever hears us takes our time over


def crashed(signer):
    """Ends a signer as a crash does, for the times on the disk."""
    signer._done = True
    signer._wake.set()
    signer._thread.join()
    signer._place.release()


def test_crashes_one_after_the_other_do_not_lock_out_for_longer_and_longer(tmp_path):
    """Of a process that is not heard by whoever speaks to it: a tool behind the autopilot's radio."""
    for _ in range(8):
        signer = opened(tmp_path)
        assert signer.times.floor <= signer.now()
        crashed(signer)
    with opened(tmp_path) as signer:
        assert signer.times.floor <= time_now() + RESERVE + 8 * UNITS_PER_S
        assert sent_at(signer) > signer.times.floor


@pytest.mark.parametrize("in_order", [False, True])
@pytest.mark.parametrize("ahead", [0, RESERVE - UNITS_PER_S, RESERVE + 10, 10 * RESERVE])
def test_nothing_that_was_used_before_a_crash_is_accepted_by_anybody_after_it(tmp_path, ahead, in_order):
    """Neither by the next process nor by those behind it, however that one ended."""
    signer = opened(tmp_path)
    raw = heartbeat(vehicle(time_now() + ahead))
    assert accepts(signer, raw)
    last = latest = sent_at(signer)
    until_s = time.monotonic() + 10.0  # the thread is told of what is beyond the reserve, and writes
    while json.loads((tmp_path / "0.json").read_text())["reserved"] < last and time.monotonic() < until_s:
        time.sleep(0.001)
    crashed(signer)
    for _ in range(3):
        signer = opened(tmp_path)
        assert not accepts(signer, raw)
        assert signer.times.floor >= last
        again = sent_at(signer)
        assert again > latest
        latest = again
        if in_order:
            signer.close()
        else:
            crashed(signer)
            last = again


def test_what_is_signed_ahead_of_the_clock_is_covered(tmp_path):
    crashed(opened(tmp_path))
    signer = opened(tmp_path)
    last = [sent_at(signer) for _ in range(10_000)][-1]
    assert last > time_now() + RESERVE // 2
    crashed(signer)
    with opened(tmp_path) as signer:
        assert signer.times.floor >= last


def test_times_of_an_older_version_are_read(tmp_path):
    old = {"newest": 5, "reserved": time_now() + 50 * UNITS_PER_S, "ended": False, "link_id": 9, "streams": {}}
    (tmp_path / "0.json").write_text(json.dumps(old))
    with opened(tmp_path) as signer:
        assert (signer.times.floor, signer.times.link_id) == (old["reserved"], 9)


def test_everything_used_is_covered_by_what_is_on_the_disk(tmp_path):
    with opened(tmp_path) as signer:
        kept = json.loads((tmp_path / "0.json").read_text())
        assert not kept["ended"]
        assert kept["reserved"] == signer.times.reserved > sent_at(signer)
        assert accepts(signer, heartbeat(vehicle(kept["reserved"] + 5)))
        signer.keep()
        kept = json.loads((tmp_path / "0.json").read_text())
        assert kept["reserved"] > sent_at(signer)
        assert kept["streams"] == {str(stream_of(1, 1, 0)): signer.times.streams[stream_of(1, 1, 0)]}


def test_a_time_at_the_end_of_all_times_can_be_read_again(tmp_path):
    with opened(tmp_path) as signer:
        signer.times.newest = TIME_END - 2
        signer.keep()
        assert signer.problem == ""
    with opened(tmp_path) as signer:
        assert sent_at(signer) == TIME_END - 1


def test_a_broken_clock_of_somebody_with_the_key_ends_nothing(tmp_path):
    with opened(tmp_path) as signer:
        assert not accepts(signer, heartbeat(vehicle(TIME_END - 2)))
        assert sent_at(signer) < time_now() + UNITS_PER_S
    with opened(tmp_path) as signer:
        assert sent_at(signer) < time_now() + UNITS_PER_S


def test_the_thread_reserves_again_when_time_jumps(tmp_path, monkeypatch):
    monkeypatch.setattr(signing_times, "_LOOK_S", 0.001)
    kept = threading.Event()
    real = KeptSigner.keep
    with opened(tmp_path) as signer:
        monkeypatch.setattr(KeptSigner, "keep", lambda self: (real(self), kept.set()))
        kept.clear()
        accepts(signer, heartbeat(vehicle(signer.times.reserved + 1)))
        assert kept.wait(10.0)
        assert signer.times.reserved > signer.now()


def test_places_are_apart_and_know_what_the_others_accepted(tmp_path):
    raw = heartbeat(vehicle())
    with opened(tmp_path) as first:
        assert accepts(first, raw)
        first.keep()
        with opened(tmp_path) as second:
            assert second.times.link_id != first.times.link_id
            assert not accepts(second, raw)
            assert sent_at(second) < time_now() + UNITS_PER_S  # what the first has reserved is not ours
            with opened(tmp_path) as third:
                assert third.times.link_id not in {first.times.link_id, second.times.link_id}
    assert sorted(path.name for path in tmp_path.glob("*.json")) == ["0.json", "1.json", "2.json"]


@pytest.mark.parametrize(
    "content",
    [
        *("", "[]", "{}", "null", '{"newest": 1}'),
        '{"newest": -1, "reserved": 0, "ended": true, "link_id": 0, "streams": {}}',
        '{"newest": 1.5, "reserved": 0, "ended": true, "link_id": 0, "streams": {}}',
        '{"newest": 1, "reserved": 0, "floor": "0", "ended": true, "link_id": 0, "streams": {}}',
        '{"newest": 1, "reserved": 0, "ended": 1, "link_id": 0, "streams": {}}',
        '{"newest": 1, "reserved": 0, "ended": true, "link_id": 256, "streams": {}}',
        '{"newest": 1, "reserved": 0, "ended": true, "link_id": 0, "streams": {"x": 1}}',
        '{"newest": 1, "reserved": 0, "ended": true, "link_id": 0, "streams": []}',
    ],
)
def test_a_damaged_file_is_not_forgotten(tmp_path, content):
    (tmp_path / "3.json").write_text(content)
    with pytest.raises(InputError, match="damaged"):
        opened(tmp_path)


def test_a_folder_that_cannot_be_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be used"):
        Place(tmp_path / "file" / "folder")


def test_without_a_place_for_the_times_nothing_is_signed(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Place, "store", full)
    with pytest.raises(InputError, match="No space left"):
        opened(tmp_path)


def test_the_folder_of_a_key_is_private_and_does_not_name_it(tmp_path, monkeypatch):
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    key = new_key(tmp_path / "key")
    assert open_signer(None) is None
    signer = open_signer(str(tmp_path / "key"))
    assert signer is not None
    signer.close()
    signer.close()
    folder = tmp_path / "offboard-companion" / "signing" / key.fingerprint
    assert folder.stat().st_mode & 0o777 == 0o700
    for path in folder.iterdir():
        assert path.stat().st_mode & 0o777 == 0o600
        assert key.secret.hex() not in path.read_text()
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/companion:/var/lib/other")
    assert str(state_folder()) == "/var/lib/companion/signing"
