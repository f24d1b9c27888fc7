"""Suggested input sequence that separates hypotheses, with its expected evidence: as CSV, text and JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENOUGH = 23.0
"""Expected log likelihood difference in nats that separates two models. With mean m its standard deviation is sqrt(2 m). From m = 14 on
m - 2 sqrt(2 m) exceeds the 3 nats of `selection/ties`, and the fit uses six tenths of a recording: 14 / 0.6 = 23."""

NAMED = 4
"""Number of hypotheses that are listed one by one."""


@dataclass(frozen=True)
class Suggestion:
    """u: (T, nu), one sample per step dt; None if no sequence within the bounds suffices, with the reason in `refused`.

    bounds: of the inputs, `seen` in the recording or given. tied: it separates competing hypotheses of a result; else the whole library.
    pairs: (one, other, nats) that it separates, the closest first; never: pairs, or effects, that no sequence within the bounds shows.
    begin: start of the robot; farthest, ends: distance from it at most, and at the end, m (without a planar pose: shares of the region).
    """

    inputs: tuple[str, ...]
    dt: float
    bounds: dict[str, tuple[float, float]]
    seen: bool
    tied: bool
    u: Array | None = None
    refused: str = ""
    pairs: tuple[tuple[str, str, float], ...] = ()
    never: tuple[str, ...] = ()
    begin: tuple[tuple[str, float], ...] = ()
    farthest: float = 0.0
    ends: float = 0.0
    metres: bool = True

    @property
    def nats(self) -> float:
        """Expected log likelihood difference of the closest pair."""
        return self.pairs[0][2] if self.pairs else 0.0

    @property
    def rows(self) -> int | None:
        """Number of samples after which the closest pair is separated; the sequence may have to be repeated."""
        return math.ceil(len(self.u) * ENOUGH / self.nats) if self.u is not None and self.nats > 0.0 else None

    def to_csv(self) -> str:
        """Columns `t` in s and the inputs, zero-order hold."""
        if self.u is None:
            raise ValueError(self.refused)
        lines = [",".join(("t", *self.inputs))]
        lines += [",".join([f"{k * self.dt:.9g}", *(f"{value:.9g}" for value in row)]) for k, row in enumerate(self.u.tolist())]
        return "\n".join(lines) + "\n"

    def to_json(self, file: str | None) -> dict[str, Any]:
        """`suggested_sequence` of docs/json.md."""
        return {
            "file": file if self.u is not None else None,
            "refused": self.refused or None,
            "duration_s": 0.0 if self.u is None else len(self.u) * self.dt,
            "bounds": {name: list(ends) for name, ends in self.bounds.items()},
            "bounds_from": "recording" if self.seen else "profile",
            "separation_nats": self.nats,
            "rows_until_separable": self.rows,
            "pairs": [{"one": a, "other": b, "nats": nats} for a, b, nats in self.pairs],
            "never": list(self.never),
            "begin": dict(self.begin),
            "farthest": self.farthest,
            "ends": self.ends,
        }

    def text(self) -> str:
        """Bounds, expected evidence and displacement, one line each."""
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The lines of `text`."""
        if self.u is None:
            return [f"no inputs are suggested: {self.refused}"]
        within = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in self.bounds.items())
        lines = [
            f"{len(self.u) * self.dt:.4g} s, {len(self.u)} rows, within {within}{' (the range seen in the recording)' if self.seen else ''}"
        ]
        lines += self._evidence(len(self.u))
        if self.never:
            rest = f" and {len(self.never) - NAMED} more" if len(self.never) > NAMED else ""
            lines.append(f"no inputs within these bounds {'separate' if self.tied else 'show'} {'; '.join(self.never[:NAMED])}{rest}")
        at = ", ".join(f"{name} = {value:.3g}" for name, value in self.begin)
        where = f"moves at most {self.farthest:.2g} m away and ends {self.ends:.2g} m from the start"
        room = f"uses {100.0 * self.farthest:.0f} % of its range and ends within {100.0 * self.ends:.0f} % of it"
        return [*lines, f"start at rest{f' at {at}' if at else ''}; the robot {where if self.metres else room}"]

    def _evidence(self, steps: int) -> list[str]:
        """Expected evidence of a sequence of n steps, one line each."""
        if not self.pairs:
            return []
        one, other, nats = self.pairs[0]
        if not self.tied:
            sure = sum(1 for *_, nats in self.pairs if nats >= ENOUGH)
            return [f"it separates {sure} of {len(self.pairs)} pairs of effects (`no effect` counts as one)"]
        closest = f", the closest of {len(self.pairs)} pairs" if len(self.pairs) > 1 else ""
        expected = [f"expected evidence: {_nats(nats)} nats between {one} and {other}{closest}"]
        again = f": repeat it {math.ceil(ENOUGH / nats)} times" if nats < ENOUGH else ""
        return [*expected, f"{ENOUGH:g} nats separate them, which takes about {math.ceil(steps * ENOUGH / nats)} rows{again}"]


def _nats(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
