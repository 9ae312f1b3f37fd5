"""The client over a network that loses, repeats and reorders, on a clock of its own; and the three commands."""

import errno
import json

import pytest
from ftp_cases import VEHICLE, Network, Raw, killed, make_store

from companion.cli import main
from companion.errors import InputError, LinkError, RefusedError
from companion.ground.examine import Here
from companion.ground.exchange import WINDOW_MAX, Pace
from companion.ground.files import FileServer
from companion.ground.ftp import Failure, Opcode, crc32, encode
from companion.ground.store import Limits, TrajectoryStore
from companion.ground.upload import Files, StoredFile

LINES = b"".join(b"%d,%f,%f,0.0\n" % (i, i * 0.1, i * 0.01) for i in range(60_000))
MEGABYTE = LINES[:1_000_000]


def client(network, **options):
    return Files(network, clock=network.clock, sleep=network.sleep, **options)


@pytest.fixture
def server(tmp_path):
    return FileServer(make_store(tmp_path))


def test_upload_list_read_remove(server, tmp_path):
    network = Network(server)
    files = client(network)
    assert files.system == VEHICLE
    shown = []
    verdict = files.upload_bytes(LINES[:10_000], "lap.csv", progress=lambda there, total: shown.append((there, total)))
    assert (verdict.accepted, verdict.verdict, verdict.id, verdict.resumed_from) == (True, "may be flown", 1, 0)
    assert shown[0] == (0, 10_000) and shown[-1] == (10_000, 10_000) and shown == sorted(shown)
    assert files.list() == [StoredFile(1, "lap.csv", 10_000, crc32(LINES[:10_000]), True, "may be flown")]
    assert files.read("lap.csv") == LINES[:10_000]
    files.remove("lap.csv")
    assert files.list() == []
    with pytest.raises(InputError, match="no such file"):
        files.remove("lap.csv")
    with pytest.raises(InputError, match="no such file"):
        files.read("lap.csv")


def test_refused_by_the_check(server, tmp_path):
    files = client(Network(server))
    files.upload_bytes(b"good\n", "lap.csv")
    verdict = files.upload_bytes(b"bad\n", "lap.csv")
    assert (verdict.accepted, verdict.verdict, verdict.id) == (False, "lap.csv: asks for too much", None)
    assert files.read("lap.csv") == b"good\n"


def test_an_empty_file_reaches_the_check(tmp_path):
    def check(path):
        raise InputError(f"{path.name}: is empty")

    verdict = client(Network(FileServer(TrajectoryStore(tmp_path, Here(check))))).upload_bytes(b"", "x.csv")
    assert (verdict.accepted, verdict.verdict) == (False, "x.csv: is empty")


@pytest.mark.parametrize(
    ("seed", "loss", "repeat", "jitter_s"), [(1, 0.1, 0.0, 0.0), (2, 0.1, 0.05, 0.02), (3, 0.3, 0.1, 0.05)]
)
def test_complete_and_intact_over_a_bad_network(server, tmp_path, seed, loss, repeat, jitter_s):
    network = Network(server, seed, loss=loss, repeat=repeat, jitter_s=jitter_s)
    content = LINES[:100_000]
    for i in range(3):
        files = client(network)
        assert files.upload_bytes(content[i:], f"lap {i}.csv").accepted
        assert (tmp_path / f"lap {i}.csv").read_bytes() == content[i:]
    assert files.read("lap 1.csv") == content[1:]
    files.remove("lap 0.csv")
    assert [stored.name for stored in files.list()] == ["lap 1.csv", "lap 2.csv"]


def test_loss_alone_does_not_slow_it_down(server):
    """A network with 10 % loss each way and 8 ms to and fro: full use would take 1.3 s with the largest window."""
    network = Network(server, 4, loss=0.1)
    begin_s = network.now_s
    assert client(network).upload_bytes(MEGABYTE, "lap.csv").accepted
    assert network.now_s - begin_s < 6.0


def test_a_slow_radio_is_not_flooded(server):
    """What queues up on the way grows no longer than some tenths of a second's worth."""

    class Radio(Network):
        queued_until_s = 0.0
        longest_s = 0.0

        def send(self, msgid, payload):
            self.queued_until_s = max(self.queued_until_s, self.now_s) + 280 / 5760
            self.longest_s = max(self.longest_s, self.queued_until_s - self.now_s)
            self.delay_s = self.queued_until_s - self.now_s
            return super().send(msgid, payload)

    network = Radio(server)
    assert client(network).upload_bytes(LINES[:20_000], "lap.csv").accepted
    assert network.longest_s < 1.0


