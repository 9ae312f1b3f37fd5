"""flight.ulg: what is written is what pyulog and a strict reader read, under PX4's names."""

import io
import math
import random
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink
from pyulog import ULog
from pyulog.px4 import PX4ULog
from record_cases import row
from ulog_reader import parse

from companion.config import build_flight, find, read_toml
from companion.link.codec import message_formats
from companion.link.framing import build_frame
from companion.link.modes import HOLD, LAND, OFFBOARD, Mode
from companion.record import topics, ulog
from companion.record.columns import COLUMN_INDEX, COLUMNS
from companion.record.flight_log import Entry, FlightLog, envelope
from companion.record.tlog import Direction
from companion.record.traffic import NAV_STATES
from companion.record.ulog import Field, Level, Series, Topic

START_US = 5_000_000
FULL_NUMBERS = {**{kind: st.integers(*limits) for kind, limits in {
    **{"bool": (0, 1), "uint8_t": (0, 255), "int8_t": (-128, 127), "uint16_t": (0, 65535)},
    **{"int16_t": (-32768, 32767), "uint32_t": (0, 2**32 - 1), "int32_t": (-(2**31), 2**31 - 1)},
    **{"uint64_t": (0, 2**64 - 1), "int64_t": (-(2**63), 2**63 - 1)},
}.items()}, "float": st.floats(width=32), "double": st.floats()}  # fmt: skip


def pyulog_of(content: bytes) -> ULog:
    return ULog(io.BytesIO(content))


def same(got: object, wanted: float) -> bool:
    return got == wanted or (math.isnan(wanted) and math.isnan(float(got)))  # type: ignore[arg-type]


@st.composite
def series(draw: st.DrawFn) -> tuple[Topic, list[tuple[int, tuple[float, ...]]]]:
    kinds = draw(st.lists(st.tuples(st.sampled_from(sorted(FULL_NUMBERS)), st.integers(0, 4)), min_size=1, max_size=6))
    fields = tuple(
        Field(f"f{index}", f"{kind}[{size}]" if size else kind, "", "") for index, (kind, size) in enumerate(kinds)
    )
    numbers = st.tuples(*[FULL_NUMBERS[field.basic_type] for field in fields for _ in range(field.size)])
    times = sorted(draw(st.lists(st.integers(0, 2**63), min_size=1, max_size=5)))
    return Topic("a_topic", "", fields), [(t_us, draw(numbers)) for t_us in times]


@settings(max_examples=25, deadline=None)
@given(
    one=series(),
    start_us=st.integers(0, 2**63),
    texts=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 2**63), st.text(max_size=30)), max_size=3),
    facts=st.dictionaries(st.from_regex(r"[a-zA-Z0-9_/]{1,20}", fullmatch=True), st.text(min_size=1, max_size=30)),
    long_text=st.text(min_size=1, max_size=20).map(lambda text: text * 200),
    numbers=st.dictionaries(
        st.from_regex(r"[a-zA-Z0-9_/]{1,20}", fullmatch=True),
        st.integers(-(2**31), 2**31 - 1) | st.floats(width=32, allow_nan=False),
    ),
)
def test_both_readers_give_back_exactly_what_was_written(one, start_us, texts, facts, long_text, numbers) -> None:
    topic, records = one
    writer = Series(topic, 0)
    content = ulog.header(start_us) + ulog.format_definition(topic)
    content += b"".join(ulog.info(key, text) for key, text in facts.items()) + ulog.long_info("long", long_text)
    content += b"".join(ulog.parameter(key, value) for key, value in numbers.items())
    content += ulog.subscription(topic, 0) + b"".join(ulog.logged(*text) for text in texts)
    content += b"".join(writer.encode(t_us, values) for t_us, values in records) + ulog.sync() + ulog.dropout(12.4)
    strict, library = parse(content), pyulog_of(content)
    assert (strict.start_us, strict.info, strict.parameters) == (start_us, facts, numbers)
    assert (strict.texts, strict.dropouts_ms, strict.left_over) == (texts, [12], 0)
    assert "".join(strict.long_info["long"]) == long_text
    assert not library.file_corruption
    assert (library.start_timestamp, library.msg_info_dict, library.initial_parameters) == (start_us, facts, numbers)
    assert [(m.log_level - 48, m.timestamp, m.message) for m in library.logged_messages] == texts
    assert "".join(library.msg_info_multiple_dict["long"][0]) == long_text
    (data,) = library.data_list
    columns = list(data.data.values())
    for index, (t_us, values) in enumerate(records):
        wanted = (t_us, *values)
        assert all(map(same, strict.data["a_topic"][index], wanted))
        # pyulog gives bool as a small integer
        assert all(same(column[index].item(), number) for column, number in zip(columns, wanted, strict=True))


