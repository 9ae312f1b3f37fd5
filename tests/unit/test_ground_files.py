"""The file server, request by request: what the usual clients rely on, and what nobody should send."""

import errno
import os
from pathlib import Path

import pytest
from ftp_cases import VEHICLE, Raw, Recorder, accepts, frame, make_store
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.ground.examine import Finding
from companion.ground.files import BURST_PACKETS, CLIENTS_MAX, SESSION_IDLE_MAX_S, FileServer
from companion.ground.ftp import EXPECTED, RECEIVED, Opcode, Packet, crc32, decode, encode
from companion.ground.store import Limits, TrajectoryStore

TEXT = b"".join(b"%d,%d,0\n" % (i, i * i) for i in range(300))
PROTECTED, NOT_FOUND, EXISTS, INVALID_SESSION, END = (9,), (10,), (8,), (4,), (6,)


def failed(number):
    return (2, number)


class Slow:
    """An examiner whose verdict comes when it is told to."""

    def __init__(self):
        self.finding = None

    def begin(self, path):
        return self

    def poll(self):
        return self.finding

    def cancel(self):
        pass


@pytest.fixture
def said():
    return []


@pytest.fixture
def server(tmp_path, said):
    return FileServer(make_store(tmp_path), lambda text, good: said.append((text, good)))


@pytest.fixture
def client(server):
    return Raw(server)


def test_upload_list_download_remove(client, said):
    assert client.put("/lap.csv", TEXT).opcode == Opcode.ACK
    assert said == [("lap.csv stored: may be flown", True)]
    listing = client.granted(Opcode.LIST_DIRECTORY, b"/").data
    index, lap, rest = listing.split(b"\0")
    assert index.startswith(b"Findex.json\t") and rest == b""
    assert lap == b"Flap.csv\t%d" % len(TEXT)
    timed = client.granted(Opcode.LIST_DIRECTORY_WITH_TIME, b"\0").data.split(b"\0")
    assert int(timed[1].split(b"\t")[2]) > 1_600_000_000
    assert client.refused(Opcode.LIST_DIRECTORY, b"/", offset=2) == END
    assert client.refused(Opcode.LIST_DIRECTORY, b"/etc") == NOT_FOUND
    assert client.get("lap.csv") == TEXT
    assert client.get("/lap.csv", size=80) == TEXT
    assert int.from_bytes(client.granted(Opcode.CALC_FILE_CRC32, b"/lap.csv").data, "little") == crc32(TEXT)
    client.granted(Opcode.REMOVE_FILE, b"/lap.csv")
    assert client.refused(Opcode.OPEN_FILE_RO, b"/lap.csv") == NOT_FOUND
    assert client.refused(Opcode.CALC_FILE_CRC32, b"/lap.csv") == NOT_FOUND


def test_the_checksum_is_that_of_the_others():
    """The value of PX4's crc32part and MAVSDK's Crc32 for "123456789": CRC-32 with both inversions left out."""
    assert crc32(b"123456789") == 0x2DFD2D88
    assert crc32(b"6789", crc32(b"12345")) == 0x2DFD2D88


def test_answers_go_to_who_asked(client):
    client.granted(Opcode.NONE)
    assert client.link.targets == [(254, 190)]


@pytest.mark.parametrize(("component", "opcode", "msgid"), [(0, 3, 110), (1, 3, 110), (190, 3, 110), (191, 3, 111)])
def test_what_is_for_others_is_left_to_others(server, component, opcode, msgid):
    link = Recorder()
    payload = encode(VEHICLE, component, Packet(1, 0, opcode, 1, 0, 0, 0, b"/"))
    assert not server.handle(frame(payload, msgid=msgid), link, 1.0)
    assert link.sent == []


def test_an_answer_is_no_request(client):
    assert client.tell(Opcode.ACK) == client.tell(Opcode.NAK) == []


def test_a_session_that_is_not_open(client):
    assert client.refused(Opcode.TERMINATE_SESSION) == INVALID_SESSION


