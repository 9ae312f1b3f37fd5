"""The summary against cases computed by hand."""

import json
import math

import pytest
from record_cases import HOLD, PHASES, TRACK, row, synthetic_flight, track_record

from companion.errors import InputError
from companion.record.flight_record import FlightRecord
from companion.record.summary import FlightMeta, PhaseChange, check_acceptance, met, summarise, without_wall_clock

KEYS = [
    *("trajectory", "vehicle", "controller", "duration_s", "steps", "control_rate_hz"),
    *("settled_at_s", "statistics_from_s", "track_rms_m"),
    *("position_rms_m", "position_p95_m", "position_max_m", "vertical_rms_m", "heading_rms_rad"),
    *("body_sideways_rms_m_s", "disturbance_m_s2", "thrust_min_n", "thrust_max_n", "tilt_max_rad"),
    *("state_age_ms", "step_us", "late_steps", "lost_setpoints", "phases", "verdict"),
]


def meta(**more) -> FlightMeta:
    return FlightMeta(trajectory="eight", vehicle="quad", **more)


def distances(*north: float, **columns) -> FlightRecord:
    return track_record([(value, 0.0, 0.0) for value in north], **columns)


def test_the_keys_and_their_order_hold():
    assert list(summarise(distances(1.0, 0.1), PHASES, meta())) == KEYS
    assert list(summarise(FlightRecord(0), [], meta())) == KEYS


@pytest.mark.parametrize(
    ("north", "settled_at_s"),
    [
        ((5.0, 1.0, 0.3, 0.1, 0.05), 3.0),
        ((5.0, 0.1, 0.3, 0.1, 0.05), 3.0),  # out again: it counts from the last time
        ((0.1, 0.1, 0.1), 0.0),  # never outside
        ((0.1, 0.1, 0.2), None),  # the bound itself is not below the bound, and the last step is outside
        ((0.1, 0.2, 0.19), 2.0),  # only the last step is inside
        ((1.0, 1.0), None),
        ((1.0, math.nan, 0.1), 2.0),
        ((1.0, 0.1, math.nan), None),
        ((-0.3, -0.1), 1.0),
    ],
)
def test_settling(north, settled_at_s):
    summary = summarise(distances(*north), [], meta(statistics_from_s=0.0))
    assert summary["settled_at_s"] == settled_at_s
    assert (summary["verdict"] == "not settled") == (settled_at_s is None)


def test_settling_looks_at_all_three_axes():
    record = track_record([(0.15, 0.15, 0.0), (0.1, 0.1, 0.1)])
    assert summarise(record, [], meta())["settled_at_s"] == 1.0


def test_statistics_begin_ten_seconds_after_settling():
    north = [1.0] + [0.1] * 10 + [0.03, 0.04]
    summary = summarise(distances(*north), [], meta())
    assert (summary["settled_at_s"], summary["statistics_from_s"]) == (1.0, 11.0)
    assert summary["position_rms_m"] == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2), rel=1e-15)
    assert summary["position_max_m"] == 0.04
    assert summary["verdict"] == "passed"


def test_statistics_by_hand():
    errors = [(9.0, 9.0, 9.0), (0.03, 0.04, 0.0), (0.0, 0.0, 0.12), (0.06, 0.0, 0.08)]
    summary = summarise(track_record(errors), [], meta(statistics_from_s=1.0))
    assert summary["statistics_from_s"] == 1.0
    assert summary["position_rms_m"] == pytest.approx(math.sqrt((0.05**2 + 0.12**2 + 0.1**2) / 3), rel=1e-14)
    assert summary["position_max_m"] == pytest.approx(0.12, rel=1e-15)
    assert summary["position_p95_m"] == pytest.approx(0.1 + 0.9 * 0.02, rel=1e-14)  # between the last two of three
    assert summary["vertical_rms_m"] == pytest.approx(math.sqrt((0.12**2 + 0.08**2) / 3), rel=1e-14)