def test_a_cut_off_upload_goes_on(server, tmp_path):
    network = Network(server)
    network.stop_after = 300
    with pytest.raises(LinkError, match="no answer from system 7 for 10 s"):
        client(network).upload_bytes(LINES[:100_000], "lap.csv")
    assert not (tmp_path / "lap.csv").exists()
    network.stop_after = None
    network.carried = 0
    verdict = client(network).upload_bytes(LINES[:100_000], "lap.csv")
    assert verdict.accepted and verdict.resumed_from > 30_000
    assert network.carried < 700
    assert (tmp_path / "lap.csv").read_bytes() == LINES[:100_000]


def test_another_file_does_not_go_on_with_the_first(server, tmp_path):
    network = Network(server)
    network.stop_after = 300
    with pytest.raises(LinkError):
        client(network).upload_bytes(LINES[:100_000], "lap.csv")
    network.stop_after = None
    verdict = client(network).upload_bytes(b"9" + LINES[1:500], "lap.csv")
    assert verdict.accepted and verdict.resumed_from == 0
    assert (tmp_path / "lap.csv").read_bytes() == b"9" + LINES[1:500]


def test_it_goes_on_when_the_server_is_started_again(tmp_path):
    network = Network(FileServer(make_store(tmp_path)))
    restarted = []

    def progress(there, total):
        if there > 50_000 and not restarted:
            restarted.append(there)
            killed(network.server._store)
            network.server = FileServer(make_store(tmp_path))

    assert client(network).upload_bytes(LINES[:100_000], "lap.csv", progress=progress).accepted
    assert (tmp_path / "lap.csv").read_bytes() == LINES[:100_000]
    assert restarted and network.carried < 1100


def test_nobody_answers():
    network = Network(None)
    with pytest.raises(LinkError, match="does `companion serve` run"):
        client(network, patience_s=2.0)
    assert 52.0 <= network.now_s < 52.5


class Two(Network):
    """Two vehicles at one link."""

    def send(self, msgid, payload):
        super().send(msgid, payload)
        return super().send(msgid, payload)

    def receive(self, timeout_s):
        found = super().receive(timeout_s)
        return [f._replace(sysid=VEHICLE + i) for f in found for i in range(2)]


def test_several_vehicles(server):
    with pytest.raises(InputError, match=r"systems 7, 8\): say which with --system"):
        client(Two(server))
    assert client(Two(server), system=8).system == 8


@pytest.mark.parametrize("name", ["../x", "", ".hidden", "a/b", "x" * 101, "index.json", "\udcff"])
def test_names_are_refused_before_anything_is_sent(server, name):
    network = Network(server)
    files = client(network)
    carried = network.carried
    with pytest.raises(InputError, match="choose another name"):
        files.upload_bytes(b"x", name)
    assert network.carried == carried


def test_quotas_in_words(tmp_path):
    files = client(Network(FileServer(make_store(tmp_path, limits=Limits(files=1, file_bytes=1000)))))
    files.upload_bytes(b"x\n", "a.csv")
    with pytest.raises(RefusedError, match=r"b.csv: the vehicle has no room for it"):
        files.upload_bytes(b"x\n", "b.csv")
    with pytest.raises(InputError, match=r"a.csv: is longer than what the vehicle takes"):
        files.upload_bytes(b"x" * 2000, "a.csv")


def test_somebody_else_uploads_it(server):
    other = Raw(server, (255, 190))
    other.now_s = 50.0
    other.granted(Opcode.CREATE_FILE, b"a.csv")
    with pytest.raises(RefusedError, match="somebody else"):
        client(Network(server)).upload_bytes(b"x", "a.csv")


@pytest.mark.parametrize("failure", list(Failure))
@pytest.mark.parametrize("number", [0, errno.EIO, 200])
def test_any_refusal_has_words(failure, number):
    class Refuses:
        def handle(self, frame, link, now_s):
            seq = int.from_bytes(frame.payload[3:5], "little")
            packet = Raw(None).request(Opcode.ACK if frame.payload[6] == 0 else Opcode.NAK, bytes([failure, number]))
            link.send(110, encode(254, 190, packet._replace(seq=seq + 1, req_opcode=frame.payload[6])))

        def tick(self, now_s):
            pass

    with pytest.raises((RefusedError, InputError, LinkError), match=r"^a.csv: "):
        client(Network(Refuses())).upload_bytes(b"x", "a.csv")


def test_an_index_that_is_none(server, monkeypatch):
    for index in (b"", b"[]", b'{"trajectories": [{}], "uploads": []}', b"\xff", b'{"trajectories": 1, "uploads": 2}'):
        monkeypatch.setattr(server._store, "index", lambda index=index: index)
        with pytest.raises(LinkError, match="sends an index that cannot be read"):
            client(Network(server)).list()


def test_a_verdict_that_does_not_come(tmp_path):
    class Never:
        def begin(self, path):
            return self

        def poll(self):
            return None

    network = Network(FileServer(TrajectoryStore(tmp_path, Never())))
    with pytest.raises(LinkError, match="there is no verdict after 20 s"):
        client(network).upload_bytes(b"x\n", "a.csv", verdict_patience_s=20.0)


