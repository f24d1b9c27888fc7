"""Pairs of runs of two controllers: from their logs by scenario or by order, or from a table of paired outcomes.

Which runs are a pair is decided by what was fixed before they ended: the seed and number of the scenario, or the order of driving.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from s2r_runtime.errors import NotEnoughEvidence, RecordingError
from s2r_runtime.evidence.scores import Score
from s2r_runtime.evidence.trials import Found, values_of
from s2r_runtime.files.bounded_file import MB, read_bounded
from s2r_runtime.recordings.units import number_of

TABLE_BYTES = 64 * MB
"""Largest table of outcomes, some million pairs."""
WORDS = {"true": 1.0, "false": 0.0}
"""Words that a cell may hold instead of a number."""

How = Literal["scenario", "order"]


class Pairs(NamedTuple):
    """Scores of A and B, one of each a pair. unpaired: runs that have no partner, of A and of B."""

    a: tuple[float, ...]
    b: tuple[float, ...]
    unpaired: tuple[int, int] = (0, 0)


def from_logs(a: Found, b: Found, score: Score, how: How) -> Pairs:
    """scenario: runs in scenarios of the same seed and number, in A's order. order: the k-th run of A with the k-th of B.

    Raises NotEnoughEvidence if there is no pair.
    """
    of_a, of_b = values_of(a, score), values_of(b, score)
    if how == "order":
        n = min(len(of_a), len(of_b))
        pairs = Pairs(tuple(of_a[:n]), tuple(of_b[:n]), (len(of_a) - n, len(of_b) - n))
    else:
        partner = {(run.seed, run.index): value for (run, _), value in zip(b.counted, of_b, strict=True)}
        keys = [(run.seed, run.index) for run, _ in a.counted]
        both = [(value, partner[key]) for key, value in zip(keys, of_a, strict=True) if key in partner]
        pairs = Pairs(tuple(x for x, _ in both), tuple(y for _, y in both), (len(of_a) - len(both), len(of_b) - len(both)))
    if not pairs.a:
        other = "; --pair order pairs them in the order of driving" if how == "scenario" and of_a and of_b else ""
        common = " in a common scenario (the same seed and number)" if other else ""
        raise NotEnoughEvidence(f"{len(of_a)} runs of A and {len(of_b)} of B count, none{common} to make a pair of{other}", 1)
    return pairs


def from_table(path: Path, a: str, b: str) -> Pairs:
    """Columns a and b of a CSV file, one pair a row. A cell is a number, true or false.

    Raises RecordingError for a file, a column or a cell that cannot be read, with its place; NotEnoughEvidence without rows.
    """
    try:
        text = read_bounded(path, TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: is not UTF-8 text, must be a CSV file") from None
    rows = csv.reader(io.StringIO(text))
    try:
        names = [name.strip() for name in next(rows, [])]
        columns = [_column(path, names, name) for name in (a, b)]
        read = [[_number(path, rows.line_num, row, names, k) for k in columns] for row in rows if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise RecordingError(f"{path}, line {rows.line_num}: is no row of a CSV file: {error}") from None
    if not read:
        raise NotEnoughEvidence(f"{path}: has no rows, at least one pair of outcomes is needed", 1)
    return Pairs(tuple(row[0] for row in read), tuple(row[1] for row in read))


def _column(path: Path, names: Sequence[str], name: str) -> int:
    if names.count(name) != 1:
        wrong = "no column" if name not in names else "more than one column"
        raise RecordingError(f"{path}: has {wrong} {name!r}; its columns are: {', '.join(names[:20]) or 'none'}")
    return names.index(name)


def _number(path: Path, line: int, row: Sequence[str], names: Sequence[str], column: int) -> float:
    cell = row[column].strip() if column < len(row) else ""
    if cell.lower() in WORDS:
        return WORDS[cell.lower()]
    try:
        return number_of(cell)
    except ValueError:
        found = repr(cell[:40]) if cell else "empty"
        raise RecordingError(f"{path}, line {line}: {names[column]} is {found}, must be a number, true or false") from None
