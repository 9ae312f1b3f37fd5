"""Mutation testing of the law and the guards: one operator, number or condition is changed, and a test must notice.

    python tools/mutation.py                                # companion/control and flight/guards.py
    python tools/mutation.py --module companion/flight/guards.py --out mutation/

Every mutant runs in a process that is forked from one with the libraries imported already, as plain Python without
numba, on the tests that TESTS names, until the first one fails or its time is over. Usual tools copy the tree and
cannot follow kernels that are built from source at import; a hook that hands out one module's changed source can. A
mutant is known by file, line and change; results are kept in OUT, so that a run can be taken up again.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import io
import json
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LAW_TESTS = ("test_law.py", "test_tracker.py", "test_heading.py", "test_output.py", "test_certificate.py")
TESTS: dict[str, tuple[str, ...]] = {
    "companion/flight/guards.py": ("test_guards.py", "test_docs_guards.py", "test_flight_responses.py"),
    "companion/control/vectors.py": ("test_vectors.py", *LAW_TESTS),
    "companion/control/heading.py": ("test_heading.py", "test_law.py"),
    "companion/control/output.py": ("test_output.py", "test_tracker.py"),
    "companion/control/certificate.py": ("test_certificate.py", "test_guards.py"),
    "companion/control/law.py": LAW_TESTS,
}
WARM = (
    *("numpy", "scipy.linalg", "scipy.optimize", "pytest", "hypothesis", "pydantic", "tomlkit", "fastcrc"),
    *("pymavlink.dialects.v20.development", "sim_link.pytest_plugin"),  # the plugin shares no code with the companion
)
TIME_MAX_S = 60.0
"""Beyond this all tests of a module hang [s]: they take a tenth of it."""
TEST_MAX_S = 15.0
"""The same for one of them: a wrong law can make an integrator crawl."""
_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult},
}


class Mutant(NamedTuple):
    """One change."""

    module: str
    line: int
    column: int
    change: str
    twin: int
    """How many others begin at the same place and change the same: a + b + c has two additions that begin at a."""

    @property
    def name(self) -> str:
        """What it is known by."""
        which = f" ({self.twin + 1})" if self.twin else ""
        return f"{self.module}:{self.line}:{self.column} {self.change}{which}"


class _Mutator(ast.NodeTransformer):
    """Visits what can be changed; changes the one at an index, if one is given."""

    def __init__(self, module: str, index: int | None) -> None:
        self.found: list[Mutant] = []
        self._module, self._index = module, index

    def _here(self, node: Any, change: str) -> bool:
        place = (self._module, node.lineno, node.col_offset, change)
        self.found.append(Mutant(*place, sum(mutant[:-1] == place for mutant in self.found)))
        return len(self.found) - 1 == self._index

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is not None:
            node.value = self.visit(node.value)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.body = [self.visit(part) for part in node.body]
        node.args.defaults = [self.visit(part) for part in node.args.defaults]
        return node

    def visit_Import(self, node: ast.Import) -> ast.AST:
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        return node  # words for people

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        for i, operator in enumerate(node.ops):
            other = _SWAPS.get(type(operator))
            if other is not None and self._here(node, f"{type(operator).__name__} -> {other.__name__}"):
                node.ops[i] = other()  # type: ignore[call-overload]
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        self.generic_visit(node)
        other = _SWAPS[type(node.op)]
        if self._here(node, f"{type(node.op).__name__} -> {other.__name__}"):
            node.op = other()  # type: ignore[assignment]
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        other = _SWAPS.get(type(node.op))
        if other is not None and self._here(node, f"{type(node.op).__name__} -> {other.__name__}"):
            node.op = other()  # type: ignore[assignment]
        return node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, ast.USub | ast.Not) and self._here(node, f"without {type(node.op).__name__}"):
            return node.operand
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if isinstance(node.value, bool):
            if self._here(node, f"{node.value} -> {not node.value}"):
                return ast.copy_location(ast.Constant(not node.value), node)
        elif isinstance(node.value, int | float):
            other = node.value + 1 if isinstance(node.value, int) else node.value * 1.5 + (node.value == 0.0)
            if self._here(node, f"{node.value!r} -> {other!r}"):
                return ast.copy_location(ast.Constant(other), node)
        return node


def mutants(module: str) -> list[Mutant]:
    """All changes of a module."""
    mutator = _Mutator(module, None)
    mutator.visit(ast.parse((ROOT / module).read_text()))
    return mutator.found


def changed(module: str, index: int) -> str:
    """The source with one change."""
    tree = _Mutator(module, index).visit(ast.parse((ROOT / module).read_text()))
    return ast.unparse(ast.fix_missing_locations(tree))


class _Overlay(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Hands out the changed source of one module."""

    def __init__(self, module: str, source: str) -> None:
        self._name = module.removesuffix(".py").replace("/", ".")
        self._path, self._source = str(ROOT / module), source

    def find_spec(self, name: str, path: object = None, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if name != self._name:
            return None
        return importlib.util.spec_from_file_location(name, self._path, loader=self)

    def get_filename(self, fullname: str) -> str:
        return self._path

    def get_data(self, path: str) -> bytes:
        if path != self._path:
            raise OSError  # no cached byte code
        return self._source.encode()


def survives(module: str, index: int) -> bool:
    """Whether no test notices a change; also one that lets a test hang is noticed."""
    pid = os.fork()
    if pid == 0:
        _in_child(module, index)
    end_s = time.monotonic() + TIME_MAX_S
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status == 0
        if time.monotonic() > end_s:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return False
        time.sleep(0.01)


def _in_child(module: str, index: int) -> None:
    import hypothesis
    import pytest

    # a failure is enough: to find the smallest input that fails, and to draw where it did, takes most of the time
    phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
    hypothesis.settings.register_profile("mutation", hypothesis.settings.default, phases=phases, database=None)
    hypothesis.settings.load_profile("mutation")
    code = 1
    try:
        if index >= 0:
            sys.meta_path.insert(0, _Overlay(module, changed(module, index)))
        tests = [str(ROOT / "tests" / "unit" / name) for name in TESTS[module]]
        options = ["-q", "-x", "-p", "no:cacheprovider", "--tb=no", f"--timeout={TEST_MAX_S:g}"]
        options += ["-m", "not long", "--hypothesis-seed=0"]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = int(pytest.main([*tests, *options]))
    finally:
        os._exit(code)


def results(path: Path) -> dict[str, bool]:
    """What is known: names, and whether they survived."""
    if not path.exists():
        return {}
    return {row["name"]: row["survived"] for row in map(json.loads, path.read_text().splitlines())}


def chosen(modules: list[str]) -> Iterator[tuple[str, int, Mutant]]:
    for module in modules:
        for index, mutant in enumerate(mutants(module)):
            yield module, index, mutant


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--module", action="append", choices=list(TESTS), help="default: all")
    parser.add_argument("--at-most", type=int, help="so many now, drawn at random, the rest another time")
    parser.add_argument("--out", type=Path, default=Path("mutation"))
    arguments = parser.parse_args()
    os.environ["COMPANION_TEST_WITHOUT_NUMBA"] = "1"
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    for library in WARM:
        importlib.import_module(library)  # once, for all that are forked
    modules = arguments.module or list(TESTS)
    for module in modules:
        if not survives(module, -1):
            print(f"the tests of {module} fail without any change", file=sys.stderr)
            return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "mutants.jsonl"
    known, everything = results(path), list(chosen(modules))
    missing = [item for item in everything if item[2].name not in known]
    random.Random(0).shuffle(missing)
    with path.open("a") as out:
        for i, (module, index, mutant) in enumerate(missing[: arguments.at_most], 1):
            known[mutant.name] = survives(module, index)
            out.write(json.dumps({"name": mutant.name, "survived": known[mutant.name]}) + "\n")
            out.flush()
            print(f"\r{i}/{len(missing)} ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    tried = [item[2].name for item in everything if item[2].name in known]
    left = [name for name in tried if known[name]]
    for name in left:
        print(f"survived: {name}")
    print(f"{len(tried)} of {len(everything)} mutants, {len(tried) - len(left)} noticed, {len(left)} survived")
    return int(bool(left))


if __name__ == "__main__":
    sys.exit(main())
