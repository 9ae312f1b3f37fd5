"""The autopilot's tables and small state machines, case by case."""

import math
import struct

import pytest

from sim_link.failsafe import Action, Cause, Decision, Health, decide
from sim_link.geodesy import HOME_ALTITUDE_M, global_position
from sim_link.land_detector import LandDetector, Motion
from sim_link.link import ONBOARD_HZ, Link
from sim_link.messages import Telemetry, truth_payload
from sim_link.modes import Mode, from_custom_mode, from_numbers
from sim_link.parameters import INT32, REAL32, ParameterError, Parameters
from sim_link.steering import position_parameters
from sim_link.watch import DisarmTimer, TiltWatch

LEVEL = (1.0, 0.0, 0.0, 0.0)
WELL = Health(offboard_ok=True, sticks_ok=False, sticks_at_arming=False, ground_ok=True)


def test_packed_modes_are_px4_s():
    packed = {
        Mode.OFFBOARD: 393216,
        Mode.POSITION: 196608,
        Mode.ALTITUDE: 131072,
        Mode.STABILIZED: 458752,
        Mode.ACRO: 327680,
        Mode.TAKEOFF: 33816576,
        Mode.HOLD: 50593792,
        Mode.MISSION: 67371008,
        Mode.RETURN: 84148224,
        Mode.LAND: 100925440,
    }
    for mode, number in packed.items():
        assert mode.custom_mode == number
        assert from_custom_mode(number) is mode
    assert from_numbers(6, 9) is Mode.OFFBOARD
    assert from_numbers(4, 77) is None
    assert from_numbers(3, 1) is None, "orbit is not flown here"
    assert {mode for mode in Mode if not mode.can_arm} == {Mode.RETURN, Mode.LAND, Mode.DESCEND, Mode.TERMINATION}
    assert from_numbers(4, 20) is None, "Descend cannot be asked for"


@pytest.mark.parametrize(
    ("act", "rc_act", "sticks", "action"),
    [
        (0, 2, False, Action.RETURN),
        (0, 2, True, Action.POSITION),
        (1, 3, False, Action.LAND),
        (1, 3, True, Action.ALTITUDE),
        (2, 1, False, Action.HOLD),
        (2, 1, True, Action.STABILIZED),
        (0, 5, False, Action.TERMINATE),
        (0, 6, False, Action.DISARM),
        (0, 0, False, Action.NONE),
        (2, 7, False, Action.NONE),
        (3, 0, False, Action.RETURN),
        (4, 0, False, Action.LAND),
        (5, 0, False, Action.HOLD),
        (6, 0, False, Action.TERMINATE),
        (7, 0, False, Action.DISARM),
    ],
)
def test_offboard_loss(act, rc_act, sticks, action):
    parameters = Parameters("1.18", {"COM_OBL_RC_ACT": act, "NAV_RCL_ACT": rc_act})
    health = WELL._replace(offboard_ok=False, sticks_ok=sticks)
    assert decide(Mode.OFFBOARD, health, parameters) == Decision(action, Cause.OFFBOARD_LOST)
    assert decide(Mode.HOLD, health, parameters) is None, "only OFFBOARD needs the signal"


def test_losing_sticks_and_ground_station():
    parameters = Parameters("1.18", {"NAV_DLL_ACT": 3})
    lost = WELL._replace(sticks_at_arming=True)
    assert decide(Mode.HOLD, lost, parameters) == Decision(Action.RETURN, Cause.STICKS_LOST)
    assert decide(Mode.POSITION, WELL, parameters) == Decision(Action.RETURN, Cause.STICKS_LOST)
    assert decide(Mode.OFFBOARD, WELL, parameters) is None, "sticks that were never there are not missed"
    parameters.set("COM_RCL_EXCEPT", 4)
    assert decide(Mode.OFFBOARD, lost, parameters) is None
    alone = WELL._replace(ground_ok=False)
    assert decide(Mode.OFFBOARD, alone, parameters) == Decision(Action.LAND, Cause.GROUND_LOST)
    parameters.set("COM_DLL_EXCEPT", 4)
    assert decide(Mode.OFFBOARD, alone, parameters) is None


# Parameters


