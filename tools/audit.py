"""Asks for known vulnerabilities of the pinned packages (constraints.txt), at OSV by pip-audit:

    python tools/audit.py

Exit code 0: none is known; 1: one is; 4: nothing was checked, because the source of advisories cannot be reached.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PINS = Path(__file__).parents[1] / "constraints.txt"
KNOWN, UNREACHED = 1, 4
PATIENCE_S = 300.0
COMMAND = [
    *(sys.executable, "-m", "pip_audit", "--requirement", str(PINS), "--no-deps", "--disable-pip"),
    *("--vulnerability-service", "osv", "--format", "json", "--progress-spinner", "off", "--timeout", "10"),
]


def findings(document: dict[str, Any]) -> tuple[int, list[str], list[str]]:
    """How many packages were looked at, a line for each vulnerability, and the packages that could not be."""
    lines, skipped, count = [], [], 0
    for package in document["dependencies"]:
        if "skip_reason" in package:
            skipped.append(f"{package['name']}: {package['skip_reason']}")
            continue
        count += 1
        for found in package["vulns"]:
            fixed = ", ".join(found["fix_versions"]) or "no version"
            lines.append(f"{package['name']} {package['version']}: {found['id']}, fixed in {fixed}")
    return count, lines, skipped


def main() -> int:
    """The command line."""
    try:
        done = subprocess.run(COMMAND, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        said, answer = done.stderr, done.stdout
    except subprocess.TimeoutExpired:
        said, answer = f"no answer within {PATIENCE_S:g} s", ""
    try:
        count, lines, skipped = findings(json.loads(answer))
    except (ValueError, KeyError, TypeError):
        last = (said.strip().splitlines() or ["pip-audit said nothing"])[-1]
        print(f"audit: the source of advisories cannot be reached, NOTHING was checked: {last[:300]}", file=sys.stderr)
        return UNREACHED
    for line in (*lines, *(f"not checked: {line}" for line in skipped)):
        print(line)
    print(f"audit: {count} pinned packages, {len(lines)} known vulnerabilities")
    return KNOWN if lines else 0


if __name__ == "__main__":
    sys.exit(main())
