"""Comparison of two controllers: what is shown, when it stops, and that it may be read after every pair."""

from __future__ import annotations

import math

import numpy as np
import pytest

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.betting import COMPARISON_BETS
from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.paired_comparison import compare, statement
from s2r_runtime.evidence.scores import SAFE, Score, merits


def outcomes(p: float, n: int, seed: int) -> np.ndarray:
    return (np.random.default_rng(seed).random(n) < p).astype(np.float64)


def by_counts(for_b: int, against_b: int) -> float:
    """The capital at delta = 0 from the numbers of discordant pairs alone: each bet gains 1 + t or loses 1 - t."""
    pairs = zip(COMPARISON_BETS.t, COMPARISON_BETS.weights, strict=True)
    return float(sum(w * (1.0 + t) ** against_b * (1.0 - t) ** for_b for t, w in pairs))


def test_evidence_at_delta_zero_depends_on_the_discordant_pairs_alone() -> None:
    a, b = outcomes(0.8, 60, 1), outcomes(0.5, 60, 2)
    found = compare(a, b)
    best = max(by_counts(int(np.sum(b[:n] > a[:n])), int(np.sum(a[:n] > b[:n]))) for n in range(61))
    assert found.e_worse == pytest.approx(best)
    assert found.agree == int(np.sum(a == b))
    kept = a != b
    assert compare(a[kept], b[kept]).e_worse == pytest.approx(found.e_worse)


def test_it_stops_at_the_first_pair_at_which_the_answer_is_shown() -> None:
    a, b = outcomes(0.9, 300, 3), outcomes(0.4, 300, 4)
    found = compare(a, b)
    assert found.answer == "worse"
    assert 0 < found.decided_at < 100
    assert compare(a[: found.decided_at], b[: found.decided_at]).answer == "worse"
    assert compare(a[: found.decided_at - 1], b[: found.decided_at - 1]).answer == "undecided"
    assert 0.0 < found.lower < 0.5 < found.upper
    assert found.e_required == pytest.approx(40.0)


def test_the_better_controller_is_found_whichever_is_named_first() -> None:
    a, b = outcomes(0.4, 300, 5), outcomes(0.9, 300, 6)
    there, back = compare(a, b), compare(b, a)
    assert (there.answer, back.answer) == ("not worse", "worse")
    assert there.decided_at == back.decided_at
    assert there.lower == pytest.approx(-back.upper)
    assert there.e_not_worse == pytest.approx(back.e_worse)


def test_equal_controllers_are_not_worse_by_more_than_a_margin() -> None:
    a, b = outcomes(0.9, 400, 7), outcomes(0.9, 400, 8)
    assert compare(a, b).answer == "undecided"
    found = compare(a, b, delta=0.15)
    assert found.answer == "not worse"
    assert not found.better
    assert found.e_not_worse >= found.e_better
    assert found.upper < 0.15


def test_identical_runs_show_a_margin_after_the_number_that_the_proof_states() -> None:
    """n equal pairs show a loss below delta at the earliest where (1 - delta)^n <= beta / 2."""
    least = math.ceil(math.log(0.025) / math.log(0.9))
    found = compare(np.ones(300), np.ones(300), delta=0.1)
    assert found.answer == "not worse"
    assert least <= found.decided_at <= 3 * least


@pytest.mark.parametrize(("p", "q", "delta"), [(0.5, 0.5, 0.0), (0.9, 0.9, 0.0), (0.7, 0.6, 0.1)])
def test_looks_after_every_pair_are_wrong_no_more_often_than_beta(p: float, q: float, delta: float) -> None:
    """At the true difference both answers are false. The exact 99.9 % lower limit of the miss rate is at most beta."""
    rng, repetitions, beta = np.random.default_rng(9), 150, 0.2
    missed = 0
    for _ in range(repetitions):
        a, b = (rng.random(80) < p).astype(np.float64), (rng.random(80) < q).astype(np.float64)
        missed += compare(a, b, delta=delta, beta=beta).answer != "undecided"
    assert clopper_pearson_lower(missed, repetitions, 1e-3) <= beta


