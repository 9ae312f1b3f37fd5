"""Several simulated vehicles in one process: each with its own system, ports, seed and time."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from vehicle_tools import Companion, free_socket, vehicle_file

from sim_link import peer
from sim_link.cli import _peer_options
from sim_link.codec import frames
from sim_link.fleet import Fleet, siblings
from sim_link.peer import PeerOptions
from sim_link.truth_log import COLUMNS, TruthLog
from sim_link.vehicle import Vehicle, VehicleOptions

IN_AIR = ((1.0, 2.0, -20.0), 0.5)


def options(**changes) -> VehicleOptions:
    return VehicleOptions(vehicle=vehicle_file(), engine="python", **{"start": IN_AIR, **changes})


class InThread:
    """A fleet in a thread of its own, on free ports, with a socket for each vehicle's companion."""

    def __init__(self, all_options: list[VehicleOptions], truth: list[Path] | None = None, **time) -> None:
        self.sockets = [free_socket() for _ in all_options]
        pairs = [
            (Vehicle(o), PeerOptions(port=0, remote_port=s.getsockname()[1], **time))
            for o, s in zip(all_options, self.sockets, strict=True)
        ]
        self._stopping = False
        self.notices: list[str] = []
        self.fleet = Fleet(pairs, stopped=lambda: self._stopping, notice=self.notices.append)
        for member, path in zip(self.fleet.members, truth or [], strict=False):
            member.log_truth(TruthLog(path))
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        try:
            self.fleet.run()
        except BaseException as error:
            self._failure = error

    def __enter__(self) -> InThread:
        self._thread.start()
        return self

    def companion(self, k: int) -> Companion:
        """Let a companion speak to its vehicle, and answer its first state."""
        member = self.fleet.members[k]
        companion = Companion(self.sockets[k], member.companion.port, system=member.vehicle.system)
        companion.target = member.vehicle.system
        companion.step()
        return companion

    def __exit__(self, *exc) -> None:
        self._stopping = True
        self._thread.join(5.0)
        self.fleet.close()
        for sock in self.sockets:
            sock.close()
        assert not self._thread.is_alive()
        if self._failure is not None and exc[0] is None:
            raise self._failure


def waiting(sock: socket.socket) -> list:
    """All messages that wait in a socket."""
    sock.setblocking(False)
    found = []
    while True:
        try:
            found += frames(sock.recv(2048))
        except BlockingIOError:
            return found


def test_siblings_differ_in_number_seed_and_place() -> None:
    first, second, third = siblings(options(instance=4, seed=7), 3, 2.5)
    assert [o.instance for o in (first, second, third)] == [4, 5, 6]
    assert [o.seed for o in (first, second, third)] == [7, 8, 9]
    assert first == options(instance=4, seed=7)
    assert third.start == ((1.0, 7.0, -20.0), 0.5)
    on_ground = siblings(options(start=None), 2)[1]
    vehicle = Vehicle(on_ground)
    assert vehicle.airframe.rigid.p == (0.0, 3.0, 0.0)
    assert vehicle.airframe.on_ground
    assert vehicle.autopilot.guidance.home == (0.0, 3.0, 0.0)
    for count in (0, 247):
        with pytest.raises(ValueError, match="allowed are 0 to 249"):
            siblings(options(instance=4), count)


def test_every_vehicle_runs_for_its_time_and_speaks_with_its_own_id() -> None:
    sockets = [free_socket() for _ in range(3)]
    pairs = [
        (Vehicle(o), PeerOptions(port=0, remote_port=s.getsockname()[1], speed=50.0))
        for o, s in zip(siblings(options(instance=1), 3), sockets, strict=True)
    ]
    fleet = Fleet(pairs)
    fleet.run(1.5)
    for k, sock in enumerate(sockets):
        assert fleet.members[k].vehicle.t_us == fleet.members[k].vehicle.start_us + 1_500_000
        heard = waiting(sock)
        assert {frame.system for frame in heard} == {k + 2}
        # 30 Hz of 50, as asked for by nobody: PX4's own rate.
        assert [frame.msg_id for frame in heard].count(331) == pytest.approx(45, abs=2)
        sock.close()
    fleet.run(2.0)
    assert {member.vehicle.t_us - member.vehicle.start_us for member in fleet.members} == {2_000_000}
    fleet.close()


def test_in_lockstep_each_follows_its_own_companion() -> None:
    with InThread(siblings(options(), 3), lockstep=True) as flight:
        first, third = flight.companion(0), flight.companion(2)
        first.run(0.5)
        third.run(0.2)
        first.run(0.5)
        times = [member.vehicle.t_us - member.vehicle.start_us for member in flight.fleet.members]
        assert times[1] == 0, "nobody has spoken to the second one"
        assert 900_000 <= times[0] <= 1_100_000
        assert times[2] <= 250_000
        first.until(lambda: "HEARTBEAT" in first.last, 2.0)
        assert first.last["HEARTBEAT"].get_srcSystem() == 1
        assert first.arm() == 0
        second = flight.companion(1)
        second.run(0.1)
        assert second.t_us < first.t_us


