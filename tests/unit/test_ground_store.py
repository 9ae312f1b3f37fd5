"""The store: names, quotas, all-or-nothing, numbers that stay, and what is found after a restart."""

import errno
import json
import os
import sys
import time

import pytest
from ftp_cases import accepts, killed, make_store
from hypothesis import given
from hypothesis import strategies as st

from companion.ground.examine import Apart, Finding, Here
from companion.ground.ftp import crc32
from companion.ground.hosting import Startable
from companion.ground.names import StoreError, checked_name, usable
from companion.ground.staging import Ranges
from companion.ground.store import Limits, TrajectoryStore


def put(store, name, content, *, expected=None, block=239):
    upload = store.begin(name)
    for at in range(0, len(content), block):
        store.write(upload, at, content[at : at + block])
    return store.submit(upload, expected)


def visible(folder):
    return sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))


@pytest.mark.parametrize(
    "path",
    [b"", b"/", b".", b"..", b"../x", b"/../x", b"a/b", b"/etc/passwd", b".hidden", b"./.part-x", b"\xff\xfe", b"a\tb",
     b"a\nb", b"a\\b", b"x" * 101, b" a", b"a ", "e\u0301.csv".encode(), b"a\x00b", "\u202egnp.csv".encode()],
)  # fmt: skip
def test_names_that_are_none(path):
    with pytest.raises(StoreError) as caught:
        checked_name(path)
    assert caught.value.errno in {errno.EINVAL, errno.ENAMETOOLONG}
    assert len(str(caught.value)) < 150
    assert str(caught.value).isprintable()


def test_names_that_are_some():
    assert checked_name(b"lap.csv") == checked_name(b"/lap.csv") == checked_name(b".//./lap.csv") == "lap.csv"
    assert checked_name("Schräge Acht.toml".encode()) == "Schräge Acht.toml"
    with pytest.raises(StoreError) as caught:
        checked_name(b"/index.json")
    assert caught.value.errno == errno.EPERM


@given(st.binary(max_size=130))
def test_a_name_that_is_taken_stays_in_the_folder(path):
    try:
        name = checked_name(path)
    except StoreError:
        return
    assert os.path.basename(name) == name and name not in {"", ".", ".."}
    assert usable(name)


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(1, 12)), max_size=30))
def test_ranges_are_the_bytes_that_were_added(pieces):
    ranges, there = Ranges(), set()
    for begin, length in pieces:
        ranges.add(begin, begin + length)
        there |= set(range(begin, begin + length))
        assert ranges.end == max(there) + 1
        assert ranges.prefix == next(i for i in range(100) if i not in there)
        assert {i for b, e in ranges.overlaps(5, 40) for i in range(b, e)} == {i for i in there if 5 <= i < 40}
        assert len(ranges) == sum(1 for i in there if i - 1 not in there)


def test_an_upload_is_checked_then_stored(tmp_path):
    store = make_store(tmp_path / "t")
    done = put(store, "lap.csv", b"1,2,3\n" * 100)
    assert done.finding == Finding(True, "may be flown")
    assert (tmp_path / "t" / "lap.csv").read_bytes() == b"1,2,3\n" * 100
    (entry,) = store.entries()
    assert (entry.id, entry.name, entry.size_bytes, entry.accepted) == (1, "lap.csv", 600, True)
    assert entry.crc32 == crc32(b"1,2,3\n" * 100)
    index = json.loads(store.index())
    assert index["trajectories"] == [
        {"id": 1, "name": "lap.csv", "size_bytes": 600, "crc32": entry.crc32, "accepted": True,
         "verdict": "may be flown"}
    ]  # fmt: skip
    assert [(u["name"], u["state"], u["id"]) for u in index["uploads"]] == [("lap.csv", "accepted", 1)]


def test_a_refused_upload_changes_nothing(tmp_path):
    store = make_store(tmp_path)
    put(store, "lap.csv", b"good\n")
    done = put(store, "lap.csv", b"bad\n")
    assert done.finding == Finding(False, "lap.csv: asks for too much")
    assert done.id is None
    assert (tmp_path / "lap.csv").read_bytes() == b"good\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == [".catalogue.json", ".lock", "lap.csv"]


def test_a_verdict_names_the_file_as_people_know_it(tmp_path):
    store = make_store(tmp_path, lambda path: f"read '{path}', {path}: 3 points, {path.name} twice")
    done = put(store, "a+b (1).csv", b"x\n")
    assert done.finding.verdict == "read 'a+b (1).csv', a+b (1).csv: 3 points, a+b (1).csv twice"


