"""Where a flight is read from: its folder, or its log alone; the report, the comparison and the replay use it alike.

A log that was cut off gives what is in it. The summary of a log is computed as the flight would have computed it; a log
that has the flight's end gives the same one.
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.errors import InputError
from companion.record import topics
from companion.record.columns import COLUMN_INDEX, COLUMNS, DEFAULT_PHASE_NAMES
from companion.record.flight_data import Message
from companion.record.flight_record import RECORD_FILE, FlightRecord
from companion.record.folder import CONFIGURATION_FILE, SUMMARY_FILE, read_summary
from companion.record.summary import FlightMeta, PhaseChange, note_end, summarise
from companion.record.ulog import ULOG_FILE, Level, Topic
from companion.record.ulog_file import Array, LogFile, read_seldom, read_ulog

TRUTH_FILE: Final = "truth.csv"
"""Written by the simulated vehicle: what really happened, on the clock of the record's `t_s`."""
_LARGEST: Final = 1e9
"""No number of a flight is larger; where one is, the log is damaged."""


@dataclass(frozen=True)
class FlightSource:
    """A flight as it was left behind."""

    path: Path
    """The folder, or the log."""
    record: FlightRecord
    summary: dict[str, Any]
    configuration: dict[str, Any]
    """flight.toml; empty when there is none."""
    configuration_name: str
    """What to call it in a message."""
    truth: Mapping[str, Array] = field(default_factory=dict)
    """Columns of the simulated vehicle's truth.csv; empty when there is none."""
    missing: tuple[str, ...] = ()
    """What could not be read, a sentence each."""
    battery: Mapping[str, Array] = field(default_factory=dict)
    """The topic battery_status of the log, with `t_s`; empty without one."""
    messages: tuple[Message, ...] = ()
    """What was said during the flight, from the log."""

    @property
    def folder(self) -> Path:
        """Where the files stand that the configuration names."""
        return self.path if self.path.is_dir() else self.path.parent


def read_source(path: Path) -> FlightSource:
    """Read a flight from its folder or its log.

    A folder without record and summary, as a killed control process leaves it, is read from its flight.ulg.

    Raises:
        InputError: there is no flight, or it cannot be read.
    """
    if path.is_file():
        source = _from_log(path)
        return replace(source, truth=_read_truth(path.parent / TRUTH_FILE)) if path.name == ULOG_FILE else source
    if (path / ULOG_FILE).is_file() and not ((path / RECORD_FILE).exists() and (path / SUMMARY_FILE).exists()):
        source = _from_log(path / ULOG_FILE)
        absent = " and ".join(name for name in (RECORD_FILE, SUMMARY_FILE) if not (path / name).exists())
        told = f"{absent}: not there, the control process did not come to its end; this is read from {ULOG_FILE}"
        return replace(source, path=path, truth=_read_truth(path / TRUTH_FILE), missing=(told, *source.missing))
    try:
        record = FlightRecord.load(path)
    except InputError as error:
        if not (path / ULOG_FILE).is_file():
            raise
        source = _from_log(path / ULOG_FILE)
        told = f"{error}; this is read from {ULOG_FILE}"
        return replace(source, path=path, truth=_read_truth(path / TRUTH_FILE), missing=(told, *source.missing))
    configuration = path / CONFIGURATION_FILE
    missing: tuple[str, ...] = ()
    battery: dict[str, Array] = {}
    messages: tuple[Message, ...] = ()
    if (path / ULOG_FILE).is_file():
        try:
            log = read_seldom(path / ULOG_FILE, [topics.BATTERY.name])
            battery, messages, missing = (
                _battery(log),
                _messages(log),
                tuple(f"{ULOG_FILE}: {said}" for said in log.missing),
            )
        except InputError as error:
            missing = (str(error),)
    return FlightSource(
        path,
        record,
        read_summary(path),
        _read_configuration(configuration),
        str(configuration),
        _read_truth(path / TRUTH_FILE),
        missing,
        battery,
        messages,
    )