def test_scores_that_are_worse_when_higher_are_turned_round() -> None:
    time = Score("time", 0.0, 60.0, better="low")
    fast, slow = np.full(60, 20.0), np.full(60, 50.0)
    found = compare(merits(fast, time)[0], merits(slow, time)[0])
    assert found.answer == "worse"
    assert found.difference == pytest.approx(0.5)


def test_a_score_outside_its_range_counts_as_the_worst_value_and_gets_one_line() -> None:
    given = [0.5, math.nan, 3.0, -0.2]
    found, lines = merits(given, Score("progress", 0.0, 2.0))
    assert list(found) == [0.25, 0.0, 0.0, 0.0]
    assert lines == (
        "3 of 4 values of 'progress' are outside the declared range 0 to 2 (the first: nan in run 2); each counts as the worst value, 0",
    )
    assert list(merits([5.0], Score("time", 0.0, 2.0, "low"))[0]) == [0.0]
    best, lines = merits([[0.5, 9.0]], Score("time", 0.0, 2.0, "low"), simulated=True, what="rollout")
    assert list(best[0]) == [0.75, 1.0]
    assert "the first: 9 in rollout 2); each counts as the best value, 0" in lines[0]
    assert merits([0.0, 1.0], SAFE)[1] == ()


def test_a_range_that_is_empty_is_refused() -> None:
    with pytest.raises(UsageError, match="must be finite and ascending"):
        Score("progress", 1.0, 1.0)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(NotEnoughEvidence, match="no pairs"):
        compare(np.zeros(0), np.zeros(0))
    with pytest.raises(UsageError, match="one of each for each pair"):
        compare(np.zeros(2), np.zeros(3))
    with pytest.raises(UsageError, match="delta"):
        compare(np.zeros(2), np.zeros(2), delta=1.0)


def test_the_statement_begins_with_the_answer() -> None:
    worse = compare(outcomes(0.9, 300, 3), outcomes(0.4, 300, 4), delta=0.1)
    assert statement(worse, "old.py", "new.py").startswith("new.py is worse than old.py by more than 0.1 (confidence 95 %, shown at pair ")
    even = compare(outcomes(0.5, 20, 3), outcomes(0.5, 20, 4))
    assert statement(even, "old.py", "new.py").startswith(
        "Not decided after 20 pairs whether new.py is worse than old.py: drive more pairs."
    )
    better = compare(outcomes(0.2, 200, 3), outcomes(0.9, 200, 4))
    assert statement(better, "old.py", "new.py").startswith("new.py is better than old.py (confidence 95 %")


def test_an_unknown_score_never_helps_to_show_anything() -> None:
    """Whatever the score would have been, nothing is shown that would not have been shown with it."""
    rng = np.random.default_rng(11)
    for seed in range(20):
        a, b = outcomes(0.8, 60, 100 + seed), outcomes(0.5, 60, 200 + seed)
        unknown_a, unknown_b = rng.random(60) < 0.1, rng.random(60) < 0.2
        found = compare(np.where(unknown_a, np.nan, a), np.where(unknown_b, np.nan, b), delta=0.1)
        for _ in range(5):
            filled = np.where(unknown_a, rng.random(60), a), np.where(unknown_b, rng.random(60), b)
            with_all = compare(*filled, delta=0.1)
            for name in ("e_worse", "e_not_worse", "e_better"):
                assert getattr(found, name) <= getattr(with_all, name) * (1.0 + 1e-9)
            assert found.lower <= with_all.lower + 1e-9
            assert found.upper >= with_all.upper - 1e-9
        assert found.censored == int(np.sum(unknown_a | unknown_b))


def test_a_comparison_of_unknown_scores_alone_shows_nothing() -> None:
    found = compare(np.full(50, np.nan), np.full(50, np.nan))
    assert (found.answer, found.a, found.difference, found.agree, found.censored) == ("undecided", 0.5, 0.0, 0, 50)
    assert (found.lower, found.upper) == (-1.0, 1.0)
