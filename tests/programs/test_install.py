"""The built wheel, installed elsewhere, works from an empty folder, and leaves nothing anywhere else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(
    command: list[str], folder: Path, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False
    )


@dataclass(frozen=True)
class Installed:
    """A new environment that holds the wheel and sees the packages that it needs, but not this checkout."""

    python: Path
    home: Path
    temporary: Path

    def run(self, folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
        """Runs a script of the environment as somebody with an empty home folder and without numba."""
        program = self.python.with_name(command[0])
        environment = {
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "PATH": os.environ["PATH"],
            "LANG": "C.UTF-8",
            "COMPANION_TEST_WITHOUT_NUMBA": "1",
        }
        return run([str(program), *command[1:]], folder, environment)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    base = tmp_path_factory.mktemp("installed here")
    wheels, home, temporary = base / "wheels", base / "home", base / "temporary"
    home.mkdir()
    temporary.mkdir()
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(wheels)]
    done = run(build, ROOT)
    assert done.returncode == 0, done.stderr
    (wheel,) = wheels.glob("*.whl")
    venv.create(base / "environment", with_pip=False)
    python = base / "environment" / "bin" / "python"
    # pip is that of this environment: nothing is downloaded
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index", "--no-deps"]
    own = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    done = run([*install, str(wheel)], base, own)
    assert done.returncode == 0, done.stderr
    (site,) = (base / "environment").glob("lib/python*/site-packages")
    # a path file adds folders but does not follow the path files in them, so this checkout stays out of sight
    dependencies = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    (site / "dependencies.pth").write_text("\n".join(dependencies) + "\n", encoding="utf-8")
    return Installed(python, home, temporary)


def contents(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_the_installed_packages_are_the_wheels(installed: Installed, tmp_path: Path) -> None:
    code = "import companion, sim_link; print(companion.__file__); print(sim_link.__file__)"
    done = installed.run(tmp_path, "python", "-c", code)
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        assert Path(line).is_relative_to(installed.python.parents[1])


@pytest.mark.parametrize("program", ["companion", "sim-link"])
def test_the_scripts_say_their_version(installed: Installed, tmp_path: Path, program: str) -> None:
    done = installed.run(tmp_path, program, "--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{program} 0.")


def test_bundled_configuration_came_along(installed: Installed, tmp_path: Path) -> None:
    code = (
        "from companion.config import bundled_root, load_flight, load_vehicle\n"
        "from companion.trajectory.load import load\n"
        "import json\n"
        "load_path = lambda name: load(name, vehicle=load_vehicle('bundled'))\n"
        "kinds = {'vehicles': load_vehicle, 'flights': load_flight, 'trajectories': load_path}\n"
        "found = {k: sorted(p.stem for p in (bundled_root() / k).glob('*.toml')) for k in kinds}\n"
        "[kinds[k](name) for k in kinds for name in found[k]]\n"
        "print(json.dumps(found))"
    )
    done = installed.run(tmp_path, "python", "-c", code)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for kind, names in found.items():
        assert names == sorted(p.stem for p in (ROOT / "config" / kind).glob("*.toml"))
    assert {"paper", "bundled", "px4_sih"} <= set(found["vehicles"])
    assert contents(tmp_path) == []


def test_the_simulated_vehicle_runs(installed: Installed, tmp_path: Path) -> None:
    quiet = ("--port", "0", "--remote-port", "0", "--no-ground", "--no-truth-stream")
    command = ("run", "--vehicle", "bundled", "--json-ready", "--duration", "0.2", "--speed", "20", *quiet)
    done = installed.run(tmp_path, "sim-link", *command)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["ready"] is True
    assert contents(tmp_path) == []


@pytest.mark.timeout(300)
def test_the_demo_flies_from_an_empty_folder(installed: Installed, tmp_path: Path) -> None:
    done = installed.run(tmp_path, "companion", "demo", "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["verdict"] == "passed"
    assert summary["position_rms_m"] <= 0.01
    for estimate, truth in zip(summary["disturbance_m_s2"], (1.0, 0.0, 0.4905), strict=True):
        assert estimate == pytest.approx(truth, abs=0.03 * 1.114)
    (folder,) = (tmp_path / "flights").iterdir()
    assert {"summary.json", "report.html", "flight.toml"} <= set(contents(folder))
    assert [p.name for p in tmp_path.iterdir()] == ["flights"]
    assert contents(installed.home) == []
    assert contents(installed.temporary) == []
