"""Rows of a table as they are read: checked block by block, stored as columns of numbers, thinned to a budget where there are too many.

Rows are grouped into units: runs of consecutive rows, or whole segments. Where all of them exceed the budget, every second unit is left
out, then every second one of the rest, and so on: which units remain depends on their number alone, and not on what is in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

UNITS = 64
"""Stretches that a thinned recording has at most; it has more than half as many."""
MAX_SEGMENT_ROWS = 65_536
"""Of a segment whose first rows count (a campaign's sample, with its hold): the later ones show nothing more."""


@dataclass(frozen=True)
class Subset:
    """Which rows of a long recording are used. rows: all of it; used: of these; stretches: (first, last) stamp of each, s, in order."""

    rows: int
    used: int
    stretches: tuple[tuple[float, float], ...]
    whole_segments: bool = False

    def text(self) -> str:
        """One sentence."""
        what = "whole segments" if self.whole_segments else "stretches of consecutive rows"
        return f"{self.used} of {self.rows} rows are used: {len(self.stretches)} {what}, evenly spread"

    def to_json(self) -> dict[str, object]:
        """Plain data; at most UNITS stretches are listed."""
        first = [list(one) for one in self.stretches[:UNITS]]
        return {"rows": self.rows, "used": self.used, "stretches": len(self.stretches), "stretches_s": first}


def joined(subsets: Sequence[Subset | None], rows: Sequence[int]) -> Subset | None:
    """The subset of several recordings together; rows: that are used of each. None if all rows of all are used."""
    there = [one for one in subsets if one is not None]
    if len(subsets) == 1 or not there:
        return subsets[0]
    total = sum(one.rows if one else n for one, n in zip(subsets, rows, strict=True))
    used = sum(one.used if one else n for one, n in zip(subsets, rows, strict=True))
    return Subset(total, used, tuple(span for one in there for span in one.stretches), there[0].whole_segments)


class RowStore:
    """Collects blocks of rows. width: number of columns besides the stamps; max_rows: budget, None for no limit; whole_segments: units are
    segments, and only their first MAX_SEGMENT_ROWS count.
    """

    def __init__(self, width: int, max_rows: int | None = None, *, whole_segments: bool = False) -> None:
        self._blocks: list[tuple[Counts, Counts | None, list[Array]]] = []
        self._width, self._max_rows = width, max_rows
        self._whole = whole_segments
        self._unit_rows = max(1, (max_rows or 1) // UNITS)
        self._stride = 1
        self._stored = 0
        self.rows = 0
        self._run = (-1, 0)
        """Segment of the last row, and its rows so far."""

    def add(self, t: Array, columns: Sequence[Array], segment: Counts | None) -> None:
        """The next block: t (n,), columns (n,) each, segment (n,)."""
        index = self.rows + np.arange(len(t))
        self.rows += len(t)
        if self._whole and segment is not None:
            kept, unit = self._within(segment), segment
        else:
            kept, unit = np.ones(len(t), dtype=bool), index // self._unit_rows
        self._store(kept & (unit % self._stride == 0), unit, segment, [t, *columns])
        while self._max_rows is not None and self._stored > self._max_rows and self._can_thin():
            self._thin()

    def _within(self, segment: Counts) -> NDArray[np.bool_]:
        """Rows that are among the first of their segment."""
        starts = np.flatnonzero(np.diff(segment, prepend=-1))
        place = np.arange(len(segment)) - np.repeat(starts, np.diff(np.append(starts, len(segment))))
        last, before = self._run
        if segment[0] == last:
            place[segment == last] += before
        self._run = (int(segment[-1]), int(place[-1]) + 1)
        return np.asarray(place < MAX_SEGMENT_ROWS)

    def _store(self, kept: NDArray[np.bool_], unit: Counts, segment: Counts | None, columns: list[Array]) -> None:
        if kept.all():
            self._blocks.append((unit, segment, columns))
        elif kept.any():
            self._blocks.append((unit[kept], None if segment is None else segment[kept], [column[kept] for column in columns]))
        self._stored += int(np.count_nonzero(kept))

    def _can_thin(self) -> bool:
        return int(self._blocks[-1][0][-1]) >= self._stride

    def _thin(self) -> None:
        self._stride *= 2
        blocks, self._blocks, self._stored = self._blocks, [], 0
        for unit, segment, columns in blocks:
            self._store(unit % self._stride == 0, unit, segment, columns)

    def end(self) -> tuple[Array, list[Array], Counts | None, Counts | None, Subset | None]:
        """(t (n,), columns, segment (n,), piece (n,), subset): all that is stored, once. piece: contiguous rows have the same number, None
        where all rows of a segment (or of the recording) are there.
        """
        columns: list[Array] = []
        for place in range(1 + self._width):
            columns.append(np.concatenate([block[2][place] for block in self._blocks]))
            for block in self._blocks:
                block[2][place] = np.empty(0)
        t = columns.pop(0)
        with_segment = [block[1] for block in self._blocks if block[1] is not None]
        segment = np.concatenate(with_segment) if with_segment else None
        if self._stride == 1:
            return t, columns, segment, None, None
        unit = np.concatenate([block[0] for block in self._blocks])
        starts = np.diff(unit, prepend=-1) != 0
        if segment is not None:
            starts |= np.diff(segment, prepend=-1) != 0
        piece = np.cumsum(starts) - 1
        first = np.flatnonzero(starts)
        last = np.append(first[1:], len(t)) - 1
        spans = tuple(zip(t[first].tolist(), t[last].tolist(), strict=True))
        return t, columns, segment, piece, Subset(self.rows, len(t), spans, self._whole and segment is not None)
