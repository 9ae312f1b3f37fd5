"""--faults on the command line of the companion: what is refused, in one line and before anything begins."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli import main
from companion.errors import ExitCode
from sim_link.cli import app

BAD = '[[fault]]\nkind = "loss"\nshare = 0.1\n[[fault]]\nkind = "loss"\nshare = 2\n'


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["demo", "--faults", "bad.toml"], "bad.toml: fault[1].share = 2: must be a number from 0 to 1"),
        (
            ["demo", "--faults", "nothing"],
            "no fault file 'nothing': neither a path nor one of the bundled ones (bad_es",
        ),
        (
            ["fly", "circle", "--vehicle", "bundled", "--faults", "windy_link"],
            "only for the bundled vehicle; add --sim",
        ),
        (
            ["fly", "circle", "--vehicle", "bundled", "--sim", "--connect", "udpin:127.0.0.1:14540"],
            "--sim starts the bundled vehicle, --connect udpin:127.0.0.1:14540 names another: leave one out",
        ),
        (
            ["fly", "circle", "--vehicle", "bundled", "--sim", "--faults", "bad.toml"],
            "bad.toml: fault[1].share = 2",
        ),
    ],
)
def test_faults_are_refused_before_anything_begins(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text(BAD)
    assert main(arguments) == ExitCode.BAD_INPUT
    printed = capsys.readouterr()
    assert printed.out.strip() == ""
    (line,) = printed.err.strip().splitlines()
    assert words in line
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


def test_a_fault_file_can_be_checked_alone(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["fault", "check", "weak_rotor"])
    assert done.exit_code == 0
    assert "from 10 s for good: rotor rotor = 2, share = 0.8" in done.stdout
    old = tmp_path / "old.toml"
    old.write_text('[[fault]]\nkind = "parameter"\nname = "COM_RC_OVERRIDE"\nvalue = 0\n')
    assert CliRunner().invoke(app, ["fault", "check", str(old)]).exit_code == 0, "of 1.13"
    old.write_text(old.read_text().replace("COM_RC", "COM_NO"))
    for arguments in (["check", str(old)], ["check"], ["check", "nothing"]):
        assert CliRunner().invoke(app, ["fault", *arguments]).exit_code == 2