def test_numbers_that_do_not_fit_become_the_nearest_that_do() -> None:
    kinds = ("float", "float", "uint8_t", "uint8_t", "int8_t", "uint32_t", "bool", "double")
    topic = Topic("t", "", tuple(Field(f"f{i}", kind, "", "") for i, kind in enumerate(kinds)))
    record = Series(topic, 3).encode(7, (1e300, -1e39, 300.0, -4.0, -1e9, math.nan, 2.5, 1e300))
    assert struct.unpack("<HcHQffBBbI?d", record)[3:] == (7, math.inf, -math.inf, 255, 0, -128, 0, True, 1e300)
    assert parse(ulog.header(0) + ulog.parameter("a b;c", 10**400)).parameters == {"a_b_c": math.inf}
    assert parse(ulog.header(0) + ulog.parameter("whole", 2**31)).parameters == {"whole": 2.0**31}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**63), st.lists(st.floats(), min_size=11, max_size=11)), max_size=4))
def test_what_is_put_into_a_list_is_what_encode_gives(records) -> None:
    one, other = Series(topics.TRAJECTORY_SETPOINT, 3), Series(topics.TRAJECTORY_SETPOINT, 3)
    out: list[bytes] = []
    write = one.into(out)
    for record in records:
        write(*record)
    assert out == [other.encode(*record) for record in records]
    with pytest.raises(struct.error):
        write(2**64, [0.0] * 11)
    write(2**63, [0.0] * 11)
    assert out[len(records) :] == [other.encode(2**63, [0.0] * 11)]


def test_times_never_step_back() -> None:
    writer = Series(topics.DISTURBANCE, 0)
    times = [struct.unpack_from("<Q", writer.encode(t, (0.0, 0.0, 0.0)), 5)[0] for t in (5, 9, 7, 10)]
    assert times == [5, 9, 9, 10]


# ---- the table ------------------------------------------------------------------------------------------------------

PX4_FIELDS = {
    "vehicle_local_position": "uint64 timestamp_sample; bool xy_valid; bool z_valid; bool v_xy_valid; bool v_z_valid;"
    " float32 x; float32 y; float32 z; float32 vx; float32 vy; float32 vz; float32 heading",
    "vehicle_attitude": "uint64 timestamp_sample; float32[4] q",
    "vehicle_angular_velocity": "uint64 timestamp_sample; float32[3] xyz",
    "vehicle_rates_setpoint": "float32 roll; float32 pitch; float32 yaw; float32[3] thrust_body",
    "vehicle_attitude_setpoint": "float32 yaw_sp_move_rate; float32[4] q_d; float32[3] thrust_body",
    "vehicle_thrust_setpoint": "uint64 timestamp_sample; float32[3] xyz",
    "vehicle_torque_setpoint": "uint64 timestamp_sample; float32[3] xyz",
    "trajectory_setpoint": "float32[3] position; float32[3] velocity; float32[3] acceleration; float32 yaw;"
    " float32 yawspeed",
    "vehicle_local_position_setpoint": "float32 x; float32 y; float32 z; float32 vx; float32 vy; float32 vz;"
    " float32 yaw",
    "vehicle_status": "uint8 arming_state; uint8 nav_state_user_intention; uint8 nav_state; uint8 vehicle_type;"
    " bool is_vtol; uint8 system_type; uint8 system_id; uint8 component_id",
    "battery_status": "bool connected; float32 voltage_v; float32 current_a; float32 discharged_mah;"
    " float32 remaining; float32 time_remaining_s; float32 temperature; uint8 cell_count; uint8 id; uint8 warning",
    "vehicle_land_detected": "bool landed",
    "home_position": "float64 lat; float64 lon; float32 alt; float32 x; float32 y; float32 z",
}
"""As PX4's message definitions have them, those that are used."""
PX4_TYPES = {"float32": "float", "float64": "double", "bool": "bool", "uint8": "uint8_t", "uint64": "uint64_t"}


