"""Measures what the companion costs against what one would use instead, and writes docs/performance.md.

    python tools/bench.py [--only ROW ...] [--quick] [--rotorpy-python PATH] [--out FILE]

Every comparison takes turns with what it is compared with, in the same run; figures are medians and 99th percentiles.
The machine should be idle otherwise. RotorPy is no part of this project: install it in an environment of its own and
name that environment's Python. Without --only all rows are measured and the table is written; with it, it is printed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from benchmarks import arithmetic, fleet, flights, latency, startup
from benchmarks.common import ROOT, NotHereError, Row, Setting, load_words, machine_lines

MEASURES: dict[str, Callable[[Setting], list[Row]]] = {
    "startup": startup.rows,
    "control": arithmetic.control_rows,
    "physics": arithmetic.physics_rows,
    "latency": latency.rows,
    "lockstep": flights.lockstep_rows,
    "hogs": flights.hog_rows,
    "fleet": fleet.rows,
    "growth": arithmetic.growth_rows,
    "instructions": arithmetic.instruction_rows,
}
HEAD = """# Performance

Written by `python tools/bench.py`, which measures everything below in one run: what is compared takes turns, figures
are medians and, where two are given, 50th and 99th percentiles. A reach that was missed says so.
"""


def table(rows: list[Row]) -> str:
    lines = ["| what | compared with | reach | seen | |", "|---|---|---|---|---|"]
    lines += [f"| {r.what} | {r.against} | {r.reach} | {r.seen} | {r.verdict} |" for r in rows]
    notes = [note for row in rows for note in row.notes]
    return "\n".join([*lines, *(["", *(f"- {note}" for note in notes)] if notes else [])])


def page(rows: list[Row], before: str) -> str:
    machine = "\n".join(f"- {line}" for line in [*machine_lines(), before])
    return f"{HEAD}\n## The machine\n\n{machine}\n\n## The table\n\n{table(rows)}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[*MEASURES], metavar="ROW", help="%(choices)s")
    parser.add_argument("--quick", action="store_true", help="fewer rounds, to see that it works")
    parser.add_argument("--rotorpy-python", default=sys.executable, metavar="PATH", help="a Python that has RotorPy")
    parser.add_argument("--out", type=Path, help="write the page here; default docs/performance.md for a whole run")
    arguments = parser.parse_args()
    before = load_words()
    begin = time.monotonic()

    def say(text: str) -> None:
        print(f"[{time.monotonic() - begin:5.0f} s] {text}", file=sys.stderr, flush=True)

    out = arguments.out or (None if arguments.only or arguments.quick else ROOT / "docs" / "performance.md")
    if arguments.quick:
        before += "; a short run (--quick): fewer rounds, less certain"
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        setting = Setting(arguments.quick, arguments.rotorpy_python, Path(folder), say)
        for name in arguments.only or MEASURES:
            try:
                rows += MEASURES[name](setting)
            except NotHereError as error:
                say(f"{name}: not measured: {error}")
                rows.append(Row(name, "", "", f"not measured: {error}", ""))
            except subprocess.TimeoutExpired:
                rows.append(Row(name, "", "", "not measured: it took too long", ""))
            if out is not None:  # what is there survives an interruption
                out.write_text(page(rows, before), encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
