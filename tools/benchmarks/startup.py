"""How long `import companion` and `companion --help` take, over the bare interpreter, in turn."""

from __future__ import annotations

import subprocess
import time

from .common import PYTHON, Row, Setting, median, verdict

BARE = [PYTHON, "-c", "pass"]
OURS = {
    "import companion": [PYTHON, "-c", "import companion"],
    "companion --help": [PYTHON, "-m", "companion", "--help"],
}
HEAVY = ("numba", "scipy", "plotly", "mavsdk")


def took_s(command: list[str]) -> float:
    begin = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - begin


def rows(setting: Setting) -> list[Row]:
    """The import rows; what is imported is a test's affair (test_imports.py)."""
    rounds = 3 if setting.quick else 15
    over: dict[str, list[float]] = {what: [] for what in OURS}
    took_s(BARE)
    for i in range(rounds):
        setting.say(f"imports, round {i + 1} of {rounds}")
        for what, command in OURS.items():
            bare = took_s(BARE)
            over[what].append(took_s(command) - bare)
    return [
        Row(
            what,
            "bare interpreter",
            f"no {', '.join(HEAVY)}; +0.25 s at most",
            f"+{median(times):.3f} s (longest of {rounds}: +{max(times):.3f} s)",
            verdict(median(times) <= 0.25),
        )
        for what, times in over.items()
    ]
