"""Is there structure in a residual that independent, zero-mean noise would not have? (guarantee G8: without an answer of no, a
certificate under the law `uniform` alone is refused, because such a law averages out what a real disturbance does not.)

e: (n, nx), one row a transition, for planar models turned into the body's axes at the start of the step (a lost share of the speed
has no mean in the world's axes). Three questions, each by a rank or normal statistic, so that the tails of e do not matter:

    mean    |mean_i| sqrt(n) / std_i                                            normal
    order   sum over lags l of n rho_l^2, rho_l rank autocorrelation            chi-square, 5 degrees
    input   rank correlation of e_i with each of u, |u|, u_j u_k, u_j |u_k|     normal, times sqrt(n-1)

The smallest p-value counts, times the number of tests (Bonferroni): noise alone is called structured with probability <= ALPHA.

Whether samples were independent is a question by itself (`serial_p`), about the discrepancy, which is what the gap bounds (guarantee
G1), and the residual, which has signs and so shows it sooner: the same statistic of order, with ranks shared among ties, for half of the
discrepancies may be the same number. Where the limit law leaves it open, its place among PERMUTATIONS seeded permutations counts, which is
exact for any law.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel

Array = NDArray[np.float64]

ALPHA = 1e-3
LAGS = 5
FEWEST = 30
"""Below this the statistics are not near their limit laws; then the answer is `not white`, for nothing was shown."""

SERIAL_ALPHA = 5e-3
"""Of campaigns whose samples are independent, this share is refused. Small enough to be rare; large enough that whoever repeats campaigns
with dependent samples until one is accepted still gets a wrong gap with probability below beta = 5 %, for autoregressions of any
strength (tools/bench_missions.py)."""
PERMUTATIONS = 1999
PERMUTED_AT_ONCE = 1_000_000
"""Numbers, 8 MB."""
MANY = 20_000
"""Samples with which the limit law is as good as the permutations."""
CERTAIN, RARE = 1e-3, 5.0
"""Times what matters: p-values by the limit law between which the permutations are made."""
DEPENDENT = "depends on the one before"
"""Stands in the reason where the order of the samples matters: they were hardly drawn independently."""


class Whiteness(NamedTuple):
    """`reason` is empty iff `white`; it holds the phrase DEPENDENT if the order of the samples matters."""

    white: bool
    reason: str


def whiteness(model: ComposedModel, x0: Array, u: Array, e: Array, *, first_lag: int = 1) -> Whiteness:
    """x0, e: (n, nx); u: (n, nu). first_lag 2: neighbours share a measurement (one transition begins where the last ended)."""
    n = len(e)
    if n < FEWEST + LAGS:
        return Whiteness(False, f"{n} transitions are too few to tell")
    e = body_axes(model, x0, e)
    found: list[tuple[float, str]] = []
    ranked: list[tuple[str, Array]] = []
    for column, state in enumerate(model.states):
        values = e[:, column]
        if np.max(np.abs(values)) <= 1e-12 * max(1.0, float(np.max(np.abs(x0[:, column])))):
            continue  # rounding
        ranks = _ranks(values)
        found.append((_normal_p(_mean_score(values)), f"the mean of the residual in {state} is {np.mean(values):.3g}, not zero"))
        if np.ptp(ranks) > 0.0:
            found.append((_serial_p(ranks, first_lag), f"the residual in {state} {DEPENDENT}"))
            ranked.append((state, ranks))
    score = math.sqrt(n - 1)
    for name, r in _input_terms(model, u) if ranked else ():
        found += [(_normal_p(score * _correlation(ranks, r)), f"the residual in {state} depends on {name}") for state, ranks in ranked]
    structure = sorted((DEPENDENT not in reason, p, reason) for p, reason in found if p * len(found) < ALPHA)
    return Whiteness(False, structure[0][2]) if structure else Whiteness(True, "")


def serial_p(d: Array, *, clear: float = SERIAL_ALPHA) -> float:
    """How likely a statistic of order as large as that of d (n,), in the order of the samples, is among independent ones; 1 for too few.

    clear: what matters is whether it is below this; far on either side of it the limit law is good enough.
    """
    n = len(d)
    ranks = _ranks(d)
    if n < FEWEST + LAGS or np.ptp(ranks) == 0.0:
        return 1.0
    limit = _serial_p(ranks, 1)
    if n > MANY or not CERTAIN * clear <= limit <= RARE * clear:
        return limit
    observed, larger, rng = _serial_statistic(ranks[None, :], 1)[0], 0, np.random.default_rng(0)
    for size in np.diff(np.linspace(0, PERMUTATIONS, 2 + PERMUTATIONS * n // PERMUTED_AT_ONCE).astype(int)):
        shuffled = rng.permuted(np.broadcast_to(ranks, (size, n)), axis=1)
        larger += int(np.count_nonzero(_serial_statistic(shuffled, 1) >= observed * (1.0 - 1e-12)))
    return (1.0 + larger) / (1.0 + PERMUTATIONS)


def body_axes(model: ComposedModel, x0: Array, e: Array) -> Array:
    """e (n, nx) with its (x, y) part turned by -theta, where the model has such states."""
    if not {"x", "y", "theta"} <= set(model.states):
        return e
    x, y, theta = (model.states.index(name) for name in ("x", "y", "theta"))
    c, s = np.cos(x0[:, theta]), np.sin(x0[:, theta])
    turned = e.copy()
    turned[:, x] = c * e[:, x] + s * e[:, y]
    turned[:, y] = c * e[:, y] - s * e[:, x]
    return turned


def _input_terms(model: ComposedModel, u: Array) -> Iterator[tuple[str, Array]]:
    """(name, ranks (n,)) of the terms of u that vary, one after the other."""
    for name, values in _terms(model, u):
        if np.ptp(values) > 0.0:
            yield name, _ranks(values)


def _terms(model: ComposedModel, u: Array) -> Iterator[tuple[str, Array]]:
    for j, name in enumerate(model.inputs):
        yield name, u[:, j]
        yield f"|{name}|", np.abs(u[:, j])
    for (j, a), (k, b) in itertools.permutations(enumerate(model.inputs), 2):
        yield f"{a}*|{b}|", u[:, j] * np.abs(u[:, k])
        if j < k:
            yield f"{a}*{b}", u[:, j] * u[:, k]


def _ranks(values: Array) -> Array:
    """Ranks, ties sharing their mean, centred; (n,). Shared ranks keep a quantised sensor from looking ordered."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2.0)[place] - (len(values) + 1) / 2.0)


def _correlation(a: Array, b: Array) -> float:
    scale = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / scale if scale > 0.0 else 0.0


def _mean_score(values: Array) -> float:
    spread = float(np.std(values))
    mean = float(np.mean(values))
    if spread == 0.0:
        return math.inf if mean else 0.0
    return mean * math.sqrt(len(values)) / spread


def _serial_p(ranks: Array, first_lag: int) -> float:
    from scipy.special import gammaincc

    return float(gammaincc(LAGS / 2.0, _serial_statistic(ranks[None, :], first_lag)[0] / 2.0))


def _serial_statistic(ranks: Array, first_lag: int) -> Array:
    """(m, n) centred ranks -> (m,): sum over lags of n rho_l^2."""
    total = np.einsum("mn,mn->m", ranks, ranks)
    lags = range(first_lag, first_lag + LAGS)
    return np.asarray(sum(ranks.shape[1] * (np.einsum("mn,mn->m", ranks[:, lag:], ranks[:, :-lag]) / total) ** 2 for lag in lags))


def _normal_p(z: float) -> float:
    return math.erfc(abs(z) / math.sqrt(2.0))
