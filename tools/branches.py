"""Says which share of all branches the tests reached, from the data that `make coverage` leaves behind.

python tools/branches.py [--least 90]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--least", type=float, default=90.0, help="percent")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "coverage.json"
        subprocess.run([sys.executable, "-m", "coverage", "json", "-q", "-o", str(path)], check=True)
        totals = json.loads(path.read_text())["totals"]
    share = 100.0 * totals["covered_branches"] / totals["num_branches"]
    lines = 100.0 * totals["covered_lines"] / totals["num_statements"]
    print(f"branches: {totals['covered_branches']} of {totals['num_branches']}, {share:.1f} %; lines: {lines:.1f} %")
    return int(share < arguments.least)


if __name__ == "__main__":
    sys.exit(main())