def test_a_directory_of_many_comes_in_parts(client):
    names = [f"a trajectory with a long name, number {i:02d}.csv" for i in range(30)]
    for name in names:
        client.put(name, b"x\n")
    found = []
    while True:
        reply = client.ask(Opcode.LIST_DIRECTORY, b"/", offset=len(found))
        if reply.opcode == Opcode.NAK:
            assert tuple(reply.data) == END
            break
        found += [item.split(b"\t")[0][1:].decode() for item in reply.data.split(b"\0")[:-1]]
    assert found == ["index.json", *names]


@pytest.mark.parametrize(
    ("opcode", "data", "reply"),
    [
        (Opcode.CREATE_FILE, b"../x", failed(errno.EINVAL)),
        (Opcode.CREATE_FILE, b"/../../etc/passwd", failed(errno.EINVAL)),
        (Opcode.CREATE_FILE, b"\xff\xfe.csv", failed(errno.EINVAL)),
        (Opcode.CREATE_FILE, b".hidden", failed(errno.EINVAL)),
        (Opcode.CREATE_FILE, b"", failed(errno.EINVAL)),
        (Opcode.CREATE_FILE, b"y" * 200, failed(errno.ENAMETOOLONG)),
        (Opcode.CREATE_FILE, b"index.json", PROTECTED),
        (Opcode.OPEN_FILE_WO, b"/index.json", PROTECTED),
        (Opcode.OPEN_FILE_RO, b"../secret", failed(errno.EINVAL)),
        (Opcode.OPEN_FILE_RO, b".catalogue.json", failed(errno.EINVAL)),
        (Opcode.OPEN_FILE_RO, b".lock", failed(errno.EINVAL)),
        (Opcode.REMOVE_FILE, b"/.lock", failed(errno.EINVAL)),
        (Opcode.REMOVE_FILE, b"index.json", PROTECTED),
        (Opcode.REMOVE_FILE, b"none.csv", NOT_FOUND),
        (Opcode.RENAME, b"none.csv\0other.csv", NOT_FOUND),
        (Opcode.RENAME, b"lap.csv\0../x", failed(errno.EINVAL)),
        (Opcode.RENAME, b"lap.csv", failed(errno.EINVAL)),
        (Opcode.RENAME, b"lap.csv\0index.json", PROTECTED),
        (Opcode.RENAME, b"lap.csv\0lap.csv", EXISTS),
        (Opcode.CREATE_DIRECTORY, b"/sub", PROTECTED),
        (Opcode.REMOVE_DIRECTORY, b"/", PROTECTED),
        (Opcode.TRUNCATE_FILE, b"lap.csv", PROTECTED),
        (Opcode.READ_FILE, b"", INVALID_SESSION),
        (Opcode.WRITE_FILE, b"x", INVALID_SESSION),
        (Opcode.BURST_READ_FILE, b"", INVALID_SESSION),
        (77, b"", (7,)),
    ],
)
def test_refusals(client, tmp_path, opcode, data, reply):
    (tmp_path.parent / "secret").write_bytes(b"secret")
    client.put("lap.csv", TEXT)
    assert client.refused(opcode, data) == reply
    assert (tmp_path / "lap.csv").read_bytes() == TEXT


def test_a_size_that_cannot_be(client):
    assert client.refused(Opcode.WRITE_FILE, b"x" * 239, size=240) == (3,)


def test_a_refused_trajectory(client, said, tmp_path):
    client.put("lap.csv", TEXT)
    reply = client.put("lap.csv", b"bad\n")
    assert (reply.opcode, tuple(reply.data)) == (Opcode.NAK, failed(errno.EINVAL))
    assert said[-1] == ("lap.csv refused: lap.csv: asks for too much", False)
    assert (tmp_path / "lap.csv").read_bytes() == TEXT


def test_blocks_in_any_order_and_again(client, tmp_path):
    """MAVProxy and pymavlink keep several writes under way and repeat lost ones at the end."""
    client.granted(Opcode.CREATE_FILE, b"lap.csv", session=9)
    offsets = list(range(0, len(TEXT), 80))
    for at in offsets[::2] + offsets[::-1]:
        client.granted(Opcode.WRITE_FILE, TEXT[at : at + 80], offset=at, session=9)
    client.granted(Opcode.TERMINATE_SESSION, session=9)
    assert (tmp_path / "lap.csv").read_bytes() == TEXT


