"""The vehicle checks the file itself before it takes it, and says why not when it does not (exit code 3); what it had
under that name stays then. An upload that was cut off goes on where it ended when it is made again.

A file that names another program's goes as one that holds its text; so does another program's file with --frame or
--laps, as NAME.toml. What goes as TOML must have a name that ends in .toml there: by that the vehicle knows it.
"""

from __future__ import annotations

import json
import sys
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.common import FrameOption, JsonOption, LapsOption, frame_named, say, say_notes
from companion.cli.operate import TO_DEFAULT, KeyOption, ToOption

if TYPE_CHECKING:
    from companion.ground.upload import Verdict
    from companion.trajectory.portable import Portable

EXAMPLE = "Example: companion upload lap.csv --to udpout:192.168.1.10:14590"

SystemOption = Annotated[
    int | None,
    typer.Option("--system", metavar="ID", min=1, max=255, help="The vehicle's system id; needed if several answer."),
]


def run(
    file: Annotated[str, typer.Argument(help="Trajectory file of any known format, or the name of a bundled one.")],
    to: ToOption = TO_DEFAULT,
    key: KeyOption = None,
    name: Annotated[
        str | None,
        typer.Option("--name", metavar="NAME", help="What to call it there; default: its own name."),
    ] = None,
    frame: FrameOption = None,
    laps: LapsOption = None,
    system: SystemOption = None,
    timeout: Annotated[
        float, typer.Option("--timeout", metavar="S", min=1.0, help="How long the vehicle's check may take.")
    ] = 90.0,
    as_json: JsonOption = False,
) -> None:
    """Uploads the file and prints the vehicle's verdict."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    from companion.errors import ExitCode
    from companion.ground.upload import Files
    from companion.trajectory.portable import Portable

    brought = Portable(file, frame_named(frame), laps)
    called = _name(brought, name)
    notes = brought.notes()
    say_notes(notes, quiet=as_json)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with (
        Files(to, system=system, key=key) as files,
        Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar,
    ):
        task = bar.add_task("uploading", total=None)

        def show(there: int, total: int) -> None:
            if there == total:
                bar.update(task, description="the vehicle checks it", completed=there, total=total)
            else:
                bar.update(task, completed=there, total=total)

        verdict = files.upload_bytes(brought.content, called, progress=show, verdict_patience_s=timeout)
    if as_json:
        print(json.dumps({**verdict._asdict(), "notes": list(notes)}, indent=2))
    else:
        _say(verdict)
    raise typer.Exit(int(ExitCode.DONE if verdict.accepted else ExitCode.REFUSED))


def _name(brought: Portable, wanted: str | None) -> str:
    """What to call the file there; TOML under another name would be read as another program's file."""
    from companion.errors import InputError
    from companion.trajectory.formats import FORMATS
    from companion.trajectory.formats.reading import shown

    if not wanted:
        return brought.file_name
    suffix = PurePath(wanted).suffix
    if suffix.lower() == ".toml" or PurePath(brought.file_name).suffix.lower() != ".toml":
        return wanted
    known = {entry for of in FORMATS for entry in of.suffixes}
    better = (wanted.removesuffix(suffix) if suffix.lower() in known else wanted) + ".toml"
    why = "with --frame or --laps the file goes as TOML" if brought.around else "the file is TOML"
    raise InputError(f"--name {shown(wanted)}: {why}; name it {shown(better)}")


def _say(verdict: Verdict) -> None:
    if verdict.resumed_from:
        say(f"{verdict.name}: went on at byte {verdict.resumed_from} of {verdict.size_bytes}")
    if verdict.accepted:
        say(f"{verdict.name}: stored with number {verdict.id} ({verdict.size_bytes} bytes, CRC-32 {verdict.crc32:08x})")
        say(f"  {verdict.verdict}")
    else:
        say(f"{verdict.name}: REFUSED by the vehicle: {verdict.verdict}")
