"""What the rows share: figures over samples, the machine in words, processes that end, compiled C."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

TOOLS = Path(__file__).resolve().parents[1]
ROOT = TOOLS.parent


class NotHereError(Exception):
    """Something that a row needs is not installed; the message says what, and how to get it."""


@dataclass
class Row:
    """A line of the table."""

    what: str
    against: str
    reach: str
    seen: str
    verdict: str
    """"reached", "MISSED", or "" where nothing is asked for, or nothing could be measured."""
    notes: list[str] = field(default_factory=list)
    """Sentences below the table."""


@dataclass
class Setting:
    """How to measure."""

    quick: bool
    rotorpy_python: str
    folder: Path
    """For whatever is made on the way."""
    say: Callable[[str], None]


def verdict(reached: bool) -> str:
    return "reached" if reached else "MISSED"


def percentile(values: Sequence[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def p50_p99(values: Sequence[float]) -> tuple[float, float]:
    return percentile(values, 0.5), percentile(values, 0.99)


def times_us(call: Callable[[int], object], count: int, begin: int = 0) -> list[float]:
    """How long each of so many calls takes [us]."""
    clock, times = time.perf_counter_ns, []
    for i in range(begin, begin + count):
        before = clock()
        call(i)
        times.append((clock() - before) * 1e-3)
    return times


@contextlib.contextmanager
def running(command: Sequence[str], **options: object) -> Iterator[subprocess.Popen[str]]:
    """A process that is asked to end, and then made to."""
    process = subprocess.Popen(command, text=True, cwd=ROOT, **options)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        ended(process)


def ended(process: subprocess.Popen[str], patience_s: float = 20.0) -> str:
    """Ends a process; returns what it printed last."""
    if process.poll() is None:
        process.terminate()
    try:
        out, _ = process.communicate(timeout=patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
    except ValueError:  # its output was read already
        return ""
    return out or ""


def compiled(source: Path, folder: Path) -> Path:
    """A C program of ours, compiled.

    Raises:
        NotHereError: there is no C compiler.
    """
    compiler = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
    if compiler is None:
        raise NotHereError("needs a C compiler (cc)")
    program = folder / source.stem
    if not program.exists():
        subprocess.run([compiler, "-O2", "-o", str(program), str(source)], check=True)
    return program


def module_environment() -> dict[str, str]:
    """The environment in which `python -m benchmarks.X` finds its module."""
    return {**os.environ, "PYTHONPATH": str(TOOLS)}


def machine_lines() -> list[str]:
    """The machine in words, without anything that names it."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    cores = len(os.sched_getaffinity(0))
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = [f"Python {platform.python_version()}"]
    for name in ("numpy", "numba", "pymavlink", "mavsdk"):
        with contextlib.suppress(Exception):
            from importlib.metadata import version

            versions.append(f"{name} {version(name)}")
    hypervisor = "hypervisor" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    kind = ", virtual" if hypervisor else ""
    release = platform.release().split("-")[0]
    return [
        f"{model}, {cores} cores{kind}, {memory_gb:.0f} GB, Linux {release}",
        ", ".join(versions),
    ]


def load_words() -> str:
    """How busy the machine is, and with what priority this runs."""
    load = os.getloadavg()[0]
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    words = f"load average {load:.1f}"
    return words if nice == 0 else f"{words}, measured at priority {nice}"


def median(values: Sequence[float]) -> float:
    return statistics.median(values)


PYTHON = sys.executable
