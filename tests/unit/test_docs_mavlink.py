"""docs/mavlink.md says what the program does: commands, phases, names, and what passes to the autopilot."""

from __future__ import annotations

import re
from pathlib import Path

from companion.ground import reports
from companion.ground.commands import PROGRESS_INTERVAL_S, UserCommand
from companion.ground.filter import BYTES_1_S, PASSING, RATE_1_S
from companion.ground.links import PEER_SILENCE_S, PEERS_MAX
from companion.ground.standing import PHASE_CODES
from companion.link import codec

TEXT = (Path(__file__).parents[2] / "docs" / "mavlink.md").read_text(encoding="utf-8")


def test_commands_and_their_numbers() -> None:
    assert {int(number) for number in re.findall(r"^\| MAV_CMD\w+[^|]*\| (\d+) \|", TEXT, re.M)} == set(UserCommand)


def test_phases() -> None:
    for name, code in PHASE_CODES.items():
        assert re.search(rf"\b{code} {name}\b", TEXT), name


def test_names_of_values() -> None:
    named = set(re.findall(r"(?:NAMED_VALUE_FLOAT|DEBUG_VECT) \| `(\w+)`", TEXT))
    told = {reports.ERROR, reports.LYAPUNOV, reports.TRACK_TIME, reports.TO_GO, reports.DISTURBANCE, reports.REFUSED}
    assert named == told
    assert all(len(name) <= 10 for name in named)


def test_messages_that_pass() -> None:
    section = TEXT.split("passes a filter first:")[1].split("## When")[0]
    named = set(re.findall(r"\b[A-Z]+(?:_[A-Z]+)+\b|\bSTATUSTEXT\b", section))
    assert named == {codec.message_name(number) for number in PASSING} | {
        "MAV_CMD_REQUEST_MESSAGE",
        "FILE_TRANSFER_PROTOCOL",
    }
    assert f"{RATE_1_S:.0f} messages and {BYTES_1_S / 1e3:.0f} kB per second" in section


def test_figures() -> None:
    assert f"every {PROGRESS_INTERVAL_S:g} s" in TEXT
    assert f"({PEERS_MAX} tools at most)" in TEXT
    assert f"for {PEER_SILENCE_S:g} s after" in TEXT
    assert f"at {1.0 / reports.GROUND_INTERVAL_S:g} Hz on the ground links" in TEXT
    assert f"{1.0 / reports.VEHICLE_INTERVAL_S:g} Hz through the radio" in TEXT