def test_the_client_chooses_the_number_of_a_session(client):
    client.put("lap.csv", TEXT)
    assert client.granted(Opcode.OPEN_FILE_RO, b"lap.csv", session=200).session == 200
    assert client.granted(Opcode.READ_FILE, session=200, size=10, offset=5).data == TEXT[5:15]
    assert client.granted(Opcode.READ_FILE, session=200, size=0, offset=0).data == TEXT[:239]
    assert client.refused(Opcode.READ_FILE, session=200, size=10, offset=len(TEXT)) == END
    assert client.refused(Opcode.WRITE_FILE, b"x", session=200) == PROTECTED


def test_what_changes_by_hand_is_answered_as_it_is(client, tmp_path):
    client.put("lap.csv", TEXT)
    (tmp_path / "lap.csv").write_bytes(b"changed\n")
    (tmp_path / "new.csv").write_bytes(b"by hand\n")
    assert client.granted(Opcode.LIST_DIRECTORY, b"/").data.split(b"\0")[1:3] == [b"Flap.csv\t8", b"Fnew.csv\t8"]
    assert int.from_bytes(client.granted(Opcode.CALC_FILE_CRC32, b"lap.csv").data, "little") == crc32(b"changed\n")
    assert client.get("lap.csv") == b"changed\n" and client.get("new.csv") == b"by hand\n"
    assert client.refused(Opcode.RENAME, b"lap.csv\0new.csv") == EXISTS
    (tmp_path / "lap.csv").unlink()
    assert client.refused(Opcode.OPEN_FILE_RO, b"lap.csv") == NOT_FOUND


def test_two_clients_with_the_same_number(server):
    one, two = Raw(server, (255, 190)), Raw(server, (254, 190))
    one.granted(Opcode.CREATE_FILE, b"one.csv")
    two.granted(Opcode.CREATE_FILE, b"two.csv")
    one.granted(Opcode.WRITE_FILE, b"1\n")
    two.granted(Opcode.WRITE_FILE, b"22\n")
    assert two.refused(Opcode.CREATE_FILE, b"one.csv", session=1) == failed(errno.EBUSY)
    one.granted(Opcode.TERMINATE_SESSION)
    two.granted(Opcode.TERMINATE_SESSION)
    assert one.get("two.csv") == b"22\n" and two.get("one.csv") == b"1\n"


def test_the_same_client_by_another_link_is_another(server):
    one, two = Raw(server), Raw(server, link=Recorder("vehicle"))
    one.granted(Opcode.CREATE_FILE, b"one.csv")
    assert two.refused(Opcode.WRITE_FILE, b"x") == INVALID_SESSION


def test_who_was_cut_off_gives_way_after_a_while(server):
    one, two = Raw(server), Raw(server, link=Recorder("vehicle"))
    one.granted(Opcode.CREATE_FILE, b"lap.csv")
    one.granted(Opcode.WRITE_FILE, TEXT[:200])
    two.now_s += 1.0
    assert two.refused(Opcode.OPEN_FILE_WO, b"lap.csv") == failed(errno.EBUSY)
    two.now_s += 5.0
    reply = two.granted(Opcode.OPEN_FILE_WO, b"lap.csv")
    assert RECEIVED.unpack(reply.data) == (200, crc32(TEXT[:200]))


def test_reset_ends_an_upload_that_is_complete(client, tmp_path):
    """QGroundControl ends uploads so, and cancels them by TerminateSession, of which it sends none for session 0."""
    client.granted(Opcode.CREATE_FILE, b"/lap.csv")
    client.granted(Opcode.WRITE_FILE, TEXT[:239])
    client.granted(Opcode.WRITE_FILE, b"the end", offset=239)
    client.granted(Opcode.RESET_SESSIONS)
    assert (tmp_path / "lap.csv").read_bytes() == TEXT[:239] + b"the end"


