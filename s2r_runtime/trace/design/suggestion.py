"""A drive that would tell apart what a recording cannot, with what it promises: as a CSV, in words, as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENOUGH = 23.0
"""Nats that tell two models apart. A log likelihood difference of m nats on average scatters by sqrt(2 m): m - 2 sqrt(2 m) exceeds the
3 nats within which rivals tie from m = 14 on; and the fit sees six tenths of a recording."""

NAMED = 4
"""Things that are named one by one."""


@dataclass(frozen=True)
class Suggestion:
    """u: (T, nu), one row a step of dt; None if nothing within the bounds would do, and `refused` says why.

    bounds: of the inputs, `seen` in the recording or given. tied: it is about rivals that tie (or nearly); else about the whole library.
    pairs: (one, other, nats) of those it tells apart, the closest first; never: what nothing within the bounds tells apart, or shows.
    begin: where the robot should stand; farthest, ends: m from there at most, and at the end (without a planar pose: shares of the room).
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
        """Of the closest pair."""
        return self.pairs[0][2] if self.pairs else 0.0

    @property
    def rows(self) -> int | None:
        """After about so many rows of it, driven again and again if need be, the closest pair is told apart."""
        return math.ceil(len(self.u) * ENOUGH / self.nats) if self.u is not None and self.nats > 0.0 else None

    def to_csv(self) -> str:
        """`t` in s and the inputs; each row's are held until the next."""
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
        """What it is, what it promises, where the robot goes; a line each."""
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The lines of `text`."""
        if self.u is None:
            return [f"no drive is suggested: {self.refused}"]
        within = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in self.bounds.items())
        told = [
            f"{len(self.u) * self.dt:.4g} s, {len(self.u)} rows, within {within}{' (the range seen in the recording)' if self.seen else ''}"
        ]
        told += self._promise(len(self.u))
        if self.never:
            rest = f" and {len(self.never) - NAMED} more" if len(self.never) > NAMED else ""
            told.append(f"nothing within these bounds {'tells apart' if self.tied else 'shows'} {'; '.join(self.never[:NAMED])}{rest}")
        at = ", ".join(f"{name} = {value:.3g}" for name, value in self.begin)
        where = f"goes {self.farthest:.2g} m away at most and ends {self.ends:.2g} m from there"
        room = f"uses {100.0 * self.farthest:.0f} % of the room it has and ends within {100.0 * self.ends:.0f} %"
        return [*told, f"begin at rest{f' at {at}' if at else ''}; the robot {where if self.metres else room}"]

    def _promise(self, steps: int) -> list[str]:
        if not self.pairs:
            return []
        one, other, nats = self.pairs[0]
        if not self.tied:
            sure = sum(1 for *_, nats in self.pairs if nats >= ENOUGH)
            return [f"it tells {sure} of {len(self.pairs)} pairs of effects apart, no effect counted as one"]
        closest = f", the closest of {len(self.pairs)} pairs" if len(self.pairs) > 1 else ""
        told = [f"it promises {_nats(nats)} nats between {one} and {other}{closest}"]
        again = f": drive it {math.ceil(ENOUGH / nats)} times" if nats < ENOUGH else ""
        return [*told, f"{ENOUGH:g} nats tell them apart, which takes about {math.ceil(steps * ENOUGH / nats)} rows{again}"]


def _nats(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