def test_parameters_keep_their_types_and_32_bits():
    p = Parameters()
    assert p.type_of("NAV_RCL_ACT") == INT32 and p.type_of("COM_OF_LOSS_T") == REAL32
    p.set("COM_OF_LOSS_T", 0.3)
    assert p["COM_OF_LOSS_T"] == struct.unpack("<f", struct.pack("<f", 0.3))[0]
    p.set_text("NAV_RCL_ACT", "3")
    assert p["NAV_RCL_ACT"] == 3 and isinstance(p["NAV_RCL_ACT"], int)
    for name, text in (("NAV_RCL_ACT", "1.5"), ("NAV_RCL_ACT", "x"), ("NO_SUCH", "1"), ("NAV_RCL_ACT", "99999999999")):
        with pytest.raises(ParameterError):
            p.set_text(name, text)


@pytest.mark.parametrize("value", [0, 1, -1, 2**31 - 1, -(2**31), -8388607, -5000000])
def test_integers_go_through_the_wire_untouched(value):
    p = Parameters()
    p.set_wire("NAV_RCL_ACT", INT32, struct.pack("<i", value))
    assert p["NAV_RCL_ACT"] == value
    assert p.wire("NAV_RCL_ACT") == struct.pack("<i", value)
    with pytest.raises(ParameterError) as caught:
        p.set_wire("NAV_RCL_ACT", REAL32, b"\0\0\0\0")
    assert caught.value.code == ParameterError.TYPE_MISMATCH


def test_the_sets_of_both_versions_differ():
    new, old = Parameters("1.18"), Parameters("1.13")
    assert "MC_REF_W_N" in new and "MC_REF_W_N" not in old
    assert "COM_RC_OVERRIDE" in old and "COM_RC_OVERRIDE" not in new
    assert new.names == sorted(new.names)
    assert all(new.name_at(new.index_of(name)) == name for name in new.names)
    assert new.name_at(len(new)) is None


def test_what_the_controller_gets_is_always_usable():
    for value in (0.0, -5.0, math.nan, math.inf):
        p = Parameters("1.18", {"MPC_THR_HOVER": value, "MPC_TILTMAX_AIR": value, "MPC_THR_MIN": value})
        got = position_parameters(p)
        assert 0.1 <= got.MPC_THR_HOVER <= 0.8
        assert 1.0 <= got.MPC_TILTMAX_AIR <= 85.0
        assert 0.01 <= got.MPC_THR_MIN <= 0.5


# Land detector, timers


def detector(landed=False):
    return LandDetector(Parameters("1.18", {"MPC_THR_HOVER": 0.5}), landed)


STILL = Motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.05, False, False, True)


def run(land, motion, seconds, t_us=0):
    for k in range(round(seconds * 50) + 1):
        land.update(motion, t_us + 20_000 * k)
    return t_us + 20_000 * (round(seconds * 50) + 1)


def test_landing_takes_three_stages_of_a_third_of_a_second():
    land = detector()
    run(land, STILL, 0.3)
    assert not land.ground_contact
    t = run(land, STILL, 0.1, 320_000)
    assert land.ground_contact and not land.maybe_landed
    run(land, STILL, 0.7, t)
    assert land.landed


@pytest.mark.parametrize(
    "motion",
    [
        STILL._replace(v=(0.0, 0.0, 0.3)),
        STILL._replace(v=(1.6, 0.0, 0.0)),
        STILL._replace(w=(0.4, 0.0, 0.0)),
        STILL._replace(thrust=0.2),
        STILL._replace(thrust=0.1),  # above MPC_MANTHR_MIN + 0.01
        STILL._replace(thrust=0.35, climb_controlled=True, descending=True),
    ],
)
def test_what_is_no_landing(motion):
    land = detector()
    run(land, motion, 3.0)
    assert not land.landed


def test_leaving_the_ground_is_immediate_and_disarmed_is_landed():
    land = detector(landed=True)
    land.update(STILL._replace(thrust=0.6), 20_000)
    assert not land.landed
    land.update(STILL._replace(thrust=0.6, armed=False), 40_000)
    assert land.landed