def test_a_check_with_a_fault_refuses(tmp_path):
    def broken(path):
        raise ZeroDivisionError("division by zero")

    done = put(make_store(tmp_path, broken), "lap.csv", b"x\n")
    assert done.finding == Finding(False, "the check failed: ZeroDivisionError: division by zero")
    assert visible(tmp_path) == []


@pytest.mark.parametrize(
    ("blocks", "expected", "reason"),
    [
        ([(0, b"aa\n")], None, None),
        ([(0, b"a" * 10), (10, b"bbb")], None, None),
        ([(0, b"a" * 10), (10, b"b" * 10)], None, "may be cut off"),
        ([(0, b"a" * 10), (10, b"b" * 9 + b"\n")], None, "may be cut off"),
        ([(0, b"a" * 10), (10, b"b" * 9 + b"\n"), (20, b"\n")], None, None),
        ([(20, b"\n"), (10, b"b" * 9 + b"\n"), (0, b"a" * 10)], None, None),
        ([(0, b"a" * 60 + b"\n")], None, None),
        ([(0, b"a" * 79 + b"\n")], None, "may be cut off"),
        ([(0, b"a" * 238 + b"\n")], None, "may be cut off"),
        ([(0, b"a" * 79 + b"\n"), (0, b"a" * 79 + b"\n")], None, "may be cut off"),
        ([(0, b"a" * 100 + b"\n")], None, None),
        ([(0, b'{"items":'), (9, b"[[1, 2]]}")], None, None),
        ([(0, b'\n{"items"'), (9, b":[1, 2]}\n")], None, None),
        ([(0, b'{"items":'), (9, b"[[1, 2]] ")], None, "may be cut off"),
        ([(0, b"x = { a=1"), (9, b",b=2345 }")], None, "may be cut off"),
        ([(0, b"a" * 10), (20, b"bbb")], None, "bytes are missing from 10 on"),
        ([(10, b"bbb")], None, "bytes are missing from 0 on"),
        ([], None, "it is empty"),
        ([(0, b"a" * 10)], (10, crc32(b"a" * 10)), None),
        ([(0, b"a" * 10)], (11, crc32(b"a" * 10)), "10 of 11 bytes came"),
        ([(0, b"a" * 10)], (10, 1), "checksum"),
        ([(0, b"aaaa"), (4, b"bbb"), (0, b"cc\n")], None, None),
    ],
)
def test_only_the_whole_is_taken(tmp_path, blocks, expected, reason):
    store = make_store(tmp_path)
    upload = store.begin("x.csv")
    for at, block in blocks:
        store.write(upload, at, block)
    if reason is None:
        assert store.submit(upload, expected).finding.accepted
        assert visible(tmp_path) == ["x.csv"]
    else:
        with pytest.raises(StoreError, match=reason):
            store.submit(upload, expected)
        assert visible(tmp_path) == []


def test_the_beginning_of_what_is_stored_does_not_replace_it(tmp_path):
    """Also where the last block is a short one; a sender that says size and checksum may shorten a file."""
    store = make_store(tmp_path)
    whole = b"1,2,3\n" * 100_000
    put(store, "lap.csv", whole)
    for length in (30, 300, 599_994):
        with pytest.raises(StoreError, match="is the beginning of the file that is stored: remove") as caught:
            put(store, "lap.csv", whole[:length])
        assert caught.value.errno == errno.EAGAIN
        assert (tmp_path / "lap.csv").read_bytes() == whole
    assert put(store, "lap.csv", whole).finding.accepted
    assert put(store, "lap.csv", whole[:-2] + b"4\n").finding.accepted
    assert put(store, "other.csv", whole[:300]).finding.accepted
    assert put(store, "lap.csv", whole[:300], expected=(300, crc32(whole[:300]))).finding.accepted
    store.remove("lap.csv")
    assert put(store, "lap.csv", whole[:294]).finding.accepted


def test_nor_of_what_is_being_checked(tmp_path):
    store = TrajectoryStore(tmp_path, Apart(os.path.basename))
    first = put(store, "lap.csv", b"1,2,3\n" * 100)
    with pytest.raises(StoreError, match="is the beginning of the file"):
        put(store, "lap.csv", b"1,2,3\n" * 50)
    assert wait(store, first).accepted
    store.close()


def test_a_pipe_of_that_name_holds_nothing_up(tmp_path):
    store = make_store(tmp_path)
    os.mkfifo(tmp_path / "lap.csv")
    assert put(store, "lap.csv", b"1,2,3\n").finding.accepted


