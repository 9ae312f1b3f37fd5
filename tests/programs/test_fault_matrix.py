"""The fault matrix, shortened: one flight of every family of faults, and the judge.

Families that other tests fly too are left to `make test-long` here; `make matrix` flies all.
"""

from __future__ import annotations

import pytest
from matrix_cases import CASES, PHASES, Job, pairs, singles
from matrix_flight import FENCE_RADIUS_M, Moment, flight_of, fly
from matrix_judge import judge, judged

from sim_link.fault_kinds import KINDS
from sim_link.modes import Mode

SHORT = {
    "loss 20 %": ("track", "flown"),
    "silence 0.5 s": ("join", "holding"),
    "delay 300 ms of setpoints": ("join", "holding"),
    "rotor at 70 %": ("track", "holding"),
    "reset 5 m": ("track", "holding"),
    "freeze 1 s": ("track", "holding"),
    "pilot: Position": ("hold", "pilot"),
    "GCS sends setpoints": ("join", "holding"),
    "socket closed": ("track", "holding"),
    "arming refused": ("takeoff", "grounded"),
}


FLOWN_ELSEWHERE = {"silence 0.5 s", "reset 5 m", "pilot: Position", "arming refused"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] if name in FLOWN_ELSEWHERE else []) for name in SHORT]
)
def test_a_single_fault_is_survived(name: str) -> None:
    phase, how = SHORT[name]
    if name == "arming refused":
        phase = "connect"
    job = Job((name,), phase, 1)
    flown = fly(flight_of(job.vehicle), job.happenings(), seed=1, engine="python")
    verdict = judge(flown)
    assert verdict.survived, verdict
    assert verdict.how == how
    assert flown.injected == [phase]


def test_a_reboot_in_the_air_is_lost_and_said_so() -> None:
    job = Job(("reboot",), "track", 1)
    verdict = judge(fly(flight_of(), job.happenings(), seed=1, engine="python"))
    assert not verdict.survived
    assert verdict.impact_m_s > 2.0
    assert verdict.cause == "REBOOTED"


def test_the_whole_matrix_covers_every_kind_and_phase() -> None:
    jobs = list(singles())
    assert {CASES[job.faults[0]].kind for job in jobs} >= set(KINDS)
    assert {(job.faults[0], job.phase, job.seed) for job in jobs} == {
        (name, phase.value, seed) for name in CASES for phase in PHASES for seed in (1, 2, 3)
    }
    kinds = {case.kind for case in CASES.values()}
    exclusive = 3  # of estimator_outage, estimator_freeze and estimator_bad_numbers only one can be
    assert len(list(pairs())) == 3 * (len(kinds) * (len(kinds) - 1) // 2 - exclusive)
    assert len({job.name for job in [*jobs, *pairs()]}) == len(jobs) + len(list(pairs()))


def path(*places: tuple[float, float, float, float], mode: Mode = Mode.HOLD, armed: bool = True) -> list[Moment]:
    """Moments at (time, north, up, northward speed)."""
    return [Moment(t, (n, 0.0, -up), (v, 0.0, 0.0), (n, 0.0, -up), mode, armed, up == 0.0) for t, n, up, v in places]


STILL = [(t, 1.0, 4.0, 0.0) for t in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]
AWAY = [(float(t), 1.0 + t, 4.0, 1.0) for t in range(7)]
OVER = [(0.0, 0.0, 0.0, 0.0), (1.0, FENCE_RADIUS_M + 0.1, 4.0, 1.0), (2.0, FENCE_RADIUS_M + 1.1, 4.0, 0.0)]
FAR = [*OVER, (3.0, FENCE_RADIUS_M + 1.4, 4.0, 0.0), (9.0, FENCE_RADIUS_M + 1.4, 4.0, 0.0)]
DOWN = [(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 2.0, 0.0), (2.0, 0.0, 0.0, 0.0)]


@pytest.mark.parametrize(
    ("places", "options", "impact", "how", "problem"),
    [
        (STILL, {}, 0.0, "holding", ""),
        (STILL, {"mode": Mode.POSITION}, 0.0, "pilot", ""),
        (AWAY, {}, 0.0, "lost", "ends at 1.0 m/s"),
        (DOWN, {"armed": False}, 1.9, "landed", ""),
        (DOWN, {"armed": False}, 2.1, "landed", "hit the ground"),
        (DOWN[:1], {"armed": False}, 0.0, "grounded", ""),
        (FAR, {}, 0.0, "holding", "beyond its fence"),
        ([*OVER, (9.0, FENCE_RADIUS_M + 1.1, 4.0, 0.0)], {}, 0.0, "holding", ""),
    ],
)
def test_the_judge(places, options, impact: float, how: str, problem: str) -> None:
    verdict = judged(path(*places, **options), impact, "STATE_LOST", "why", named=True)
    assert verdict.how == how
    assert verdict.survived is (problem == "")
    assert problem in " ".join(verdict.problems)


def test_a_cause_that_is_not_named_is_a_loss() -> None:
    assert not judged(path(*STILL), 0.0, "FAULT", "a fault of the program", named=False).survived
