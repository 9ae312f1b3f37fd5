"""The messages of one row of the record: those of all step topics in one piece, far cheaper than each by itself.

Most of a row goes into the log as it is: its bytes are cut where the topics part and put behind the heads of the
messages. Only what is logged with less than double precision, or derived, is a number on the way.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Any, Final

from companion.record.columns import COLUMN_INDEX, COLUMNS
from companion.record.ulog import Number, Series, Topic

_ROW = struct.Struct(f"={len(COLUMNS)}d")
_BYTES: Final = 8  # of a number in a row
_LITTLE_ENDIAN: Final = sys.byteorder == "little"
"""Whether a row's bytes are a log's."""


class RowSeries:
    """Makes the data messages (D) of topics of which every row gives one record each.

    Args:
        series: of the topics, in the order of their messages. They are this object's from now on.
        derived: the numbers of the topics that are no column of the record.
    """

    def __init__(self, series: Sequence[Series], derived: Sequence[str]) -> None:
        self._series = [(one, _getter(one.topic, derived)) for one in series]
        self._last_us = 0
        parts = [(one, _pieces(one.topic)) for one in series]
        pieces = [piece for _, some in parts for piece in some]
        edges = {edge for piece in pieces if isinstance(piece, range) for edge in (piece.start, piece.stop)}
        cuts = [range(*pair) for pair in pairwise(sorted({0, len(COLUMNS), *edges}))]
        rounded = {piece[1] for piece in pieces if not isinstance(piece, range)}
        self._heads = [one.head for one in series]
        self._cut = struct.Struct("=" + "".join(f"{_BYTES * len(cut)}s" for cut in cuts)).unpack
        self._numbers = struct.Struct("=" + "".join("d" if name in rounded else "8x" for name in COLUMNS)).unpack

        sources = ("t_us", *self._heads, *cuts, *(name for name in COLUMNS if name in rounded), *derived)
        place = {source: index for index, source in enumerate(sources)}
        layout, order = "<", []
        for one, some in parts:
            layout += f"{len(one.head)}sQ"
            order += [place[one.head], place["t_us"]]
            for piece in some:
                layout += f"{_BYTES * len(piece)}s" if isinstance(piece, range) else piece[0]
                order.append(place[piece if isinstance(piece, range) else piece[1]])
        self._order = itemgetter(*order)
        self._pack = struct.Struct(layout).pack

    def encode(self, t_us: int, row: bytes, derived: Sequence[Number]) -> bytes:
        """The messages of a row, as `Series.encode` makes them of its numbers one after the other.

        Args:
            t_us: vehicle time [us]; where it is before the last row's, that one's is taken.
            row: doubles in the order of `columns.COLUMNS`.
            derived: the derived numbers.

        Raises:
            struct.error: not a row, or a time that no log can hold.
        """
        t_us = max(t_us, self._last_us)
        try:
            sources = (t_us, *self._heads, *self._cut(row), *self._numbers(row), *derived)
            messages = self._pack(*self._order(sources)) if _LITTLE_ENDIAN else self._one_by_one(t_us, row, derived)
        except (struct.error, OverflowError):  # something does not fit its type
            messages = self._one_by_one(t_us, row, derived)
        self._last_us = t_us
        return messages

    def _one_by_one(self, t_us: int, row: bytes, derived: Sequence[Number]) -> bytes:
        numbers = (*_ROW.unpack(row), *derived)
        return b"".join([series.encode(t_us, values(numbers)) for series, values in self._series])


def _getter(topic: Topic, derived: Sequence[str]) -> itemgetter[Any]:
    """Takes a topic's numbers out of a row with the derived numbers behind it."""
    places = {name: index for index, name in enumerate((*COLUMNS, *derived))}
    return itemgetter(*[places[name] for name in _names(topic)])


def _names(topic: Topic) -> list[str]:
    return [name for field in topic.fields for name in field.columns]


def _pieces(topic: Topic) -> list[range | tuple[str, str]]:
    """What a record consists of, in its order: stretches of a row, and numbers by their `struct` code and name."""
    pieces: list[range | tuple[str, str]] = []
    for code, name in zip(topic.codes, _names(topic), strict=True):
        place = COLUMN_INDEX.get(name)
        last = pieces[-1] if pieces else None
        if code != "d" or place is None:
            pieces.append((code, name))
        elif isinstance(last, range) and last.stop == place:
            pieces[-1] = range(last.start, place + 1)
        else:
            pieces.append(range(place, place + 1))
    return pieces
