"""Compiles plain Python kernels with numba on request.

The law is made of scalar functions that run as plain Python; nothing marks them for compilation.
On request a function is compiled together with every function of ours that it calls: a copy of it, whose globals hold
the compiled callees, goes to `numba.njit`. numba is optional and only imported here, when something is compiled.

Compiled code is kept on disk between processes, one folder per state of the sources: numba itself looks at nothing
but the file of the function it compiles, and would go on using machine code into which an old version of a callee or
a constant was built.
"""

from __future__ import annotations

import builtins
import dis
import functools
import hashlib
import importlib.util
import os
from collections.abc import Callable, Iterator, MutableSequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from companion.control.types import new_record
from companion.errors import InputError

ENGINES = ("auto", "python", "numba")
"""What `resolve` understands."""

_PACKAGES = ("companion", "sim_link")
"""Functions of these packages are compiled with the function that calls them."""
_CONSTANTS = (bool, int, float, str, tuple)
"""Types of globals that become part of the compiled code."""
_compiled: dict[FunctionType, Any] = {}


def available() -> bool:
    """Tell whether numba can be used: installed, and not hidden by COMPANION_TEST_WITHOUT_NUMBA=1."""
    if os.environ.get("COMPANION_TEST_WITHOUT_NUMBA") == "1":
        return False
    return importlib.util.find_spec("numba") is not None


def resolve(engine: str) -> str:
    """Return the engine that "auto" stands for here; "python" and "numba" stand for themselves.

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
    """Return a kernel as it is to run: the plain function, or its compiled twin."""
    return compile_kernel(function) if resolve(engine) == "numba" else function


def numbers(size: int, engine: str) -> MutableSequence[float]:
    """Return zeros for kernels to work on: a list for plain Python, an array for compiled code."""
    if resolve(engine) != "numba":
        return [0.0] * size
    import numpy as np

    array: MutableSequence[float] = np.zeros(size)  # type: ignore[assignment]  # what is used of a sequence it has
    return array


def compile_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the compiled twin of a plain function: the same numbers, faster.

    Its first call with arguments of new types compiles it, or loads it from the disk. Raises ImportError without numba.
    """
    if not available():
        raise ImportError("numba is not installed; install it with: pip install 'offboard-companion[fast]'")
    if not isinstance(function, FunctionType):
        raise TypeError(f"{function!r} is not a plain Python function")
    twin: Callable[..., Any] = _twin(function, ())
    return twin


def compile_for(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return the compiled twin of a plain function for arguments of the types of these alone, compiled or loaded now.

    It is called without a look at what it gets, which would take longer than a short kernel: an array of other numbers
    would be read as if it were none.
    """
    import numba

    twin: Any = compile_kernel(function)
    type_of: Any = numba.typeof
    types = tuple(type_of(argument) for argument in arguments)
    twin.compile(types)
    entry: Callable[..., Any] = twin.get_overload(types)
    return entry


def _twin(function: FunctionType, callers: tuple[FunctionType, ...]) -> Any:
    """Return the compiled copy of a function, its callees first; `callers` is the path to it, to find recursion."""
    if function in _compiled:
        return _compiled[function]
    if function.__closure__:
        raise TypeError(f"{function.__qualname__} is a closure; a kernel takes all that it needs as arguments")
    if function in callers:
        raise TypeError(f"{function.__qualname__} calls itself; kernels do not recurse")
    names = {"__builtins__": builtins, "__name__": function.__module__}
    for name, value in _globals_of(function):
        names[name] = _twin(value, (*callers, function)) if _is_ours(value) else value
    copy = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    copy.__module__ = function.__module__
    copy.__qualname__ = function.__qualname__
    twin = _compile(copy, _digest(function))
    _compiled[function] = twin
    return twin


@functools.cache
def _teach_records() -> None:
    """Lets compiled code make records with `types.new_record`."""
    from numba import types
    from numba.extending import overload

    @overload(new_record, strict=False)
    def make(kind: Any, fields: Any) -> Any:
        if isinstance(kind, types.NamedTupleClass):
            return lambda kind, fields: kind(*fields)
        return None


def _compile(function: FunctionType, digest: str) -> Any:
    import numba

    _teach_records()
    config: Any = numba.config
    folder = _cache_folder(str(config.CACHE_DIR), digest)
    if folder is None:
        return numba.njit(cache=False, error_model="numpy", fastmath=False)(function)
    before = config.CACHE_DIR
    # numba reads this setting while it wraps a function; others in this process keep theirs.
    config.CACHE_DIR = str(folder)
    try:
        return numba.njit(cache=True, error_model="numpy", fastmath=False)(function)
    finally:
        config.CACHE_DIR = before


def _cache_folder(chosen: str, digest: str) -> Path | None:
    """Return the folder for compiled code, made if need be; None when it cannot be written.

    It is below NUMBA_CACHE_DIR where that is set (`chosen`), else below the user's cache folder.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(chosen or os.path.join(home, "offboard-companion", "numba")) / digest
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _digest(function: FunctionType) -> str:
    """Return a hash over the sources and constants of a function and all that it calls."""
    found: dict[str, bytes] = {}
    _collect(function, found, set())
    digest = hashlib.sha256()
    for key in sorted(found):
        digest.update(key.encode() + b"\0" + found[key] + b"\0")
    return digest.hexdigest()[:20]


def _collect(function: FunctionType, found: dict[str, bytes], seen: set[FunctionType]) -> None:
    if function in seen:
        return
    seen.add(function)
    path = Path(function.__code__.co_filename)
    key = f"{function.__module__}:{path.name}"
    if key not in found:
        found[key] = _source(path, function.__code__)
    for name, value in _globals_of(function):
        if _is_ours(value):
            _collect(value, found, seen)
        elif isinstance(value, type) and hasattr(value, "_fields"):
            found[f"{function.__module__}.{name}"] = repr((value.__qualname__, value._fields)).encode()
        elif isinstance(value, _CONSTANTS):
            found[f"{function.__module__}.{name}"] = repr(value).encode()


def _source(path: Path, code: CodeType) -> bytes:
    """Return the file of a function, or its byte code and constants where there is no file to read (a zip archive)."""
    try:
        return path.read_bytes()
    except OSError:
        return code.co_code + repr(code.co_consts).encode()


def _globals_of(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the globals that a function's code, or code nested in it, reads: name and value."""
    for name in sorted(_global_names(function.__code__)):
        if name in function.__globals__:
            yield name, function.__globals__[name]


def _global_names(code: CodeType) -> set[str]:
    names = {str(i.argval) for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _global_names(constant)
    return names


def _is_ours(value: Any) -> bool:
    return isinstance(value, FunctionType) and value.__module__.split(".")[0] in _PACKAGES
