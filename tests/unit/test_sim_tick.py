"""Messages may go out before the vehicle has moved: the same bytes, only earlier; and how answers are awaited."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Mapping

import pytest

from sim_link.autopilot import Result
from sim_link.codec import (
    ID_ATTITUDE_TARGET,
    ID_HIL_STATE_QUATERNION,
    ID_ODOMETRY,
    ID_SET_ATTITUDE_TARGET,
    ID_TIMESYNC,
    SET_ATTITUDE_TARGET,
    TIMESYNC,
    Encoder,
    frames,
    mavlink,
    timesync,
)
from sim_link.modes import Mode
from sim_link.peer import Peer, PeerOptions
from sim_link.vehicle import Foretold, Vehicle, VehicleOptions
from sim_link.vehicle_file import load

IN_AIR = ((0.0, 0.0, -20.0), 0.0)


def in_air(**options: object) -> Vehicle:
    v = Vehicle(VehicleOptions(vehicle=load("paper"), start=IN_AIR, engine="python", **options))  # type: ignore[arg-type]
    v.companion.set_interval(ID_ODOMETRY, 1, v.t_us)
    return v


def sent(v: Vehicle, ticks: int) -> tuple[list[list[bytes]], int]:
    """Return what each tick queued, and how many of them did so before the vehicle moved."""
    out = []
    early = []
    for _ in range(ticks):
        before = v.t_us

        def queued(now_us: int, before: int = before) -> None:
            assert now_us == before + v.period_us
            early.append(v.t_us == before)

        v.tick(queued)
        out.append(list(v.companion.outbox))
        v.companion.outbox.clear()
        v.look_ahead()
    assert len(early) == ticks
    return out, sum(early)


def test_messages_of_the_past_go_out_before_the_move_and_are_the_same() -> None:
    usual, patient = in_air(), in_air()
    patient._tell_the_past = lambda due: False  # type: ignore[method-assign]
    ahead, early = sent(usual, 300)
    after, late = sent(patient, 300)
    assert ahead == after
    assert early > 150
    assert late == 0
    assert usual.airframe.truth() == patient.airframe.truth()
    assert all(any(frame.msg_id == ID_ODOMETRY for raw in tick for frame in frames(raw)) for tick in ahead)


def test_messages_of_the_present_wait_for_the_move() -> None:
    v = in_air()
    v.companion.set_interval(ID_ATTITUDE_TARGET, 1, v.t_us)
    v.tick()
    out, early = sent(v, 20)
    assert early == 0
    assert all(any(frame.msg_id == ID_ATTITUDE_TARGET for raw in tick for frame in frames(raw)) for tick in out)


def flown(
    states: int, *, hurries: bool, happens: Mapping[int, Callable[[Vehicle], object]] | None = None, **options: object
) -> tuple[bytes, object, int]:
    """Fly in lockstep with a companion of few words; gives what it received, the truth, and the states told ahead.

    happens: what is done to the vehicle before which state, when the state may be out already.
    """
    v = in_air(**options)
    ahead = [0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as companion:
        companion.bind(("127.0.0.1", 0))
        companion.settimeout(5.0)
        peer = Peer(v, PeerOptions(port=0, remote_port=companion.getsockname()[1], lockstep=True))
        tell_ahead = v.tell_ahead

        def told() -> Foretold | None:
            foretold = tell_ahead() if hurries else None
            ahead[0] += foretold is not None
            return foretold

        v.tell_ahead = told  # type: ignore[method-assign]
        heard, encoder = b"", Encoder(1, 191)
        try:
            for k in range(states):
                if happens and k in happens:
                    happens[k](v)
                peer._advance()
                if k == 200:
                    assert v.autopilot.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
                while not peer._answered:  # of a state from before a reboot the answer does not count
                    asked = None
                    while asked is None:
                        datagram = companion.recv(2048)
                        heard += datagram
                        found = frames(datagram)
                        asked = next((timesync(f.payload)[1] for f in found if f.msg_id == ID_TIMESYNC), None)
                    thrust = 0.5 + 0.2 * math.sin(0.1 * k)
                    setpoint = (0, 1.0, 0.0, 0.0, 0.0, 0.1, -0.05, 0.02, thrust, 1, 1, 128, 0.0, 0.0, 0.0)
                    answer = encoder.hot(ID_SET_ATTITUDE_TARGET, SET_ATTITUDE_TARGET.pack(*setpoint))
                    if k % 50 == 7:  # somebody asks for something now and then
                        answer += encoder.cold(mavlink.MAVLink_param_request_read_message(1, 1, b"MC_ROLL_P", -1))
                    answer += encoder.hot(ID_TIMESYNC, TIMESYNC.pack(asked + 1, asked, 1, 1))
                    companion.sendto(answer, ("127.0.0.1", peer.companion.port))
                    peer._spin(0.2)
                peer._flush()
        finally:
            peer.close()
    return heard, v.airframe.truth(), ahead[0]


def test_states_told_before_the_setpoint_is_acted_on_are_the_same() -> None:
    hurried, hurried_truth, ahead = flown(600, hurries=True)
    usual, usual_truth, none = flown(600, hurries=False)
    assert ahead > 200
    assert none == 0
    assert hurried == usual
    assert hurried_truth == usual_truth


def test_a_state_told_ahead_is_not_told_again_when_a_ground_station_asks_for_the_present() -> None:
    def asks(v: Vehicle) -> None:
        v.ground.speak()
        assert v.ground.set_interval(ID_ATTITUDE_TARGET, 1, v.t_us)

    hurried, hurried_truth, ahead = flown(400, hurries=True, happens={300: asks})
    usual, usual_truth, _ = flown(400, hurries=False, happens={300: asks})
    assert 50 < ahead < 110
    assert (hurried, hurried_truth) == (usual, usual_truth)


def test_a_time_that_comes_again_after_a_reboot_is_told_again() -> None:
    def reboots(v: Vehicle) -> None:
        assert v.autopilot.set_mode(Mode.HOLD) is Result.ACCEPTED
        v.finish_boot(v.t_us - 20 * v.period_us)
        v.companion.set_interval(ID_ODOMETRY, 1, v.t_us)

    heard, _, ahead = flown(340, hurries=True, happens={300: reboots})
    assert ahead > 50
    states = [frame for frame in frames(heard) if frame.msg_id in (ID_ODOMETRY, ID_TIMESYNC)]
    assert [f.msg_id for f in states[-60:]] == [ID_ODOMETRY, ID_TIMESYNC] * 30


def test_where_messages_are_signed_no_state_is_told_before_the_answer_was_verified() -> None:
    v = in_air(signing_key=bytes(range(32)))
    v.tick()
    v.look_ahead()
    assert v.autopilot.set_mode(Mode.OFFBOARD) is not None
    assert v.tell_ahead() is None


@pytest.mark.parametrize("wanted", [True, False])
def test_the_truth_is_built_for_its_port_alone(wanted: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ears:
        ears.bind(("127.0.0.1", 0))
        ears.settimeout(5.0)
        v = in_air()
        built: list[int] = []
        publish = v._publish_truth

        def noted(now_us: int) -> None:
            built.append(now_us)
            publish(now_us)

        v._publish_truth = noted  # type: ignore[method-assign]
        port = ears.getsockname()[1] if wanted else None
        peer = Peer(v, PeerOptions(port=0, remote_port=0, truth_port=port, lockstep=True))
        try:
            for _ in range(100):
                peer._advance()
            assert len(built) == (11 if wanted else 0)
            assert not v.truth_outbox
            if wanted:
                heard = [frame.msg_id for _ in built for frame in frames(ears.recv(2048))]
                assert heard == [ID_HIL_STATE_QUATERNION] * 11
        finally:
            peer.close()


def test_polling_in_vain_makes_room_for_the_companion(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = Peer(in_air(), PeerOptions(port=0, remote_port=0, lockstep=True))
    try:
        polls: list[int] = []
        state = 0
        answers = False

        def spin(limit_s: float) -> None:
            polls.append(state)
            peer._answered = answers

        monkeypatch.setattr(peer, "_spin", spin)
        for state in range(12):  # noqa: B007
            peer._answered = False
            peer._spin_first()
        assert polls == [0, 2, 6]
        answers = True
        for state in range(12, 20):  # noqa: B007
            peer._answered = False
            peer._spin_first()
        assert polls[3:] == [14, 15, 16, 17, 18, 19]
    finally:
        peer.close()