def test_a_track_too_short_for_statistics_is_a_miss():
    summary = summarise(distances(1.0, 0.1, 0.1), [], meta(acceptance={"position_rms_m": 1.0}))
    assert summary["position_rms_m"] is None
    assert summary["verdict"] == "missed: the track ended before the statistics began at 11 s"


def test_a_short_track_of_which_nothing_was_asked_missed_nothing():
    verdict = summarise(distances(1.0, 0.1, 0.1), [], meta())["verdict"]
    assert verdict == "flown, too short for statistics, which begin at 11 s"
    assert met(verdict) and met("passed")
    assert not any(map(met, ("not settled", "did not track", "missed: everything", "ended early: x", "unknown", None)))


def test_heading_is_null_when_it_is_free_and_skips_steps_without_one():
    assert summarise(distances(0.1, 0.1), [], meta(statistics_from_s=0.0))["heading_rms_rad"] is None
    record = distances(0.1, 0.1, 0.1, heading_error_rad=[0.3, math.nan, -0.4])
    heading = summarise(record, [], meta(statistics_from_s=0.0))["heading_rms_rad"]
    assert heading == pytest.approx(math.sqrt((0.09 + 0.16) / 2), rel=1e-15)


def test_sideways_speed_is_taken_in_the_body_frame():
    half = math.sqrt(0.5)
    east = {"q_w": [half], "q_z": [half]}  # nose to the east
    moving_east = distances(0.0, v_n=[0.0], v_e=[3.0], v_d=[1.0], **east)
    moving_north = distances(0.0, v_n=[3.0], v_e=[0.0], v_d=[1.0], **east)
    given = meta(statistics_from_s=0.0)
    assert summarise(moving_east, [], given)["body_sideways_rms_m_s"] == pytest.approx(0.0, abs=1e-15)
    assert summarise(moving_north, [], given)["body_sideways_rms_m_s"] == pytest.approx(3.0, rel=1e-15)
    # Rolled to the right by 90 degrees the right side points down.
    rolled = distances(0.0, v_n=[0.0], v_e=[0.0], v_d=[2.0], q_w=[half], q_x=[half])
    assert summarise(rolled, [], given)["body_sideways_rms_m_s"] == pytest.approx(2.0, rel=1e-15)


def test_effort_and_timing():
    pitch = 0.3
    record = distances(
        *(1.0, 0.1, 0.1),
        thrust_n=[40.0, 70.0, 50.0],
        q_w=[1.0, math.cos(pitch / 2), 1.0],
        q_y=[0.0, math.sin(pitch / 2), 0.0],
        **{"b_hat_n": [0.0, 0.5, 1.0], "b_hat_e": [0.0, 0.0, -0.2], "b_hat_d": [0.0, 0.1, 0.49]},
        **{"state_age_ms": [20.0, 21.0, 25.0], "step_us": [80.0, 90.0, 100.0], "late": [0.0, 1.0, 1.0]},
    )
    summary = summarise(record, [], meta(lost_setpoints=3))
    assert (summary["thrust_min_n"], summary["thrust_max_n"]) == (40.0, 70.0)
    assert summary["tilt_max_rad"] == pytest.approx(0.3, rel=1e-14)
    assert summary["disturbance_m_s2"] == [1.0, -0.2, 0.49]
    assert summary["state_age_ms"] == {"p50": 21.0, "p99": pytest.approx(24.92)}
    assert summary["step_us"]["p50"] == 90.0
    assert (summary["late_steps"], summary["lost_setpoints"]) == (2, 3)


