"""State datagram in, setpoint datagram out, at 250 Hz: the companion in flight against a C echo, mavutil and MAVSDK.

All of them stand at the same bundled vehicle in real time, behind the same relay, which stops the time
(`tools/echo.c`). They take turns.
"""

from __future__ import annotations

import json
import select
import signal
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from companion.flight.bundled import free_udp_port
from companion.link import codec
from companion.link.framing import build_frame

from .common import (
    PYTHON,
    TOOLS,
    NotHereError,
    Row,
    Setting,
    compiled,
    ended,
    median,
    module_environment,
    p50_p99,
    running,
    verdict,
)

LEAD_S = 1.0
"""At the beginning of what is measured, left out: processes that have just started."""
COMPANION, ECHO, MAVUTIL, MAVSDK = "companion in flight", "C echo", "mavutil recv_match", "MAVSDK callback"
PATIENCE_S = 60.0
SET_MESSAGE_INTERVAL = 511
TRAJECTORY = """shape = "circle"
anchor = "here"
duration_s = 60.0

[circle]
radius_m = 5.0
angular_rate_rad_s = 0.5
phase_deg = 0.0
"""


class Turn(NamedTuple):
    """What one of them did while it was measured."""

    latencies_us: list[float]
    unanswered: int
    said: str
    """What it printed at its end."""


def subject(kind: str, port: int, program: Path, folder: Path, options: tuple[str, ...]) -> list[str]:
    """The command line of one that answers states at a port."""
    if kind == ECHO:
        return [str(program), "echo", str(port)]
    if kind in {MAVUTIL, MAVSDK}:
        return [PYTHON, "-m", "benchmarks.peers", "mavutil" if kind == MAVUTIL else "mavsdk", str(port)]
    path = folder / "circling.toml"
    path.write_text(TRAJECTORY, encoding="utf-8")
    command = [PYTHON, "-m", "companion", "fly", str(path), "--vehicle", "bundled", "--json", *options]
    return [*command, "--connect", f"udpin:127.0.0.1:{port}", "--out", str(folder / f"flight-{time.monotonic_ns()}")]


def states_wanted() -> str:
    """The request for ODOMETRY at 250 Hz, as the relay takes it: a frame in hexadecimal digits."""
    payload = codec.encode_command_long(
        1, 1, SET_MESSAGE_INTERVAL, 0, (codec.ODOMETRY, 4000.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    )
    extra = codec.message_formats()[codec.COMMAND_LONG].crc_extra
    return build_frame(codec.COMMAND_LONG, payload, 0, 1, 191, extra).hex()


def turn(kind: str, seconds: float, setting: Setting, options: tuple[str, ...] = ()) -> Turn:
    """One turn of one of them."""
    program = compiled(TOOLS / "echo.c", setting.folder)
    here, port = free_udp_port(), free_udp_port()
    command = [PYTHON, "-m", "sim_link", "run", "--vehicle", "bundled", "--start", "0,0,-20", "--port", "0"]
    command += ["--remote-port", str(here), "--no-ground", "--no-truth-stream", "--json-ready", "--with-parent"]
    with running(command, stdout=subprocess.PIPE) as vehicle:
        assert vehicle.stdout is not None
        ready = json.loads(vehicle.stdout.readline())
        between = [str(program), "relay", str(here), str(ready["port"]), str(port), states_wanted()]
        with running(between, stdout=subprocess.PIPE) as relay:
            answering_command = subject(kind, port, program, setting.folder, options)
            quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "env": module_environment()}
            with running(answering_command, **quiet) as answering:
                if not _answered(relay):
                    raise NotHereError(f"{kind}: answered no state: {ended(answering).strip()[-300:]}")
                time.sleep(seconds + LEAD_S)
                if kind == COMPANION:
                    answering.send_signal(signal.SIGINT)  # hands over, writes its summary
                    said = answering.communicate(timeout=60.0)[0]
                else:
                    said = ended(answering)
            return counted(ended(relay), seconds, said)


def _answered(relay: subprocess.Popen[str]) -> bool:
    """Waits until a state was answered; a flight begins with its gates."""
    assert relay.stdout is not None
    return bool(select.select([relay.stdout], [], [], PATIENCE_S)[0]) and relay.stdout.readline() == "answered\n"


def counted(lines: str, seconds: float, said: str) -> Turn:
    """What a relay printed: of the last so many seconds in which states were answered."""
    states = [(int(a), int(b)) for a, b in (line.split() for line in lines.splitlines() if " " in line)]
    answered = [at for at, took in states if took >= 0]
    last = answered[-1] - 50_000_000  # it was ended then
    first = last - int(seconds * 1e9)
    of = [took for at, took in states if first <= at <= last]
    return Turn([took * 1e-3 for took in of if took >= 0], sum(took < 0 for took in of), said)


def rows(setting: Setting) -> list[Row]:
    """The echo rows."""
    seconds, rounds = (4.0, 1) if setting.quick else (12.0, 4)
    found: dict[str, list[tuple[float, float]]] = {}
    lost: dict[str, int] = {}
    for i in range(rounds):
        for kind in (ECHO, COMPANION, MAVUTIL, MAVSDK):
            setting.say(f"latency, round {i + 1} of {rounds}: {kind}")
            done = turn(kind, seconds, setting)
            found.setdefault(kind, []).append(p50_p99(done.latencies_us))
            lost[kind] = lost.get(kind, 0) + done.unanswered
    return _table(found, lost)


def _table(found: dict[str, list[tuple[float, float]]], lost: dict[str, int]) -> list[Row]:
    figures = {kind: (median([a for a, _ in of]), median([b for _, b in of])) for kind, of in found.items()}
    # Of a round, because what the machine does changes from one to the next.
    factors = [(a / c, b / d) for (a, b), (c, d) in zip(found[COMPANION], found[ECHO], strict=True)]
    p50, p99 = median([a for a, _ in factors]), median([b for _, b in factors])

    def words(kind: str) -> str:
        return f"{figures[kind][0]:.0f} / {figures[kind][1]:.0f} us"

    what = "state datagram in -> setpoint out, 250 Hz, p50 / p99"
    table = [
        Row(
            what,
            f"a C program doing the same echo, {words(ECHO)}",
            "<= 2.2 and <= 4 times",
            f"{words(COMPANION)}: {p50:.2f} and {p99:.2f} times",
            verdict(p50 <= 2.2 and p99 <= 4.0),
        )
    ]
    for kind in (MAVUTIL, MAVSDK):
        ours, theirs = figures[COMPANION], figures[kind]
        faster = ours[0] < theirs[0] and ours[1] < theirs[1]
        seen = f"{theirs[0] / ours[0]:.2f} and {theirs[1] / ours[1]:.2f} times faster"
        table.append(Row("the same", f"{kind}, {words(kind)}", "faster at p50 and p99", seen, verdict(faster)))
    table[0].notes.append(
        "Latency: the companion is a whole flight (law, guards, recorder, traffic log), the others send constants;"
        " figures are medians of rounds, factors medians of each round's factor. States without an answer: "
        + ", ".join(f"{kind} {count}" for kind, count in lost.items())
        + "."
    )
    return table
