"""PX4's own tracking as a baseline: what is sent, what is never sent, and what a flight of it says of itself."""

from __future__ import annotations

import math
import struct

import pytest
from record_cases import PHASES, synthetic_flight, track_record

from companion.config import load_flight, load_vehicle
from companion.control import flat
from companion.control.output import PositionSetpoint
from companion.control.types import GRAVITY_M_S2, Reference, State
from companion.errors import RefusedError
from companion.flight.baseline import Px4Baseline
from companion.flight.coast import coast_setpoint
from companion.flight.controller import controller_of
from companion.flight.engines import kernels
from companion.flight.launch import prepare
from companion.flight.tracker import Tracker
from companion.frames import quat_from_yaw
from companion.link import codec
from companion.link.setpoint import (
    ACCELERATION_BOUND_M_S2,
    POSITION_BOUND_M,
    RATE_BOUND_RAD_S,
    SPEED_BOUND_M_S,
    SetpointSender,
    UnsendableSetpoint,
)
from companion.record.folder import write_summary
from companion.record.report import build_report
from companion.record.summary import FlightMeta, summarise

ZERO = (0.0, 0.0, 0.0)
LIBRARY = codec.dialect()
WHOLE = PositionSetpoint((1.25, -2.5, -10.0), (0.5, 1.5, -0.25), (2.0, -3.0, 0.125), 1.5, -0.75)


def payload(setpoint: PositionSetpoint) -> bytes:
    """What goes to the link for it."""
    sent: list[tuple[int, bytes]] = []
    sender = SetpointSender(lambda msgid, data: sent.append((msgid, data)) is None, 3, 1)
    assert sender.send(setpoint, 12_345_678)
    ((msgid, data),) = sent
    assert msgid == 84
    return data


# ---- on the wire ----------------------------------------------------------------------------------------------------

# MAVLink's POSITION_TARGET_TYPEMASK: x 1, y 2, z 4; vx 8, vy 16, vz 32; ax 64, ay 128, az 256; yaw 1024, yaw rate 2048.
MASKS = [
    ({}, 0),
    ({"yaw_rate": None}, 2048),
    ({"yaw": None, "yaw_rate": None}, 1024 + 2048),
    ({"a": None}, 64 + 128 + 256),
    ({"p": None}, 1 + 2 + 4),
    ({"p": None, "a": None, "yaw": None, "yaw_rate": None}, 0b110111000111),
]


@pytest.mark.parametrize(("changes", "mask"), MASKS)
def test_the_bytes_are_pymavlinks(changes, mask):
    setpoint = WHOLE._replace(**changes)
    p, v, a = setpoint.p or ZERO, setpoint.v, setpoint.a or ZERO
    yaw, yaw_rate = setpoint.yaw or 0.0, setpoint.yaw_rate or 0.0
    message = LIBRARY.MAVLink_set_position_target_local_ned_message(
        12_345, 3, 1, LIBRARY.MAV_FRAME_LOCAL_NED, mask, *p, *v, *a, yaw, yaw_rate
    )
    packed = message.pack(LIBRARY.MAVLink(None, srcSystem=1, srcComponent=191))
    assert packed[10:-2] == payload(setpoint).rstrip(b"\0")
    assert message.crc_extra == codec.message_formats()[84].crc_extra
    assert message.unpacker.size == len(payload(setpoint))


WRONG = [
    *({"p": (0.0, x, 0.0)} for x in (math.nan, math.inf, 1.01 * POSITION_BOUND_M)),
    *({"v": (0.0, 0.0, x)} for x in (math.nan, -math.inf, 1.01 * SPEED_BOUND_M_S)),
    *({"a": (x, 0.0, 0.0)} for x in (math.nan, math.inf, -1.01 * ACCELERATION_BOUND_M_S2)),
    *({"yaw": x} for x in (math.nan, math.inf, 3.2, -3.2)),
    *({"yaw_rate": x} for x in (math.nan, -math.inf, 1.01 * RATE_BOUND_RAD_S)),
]


@pytest.mark.parametrize("changes", WRONG)
def test_what_is_no_setpoint_is_never_sent(changes):
    sent: list[bytes] = []
    with pytest.raises(UnsendableSetpoint, match=r"is not within"):
        SetpointSender(lambda msgid, data: sent.append(data) is None, 1).send(WHOLE._replace(**changes), 1)
    assert sent == []


def test_the_bounds_themselves_may_be_sent():
    payload(PositionSetpoint((POSITION_BOUND_M, 0.0, 0.0), ZERO, None, math.pi, -RATE_BOUND_RAD_S))


# ---- the controller -------------------------------------------------------------------------------------------------


