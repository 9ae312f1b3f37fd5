"""Flies the fault matrix: every fault in every phase, pairs of faults, and faults of processes and machine.

    python tools/fault_matrix.py singles --out matrix/          # every fault, every phase, three seeds
    python tools/fault_matrix.py pairs --out matrix/            # every pair of kinds, once per seed
    python tools/fault_matrix.py real --out matrix/             # processes and machine, at real time, once per phase
    python tools/fault_matrix.py singles --only "reset 5 m" --out matrix/
    python tools/fault_matrix.py singles --short --out short/   # a sample
    python tools/fault_matrix.py table --out matrix/            # the tables of docs/reliability.md

Results are appended to OUT/NAME.jsonl, one line per flight; flights that are there already are not flown again. The
exit code is 1 when a vehicle was lost that could have been saved.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from matrix_cases import PHASES, Job, pairs, singles
from matrix_flight import flight_of, fly
from matrix_judge import judge
from matrix_real import REAL_CASES, fly_real, possible

from companion.flight.phases import Phase

HOPELESS = "reboot"
"""An autopilot that restarts in the air stops its rotors: nobody beside it can hold the vehicle up."""
_flights: dict[str, Any] = {}


def real_jobs(seeds: tuple[int, ...]) -> Iterator[Job]:
    """Faults of processes and machine, once per phase; those that cannot be made here are left out, and said."""
    del seeds
    for name, case in REAL_CASES.items():
        why = possible(case)
        if why:
            print(f"left out: {name}: {why}", file=sys.stderr)
            continue
        for phase in PHASES:
            yield Job((name,), phase.value, 0)


MADE: dict[str, Callable[[tuple[int, ...]], Iterator[Job]]] = {
    "singles": singles,
    "pairs": pairs,
    "real": real_jobs,
}


def run(job: Job) -> dict[str, Any]:
    """Flies one flight; a failure of the tool itself is a result too."""
    begin_s = time.monotonic()
    told: dict[str, Any]
    try:
        if job.faults[0] in REAL_CASES:
            verdict, lines = fly_real(job.faults[0], Phase(job.phase))
            told = verdict.told() | ({} if verdict.survived else {"log": lines})
        else:
            flight = _flights.setdefault(job.vehicle, flight_of(job.vehicle))
            flown = fly(flight, job.happenings(), seed=job.seed)
            told = judge(flown).told() | {"began_in": flown.injected}
    except Exception as error:
        told = {"survived": False, "how": "the tool failed", "problems": [f"{type(error).__name__}: {error}"]}
    return {"name": job.name, **job._asdict(), **told, "wall_s": round(time.monotonic() - begin_s, 2)}


def done_before(path: Path) -> dict[str, dict[str, Any]]:
    """Results that are in a file already, by their names."""
    if not path.exists():
        return {}
    return {row["name"]: row for row in map(json.loads, path.read_text().splitlines())}


def fly_all(jobs: list[Job], path: Path, workers: int, at_most: int | None) -> list[dict[str, Any]]:
    """Flies what is missing, with progress; gives all results that there are, in the order of the jobs."""
    known = done_before(path)
    missing = [job for job in jobs if job.name not in known]
    random.Random(0).shuffle(missing)  # what there is of a run that is not complete yet is a fair sample
    missing = missing[:at_most]
    path.parent.mkdir(parents=True, exist_ok=True)
    begin_s, lost = time.monotonic(), 0
    with path.open("a") as out, multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=500) as pool:
        for i, row in enumerate(pool.imap_unordered(run, missing, chunksize=1), 1):
            known[row["name"]] = row
            out.write(json.dumps(row) + "\n")
            out.flush()
            lost += not row["survived"]
            if not row["survived"]:
                print(f"\nLOST {row['name']}: {row['problems']} [{row.get('sentence')}]", file=sys.stderr)
            left_s = (time.monotonic() - begin_s) / i * (len(missing) - i)
            if i % 10 == 0 or i == len(missing):
                print(f"\r{i}/{len(missing)} flown, {lost} lost, {left_s / 60:.1f} min left ", end="", file=sys.stderr)
    print(file=sys.stderr)
    return [known[job.name] for job in jobs if job.name in known]


def table(folder: Path) -> str:
    """The tables of docs/reliability.md, from the results of a folder."""
    parts = []
    for what in MADE:
        rows = list(done_before(folder / f"{what}.jsonl").values())
        if not rows:
            continue
        kinds: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            kinds.setdefault(" + ".join(row["faults"]) if what != "pairs" else row["phase"], []).append(row)
        survived = sum(row["survived"] for row in rows)
        parts += [f"{what}: {survived} of {len(rows)} survived", ""]
        parts += [
            f"| {'fault' if what != 'pairs' else 'phase'} | tried | survived | how | named |",
            "|---|---|---|---|---|",
        ]
        for name, flights in kinds.items():
            how = _counted(row["how"] for row in flights)
            causes = _counted(row.get("cause", "?") for row in flights if row.get("cause") != "COMPLETED")
            parts.append(f"| {name} | {len(flights)} | {sum(r['survived'] for r in flights)} | {how} | {causes} |")
        parts.append("")
        parts += [f"- lost: {r['name']}: {'; '.join(r['problems'])}" for r in rows if not r["survived"]]
    return "\n".join(parts)


def _counted(words: Iterable[str]) -> str:
    return ", ".join(f"{n} {word}" for word, n in Counter(words).most_common())


def hopeless(row: dict[str, Any]) -> bool:
    """Whether a lost flight was beyond saving: the autopilot restarted in the air."""
    return HOPELESS in row["faults"] and not row["survived"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="singles", choices=[*MADE, "table"])
    parser.add_argument("--only", help="flights whose name holds this")
    parser.add_argument("--short", action="store_true", help="every 25th flight")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--out", type=Path, default=Path("matrix"))
    parser.add_argument("--at-most", type=int, metavar="N", help="fly so many now, the rest another time")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    if arguments.what == "table":
        print(table(arguments.out))
        return 0
    jobs = [
        job
        for job in MADE[arguments.what](tuple(arguments.seeds))
        if arguments.only is None or arguments.only in job.name
    ]
    jobs = jobs[::25] if arguments.short else jobs
    rows = fly_all(jobs, arguments.out / f"{arguments.what}.jsonl", arguments.workers, arguments.at_most)
    lost = [row for row in rows if not row["survived"]]
    beyond = sum(map(hopeless, lost))
    print(
        f"{len(rows)} of {len(jobs)} flights, {len(rows) - len(lost)} survived, {beyond} could not be saved by anybody"
    )
    return int(len(lost) > beyond)


if __name__ == "__main__":
    sys.exit(main())
