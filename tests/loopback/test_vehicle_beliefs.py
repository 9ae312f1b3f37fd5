"""What a companion sees when the estimator of the simulated vehicle goes wrong: jump, outage, freeze, stamps, rate."""

import itertools
import math

import pytest
from vehicle_tools import HOLD, IN_AIR, OFFBOARD, Flight, mavlink, vehicle_file

DESCEND = 4 << 16 | 20 << 24
STATES = ("ODOMETRY", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "VFR_HUD")
AHRS = mavlink.MAV_SYS_STATUS_AHRS
NOTHING = (0.0, 0.0, 0.0)


def state(c):
    """The numbers of the last state message."""
    m = c.last["ODOMETRY"]
    return (m.x, m.y, m.z, *m.q, m.vx, m.vy, m.vz, m.rollspeed, m.pitchspeed, m.yawspeed)


def yaw(q):
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2))


def between_states(c, act):
    """Do something with the vehicle while it waits for the answer to a state; the next state shows it."""
    kept = c.each

    def each():
        c.each = kept
        act()
        if kept is not None:
            kept()

    c.each = each
    c.step()


def stream_position(c):
    message = mavlink.MAVLink_set_position_target_local_ned_message
    c.each = lambda: c.send(message(0, 1, 1, 1, 0xDF8, 0.0, 0.0, -20.0, *(0.0,) * 8))


def test_a_reset_is_a_jump_with_a_raised_counter_and_the_truth_does_not_jump():
    flight = Flight(start=IN_AIR)
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        c.interval("LOCAL_POSITION_NED", 1)
        c.run(0.2)
        truth = flight.vehicle.airframe.truth()
        between_states(c, lambda: beliefs.reset((2.0, -1.0, 0.5), (0.3, 0.0, 0.0), 0.5))
        before, numbers = c.last["ODOMETRY"], state(c)
        c.step()
        after = c.last["ODOMETRY"]
        assert after.reset_counter == before.reset_counter + 1
        assert after.time_usec - before.time_usec == 20_000
        jump = [b - a for a, b in zip(numbers, state(c), strict=True)]
        assert jump[:3] == pytest.approx([2.0, -1.0, 0.5], abs=0.01)
        assert jump[7:10] == pytest.approx([0.3, 0.0, 0.0], abs=0.01)
        assert yaw(after.q) - yaw(before.q) == pytest.approx(0.5, abs=0.01)
        local = c.last["LOCAL_POSITION_NED"]
        assert (local.x, local.y, local.z) == pytest.approx(state(c)[:3])
        assert flight.vehicle.airframe.truth().p == pytest.approx(truth.p, abs=0.01)
        c.run(0.2)
        assert c.last["ODOMETRY"].reset_counter == after.reset_counter
        # Position alone: velocity and heading stay.
        between_states(c, lambda: beliefs.reset((0.0, 0.0, 1.0), NOTHING, 0.0))
        numbers = state(c)
        c.step()
        jump = [b - a for a, b in zip(numbers, state(c), strict=True)]
        assert jump == pytest.approx([0.0, 0.0, 1.0, *(0.0,) * 10], abs=0.15)
        assert c.last["ODOMETRY"].reset_counter == after.reset_counter + 1


def test_in_an_outage_no_state_is_sent_and_rates_can_still_be_flown():
    flight = Flight(start=IN_AIR)
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        for name in (*STATES, "ESTIMATOR_STATUS", "SYS_STATUS"):
            assert c.interval(name, 1) == 0
        c.enter_offboard(thrust=0.49)
        c.run(0.1)
        assert c.last["ESTIMATOR_STATUS"].flags == 127
        assert c.last["SYS_STATUS"].onboard_control_sensors_health & AHRS
        between_states(c, lambda: beliefs.set_outage(True))
        c.log.clear()
        c.run(1.5)
        assert [name for name in STATES if c.of_type(name)] == []
        assert c.last["ESTIMATOR_STATUS"].flags == 0
        assert not c.last["SYS_STATUS"].onboard_control_sensors_health & AHRS
        assert len(c.of_type("HEARTBEAT")) in (1, 2)
        assert c.request("ODOMETRY") != 0
        assert c.mode == OFFBOARD
        assert c.set_mode(HOLD) == 1, "Hold needs a position"
        between_states(c, lambda: beliefs.set_outage(False))
        c.log.clear()
        c.run(0.2)
        assert [name for name in STATES if not c.of_type(name)] == []
        assert c.set_mode(HOLD) == 0


