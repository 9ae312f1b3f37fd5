"""The systemd unit starts a command that there is, as an ordinary user, and knows where things are."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest

from companion.cli import main
from companion.ground.exposure import check_ground

UNIT = Path(__file__).parents[2] / "config" / "companion.service"
TEXT = UNIT.read_text(encoding="utf-8").replace("\\\n", " ")
ENTRIES = dict(line.split("=", 1) for line in TEXT.splitlines() if "=" in line and not line.startswith("#"))


def test_the_command_is_one_of_ours() -> None:
    words = shlex.split(ENTRIES["ExecStart"])
    assert Path(words[0]).name == "companion"
    assert words[1] == "serve"
    assert main([*words[1:], "--help"]) == 0  # parsed, not run
    for option in ("--folder", "--flights"):
        assert words[words.index(option) + 1].startswith("/var/lib/" + ENTRIES["StateDirectory"])


def test_an_ordinary_user_in_a_sandbox() -> None:
    assert ENTRIES["User"] not in {"root", "0"}
    assert ENTRIES["CapabilityBoundingSet"] == ""
    for key in ("NoNewPrivileges", "PrivateTmp", "ProtectHome", "ProtectKernelModules", "RestrictNamespaces"):
        assert ENTRIES[key] == "yes"
    assert ENTRIES["ProtectSystem"] == "strict"
    assert {"AF_UNIX", "AF_INET"} == set(ENTRIES["RestrictAddressFamilies"].split())
    assert (ENTRIES["UMask"], ENTRIES["StateDirectoryMode"]) == ("0077", "0700")


def test_links_are_signed_or_stay_on_this_machine() -> None:
    words = shlex.split(ENTRIES["ExecStart"])
    assert words[words.index("--key") + 1].startswith("/var/lib/" + ENTRIES["StateDirectory"])
    links = [word for before, word in pairwise(words) if before == "--ground"]
    check_ground(tuple(links), (None,) * len(links), allow_unsigned=False)
    assert (ENTRIES["IPAddressDeny"], ENTRIES["IPAddressAllow"]) == ("any", "localhost")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_finds_little_that_it_may_do() -> None:
    """The exposure that systemd computes, in tenths: 0 is nothing, 100 everything."""
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=19", "--no-pager", str(UNIT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30.0, check=False)
    if "unrecognized option" in done.stderr or "Unknown" in done.stderr:
        pytest.skip("this systemd cannot judge a file")
    assert done.returncode == 0, done.stdout[-300:]


def test_only_the_supervisor_is_told_to_stop() -> None:
    assert ENTRIES["KillMode"] == "mixed"
    assert int(ENTRIES["TimeoutStopSec"]) >= 60
    assert int(ENTRIES["SuccessExitStatus"]) == 130


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_understands_it(tmp_path: Path) -> None:
    copy = tmp_path / UNIT.name
    copy.write_text(re.sub(r"/opt/companion/bin/companion", "/bin/true", UNIT.read_text(encoding="utf-8")))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(copy)], capture_output=True, text=True, timeout=30.0, check=False
    )
    mine = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert mine == [], done.stderr
