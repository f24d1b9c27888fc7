"""The core's own arithmetic of what is spent says the same as `bounds`, which it may not import."""

from __future__ import annotations

import math
import random

import pytest

from s2r_runtime.core import ledger
from s2r_runtime.evidence import bounds


def test_shares_are_those_of_the_bounds_and_never_sum_to_more_than_the_budget() -> None:
    for number in (1, 2, 3, 10, 1000):
        assert ledger.share(0.05, number) == pytest.approx(bounds.epoch_beta(0.05, number), rel=1e-15)
        assert ledger.share(0.05, number) == pytest.approx(bounds.attempt_beta(0.05, number), rel=1e-15)
    assert ledger.spent(0.05, 0, 0) == 0.0
    assert ledger.spent(0.05, 1, 2) == pytest.approx(3 * 0.05 / math.pi**2 * (1 + 1 + 1 / 4))
    assert 0.0499 < ledger.spent(0.05, 5000, 5000) < 0.05


def test_sample_sizes_agree_with_the_bounds_to_the_sample() -> None:
    draw = random.Random(1)
    for _ in range(300):
        eps = draw.choice([0.005, 0.01, 0.03, 10 ** draw.uniform(-4, -0.4)])
        beta, k = 10 ** draw.uniform(-6, -0.5), draw.choice([0, 0, 1, 2, 5, 20, 100])
        assert ledger.sample_size(eps, beta, k) == bounds.sample_size(eps, beta, k), (eps, beta, k)
    assert ledger.campaign_size(0.03, 0.1, 0) == bounds.sample_size(0.03, 0.05)


def test_the_tail_agrees_with_the_bounds_where_terms_would_overflow() -> None:
    for n, k, eps in ((200_000, 150, 0.001), (5000, 5000, 0.5), (3, 7, 0.1), (10**6, 0, 1e-5), (1000, 400, 0.5)):
        assert ledger.binomial_tail(n, k, eps) == pytest.approx(bounds.scenario_confidence(n, k, eps), rel=1e-8)


def test_a_plan_of_more_than_a_billion_samples_is_none() -> None:
    with pytest.raises(ValueError, match="more than 1e"):
        ledger.sample_size(1e-12, 0.05)


def test_seeds_are_exact_in_every_json_reader_and_differ_with_every_part() -> None:
    seeds = {ledger.seed("a", "b", 1), ledger.seed("a", "b", 2), ledger.seed("ab", 1), ledger.seed("b", "a", 1)}
    assert len(seeds) == 4
    assert all(0 <= seed < 2**53 for seed in seeds)
    assert ledger.seed("a", "b", 1) == ledger.seed("a", "b", 1)