def moving(t: float) -> Reference:
    """A straight line whose heading, as commanded, turns at 0.5 rad/s."""
    return Reference((2.0 * t, 0.0, -5.0), (2.0, 0.0, 0.0), ZERO, ZERO, ZERO, 0.5 * t, 0.5, 0.0)


def circle(t: float) -> Reference:
    """A circle of 2 m at 0.5 rad/s: the course turns as fast."""
    n, e = 2.0 * math.cos(0.5 * t), 2.0 * math.sin(0.5 * t)
    return Reference((n, e, -5.0), (-0.5 * e, 0.5 * n, 0.0), (-0.25 * n, -0.25 * e, 0.0), ZERO, ZERO, 0.0, 0.0, 0.0)


def standing(yaw: float = 0.0) -> State:
    return State((0.0, 0.0, -5.0), ZERO, quat_from_yaw(yaw), ZERO)


def baseline(heading: str, **limits: float) -> Px4Baseline:
    overrides = {"controller": {"heading": heading}, "limits": limits, "link": {"state_age_s": 0.03}}
    return Px4Baseline(load_vehicle("windtest", overrides))


def test_the_reference_is_that_of_the_time_of_effect():
    """30 ms after the stamp, all derivatives alike; nothing of the law is in the record's numbers."""
    controller = baseline("commanded", heading_rate_max_rad_s=500.0)
    controller.begin(standing(0.4))
    out = controller.step(1.0, standing(0.4), moving)
    assert out.setpoint == PositionSetpoint(
        pytest.approx((2.06, 0.0, -5.0)), (2.0, 0.0, 0.0), ZERO, pytest.approx(0.515), 0.5
    )
    there = {i for i, value in enumerate(out.numbers) if not math.isnan(value)}
    assert there == {flat.LIMITS, flat.HEADING_ERROR}
    assert len(out.numbers) == flat.RESULTS
    # the heading error is that at the stamp: 0.4 where 0.5 is due
    assert out.numbers[flat.HEADING_ERROR] == pytest.approx(-0.1)


def test_the_nose_goes_along_the_path():
    controller = baseline("sideslip", heading_rate_max_rad_s=500.0)
    controller.begin(standing())
    for k in range(20):
        t = 0.01 * k
        setpoint = controller.step(t, standing(), circle).setpoint
        assert isinstance(setpoint, PositionSetpoint)
        assert setpoint.yaw == pytest.approx(0.5 * math.pi + 0.5 * (t + 0.03))
        assert setpoint.yaw_rate == pytest.approx(0.5)


def test_the_nose_is_held_while_there_is_no_direction():
    controller = baseline("sideslip", heading_rate_max_rad_s=500.0)
    controller.begin(standing(1.0))
    speeds = [0.0, 0.29, 0.59, 0.61, 0.31, 0.29, 0.31]  # held below 0.3 m/s, and from there on below 0.6 m/s
    yaws = []
    for k, speed in enumerate(speeds):
        reference = Reference(ZERO, (0.0, speed, 0.0), ZERO, ZERO, ZERO, 0.0, 0.0, 0.0)
        yaws.append(controller.step(0.01 * k, standing(1.0), lambda t, r=reference: r).setpoint.yaw)
    east = 0.5 * math.pi
    assert yaws == pytest.approx([1.0, 1.0, 1.0, east, east, east, east])


def test_the_nose_turns_no_faster_than_allowed_and_the_short_way():
    controller = baseline("commanded", heading_rate_max_rad_s=1.0)
    controller.begin(standing(3.0))
    back = Reference(ZERO, ZERO, ZERO, ZERO, ZERO, -3.0, 0.0, 0.0)
    seen = [controller.step(0.01 * k, standing(3.0), lambda t: back).setpoint for k in range(40)]
    yaws = [setpoint.yaw for setpoint in seen]
    assert yaws[:10] == pytest.approx([3.0 + 0.01 * (k + 1) for k in range(10)])
    assert seen[0].yaw_rate == 1.0
    assert (yaws[-1], seen[-1].yaw_rate) == (pytest.approx(-3.0), 0.0)
    assert all(abs(yaw) <= math.pi for yaw in yaws)


def test_a_free_heading_is_not_commanded():
    controller = baseline("damping")
    controller.begin(standing(1.0))
    out = controller.step(1.0, standing(1.0), circle)
    assert (out.setpoint.yaw, out.setpoint.yaw_rate) == (None, None)
    assert math.isnan(out.numbers[flat.HEADING_ERROR])


def flight_of(controller: str, **more):
    def adjust(data):
        data["output"] = {"controller": controller, "kind": "attitude"}
        for key, value in more.items():
            data["vehicle"]["controller"][key] = value

    return load_flight("windtest", adjust)


