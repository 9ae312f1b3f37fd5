"""Orders to a flight of the bundled vehicle, in lockstep: the vehicle rests where it is told to, and goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flight_cases import COMMAND_ACK, HOLD, HOVER, INDOOR, LAND, OFFBOARD, Flown, Stand, make_flight

from companion.campaign.replay import replay
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import Cause, Order
from companion.record.folder import write_configuration, write_summary
from sim_link.modes import Mode

Plan = list[tuple[float, Order]]


def ordered(stand: Stand, plan: Plan, refusals: list[str]) -> Callable[[FlightLoop], None]:
    """Gives orders at times after OFFBOARD."""

    def prepare(loop: FlightLoop) -> None:
        for seconds, order in plan:
            stand.after_offboard(seconds, lambda order=order: refusals.append(loop.order(order)))  # type: ignore[misc]

    return prepare


def fly(folder: Path, plan: Plan, engine: str = "python", **changes: Any) -> tuple[Flown, Stand]:
    flight = make_flight(**changes)
    refusals: list[str] = []
    with Stand(flight, folder) as stand:
        flown = stand.fly(ordered(stand, plan, refusals), engine=engine)
        assert refusals == [""] * len(plan)
    return flown, stand


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
def test_pause_and_resume_in_the_air(tmp_path: Path, engine: str) -> None:
    plan = [(2.0, Order.PAUSE), (7.0, Order.RESUME)]
    trajectory = dict(INDOOR) | {"join": "law"}
    flown, stand = fly(tmp_path, plan, engine, trajectory=trajectory)
    assert (flown.cause, flown.phases[-4:]) == (Cause.COMPLETED, ["track", "pause", "track", "hold"])
    record = flown.record
    first = int(np.argmax(record.in_phase("pause")))
    error = np.linalg.norm(record.columns("error_n", "error_e", "error_d"), axis=1)
    assert error[first:].max() < error[first] + 0.01  # it is still settling from the join
    assert error[first + 200 :].max() < 0.02
    speed = np.linalg.norm(record.columns("v_n", "v_e", "v_d"), axis=1)
    assert speed[record.in_phase("pause")].min() < 0.02
    reference = record.columns("ref_v_n", "ref_v_e", "ref_v_d")
    assert np.linalg.norm(np.diff(reference, axis=0), axis=1).max() < 0.02 + 2.0 / 100.0
    assert np.linalg.norm(reference, axis=1)[record.in_phase("pause")].min() == 0.0
    assert math.isclose(flown.summary["duration_s"], 6.0, abs_tol=0.03)
    assert [code for _, code in stand.mode_requests(-1.0)][-2:] == [OFFBOARD, HOLD]
    check_replay(tmp_path, flown, engine)


def check_replay(folder: Path, flown: Flown, engine: str) -> None:
    """The record holds the changes of pace: its commands can be computed again to the last bit."""
    assert flown.outcome.engagement is not None
    assert [ramp.rate for ramp in flown.outcome.engagement.ramps] == [0.0, 1.0]
    out = folder / "out"
    out.mkdir()
    write_configuration(out, make_flight(trajectory=dict(INDOOR) | {"join": "law"}).model_dump(exclude_none=True))
    write_summary(out, flown.summary | {"engagement": asdict(flown.outcome.engagement)})
    flown.record.save(out)
    assert replay(out, kernels(engine)).identical


def test_stop_on_the_way(tmp_path: Path) -> None:
    flown, stand = fly(tmp_path, [(2.0, Order.STOP)], trajectory=dict(INDOOR) | {"join": "law"})
    assert (flown.cause, flown.code) == (Cause.STOPPED, 0)
    assert flown.outcome.sentence == "stopped by the operator: the vehicle is in Hold"
    assert stand.mode is Mode.HOLD
    assert stand.mode_requests()[-1][1] == HOLD
    speed = np.linalg.norm(flown.record.columns("v_n", "v_e", "v_d"), axis=1)
    assert speed[-1] < 0.02


def test_land_out_of_the_air(tmp_path: Path) -> None:
    flight = make_flight(trajectory=dict(HOVER) | {"duration_s": 30.0})
    refusals: list[str] = []
    with Stand(flight, tmp_path, start=((0.0, 0.0, -3.0), 0.0)) as stand:
        flown = stand.fly(ordered(stand, [(1.0, Order.LAND)], refusals))
        assert stand.vehicle.autopilot.mode.custom_mode == LAND
    assert refusals == [""]
    assert flown.outcome.sentence == "stopped by the operator: landed and disarmed"
    assert flown.phases[-2:] == ["hold", "land"]


@pytest.mark.parametrize(("order", "mode"), [(Order.STOP, Mode.HOLD), (Order.LAND, Mode.LAND)])
def test_an_order_between_arming_and_its_heartbeat_keeps_the_vehicle_down(
    order: Order, mode: Mode, tmp_path: Path
) -> None:
    armed_us: list[int] = []
    given: list[tuple[str, bool, bool]] = []

    with Stand(make_flight(takeoff_altitude_m=3.0), tmp_path, start=None) as stand:

        def alter(stand: Stand, number: int, raw: bytes) -> list[bytes]:
            vehicle = stand.vehicle.autopilot.armed
            if vehicle and not armed_us:
                armed_us.append(stand.t_us)
            if armed_us and not given and stand.t_us - armed_us[0] > 0.2e6:
                given.append((loops[0].order(order), vehicle, loops[0].autopilot.armed))
            return [raw]

        loops: list[FlightLoop] = []
        stand.alter = alter
        flown = stand.fly(loops.append)
        assert given == [("", True, False)], "armed, and not said yet"
        assert flown.cause is Cause.STOPPED
        assert stand.mode is mode
        assert stand.vehicle.airframe.truth().p[2] > -0.1, "it did not take off"


def test_a_lost_answer_to_offboard_brings_it_back_after_no_landing(tmp_path: Path) -> None:
    """A request that was not answered is not repeated once the operator wants something else."""
    lost: list[int] = []
    ordered_at: list[float] = []
    seen: list[Mode] = []
    with Stand(make_flight(), tmp_path) as stand:

        def alter(stand: Stand, number: int, raw: bytes) -> list[bytes]:
            seen.append(stand.mode)
            if stand.offboard_s > 0.2 and not ordered_at:
                ordered_at.append(stand.offboard_s)
                assert loops[0].order(Order.LAND) == ""
            if number == COMMAND_ACK and stand.mode is Mode.OFFBOARD and not lost and not ordered_at:
                lost.append(stand.t_us)
                return []
            return [raw]

        loops: list[FlightLoop] = []
        stand.alter = alter
        flown = stand.fly(loops.append)
    assert lost and ordered_at
    assert Mode.OFFBOARD not in seen[seen.index(Mode.LAND) :]
    assert (flown.cause, flown.outcome.detail) == (Cause.STOPPED, "landed and disarmed")
