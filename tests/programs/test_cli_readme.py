"""The README's commands work: the quick ones are run, the others are parsed by the program that they name."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from companion.cli import main
from companion.config import find

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [line for block in re.findall(r"^```sh\n(.*?)^```", TEXT, re.M | re.S) for line in block.splitlines()]
QUICK = {"companion certify paper"}
"""Run as they stand; a flight takes too long for that, a real vehicle is not there."""
ANY_PORTS = ["--port", "0", "--remote-port", "0", "--no-ground", "--no-truth-stream"]


def commands_of(program: str) -> list[str]:
    found = [line for line in COMMANDS if Path(line.split()[0]).name == program]
    assert found, f"the README has no example of {program}"
    return found


def test_the_readme_begins_with_the_two_commands() -> None:
    assert COMMANDS[:2] == ["make demo", "make test"]
    assert TEXT.index("make demo") < TEXT.index("## What it is")


def test_no_command_is_of_an_unknown_kind() -> None:
    programs = {Path(line.split()[0]).name for line in COMMANDS}
    assert programs == {"make", "python3", "pip", "companion", "sim-link"}


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("line", commands_of("make"))
def test_make_knows_its_targets(line: str) -> None:
    done = subprocess.run([*line.split(), "-n"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("line", commands_of("companion"))
def test_companion_commands(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(line)[1:]
    # asked for help at its end, a command is parsed and not run
    assert main(arguments if line in QUICK else [*arguments, "--help"]) == 0
    for option, kind in (("--vehicle", "vehicles"), ("--flight", "flights")):
        if option in arguments:
            assert find(arguments[arguments.index(option) + 1], kind).is_file()
    if arguments[0] in {"fly", "simulate"}:
        assert find(arguments[1], "trajectories" if arguments[0] == "fly" else "flights").is_file()


def test_parsing_would_find_a_wrong_option() -> None:
    assert main(["demo", "--no-such-option", "--help"]) == 2


def test_quick_commands_are_in_the_readme() -> None:
    assert set(COMMANDS) >= QUICK


@pytest.mark.parametrize("line", commands_of("sim-link"))
def test_sim_link_commands(line: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sim_link", *shlex.split(line)[1:], *ANY_PORTS]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.terminate()
        assert process.wait(30.0) == 0
    assert "companion link 127.0.0.1:" in first


@pytest.mark.parametrize("line", [*commands_of("pip"), *re.findall(r"`(\S*pip install .*?)`", TEXT)])
def test_pip_commands_name_the_pins_and_extras_that_there_are(line: str) -> None:
    words = shlex.split(line)
    assert words[1] == "install"
    assert (ROOT / words[words.index("-c") + 1]).is_file()
    name, bracket, extras = words[-1].partition("[")
    assert name == "."
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    if bracket:
        assert extras.rstrip("]") in project["optional-dependencies"]


def test_every_path_that_the_readme_names_is_there() -> None:
    paths = re.findall(r"\]\(([\w./-]+)\)", TEXT) + re.findall(
        r"`((?:companion|sim_link|config|tests|tools)[\w./]*)`", TEXT
    )
    assert len(paths) > 8
    for path in paths:
        assert (ROOT / path).exists(), path


def test_the_map_has_every_folder_of_the_companion() -> None:
    for folder in (ROOT / "companion").iterdir():
        if (folder / "__init__.py").exists():
            assert f"`companion/{folder.name}`" in TEXT