def read_source_summary(path: Path) -> dict[str, Any]:
    """The summary alone; of a folder that has one without reading more. Raises InputError."""
    if path.is_file() or ((path / ULOG_FILE).is_file() and not (path / SUMMARY_FILE).exists()):
        return read_source(path).summary
    return read_summary(path)


# ---- a folder's files -----------------------------------------------------------------------------------------------


def _read_configuration(path: Path) -> dict[str, Any]:
    """The configuration as used; empty when there is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); repair or remove it") from None


def _read_truth(path: Path) -> dict[str, Array]:
    """The truth by column; empty when there is none. A last line that was cut off is left out."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            names = next(reader, [])
            rows = [[float(value) for value in row] for row in reader if len(row) == len(names) and row[-1]]
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); repair or remove it") from None
    if "t_s" not in names:
        raise InputError(f"{path}: the first line must name the columns, t_s among them; repair or remove it")
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return {name: table[:, index] for index, name in enumerate(names)}


# ---- a log ----------------------------------------------------------------------------------------------------------


def _from_log(path: Path) -> FlightSource:
    log = read_ulog(path, [topic.name for topic in (*topics.STEP_TOPICS, topics.LINK, topics.BATTERY)])
    if not log.info and not log.topics:
        raise InputError(f"{path}: ends within its definitions; nothing of the flight is in it")
    if not log.is_ours:
        by = str(log.info.get("sys_name", "another program"))
        raise InputError(
            f"{path}: was written by {by}, not by this program; lay it over a flight with --from-px4 {path.name} FOLDER"
        )
    missing = list(log.missing)
    record = _record(log, missing)
    configuration = _configuration(log, missing)
    outcome = _json_object(log, "outcome", {"sentence", "cause", "rejected_states"})
    if not outcome:
        missing.append("the log does not have the flight's end: the program was killed, or the rest of the log is lost")
    dropped = log.topics[topics.LINK.name].get("dropped") if topics.LINK.name in log.topics else None
    if dropped is not None and dropped[-1]:
        missing.append(f"{dropped[-1]} entries never reached the log: its writer was too slow")
    summary = _summary(log, record, configuration, outcome)
    return FlightSource(
        *(path, record, summary, configuration, f"{path} (flight_toml)"),
        missing=tuple(missing),
        battery=_battery(log),
        messages=_messages(log),
    )


def _battery(log: LogFile) -> dict[str, Array]:
    """The battery's topic, where it is whole."""
    name = topics.BATTERY.name
    if name not in log.topics:
        return {}
    return {"t_s": log.time_s(name)} | {entry: log.column(name, entry) for entry in log.topics[name]}


def _messages(log: LogFile) -> tuple[Message, ...]:
    return tuple(Message(1e-6 * t_us, level, text) for level, t_us, text in log.texts)


def _record(log: LogFile, missing: list[str]) -> FlightRecord:
    """The record out of the topics of the control steps: bit by bit, where the log is whole."""
    names = _phase_names(log)
    if topics.STEP.name not in log.topics or "t_s" not in log.topics[topics.STEP.name]:
        missing.append("no control step is in the log")
        return FlightRecord(0, names)
    stamps = np.asarray(log.topics[topics.STEP.name]["timestamp"])
    t_s = log.column(topics.STEP.name, "t_s")
    good = np.isfinite(t_s) & (np.abs(1e6 * t_s - stamps) < 1.0) & np.concatenate(([True], np.diff(t_s) > 0.0))
    table = np.full((len(stamps), len(COLUMNS)), np.nan)
    whole = np.ones(len(stamps), dtype=np.bool_)
    for topic in topics.STEP_TOPICS:
        whole &= topic.name in log.topics and _fill(table, log, topic, stamps)
    good[-1] &= whole[-1]  # the rest of the last step may be behind the log's end
    if not good[:-1].all():
        missing.append(f"{np.count_nonzero(~good)} control steps have no time that can be right and are left out")
    table = table[good]
    table[~(np.abs(table) < _LARGEST)] = np.nan
    record = FlightRecord(len(table), names)
    for row in table.tolist():
        record.append(tuple(row))
    return record


