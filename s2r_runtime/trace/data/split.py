"""Which transitions the fit sees, and which it never does.

Of one run two stretches are held out, one of them the end (HELD_OUT); of several runs, whole runs drawn by the seed (TEST_SHARE). Where
the inputs of one side do not reach as far as those of the other, other stretches, or runs, are held out on which they do (TENTHS,
DRAWS): an end stop that only one side meets would be found and not confirmed, or not found. What the robot did then is not looked at.
The inputs of a run are kept from its beginning: a wide play never forgets, and a slow process hardly. Long recordings are thinned for the
fit: blocks of contiguous steps, evenly spread, each with the inputs before it from which hidden states settle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.data.dataset import Dataset, Run
from s2r_runtime.trace.estimation.prediction import Steps, first_steps, steps_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stretches = tuple[tuple[float, float], ...]

HELD_OUT = ((0.3, 0.5), (0.8, 1.0))
"""Parts of a run's time. Two, so that what the robot did, and what became of it, is seen early and late on both sides."""

TENTHS = 4
"""Tenths of a run's time that are held out, as much as in HELD_OUT."""

ENDS = (0.05, 0.15), (0.85, 0.95)
"""Middles of the tenths at the beginning, and at the end, of a run's time."""

DRAWS = 20
"""Draws of runs, the seed's own first."""

LOOKED_AT = 4000
"""Rows of inputs, evenly spread, by which ways are compared."""

REACH, SHORTER, LESS = 0.005, 0.07, 0.75
"""An input reaches as far as this share of its rows does, or more; and by this share of its range one side must fall shorter under the
first way than under another one, for that to be taken.
"""

TEST_SHARE = 0.4
"""Of the runs: as much as of one run's time."""

FEWEST_RUNS = 5
"""From so many runs on whole runs are held out."""

BLOCK = 500
"""Steps of a block when a long recording is thinned."""

SETTLE_S, SETTLE_STEPS = 3.0, (100, 600)
"""Inputs before a block, s, and least and most steps: hidden states have settled then, or nearly."""


@dataclass(frozen=True)
class Part:
    """Some of a dataset: steps that count, and (run, step) that do not although they are there."""

    data: Dataset
    steps: Steps
    left_out: tuple[tuple[int, int], ...]


def fit_mask(data: Dataset, seed: int, *, everything: bool = False) -> Mask:
    """(M,) steps, of the runs laid end to end, that the fit may see. everything: another recording is the judge."""
    spans = _spans(data)
    measured = _without(data, spans, set(), ())
    if everything:
        return measured
    u, rows = _rows(data, measured)
    ways: list[tuple[set[int], Stretches]]
    if len(data.runs) >= FEWEST_RUNS:
        rng, few = np.random.default_rng(seed), round(TEST_SHARE * len(data.runs))
        ways = [(set(rng.permutation(len(data.runs))[:few].tolist()), ()) for _ in range(DRAWS)]
    else:
        chosen = [HELD_OUT, *(tuple((k / 10.0, (k + 1) / 10.0) for k in tenths) for tenths in combinations(range(10), TENTHS))]
        ways = [
            (set(), stretches) for stretches in [HELD_OUT, *sorted(chosen, key=lambda way: (_pieces(way) < 2, _hides(way), _pieces(way)))]
        ]
    span = np.ptp(u, axis=0) if len(u) else np.ones(u.shape[1])
    u = u / np.where(span > 0.0, span, 1.0)
    shorter = np.array([_shorter(u, _without(data, spans, *way)[rows]) for way in ways])
    enough = np.flatnonzero(shorter <= shorter.min() + (SHORTER if shorter[0] <= shorter.min() + SHORTER else 0.5 * SHORTER))
    return _without(data, spans, *ways[int(enough[0])])


def _pieces(stretches: Stretches) -> int:
    """How many, those that touch taken as one: the longer they are, the longer a rollout can be judged."""
    return 1 + sum(before[1] < after[0] for before, after in pairwise(stretches))


def _hides(way: Stretches) -> bool:
    """Whether the first fifth of the time is held out, or the last: what changed since then, or only then, the fit would never see."""
    return any(all(any(a <= at < b for a, b in way) for at in ends) for ends in ENDS)


