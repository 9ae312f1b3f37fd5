"""`companion serve` goes on when nobody reads any more what it says, or nobody does for a while."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from serve_cases import Serving, until

from companion.flight.bundled import free_udp_port


@contextlib.contextmanager
def speaking_into_a_pipe(folder: Path) -> Iterator[tuple[Serving, int, int]]:
    """A companion that is ready, and both ends of the pipe that is its stdout; the caller closes them."""
    serve = Serving(folder, free_udp_port(), ("hover",))
    reader, writer = os.pipe()
    command = [word for word in serve.command if word != "--json"]
    with (folder / "serve.log").open("w") as log:
        serve.process = subprocess.Popen(command, stdout=writer, stderr=log, start_new_session=True)
    try:
        said = b""
        while b"ready: " not in said:
            said += os.read(reader, 4096)
        yield serve, reader, writer
    finally:
        for end in (serve.process.terminate, serve.process.kill):
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                serve.process.wait(20.0)


def another_ground_process(serve: Serving) -> None:
    """Kills the one that there is and waits for the next one."""
    killed, control = serve.ground_pid, serve.control_pid
    serve.kill(killed)
    until(lambda: serve.ground_pid not in {None, killed} or serve.process.poll() is not None)
    assert serve.process.poll() is None, serve.log
    assert serve.control_pid == control


def test_the_reader_goes_away(tmp_path: Path) -> None:
    with speaking_into_a_pipe(tmp_path) as (serve, reader, writer):
        os.close(writer)
        os.close(reader)
        another_ground_process(serve)
        another_ground_process(serve)
        serve.process.send_signal(signal.SIGTERM)
        assert serve.process.wait(20.0) == 0
        assert serve.log == ""


def test_the_reader_stands_still(tmp_path: Path) -> None:
    with speaking_into_a_pipe(tmp_path) as (serve, reader, writer):
        # Opened anew, so that only this end does not wait.
        filling = os.open(f"/proc/self/fd/{writer}", os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filling, b"x" * 4096)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filling, b"x")
        another_ground_process(serve)
        another_ground_process(serve)
        serve.process.send_signal(signal.SIGINT)
        assert serve.process.wait(20.0) == 130
        for descriptor in (filling, writer, reader):
            os.close(descriptor)