def test_a_block_that_contradicts_begins_afresh(tmp_path):
    store = make_store(tmp_path)
    upload = store.begin("x.csv")
    for at in range(0, 100, 10):
        store.write(upload, at, b"old line!\n")
    store.write(upload, 0, b"new line!\n")
    store.write(upload, 10, b"end\n")
    assert store.submit(upload, None).finding.accepted
    assert (tmp_path / "x.csv").read_bytes() == b"new line!\nend\n"


def test_an_upload_goes_on_after_a_cut_and_after_a_restart(tmp_path):
    store = make_store(tmp_path)
    upload = store.begin("x.csv")
    store.write(upload, 0, b"0123456789")
    store.write(upload, 20, b"klmno")
    store.leave(upload)
    assert (tmp_path / ".part-x.csv").read_bytes() == b"0123456789"
    for restarted in (False, True):
        if restarted:
            killed(store)
        again = make_store(tmp_path) if restarted else store
        upload = again.begin("x.csv", resume=True)
        assert (upload.received, upload.crc32) == (10, crc32(b"0123456789"))
        again.leave(upload)
    upload = again.begin("x.csv", resume=True)
    again.write(upload, 10, b"abc\n")
    assert again.submit(upload, (14, crc32(b"0123456789abc\n"))).finding.accepted
    assert (tmp_path / "x.csv").read_bytes() == b"0123456789abc\n"
    assert again.begin("x.csv").received == 0


def test_a_killed_upload_is_found_again(tmp_path):
    """Without leave(): the process was killed. What was being checked then can be submitted again."""
    store = make_store(tmp_path)
    store.write(store.begin("x.csv"), 0, b"0123456789")
    (tmp_path / ".check-4-y.csv").write_bytes(b"whole\n")
    killed(store)
    again = make_store(tmp_path)
    assert again.begin("x.csv", resume=True).received == 10
    assert again.begin("y.csv", resume=True).received == 6
    assert visible(tmp_path) == []


def test_numbers_stay(tmp_path):
    store = make_store(tmp_path)
    for name in ("a.csv", "b.csv", "c.csv"):
        put(store, name, b"x\n")
    put(store, "a.csv", b"other\n")
    store.rename("b.csv", "d.csv")
    store.remove("c.csv")
    store.close()
    again = make_store(tmp_path)
    assert [(e.id, e.name) for e in again.entries()] == [(1, "a.csv"), (2, "d.csv")]
    put(again, "c.csv", b"x\n")
    assert again.entry("c.csv").id == 4
    assert again.numbered(2).name == "d.csv" and again.numbered(3) is None


def test_files_put_there_by_hand_are_numbered_and_checked(tmp_path):
    store = make_store(tmp_path)
    put(store, "a.csv", b"x\n")
    (tmp_path / "by hand.csv").write_bytes(b"bad\n")
    (tmp_path / "a.csv").write_bytes(b"changed\n")
    (tmp_path / "link.csv").symlink_to("/etc/passwd")
    (tmp_path / "folder").mkdir()
    killed(store)
    again = make_store(tmp_path)
    assert [e.accepted for e in again.entries()] == [None, None]
    again.update()
    found = {e.name: (e.id, e.accepted, e.crc32) for e in again.entries()}
    assert found == {"a.csv": (1, True, crc32(b"changed\n")), "by hand.csv": (2, False, crc32(b"bad\n"))}


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


def watched(folder, check=accepts, **options):
    clock = Clock()
    return TrajectoryStore(folder, Here(check), clock=clock, **options), clock


def write_by_hand(path, content):
    """As an editor does it, at a time that no two writes share."""
    before = path.stat().st_mtime_ns if path.exists() else time.time_ns()
    path.write_bytes(content)
    os.utime(path, ns=(before + 1_000_000, before + 1_000_000))


def test_a_file_that_comes_by_hand_is_found_while_it_runs(tmp_path):
    store, clock = watched(tmp_path)
    put(store, "a.csv", b"x\n")
    assert [e.name for e in store.entries()] == ["a.csv"]
    write_by_hand(tmp_path / "b.csv", b"by hand\n")
    (tmp_path / "link.csv").symlink_to("/etc/passwd")
    clock.now_s += 1.9
    assert [e.name for e in store.entries()] == ["a.csv"]
    clock.now_s += 0.2
    found = store.numbered(2) or store.entries()[-1]
    assert (found.id, found.name, found.size_bytes, found.crc32) == (2, "b.csv", 8, crc32(b"by hand\n"))
    assert (found.accepted, found.verdict) == (None, "not checked yet")
    store.update()
    assert store.entry("b.csv").accepted and [e.name for e in store.entries()] == ["a.csv", "b.csv"]
    store.close()
    assert make_store(tmp_path).entry("b.csv").id == 2


