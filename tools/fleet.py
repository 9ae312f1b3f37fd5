"""Shows how many states per second a fleet of simulated vehicles keeps on one core, and what a state costs.

    python tools/fleet.py [--count 20] [--rate 100] [--seconds 5] [--engine python] [--flood N]

Starts `sim-link run --count N` bound to one core and flies every vehicle in OFFBOARD, with a position setpoint in
answer to every state. Counts the states that arrive in each second, and takes the processor time of the vehicles'
process from the system. --flood sends so many requests a second to the first vehicle besides. The rest of the machine
should be idle.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import common as mavlink

ODOMETRY = mavlink.MAVLINK_MSG_ID_ODOMETRY
POSITION_ONLY = 0b110111111000
CLOCK_TICKS = os.sysconf("SC_CLK_TCK")
SETTLE_S = 2.0
FRAME_BYTES = 12
"""Of a message without its payload."""


class Companion:
    """One vehicle's companion: asks for states, answers each with a setpoint, and counts them."""

    def __init__(self, ready: dict[str, Any], rate_hz: float, east_m: float) -> None:
        self.system = ready["system_id"]
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.connect(("127.0.0.1", ready["port"]))
        self.mav = mavlink.MAVLink(None, srcSystem=self.system, srcComponent=191)
        self.states = 0
        hold = mavlink.MAVLink_set_position_target_local_ned_message(
            0, self.system, 1, mavlink.MAV_FRAME_LOCAL_NED, POSITION_ONLY, 0, east_m, -10, 0, 0, 0, 0, 0, 0, 0, 0
        )
        self.setpoint = hold.pack(self.mav)
        self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3))
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, ODOMETRY, 1e6 / rate_hz)

    def send(self, message: Any) -> None:
        self.socket.send(message.pack(self.mav))

    def command(self, number: int, *params: float) -> None:
        values = (*params, *(0.0,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(self.system, 1, number, 0, *values))

    def hear(self) -> None:
        while True:
            try:
                datagram = self.socket.recv(2048)
            except BlockingIOError:
                return
            while datagram:  # several messages may share it
                if int.from_bytes(datagram[7:10], "little") == ODOMETRY:
                    self.states += 1
                    self.socket.send(self.setpoint)
                datagram = datagram[datagram[1] + FRAME_BYTES :]


def processor_s(pid: int) -> float:
    """Processor time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS


def hear_until(companions: list[Companion], poll: select.poll, end_s: float, flood: Flood | None) -> None:
    owners = {c.socket.fileno(): c for c in companions}
    while (left_s := end_s - time.monotonic()) > 0.0:
        if flood is not None:
            flood.go_on()
            left_s = min(left_s, 0.001)
        for descriptor, _ in poll.poll(1e3 * left_s):
            owners[descriptor].hear()


class Flood:
    """Requests that a vehicle has to answer, at a steady rate, from somebody who is not its companion."""

    def __init__(self, ready: dict[str, Any], per_s: float) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.address = ("127.0.0.1", ready["port"])
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        ask = (mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
        self.frame = mavlink.MAVLink_command_long_message(ready["system_id"], 1, *ask).pack(mav)
        self.per_s = per_s
        self.begin_s = time.monotonic()
        self.sent = 0

    def go_on(self) -> None:
        while self.sent < (time.monotonic() - self.begin_s) * self.per_s:
            self.socket.sendto(self.frame, self.address)
            self.sent += 1


def measure(engine: str, arguments: argparse.Namespace) -> None:
    cores = sorted(os.sched_getaffinity(0))
    spacing_m = 3.0
    command = [sys.executable, "-m", "sim_link", "run", "--count", str(arguments.count), "--engine", engine]
    command += ["--state-rate", str(arguments.rate), "--start", "0,0,-10", "--spacing", str(spacing_m)]
    command += ["--port", "0", "--remote-port", "0", "--no-truth-stream", "--json-ready", "--with-parent"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        os.sched_setaffinity(process.pid, {cores[0]})
        os.sched_setaffinity(0, set(cores[1:]) or set(cores))
        vehicles = ready.get("vehicles", [ready])
        companions = [Companion(vehicle, arguments.rate, k * spacing_m) for k, vehicle in enumerate(vehicles)]
        flood = Flood(vehicles[0], arguments.flood) if arguments.flood else None
        poll = select.poll()
        for companion in companions:
            poll.register(companion.socket.fileno(), select.POLLIN)
        hear_until(companions, poll, time.monotonic() + 0.5 * SETTLE_S, None)
        for companion in companions:
            companion.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
        hear_until(companions, poll, time.monotonic() + 0.5 * SETTLE_S, flood)
        report(engine, process.pid, companions, poll, flood, arguments)
    finally:
        process.terminate()
        process.wait(10.0)
        os.sched_setaffinity(0, set(cores))


def report(
    engine: str,
    pid: int,
    companions: list[Companion],
    poll: select.poll,
    flood: Flood | None,
    arguments: argparse.Namespace,
) -> None:
    slowest, middle, shares = [], [], []
    for _ in range(arguments.seconds):
        begin_s, used_s = time.monotonic(), processor_s(pid)
        before = [c.states for c in companions]
        hear_until(companions, poll, begin_s + 1.0, flood)
        passed_s = time.monotonic() - begin_s
        rates = [(c.states - b) / passed_s / arguments.rate for c, b in zip(companions, before, strict=True)]
        slowest.append(min(rates))
        middle.append(statistics.median(rates))
        shares.append((processor_s(pid) - used_s) / passed_s)
    share, kept = statistics.median(shares), statistics.median(middle)
    print(
        f"{engine}: {arguments.count} vehicles, {arguments.rate:g} Hz: "
        f"states achieved / asked {kept:.3f}, slowest vehicle {statistics.median(slowest):.3f}; "
        f"{100 * share:.0f} % of a core; a state costs {share / arguments.count / kept:.4f} of its period"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--rate", type=float, default=100.0, help="states per second")
    parser.add_argument("--seconds", type=int, default=5, help="that are counted; the figures are medians of them")
    parser.add_argument("--engine", action="append", choices=("python", "numba"), help="default: both")
    parser.add_argument("--flood", type=float, default=0.0, help="requests per second to the first vehicle")
    arguments = parser.parse_args()
    for engine in arguments.engine or ("python", "numba"):
        measure(engine, arguments)


if __name__ == "__main__":
    main()
