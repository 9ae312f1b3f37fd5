"""Compilation on request: choice of the engine, callees, constants, and a disk cache that follows the sources."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sim_link import accelerate
from sim_link.accelerate import available, choose, compile_kernel
from sim_link.rotation import cross, exponential

HELPER = """
FACTOR = {factor}

def scaled(x):
    return FACTOR * x{more}
"""
KERNEL = """
from typing import NamedTuple

class Pair(NamedTuple):
    a: float
    b: float

def kernel(x):
    parts = [scaled(k * x) for k in (1.0, 2.0)]
    return Pair(parts[0], parts[1])
"""


def test_engines() -> None:
    assert choose(cross, "python") is cross
    with pytest.raises(ValueError, match="engine 'gpu' is not one of auto, python, numba"):
        choose(cross, "gpu")


def test_without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_TEST_WITHOUT_NUMBA", "1")
    assert not available()
    assert choose(cross, "auto") is cross
    with pytest.raises(ImportError, match=r"pip install 'offboard-companion\[fast\]'"):
        choose(cross, "numba")


def test_importing_the_vehicle_does_not_import_numba() -> None:
    code = "import sys, sim_link.airframe, sim_link.position_loop; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def source(folder: Path, *, factor: float, more: str = "") -> Callable[..., Any]:
    """Return the kernel of two source files as a fresh process would import it."""
    names: dict[str, Any] = {"__name__": "sim_link.helper_of_a_test"}
    for name, text in (("helper.py", HELPER.format(factor=factor, more=more)), ("kernel.py", KERNEL)):
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
        exec(compile(text, str(path), "exec"), names)
    kernel: Callable[..., Any] = names["kernel"]
    return kernel


@pytest.mark.numba
def test_cache_survives_and_follows_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")

    def run(**text: Any) -> tuple[tuple[float, float], int]:
        monkeypatch.setattr(accelerate, "_compiled", {})
        twin: Any = compile_kernel(source(tmp_path, **text))
        result = twin(3.0)
        return (result.a, result.b), sum(twin.stats.cache_hits.values())

    assert run(factor=2.0) == ((6.0, 12.0), 0)
    assert run(factor=2.0) == ((6.0, 12.0), 1)
    # The kernel's own file stays the same; the callee's constant, then its code, do not.
    assert run(factor=5.0) == ((15.0, 30.0), 0)
    assert run(factor=5.0, more=" + 1.0") == ((16.0, 31.0), 0)
    assert run(factor=2.0) == ((6.0, 12.0), 1)
    assert (tmp_path / "cache" / "offboard-companion" / "numba").is_dir()
    assert numba.config.CACHE_DIR == ""


@pytest.mark.numba
def test_compiles_without_a_place_to_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(accelerate, "_compiled", {})
    assert compile_kernel(cross)((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) == (0.0, 0.0, 1.0)


@pytest.mark.numba
def test_twins_are_made_once_and_agree() -> None:
    assert compile_kernel(exponential) is compile_kernel(exponential)
    for a in ((0.3, -1.0, 2.0), (1e-6, 0.0, 0.0)):
        assert compile_kernel(exponential)(a) == pytest.approx(exponential(a), rel=1e-15)


@pytest.mark.numba
def test_what_cannot_be_a_kernel_is_refused() -> None:
    factor = 2.0

    def closure(x: float) -> float:
        return factor * x

    with pytest.raises(TypeError, match="is a closure"):
        compile_kernel(closure)
    with pytest.raises(TypeError, match="not a plain Python function"):
        compile_kernel(len)
    names: dict[str, Any] = {"__name__": "sim_link.helper_of_a_test"}
    exec("def again(x):\n    return again(x - 1.0) if x > 0.0 else x\n", names)
    with pytest.raises(TypeError, match="again calls itself"):
        compile_kernel(names["again"])
