"""Comparison of two controllers on common scenarios, which may be read after every pair of runs (guarantee G14).

D_i = merit of A - merit of B in pair i, in [-1, 1] (`scores`); delta: the largest loss that does not matter, in the same unit.

    null hypothesis                          capital (`betting.log_capital`)     refuted: what is shown
    E[D_i | earlier pairs] <= delta, all i   of D against delta                  B is worse than A by more than delta
    E[D_i | earlier pairs] >= delta, all i   of -D against -delta                B is not worse than A by more than delta
    E[D_i | earlier pairs] >= -delta, all i  of -D against delta                 A is worse than B by more than delta

Each capital is an e-process under its null hypothesis, whatever the dependence of A and B within a pair. It is compared with 2/beta. The
second capital is never below the third one, so together they spend beta/2 (Ville), and the first one spends the other half. Nothing that
is shown is wrong with probability 1-beta, however often one looks and whenever one stops.

A score that nobody knows (a run that was cut) lies anywhere in its range. The first capital takes the least D, which is worst for it; the
others take the largest one. So each stays an e-process whatever the run would have scored and for whatever reason it was cut.

With outcomes 0 and 1 and delta = 0 the factor of a pair is 1 + t, 1 - t, or 1 where both did alike. This is the sequential sign test of
the discordant pairs. Under independent scenarios of equal number it is within 2 % of the growth of the two-sample e-values of
R. Turner, A. Ly & P. Grünwald (*Generic e-variables for exact sequential k-sample tests*, JSPI 2024) where success rates differ by 0.2
or less. Those need independence of A and B; this one does not, and gains where common scenarios make them alike.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.betting import COMPARISON_BETS, log_capital, lower_limit
from s2r_runtime.evidence.bounds import check_probability
from s2r_runtime.evidence.scores import Score
from s2r_runtime.evidence.statements import bound

Array = NDArray[np.float64]
Answer = Literal["worse", "not worse", "undecided"]


class Comparison(msgspec.Struct, frozen=True):
    """What n pairs show. answer: of B against A, from the first pair at which one was shown (`decided_at`; 0: none yet).

    difference: mean of A - B in the score's unit, with its limits `lower` and `upper`, valid at all times. e_worse, e_not_worse, e_better:
    largest capital so far for "B is worse than A by more than delta", "B is not", and "A is worse than B by more than delta". e_required:
    the capital at which one is shown. a, b: mean scores, an unknown one at the middle of its range. agree: pairs of equal scores. censored:
    pairs with a score that nobody knows.
    """

    answer: Answer
    decided_at: int
    better: bool
    n: int
    agree: int
    a: float
    b: float
    difference: float
    lower: float
    upper: float
    delta: float
    beta: float
    e_worse: float
    e_not_worse: float
    e_better: float
    e_required: float
    censored: int = 0


def compare(merits_a: Array, merits_b: Array, *, delta: float = 0.0, beta: float = 0.05) -> Comparison:
    """What the pairs show. merits_a, merits_b: (n,) in [0, 1], 1 the best, in the order of the pairs; NaN: not known. delta: in [0, 1).

    Raises NotEnoughEvidence without pairs, UsageError for arrays that do not fit or settings out of range.
    """
    check_probability("beta", beta)
    if not 0.0 <= delta < 1.0:
        raise UsageError(f"delta is {delta:g} of the score's range, must be at least 0 and below 1")
    if merits_a.shape != merits_b.shape or merits_a.ndim != 1:
        raise UsageError(f"{merits_a.shape} scores of A and {merits_b.shape} of B, must be one of each for each pair")
    n = len(merits_a)
    if n == 0:
        raise NotEnoughEvidence("no pairs of runs, at least one is needed", 1)
    (a_low, a_high), (b_low, b_high) = _ranges(merits_a), _ranges(merits_b)
    least, most = a_low - b_high, a_high - b_low
    worse, not_worse, better = (
        np.maximum.accumulate(log_capital(x, -1.0, mean, COMPARISON_BETS)) for x, mean in ((least, delta), (-most, -delta), (-most, delta))
    )
    required = math.log(2.0 / beta)
    first = {
        name: int(np.argmax(log >= required)) + 1 if log[-1] >= required else 0 for name, log in (("worse", worse), ("not", not_worse))
    }
    answer: Answer = "undecided"
    if first["worse"] and not 0 < first["not"] < first["worse"]:
        answer = "worse"
    elif first["not"]:
        answer = "not worse"
    return Comparison(
        answer=answer,
        decided_at=first["worse"] if answer == "worse" else first["not"],
        better=bool(better[-1] >= required),
        n=n,
        agree=int(np.sum(merits_a == merits_b)),
        a=float(np.mean((a_low + a_high) / 2.0)),
        b=float(np.mean((b_low + b_high) / 2.0)),
        difference=float(np.mean((least + most) / 2.0)),
        lower=float(lower_limit(least, -1.0, beta / 2.0, -1.0, 1.0, COMPARISON_BETS)),
        upper=-float(lower_limit(-most, -1.0, beta / 2.0, -1.0, 1.0, COMPARISON_BETS)),
        delta=delta,
        beta=beta,
        e_worse=_capital(worse[-1]),
        e_not_worse=_capital(not_worse[-1]),
        e_better=_capital(better[-1]),
        e_required=2.0 / beta,
        censored=int(np.sum(np.isnan(merits_a) | np.isnan(merits_b))),
    )


def _ranges(merits: Array) -> tuple[Array, Array]:
    """Least and largest value that each merit may have."""
    unknown = np.isnan(merits)
    return np.where(unknown, 0.0, merits), np.where(unknown, 1.0, merits)


def in_unit(c: Comparison, score: Score) -> Comparison:
    """The same in the score's own unit instead of merits. The difference stays that of merits: positive where A is better."""
    value = {name: score.low + getattr(c, name) * score.spread for name in ("a", "b")}
    if score.better == "low":
        value = {name: score.high - getattr(c, name) * score.spread for name in ("a", "b")}
    scaled = {name: getattr(c, name) * score.spread for name in ("difference", "lower", "upper", "delta")}
    return msgspec.structs.replace(c, **value, **scaled)


def statement(c: Comparison, a: str, b: str, what: str = "success rate") -> str:
    """What the comparison shows, in one paragraph. a, b: names. what: the scores' name."""
    by = f" by more than {bound(c.delta)}" if c.delta > 0.0 else ""
    sure = f"{100.0 * (1.0 - c.beta):.4g} %"
    first = {
        "worse": f"{b} is worse than {a}{by} (confidence {sure}, shown at pair {c.decided_at} of {c.n}): stop.",
        "not worse": f"{b} is {f'not worse than {a}{by}' if by else f'better than {a}'} "
        f"(confidence {sure}, shown at pair {c.decided_at} of {c.n}): stop.",
        "undecided": f"Not decided after {c.n} pairs whether {b} is worse than {a}{by}: drive more pairs.",
    }[c.answer]
    also = f" In fact {a} is worse than {b}{by}." if c.better and by and c.answer == "not worse" else ""
    return (
        f"{first}{also} The mean {what} is {c.a:.3g} for {a} and {c.b:.3g} for {b}; with confidence {sure} the advantage "
        f"of {a} over {b} is between {c.lower:.3g} and {c.upper:.3g}. This may be read after every pair, and one may stop at any of them."
    )


def _capital(log: float) -> float:
    """Capital from its logarithm; the largest number where it is beyond."""
    return math.exp(min(float(log), 700.0))
