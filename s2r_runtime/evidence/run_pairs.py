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
from s2r_runtime.evidence.compared_runs import Compared, compared_values
from s2r_runtime.evidence.scores import Score
from s2r_runtime.files.bounded_file import MB, read_bounded
from s2r_runtime.recordings.units import number_of

TABLE_BYTES = 64 * MB
"""Largest table of outcomes, some million pairs."""
WORDS = {"true": 1.0, "false": 0.0}
"""Words that a cell may hold instead of a number."""

How = Literal["scenario", "order"]


class Pairs(NamedTuple):
    """Scores of A and B, one of each a pair; None for a censored run. unpaired: runs without a partner, of A and of B."""

    a: tuple[float | None, ...]
    b: tuple[float | None, ...]
    unpaired: tuple[int, int] = (0, 0)


def from_logs(a: Compared, b: Compared, score: Score, how: How) -> Pairs:
    """scenario: runs in scenarios of the same seed and number, in A's order. order: the k-th run of A with the k-th of B.

    A censored run without a partner is a pair of two unknown scores, so that cutting a run short before its partner drives gains nothing.
    Raises NotEnoughEvidence if there is no pair.
    """
    of_a, of_b = compared_values(a, score), compared_values(b, score)
    if how == "order":
        n = min(len(of_a), len(of_b))
        pairs = Pairs(tuple(of_a[:n]), tuple(of_b[:n]), (len(of_a) - n, len(of_b) - n))
    else:
        in_a, in_b = (
            {(run.seed, run.index): value for (run, _), value in zip(one.runs, values, strict=True)}
            for one, values in ((a, of_a), (b, of_b))
        )
        keys = [key for key in (*in_a, *in_b) if (key in in_a and key in in_b) or in_a.get(key, in_b.get(key)) is None]
        keys = list(dict.fromkeys(keys))
        alone = (len(in_a) - sum(key in in_a for key in keys), len(in_b) - sum(key in in_b for key in keys))
        pairs = Pairs(tuple(in_a.get(key) for key in keys), tuple(in_b.get(key) for key in keys), alone)
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
