"""The parameter server as a ground tool sees it: lists, reads, sets, refusals; and as a stranger does: no faults."""

import struct
import tomllib
import zlib
from dataclasses import dataclass, field

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.config import load_vehicle
from companion.errors import InputError
from companion.flight.retuning import ParameterChange
from companion.ground.parameter_file import file_for, load_tuning, save_tuning
from companion.ground.parameter_messages import encode_error, encode_value
from companion.ground.parameters import COUNT, ParameterServer
from companion.ground.trial import AtOnce, InThread, judge
from companion.ground.tuning import ENTRIES, INT32, REAL32, Tuning, find
from companion.link import codec
from companion.link.framing import Frame

READ, LIST, VALUE, SET, ERROR = 20, 21, 22, 23, 345
OUT_OF_RANGE, PERMISSION, MISMATCH, NO_SUCH = 2, 3, 7, 1
VEHICLE = load_vehicle("bundled")


@dataclass
class Link:
    """A ground tool's end."""

    name: str = "udpin:127.0.0.1:1"
    sent: list = field(default_factory=list)

    def send(self, msgid, payload):
        self.sent.append(decoded(msgid, payload))

    def take(self):
        sent, self.sent = self.sent, []
        return sent


def decoded(msgid, payload):
    """What pymavlink reads in it."""
    message = codec.dialect().mavlink_map[msgid]
    fields = dict(zip(message.ordered_fieldnames, message.unpacker.unpack(payload), strict=True))
    name = fields["param_id"].split(b"\0")[0].decode(errors="replace")
    if msgid == VALUE:
        raw = payload[:4]
        kind = {INT32: "<i", REAL32: "<f", 5: "<I"}[fields["param_type"]]
        return (VALUE, name, struct.unpack(kind, raw)[0], fields["param_index"], fields["param_count"])
    assert msgid == ERROR
    assert (fields["target_system"], fields["target_component"]) == (255, 190)
    return (ERROR, name, fields["error"], fields["param_index"])


class Control:
    """The control process: takes everything, or says why not."""

    def __init__(self):
        self.asked = []
        self.refusal = ""
        self.answers = True
        self.reached = True
        self.server = None

    def request(self, number, what, **content):
        assert what == "parameters"
        if not self.reached:
            return False
        self.asked.append((number, ParameterChange.from_note(content["change"])))
        return True

    def turn(self, now_s):
        if not self.answers:
            return
        asked, self.asked = self.asked, []
        for number, change in asked:
            self.latest = change
            assert self.server.on_taken(number, self.refusal, now_s)


class Desk:
    """A server with everything around it."""

    def __init__(self, folder, tuning=None, judge_=judge):
        self.path = folder / "parameters.toml"
        self.said = []
        self.control = Control()
        self.link = Link()
        self.now_s = 100.0
        tuning = Tuning(VEHICLE) if tuning is None else tuning
        tell = lambda text, good: self.said.append((text, good))  # noqa: E731
        self.server = ParameterServer(tuning, self.path, self.control, tell, lambda: 1, AtOnce(judge_))
        self.control.server = self.server
        self.turn()

    def turn(self, seconds=0.02):
        for _ in range(max(1, round(seconds / 0.01))):
            self.now_s += 0.01
            self.server.tick(self.now_s)
            self.control.turn(self.now_s)

    def ask(self, msgid, payload, link=None, seconds=0.03):
        link = self.link if link is None else link
        handled = self.server.handle(Frame(msgid, 255, 190, 0, payload, b"", 0), link, self.now_s)
        self.turn(seconds)
        return handled, link.take()

    def set(self, name, value, kind=None, system=1, component=191, **options):
        kind = kind or (INT32 if isinstance(value, int) else REAL32)
        raw = struct.pack("<i" if isinstance(value, int) else "<f", value)
        return self.ask(SET, struct.pack("<4sBB16sB", raw, system, component, name.encode(), kind), **options)[1]

    def read(self, name="", index=-1, component=191):
        return self.ask(READ, struct.pack("<hBB16s", index, 1, component, name.encode()))[1]

    def value(self, name):
        return self.server.tuning.value(find(name))


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path)


def f32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


