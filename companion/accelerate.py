"""Compiles kernels with numba on request, from the source that also runs as plain Python.

A kernel is a plain function over floats and tuples. `compile_kernel` walks the globals that its code names, compiles
every function of this project that it finds there first, and hands a copy of the function with those globals replaced
to numba. So the modules themselves stay plain Python, both engines can run side by side, and numba is imported only
when somebody asks for it.

numba's disk cache looks at the time stamp of a function's own file only, not at the files of the functions that it
calls. So the cache folder's name carries a hash of all kernel sources: a change anywhere starts a new folder.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.errors import InputError

PACKAGES = ("companion", "sim_link")
ENGINES = ("auto", "python", "numba")

_compiled: dict[Any, Any] = {}


def available() -> bool:
    """Whether numba can be imported; the environment variable COMPANION_TEST_WITHOUT_NUMBA=1 says no."""
    return os.environ.get("COMPANION_TEST_WITHOUT_NUMBA") != "1" and importlib.util.find_spec("numba") is not None


def resolve(engine: str) -> str:
    """The engine that "auto" stands for here; "python" and "numba" stand for themselves.

    Raises:
        InputError: the name is unknown, or numba is asked for and not installed.
    """
    if engine not in ENGINES:
        raise InputError(f"engine {engine!r}: must be one of {', '.join(ENGINES)}")
    if engine == "auto":
        return "numba" if available() else "python"
    if engine == "numba" and not available():
        raise InputError(
            "engine 'numba' is not installed here: pip install 'offboard-companion[fast]', or use 'python'"
        )
    return engine


def choose(function: Callable[..., Any], engine: str) -> Callable[..., Any]:
    """The function itself, or its compiled twin."""
    return compile_kernel(function) if resolve(engine) == "numba" else function


def _use_own_cache(numba: Any) -> None:
    digest = hashlib.sha256()
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(root).rglob("*.py")):
                digest.update(path.name.encode() + path.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    numba.config.CACHE_DIR = str(Path(base) / "offboard-companion" / digest.hexdigest()[:16])


def _names(code: types.CodeType) -> set[str]:
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _names(constant)
    return names


def _ours(value: object) -> bool:
    return isinstance(value, types.FunctionType) and value.__module__.partition(".")[0] in PACKAGES


def compile_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """The compiled twin of a kernel; compiled code is kept on disk between processes."""
    if function in _compiled:
        return _compiled[function]  # type: ignore[no-any-return]
    first = "numba" not in sys.modules
    import numba

    if first or not _compiled:
        _use_own_cache(numba)
    assert isinstance(function, types.FunctionType)
    scope = dict(function.__globals__)
    for name in _names(function.__code__):
        value = scope.get(name)
        if value is not None and _ours(value) and value is not function:
            scope[name] = compile_kernel(value)
    twin = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
    twin.__qualname__ = function.__qualname__
    twin.__module__ = function.__module__
    twin.__annotations__ = {}
    compiled = numba.njit(cache=True, error_model="numpy", fastmath=False)(twin)
    _compiled[function] = compiled
    return compiled  # type: ignore[no-any-return, unused-ignore]