def test_names_and_types_are_px4s_or_clearly_ours() -> None:
    for topic in topics.TOPICS:
        if topic.name.startswith("companion_"):
            continue
        wanted = []
        for part in PX4_FIELDS[topic.name].split("; "):
            kind, _, name = part.strip().partition(" ")
            basic, bracket, rest = kind.partition("[")
            wanted.append((name, PX4_TYPES[basic] + bracket + rest))
        assert [(field.name, field.type) for field in topic.fields] == wanted
    assert len({topic.name for topic in topics.TOPICS}) == len(topics.TOPICS)


def test_every_column_of_the_record_is_in_the_log_in_full() -> None:
    full = [
        name
        for topic in topics.STEP_TOPICS
        for field in topic.fields
        for name in field.columns
        if topic.name.startswith("companion_")
    ]
    assert all(
        field.basic_type == "double" and field.size == len(field.columns)
        for topic in topics.STEP_TOPICS
        if topic is not topics.POSITION_SETPOINT
        for field in topic.fields
    )
    assert sorted(full) == sorted([*COLUMNS, "envelope"])


# ---- a flight -------------------------------------------------------------------------------------------------------


class Vehicle:
    """Makes the frames of an autopilot and of us."""

    def __init__(self, system: int = 1) -> None:
        self._theirs = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._ours = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)

    def says(self, message) -> tuple[int, bytes]:
        raw = message.pack(self._theirs)
        self._theirs.seq = (self._theirs.seq + 1) % 256
        return Direction.IN, bytes(raw)

    def hears(self, message) -> tuple[int, bytes]:
        return Direction.OUT, bytes(message.pack(self._ours))

    def heartbeat(self, mode: Mode = HOLD, armed: bool = True) -> tuple[int, bytes]:
        return self.says(mavlink.MAVLink_heartbeat_message(2, 12, 128 if armed else 0, mode.custom_mode, 4, 3))

    def state(self, t_us: int, p=(1.0, 2.0, -3.0), q=(1.0, 0.0, 0.0, 0.0), resets: int = 0) -> tuple[int, bytes]:
        none = [math.nan] * 21
        return self.says(
            mavlink.MAVLink_odometry_message(
                *(t_us, 1, 1, *p, list(q), 0.5, -0.25, 0.125),
                *(0.1 + 1e-10 * (t_us - START_US), 0.2, 0.3),  # an estimate that never changes at all is none
                *(none, none, resets, 1, 100),
            )
        )


def written(entries, configuration: str = "", wall_ns: int = 0) -> bytes:
    """The log of a flight of these entries."""
    log = FlightLog(configuration, 0)
    for kind, raw in entries:
        log.take(kind, raw, wall_ns)
    return log.end()


def a_row(t_us: int, seed: int = 0, **values: float) -> tuple[float, ...]:
    numbers = random.Random(seed)
    return row(**{name: numbers.uniform(-5.0, 5.0) for name in COLUMNS} | {"t_s": t_us * 1e-6, "phase": 4.0} | values)


def packed(numbers: tuple[float, ...]) -> tuple[int, bytes]:
    return Entry.ROW, struct.pack(f"={len(numbers)}d", *numbers)


def table_of(content: bytes) -> np.ndarray:
    """The record as the log has it, by pyulog."""
    library = pyulog_of(content)
    count = len(library.get_dataset("companion_step").data["timestamp"])
    table = np.full((count, len(COLUMNS)), np.nan)
    for topic in topics.STEP_TOPICS:
        if not topic.name.startswith("companion_"):
            continue
        data = library.get_dataset(topic.name).data
        for field in topic.fields:
            for index, name in enumerate(field.columns):
                if name in COLUMN_INDEX:
                    table[:, COLUMN_INDEX[name]] = data[f"{field.name}[{index}]" if field.size > 1 else field.name]
    return table


@settings(max_examples=25, deadline=None)
@given(st.lists(st.lists(st.floats(), min_size=len(COLUMNS) - 1, max_size=len(COLUMNS) - 1), min_size=1, max_size=4))
def test_rows_come_back_bit_by_bit(rows) -> None:
    vehicle = Vehicle()
    table = [((START_US + 4000 * index) * 1e-6, *numbers) for index, numbers in enumerate(rows)]
    content = written([vehicle.heartbeat(), vehicle.state(START_US), *(packed(numbers) for numbers in table)])
    assert table_of(content).tobytes() == np.array(table).tobytes()
    times = [record[0] for record in parse(content).data["companion_errors"]]
    assert times == [START_US + 4000 * index for index in range(len(rows))]


