"""Setpoints on the wire, and the ones that never get there."""

import math
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec
from companion.link.framing import build_frame
from companion.link.setpoint import (
    RATE_BOUND_RAD_S,
    ActuatorSetpoint,
    AttitudeSetpoint,
    RateSetpoint,
    SetpointSender,
    UnsendableSetpoint,
)

LIBRARY = codec.dialect()


class Link:
    """Remembers what was sent, as pymavlink reads it."""

    def __init__(self, takes: bool = True):
        self.messages = []
        self.takes = takes

    def send(self, msgid: int, payload: bytes) -> bool:
        raw = build_frame(msgid, payload, 0, 1, 191, codec.message_formats()[msgid].crc_extra)
        self.messages.append(LIBRARY.MAVLink(None).decode(bytearray(raw)))
        return self.takes


def sent(setpoint, t_us: int = 12_345_678):
    link = Link()
    assert SetpointSender(link.send, 3, 1).send(setpoint, t_us)
    return link.messages[0]


def test_rates_and_thrust():
    message = sent(RateSetpoint(0.5, (1.0, -2.0, 0.25)))
    assert message.get_type() == "SET_ATTITUDE_TARGET"
    assert (message.type_mask, message.target_system, message.target_component) == (128, 3, 1)
    assert (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate) == (1.0, -2.0, 0.25)
    assert message.thrust == 0.5
    assert message.time_boot_ms == 12_345
    assert list(message.q) == [1.0, 0.0, 0.0, 0.0]


def test_attitude_yaw_rate_and_thrust():
    message = sent(AttitudeSetpoint(0.25, (0.0, 1.0, 0.0, 0.0), -0.5))
    assert message.type_mask == 3
    assert list(message.q) == [0.0, 1.0, 0.0, 0.0]
    assert (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate) == (0.0, 0.0, -0.5)
    assert message.thrust == 0.25


def test_torque_and_thrust():
    message = sent(ActuatorSetpoint(0.5, (0.125, -0.25, 1.0)))
    assert message.get_type() == "SET_ACTUATOR_CONTROL_TARGET"
    assert (message.group_mlx, message.target_system, message.target_component) == (0, 3, 1)
    assert list(message.controls) == [0.125, -0.25, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    assert message.time_usec == 12_345_678


def test_the_milliseconds_wrap_after_seven_weeks():
    assert sent(RateSetpoint(0.5, (0.0, 0.0, 0.0)), (2**32 + 5) * 1000).time_boot_ms == 5


def test_the_link_may_decline():
    sender = SetpointSender(Link(takes=False).send, 1)
    assert not sender.send(RateSetpoint(0.5, (0.0, 0.0, 0.0)), 1)
    assert sender.sent == 0


NOT_NUMBERS = [math.nan, math.inf, -math.inf]
LEVEL = (1.0, 0.0, 0.0, 0.0)
BAD = (
    [RateSetpoint(thrust, (0.0, 0.0, 0.0)) for thrust in [*NOT_NUMBERS, -1e-6, 1.0001]]
    + [RateSetpoint(0.5, (0.0, rate, 0.0)) for rate in [*NOT_NUMBERS, 20.1, -20.1, 1e39]]
    + [AttitudeSetpoint(thrust, LEVEL, 0.0) for thrust in [*NOT_NUMBERS, -0.1, 1.1]]
    + [AttitudeSetpoint(0.5, LEVEL, rate) for rate in [*NOT_NUMBERS, 21.0]]
    + [AttitudeSetpoint(0.5, (x, 0.0, 0.0, 0.0), 0.0) for x in [*NOT_NUMBERS, 0.0, 0.9, 1.01, 1e300]]
    + [AttitudeSetpoint(0.5, (1.0, 0.0, x, 0.0), 0.0) for x in NOT_NUMBERS]
    + [ActuatorSetpoint(thrust, (0.0, 0.0, 0.0)) for thrust in [*NOT_NUMBERS, -0.1, 1.1]]
    + [ActuatorSetpoint(0.5, (0.0, 0.0, torque)) for torque in [*NOT_NUMBERS, 1.01, -1.01]]
)


@pytest.mark.parametrize("setpoint", BAD, ids=str)
def test_what_must_not_be_sent_is_not(setpoint):
    link = Link()
    sender = SetpointSender(link.send, 1)
    with pytest.raises(UnsendableSetpoint):
        sender.send(setpoint, 1)
    assert link.messages == []
    assert sender.sent == 0


any_float = st.floats() | st.floats(-1.5, 1.5)
vec3 = st.tuples(any_float, any_float, any_float)
setpoints = st.one_of(
    st.builds(RateSetpoint, any_float, vec3),
    st.builds(AttitudeSetpoint, any_float, st.tuples(any_float, any_float, any_float, any_float), any_float),
    st.builds(ActuatorSetpoint, any_float, vec3),
)


@settings(deadline=None)
@given(setpoints)
def test_whatever_is_sent_is_sane(setpoint):
    link = Link()
    try:
        SetpointSender(link.send, 1).send(setpoint, 1)
    except UnsendableSetpoint:
        assert link.messages == []
        return
    (message,) = link.messages
    if message.get_type() == "SET_ATTITUDE_TARGET":
        assert 0.0 <= message.thrust <= 1.0
        assert math.hypot(*message.q) == pytest.approx(1.0, abs=2e-3)
        rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        assert all(abs(rate) <= RATE_BOUND_RAD_S for rate in rates)
    else:
        assert 0.0 <= message.controls[3] <= 1.0
        assert all(abs(control) <= 1.0 for control in message.controls)


def test_something_else_is_no_setpoint():
    class Lookalike(NamedTuple):
        thrust: float
        w: tuple[float, float, float]

    link = Link()
    with pytest.raises(UnsendableSetpoint, match="no kind of setpoint"):
        SetpointSender(link.send, 1).send(Lookalike(0.5, (0.0, 0.0, 0.0)), 1)  # type: ignore[arg-type]
    assert link.messages == []


def test_the_limits_themselves_are_sendable():
    for thrust in (0.0, 1.0):
        sent(RateSetpoint(thrust, (RATE_BOUND_RAD_S, -RATE_BOUND_RAD_S, 0.0)))
    sent(ActuatorSetpoint(1.0, (1.0, -1.0, 1.0)))
