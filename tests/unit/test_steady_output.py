"""What `companion serve` says neither fails nor waits, whoever reads it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import TextIO

import pytest

from companion.cli import steady_output
from companion.cli.steady_output import SteadyOutput

Pipe = tuple[int, TextIO]


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream:
        yield reader, stream


def read_until(reader: int, ending: str) -> str:
    text = ""
    while not text.endswith(ending):
        text += os.read(reader, 65536).decode()
    return text


def test_lines_come_in_their_order(pipe: Pipe) -> None:
    reader, stream = pipe
    with SteadyOutput(stream) as output:
        for number in range(500):
            output.say(f"line {number} å")
    assert read_until(reader, "499 å\n").splitlines() == [f"line {number} å" for number in range(500)]
    os.close(reader)


def test_a_reader_that_has_gone_is_no_matter(pipe: Pipe) -> None:
    reader, stream = pipe
    os.close(reader)
    with SteadyOutput(stream) as output:
        output.say("nobody")
        output.say("hears this")
    print("nor does this fail", file=stream, flush=True)


def test_a_full_disk_is_no_matter() -> None:
    with open("/dev/full", "w") as stream:  # noqa: SIM117
        with SteadyOutput(stream) as output:
            output.say("no room")
            output.say("for this")


def test_a_closed_stream_is_no_matter() -> None:
    with SteadyOutput(None) as output:
        output.say("nothing")


@pytest.mark.parametrize("blocking", [True, False])
def test_a_reader_that_stands_still_costs_lines_and_no_time(
    blocking: bool, pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steady_output, "CLOSE_S", 0.2)
    reader, stream = pipe
    os.set_blocking(stream.fileno(), blocking)
    output = SteadyOutput(stream)
    begun_s = time.monotonic()
    said = 20 * steady_output.LINES_MAX
    for number in range(said):
        output.say(f"{number:050d}")
    output.close()
    assert time.monotonic() - begun_s < 5.0
    lines: list[str] = []
    dropped = 0
    while sum(line.isdigit() for line in lines) + dropped < said:
        lines += read_until(reader, "\n").splitlines()
        dropped = sum(int(line[1:].split()[0]) for line in lines if line.startswith("("))
    kept = [line for line in lines if line.isdigit()]
    assert kept == sorted(set(kept))
    assert kept[0] == "0" * 50
    assert len(kept) >= steady_output.LINES_MAX
    assert dropped == said - len(kept) > 0
    os.close(reader)