def test_the_pace():
    pace = Pace()
    for i in range(2000):
        pace.sample(0.01, i * 0.001)
    assert pace.window == WINDOW_MAX
    assert 0.05 <= pace.timeout_s(1) < 0.06
    assert pace.timeout_s(20) == 2.0
    for i in range(200):
        pace.sample(0.2, 2.0 + i * 0.01)
    assert pace.window < 20.0
    for i in range(100):
        pace.overdue(10.0 + i)
    assert pace.window == 2.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["upload", "no such file.csv"], "no trajectory file"),
        (["upload", "paper", "--to", "nonsense"], 'connection "nonsense"'),
        (["list", "--to", "udpout:127.0.0.1:99999"], "port 99999"),
        (["remove", "a.csv", "--system", "256"], "--system"),
    ],
)
def test_what_is_wrong_with_a_command(capsys, arguments, words):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert words in err and len(err.splitlines()) == 1 and out == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lap.csv", "--frame", "enu", "--name", "lap.csv"], "with --frame or --laps the file goes as TOML; lap.toml"),
        (["lap.csv", "--laps", "2", "--name", "Lap.PLAN"], "with --frame or --laps the file goes as TOML; Lap.toml"),
        (
            ["lap.csv", "--laps", "2", "--name", "lap v1.2"],
            "with --frame or --laps the file goes as TOML; lap v1.2.toml",
        ),
        (["around.toml", "--name", "lap.csv"], "the file is TOML; lap.toml"),
        (["circle", "--name", "circle"], "the file is TOML; circle.toml"),
        (["circle", "--laps", "2", "--name", "circle.txt"], "the file is TOML; circle.toml"),
    ],
)
def test_toml_under_another_name_is_refused_before_it_is_sent(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("companion.ground.upload.Wire.open", lambda *_, **__: pytest.fail("a link was opened"))
    (tmp_path / "lap.csv").write_text("0,0,5\n5,0,5\n")
    (tmp_path / "around.toml").write_text('file = "lap.csv"\nframe = "enu"\n')
    assert main(["upload", *arguments]) == 2
    why, _, better = words.partition("; ")
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"companion: --name {arguments[-1]}: {why}; name it {better}\n")


def joined(server, monkeypatch) -> Network:
    """The command line's link leads to the server, in the network's own time."""
    network = Network(server)
    network.close = lambda: None
    monkeypatch.setattr("companion.ground.upload.Wire.open", lambda *_, **__: network)
    defaults = Files.__init__.__kwdefaults__
    monkeypatch.setitem(defaults, "clock", network.clock)
    monkeypatch.setitem(defaults, "sleep", network.sleep)
    return network


def test_the_reader_s_notes_come_first(server, tmp_path, monkeypatch, capsys):
    joined(server, monkeypatch)
    lap = tmp_path.parent / "lap.csv"
    lap.write_text("east,north,up,yaw_deg\n0,0,5,0\n5,0,5,0\n")
    assert main(["upload", str(lap)]) == 0
    note, stored, _ = capsys.readouterr().out.splitlines()
    assert note.startswith(
        "  yaw_deg counts from east to north in this frame: the first point's 0 is a heading of 90 deg"
    )
    assert stored.startswith("lap.csv: stored with number 1")
    assert main(["upload", str(lap), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == [note.strip()]


def test_a_name_that_fits_is_taken(server, tmp_path, monkeypatch, capsys):
    joined(server, monkeypatch)
    lap = tmp_path.parent / "lap.csv"
    lap.write_text("0,0,5\n5,0,5\n")
    for arguments in (
        [str(lap), "--frame", "enu", "--name", "mine.toml"],
        [str(lap), "--name", "anything"],
        ["circle", "--name", "C.TOML"],
    ):
        assert main(["upload", *arguments, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["name"] == arguments[-1]


def test_the_commands(server, tmp_path, monkeypatch, capsys):
    joined(server, monkeypatch)
    good, bad = tmp_path.parent / "good.csv", tmp_path.parent / "bad.csv"
    good.write_bytes(b"1,2\n")
    bad.write_bytes(b"bad\n")
    assert main(["upload", str(good)]) == 0
    assert "good.csv: stored with number 1 (4 bytes" in capsys.readouterr().out
    assert main(["upload", "paper", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "paper.toml"
    assert main(["upload", str(bad), "--name", "good.csv"]) == 3
    assert capsys.readouterr().out == "good.csv: REFUSED by the vehicle: good.csv: asks for too much\n"
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert "good.csv" in out and "paper.toml" in out and "may be flown" in out
    assert main(["remove", "good.csv"]) == 0
    assert main(["remove", "good.csv"]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["list", "--json"]) == 0
    assert [item["name"] for item in json.loads(capsys.readouterr().out)] == ["paper.toml"]
