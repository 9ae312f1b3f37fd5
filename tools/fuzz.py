"""Fuzzes everything that reads bytes from somewhere else, with atheris (coverage-guided):

    python tools/fuzz.py                      every target, ten million inputs together
    python tools/fuzz.py --runs 1000000 wire  one target
    python tools/fuzz.py --blind              changed at random, without looking at coverage: much faster
    python tools/fuzz.py --list

A finding is written to tests/data/fuzz/TARGET/, where tests/unit/test_fuzz.py repeats it from then on. Findings are
faults, inputs that take longer than 20 s, and memory that grows. Exit code 1: there was one.
"""

from __future__ import annotations

import argparse
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from hashlib import sha256
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

SHARES = {
    **{"wire": 0.50, "messages": 0.10, "ftp": 0.06, "commands": 0.09, "parameters": 0.04, "channel": 0.12},
    **{"trajectory": 0.02, "own_trajectory": 0.002, "configuration": 0.005, "simulator_files": 0.03, "keys": 0.005},
    **{"ulog": 0.003, "tlog": 0.015, "vehicle": 0.01},
}
"""Of the inputs: what costs little and is reached by strangers gets most."""
TOGETHER = 10_000_000
HANG_S = 20
MEMORY_MB = 900
ASLEEP_FACTOR = 30
"""With --blind an input may take HANG_S of the processor, and so many times as long by the clock: whoever stops this
process for a while has found nothing."""
GROWTH_MB = 300
"""With --blind: beyond what the first input needed."""
TELL_S = 10.0
NAN_INF_LARGE = [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\xff\x7f"]
ODD = [b"\0", b"\xff", b"\xfd", b"\xfe", *NAN_INF_LARGE, b"=", b'"', b"nan", b"[["]
"""What breaks things: magic bytes, numbers that are none or infinite, signs with a meaning."""


def fuzz_one(name: str, options: list[str]) -> None:
    """Fuzzes one target in this process; atheris ends it."""
    import atheris

    with atheris.instrument_imports(include=["companion", "sim_link"]):
        import fuzz_targets
    target = fuzz_targets.TARGETS[name]()
    atheris.Setup([sys.argv[0], *options], target)
    atheris.Fuzz()


def mutated(chance: random.Random, seeds: list[bytes]) -> bytes:
    """A seed, or random bytes, with a few places changed; short ones are most frequent."""
    if chance.random() < 0.5:
        return chance.randbytes(int(chance.expovariate(1 / 24)))
    content = bytearray(chance.choice(seeds))
    for _ in range(chance.randrange(5)):
        at = chance.randrange(len(content) + 1)
        kind = chance.randrange(4)
        if kind == 0 and at < len(content):
            content[at] = chance.randrange(256)
        elif kind == 1:
            content[at:at] = chance.choice(ODD)
        elif kind == 2:
            del content[at : at + chance.randrange(1, 9)]
        else:
            content[at : at + 4] = chance.choice(ODD)
    return bytes(content)


def fuzz_blindly(name: str, runs: int, seconds: int, hang_s: int, seed: int) -> int:
    """Fuzzes one target in this process; gives 1 and keeps the input when something is found. Tells its progress."""
    import fuzz_targets

    target, seeds = fuzz_targets.TARGETS[name](), fuzz_targets.seeds(name) or [b""]
    chance = random.Random(seed)
    data = b""

    def keep(what: str) -> int:
        folder = fuzz_targets.DATA / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{what}-{sha256(data).hexdigest()[:16]}").write_bytes(data)
        return 1

    def hang(*_: object) -> None:
        raise TimeoutError(f"longer than {hang_s} s")

    signal.signal(signal.SIGPROF, hang)
    signal.signal(signal.SIGALRM, hang)
    memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun_s = told_s = time.monotonic()
    for number in range(runs):
        if number % 64 == 0:
            signal.setitimer(signal.ITIMER_PROF, hang_s)
            signal.alarm(ASLEEP_FACTOR * hang_s)
            now_s = time.monotonic()
            if now_s - told_s > TELL_S:
                told_s = now_s
                print(f"Done {number} runs", flush=True)
            if seconds and now_s - begun_s > seconds:
                print(f"Done {number} runs", flush=True)
                return 0
            if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > memory_kb + 1024 * GROWTH_MB:
                return keep("memory")
        data = mutated(chance, seeds)
        try:
            target(data)
        except Exception:
            traceback.print_exc()
            print(f"Done {number + 1} runs", flush=True)
            return keep("fault")
    print(f"Done {runs} runs", flush=True)
    return 0


def run_blindly(name: str, runs: int, seconds: int, hang_s: int, seed: int) -> tuple[int, str]:
    """The same in a process of its own; as `run`."""
    command = [sys.executable, __file__, "--one-blindly", *map(str, (name, runs, seconds, hang_s, seed))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    counted = re.findall(r"Done (\d+) runs", done.stdout)
    count = int(counted[-1]) if counted else 0
    return count, "" if done.returncode == 0 else done.stderr[-2000:] or f"ended with code {done.returncode}"


def run(name: str, runs: int, seconds: int, hang_s: int) -> tuple[int, str]:
    """Fuzzes one target in a process of its own; gives how many inputs there were, and what was found ("" nothing)."""
    from fuzz_targets import DATA, seeds

    findings = DATA / name
    before = set(findings.glob("*")) if findings.is_dir() else set()
    with tempfile.TemporaryDirectory(prefix="fuzz-corpus-") as folder:
        for number, seed in enumerate(seeds(name)):
            (Path(folder) / f"seed-{number}").write_bytes(seed)
        new = Path(folder) / "found"
        new.mkdir()
        command = [
            *(sys.executable, __file__, "--one", name, f"-runs={runs}", f"-max_total_time={seconds}"),
            *(f"-timeout={hang_s}", f"-rss_limit_mb={MEMORY_MB}", "-max_len=600", "-len_control=40"),
            *(f"-artifact_prefix={new}/", "-print_final_stats=1", folder),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said = done.stderr + done.stdout
        counted = re.findall(r"number_of_executed_units: (\d+)", said) or re.findall(r"Done (\d+) runs", said)
        count = int(counted[-1]) if counted else 0
        made = sorted(new.iterdir())
        for path in made:
            findings.mkdir(parents=True, exist_ok=True)
            (findings / path.name).write_bytes(path.read_bytes())
    found = sorted(set(findings.glob("*")) - before) if made else []
    if done.returncode == 0 and not found:
        return count, ""
    where = ", ".join(str(path) for path in found) or "no input was kept"
    lines = [line for line in said.splitlines() if line.strip() and not line.startswith(("#", "INFO", "stat::"))]
    return count, f"{where}\n    " + "\n    ".join(lines[-25:])


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="what to fuzz; default: everything")
    parser.add_argument("--runs", type=int, default=TOGETHER, help="inputs of all targets together")
    parser.add_argument("--seconds", type=int, default=0, help="for each target at most; 0: no limit")
    parser.add_argument("--hang", type=int, default=HANG_S, help="seconds that one input may take")
    parser.add_argument("--blind", action="store_true", help="change inputs at random, without atheris")
    parser.add_argument("--seed", type=int, default=1, help="of --blind")
    parser.add_argument("--list", action="store_true", help="say what there is")
    arguments = parser.parse_args()
    names = arguments.targets or list(SHARES)
    unknown = [name for name in names if name not in SHARES]
    if arguments.list or unknown:
        print("targets: " + ", ".join(SHARES))
        return 2 if unknown else 0
    whole = sum(SHARES[name] for name in names)
    total, failed = 0, 0
    begun_s = time.monotonic()
    for name in names:
        from_s = time.monotonic()
        runs = max(1, round(arguments.runs * SHARES[name] / whole))
        if arguments.blind:
            count, finding = run_blindly(name, runs, arguments.seconds, arguments.hang, arguments.seed)
        else:
            count, finding = run(name, runs, arguments.seconds, arguments.hang)
        total += count
        failed += bool(finding)
        print(
            f"{name:16s} {count:10d} inputs in {time.monotonic() - from_s:6.0f} s  {finding or 'nothing found'}",
            flush=True,
        )
    took_s = time.monotonic() - begun_s
    print(f"{'together':16s} {total:10d} inputs in {took_s:6.0f} s, {failed} targets with findings")
    return 1 if failed else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        fuzz_one(sys.argv[2], sys.argv[3:])
    if sys.argv[1:2] == ["--one-blindly"]:
        sys.exit(fuzz_blindly(sys.argv[2], *map(int, sys.argv[3:])))
    sys.exit(main())
