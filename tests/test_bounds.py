"""The bounds against exact binomial sums in rational arithmetic."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.bounds import (
    attempt_beta,
    clopper_pearson_lower,
    clopper_pearson_upper,
    epoch_beta,
    sample_size,
    scenario_confidence,
)
from s2r_runtime.core import ledger
from s2r_runtime.errors import UsageError

SIZES = (1, 2, 7, 50, 99, 299)
EPSILONS = (Fraction(1, 1000), Fraction(1, 200), Fraction(1, 100), Fraction(3, 100), Fraction(1, 4), Fraction(9, 10))


def binomial_below(n: int, k: int, p: Fraction) -> Fraction:
    """P(Bin(n, p) <= k), exactly."""
    return sum((math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k + 1)), Fraction(0))


@pytest.mark.parametrize(("n", "eps"), list(itertools.product(SIZES, EPSILONS)))
def test_scenario_bound_is_the_binomial_sum(n: int, eps: Fraction) -> None:
    for k in {0, 1, 3, n // 2, n - 1}:
        if k < n:
            exact = float(binomial_below(n, k, eps))
            assert scenario_confidence(n, k, float(eps)) == pytest.approx(exact, rel=1e-9, abs=1e-300)


def test_all_samples_discarded_shows_nothing() -> None:
    assert scenario_confidence(5, 5, 0.1) == 1.0
    assert scenario_confidence(0, 0, 0.1) == 1.0


@pytest.mark.parametrize(("eps", "n"), [(0.005, 598), (0.01, 299), (0.03, 99)])
def test_sample_sizes_for_five_per_cent_are_those_of_the_statement(eps: float, n: int) -> None:
    assert sample_size(eps, 0.05) == n


@pytest.mark.parametrize(("eps", "n", "percent"), [(0.005, 600, 95.06), (0.01, 300, 95.10), (0.03, 100, 95.24)])
def test_confidences_of_the_paper_s_sample_sizes(eps: float, n: int, percent: float) -> None:
    assert round(100 * (1 - scenario_confidence(n, 0, eps)), 2) == percent


@pytest.mark.parametrize(
    ("eps", "beta", "k"), list(itertools.product((Fraction(1, 100), Fraction(3, 100), Fraction(1, 5)), (5, 1), (0, 1, 2, 6)))
)
def test_sample_size_is_the_smallest_that_suffices(eps: Fraction, beta: int, k: int) -> None:
    exact_beta = Fraction(beta, 100)
    n = sample_size(float(eps), float(exact_beta), k)
    assert binomial_below(n, k, eps) <= exact_beta < binomial_below(n - 1, k, eps)


@settings(deadline=None, max_examples=60)
@given(st.floats(1e-6, 0.99), st.floats(1e-9, 0.99), st.integers(0, 20))
def test_sample_size_suffices_and_one_fewer_does_not(eps: float, beta: float, k: int) -> None:
    n = sample_size(eps, beta, k)
    assert scenario_confidence(n, k, eps) <= beta < scenario_confidence(n - 1, k, eps)


@pytest.mark.parametrize("spend", [epoch_beta, attempt_beta])
def test_a_life_of_epochs_spends_half_of_the_budget_and_never_more(spend: object) -> None:
    assert callable(spend)
    beta, last = 0.05, 20_000
    total = math.fsum(spend(beta, i) for i in range(1, last + 1))
    tail = 3 * beta / math.pi**2 / last  # sum over i > m of 1/i^2 is below 1/m
    assert total < beta / 2 < total + tail
    assert spend(beta, 1) == pytest.approx(3 * beta / math.pi**2)


@settings(deadline=None, max_examples=200)
@given(st.floats(1e-4, 0.6), st.sampled_from([0.01, 0.05, 0.1]), st.integers(0, 6), st.integers(1, 9))
def test_the_core_s_own_sums_ask_for_the_same_samples(eps: float, beta: float, k: int, number: int) -> None:
    """The core may not use scipy; a campaign that it planned must be enough for the gap, and no larger."""
    share = ledger.share(beta, number)
    assert share == epoch_beta(beta, number)
    assert ledger.campaign_size(eps, share, k) == sample_size(eps, share / 2, k)


@pytest.mark.parametrize(("failures", "n"), [(0, 299), (1, 50), (3, 50), (49, 50), (7, 1000)])
def test_clopper_pearson_limits_solve_the_binomial_equation(failures: int, n: int) -> None:
    beta = 0.05
    upper, lower = clopper_pearson_upper(failures, n, beta), clopper_pearson_lower(failures, n, beta)
    assert float(binomial_below(n, failures, Fraction(upper))) == pytest.approx(beta, rel=1e-6)
    if failures:
        assert float(1 - binomial_below(n, failures - 1, Fraction(lower))) == pytest.approx(beta, rel=1e-6)
    assert lower <= failures / n <= upper


def test_clopper_pearson_at_the_ends() -> None:
    assert clopper_pearson_upper(0, 299, 0.05) <= 0.01 < clopper_pearson_upper(0, 298, 0.05)
    assert clopper_pearson_upper(5, 5, 0.05) == 1.0
    assert clopper_pearson_lower(0, 5, 0.05) == 0.0
    assert clopper_pearson_upper(0, 0, 0.05) == 1.0
    assert clopper_pearson_lower(0, 0, 0.05) == 0.0


def test_clopper_pearson_covers_at_least_its_confidence_for_every_rate() -> None:
    n, beta = 40, 0.05
    limits = [clopper_pearson_upper(f, n, beta) for f in range(n + 1)]
    for step in range(1, 40):
        p = Fraction(step, 40)
        missed = [f for f in range(n + 1) if limits[f] < p]
        chance = sum((math.comb(n, f) * p**f * (1 - p) ** (n - f) for f in missed), Fraction(0))
        assert chance <= Fraction(beta)


@pytest.mark.parametrize(
    "call",
    [
        lambda: scenario_confidence(10, 0, 0.0),
        lambda: scenario_confidence(10, 0, 1.0),
        lambda: scenario_confidence(10, 0, float("nan")),
        lambda: scenario_confidence(-1, 0, 0.1),
        lambda: sample_size(0.1, 0.0),
        lambda: sample_size(0.1, 0.05, -1),
        lambda: sample_size(1e-12, 0.05),
        lambda: epoch_beta(0.05, 0),
        lambda: clopper_pearson_upper(6, 5, 0.05),
        lambda: clopper_pearson_lower(-1, 5, 0.05),
    ],
)
def test_numbers_out_of_range_are_refused(call: object) -> None:
    assert callable(call)
    with pytest.raises(UsageError):
        call()