def test_a_name_that_is_not_known_is_looked_for(tmp_path):
    store, clock = watched(tmp_path)
    with pytest.raises(StoreError):
        store.entry("b.csv")
    write_by_hand(tmp_path / "b.csv", b"by hand\n")
    clock.now_s += 2.1
    assert store.entry("b.csv").size_bytes == 8


def test_a_folder_that_does_not_change_is_not_read_again(tmp_path, monkeypatch):
    store, clock = watched(tmp_path)
    put(store, "a.csv", b"x\n")
    os.utime(tmp_path, (1.7e9, 1.7e9))
    store.entries()
    listed = []
    monkeypatch.setattr("companion.ground.by_hand.os.listdir", lambda folder: listed.append(folder) or [])
    for _ in range(5):
        clock.now_s += 2.1
        store.entries()
    assert listed == []
    os.utime(tmp_path, (1.7e9, 1.7e9 + 1))
    clock.now_s += 2.1
    store.entries()
    assert listed == [tmp_path]


def test_a_file_that_changes_by_hand_is_read_and_checked_again(tmp_path):
    store, _ = watched(tmp_path)
    put(store, "a.csv", b"good\n")
    write_by_hand(tmp_path / "a.csv", b"bad!\n")
    (entry,) = json.loads(store.index())["trajectories"]
    assert entry == {"id": 1, "name": "a.csv", "size_bytes": 5, "crc32": crc32(b"bad!\n"), "accepted": None,
                     "verdict": "not checked yet"}  # fmt: skip
    store.update()
    assert store.entry("a.csv").accepted is False
    write_by_hand(tmp_path / "a.csv", b"good again\n")
    with pytest.raises(LookupError, match=r"a\.csv: not checked yet"):
        Startable(store).find(1)
    store.update()
    assert Startable(store).find(1) == ("a.csv", str(tmp_path / "a.csv"))
    fd, entry = store.open("a.csv")
    os.close(fd)
    assert entry.size_bytes == 11


def test_a_file_that_goes_by_hand_is_gone(tmp_path):
    store, _ = watched(tmp_path)
    put(store, "a.csv", b"x\n")
    put(store, "lap.toml", b'file = "a.csv"\n')
    (tmp_path / "a.csv").unlink()
    with pytest.raises(LookupError, match="no trajectory has the id 1"):
        Startable(store).find(1)
    with pytest.raises(LookupError, match=r"lap\.toml: not checked yet"):
        Startable(store).find(2)
    assert put(store, "a.csv", b"x\n").id == 3


def test_what_names_a_file_that_changed_by_hand_is_not_started(tmp_path):
    store, _ = watched(tmp_path)
    put(store, "lap.csv", b"x\n")
    put(store, "lap.toml", b'file = "lap.csv"\n')
    write_by_hand(tmp_path / "lap.csv", b"y\n")
    with pytest.raises(LookupError, match=r"lap\.toml: not checked yet"):
        Startable(store).find(2)
    store.update()
    assert Startable(store).find(2)[0] == "lap.toml"
    store.close()
    write_by_hand(tmp_path / "lap.csv", b"z\n")
    assert make_store(tmp_path).entry("lap.toml").accepted is None


class Steered:
    """An examiner whose checks end when they are told to."""

    def __init__(self):
        self.begun, self.finding = [], None

    def begin(self, path):
        self.begun.append(path.read_bytes())
        return self

    def poll(self):
        finding, self.finding = self.finding, None
        return finding

    def cancel(self):
        pass


def test_a_verdict_is_not_given_to_other_contents_than_were_checked(tmp_path):
    examiner = Steered()
    (tmp_path / "a.csv").write_bytes(b"good\n")
    store = TrajectoryStore(tmp_path, examiner)
    store.update()
    write_by_hand(tmp_path / "a.csv", b"changed while it was checked\n")
    examiner.finding = Finding(True, "may be flown")
    store.update()
    assert store.entry("a.csv").accepted is None
    store.update()
    examiner.finding = Finding(False, "no")
    store.update()
    assert store.entry("a.csv").verdict == "no"
    assert examiner.begun == [b"good\n", b"changed while it was checked\n"]