def _fill(table: Array, log: LogFile, topic: Topic, stamps: Any) -> Any:
    """Put a topic's numbers into the rows with their timestamps; a row that the topic lost stays NaN.

    Returns which rows it has, shape (len,).
    """
    data = log.topics[topic.name]
    own = np.asarray(data["timestamp"])
    same = len(own) == len(stamps) and bool(np.all(own == stamps))
    at = np.arange(len(own)) if same else np.searchsorted(own, stamps).clip(0, len(own) - 1)
    here = np.ones(len(stamps), dtype=np.bool_) if same else np.asarray(own[at] == stamps)
    for entry in topic.fields:
        for index, name in enumerate(entry.columns):
            column = COLUMN_INDEX.get(name)
            if column is not None and entry.basic_type == "double":
                numbers = data.get(f"{entry.name}[{index}]" if entry.size > 1 else entry.name)
                if numbers is not None:
                    table[here, column] = np.asarray(numbers, dtype=np.float64)[at[here]]
    return here


def _phase_names(log: LogFile) -> tuple[str, ...]:
    named = log.info.get("phase_names")
    return tuple(named.split(", ")) if isinstance(named, str) and named else DEFAULT_PHASE_NAMES


def _configuration(log: LogFile, missing: list[str]) -> dict[str, Any]:
    text = next(iter(log.long_info.get("flight_toml", ())), "")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        missing.append("the configuration in the log is damaged: limits, gains and thresholds are not known")
        return {}


def _json_object(log: LogFile, key: str, needed: Collection[str] = ()) -> dict[str, Any]:
    """The last of the facts under a key that can be read and has the entries that are needed; empty: there is none."""
    for text in reversed(log.long_info.get(key, ())):
        try:
            found = json.loads(text)
        except ValueError:
            continue
        if isinstance(found, dict) and found.keys() >= set(needed):
            return found
    return {}


def _summary(
    log: LogFile, record: FlightRecord, configuration: Mapping[str, Any], outcome: Mapping[str, Any]
) -> dict[str, Any]:
    from companion.flight.preflight import BASELINE_PARAMETERS

    acceptance = configuration.get("acceptance")
    output = configuration.get("output")
    from_s = configuration.get("statistics_from_s")
    meta = FlightMeta(
        str(log.info.get("trajectory", "?")),
        str(log.info.get("vehicle", "?")),
        int(outcome.get("lost_setpoints", 0)),
        float(from_s) if isinstance(from_s, int | float) else None,
        {key: most for key, most in acceptance.items() if isinstance(most, int | float)}
        if isinstance(acceptance, Mapping)
        else {},
        str(output.get("controller", "law")) if isinstance(output, Mapping) else "law",
    )
    summary = summarise(record, _phases(log, outcome), meta)
    engagement = _engagement(log)
    if outcome:
        read = outcome.get("parameters", {})
        note_end(summary, outcome, engagement, {name: read[name] for name in BASELINE_PARAMETERS if name in read})
        return summary
    if engagement is not None:
        summary["engagement"] = engagement
    summary["ended"] = "the log ends before the flight's end"
    summary["verdict"] = "incomplete: the log ends before the flight's end"
    return summary


def _engagement(log: LogFile) -> dict[str, Any] | None:
    """The last engagement; of a flight whose end is missing, with the delays that were told on the way."""
    engagement = _json_object(log, "engagement") or None
    if engagement is not None and not engagement.get("delays"):
        told: list[Any] = []
        for text in log.long_info.get("delays", ()):
            with contextlib.suppress(ValueError, TypeError):
                told += json.loads(text)
        engagement["delays"] = told
    return engagement


def _phases(log: LogFile, outcome: Mapping[str, Any]) -> list[PhaseChange]:
    """As the flight's end has them; without it from what was said at every change."""
    try:
        return [PhaseChange(str(name), float(at_s), str(reason)) for name, at_s, reason in outcome["phases"]]
    except (KeyError, TypeError, ValueError):
        pass
    names, found = _phase_names(log), []
    for level, t_us, text in log.texts:
        name, sign, reason = text.partition(": ")
        if level == Level.NOTICE and sign and name in names and math.isfinite(t_us):
            found.append(PhaseChange(name, 1e-6 * t_us, reason))
    return found