def _spans(data: Dataset) -> list[tuple[int, int]]:
    """(first step, steps) of each run, of all runs laid end to end, from its first measurement to its last."""
    found = []
    for begin, run in zip(first_steps(data).tolist(), data.runs, strict=False):
        there = np.flatnonzero(~np.isnan(run.y).any(axis=1))
        found.append((begin + int(there[0]), int(there[-1] - there[0])) if len(there) > 1 else (begin, 0))
    return found


def _without(data: Dataset, spans: list[tuple[int, int]], runs: set[int], stretches: Stretches) -> Mask:
    """(M,) steps from each run's first measurement to its last, less some runs, and less these parts of the time of every run."""
    seen = np.zeros(first_steps(data)[-1], dtype=bool)
    for i, (a, length) in enumerate(spans):
        if i in runs:
            continue
        seen[a : a + length] = True
        for first, last in stretches:
            seen[a + round(first * length) : a + round(last * length)] = False
    return seen


def _rows(data: Dataset, measured: Mask) -> tuple[Array, NDArray[np.int64]]:
    """Inputs (n, nu) of some of the steps that were measured, and which ones."""
    rows = np.flatnonzero(measured)
    rows = rows[:: max(1, len(rows) // LOOKED_AT)]
    return np.concatenate([run.u[:: data.substeps][: len(run.y) - 1] for run in data.runs])[rows], rows


def _shorter(u: Array, seen: Mask) -> float:
    """By how much an input (n, nu), over its range, falls short on one side of what it reaches on the other; the worst input and direction.
    What the fit does not reach counts in full, as it can't be found then; what the judge does not reach, LESS.
    """
    sides = [u[seen], u[~seen]]
    if not all(map(len, sides)):
        return 0.0
    ends = [np.sort(side, axis=0)[[int(REACH * len(side)), -1 - int(REACH * len(side))]] for side in sides]
    beyond = np.stack([ends[0][0] - ends[1][0], ends[1][1] - ends[0][1]])  # what is held out reaches farther: low, high
    return float(np.max(np.maximum(beyond, -LESS * beyond)))


def part(data: Dataset, left_out: tuple[tuple[int, int], ...], seen: Mask, most: int) -> Part:
    """The part of a dataset with these steps, at most about `most` of them."""
    runs: list[Run] = []
    out: list[tuple[int, int]] = []
    known = set(left_out)
    for run, early, kept in _kept(data, seen, most):
        given, end = data.runs[run], kept[-1][1]
        y = np.full((end + 1 - early, given.y.shape[1]), np.nan)
        for a, b in kept:
            y[a - early : b + 1 - early] = given.y[a : b + 1]
            out += [(len(runs), k - early) for k in range(a, b) if (run, k) in known] if known else []
        out += [(len(runs), a - 1 - early) for (_, before), (a, _) in pairwise(kept) if a == before + 1]
        lasts = None if given.lasts is None else given.lasts[early:end]
        turned = None if given.turned is None else given.turned[early:end] & (np.arange(early, end) < end - 1)[:, None]
        u = given.u[early * data.substeps : end * data.substeps]
        runs.append(Run(float(given.begins(data.dt)[early]), y, u, lasts, turned, given.segment))
    made = replace(data, runs=tuple(runs))
    return Part(made, steps_of(made, out), tuple(out))


def _kept(data: Dataset, seen: Mask, most: int) -> list[tuple[int, int, list[tuple[int, int]]]]:
    """(run, first step whose inputs are kept, [(first step, step after the last) of what is kept]), evenly over what may be seen."""
    begin = first_steps(data)
    stretches = []
    for run, (a, b) in enumerate(pairwise(begin.tolist())):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], seen[a:b].astype(np.int8), [0]])))
        stretches.append((run, [(int(p), int(q)) for p, q in zip(edges[::2], edges[1::2], strict=True)]))
    total = sum(q - p for _, kept in stretches for p, q in kept)
    if total <= most * 1.2:
        return [(run, 0, kept) for run, kept in stretches if kept]
    pieces = [(run, k, min(k + BLOCK, q)) for run, kept in stretches for p, q in kept for k in range(p, q, BLOCK)]
    count = max(1, round(most / (total / len(pieces))))
    chosen = np.unique(np.linspace(0, len(pieces) - 1, count).round().astype(int))
    settle = int(np.clip(SETTLE_S / data.dt, *SETTLE_STEPS))
    return [(run, max(0, a - settle), [(a, b)]) for run, a, b in (pieces[i] for i in chosen)]