def test_a_check_of_what_has_changed_since_is_void(tmp_path):
    """Also of a file that names another one: what it read of that is no longer so."""
    examiner = Steered()
    (tmp_path / "lap.csv").write_bytes(b"x\n")
    (tmp_path / "lap.toml").write_bytes(b'file = "lap.csv"\n')
    store = TrajectoryStore(tmp_path, examiner)
    store.update()
    examiner.finding = Finding(True, "the first")
    store.update()
    assert store.entry("lap.csv").accepted and len(examiner.begun) == 2
    write_by_hand(tmp_path / "lap.csv", b"y\n")
    store.entries()
    examiner.finding = Finding(True, "of the old contents")
    store.update()
    assert store.entry("lap.toml").accepted is None
    for _ in range(2):
        examiner.finding = Finding(True, "anew")
        store.update()
    assert [e.verdict for e in store.entries()] == ["anew", "anew"]


def test_many_files_by_hand_hold_nobody_up(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.ground.store._READ_BYTES", 1000)
    store, _ = watched(tmp_path)
    for i in range(10):
        write_by_hand(tmp_path / f"{i}.csv", b"x" * 400)
    assert [e.name for e in store.entries()] == ["0.csv", "1.csv", "2.csv"]
    assert store.entry("9.csv").id == 4
    for _ in range(3):
        store.update()
    assert len(store.entries()) == 10 and all(e.accepted for e in store.entries())
    for i in range(10):
        write_by_hand(tmp_path / f"{i}.csv", b"y" * 400)
    assert len(store.entries()) == 3
    assert store.numbered(4).crc32 == crc32(b"y" * 400) and store.numbered(4).accepted is None
    (tmp_path / "8.csv").unlink()
    for _ in range(4):
        store.update()
    assert [e.crc32 for e in store.entries()] == [crc32(b"y" * 400)] * 9


def test_a_restart_in_between_keeps_the_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.ground.store._READ_BYTES", 1)
    store, _ = watched(tmp_path)
    for name in ("a.csv", "b.csv", "c.csv"):
        put(store, name, b"x\n")
        write_by_hand(tmp_path / name, b"changed\n")
    store.entries()
    killed(store)
    again = make_store(tmp_path)
    assert [(e.id, e.name, e.accepted) for e in again.entries()] == [(i + 1, "abc"[i] + ".csv", None) for i in range(3)]


def test_a_file_that_cannot_be_read_is_tried_again(tmp_path, monkeypatch):
    store, clock = watched(tmp_path)
    write_by_hand(tmp_path / "a.csv", b"x\n")
    os.utime(tmp_path, (1.7e9, 1.7e9))

    def refuses(path):
        raise PermissionError(errno.EACCES, "denied")

    with monkeypatch.context() as patch:
        patch.setattr("companion.ground.store.file_crc32", refuses)
        assert store.entries() == []
    clock.now_s += 2.1
    assert [e.name for e in store.entries()] == ["a.csv"]


def test_a_rename_does_not_overwrite_what_came_by_hand(tmp_path):
    store, _ = watched(tmp_path)
    put(store, "a.csv", b"x\n")
    store.entries()
    write_by_hand(tmp_path / "b.csv", b"precious\n")
    (tmp_path / "c.csv").symlink_to("nowhere")
    for name in ("b.csv", "c.csv"):
        with pytest.raises(StoreError) as caught:
            store.rename("a.csv", name)
        assert caught.value.errno == errno.EEXIST
    assert (tmp_path / "b.csv").read_bytes() == b"precious\n"
    store.rename("a.csv", "d.csv")
    assert store.entry("d.csv").id == 1


def test_another_vehicle_checks_anew(tmp_path):
    checked = []

    def check(path):
        checked.append(path.name)
        return "fine"

    for checked_by, times in (("paper", 1), ("paper", 1), ("bundled", 2)):
        store = TrajectoryStore(tmp_path, Here(check), checked_by=checked_by)
        if not store.entries():
            put(store, "a.csv", b"x\n")
        store.update()
        assert len(checked) == times
        assert store.entry("a.csv").accepted
        store.close()


def test_a_file_that_names_a_changed_one_is_checked_anew(tmp_path):
    store = make_store(tmp_path)
    put(store, "lap.csv", b"x\n")
    put(store, "lap.toml", b'file = "lap.csv"\n')
    store._checks._examiner = Here(lambda path: "checked again")
    put(store, "lap.csv", b"y\n")
    store.update()
    assert store.entry("lap.toml").verdict == "checked again"


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"next_id": "x", "files": [{}]}', b"\xff", b"[" * 100_000])
def test_a_damaged_catalogue_is_written_anew(tmp_path, damage):
    store = make_store(tmp_path)
    put(store, "a.csv", b"x\n")
    store.close()
    (tmp_path / ".catalogue.json").write_bytes(damage)
    store = make_store(tmp_path)
    store.update()
    assert [(e.id, e.accepted) for e in store.entries()] == [(1, True)]
    assert json.loads((tmp_path / ".catalogue.json").read_bytes())["next_id"] == 2