def test_states_and_the_setpoints_that_answer_them_have_the_same_time() -> None:
    vehicle, t_us = Vehicle(), START_US + 123
    ms = t_us // 1000
    half = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
    content = written(
        [
            vehicle.heartbeat(),
            vehicle.state(t_us, q=half),
            vehicle.hears(mavlink.MAVLink_set_attitude_target_message(ms, 1, 1, 128, [1, 0, 0, 0], 0.1, 0.2, 0.3, 0.5)),
            vehicle.hears(mavlink.MAVLink_set_attitude_target_message(ms, 1, 1, 3, half, 0.0, 0.0, 0.25, 0.75)),
            vehicle.hears(
                mavlink.MAVLink_set_actuator_control_target_message(t_us, 0, 1, 1, [0.5, 0.25, -1, 0.375] + [0] * 4)
            ),
            vehicle.hears(
                mavlink.MAVLink_set_position_target_local_ned_message(
                    ms, 1, 1, 1, 448 | 2048, 1, 2, -3, 0.5, 0, -0.5, 9, 9, 9, 0.75, 9
                )
            ),
        ]
    )
    data = parse(content).data
    assert data["vehicle_local_position"] == [
        (t_us, t_us, True, True, True, True, 1.0, 2.0, -3.0, 0.5, -0.25, 0.125, pytest.approx(0.8))
    ]
    ((at_us, sample_us, *q),) = data["vehicle_attitude"]
    assert (at_us, sample_us, q) == (t_us, t_us, pytest.approx(half))
    assert data["vehicle_angular_velocity"][0][2:] == pytest.approx((0.1, 0.2, 0.3))
    ((at_us, *rates),) = data["vehicle_rates_setpoint"]
    assert (at_us, rates) == (t_us, pytest.approx([0.1, 0.2, 0.3, 0, 0, -0.5]))
    ((at_us, *attitude),) = data["vehicle_attitude_setpoint"]
    assert (at_us, attitude) == (t_us, pytest.approx([0.25, *half, 0, 0, -0.75]))
    assert data["vehicle_torque_setpoint"] == [(t_us, t_us, 0.5, 0.25, -1.0)]
    assert data["vehicle_thrust_setpoint"] == [(t_us, t_us, 0.0, 0.0, -thrust) for thrust in (0.5, 0.75, 0.375)]
    ((at_us, *target),) = data["trajectory_setpoint"]
    assert (at_us, target[:6], target[9]) == (t_us, [1, 2, -3, 0.5, 0, -0.5], 0.75)
    assert all(map(math.isnan, [*target[6:9], target[10]]))
    library = pyulog_of(content)
    PX4ULog(library).add_roll_pitch_yaw()
    assert library.get_dataset("vehicle_attitude").data["yaw"] == pytest.approx([0.8])
    assert library.get_dataset("vehicle_attitude_setpoint").data["yaw_d"] == pytest.approx([0.8])
    assert PX4ULog(library).get_mav_type() == "Quadrotor"


