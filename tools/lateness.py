"""Measures by how much serving, uploading and status traffic delay the control step.

    python tools/lateness.py [--rounds 3] [--seconds 12] [--idle] [--engine auto]

Flies the same circle on the bundled vehicle in real time, in turns: by `companion fly`, with nobody to serve, and by
`companion serve` while a tool uploads files of 1 MB one after another, lists them, reads all parameters and asks for
the status ten times per second. --idle flies it by `companion serve` without any traffic too. Lateness is the time from
a state's arrival to its setpoint's departure (`step_us` of the record), and the age of the state at that moment. The
tool runs at the lowest priority: it belongs on another machine. Nothing else should run on this one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import CompanionError
from companion.flight.bundled import free_udp_port
from companion.ground.client import Client
from companion.ground.exchange import OWN_COMPONENT, OWN_SYSTEM
from companion.ground.upload import Files
from companion.link.wire import Wire
from companion.record.columns import TRACK_PHASE
from companion.record.flight_record import FlightRecord

CIRCLE = """shape = "circle"
anchor = "here"
duration_s = {seconds}
[circle]
radius_m = 2.0
angular_rate_rad_s = 1.0
"""
PATIENCE_S = 60.0
REACH = 1.20
PARAM_REQUEST_LIST = 21


@contextlib.contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    """A Python process that has printed its first line; ended afterwards."""
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        if not process.stdout.readline():
            raise SystemExit(f"{' '.join(command)} did not start")
        yield process
    finally:
        process.terminate()
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def vehicle(port: int, engine: str) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    """The bundled vehicle in the air, in real time, speaking to this port."""
    return running(
        *("-m", "sim_link", "run", "--vehicle", "bundled", "--start", "0,0,-10", "--engine", engine, "--port", "0"),
        *("--remote-port", str(port), "--no-ground", "--no-truth-stream", "--json-ready", "--with-parent"),
    )


def by_fly(folder: Path, circle: Path, engine: str) -> FlightRecord:
    """A flight with nobody to serve."""
    port = free_udp_port()
    with vehicle(port, engine):
        command = [sys.executable, "-m", "companion", "fly", str(circle), "--vehicle", "bundled", "--engine", engine]
        command += ["--connect", f"udpin:127.0.0.1:{port}", "--out", str(folder), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if not (folder / "record.npz").exists():
        raise SystemExit(f"companion fly ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return FlightRecord.load(folder)


def by_serve(folder: Path, circle: Path, engine: str, *, busy: bool) -> FlightRecord:
    """The same by `companion serve`, with or without traffic."""
    port, ground = free_udp_port(), free_udp_port()
    stored, flights = folder / "stored", folder / "flights"
    stored.mkdir(parents=True)
    (stored / "circle.toml").write_text(circle.read_text())
    with (
        vehicle(port, engine),
        running(
            *("-m", "companion", "serve", "--vehicle", "bundled", "--connect", f"udpin:127.0.0.1:{port}"),
            *("--ground", f"udpin:127.0.0.1:{ground}", "--folder", str(stored), "--flights", str(flights)),
            *("--engine", engine, "--json", "--no-reports"),
        ),
        Client(f"udpout:127.0.0.1:{ground}", PATIENCE_S) as client,
    ):
        wait_until(lambda: client.status(5.0).vehicle and all(t.accepted for t in client.trajectories()))
        with contextlib.ExitStack() as stack:
            if busy:
                stack.enter_context(running(__file__, "--traffic", str(ground)))
            client.start("circle")
            wait_until(lambda: client.status(5.0).phase == "idle")
            wait_until(lambda: any(flights.glob("*/summary.json")))
    return FlightRecord.load(next(flights.iterdir()))


def wait_until(condition: Any) -> None:
    """Looks twice per second."""
    end_s = time.monotonic() + 2.0 * PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            raise SystemExit("gave up waiting for the companion")
        time.sleep(0.5)


def samples(size: int) -> str:
    """A sampled file of this many bytes: a circle, at 100 Hz."""
    text, i = "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z\n", 0
    lines = []
    while size > len(text):
        lines.append(text)
        size -= len(text)
        t, i = 0.01 * i, i + 1
        p, v = (2 * math.cos(t), 2 * math.sin(t), 10.0), (-2 * math.sin(t), 2 * math.cos(t), 0.0)
        text = ",".join(repr(x) for x in (t, *p, 1.0, 0.0, 0.0, 0.0, *v)) + "\n"
    return "".join(lines)


def traffic(port: int) -> None:
    """What a busy ground tool does, until it is ended."""
    os.nice(19)
    content = samples(1_000_000).encode()
    print("ready", flush=True)
    if os.fork() == 0:
        with Client(f"udpout:127.0.0.1:{port}", PATIENCE_S) as client:
            while os.getppid() > 1:
                with contextlib.suppress(CompanionError):
                    client.status(1.0)
                time.sleep(0.1)
        os._exit(0)
    with Wire.open(f"udpout:127.0.0.1:{port}", system_id=OWN_SYSTEM, component_id=OWN_COMPONENT) as wire:
        files, number = Files(wire), 0
        while True:
            wire.send(PARAM_REQUEST_LIST, bytes((1, 191)))
            with contextlib.suppress(CompanionError):
                files.upload_bytes(content, f"long-{number % 2}.csv", progress=lambda there, whole: None)
                number += 1


def p99(records: Sequence[FlightRecord], column: str) -> float:
    """Over the track, of all of them together."""
    return float(np.nanpercentile(np.concatenate([r.column(column)[r.in_phase(TRACK_PHASE)] for r in records]), 99.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--idle", action="store_true", help="serve without traffic too")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--traffic", type=int, metavar="PORT", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.traffic is not None:
        traffic(arguments.traffic)
        return
    flown: dict[str, list[FlightRecord]] = {"fly": [], **({"serve": []} if arguments.idle else {}), "busy": []}
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        circle = base / "circle.toml"
        circle.write_text(CIRCLE.format(seconds=arguments.seconds))
        for number in range(arguments.rounds):
            for kind, records in flown.items():
                folder = base / f"{kind}-{number}"
                if kind == "fly":
                    records.append(by_fly(folder, circle, arguments.engine))
                else:
                    records.append(by_serve(folder, circle, arguments.engine, busy=kind == "busy"))
                print(f"round {number + 1}: {kind}", file=sys.stderr)
    document: dict[str, Any] = {}
    for column in ("step_us", "state_age_ms"):
        each = {kind: [p99([record], column) for record in records] for kind, records in flown.items()}
        document[column] = {kind: {"p99": p99(flown[kind], column), "each": each[kind]} for kind in flown}
        ratios = [b / a for a, b in zip(each["fly"], each["busy"], strict=True)]
        document[column]["ratio"] = {"median": statistics.median(ratios), "each": ratios}
    if arguments.json:
        print(json.dumps(document, indent=2))
        return
    for column, unit in (("step_us", "us"), ("state_age_ms", "ms")):
        for kind in flown:
            found = document[column][kind]
            each_p99 = ", ".join(f"{x:.1f}" for x in found["each"])
            print(f"{column} p99, {kind}: {found['p99']:.1f} {unit} (each {each_p99})")
        ratio = document[column]["ratio"]
        each_ratio = ", ".join(f"{x:.2f}" for x in ratio["each"])
        print(f"{column} p99, busy over fly: {ratio['median']:.2f} (each {each_ratio}), reach < {REACH:.2f}")


if __name__ == "__main__":
    main()
