"""What `companion serve` and its client say when something is not as it should be."""

from __future__ import annotations

import os
import signal
import socket
import time
from pathlib import Path

import pytest
from serve_cases import serving, until

from companion import Client
from companion.cli import main
from companion.errors import LinkError
from companion.flight.bundled import free_udp_port
from companion.ground.folder_lock import FolderLock


def test_nobody_answers() -> None:
    port = free_udp_port()
    with pytest.raises(
        LinkError, match=rf"no companion answers at udpout:127.0.0.1:{port} within 0.2 s: is `companion"
    ):
        Client(f"udpout:127.0.0.1:{port}", 0.2)
    assert main(["pause", "--to", f"udpout:127.0.0.1:{port}", "--timeout", "0.1"]) == 4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--vehicle", "nonesuch"], "no vehicle file 'nonesuch'"),
        (["--vehicle", "paper", "--connect", "tcp:1"], 'connection "tcp:1"'),
        (["--vehicle", "paper", "--ground", "udpin:127.0.0.1:0"], "port 0 is not within"),
        (["--vehicle", "paper", "--flights", "/proc/nothing"], "--flights /proc/nothing: cannot be made"),
    ],
)
def test_wrong_options(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["serve", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("link", ["--connect", "--ground"])
def test_a_port_in_use_ends_it_at_once(
    link: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Starting a process again that could never begin would help nobody."""
    monkeypatch.chdir(tmp_path)
    other = "--ground" if link == "--connect" else "--connect"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        held = f"udpin:127.0.0.1:{holder.getsockname()[1]}"
        free = f"udpin:127.0.0.1:{free_udp_port()}"
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        try:
            assert main(["serve", "--vehicle", "paper", "--engine", "python", link, held, other, free]) == 4
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    assert "is in use (process " in capfd.readouterr().err


def refused_to_serve() -> None:
    """`companion serve` in this process and folder, which must end as bad input; its signal handlers go with it."""
    free = [f"udpin:127.0.0.1:{free_udp_port()}" for _ in range(2)]
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        arguments = ["--engine", "python", "--connect", free[0], "--ground", free[1]]
        assert main(["serve", "--vehicle", "paper", *arguments]) == 2
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def test_a_folder_in_use_ends_it_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "trajectories"
    folder.mkdir()
    lock = FolderLock(folder)
    try:
        refused_to_serve()
    finally:
        lock.release()
    assert f"--folder {folder}: another `companion serve` uses it; give each its own" in capfd.readouterr().err


def test_a_parameters_file_that_cannot_be_used_ends_it_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "trajectories" / ".parameters-paper.toml"
    file.parent.mkdir()
    file.write_text("controller = 3\n")
    refused_to_serve()
    error = capfd.readouterr().err
    assert str(file) in error
    assert error.count("\n") == 1


def test_the_supervisor_killed(tmp_path: Path) -> None:
    """The flight goes on and hears its operator; at its end nothing is left."""
    with serving(tmp_path, ("hover",)) as (serve, stand):
        with serve.client() as client:
            client.start("hover")
            client.wait_for("track")
            pids = (serve.control_pid, serve.ground_pid)
            os.kill(serve.process.pid, signal.SIGKILL)
            serve.process.wait()
            time.sleep(1.0)  # several ticks of the ground process, which looks after its supervisor in each
            assert client.status(5.0).phase == "track"
            client.stop()
        until(lambda: all(not Path(f"/proc/{pid}").exists() for pid in pids))
        assert "the operator ends the flight (stop)" in [p["reason"] for p in serve.summaries()[-1]["phases"]]
        assert not stand.vehicle.autopilot.in_failsafe