def test_what_the_autopilot_reports() -> None:
    vehicle = Vehicle()
    battery = mavlink.MAVLink_battery_status_message(
        0, 0, 0, 2512, [4000] * 4 + [65535] * 6, 1250, 300, -1, 75, 600, 2, [0] * 4, 0, 0
    )
    unknown = mavlink.MAVLink_battery_status_message(0, 0, 0, 32767, [65535] * 10, -1, -1, -1, -1, 0, 0, [0] * 4, 0, 0)
    home = mavlink.MAVLink_home_position_message(
        473977418, 85455939, 488000, 1.0, 2.0, 3.0, [1.0, 0, 0, 0], 0.0, 0.0, 0.0, 1
    )
    name = b"COM_OBL_RC_ACT"
    value = struct.unpack("<f", struct.pack("<i", 5))[0]
    parameter = mavlink.MAVLink_param_value_message(name, value, 6, 1, 0)
    later = START_US + 40_000
    content = written(
        [
            vehicle.heartbeat(HOLD, armed=False),
            vehicle.state(START_US),
            vehicle.heartbeat(HOLD, armed=True),
            vehicle.state(later, resets=1),
            vehicle.says(mavlink.MAVLink_current_mode_message(0, OFFBOARD.custom_mode, OFFBOARD.custom_mode)),
            vehicle.says(mavlink.MAVLink_current_mode_message(0, LAND.custom_mode, OFFBOARD.custom_mode)),
            vehicle.says(mavlink.MAVLink_current_mode_message(0, LAND.custom_mode, OFFBOARD.custom_mode)),
            vehicle.says(mavlink.MAVLink_extended_sys_state_message(0, 2)),
            vehicle.says(mavlink.MAVLink_extended_sys_state_message(0, 1)),
            vehicle.says(mavlink.MAVLink_extended_sys_state_message(0, 0)),
            *(vehicle.says(message) for message in (battery, unknown, home, parameter, parameter)),
            vehicle.says(mavlink.MAVLink_statustext_message(4, b"low battery")),
            vehicle.says(mavlink.MAVLink_statustext_message(3, b"x" * 50, 7, 0)),
            vehicle.says(mavlink.MAVLink_statustext_message(3, b"yz", 7, 1)),
        ]
    )
    log = parse(content)
    assert [(t, *rest[:4]) for t, *rest in log.data["vehicle_status"]] == [
        (START_US, 2, 31, 4, 1),
        (later, 2, 14, 14, 1),
        (later, 2, 14, 18, 1),
    ]
    assert log.data["vehicle_status"][0][6:] == (2, 1, 1)
    assert log.data["vehicle_land_detected"] == [(later, False), (later, True)]
    first, second = log.data["battery_status"]
    assert first == pytest.approx((later, True, 16.0, 12.5, 300.0, 0.75, 600.0, 25.12, 4, 1, 1))
    assert second[:6] == (later, False, 0.0, -1.0, -1.0, -1.0)
    assert second[8:] == (0, 1, 0)
    assert log.data["home_position"] == [pytest.approx((later, 47.3977418, 8.5455939, 488.0, 1.0, 2.0, 3.0))]
    assert log.changed == [("COM_OBL_RC_ACT", 5)]
    assert log.parameters == {"MAV_TYPE": 2}
    assert log.texts == [
        (Level.INFO, START_US, "the autopilot reports Hold"),
        (Level.WARNING, later, "the autopilot's estimate was reset (reset counter 1)"),
        (Level.INFO, later, "the autopilot reports Offboard"),
        (Level.INFO, later, "the autopilot reports Land"),
        (4, later, "autopilot: low battery"),
        (3, later, f"autopilot: {'x' * 50}yz"),
    ]


def test_modes_have_px4s_numbers() -> None:
    assert len(set(NAV_STATES.values())) == len(NAV_STATES)
    assert NAV_STATES[Mode(4, 11)] == 23 and NAV_STATES[Mode(4, 18)] == 30  # NAVIGATION_STATE_EXTERNAL1 to 8
    assert (NAV_STATES[HOLD], NAV_STATES[OFFBOARD], NAV_STATES[LAND]) == (4, 14, 18)


def test_the_link_is_counted_once_per_second() -> None:
    vehicle = Vehicle()
    entries = [vehicle.heartbeat()]
    for index in range(101):
        entries.append(vehicle.state(START_US + 20_000 * index))
        if index % 25 == 10:
            vehicle.state(0)  # lost on its way
            entries.append(vehicle.state(START_US))  # late: not used
    log = parse(written(entries, wall_ns=1_700_000_000_000_000_000))
    size = len(entries[1][1])
    assert [record[:3] for record in log.data["companion_link"]] == [
        (START_US + 1_000_000, 1_700_000_000_000_000, 54),
        (START_US + 2_000_000, 1_700_000_000_000_000, 106),
    ]
    assert [record[3] for record in log.data["companion_link"]] == [2, 4]
    assert log.data["companion_link"][1][4] == pytest.approx(52 * size, rel=0.02)
    assert [record[7:] for record in log.data["companion_link"]] == [(51, 2, 0), (101, 4, 0)]
    assert log.syncs == 3
    assert log.info["time_utc_usec"] == 1_700_000_000_000_000


def test_a_wrong_time_of_the_link_does_not_carry_the_log_away() -> None:
    vehicle = Vehicle()
    far = (START_US + 3_600_000_000) * 1000
    entries = [vehicle.heartbeat(), vehicle.says(mavlink.MAVLink_timesync_message(0, far)), vehicle.state(START_US)]
    entries += [vehicle.says(mavlink.MAVLink_timesync_message(0, far)), vehicle.state(START_US + 4000)]
    entries.append((Entry.TEXT, bytes((5,)) + b"here"))
    log = parse(written(entries))
    assert log.texts[-1] == (5, START_US + 4000, "here")
    assert [record[0] for record in log.data["vehicle_attitude"]] == [START_US, START_US + 4000]