@pytest.mark.parametrize("age_s", [0.1, 10.0])
def test_reset_by_a_client_that_begins_anew_ends_nothing(client, tmp_path, age_s):
    """pymavlink sends it when it starts, MAVProxy's leftovers included."""
    client.granted(Opcode.CREATE_FILE, b"/lap.csv")
    client.granted(Opcode.WRITE_FILE, (TEXT[:200] + b"\n") if age_s > 5.0 else b"x" * 239)
    client.now_s += age_s
    client.granted(Opcode.RESET_SESSIONS)
    assert not (tmp_path / "lap.csv").exists()
    assert client.refused(Opcode.WRITE_FILE, b"x") == INVALID_SESSION


def test_giving_up_is_no_upload(client, tmp_path, said):
    """MAVProxy's `ftp cancel`, and pymavlink after a timeout, end the session in the middle."""
    client.put("lap.csv", TEXT)
    client.granted(Opcode.CREATE_FILE, b"/lap.csv")
    for at in range(0, 800, 80):
        client.granted(Opcode.WRITE_FILE, b"x" * 80, offset=at)
    assert client.refused(Opcode.TERMINATE_SESSION) == failed(errno.EAGAIN)
    assert said[-1][0].startswith("lap.csv: it may be cut off") and not said[-1][1]
    assert (tmp_path / "lap.csv").read_bytes() == TEXT
    assert RECEIVED.unpack(client.granted(Opcode.OPEN_FILE_WO, b"lap.csv").data)[0] == 800


ROWS = b"t_s,x_m,y_m,z_m    \n" + b"".join(b"%6.2f,%6.2f,%5.2f\n" % (i, i, 2.0) for i in range(7))
"""Every block of 80 bytes ends with a line."""


@pytest.mark.parametrize("end", [Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS])
@pytest.mark.parametrize("blocks", [1, 2])
@pytest.mark.parametrize("stored", [b"", ROWS + b"  7.00,  7.00, 2.00\n", TEXT])
def test_giving_up_at_the_end_of_a_line_is_no_upload(client, tmp_path, said, end, blocks, stored):
    if stored:
        client.put("lap.csv", stored)
    client.granted(Opcode.CREATE_FILE, b"lap.csv")
    for at in range(0, 80 * blocks, 80):
        client.granted(Opcode.WRITE_FILE, ROWS[at : at + 80], offset=at)
    reply = client.ask(end)
    assert reply.opcode == (Opcode.NAK if end == Opcode.TERMINATE_SESSION else Opcode.ACK)
    assert said[-1] == (
        "lap.csv: it may be cut off, as it ends with a full block: add an empty line at its end, or use"
        " `companion upload`; not stored",
        False,
    )
    assert (tmp_path / "lap.csv").read_bytes() == stored if stored else not (tmp_path / "lap.csv").exists()


@pytest.mark.parametrize("block", [80, 239])
def test_an_empty_line_at_the_end_cures_a_length_that_ends_with_a_full_block(client, tmp_path, block):
    content = (ROWS * 300)[: 239 * 80]
    assert client.put("lap.csv", content, block=block).opcode == Opcode.NAK
    assert client.put("lap.csv", content + b"\n", block=block).opcode == Opcode.ACK
    assert (tmp_path / "lap.csv").read_bytes() == content + b"\n"


def test_the_beginning_of_what_is_stored_does_not_replace_it(client, tmp_path, said):
    client.put("lap.csv", TEXT)
    reply = client.put("lap.csv", TEXT[:300])
    assert (reply.opcode, tuple(reply.data)) == (Opcode.NAK, failed(errno.EAGAIN))
    assert said[-1][0] == (
        "lap.csv: it is the beginning of the file that is stored: remove that one first, or use `companion upload`;"
        " not stored"
    )
    assert (tmp_path / "lap.csv").read_bytes() == TEXT