def test_the_flight_file_chooses():
    compiled = kernels("python")
    assert isinstance(controller_of(flight_of("law"), compiled), Tracker)
    assert isinstance(controller_of(flight_of("px4"), compiled), Px4Baseline)
    assert (flight_of("law").output.sends, flight_of("px4").output.sends) == ("attitude", "position")


def test_without_a_state_it_is_told_to_stop():
    setpoint = coast_setpoint(flight_of("px4"), quat_from_yaw(0.3))
    assert setpoint == PositionSetpoint(None, ZERO, None, None, None)
    data = payload(setpoint)
    assert struct.unpack_from("<H", data, 48) == (0b110111000111,)
    assert data[4:48] == bytes(44)


def test_without_a_state_the_law_coasts_with_the_thrust_as_it_was_found_to_be():
    flight = flight_of("law")
    by_file = coast_setpoint(flight, quat_from_yaw(0.3))
    weaker = coast_setpoint(flight, quat_from_yaw(0.3), thrust_scale=0.8)
    curve, full_n = flight.vehicle.rotors.curve_factor, flight.vehicle.thrust_full_n

    def lift_n(setpoint):
        return full_n * (curve * setpoint.thrust**2 + (1.0 - curve) * setpoint.thrust)

    weight_n = flight.vehicle.body.mass_kg * GRAVITY_M_S2
    assert lift_n(by_file) == pytest.approx(weight_n)
    assert 0.8 * lift_n(weaker) == pytest.approx(weight_n)
    assert weaker.q == by_file.q == pytest.approx(quat_from_yaw(0.3))


def test_gates_of_the_gains_are_the_laws_alone(tmp_path):
    """Gains that no flight of the law would be allowed with mean nothing to PX4; the reference's limits do."""
    with pytest.raises(RefusedError, match="not certified"):
        prepare(flight_of("law", gamma_1_s3=60.0), tmp_path / "law")
    folder = prepare(flight_of("px4", gamma_1_s3=60.0), tmp_path / "px4")
    assert 'controller = "px4"' in (folder / "flight.toml").read_text()
    fast = flight_of("px4").model_copy(update={"trajectory": "paper"})
    slow = fast.vehicle.limits.model_copy(update={"speed_max_m_s": 0.5})
    with pytest.raises(RefusedError, match="speed"):
        vehicle = fast.vehicle.model_copy(update={"limits": slow})
        prepare(fast.model_copy(update={"vehicle": vehicle}), tmp_path / "fast")


# ---- what is said of it ---------------------------------------------------------------------------------------------


def test_the_summary_leaves_out_what_the_law_alone_has():
    errors = [(0.03, 0.04, 0.0)] * 4
    meta = FlightMeta("path", "vehicle", statistics_from_s=0.0, acceptance={"position_rms_m": 0.04}, controller="px4")
    summary = summarise(track_record(errors), PHASES, meta)
    assert summary["controller"] == "px4"
    assert summary["position_rms_m"] == summary["track_rms_m"] == pytest.approx(0.05)
    assert (summary["disturbance_m_s2"], summary["thrust_min_n"], summary["thrust_max_n"]) == (None, None, None)
    assert summary["verdict"] == "missed: position_rms_m 0.05 > 0.04"


def test_flights_that_never_settle_can_be_compared_all_the_same():
    summary = summarise(track_record([(3.0, 4.0, 0.0), (0.0, 0.0, 1.0)]), PHASES, FlightMeta("path", "vehicle"))
    assert (summary["verdict"], summary["position_rms_m"]) == ("not settled", None)
    assert summary["track_rms_m"] == pytest.approx(math.sqrt(13.0))


@pytest.mark.parametrize(("controller", "by_law"), [("law", True), ("px4", False)])
def test_the_report_says_who_flew(tmp_path, controller, by_law):
    record = synthetic_flight(20.0)
    record.save(tmp_path)
    summary = summarise(record, PHASES, FlightMeta("path", "vehicle", controller=controller))
    if not by_law:
        summary["px4_parameters"] = {"MPC_XY_P": 0.95}
    write_summary(tmp_path, summary)
    text = f'[vehicle.controller]\nk2 = 3.0\n[output]\ncontroller = "{controller}"\n'
    (tmp_path / "flight.toml").write_text(text, encoding="utf-8")
    page = build_report(tmp_path).read_text(encoding="utf-8")
    shown = page[: page.index("<script")]  # what people read; the rest is plotly.js
    assert ("by <b>the law</b>" in shown, "PX4's own position controller" in shown) == (by_law, not by_law)
    for words in ("Figure 3: force estimates", "Figure 4: the four errors", "Figure 5: actuation", "Gains used"):
        assert (words, words in page) == (words, by_law)
    assert ('id="plan-view"' in page) and ('id="position-error"' in page)
    assert ("MPC_XY_P" in page) is not by_law
    assert ("<span>Disturbance</span>" in page) is by_law