# -- reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("component", [0, 191])
def test_a_list_has_every_parameter_once_with_consistent_numbers(desk, component):
    values = desk.ask(LIST, bytes([1, component]), seconds=0.5)[1]
    assert [value[3] for value in values] == list(range(COUNT))
    assert {value[4] for value in values} == {COUNT}
    names = [value[1] for value in values]
    assert names == sorted(names) == sorted([*(entry.name for entry in ENTRIES), "OC_RESET"])
    for value in values:
        entry = find(value[1])
        assert value[2] == (0 if entry is None else f32(desk.value(entry.name)))


def test_a_parameter_is_read_by_name_and_by_index(desk):
    for value in desk.ask(LIST, bytes([1, 191]), seconds=0.5)[1]:
        assert desk.read(value[1]) == desk.read(index=value[3]) == [value]


def test_what_is_not_there_is_an_error_only_for_who_asked_us(desk):
    assert desk.read("MC_ROLL_P") == [(ERROR, "MC_ROLL_P", NO_SUCH, -1)]
    assert desk.read(index=COUNT) == [(ERROR, "", NO_SUCH, COUNT)]
    assert desk.read("MC_ROLL_P", component=0) == desk.read(index=3, component=0) == []
    assert desk.read("OC_K1", component=0)[0][:2] == (VALUE, "OC_K1")
    assert desk.set("MC_ROLL_P", 1.0) == [(ERROR, "MC_ROLL_P", NO_SUCH, -1)]
    assert desk.set("MC_ROLL_P", 1.0, component=0) == []


def test_requests_for_others_are_left_to_them(desk):
    for msgid, payload in (
        (LIST, bytes([1, 1])),
        (LIST, bytes([2, 191])),
        (READ, struct.pack("<hBB16s", 0, 1, 1, b"")),
    ):
        assert desk.ask(msgid, payload) == (False, [])
    assert desk.set("OC_K1", 2.1, component=1) == desk.set("OC_K1", 2.1, system=0) == []
    assert desk.ask(76, bytes(33)) == (False, [])
    assert desk.value("OC_K1") == 2.0


def test_the_checksum_is_over_names_and_values_and_changes_with_them(desk):
    crc = 0
    for entry in ENTRIES:
        crc = zlib.crc32(desk.server.tuning.wire(entry), zlib.crc32(entry.name.encode(), crc))
    assert desk.read("_HASH_CHECK") == [(VALUE, "_HASH_CHECK", crc, 65535, COUNT)]
    desk.set("OC_K1", 2.1)
    assert desk.read("_HASH_CHECK")[0][2] != crc


def test_a_list_over_the_radio_is_slow_and_ends_when_the_client_has_it(desk):
    radio = Link("vehicle")
    values = desk.ask(LIST, bytes([1, 191]), link=radio, seconds=0.5)[1]
    assert 8 <= len(values) < COUNT
    desk.turn(3.0)
    assert [value[3] for value in values + radio.take()] == list(range(COUNT))
    desk.ask(LIST, bytes([1, 191]), link=radio)
    desk.set("_HASH_CHECK", 0, link=radio)
    desk.turn(3.0)
    assert radio.take() == []


# -- setting ----------------------------------------------------------------------------------------------------------


def test_a_change_is_taken_told_everybody_and_kept_on_the_disk(desk):
    other = Link("udpin:127.0.0.1:2")
    desk.ask(READ, struct.pack("<hBB16s", 0, 1, 191, b""), link=other)
    answer = (VALUE, "OC_K1", f32(2.2), desk.read("OC_K1")[0][3], COUNT)
    assert desk.set("OC_K1", 2.2) == [answer]
    assert other.take() == [answer]
    assert desk.said == [("OC_K1 = 2.2 (was 2)", True)]
    assert desk.control.latest.applied(VEHICLE).controller.k1_1_s == 2.2
    assert tomllib.loads(desk.path.read_text()) == {"controller": {"k1_1_s": 2.2}}
    assert load_tuning(desk.path, VEHICLE) == desk.server.tuning


