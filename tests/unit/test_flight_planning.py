"""The course is planned beside the loop, and a plan for another place is not flown."""

from __future__ import annotations

import threading

import pytest
from test_flight_sequence import Script

from companion.errors import RefusedError
from companion.flight import sequence as module
from companion.flight.planning import Planning
from companion.flight.sequence import Duty


class Held:
    """Lets no plan be finished before `go`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go = threading.Event()
        self.plans: list[Planning] = []

        def planning(plan, *, aside: bool) -> Planning:
            def wait():
                assert self.go.wait(10.0)
                return plan()

            self.plans.append(Planning(wait, aside=aside))
            return self.plans[-1]

        monkeypatch.setattr(module, "Planning", planning)

    def finish(self) -> None:
        self.go.set()
        for plan in self.plans:
            assert plan._thread is not None
            plan._thread.join(10.0)


def test_the_loop_goes_on_while_the_course_is_planned(monkeypatch) -> None:
    held, script = Held(monkeypatch), Script()
    script.sequence._waits = lambda: False
    script.run(4.0)
    assert len(held.plans) == 1
    assert script.sequence.duty is Duty.NOTHING
    held.finish()
    script.run(0.1)
    assert script.sequence.duty is Duty.STREAM


def test_a_vehicle_that_has_moved_meanwhile_gets_another_plan(monkeypatch) -> None:
    held, script = Held(monkeypatch), Script()
    script.sequence._waits = lambda: False
    script.run(4.0)
    monkeypatch.setattr(module, "DRIFT_MAX_M", -1.0)
    held.finish()
    script.run(0.1)
    assert len(held.plans) > 1
    assert script.sequence.duty is Duty.NOTHING


def test_what_the_plan_raises_comes_out() -> None:
    def refuse():
        raise RefusedError("no way")

    planning = Planning(refuse, aside=True)
    assert planning._thread is not None
    planning._thread.join(10.0)
    with pytest.raises(RefusedError, match="no way"):
        planning.course()
