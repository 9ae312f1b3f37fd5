"""However the ground process ends: the times of its keys are closed in order."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import ExitCode
from companion.ground.settings import Settings
from companion.link.key_file import new_key


def ended(tmp_path: Path, settings: Settings) -> tuple[int, str]:
    """Runs the process until it ends on its own; gives its exit code and what it said to the supervisor."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs, channel, far:
        ours.settimeout(30.0)
        process = subprocess.run(
            [
                sys.executable,
                "-m",
                "companion.ground.process",
                settings.as_json(),
                str(far.fileno()),
                str(theirs.fileno()),
            ],
            pass_fds=(far.fileno(), theirs.fileno()),
            env={**os.environ, "STATE_DIRECTORY": str(tmp_path / "state")},
            timeout=60.0,
            check=False,
        )
        return process.returncode, ours.recv(4096).decode()


@pytest.mark.parametrize("wrong", ["port", "key"])
def test_a_ground_link_that_cannot_be_opened(tmp_path: Path, wrong: str) -> None:
    key = new_key(tmp_path / "key")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        free = "udpout:127.0.0.1:9"
        second = f"udpin:127.0.0.1:{taken.getsockname()[1]}" if wrong == "port" else free
        keys = (str(tmp_path / "key"), None if wrong == "port" else str(tmp_path / "none"))
        folders = {"trajectories": str(tmp_path / "trajectories"), "flights": str(tmp_path / "flights")}
        settings = Settings("udpin:127.0.0.1:1", (free, second), engine="python", ground_keys=keys, **folders)
        code, said = ended(tmp_path, settings)
    assert code != ExitCode.DONE
    assert "error" in said
    (kept,) = (tmp_path / "state" / "signing" / key.fingerprint).glob("*.json")
    assert json.loads(kept.read_text())["ended"] is True