def test_what_the_certificate_refuses_stays_as_it_was(desk):
    before = desk.read("OC_GAMMA")[0]
    assert desk.set("OC_GAMMA", 500.0) == [(ERROR, "OC_GAMMA", OUT_OF_RANGE, -1), before]
    assert desk.value("OC_GAMMA") == 4.0 and not desk.path.exists()
    assert desk.control.latest.controller["gamma_1_s3"] == 4.0
    ((text, good),) = desk.said
    assert text.startswith("OC_GAMMA refused: the gains of vehicle 'bundled' are not certified") and not good


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("OC_K1", float("nan"), "between 0.01 and 100 1/s"),
        ("OC_K1", float("inf"), "between"),
        ("OC_K1", -1.0, "between"),
        ("OC_K4", 60.0, "sampled loop"),
        ("OC_P_MAX", 0.02, "bounded position error"),
        ("OC_THR_MAX", 1.0, "thrust_min_n 2.0 must be below"),
        ("OC_THR_MAX", 9.0, "enclose the weight"),
        ("OC_THR_MAX", 30.0, "four rotors"),
        ("OC_HDG_KIND", 3, "between 0 and 2"),
        ("OC_RESET", 2, "must be 1"),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_the_reason(desk, name, value, reason):
    before = desk.read(name)[0]
    if name == "OC_THR_MAX" and value == 9.0:
        assert desk.set("OC_THR_MIN", 1.0)[0][2] == 1.0
        desk.said.clear()
    assert desk.set(name, value) == [(ERROR, name, OUT_OF_RANGE, -1), before]
    assert reason in desk.said[0][0] and not desk.said[0][1]


def test_the_type_must_be_right(desk):
    assert desk.set("OC_K1", 2)[0] == (ERROR, "OC_K1", MISMATCH, -1)
    assert desk.set("OC_HDG_KIND", 2.0)[0] == (ERROR, "OC_HDG_KIND", MISMATCH, -1)
    assert desk.set("OC_HDG_KIND", 2, kind=4)[0] == (ERROR, "OC_HDG_KIND", MISMATCH, -1)
    assert desk.set("OC_HDG_KIND", 2)[0][:3] == (VALUE, "OC_HDG_KIND", 2)
    assert desk.server.tuning.vehicle.controller.heading == "commanded"


def test_what_the_control_process_refuses_stays_as_it_was(desk):
    desk.control.refusal = "a flight is being prepared; try again in a moment"
    assert desk.set("OC_K1", 2.2)[0] == (ERROR, "OC_K1", PERMISSION, -1)
    assert desk.value("OC_K1") == 2.0 and not desk.path.exists()
    assert "being prepared" in desk.said[0][0]


def test_without_a_control_process_nothing_changes_and_it_is_told_so_when_it_is_back(desk):
    desk.control.answers = False
    assert desk.set("OC_K1", 2.2) == []
    desk.turn(0.3)
    assert desk.link.take()[0] == (ERROR, "OC_K1", PERMISSION, -1)
    desk.turn(1.0)
    desk.control.answers = True
    desk.turn(2.0)
    assert desk.control.latest.controller["k1_1_s"] == 2.0
    desk.control.reached = False
    assert desk.set("OC_K1", 2.2)[0] == (ERROR, "OC_K1", PERMISSION, -1)
    desk.control.reached = True
    assert desk.set("OC_K1", 2.2)[0][0] == VALUE


def test_a_change_that_cannot_be_written_is_refused_and_taken_back(tmp_path):
    (tmp_path / "file").write_text("")
    desk = Desk(tmp_path / "file")
    assert desk.set("OC_K1", 2.2)[0] == (ERROR, "OC_K1", PERMISSION, -1)
    assert "cannot be written" in desk.said[0][0]
    desk.turn(0.1)
    assert desk.value("OC_K1") == desk.control.latest.controller["k1_1_s"] == 2.0


def test_a_fault_of_the_judge_is_a_refusal(tmp_path, capsys):
    def broken(old, new):
        raise ArithmeticError("no")

    desk = Desk(tmp_path, judge_=broken)
    assert desk.set("OC_K1", 2.2)[0] == (ERROR, "OC_K1", OUT_OF_RANGE, -1)
    assert "ArithmeticError" in desk.said[0][0]
    assert "ArithmeticError" in capsys.readouterr().err


