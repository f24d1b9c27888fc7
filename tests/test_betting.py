"""Betting sequences: never above what an exact game allows, the same as a slow computation, and valid where naive ones are not."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.betting import (
    COMPARISON_BETS,
    MEAN_BETS,
    RATES,
    Bets,
    log_capital,
    lower_limit,
    running_log_capital,
    running_mean_lower_limit,
    variations,
)
from s2r_runtime.evidence.bounds import clopper_pearson_lower


def slow_capital(x: list[float], least: list[float], mean: float, bets: Bets) -> list[float]:
    """The capital as products of plain numbers, run by run."""
    out = []
    for n in range(1, len(x) + 1):
        total = 0.0
        for t, weight in zip(bets.t, bets.weights, strict=True):
            wealth = float(weight)
            for score, floor in zip(x[:n], least[:n], strict=True):
                wealth *= 1.0 + float(t) * (score - mean) / (mean - floor)
            total += wealth
        out.append(total)
    return out


def test_capital_is_the_mixture_of_the_products_of_its_factors() -> None:
    rng = np.random.default_rng(1)
    x, least = rng.random(9), -rng.random(9)
    for bets in (MEAN_BETS, COMPARISON_BETS):
        assert np.exp(log_capital(x, least, 0.4, bets)) == pytest.approx(slow_capital(list(x), list(least), 0.4, bets))


@pytest.mark.parametrize("bets", [MEAN_BETS, COMPARISON_BETS, RATES])
def test_weights_are_shares_of_one(bets: Bets) -> None:
    assert float(np.sum(bets.weights)) == pytest.approx(1.0)
    assert np.all(bets.weights > 0.0)
    assert 0.0 < bets.t.min() < bets.t.max() <= 1.0


@pytest.mark.parametrize("mean", [0.1, 0.5, 0.9])
def test_expected_capital_is_one_at_the_hypothesised_mean(mean: float) -> None:
    """Exactly, over all 2^8 sequences of outcomes: a test martingale."""
    expected = 0.0
    for outcomes in product((0.0, 1.0), repeat=8):
        probability = float(np.prod([mean if y else 1.0 - mean for y in outcomes]))
        expected += probability * float(np.exp(log_capital(np.array(outcomes), 0.0, mean)[-1]))
    assert expected == pytest.approx(1.0)


def test_running_capital_is_no_more_than_one_in_expectation_whatever_the_past_decides() -> None:
    """Exactly, over all 2^8 sequences; the next mean depends on the last outcome, which no constant mean allows."""
    expected = 0.0
    for outcomes in product((0.0, 1.0), repeat=8):
        means = [0.2, *(0.7 if y else 0.1 for y in outcomes[:-1])]
        probability = float(np.prod([mean if y else 1.0 - mean for y, mean in zip(outcomes, means, strict=True)]))
        x = np.array(outcomes)
        variation = variations(x, np.zeros(8), 1.0)[-1]
        expected += probability * float(np.exp(running_log_capital(np.asarray(np.sum(x - means)), variation)))
    assert 0.5 < expected <= 1.0


def test_the_limit_is_where_the_capital_reaches_the_threshold() -> None:
    x = (np.random.default_rng(2).random(60) < 0.7).astype(np.float64)
    limit = float(lower_limit(x, 0.0, 0.05, 0.0, 1.0))
    assert slow_capital(list(x), [0.0] * 60, limit - 1e-6, MEAN_BETS)[-1] >= 20.0
    assert slow_capital(list(x), [0.0] * 60, limit + 1e-6, MEAN_BETS)[-1] < 20.0


def test_limits_from_before_a_change_do_not_outlive_it() -> None:
    """Forty successes, then forty failures: whoever looks now sees limits on either side of the mean of both."""
    x = np.repeat([1.0, 0.0], 40)
    before = float(lower_limit(x[:40], 0.0, 0.05, 0.0, 1.0))
    low, high = float(lower_limit(x, 0.0, 0.05, 0.0, 1.0)), 1.0 - float(lower_limit(1.0 - x, 0.0, 0.05, 0.0, 1.0))
    assert low < 0.5 < high
    assert low < before - 0.3


def test_no_limit_is_better_than_the_exact_one_for_a_fixed_number() -> None:
    """An exact one-sided limit has no room: a valid one after n equal outcomes is not beyond it."""
    for n in (1, 5, 29, 59, 299):
        assert float(lower_limit(np.ones(n), 0.0, 0.05, 0.0, 1.0)) <= clopper_pearson_lower(n, n, 0.05)


def test_limits_of_many_experiments_at_once_are_those_of_each() -> None:
    x = np.random.default_rng(3).random((4, 30))
    together = lower_limit(x, 0.0, 0.05, 0.0, 1.0)
    assert together == pytest.approx([float(lower_limit(one, 0.0, 0.05, 0.0, 1.0)) for one in x])
    running = running_mean_lower_limit(x, np.zeros_like(x), 1.0, 0.05)
    assert running == pytest.approx([float(running_mean_lower_limit(one, np.zeros(30), 1.0, 0.05)) for one in x])


def test_a_running_limit_is_below_the_mean_and_approaches_it() -> None:
    x = (np.random.default_rng(4).random(4000) < 0.3).astype(np.float64)
    few, many = (float(running_mean_lower_limit(x[:n], np.zeros(n), 1.0, 0.05)) for n in (200, 4000))
    assert few < float(np.mean(x[:200])) - 0.02
    # 2 sigma^2 log(1/beta) / n with a mixture of 25 rates: at most twice the fixed-number width
    width = np.sqrt(2.0 * 0.21 * (np.log(20.0) + np.log(25.0)) / 4000)
    assert float(np.mean(x)) - 1.2 * width < many < float(np.mean(x))


def test_without_runs_nothing_is_limited() -> None:
    assert float(lower_limit(np.zeros(0), 0.0, 0.05, 0.0, 1.0)) == 0.0
    assert float(running_mean_lower_limit(np.zeros(0), np.zeros(0), 1.0, 0.05)) == -np.inf


def test_a_mean_below_the_least_score_is_refused() -> None:
    with pytest.raises(UsageError, match="above the least possible score"):
        log_capital(np.ones(3), 0.0, 0.0)