def test_position_setpoints_cannot_be_flown_without_a_position():
    flight = Flight(start=IN_AIR, parameters={"COM_OBL_RC_ACT": 5})
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        stream_position(c)
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        c.until(lambda: c.mode == OFFBOARD, 1.0)
        between_states(c, lambda: beliefs.set_outage(True))
        lost_s = c.until(lambda: c.mode == DESCEND, 2.0)
        assert 1.0 <= lost_s <= 1.3
        assert c.intended == OFFBOARD
        assert "Offboard signal lost: Descend" in c.texts()
        assert c.last["HEARTBEAT"].system_status in (mavlink.MAV_STATE_ACTIVE, mavlink.MAV_STATE_CRITICAL)
        c.run(1.2)
        assert c.last["HEARTBEAT"].custom_mode == DESCEND
        assert flight.vehicle.airframe.rigid.v[2] > 0.1
        between_states(c, lambda: beliefs.set_outage(False))
        c.until(lambda: c.mode == OFFBOARD, 0.5)
        c.run(4.0)
        assert c.position == pytest.approx((0.0, 0.0, -20.0), abs=0.3)


def test_offboard_position_setpoints_move_along_until_the_next_one():
    flight = Flight(start=IN_AIR)
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        stream_position(c)
        c.run(0.1)
        assert c.set_mode(OFFBOARD) == 0
        c.run(0.5)
        c.silence()
        c.run(0.1)
        between_states(c, lambda: beliefs.reset((3.0, 0.0, 0.0), NOTHING, 0.0))
        c.run(0.6)
        assert flight.vehicle.airframe.rigid.p == pytest.approx((0.0, 0.0, -20.0), abs=0.05)
        stream_position(c)
        c.run(6.0)
        assert flight.vehicle.airframe.rigid.p == pytest.approx((-3.0, 0.0, -20.0), abs=0.2)


def test_frozen_numbers_come_with_stamps_that_go_on():
    flight = Flight(start=IN_AIR, file=vehicle_file(noise_position_m=0.01, noise_rate_rad_s=0.01))
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        c.enter_offboard(thrust=0.6)
        c.run(0.3)
        between_states(c, lambda: beliefs.set_frozen(True))
        seen, times = set(), []
        for _ in range(25):
            c.step()
            seen.add(state(c))
            times.append(c.last["ODOMETRY"].time_usec)
        assert len(seen) == 1
        assert [b - a for a, b in itertools.pairwise(times)] == [20_000] * 24
        between_states(c, lambda: beliefs.set_frozen(False))
        seen.add(state(c))
        assert len(seen) == 1
        c.step()
        assert state(c) not in seen


def test_stamps_under_delay_rate_and_bad_numbers():
    flight = Flight(start=IN_AIR)
    beliefs = flight.vehicle.airframe.beliefs
    with flight as c:
        assert c.interval("LOCAL_POSITION_NED", 1) == 0
        c.run(0.1)
        assert c.t_us - c.last["ODOMETRY"].time_usec == 0
        between_states(c, lambda: beliefs.set_delay_s(0.1))
        assert c.count("ODOMETRY", 0.1) == 0, "none for as long as the delay rose"
        c.run(0.1)
        assert c.t_us - c.last["ODOMETRY"].time_usec == 100_000
        between_states(c, lambda: beliefs.set_rate_hz(5.0))
        c.log.clear()
        c.run(2.0)
        times = [m.time_usec for m in c.of_type("ODOMETRY")]
        assert [b - a for a, b in itertools.pairwise(times)] == [200_000] * 9
        assert len(c.of_type("LOCAL_POSITION_NED")) == 10
        between_states(c, lambda: beliefs.set_delay_s(None))
        between_states(c, lambda: beliefs.set_rate_hz(None))
        c.run(0.1)
        assert c.t_us - c.last["ODOMETRY"].time_usec == 0
        between_states(c, lambda: beliefs.set_bad_numbers("stamp_back"))
        c.step()
        assert c.t_us - c.last["ODOMETRY"].time_usec == 1_000_000
        assert c.last["LOCAL_POSITION_NED"].time_boot_ms == (c.t_us - 1_000_000) // 1000
        between_states(c, lambda: beliefs.set_bad_numbers("zero_quaternion"))
        c.step()
        assert tuple(c.last["ODOMETRY"].q) == (0.0,) * 4
        between_states(c, lambda: beliefs.set_bad_numbers("nan"))
        c.step()
        assert all(map(math.isnan, state(c)))
        between_states(c, lambda: beliefs.set_bad_numbers(None))
        c.step()
        assert c.position == pytest.approx((0.0, 0.0, -20.0), abs=0.1)