def test_repetitions_are_done_once_and_answered(desk):
    desk.control.answers = False
    assert desk.set("OC_K1", 2.2) == []
    assert desk.set("OC_K1", 2.2) == []
    assert desk.set("OC_K2", 3.1) == []
    desk.control.answers = True
    desk.turn(0.1)
    assert [value[:2] for value in desk.link.take()] == [(VALUE, "OC_K1"), (VALUE, "OC_K2")]
    assert desk.set("OC_K1", 2.2)[0][:3] == (VALUE, "OC_K1", f32(2.2))
    assert len(desk.said) == 2


def test_everything_goes_back_to_the_vehicle_file(desk):
    desk.set("OC_K1", 2.2)
    desk.set("OC_RATE_MAX_Z", 2.5)
    assert desk.server.tuning.vehicle.limits.rate_max_rad_s == (6.0, 6.0, 2.5)
    answers = desk.set("OC_RESET", 1)
    after = [("OC_K1", 2.0), ("OC_RATE_MAX_Z", 3.0), ("OC_RESET", 0)]
    assert [value[1:3] for value in answers] == [("OC_RESET", 1), *after]
    assert desk.server.tuning == Tuning(VEHICLE)
    assert tomllib.loads(desk.path.read_text()) == {}
    assert desk.control.latest.applied(VEHICLE) == VEHICLE
    assert "from the next flight on" in desk.said[-1][0]


def test_a_step_through_what_is_not_sound_is_refused_with_what_to_do(tmp_path):
    quick = {
        "controller": {"gamma_1_s3": 0.0},
        "limits": {"disturbance_max_m_s2": 0.5, "state_gap_max_s": 0.01},
        "link": {"state_rate_hz": 250.0, "state_age_s": 0.0, "command_delay_s": 0.0},
        "autopilot": {"rate_lag_s": [0.04, 0.04, 0.04]},
        "rotors": {"lag_s": 0.04},
    }
    low = Tuning(load_vehicle("paper", quick))
    high = low
    for name, value in (("OC_K1", 4.0), ("OC_K2", 4.0), ("OC_K3", 8.0), ("OC_K4", 8.0), ("OC_GAMMA", 130.0)):
        high = high.changed(find(name), value)
    assert judge(high, high) == judge(low, low) == ""
    assert "change another parameter first" in judge(low, high)


def test_the_judge_in_a_thread_says_the_same():
    tuning = Tuning(VEHICLE)
    court = InThread(tuning)
    try:
        wanted = tuning.changed(find("OC_GAMMA"), 500.0)
        trial = court.begin(tuning, wanted)
        while (verdict := trial.poll()) is None:
            pass
        assert verdict == judge(tuning, wanted) != ""
    finally:
        court.close()


# -- strangers --------------------------------------------------------------------------------------------------------

names = st.one_of(
    st.sampled_from([e.name.encode() for e in ENTRIES] + [b"OC_RESET", b"_HASH_CHECK"]), st.binary(max_size=16)
)
targets = st.sampled_from([(1, 191), (1, 0), (0, 0), (0, 191), (1, 1), (9, 191)])
requests = st.one_of(
    st.builds(lambda t: (LIST, bytes(t)), targets),
    st.builds(lambda i, t, n: (READ, struct.pack("<hBB16s", i, *t, n)), st.integers(-32768, 32767), targets, names),
    st.builds(
        lambda v, t, n, k: (SET, struct.pack("<4sBB16sB", v, *t, n, k)),
        st.binary(min_size=4, max_size=4) | st.floats(0.125, 8.0, width=32).map(lambda x: struct.pack("<f", x)),
        targets, names, st.sampled_from([REAL32, INT32, 0, 5, 255]),
    ),
    st.tuples(st.sampled_from([LIST, READ, SET]), st.binary(max_size=40)),
)  # fmt: skip


def consistent(old, new):
    """The least that a judge does: what holds must be a vehicle."""
    try:
        _ = new.vehicle
    except InputError as error:
        return str(error)
    return ""


