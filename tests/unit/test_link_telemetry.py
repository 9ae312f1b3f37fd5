"""What is taken for a state, what is not, and in which frame."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec
from companion.link.framing import Frame
from companion.link.telemetry import AttitudeSample, StateRejection, Telemetry, VehicleState

LEVEL = (1.0, 0.0, 0.0, 0.0)


def odometry(
    t_us: int = 20_000_000,
    frame_id: int = 1,
    child: int = 1,
    p=None,
    q=LEVEL,
    v=(0.5, 0.25, -0.125),
    w=(0.0, 0.0, 0.0),
    resets: int = 0,
    quality: int = 0,
    system: int = 1,
    component: int = 1,
) -> Frame:
    if p is None:  # it moves
        p = (1.0 + 0.5 * ((t_us - 20_000_000) % 10_000_000) * 1e-6, 2.0, -3.0)
    payload = struct.pack("<Q13f168xBBBBb", t_us, *p, *q, *v, *w, frame_id, child, resets, 8, quality)
    return Frame(codec.ODOMETRY, system, component, 0, payload, b"", 0)


def attitude(t_ms: int = 20_000, q=LEVEL, w=(0.0, 0.0, 0.0), system: int = 1) -> Frame:
    payload = struct.pack("<I7f16x", t_ms, *q, *w)
    return Frame(codec.ATTITUDE_QUATERNION, system, 1, 0, payload, b"", 0)


def yawed(yaw_deg: float):
    half = math.radians(yaw_deg) / 2
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def test_a_state_is_taken_as_it_is():
    telemetry = Telemetry(1)
    state = telemetry.on_odometry(odometry(w=(0.5, -0.5, 1.0), resets=7))
    assert state == VehicleState(20_000_000, (1.0, 2.0, -3.0), (0.5, 0.25, -0.125), LEVEL, (0.5, -0.5, 1.0), 7)
    assert telemetry.accepted == 1
    assert telemetry.last_t_vehicle_us == 20_000_000
    assert sum(telemetry.rejected.values()) == 0


@pytest.mark.parametrize("yaw_deg", [0, 90, 180, 270])
def test_ned_velocity_does_not_turn_with_the_vehicle(yaw_deg):
    state = Telemetry(1).on_odometry(odometry(child=1, q=yawed(yaw_deg), v=(3.0, 1.0, -2.0)))
    assert isinstance(state, VehicleState)
    assert state.v == (3.0, 1.0, -2.0)


# Flying 3 m/s forward, 1 m/s to the right, 2 m/s up, nose to north, east, south, west: worked out by hand.
BODY_TO_NED = {0: (3.0, 1.0), 90: (-1.0, 3.0), 180: (-3.0, -1.0), 270: (1.0, -3.0)}


@pytest.mark.parametrize("yaw_deg", [0, 90, 180, 270])
def test_body_velocity_is_turned_by_the_attitude(yaw_deg):
    state = Telemetry(1).on_odometry(odometry(child=12, q=yawed(yaw_deg), v=(3.0, 1.0, -2.0)))
    assert isinstance(state, VehicleState)
    assert state.v == pytest.approx((*BODY_TO_NED[yaw_deg], -2.0), abs=1e-5)


def test_body_velocity_with_the_nose_up():
    pitch = math.radians(90)
    q = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    state = Telemetry(1).on_odometry(odometry(child=12, q=q, v=(2.0, 0.0, 0.0)))
    assert isinstance(state, VehicleState)
    assert state.v == pytest.approx((0.0, 0.0, -2.0), abs=1e-5)  # forward is up


@pytest.mark.parametrize(
    ("frame_id", "child"), [(20, 1), (21, 1), (4, 1), (0, 1), (1, 0), (1, 8), (1, 20), (1, 21), (12, 12)]
)
def test_other_frames_are_refused(frame_id, child):
    telemetry = Telemetry(1)
    assert telemetry.on_odometry(odometry(frame_id=frame_id, child=child)) is StateRejection.UNKNOWN_FRAME
    assert telemetry.rejected[StateRejection.UNKNOWN_FRAME] == 1
    assert telemetry.accepted == 0


@pytest.mark.parametrize("ids", [{"system": 2}, {"component": 195}])
def test_other_senders_are_refused(ids):
    assert Telemetry(1).on_odometry(odometry(**ids)) is StateRejection.NOT_FROM_AUTOPILOT


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["p", "v", "w"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_numbers_that_are_none_are_refused(bad, field, axis):
    values = [0.0, 0.0, 0.0]
    values[axis] = bad
    assert Telemetry(1).on_odometry(odometry(**{field: tuple(values)})) is StateRejection.NOT_FINITE


@pytest.mark.parametrize("child", [1, 12])
@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_a_quaternion_with_a_nan_is_refused(axis, child):
    q = [0.5, 0.5, 0.5, 0.5]
    q[axis] = math.nan
    assert Telemetry(1).on_odometry(odometry(q=tuple(q), child=child)) is StateRejection.NOT_FINITE


@pytest.mark.parametrize("length", [0.0, 0.5, 0.89, 1.11, 2.0])
def test_a_quaternion_that_is_no_attitude_is_refused(length):
    assert Telemetry(1).on_odometry(odometry(q=(0.0, 0.0, length, 0.0))) is StateRejection.ZERO_QUATERNION


@pytest.mark.parametrize("length", [0.91, 1.0, 1.09])
def test_a_quaternion_is_normalised(length):
    state = Telemetry(1).on_odometry(odometry(q=(length * 0.6, length * 0.8, 0.0, 0.0)))
    assert isinstance(state, VehicleState)
    assert state.q == pytest.approx((0.6, 0.8, 0.0, 0.0), abs=1e-6)
    assert math.hypot(*state.q) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("field", [{"p": (2e6, 0.0, 0.0)}, {"v": (0.0, 0.0, -300.0)}, {"w": (0.0, 150.0, 0.0)}])
def test_absurd_numbers_are_refused(field):
    assert Telemetry(1).on_odometry(odometry(**field)) is StateRejection.ABSURD_MAGNITUDE


def test_an_estimate_that_failed_is_refused():
    assert Telemetry(1).on_odometry(odometry(quality=-1)) is StateRejection.ESTIMATOR_FAILED


def test_time_must_go_on():
    telemetry = Telemetry(1)
    assert isinstance(telemetry.on_odometry(odometry(20_000_000)), VehicleState)
    assert telemetry.on_odometry(odometry(20_000_000)) is StateRejection.REPEATED
    assert telemetry.on_odometry(odometry(19_996_000)) is StateRejection.BACK_IN_TIME
    assert isinstance(telemetry.on_odometry(odometry(20_004_000)), VehicleState)
    assert telemetry.accepted == 2


def test_an_estimate_that_stands_still_while_its_stamps_go_on_is_refused():
    telemetry = Telemetry(1)
    here = {"p": (1.0, 2.0, -3.0)}
    moves, turns, rests = here, here | {"v": (0.0, 0.0, 0.0), "w": (0.0, 0.0, 0.01)}, here | {"v": (0.0005, 0.0, 0.0)}
    for i, still in enumerate((moves, turns)):
        base_us = 20_000_000 + 100_000 * i
        assert isinstance(telemetry.on_odometry(odometry(base_us, **still)), VehicleState)
        assert telemetry.on_odometry(odometry(base_us + 10_000, **still)) is StateRejection.FROZEN
        assert telemetry.on_odometry(odometry(base_us + 20_000, **still)) is StateRejection.FROZEN
        assert isinstance(
            telemetry.on_odometry(odometry(base_us + 30_000, **still | {"p": (1.0, 2.0, -3.001)})), VehicleState
        )
    # A vehicle at rest without noise may well be where it was.
    for t_us in (21_000_000, 21_010_000, 21_020_000):
        assert isinstance(telemetry.on_odometry(odometry(t_us, **rests)), VehicleState)


def test_a_state_without_a_stamp_is_refused():
    assert Telemetry(1).on_odometry(odometry(0)) is StateRejection.NO_STAMP


def test_a_refused_state_does_not_move_the_clock():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(20_000_000))
    telemetry.on_odometry(odometry(20_008_000, p=(math.nan, 0.0, 0.0)))
    assert isinstance(telemetry.on_odometry(odometry(20_004_000)), VehicleState)


def test_a_reboot_is_named_and_stays():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(60_000_000))
    assert telemetry.on_odometry(odometry(4_000_000)) is StateRejection.REBOOTED
    # Even when the new clock has passed the old one: nothing of the old flight holds any more.
    assert telemetry.on_odometry(odometry(61_000_000)) is StateRejection.REBOOTED
    assert telemetry.on_attitude(attitude(61_000)) is StateRejection.REBOOTED
    telemetry.restart()
    assert isinstance(telemetry.on_odometry(odometry(61_004_000)), VehicleState)
    assert telemetry.rejected[StateRejection.REBOOTED] == 3


def test_a_reboot_that_is_noticed_late_is_named_after_a_few_states():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(60_000_000))
    got = [telemetry.on_odometry(odometry(20_000_000 + 4000 * i)) for i in range(4)]
    assert got == [StateRejection.BACK_IN_TIME] * 2 + [StateRejection.REBOOTED] * 2


def test_an_early_reboot_is_named_after_a_few_states():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(8_000_000))
    got = [telemetry.on_odometry(odometry(1_000_000 + 4000 * i)) for i in range(3)]
    assert got[-1] is StateRejection.REBOOTED


def test_late_datagrams_between_new_ones_are_no_reboot():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(60_000_000))
    for i in range(10):
        assert telemetry.on_odometry(odometry(50_000_000 + 4000 * i)) is StateRejection.BACK_IN_TIME
        assert isinstance(telemetry.on_odometry(odometry(60_004_000 + 4000 * i)), VehicleState)


def test_one_stamp_far_ahead_does_not_shut_out_the_rest():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(20_000_000))
    assert telemetry.on_odometry(odometry(2**63)) is StateRejection.FAR_AHEAD
    assert isinstance(telemetry.on_odometry(odometry(20_004_000)), VehicleState)


def test_after_a_long_silence_the_second_state_is_taken():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(20_000_000))
    assert telemetry.on_odometry(odometry(50_000_000)) is StateRejection.FAR_AHEAD
    assert isinstance(telemetry.on_odometry(odometry(50_004_000)), VehicleState)


def test_attitude_between_states():
    telemetry = Telemetry(1)
    telemetry.on_odometry(odometry(20_000_000))
    sample = telemetry.on_attitude(attitude(20_003, q=(0.6 * 1.05, 0.8 * 1.05, 0.0, 0.0), w=(0.5, 0.0, -0.5)))
    assert isinstance(sample, AttitudeSample)
    assert sample.t_vehicle_us == 20_003_000
    assert sample.q == pytest.approx((0.6, 0.8, 0.0, 0.0), abs=1e-6)
    assert sample.w == (0.5, 0.0, -0.5)
    assert telemetry.accepted == 0 + 1  # an attitude is no state
    assert telemetry.on_attitude(attitude(20_003)) is StateRejection.REPEATED
    assert telemetry.on_attitude(attitude(20_001)) is StateRejection.BACK_IN_TIME
    assert telemetry.on_attitude(attitude(40_000)) is StateRejection.FAR_AHEAD
    assert telemetry.on_attitude(attitude(20_007, q=(0.0, 0.0, 0.0, 0.0))) is StateRejection.ZERO_QUATERNION
    assert telemetry.on_attitude(attitude(20_007, w=(math.nan, 0.0, 0.0))) is StateRejection.NOT_FINITE
    assert telemetry.on_attitude(attitude(20_007, system=9)) is StateRejection.NOT_FROM_AUTOPILOT
    assert isinstance(telemetry.on_attitude(attitude(20_007)), AttitudeSample)


def test_every_rejection_has_a_sentence_of_its_own():
    sentences = {rejection.sentence for rejection in StateRejection}
    assert len(sentences) == len(StateRejection)
    assert all(len(sentence.split()) > 4 for sentence in sentences)


@settings(deadline=None)
@given(st.binary(max_size=240))
def test_whatever_is_taken_can_be_flown_on(payload):
    state = Telemetry(1).on_odometry(Frame(codec.ODOMETRY, 1, 1, 0, payload, b"", 0))
    if isinstance(state, VehicleState):
        assert all(math.isfinite(x) for part in (state.p, state.v, state.q, state.w) for x in part)
        assert math.hypot(*state.q) == pytest.approx(1.0, abs=1e-9)


@settings(deadline=None)
@given(
    st.tuples(*[st.floats(width=32)] * 4),
    st.tuples(*[st.floats(width=32)] * 3),
    st.sampled_from([1, 12]),
)
def test_no_attitude_or_velocity_makes_a_state_that_is_none(q, v, child):
    state = Telemetry(1).on_odometry(odometry(q=q, v=v, child=child))
    if isinstance(state, VehicleState):
        assert all(math.isfinite(x) for x in (*state.v, *state.q))
        assert math.hypot(*state.v) == pytest.approx(math.hypot(*v), rel=1e-6, abs=1e-6)
    else:
        assert state in {
            StateRejection.NOT_FINITE,
            StateRejection.ZERO_QUATERNION,
            StateRejection.ABSURD_MAGNITUDE,
        }