def test_quotas(tmp_path):
    store = make_store(tmp_path, limits=Limits(files=3, file_bytes=100, total_bytes=250, uploads=2, parts=1))
    one, two = store.begin("one"), store.begin("two")
    with pytest.raises(StoreError, match="more than 2 uploads") as caught:
        store.begin("three")
    assert caught.value.errno == errno.EMFILE
    with pytest.raises(StoreError) as caught:
        store.begin("one")
    assert caught.value.errno == errno.EBUSY
    store.write(one, 0, b"x" * 100)
    with pytest.raises(StoreError) as caught:
        store.write(one, 100, b"x")
    assert caught.value.errno == errno.EFBIG
    with pytest.raises(StoreError, match="a part of it could not be taken"):
        store.submit(one, (100, crc32(b"x" * 100)))
    store.write(two, 0, b"x" * 10)
    store.leave(two)
    assert [p.name for p in tmp_path.glob(".part-*")] == [".part-two"]
    for name in ("a", "b"):
        put(store, name, b"x" * 98 + b"\n", block=50)
    upload = store.begin("c")
    store.write(upload, 0, b"x" * 42)
    with pytest.raises(StoreError) as caught:
        store.write(upload, 42, b"x")
    assert caught.value.errno == errno.EDQUOT
    store.leave(upload)
    put(store, "c", b"x\n")
    with pytest.raises(StoreError, match="3 files are stored") as caught:
        store.begin("d")
    assert caught.value.errno == errno.EDQUOT
    assert put(store, "c", b"y\n").finding.accepted


def test_ten_thousand_files(tmp_path):
    for i in range(10_000):
        (tmp_path / f"{i:05d}.csv").touch()
    store = make_store(tmp_path, limits=Limits(files=50))
    store.update()
    assert len(store.entries()) == 50
    with pytest.raises(StoreError):
        store.begin("new.csv")
    assert len(store.index()) < 10_000


def wait(store, submission):
    end_s = time.monotonic() + 20.0
    while submission.finding is None and time.monotonic() < end_s:
        store.update()
        time.sleep(0.005)
    return submission.finding


def test_a_check_apart(tmp_path):
    store = TrajectoryStore(tmp_path, Apart(os.path.basename))
    done = put(store, "x.csv", b"1\n")
    assert done.finding is None
    assert json.loads(store.index())["uploads"][0]["state"] == "checking"
    assert wait(store, done) == Finding(True, "x.csv")


CHECKS = """
import os, time
def endless(path): time.sleep(60)
def crash(path): os.abort()
def greedy(path): bytearray(1 << 40)
def talkative(path): print("nothing to see"); return "y" * 1000
"""


@pytest.mark.parametrize(
    ("check", "accepted", "verdict"),
    [
        ("endless", False, "the check did not end within 1 s"),
        ("crash", False, "the check broke off (signal 6)"),
        ("greedy", False, "the check failed: MemoryError:"),
        ("talkative", True, "y" * 397 + "..."),
    ],
)
def test_a_check_apart_is_held_in_limits(tmp_path, monkeypatch, check, accepted, verdict):
    (tmp_path / "some_checks.py").write_text(CHECKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    module = __import__("some_checks")
    store = TrajectoryStore(tmp_path / "t", Apart(getattr(module, check), time_max_s=1.0 if check == "endless" else 20))
    assert wait(store, put(store, "x.csv", b"1\n")) == Finding(accepted, verdict)
    assert visible(tmp_path / "t") == ["x.csv"] * accepted
    del sys.modules["some_checks"]


def test_a_store_closes_what_is_under_way(tmp_path):
    store = TrajectoryStore(tmp_path, Apart(accepts))
    store.write(store.begin("x.csv"), 0, b"abc")
    put(store, "y.csv", b"1\n")
    store.close()
    assert (tmp_path / ".part-x.csv").read_bytes() == b"abc"
    assert make_store(tmp_path).begin("y.csv", resume=True).received == 2