@settings(max_examples=60, deadline=None)
@example([(SET, struct.pack("<fBB16sB", 0.03125, 1, 191, b"OC_THR_MAX", REAL32))], True)  # less than OC_THR_MIN
@given(st.lists(requests, min_size=1, max_size=15), st.booleans())
def test_no_request_is_a_fault_and_every_value_is_consistent(tmp_path_factory, asked, sound):
    desk = Desk(tmp_path_factory.mktemp("desk"), judge_=consistent if sound else lambda old, new: "no")
    desk.turn(1.0)
    answers = []
    for msgid, payload in asked:
        answers += desk.ask(msgid, payload, seconds=0.02)[1]
    desk.turn(1.0)
    index = {value[1]: value[3] for value in desk.ask(LIST, bytes([1, 191]), seconds=0.5)[1]}
    assert len(index) == COUNT
    for answer in answers:
        if answer[0] == VALUE:
            assert answer[4] == COUNT
            assert answer[3] == index.get(answer[1], 65535)
    assert sound or not desk.server.tuning.changes
    assert load_tuning(desk.path, VEHICLE).changes == desk.server.tuning.changes
    assert desk.control.latest == desk.server.tuning.change


# -- the file ---------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.dictionaries(st.sampled_from(ENTRIES), st.floats(0.0, 1.0), max_size=8))
def test_what_is_written_is_read_again(tmp_path_factory, shares):
    path = tmp_path_factory.mktemp("file") / "parameters.toml"
    tuning = Tuning(VEHICLE)
    for entry, share in shares.items():
        value = entry.low + share * (entry.high - entry.low)
        tuning = tuning.changed(entry, round(value) if entry.words else value)
    save_tuning(path, tuning)
    try:
        assert load_tuning(path, VEHICLE) == tuning
    except InputError as error:  # together they may be no vehicle: thrusts that do not carry it
        assert "thrust" in str(error)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[controller]\nk1_1_s = 'x'\n", "controller.k1_1_s = 'x': must be a number"),
        ("[controller]\nk1_1_s = true\n", "must be a number"),
        ("[controller]\nk1_1_s = 1000.0\n", "OC_K1 = 1000 must be between"),
        ("[controller]\nk1_1_s = nan\n", "OC_K1 = nan must be between"),
        (f"[controller]\nk1_1_s = 1{'0' * 400}\n", "not a number that can be used"),
        ("[controller]\nheading = 'north'\n", "must be one of damping, sideslip, commanded"),
        ("[controller]\nprediction = false\n", "controller.prediction is no parameter"),
        ("[limits]\nrate_max_rad_s = [1.0, 2.0]\n", "must be three numbers"),
        ("[limits]\nthrust_max_n = 1.0\n", "must be below"),
        ("[body]\nmass_kg = 1.0\n", "body.mass_kg is no parameter"),
        ("controller = 3\n", "controller is no table"),
        ("[controller\n", "not valid TOML"),
    ],
)
def test_a_file_that_is_wrong_is_not_flown_with(tmp_path, text, reason):
    path = tmp_path / "parameters.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=str(path)) as raised:
        load_tuning(path, VEHICLE)
    assert reason in str(raised.value)


def test_the_files_of_different_vehicles_are_different_and_stay_in_the_folder(tmp_path):
    names = {file_for(tmp_path, name) for name in ("paper", "px4_sih", "../../x", "a b")}
    assert len(names) == 4 and all(path.parent == tmp_path and path.name.startswith(".") for path in names)


def test_the_messages_are_those_of_the_definition():
    library = codec.dialect()
    link = library.MAVLink(None, 1, 191)
    theirs = library.MAVLink_param_error_message(255, 190, b"OC_K1", -1, 2).pack(link)
    assert codec.decode_cold(Framed(theirs)).error == 2
    raw = encode_error((255, 190), b"OC_K1".ljust(16, b"\0"), -1, 2)
    assert theirs[10:-2] == raw.rstrip(b"\0")
    theirs = library.MAVLink_param_value_message(b"OC_K1", 2.5, 9, 23, 4).pack(link)
    assert theirs[10:-2] == encode_value("OC_K1", struct.pack("<f", 2.5), 9, 4, 23)


@dataclass
class Framed:
    raw: bytes