def test_a_sender_that_says_what_the_whole_is(client, tmp_path):
    client.granted(Opcode.CREATE_FILE, b"/lap.csv")
    client.granted(Opcode.WRITE_FILE, TEXT[:239])
    whole = EXPECTED.pack(len(TEXT), crc32(TEXT))
    assert client.refused(Opcode.TERMINATE_SESSION, whole) == failed(errno.EAGAIN)
    client.granted(Opcode.OPEN_FILE_WO, b"/lap.csv")
    for at in range(239, len(TEXT), 239):
        client.granted(Opcode.WRITE_FILE, TEXT[at : at + 239], offset=at)
    client.granted(Opcode.TERMINATE_SESSION, whole)
    assert (tmp_path / "lap.csv").read_bytes() == TEXT


def test_repeated_requests_are_answered_without_doing_them_twice(client, server, tmp_path):
    first = client.granted(Opcode.CREATE_FILE, b"lap.csv")
    client.granted(Opcode.WRITE_FILE, b"one line\n")
    assert client.tell(Opcode.CREATE_FILE, b"lap.csv", seq=first.seq - 1) == [first]
    done = client.granted(Opcode.TERMINATE_SESSION)
    assert client.tell(Opcode.TERMINATE_SESSION, seq=done.seq - 1) == [done]
    assert (tmp_path / "lap.csv").read_bytes() == b"one line\n"
    renamed = client.granted(Opcode.RENAME, b"lap.csv\0new.csv")
    assert client.tell(Opcode.RENAME, b"lap.csv\0new.csv", seq=renamed.seq - 1) == [renamed]
    removed = client.granted(Opcode.REMOVE_FILE, b"new.csv")
    assert client.tell(Opcode.REMOVE_FILE, b"new.csv", seq=removed.seq - 1) == [removed]
    client.put("new.csv", b"again\n")
    assert client.tell(Opcode.REMOVE_FILE, b"new.csv", seq=removed.seq - 1) == [removed]
    assert (tmp_path / "new.csv").exists()


def test_requests_repeated_with_a_new_number(client, tmp_path):
    """MAVSDK counts on when it repeats."""
    client.granted(Opcode.CREATE_FILE, b"lap.csv\0")
    client.granted(Opcode.CREATE_FILE, b"lap.csv\0")
    client.granted(Opcode.WRITE_FILE, b"one line\n")
    client.granted(Opcode.WRITE_FILE, b"one line\n")
    client.granted(Opcode.TERMINATE_SESSION)
    client.granted(Opcode.TERMINATE_SESSION)
    client.granted(Opcode.REMOVE_FILE, b"lap.csv\0")
    client.granted(Opcode.REMOVE_FILE, b"lap.csv\0")
    client.now_s += 7.0
    assert client.refused(Opcode.REMOVE_FILE, b"lap.csv\0") == NOT_FOUND
    client.put("lap.csv", b"again\n")
    client.granted(Opcode.REMOVE_FILE, b"lap.csv\0")
    assert not (tmp_path / "lap.csv").exists()


def test_a_client_that_died_and_begins_with_the_same_numbers(server, tmp_path):
    one = Raw(server)
    one.granted(Opcode.CREATE_FILE, b"lap.csv")
    for at in range(0, 2390, 239):
        one.granted(Opcode.WRITE_FILE, b"o" * 239, offset=at)
    assert Raw(server).put("lap.csv", TEXT[:500]).opcode == Opcode.ACK
    assert (tmp_path / "lap.csv").read_bytes() == TEXT[:500]


def test_a_burst_is_paced_and_ends_for_the_client_to_ask_again(client):
    client.put("lap.csv", TEXT * 20)
    client.granted(Opcode.OPEN_FILE_RO, b"lap.csv")
    client.now_s += 1.0
    sent = client.tell(Opcode.BURST_READ_FILE, size=239)
    assert 1 <= len(sent) <= 10
    while not sent[-1].burst_complete:
        sent += client.tick()
    assert len(sent) == BURST_PACKETS
    assert [packet.offset for packet in sent] == [239 * i for i in range(BURST_PACKETS)]
    assert [packet.seq for packet in sent] == [client.seq + 1 + i for i in range(BURST_PACKETS)]
    assert client.tick(1.0) == []
    client.tell(Opcode.BURST_READ_FILE, size=239, offset=239)
    replaced = client.tell(Opcode.BURST_READ_FILE, size=239, offset=0)
    rest = replaced + [packet for _ in range(20) for packet in client.tick()]
    assert {packet.seq for packet in rest} == {client.seq + 1 + i for i in range(BURST_PACKETS)}