def test_the_configuration_is_in_the_log() -> None:
    import tomlkit

    data = read_toml(find("paper", "flights"))
    flight = build_flight(data, "paper").model_dump(exclude_none=True)
    text = tomlkit.dumps({key: value if not isinstance(value, tuple) else list(value) for key, value in flight.items()})
    text = "# " + "größer " * 800 + "\n" + text
    vehicle = Vehicle()
    log = parse(written([vehicle.heartbeat(), vehicle.state(START_US)], text))
    assert "".join(log.long_info["flight_toml"]) == text
    assert len(log.long_info["flight_toml"]) > 3
    assert log.parameters["controller/k1_1_s"] == np.float32(0.7)
    assert log.parameters["rotors/x_m/1"] == -0.25
    assert log.parameters["controller/prediction"] == 1
    assert log.parameters["world/seed"] == 1
    assert not any("trajectory" in key for key in log.parameters)
    assert (log.info["flight"], log.info["vehicle"], log.info["trajectory"]) == ("paper", "paper", "paper")
    assert log.info["sys_name"] == "companion"
    assert log.info["phase_names"].startswith("connect, preflight, takeoff")


def test_the_envelope_is_the_proofs() -> None:
    settings_ = {"vehicle": {"controller": {"k1_1_s": 0.5, "gamma_1_s3": 2.0}, "limits": {"disturbance_max_m_s2": 3.0}}}
    assert envelope(settings_, 10.0, (0.0, 1.0, 0.0)) == 10.0 + 16.0 / 2.0
    assert math.isnan(envelope({}, 10.0, (0.0, 0.0, 0.0)))
    settings_["vehicle"]["controller"]["gamma_1_s3"] = 0.0
    assert math.isnan(envelope(settings_, 10.0, (0.0, 0.0, 0.0)))
    vehicle = Vehicle()
    text = "[vehicle.controller]\nk1_1_s = 0.5\ngamma_1_s3 = 2.0\n[vehicle.limits]\ndisturbance_max_m_s2 = 3.0\n"
    start = a_row(START_US, lyapunov=10.0, b_hat_n=0.0, b_hat_e=1.0, b_hat_d=0.0)
    later = a_row(START_US + 4000, lyapunov=99.0)
    log = parse(written([vehicle.heartbeat(), vehicle.state(START_US), packed(start), packed(later)], text))
    assert [record[1:] for record in log.data["companion_lyapunov"]] == [(10.0, 18.0), (99.0, 18.0)]


def test_the_heading_wanted() -> None:
    vehicle = Vehicle()
    turned = {"q_w": math.cos(1.5), "q_x": 0.0, "q_y": 0.0, "q_z": math.sin(1.5)}
    rows = [a_row(START_US + 4000 * i, heading_error_rad=e, **turned) for i, e in enumerate((-0.5, math.nan, math.inf))]
    log = parse(written([vehicle.heartbeat(), vehicle.state(START_US), *map(packed, rows)]))
    yaw = [record[-1] for record in log.data["vehicle_local_position_setpoint"]]
    assert yaw[0] == pytest.approx(3.5 - 2.0 * math.pi)
    assert math.isnan(yaw[1]) and math.isnan(yaw[2])


def test_texts_wait_for_the_vehicles_time_and_a_flight_without_one_has_them_too() -> None:
    vehicle = Vehicle()
    said = [(Entry.TEXT, bytes((3,)) + "nobody there: größer".encode())]
    assert parse(written(said)).texts == [(3, 0, "nobody there: größer")]
    with_time = parse(written([*said, vehicle.heartbeat(), vehicle.state(START_US)]))
    assert with_time.start_us == START_US
    assert with_time.texts[0] == (3, START_US, "nobody there: größer")


def parameter(vehicle: Vehicle, name: bytes, value: float) -> tuple[int, bytes]:
    return vehicle.says(mavlink.MAVLink_param_value_message(name, value, 9, 1, 0))


def test_parameters_wait_for_the_vehicles_time_too() -> None:
    vehicle = Vehicle()
    read = [parameter(vehicle, name, value) for name, value in ((b"A", 1.5), (b"B", 2.0), (b"A", 2.5))]
    log = parse(written([vehicle.heartbeat(), *read, vehicle.state(START_US), parameter(vehicle, b"C", 3.0)]))
    assert log.changed == [("A", 2.5), ("B", 2.0), ("C", 3.0)]
    assert log.parameters == {"MAV_TYPE": 2}
    assert parse(written([vehicle.heartbeat(), *read])).changed == [("A", 2.5), ("B", 2.0)]