def test_a_silent_companion_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_link.fleet.PATIENCE_S", 0.1)
    monkeypatch.setattr(peer, "PATIENCE_S", 0.1)
    with InThread(siblings(options(), 2), lockstep=True) as flight:
        first, second = flight.companion(0), flight.companion(1)
        first.run(0.1)
        second.run(0.1)
        silent = flight.fleet.members[1]
        while silent.synchronous:
            first.step()
        at_us = silent.vehicle.t_us
        while silent.vehicle.t_us < at_us + 60_000:
            first.step()
        second.step()
        second.until(lambda: silent.synchronous, 5.0)
        second.run(0.1)
        sentences = [sentence for sentence in flight.notices if sentence.startswith("system 2: ")]
        assert len(sentences) >= 2
        assert "no answer" in sentences[0]
        assert "back in lockstep" in sentences[1]


def test_a_vehicle_of_a_fleet_flies_as_it_would_alone(tmp_path: Path) -> None:
    rows = []
    for name, all_options in (("two", siblings(options(), 2)), ("one", siblings(options(), 2)[1:])):
        paths = [tmp_path / f"{name}-{k}.csv" for k in range(len(all_options))]
        with InThread(all_options, paths, lockstep=True) as flight:
            companions = [flight.companion(k) for k in range(len(all_options))]
            for companion in companions:
                assert companion.interval("CURRENT_MODE", 1) == 0
                companion.enter_offboard(rates=(0.0, 0.1, 0.0), thrust=0.5, target=(companion.target, 1))
                companion.run(0.5)
        rows.append(paths[-1].read_text(encoding="utf-8").splitlines())
    count = min(map(len, rows))
    assert count > 20
    assert rows[0][:count] == rows[1][:count]


def test_ports_are_consecutive() -> None:
    def ports(first: int, k: int, port: int | None = None, remote: int | None = None) -> tuple[int | None, ...]:
        given = {"companion": (port, remote), "ground": (None, 14550), "truth_port": None, "truth_stream": True}
        found = _peer_options(first, k, lockstep=False, speed=1.0, **given)
        return found.port, found.remote_port, found.ground_port, found.ground_remote_port, found.truth_port

    assert ports(8, 1) == (14589, 14549, 18579, 14550, 19419)
    assert ports(8, 2) == (24590, 24550, 18580, 14550, 19420)
    assert ports(0, 2, 5000, 6000) == (5002, 6002, 18572, 14550, 19412)
    assert ports(0, 2, 0, 0) == (0, 0, 0, 14550, 19412)


def sim_link(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sim_link", "run", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_the_command_starts_them_all_and_says_where(tmp_path: Path) -> None:
    words = (
        "--count",
        "3",
        "--spacing",
        "5",
        "--instance",
        "2",
        "--port",
        "0",
        "--remote-port",
        "0",
        "--engine",
        "python",
    )
    more = ("--start", "0,0,-9", "--no-truth-stream", "--state-rate", "50", "--speed", "20", "--duration", "0.4")
    done = sim_link(*words, *more, "--json-ready", "--truth", str(tmp_path / "truth.csv"))
    assert done.returncode == 0, done.stderr
    ready = json.loads(done.stdout)
    assert ready["ready"] is True
    assert [vehicle["system_id"] for vehicle in ready["vehicles"]] == [3, 4, 5]
    ports = [vehicle[key] for vehicle in ready["vehicles"] for key in ("port", "ground_port")]
    assert len(set(ports)) == 6
    assert {vehicle["state_rate_hz"] for vehicle in ready["vehicles"]} == {50.0}
    for k in range(3):
        lines = (tmp_path / f"truth-{k + 3}.csv").read_text(encoding="utf-8").splitlines()
        assert len(lines) == 22, "a head, the start, and a row for each of 20 states"
        assert float(lines[1].split(",")[COLUMNS.index("p_e")]) == 5.0 * k


def test_more_than_there_are_ids_is_refused() -> None:
    done = sim_link("--instance", "248", "--count", "3")
    assert done.returncode == 2
    assert done.stderr.strip() == "sim-link: --count 3: from --instance 248 on there are 2"


def test_a_full_disk_does_not_end_the_vehicle(capfd):
    """Said once; the rest of the truth is not written."""
    log = TruthLog(Path("/dev/full"))
    for number in range(1200):
        log.add(str(number))
    log.close()
    log.close()
    said = "sim-link: full: No space left on device; nothing more is written, the flight goes on\n"
    assert capfd.readouterr().err == said
