"""A reader of ULog that follows the specification to the letter and forgives nothing, but an end in the middle."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CODES = {
    **{"int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I"},
    **{"int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d", "bool": "?"},
}
KEY = re.compile(rb"(\w+(?:\[\d+\])?) ([A-Za-z0-9_\-/]+)")
FIELD = re.compile(r"(\w+?)(?:\[(\d+)\])? ([A-Za-z0-9_]+)")


@dataclass
class Log:
    start_us: int
    formats: dict[str, list[tuple[str, int, str]]] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    long_info: dict[str, list[str]] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    changed: list[tuple[str, float]] = field(default_factory=list)
    numbers: dict[int, str] = field(default_factory=dict)
    data: dict[str, list[tuple[Any, ...]]] = field(default_factory=dict)
    texts: list[tuple[int, int, str]] = field(default_factory=list)
    dropouts_ms: list[int] = field(default_factory=list)
    syncs: int = 0
    left_over: int = 0
    """Bytes of a last message that is not whole."""


def value_of(kind: bytes, content: bytes) -> Any:
    name = kind.decode()
    if name.startswith("char["):
        assert name == f"char[{len(content)}]"
        return content.decode("utf-8")
    (value,) = struct.unpack("<" + CODES[name], content)
    return value


def read(path: Path) -> Log:
    return parse(path.read_bytes())


def parse(content: bytes) -> Log:
    assert content[:8] == b"ULog\x01\x12\x35\x01"
    log = Log(struct.unpack_from("<Q", content, 8)[0])
    at = 16
    first, in_data = True, False
    while at < len(content):
        if len(content) - at < 3 or len(content) - at - 3 < struct.unpack_from("<H", content, at)[0]:
            log.left_over = len(content) - at
            break
        size, kind = struct.unpack_from("<Hc", content, at)
        body = content[at + 3 : at + 3 + size]
        at += 3 + size
        assert first == (kind == b"B"), "the flag bits come first, and once"
        first = False
        in_data = in_data or kind in b"AL"
        take(log, kind.decode(), body, in_data)
    return log


def take(log: Log, kind: str, body: bytes, in_data: bool) -> None:
    if kind == "B":
        assert body == bytes(40)
    elif kind == "F":
        assert not in_data
        name, _, fields = body.decode("ascii").partition(":")
        assert re.fullmatch(r"[a-zA-Z0-9_\-/]+", name) and name not in log.formats
        found = [FIELD.fullmatch(part) for part in fields.removesuffix(";").split(";")]
        assert all(found)
        log.formats[name] = [(m[1], int(m[2] or 1), m[3]) for m in found if m]
        assert log.formats[name][0] == ("uint64_t", 1, "timestamp")
    elif kind in "IP":
        match = KEY.fullmatch(body[1 : 1 + body[0]])
        assert match
        key, value = match[2].decode(), value_of(match[1], body[1 + body[0] :])
        if kind == "I":
            assert key not in log.info and not in_data
            log.info[key] = value
        elif in_data:
            log.changed.append((key, value))
        else:
            assert match[1] in {b"float", b"int32_t"} and key not in log.parameters
            log.parameters[key] = value
    elif kind == "M":
        match = KEY.fullmatch(body[2 : 2 + body[1]])
        assert match
        parts = log.long_info.setdefault(match[2].decode(), [])
        assert body[0] == bool(parts)
        parts.append(value_of(match[1], body[2 + body[1] :]))
    elif kind == "A":
        multi, number = struct.unpack_from("<BH", body)
        assert multi == 0 and number == len(log.numbers)
        name = body[3:].decode()
        assert name in log.formats
        log.numbers[number] = name
        log.data[name] = []
    elif kind == "D":
        name = log.numbers[struct.unpack_from("<H", body)[0]]
        layout = "<" + "".join(CODES[basic] * count for basic, count, _ in log.formats[name])
        record = struct.unpack(layout, body[2:])
        assert not log.data[name] or record[0] >= log.data[name][-1][0], f"time steps back in {name}"
        log.data[name].append(record)
    elif kind == "L":
        assert body[:1] in b"01234567"
        log.texts.append((body[0] - ord("0"), struct.unpack_from("<Q", body, 1)[0], body[9:].decode("utf-8")))
    elif kind == "S":
        assert body == bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
        log.syncs += 1
    else:
        assert kind == "O"
        log.dropouts_ms += struct.unpack("<H", body)
