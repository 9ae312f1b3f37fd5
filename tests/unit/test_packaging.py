"""The pins, and what ships: every package that is needed is pinned, nothing else is, and no address stands anywhere."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from companion import __version__

ROOT = Path(__file__).parents[2]
PIN = re.compile(r"([A-Za-z0-9._-]+)==([0-9][A-Za-z0-9.!+-]*)")


def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    found = {}
    for line in lines:
        if line.startswith("#"):
            continue
        match = PIN.fullmatch(line)
        assert match, f"constraints.txt: {line!r} is not NAME==VERSION"
        name = canonicalize_name(match[1])
        assert name not in found, f"constraints.txt: {name} twice"
        found[name] = match[2]
    return found


def requirements() -> Iterator[Requirement]:
    """What the project asks for itself: to run, with every extra, and to be built."""
    project = pyproject()
    yield from map(Requirement, project["build-system"]["requires"])
    yield from map(Requirement, project["project"]["dependencies"])
    for extra in project["project"]["optional-dependencies"].values():
        yield from map(Requirement, extra)


def closure() -> set[str]:
    """Names of all packages that `requirements` lead to here; the lint extra's only as far as it is installed."""
    seen: set[tuple[str, str]] = set()
    open_ends = [(r, extra) for r in requirements() for extra in ("", *r.extras)]
    while open_ends:
        requirement, extra = open_ends.pop()
        key = canonicalize_name(requirement.name), extra
        if key in seen:
            continue
        seen.add(key)
        try:
            needs = importlib.metadata.requires(requirement.name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for need in map(Requirement, needs):
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                open_ends += [(need, e) for e in ("", *need.extras)]
    return {name for name, _ in seen}


def test_everything_that_is_needed_is_pinned() -> None:
    missing = closure() - set(pins())
    assert not missing, f"constraints.txt has no pin for {sorted(missing)}"


def test_nothing_is_pinned_that_nothing_needs() -> None:
    for requirement in requirements():
        try:
            importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            pytest.skip(f"{requirement.name} is not installed here, so what it needs is not known")
    unneeded = set(pins()) - closure()
    assert not unneeded, f"constraints.txt pins {sorted(unneeded)}, which nothing needs"


def test_the_pins_are_what_the_project_asks_for() -> None:
    found = pins()
    for requirement in requirements():
        assert requirement.url is None
        assert requirement.specifier.contains(found[canonicalize_name(requirement.name)]), requirement


def test_no_address_to_download_from() -> None:
    for name in ("constraints.txt", "pyproject.toml", "Makefile", ".ci/run"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert "://" not in text, name
        assert not re.search(r"--(extra-)?index-url|--find-links|INDEX_URL|FIND_LINKS", text), name


def test_one_version_everywhere() -> None:
    assert pyproject()["project"]["version"] == __version__


def test_the_licence_is_stated_and_there() -> None:
    project = pyproject()["project"]
    assert project["license"] == "BSD-3-Clause"
    assert project["license-files"] == ["LICENSE"]
    assert "Redistributions of source code must retain" in (ROOT / "LICENSE").read_text(encoding="utf-8")
