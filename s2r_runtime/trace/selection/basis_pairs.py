"""Two dictionaries that say little alone, and much together: gravity on a link hides that link's friction, and is hidden by it.

What one of them leaves beside the other looks like noise of some colour, so that neither is likelier than that noise. With z the whitened
residual, X_a and X_b the whitened dictionaries, K = [X_a X_b]' [X_a X_b] and s = [X_a X_b]' z, pairs are ranked by the evidence of K and
s (`evidence`), of the best dictionary of each token: one product for all of them. The best few are judged as any dictionary is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.selection.basis_evidence import Judged, Left, judge, leading
from s2r_runtime.trace.selection.evidence import evidence

Array = NDArray[np.float64]

JUDGED = 2
"""Pairs that are judged, after a first look under the model's own noise."""


def pairs(
    left: Left, looked: Sequence[tuple[float, int]], found: Sequence[tuple[str, Array]], least: float, adds: float
) -> list[list[Judged]]:
    """[both under the token of the first one, both under that of the second one] of pairs that explain `least` nats and a share of `adds`
    more together than the better one of them alone, at first look. looked: (nats, place in `found`), the best first.
    """
    best = _best_of_each(looked, found)
    if len(best) < 2 or best[0][0] <= least:
        return []
    alone = [nats for nats, _ in best]
    x = [leading(left, found[i][1]) for _, i in best]
    told = _together(left, x)
    enough = {(a, b): alone[a] + max(least, adds * alone[a]) for a, b in told}  # the first one of two is the better one
    ranked = sorted((pair for pair in told if told[pair] > enough[pair]), key=lambda pair: -told[pair])
    made = []
    for a, b in ranked[:JUDGED]:
        both = judge(left, found[best[b][1]][0], np.concatenate([x[a], x[b]], axis=2))
        made.append([replace(both, token=found[best[a][1]][0]), both])
    return made


def _best_of_each(looked: Sequence[tuple[float, int]], found: Sequence[tuple[str, Array]]) -> list[tuple[float, int]]:
    """The best dictionary of each token at first look, the best first."""
    first: dict[str, tuple[float, int]] = {}
    for nats, i in looked:
        first.setdefault(found[i][0], (nats, i))
    return list(first.values())


def _together(left: Left, x: Sequence[Array]) -> dict[tuple[int, int], float]:
    """Log evidence of each two of these dictionaries."""
    white = left.fit.whiten(np.concatenate(x, axis=2)).reshape(-1, sum(one.shape[2] for one in x))
    z = left.fit.z.ravel()
    root = np.sqrt(noises.weight(z))
    weighted = white * root[:, None]
    product, slope = weighted.T @ weighted, weighted.T @ (root * z)
    edges = np.cumsum([0, *(one.shape[2] for one in x)])
    own = [np.arange(edges[i], edges[i + 1]) for i in range(len(x))]
    both = {(a, b): np.concatenate([own[a], own[b]]) for a, b in combinations(range(len(x)), 2)}
    return {pair: evidence(product[np.ix_(at, at)], slope[at]).log for pair, at in both.items()}