def test_a_vehicle_that_is_known_already_is_followed_before_its_heartbeat() -> None:
    """As in `companion serve`: parameters are read at once, and the next heartbeat may be a second away."""
    vehicle = Vehicle()
    system = (Entry.SYSTEM, bytes((1,)))
    read = parameter(vehicle, b"COM_OF_LOSS_T", 1.0)
    states = [vehicle.state(START_US + 4000 * index) for index in range(3)]
    log = parse(written([system, *states[:2], read, vehicle.heartbeat(), states[2]]))
    assert log.start_us == START_US
    assert len(log.data["vehicle_local_position"]) == 3
    assert log.changed == [("COM_OF_LOSS_T", 1.0), ("MAV_TYPE", 2)]
    assert log.data["vehicle_status"][0][6:] == (2, 1, 1)


def test_the_vehicle_that_is_flown_is_followed_and_not_the_first_one_heard() -> None:
    vehicle, other = Vehicle(), Vehicle(system=7)
    entries = [other.heartbeat(), other.state(START_US + 10**9), (Entry.SYSTEM, bytes((1,))), vehicle.heartbeat()]
    log = parse(written([*entries, other.state(START_US + 10**9 + 4000), *(vehicle.state(START_US + 10**10),) * 2]))
    assert [record[0] for record in log.data["vehicle_local_position"]] == [START_US + 10**9, START_US + 10**10]


def test_a_hole_is_marked_where_rows_are_missing() -> None:
    vehicle = Vehicle()
    log = FlightLog("", 0)
    for entry in (vehicle.heartbeat(), vehicle.state(START_US)):
        log.take(*entry, 0)
    for index in (0, 1, 2, 52, 53, 80):
        if index == 52:
            log.missed(50)
        log.take(*packed(a_row(START_US + 4000 * index)), 0)
    log.take(*vehicle.state(START_US + 2_000_000), 0)
    parsed = parse(log.end())
    assert parsed.dropouts_ms == [200]  # the second one is a pause between steps: nothing was missed
    assert parsed.data["companion_link"][0][-1] == 50


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_log_that_is_cut_off_reads_up_to_there(data) -> None:
    vehicle = Vehicle()
    entries = [vehicle.heartbeat(), vehicle.state(START_US)]
    entries += [packed(a_row(START_US + 4000 * index, index)) for index in range(20)]
    content = written(entries)
    full = parse(content)
    cut = data.draw(st.integers(content.index(b"\x00A\x00"), len(content)))
    strict, library = parse(content[:cut]), pyulog_of(content[:cut])
    rows = strict.data.get("companion_errors", [])
    assert rows == full.data["companion_errors"][: len(rows)]
    read = [elem for elem in library.data_list if elem.name == "companion_errors"]
    assert (len(read[0].data["timestamp"]) if read else 0) == len(rows)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0, 3, 17, 99]), st.binary(min_size=1, max_size=80)), max_size=20))
def test_whatever_comes_the_log_stays_readable(entries) -> None:
    vehicle = Vehicle()
    ours = [vehicle.heartbeat(), vehicle.state(START_US)]
    log = parse(written([*ours, *entries, vehicle.state(START_US + 4000)]))
    assert [record[0] for record in log.data["vehicle_attitude"]] == [START_US, START_US + 4000]


HEARD = [0, 22, 111, 147, 242, 245, 253, 331, 436]
SENT = [82, 84, 139]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(HEARD + SENT), st.binary(max_size=255)), max_size=12))
def test_messages_with_any_content_do_not_end_the_log(messages) -> None:
    """Frames that the link has checked may still hold anything."""
    vehicle, formats = Vehicle(), message_formats()
    entries = [vehicle.heartbeat(), vehicle.state(START_US)]
    for msgid, payload in messages:
        crc_extra, length = formats[msgid]
        raw = build_frame(msgid, payload[:length].ljust(length, b"\0"), 0, 1, 1, crc_extra, None)
        entries.append((Direction.OUT if msgid in SENT else Direction.IN, raw))
    log = parse(written(entries))
    assert log.data["vehicle_attitude"][0][0] == START_US