def test_only_the_track_counts_and_a_pause_does_not_change_the_rate():
    record = FlightRecord(20)
    record.append(row(t_s=9.9, phase=0, error_n=99.0, thrust_n=1.0))
    for index in range(5):
        record.append(row(t_s=10.0 + 0.1 * index, track_s=0.1 * index, phase=TRACK, error_n=0.1, error_e=0, error_d=0))
    record.append(row(t_s=10.5, phase=HOLD, error_n=99.0, thrust_n=999.0))
    for index in range(5, 8):
        more = {"track_s": 0.1 * index, "phase": TRACK, "error_n": 0.1, "error_e": 0, "error_d": 0}
        record.append(row(t_s=70.0 + 0.1 * index, thrust_n=50.0, **more))
    summary = summarise(record, [], meta(statistics_from_s=0.0))
    assert summary["steps"] == 8
    assert summary["duration_s"] == pytest.approx(0.7)
    assert summary["control_rate_hz"] == pytest.approx(10.0)
    assert summary["position_max_m"] == 0.1
    assert (summary["thrust_min_n"], summary["thrust_max_n"]) == (50.0, 50.0)


def test_a_flight_without_a_track():
    record = FlightRecord(2)
    record.append(row(t_s=1.0, phase=HOLD))
    summary = summarise(record, [PhaseChange("hold", math.nan, "no state")], meta(acceptance={"position_rms_m": 1.0}))
    assert summary["verdict"] == "did not track"
    assert (summary["steps"], summary["duration_s"], summary["control_rate_hz"]) == (0, 0.0, None)
    assert summary["phases"] == [{"name": "hold", "at_s": None, "reason": "no state"}]
    json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize(
    ("acceptance", "verdict"),
    [
        ({}, "passed"),
        ({"position_rms_m": 0.013}, "passed"),
        ({"position_rms_m": 0.01}, "missed: position_rms_m 0.013 > 0.01"),
        ({"position_rms_m": 0.01, "late_steps": 0, "position_max_m": 0.001}, None),
        ({"position_rms_m": 0.0129999}, "missed: position_rms_m 0.013 > 0.0129999"),
        ({"heading_rms_rad": 0.1}, "missed: heading_rms_rad is unknown, 0.1 allowed"),
    ],
)
def test_verdicts(acceptance, verdict):
    summary = summarise(distances(0.013, 0.013), [], meta(statistics_from_s=0.0, acceptance=acceptance))
    expected = verdict or "missed: position_rms_m 0.013 > 0.01, position_max_m 0.013 > 0.001"
    assert summary["verdict"] == expected


def test_a_miss_by_a_hair_shows_its_digits():
    given = meta(statistics_from_s=0.0, acceptance={"position_max_m": 0.01})
    verdict = summarise(distances(0.010000001), [], given)["verdict"]
    assert verdict == "missed: position_max_m 0.010000001 > 0.01"


@pytest.mark.parametrize("wrong", [{"position_rms": 0.1}, {"verdict": 1.0}, {"position_rms_m": "0.1"}])
def test_thresholds_that_cannot_be_judged_are_refused(wrong):
    with pytest.raises(InputError, match=r"flight\.toml: acceptance\."):
        check_acceptance(wrong, "flight.toml")


@pytest.mark.parametrize("value", [math.nan, math.inf, True])
def test_thresholds_must_be_finite_numbers(value):
    with pytest.raises(InputError, match="must be a finite number"):
        check_acceptance({"position_rms_m": value}, "flight.toml")


def test_thresholds_that_can_be_judged_pass():
    check_acceptance({"position_rms_m": 0.01, "late_steps": 3}, "flight.toml")


def test_equal_flights_differ_in_wall_clock_entries_only():
    first = synthetic_flight(5.0)
    second = synthetic_flight(5.0)
    second.column("step_us")[:] += 7.0
    second.column("state_age_ms")[:] *= 1.5
    second.column("late")[:] = 1.0
    summaries = [summarise(record, PHASES, meta()) for record in (first, second)]
    assert summaries[0] != summaries[1]
    stripped = [json.dumps(without_wall_clock(summary), allow_nan=False) for summary in summaries]
    assert stripped[0] == stripped[1]
    assert set(summaries[0]) - set(without_wall_clock(summaries[0])) == {"state_age_ms", "step_us", "late_steps"}
