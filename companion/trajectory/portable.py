"""A trajectory as one file that says all there is to say: for a vehicle that has only this file."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from companion.config import find
from companion.errors import InputError
from companion.frames import Frame
from companion.toml_text import toml_text
from companion.trajectory.formats.reading import decoded, read_bytes, shown
from companion.trajectory.load import changed, reader_notes, table_of


class Portable:
    """A trajectory file as it goes to the vehicle."""

    def __init__(self, name: str, frame: Frame | None = None, laps: int | None = None) -> None:
        """Read it.

        A file of ours that names another program's takes that file's text in; so does one that is made around another
        program's file where something has to be said about it. Every other file goes as it is.

        Args:
            name: a path, or the name of a bundled trajectory.
            frame: of another program's file, where its format leaves that open.
            laps: replaces the file's.

        Raises:
            InputError: no such file, or it cannot be read.
        """
        path = find(name, "trajectories")
        self.file_name = path.name
        """What to call it there."""
        self.around = False
        """Whether it was made around another program's file, because of `frame` or `laps`."""
        ours = path.suffix.lower() == ".toml"
        table = table_of(name, frame) if ours or frame is not None or laps is not None else {}
        if not ("file" in table or (ours and laps is not None)):
            self.content = read_bytes(path, shown(str(path)))
            self._table = table or {"file": str(path)}
            return
        table = changed(table, None, laps)
        if "file" in table:
            other = Path(table.pop("file"))
            table.pop("sha256", None)
            called = shown(str(other))
            table["text"] = decoded(read_bytes(other, called), called).text
        self.around = not ours
        self.file_name = path.with_suffix(".toml").name
        self.content = toml_text(table).encode()
        self._table = table

    def notes(self) -> tuple[str, ...]:
        """Return what the reader of another program's file says about it, a sentence each.

        None where it cannot be read: what is wrong with it is the vehicle's to say, which may know more formats.
        """
        with suppress(InputError):
            return reader_notes(self._table, self.file_name)
        return ()
