"""The import rules of the project, read from the source of every module, and what an import brings with it."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PHYSICS_FOR_CAMPAIGN = {
    "sim_link.airframe",
    "sim_link.estimator",
    "sim_link.inner_loops",
    "sim_link.physics",
    "sim_link.vehicle_file",
    "sim_link.wind",
}
"""What companion.campaign may take from the simulated vehicle: its body, not its autopilot and not its link."""
HEAVY = {"fastcrc", "lxml", "mavsdk", "numba", "numpy", "plotly", "pydantic", "pymavlink", "rich", "scipy", "tomlkit"}
"""Nothing of this is needed to say what commands there are."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def files(package: str) -> list[Path]:
    found = sorted((ROOT / package).rglob("*.py"))
    assert len(found) > 10, f"{package} was not found"
    return found


def imports(source: str, package: str) -> Iterator[tuple[int, str]]:
    """Line and full name of every import anywhere in a source; `from a import b` counts as a.b.

    Args:
        source: the text of the module.
        package: the package that the module is in, for relative imports.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in {"import_module", "__import__"} and isinstance(node.args[0].value, str):
                yield node.lineno, node.args[0].value


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def breaches(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """What a module imports against the rules, one sentence each."""
    package = module if is_package else module.rpartition(".")[0]
    found = []
    for line, name in imports(source, package):
        if within(module, "sim_link") and within(name, "companion"):
            found.append(f"{module}:{line} imports {name}: sim_link never imports companion")
        if within(module, "companion") and within(name, "sim_link"):
            allowed = any(within(name, physics) for physics in PHYSICS_FOR_CAMPAIGN)
            if not (within(module, "companion.campaign") and allowed):
                found.append(f"{module}:{line} imports {name}: only companion.campaign may, and only the physics")
        if within(module, "companion.control") and within(name, "companion") and not within(name, "companion.control"):
            found.append(f"{module}:{line} imports {name}: companion.control imports nothing else of ours")
        if within(name, "tests") or within(name, "tools"):
            found.append(f"{module}:{line} imports {name}: neither tests nor tools are installed")
    return found


@pytest.mark.parametrize("package", ["companion", "sim_link"])
def test_no_module_breaks_the_import_rules(package: str) -> None:
    found = []
    for path in files(package):
        source = path.read_text(encoding="utf-8")
        found += breaches(source, module_name(path), is_package=path.name == "__init__.py")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("sim_link.wind", "import companion"),
        ("sim_link.wind", "from companion.control.law import step"),
        ("sim_link.wind", "def f():\n    import companion.config as c"),
        ("companion.flight.loop", "from sim_link.physics import advance"),
        ("companion.flight.loop", "from sim_link import physics"),
        ("companion.campaign.simulate", "from sim_link.peer import Peer"),
        ("companion.campaign.simulate", "from sim_link import autopilot"),
        ("companion.campaign.simulate", "import sim_link"),
        ("companion.cli.demo", "import importlib\nimportlib.import_module('sim_link.vehicle')"),
        ("companion.control.law", "from companion.frames import degrees"),
        ("companion.control.law", "from ..frames import degrees"),
        ("companion.control.law", "from .. import frames"),
    ],
)
def test_a_breach_would_be_found(module: str, source: str) -> None:
    assert len(breaches(source, module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("sim_link.wind", "from .physics import advance\nimport math"),
        ("companion.campaign.simulate", "from sim_link import inner_loops\nfrom sim_link.airframe import Airframe"),
        ("companion.control.law", "from .types import State\nfrom companion.control.vectors import norm"),
        ("companion.flight.loop", "from companion.control.law import step\nimport simulation_link"),
    ],
)
def test_what_the_rules_allow_is_no_breach(module: str, source: str) -> None:
    assert breaches(source, module) == []


def modules_after(code: str) -> set[str]:
    """The top-level modules that are loaded in a new interpreter after some code."""
    script = f"import sys\n{code}\nprint('loaded:', *sorted(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("loaded:")[2].split())


@pytest.mark.parametrize(
    "code",
    [
        "import companion, companion.cli",
        "import companion.cli\nassert companion.cli.main(['--help']) == 0",
        "import companion.cli\nassert companion.cli.main(['--version']) == 0",
    ],
)
def test_the_command_line_comes_up_without_the_heavy_parts(code: str) -> None:
    loaded = modules_after(code)
    assert "companion" in loaded
    assert not loaded & HEAVY
    assert "sim_link" not in loaded


def test_the_control_process_carries_no_more_than_it_flies_with() -> None:
    loaded = modules_after("import companion.flight.process")
    assert not loaded & {"lxml", "mavsdk", "numba", "plotly", "rich", "typer", "asyncio", "sim_link"}