def test_the_radio_gets_less(server):
    Raw(server).put("lap.csv", TEXT * 20)
    radio = Raw(server, link=Recorder("vehicle"))
    radio.granted(Opcode.OPEN_FILE_RO, b"lap.csv")
    radio.tell(Opcode.BURST_READ_FILE, size=239)
    radio.tick(1.0)
    before = len(radio.link.sent)
    for _ in range(100):
        radio.tick(0.02)
        if radio.link.sent[-1].burst_complete:
            radio.tell(Opcode.BURST_READ_FILE, size=239, offset=radio.link.sent[-1].offset + 239)
    assert (len(radio.link.sent) - before) * 280 < 2.0 * 4000.0


def test_a_download_is_one_version_of_the_file(client):
    client.put("lap.csv", TEXT)
    client.granted(Opcode.OPEN_FILE_RO, b"lap.csv", session=3)
    client.put("lap.csv", b"other\n")
    assert client.granted(Opcode.READ_FILE, session=3, size=239).data == TEXT[:239]
    client.granted(Opcode.REMOVE_FILE, b"lap.csv")
    assert client.granted(Opcode.READ_FILE, session=3, size=239, offset=239).data == TEXT[239:478]


def test_an_idle_session_is_closed_and_its_upload_kept(client, server):
    client.granted(Opcode.CREATE_FILE, b"lap.csv")
    client.granted(Opcode.WRITE_FILE, TEXT[:239])
    client.tick(SESSION_IDLE_MAX_S + 1.0)
    assert client.refused(Opcode.WRITE_FILE, TEXT[:239]) == INVALID_SESSION
    assert RECEIVED.unpack(client.granted(Opcode.OPEN_FILE_WO, b"lap.csv").data)[0] == 239
    client.granted(Opcode.RESET_SESSIONS)
    client.tick(SESSION_IDLE_MAX_S + 1.0)
    assert server._clients == {}


def test_open_files_are_bounded(server):
    open_before = len(os.listdir("/proc/self/fd"))
    Raw(server).put("a.csv", b"x\n")
    for i in range(40):
        client = Raw(server, (i + 1, 190))
        for session in range(10):
            client.tell(Opcode.OPEN_FILE_RO, b"a.csv", session=session)
    assert len(server._clients) == CLIENTS_MAX
    assert client.refused(Opcode.NONE) == (5,)
    assert len(os.listdir("/proc/self/fd")) - open_before <= CLIENTS_MAX * 4
    server.close()
    assert len(os.listdir("/proc/self/fd")) == open_before - 1  # the lock of the folder was one of them


def test_quota_of_the_disk(tmp_path):
    client = Raw(FileServer(make_store(tmp_path, limits=Limits(files=1, file_bytes=300, total_bytes=400))))
    client.put("a.csv", b"x\n")
    assert client.refused(Opcode.CREATE_FILE, b"b.csv") == failed(errno.EDQUOT)
    client.granted(Opcode.CREATE_FILE, b"a.csv")
    assert client.refused(Opcode.WRITE_FILE, b"x" * 239, offset=0xFFFFFFFF) == failed(errno.EDQUOT)
    assert client.refused(Opcode.WRITE_FILE, b"x" * 50, offset=260) == failed(errno.EFBIG)
    client.granted(Opcode.WRITE_FILE, b"y\n")
    assert client.refused(Opcode.TERMINATE_SESSION) == failed(errno.EAGAIN)
    assert (tmp_path / "a.csv").read_bytes() == b"x\n"


