"""The verdict is that of the vehicle's own check. The number is what a start command carries."""

from __future__ import annotations

import json

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, ToOption
from companion.cli.upload import SystemOption

EXAMPLE = "Example: companion list --to udpout:192.168.1.10:14590"


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, system: SystemOption = None, as_json: JsonOption = False
) -> None:
    """Lists what is stored."""
    from companion.ground.upload import Files

    with Files(to, system=system, key=key) as files:
        stored = files.list()
    if as_json:
        print(json.dumps([file._asdict() for file in stored], indent=2))
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if not stored:
        print("no trajectories are stored")
        return
    table = Table("number", "name", "bytes", "CRC-32", "verdict", box=box.SIMPLE)
    for file in stored:
        word = {True: "", False: "REFUSED: ", None: "not checked: "}[file.accepted]  # what may fly says so itself
        cells = (str(file.id), file.name, str(file.size_bytes), f"{file.crc32:08x}", word + file.verdict)
        table.add_row(*(Text(cell) for cell in cells))
    Console(highlight=False).print(table)
