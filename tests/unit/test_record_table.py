"""The record of a flight: writing, running full, saving, refusing what is not a record."""

import struct

import numpy as np
import pytest
from record_cases import row

from companion.errors import InputError
from companion.record.columns import COLUMN_INDEX, COLUMNS, LIMIT_NAMES
from companion.record.flight_record import FlightRecord


def counting(rows: int, capacity: int) -> FlightRecord:
    record = FlightRecord(capacity, ("join", "track"))
    for index in range(rows):
        record.append(tuple(index + column / 100 for column in range(len(COLUMNS))))
    return record


def test_columns_are_distinct_and_limits_are_single_bits():
    assert len(set(COLUMNS)) == len(COLUMNS) == 63
    assert COLUMNS[:3] == ("t_s", "track_s", "phase")
    assert COLUMNS[-12:-7] == ("state_age_ms", "step_us", "late", "skipped", "limits")
    assert list(LIMIT_NAMES) == [1, 2, 4, 8, 16, 32, 64]


def test_rows_come_back_by_column():
    record = counting(3, 10)
    assert len(record) == 3
    assert record.rows.shape == (3, 63)
    assert record.column("t_s").tolist() == [0.0, 1.0, 2.0]
    assert record.column("limits").tolist() == [0.55, 1.55, 2.55]
    assert record.columns("p_d", "t_s")[2].tolist() == [2 + COLUMN_INDEX["p_d"] / 100, 2.0]
    assert list(record.as_dict()) == list(COLUMNS)
    with pytest.raises(KeyError):
        record.column("altitude")


def test_a_full_record_counts_and_keeps_what_it_has():
    record = counting(7, 4)
    assert (len(record), record.overflow, record.capacity) == (4, 3, 4)
    assert record.column("t_s").tolist() == [0.0, 1.0, 2.0, 3.0]
    empty = counting(2, 0)
    assert (len(empty), empty.overflow) == (0, 2)


def test_reserve_makes_room_and_keeps_the_rows():
    record = counting(4, 4)
    record.reserve(2)
    record.append(row(t_s=9.0))
    assert record.capacity == 6
    assert record.column("t_s").tolist() == [0.0, 1.0, 2.0, 3.0, 9.0]
    record.reserve(1)
    assert record.capacity == 6


def test_a_row_of_another_length_is_a_fault_of_the_program():
    record = FlightRecord(4)
    for wrong in ((1.0,), (0.0,) * 57):
        with pytest.raises(struct.error):
            record.append(wrong)
    assert len(record) == 0


def test_phases_and_selections():
    record = FlightRecord(4, ("join", "track"))
    for phase in (0, 1, 1, 0):
        record.append(row(t_s=phase, phase=phase))
    assert record.in_phase("track").tolist() == [False, True, True, False]
    assert not record.in_phase("land").any()
    chosen = record.select(record.in_phase("track"))
    assert len(chosen) == 2
    assert chosen.phase_names == ("join", "track")
    assert record.select(np.array([3])).column("t_s").tolist() == [0.0]


def test_saved_and_loaded_it_is_the_same(tmp_path):
    record = counting(7, 5)
    record.append(row())
    path = record.save(tmp_path)
    assert path.name == "record.npz"
    assert [entry.name for entry in tmp_path.iterdir()] == ["record.npz"]
    for where in (path, tmp_path):
        loaded = FlightRecord.load(where)
        np.testing.assert_array_equal(loaded.rows, record.rows)
        assert (loaded.phase_names, loaded.overflow) == (("join", "track"), 3)


def test_an_empty_record_can_be_saved(tmp_path):
    FlightRecord(0).save(tmp_path)
    assert len(FlightRecord.load(tmp_path)) == 0


def test_what_is_not_a_record_is_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match=r"record\.npz: there is no flight record"):
        FlightRecord.load(tmp_path)
    path = counting(3, 3).save(tmp_path)
    whole = path.read_bytes()
    for broken in (b"", b"something else", whole[: len(whole) // 2]):
        path.write_bytes(broken)
        with pytest.raises(InputError, match="not a flight record") as caught:
            FlightRecord.load(path)
        assert "\n" not in str(caught.value)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))  # another kind of numpy file
    with pytest.raises(InputError, match="not a flight record"):
        FlightRecord.load(path)
    np.savez(path, format=1, columns=np.array(["t_s"]), phase_names=np.array(["a"]), overflow=0, rows=np.zeros((1, 1)))
    with pytest.raises(InputError, match="another version"):
        FlightRecord.load(path)


def test_the_sink_gets_every_row_also_those_that_find_no_place():
    record = FlightRecord(2)
    seen: list[bytes] = []
    record.sink = lambda content: seen.append(bytes(content))
    rows = [row(t_s=float(index)) for index in range(3)]
    for numbers in rows:
        record.append(numbers)
    assert (len(record), record.overflow) == (2, 1)
    assert b"".join(seen) == np.array(rows).tobytes()
    assert b"".join(seen[:2]) == record.rows.tobytes()