@pytest.mark.parametrize(("opcode", "patience_s"), [(Opcode.TERMINATE_SESSION, 3.0), (Opcode.RESET_SESSIONS, 0.8)])
@pytest.mark.parametrize("accepted", [True, False, None])
def test_the_answer_waits_for_the_verdict(tmp_path, said, opcode, patience_s, accepted):
    examiner = Slow()
    client = Raw(FileServer(TrajectoryStore(tmp_path, examiner), lambda text, good: said.append(good)))
    client.granted(Opcode.CREATE_FILE, b"lap.csv")
    client.granted(Opcode.WRITE_FILE, b"a line\n")
    assert client.tell(opcode) == []
    first = client.seq
    client.now_s += 0.3
    assert client.tell(opcode) == client.tell(opcode, seq=client.seq) == []
    assert client.tick(0.1) == []
    if accepted is not None:
        examiner.finding = Finding(accepted, "so it is")
    answers = client.tick(0.02 if accepted is not None else patience_s)
    assert [a.seq for a in answers] == [first + 1, first + 2]
    assert {a.opcode for a in answers} == {Opcode.NAK if accepted is False else Opcode.ACK}
    assert {a.req_opcode for a in answers} == {opcode}
    assert said == [] if accepted is None else [accepted]
    if accepted is None:
        examiner.finding = Finding(True, "at last")
        assert client.tick() == []
        assert said == [True]


requests = st.tuples(
    st.one_of(st.integers(0, 17), st.integers(0, 255)),
    st.integers(0, 3),
    st.one_of(
        st.sampled_from(
            [b"a.csv", b"/b.csv\0", b"a.csv\0b.csv", b"index.json", b"..", b"/../../x", b"/", b"", b"\xff"]
        ),
        st.binary(max_size=239),
    ),
    st.one_of(st.integers(0, 600), st.integers(0, 0xFFFFFFFF)),
    st.one_of(st.none(), st.integers(0, 255)),
    st.integers(0, 65535),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(requests, max_size=60), st.integers(0, 2))
def test_random_requests(tmp_path_factory, wanted, seed):
    """Never an exception, one answer each (but for bursts), nothing outside the folder, the files whole."""
    outer = tmp_path_factory.mktemp("random")
    server = FileServer(make_store(outer / "in", limits=Limits(files=3, file_bytes=2000, total_bytes=5000, uploads=3)))
    clients = [Raw(server, (250 + i, 190)) for i in range(2)]
    clients[0].put("a.csv", TEXT[:500])
    for i, (opcode, session, data, offset, size, seq) in enumerate(wanted):
        client = clients[(i + seed) % 2]
        fields = {"session": session, "offset": offset, "seq": seq}
        answers = client.tell(opcode, data, **fields, **({} if size is None else {"size": size}))
        if opcode in {Opcode.ACK, Opcode.NAK}:
            assert answers == []
        elif opcode != Opcode.BURST_READ_FILE:
            assert len(answers) == 1
        for answer in answers:
            assert answer.opcode in {Opcode.ACK, Opcode.NAK} and answer.req_opcode == opcode
            assert answer.opcode == Opcode.ACK or answer.size == len(answer.data) == 1 + (answer.data[0] == 2)
        if i % 7 == 0:
            client.tick(3.0)
    server.close()
    assert [p.name for p in outer.iterdir()] == ["in"]
    for path in (outer / "in").iterdir():
        assert (
            path.name.startswith(".part-")
            or path.name in {"a.csv", "b.csv", ".catalogue.json", ".lock"}
            or accepts(path)
        )
    for entry in server._store.entries():
        assert crc32((outer / "in" / entry.name).read_bytes()) == entry.crc32


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=260))
def test_truncated_and_random_payloads(tmp_path_factory, payload):
    folder: Path = tmp_path_factory.mktemp("payload")
    server = FileServer(make_store(folder))
    link = Recorder()
    server.handle(frame(payload), link, 1.0)
    for i in range(3):
        server.handle(frame(b"\0\7\xbf" + payload), link, 2.0 + i)
    server.tick(9.0)
    assert all(name.startswith((".part-", ".catalogue", ".lock")) for name in os.listdir(folder))
    assert decode(payload)[2].size <= 255
    server.close()
