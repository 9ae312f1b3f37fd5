"""Random sequences of events drive whole flights through their phases, and what must always hold is looked at.

The control loop and the simulated vehicle are the real ones; they take turns in this thread. Whatever happens, in any
order: no setpoint where nobody means to fly by them, none from an old state, no way back after another hand or an own
silence, and the vehicle ends flown, holding or on the ground.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import pytest
from flight_cases import OFFBOARD, SETPOINTS
from hypothesis import HealthCheck, settings
from hypothesis import Phase as HypothesisPhase
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from matrix_flight import Flown, Stage, TurnWire, flight_of
from matrix_judge import judge

from companion.flight import last_resort, loop
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause, FlightEnded, Order, Outcome
from companion.flight.sequence import Duty
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight
from sim_link import codec
from sim_link.fault_keys import FaultError
from sim_link.modes import Mode

AGE_S, SILENCE_S, PERIOD_S = 0.02, 0.05, 0.01
KNOWS_S = 0.15
"""CURRENT_MODE comes at 10 Hz: so long the companion cannot know of another mode."""
LOSS_S = 1.0
"""COM_OF_LOSS_T."""
FLIGHT = flight_of(trajectory__duration_s=2.0)
COMPILED = kernels("python")
ENDS_WITHIN = 6000
"""Turns, one per state: the longest that is left of a flight, with its landing."""


class Heard:
    """One setpoint that reached the vehicle."""

    def __init__(self, now_s: float, age_s: float, duty: Duty, mode: Mode, by_hand_s: float | None) -> None:
        self.now_s, self.age_s, self.duty, self.mode, self.by_hand_s = now_s, age_s, duty, mode, by_hand_s


class Flights(RuleBasedStateMachine):
    """One flight, and what happens to it."""

    @initialize(seed=st.integers(1, 50), in_air=st.booleans())
    def begin(self, seed: int, in_air: bool) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="states-")
        start = ((0.0, 0.0, -4.0), 0.0) if in_air else None
        self.stage = Stage(FLIGHT, Path(self.folder.name), seed=seed, engine="python", compiled=COMPILED, start=start)
        self.heard: list[Heard] = []
        self.offboard_asked: list[float] = []
        self.other_s: float | None = None
        """When the vehicle left OFFBOARD after it had been there."""
        self.was_offboard = False
        self.looked_at = 0
        self.ended: FlightEnded | None = None
        self.lines: list[str] = []
        self.wire = TurnWire(self.stage)
        self.record = FlightRecord(30_000, PHASE_NAMES)
        self.loop = FlightLoop(
            *(FLIGHT, of_flight(FLIGHT), self.wire, self.record, COMPILED, self.lines.append), connect_timeout_s=5.0
        )
        receive = self.stage.vehicle.receive

        def listening(frame, link) -> None:
            self._on_frame(frame)
            receive(frame, link)

        self.stage.vehicle.receive = listening  # type: ignore[method-assign]
        self.stage.every_state.append(self._watch_mode)
        self.loop._meet()
        self.stage.loop = self.loop

    def _watch_mode(self) -> None:
        mode = self.stage.vehicle.autopilot.mode
        if mode is Mode.OFFBOARD:
            self.was_offboard = True
        elif self.was_offboard and self.other_s is None:
            self.other_s = self.stage.t_s

    def _on_frame(self, frame) -> None:
        vehicle = self.stage.vehicle
        if frame.msg_id in SETPOINTS:
            stamp_ms = int.from_bytes(frame.payload[:4], "little")
            age_s = vehicle.t_us * 1e-6 - stamp_ms * 1e-3
            duty = self.loop._sequence.duty if self.loop._met else Duty.NOTHING
            self.heard.append(Heard(self.stage.t_s, age_s, duty, vehicle.autopilot.mode, self.other_s))
        elif frame.msg_id == 76 and frame.component == 191:  # COMMAND_LONG
            message = codec.Decoder().message(frame)
            if message is not None and message.command == 176:
                wanted = int(message.param2) << 16 | int(message.param3) << 24
                if wanted == OFFBOARD:
                    self.offboard_asked.append(self.stage.t_s)

    def _turns(self, count: int) -> None:
        try:
            for _ in range(count):
                if self.ended is not None:
                    return
                self.loop._turn()
        except FlightEnded as ended:
            self.ended = ended

    def _happens(self, kind: str, for_s: float | None = None, **values) -> None:
        with contextlib.suppress(FaultError):  # it acts already
            self.stage.inject(kind, for_s=for_s, **values)

    # What happens

    @rule(states=st.integers(1, 150))
    def time_passes(self, states: int) -> None:
        self._turns(states)

    @rule(seconds=st.floats(0.5, 6.0))
    def much_time_passes(self, seconds: float) -> None:
        self._turns(round(seconds / PERIOD_S))

    @rule(order=st.sampled_from(list(Order)))
    def the_operator_orders(self, order: Order) -> None:
        self.loop.order(order)

    @rule()
    def the_operator_interrupts(self) -> None:
        self.loop.interrupt()

    @rule(mode=st.sampled_from(["Position", "Altitude", "Hold", "Land", "Offboard"]), for_s=st.floats(0.05, 3.0))
    def the_pilot_takes_over(self, mode: str, for_s: float) -> None:
        self._happens("pilot_mode", for_s, mode=mode)

    @rule(for_s=st.floats(0.02, 2.0), direction=st.sampled_from(["from_vehicle", "to_vehicle", "both"]))
    def the_link_is_silent(self, for_s: float, direction: str) -> None:
        self._happens("silence", for_s, direction=direction)

    @rule(delay_s=st.sampled_from([0.02, 0.06, 0.2]), for_s=st.floats(0.1, 1.5))
    def states_come_late(self, delay_s: float, for_s: float) -> None:
        self._happens("delay", for_s, delay_s=delay_s, direction="from_vehicle")

    @rule(jump_m=st.sampled_from([0.3, 1.0, 4.0]))
    def the_estimate_jumps(self, jump_m: float) -> None:
        self._happens("estimator_reset", jump_m=(jump_m, 0.0, 0.0))

    @rule(what=st.sampled_from(["nan", "zero_quaternion", "stamp_back"]), for_s=st.floats(0.02, 0.5))
    def the_estimate_is_broken(self, what: str, for_s: float) -> None:
        self._happens("estimator_bad_numbers", for_s, what=what)

    @rule(for_s=st.floats(0.3, 5.0), command=st.sampled_from(["DO_SET_MODE", "COMPONENT_ARM_DISARM", "NAV_LAND"]))
    def commands_are_refused(self, for_s: float, command: str) -> None:
        self._happens("refuse", for_s, command=command)

    # What must hold

    @invariant()
    def setpoints_are_meant_and_fresh(self) -> None:
        if not hasattr(self, "heard"):
            return
        for before, heard in zip([None, *self.heard], self.heard, strict=False):
            # Nobody else has the vehicle, as far as can be known.
            assert heard.by_hand_s is None or heard.now_s - heard.by_hand_s <= KNOWS_S + SILENCE_S, self.lines
            # It answers a state that was fresh; the one without a fresh state comes at the limit on silence.
            assert heard.age_s <= AGE_S + SILENCE_S + 0.2 + 3 * PERIOD_S, (heard.age_s, self.lines)
            # After an own silence, none.
            if before is not None and before.mode is Mode.OFFBOARD:
                assert heard.now_s - before.now_s <= 0.5 * LOSS_S + SILENCE_S, self.lines

    @invariant()
    def no_way_back(self) -> None:
        if getattr(self, "other_s", None) is not None:
            assert all(at_s <= self.other_s for at_s in self.offboard_asked), self.lines

    @invariant()
    def setpoints_only_while_they_are_due(self) -> None:
        if not hasattr(self, "heard") or not self.loop._met:
            return
        coasts = [heard for heard in self.heard if heard.duty is Duty.NOTHING]
        assert len(coasts) <= 2, self.lines  # the last one of ours and the coast setpoint may arrive after the end

    def teardown(self) -> None:
        if not hasattr(self, "stage"):
            return
        try:
            self._turns(ENDS_WITHIN)
            if self.ended is None:  # paused, or resting somewhere: the operator ends it
                self.loop.order(Order.LAND)
                self._turns(ENDS_WITHIN)
            assert self.ended is not None, self.lines
            before = len(self.heard)
            detail = self.loop._leave(self.ended.detail)
            self.wire.close()
            self.stage._go_on_alone()
            assert len(self.heard) - before <= 1
            self.setpoints_are_meant_and_fresh()
            self.no_way_back()
            outcome = Outcome(self.ended.cause, detail, self.loop._sequence.changes, 0, {})
            impact = self.stage.vehicle.airframe.impact_speed_m_s
            verdict = judge(Flown(outcome, self.lines, self.stage.notices, self.stage.moments, impact))
            assert verdict.survived, (verdict, self.lines, self.stage.notices)
            assert verdict.how in {"flown", "holding", "landed", "grounded", "pilot"}
            assert self.ended.cause is not Cause.FAULT
        finally:
            self.wire.close()
            self.stage.peer.close()
            self.folder.cleanup()


@pytest.fixture(autouse=True)
def little_wall_time(monkeypatch) -> None:
    """A vehicle that says nothing is given up soon; its own time does not depend on that."""
    monkeypatch.setattr(last_resort, "TIMEOUT_NS", 200_000_000)
    monkeypatch.setattr(loop, "PACED_SILENCE_S", 30.0)


def run(examples: int, steps: int) -> None:
    run_state_machine_as_test(
        Flights,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=[
                HypothesisPhase.explicit,
                HypothesisPhase.reuse,
                HypothesisPhase.generate,
            ],  # a flight is too long to shrink
            print_blob=True,
        ),
    )


def test_a_few_flights() -> None:
    run(3, 6)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_many_flights() -> None:
    run(60, 25)