def test_free_fall_is_no_landing():
    land = detector()
    for k in range(12):  # a fall through the apex: slow for a quarter of a second
        land.update(STILL._replace(v=(0.0, 0.0, -0.12 + 0.02 * 9.81 * (k - 6) / 10)), 20_000 * k)
    assert not land.maybe_landed


def test_disarm_timer():
    timer = DisarmTimer(Parameters())
    assert timer.update(0, True, False) is None
    assert timer.update(10_900_000, True, False) is None
    assert timer.update(11_000_000, True, False) == "Disarmed by auto preflight disarming"
    timer.reset()
    assert timer.update(0, True, True) is None
    assert timer.update(1_000_000, False, True) is None
    assert timer.update(2_000_000, True, True) is None
    assert timer.update(3_900_000, True, True) is None
    assert timer.update(4_000_000, True, True) == "Disarmed by landing"


def test_tilt_watch_needs_its_time_and_an_attitude_controller():
    def tilted(degrees):
        return (math.cos(math.radians(degrees) / 2), math.sin(math.radians(degrees) / 2), 0.0, 0.0)

    watch = TiltWatch(Parameters())
    assert not watch.failed(0, tilted(61), True)
    assert not watch.failed(280_000, tilted(61), True)
    assert watch.failed(320_000, tilted(61), True)
    assert not watch.failed(330_000, tilted(59), True)
    assert not watch.failed(340_000, tilted(61), True)
    assert not watch.failed(900_000, tilted(61), False)


# Messages


def sent(link, period_us, ticks, start_us=0):
    return [link.due(start_us + period_us * k, period_us) for k in range(1, ticks + 1)]


def test_intervals_keep_their_rate_on_a_coarse_grid():
    link = Link(1, ONBOARD_HZ, 0)
    for interval, expected in ((33_333, 300), (4000, 2500), (6000, 1667), (250_000, 40)):
        link.set_interval(331, interval, 0)
        link.streams[331].due_us = 0
        assert sum(331 in ids for ids in sent(link, 4000, 2500)) == pytest.approx(expected, abs=1), interval
    assert link.set_interval(9999, 10_000, 0) is False
    assert link.interval_us(9999) is None
    link.set_interval(331, -1, 0)
    assert link.interval_us(331) == -1


def test_a_quiet_link_sends_its_heartbeat_only():
    link = Link(1, ONBOARD_HZ, 0, quiet=True)
    assert {i for ids in sent(link, 4000, 500) for i in ids} == {0}
    link.speak()
    assert len({i for ids in sent(link, 4000, 600, 2_000_000) for i in ids}) > 8


def test_long_sentences_go_in_chunks():
    (short,) = Telemetry.status_texts(6, "x" * 50, 1)
    assert (short.id, short.chunk_seq) == (0, 0)
    chunks = Telemetry.status_texts(6, "ab" * 60, 7)
    assert [(c.id, c.chunk_seq) for c in chunks] == [(7, 0), (7, 1), (7, 2)]
    assert b"".join(c.text if isinstance(c.text, bytes) else c.text.encode() for c in chunks) == b"ab" * 60


def test_truth_is_in_the_specification_s_units_and_never_overflows():
    payload = truth_payload(5, (100.0, 0.0, -10.0), (1.5, -2.0, 0.25), LEVEL, (0.0, 0.0, 0.0), (9.80665, 0.0, -19.6133))
    fields = struct.unpack("<Q7fiiihhhHHhhh", payload)
    assert fields[8] == pytest.approx(473977420 + 8993, abs=2)
    assert fields[10] == round(1000 * (HOME_ALTITUDE_M + 10.0))
    assert fields[11:14] == (150, -200, 25)
    assert fields[16:] == (1000, 0, -2000)
    wild = (math.nan, 1e12, -1e12)
    truth_payload(5, wild, wild, LEVEL, wild, wild)


def test_home_is_where_px4_s_simulation_is():
    assert global_position((0.0, 0.0, 0.0)) == (473977420, 85455940, 489.4)
    north, east, _ = global_position((111.2, 111.2, 0.0))
    assert north - 473977420 == pytest.approx(10_000, rel=0.01)
    assert east - 85455940 == pytest.approx(10_000 / math.cos(math.radians(47.4)), rel=0.01)
