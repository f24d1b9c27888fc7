"""The bounds against exact binomial sums in rational arithmetic."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.core import ledger, stream
from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.bounds import (
    anytime_discards,
    anytime_evidence,
    anytime_sample_size,
    anytime_upper,
    attempt_beta,
    clopper_pearson_lower,
    clopper_pearson_upper,
    epoch_beta,
    sample_size,
    scenario_confidence,
    split,
)

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


# ---------------------------------------------------------------- shares


def test_split_shares_are_in_proportion_and_never_more_than_the_whole() -> None:
    assert split(0.05, (1, 1)) == (0.025, 0.025)
    assert split(0.06, (1, 2, 3)) == pytest.approx((0.01, 0.02, 0.03))
    for parts in range(1, 60):
        assert sum(map(Fraction, split(0.05, (1.0,) * parts))) <= Fraction(0.05) * (1 + Fraction(1, 10**15))


def test_a_pass_that_needs_every_law_is_no_likelier_wrong_than_one_law_alone() -> None:
    """Intersection-union, exactly: laws that are independent, and laws that are the same; one of them too bad by a hair."""
    eps, n, beta = Fraction(1, 10), sample_size(0.1, 0.05), Fraction(1, 20)
    one = (1 - eps) ** n
    for other in (Fraction(0), Fraction(1, 50), eps):
        assert one * (1 - other) ** n <= one <= beta


# ---------------------------------------------------------------- at all times


def exact_evidence(k: int, n: int, p: Fraction) -> Fraction:
    """E_n(p) = (1/p) int_0^p t^k (1-t)^(n-k) dt / (p^k (1-p)^(n-k)), the polynomial integrated term by term."""
    integral = sum((math.comb(n - k, i) * (-1) ** i * p ** (k + i + 1) / (k + i + 1) for i in range(n - k + 1)), Fraction(0))
    return integral / (p ** (k + 1) * (1 - p) ** (n - k))


@pytest.mark.parametrize("p", [Fraction(1, 100), Fraction(3, 100), Fraction(1, 4), Fraction(9, 10)])
@pytest.mark.parametrize("n", [0, 1, 7, 60])
def test_anytime_evidence_is_the_mixture_integrated_exactly(n: int, p: Fraction) -> None:
    for k in {0, 1, n // 3, n} & set(range(n + 1)):
        assert anytime_evidence(k, n, float(p)) == pytest.approx(math.log(exact_evidence(k, n, p)), rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("p", [Fraction(1, 100), Fraction(1, 4)])
def test_mean_of_the_anytime_evidence_is_one_where_the_probability_is_p_and_less_above_it(p: Fraction) -> None:
    n = 40
    for q, mean in ((p, 1), (2 * p, None)):
        total = sum((exact_evidence(k, n, p) * math.comb(n, k) * q**k * (1 - q) ** (n - k) for k in range(n + 1)), Fraction(0))
        assert total == mean if mean else total < 1


def test_anytime_bound_read_after_every_sample_is_wrong_with_probability_beta_at_most_exactly() -> None:
    """The chance that at most k_n of n are above the quantile at any n up to 3000, by adding up all paths; and of the fixed-size bound."""
    eps, beta, last = 0.03, 0.05, 3000

    def ever_wrong(discards: object) -> float:
        assert callable(discards)
        chance, wrong = [1.0], 0.0  # of each count, none wrong so far
        for n in range(1, last + 1):
            grown = [0.0, *[c * eps for c in chance]]
            for i, c in enumerate(chance):
                grown[i] += c * (1.0 - eps)
            k = discards(n)
            wrong += math.fsum(grown[: k + 1])
            chance = [0.0] * (k + 1) + grown[k + 1 :] if k >= 0 else grown
            chance = chance[: int(eps * last + 120)]
        return wrong

    assert ever_wrong(lambda n: anytime_discards(n, eps, beta)) <= beta
    assert ever_wrong(_fixed_size(eps, beta)) > 2 * beta


def _fixed_size(eps: float, beta: float) -> object:
    """n -> k of the bound for a size fixed beforehand, which is read as if each n had been; to be asked in order."""
    reached = [-1]

    def discards(n: int) -> int:
        while reached[0] + 1 < n and scenario_confidence(n, reached[0] + 1, eps) <= beta:
            reached[0] += 1
        return reached[0]

    return discards


@pytest.mark.parametrize(("eps", "beta"), [(0.005, 0.05), (0.01, 0.05), (0.03, 0.01)])
def test_anytime_sample_size_is_the_smallest_that_gives_a_bound_and_dearer_than_a_size_fixed_beforehand(eps: float, beta: float) -> None:
    n = anytime_sample_size(eps, beta)
    assert anytime_discards(n, eps, beta) == 0
    assert anytime_discards(n - 1, eps, beta) == -1
    assert sample_size(eps, beta) < n < 3 * sample_size(eps, beta)
    assert float(exact_evidence(0, n, Fraction(eps).limit_denominator(1000))) >= 1 / beta


@pytest.mark.parametrize(("exceedances", "n"), [(0, 0), (0, 500), (3, 500), (20, 5000), (2000, 200_000), (90_000, 10**7), (5, 5)])
def test_anytime_upper_limit_is_where_the_evidence_reaches_its_bar_and_the_core_s_own_is_no_smaller(exceedances: int, n: int) -> None:
    beta = 0.01
    upper, cores = anytime_upper(exceedances, n, beta), stream.share_above(exceedances, n, beta)
    assert upper <= cores * (1 + 1e-9) <= upper * 1.1 + 1e-9
    if exceedances < n:
        assert anytime_evidence(exceedances, n, upper) == pytest.approx(math.log(1 / beta), abs=1e-4)
        assert clopper_pearson_upper(exceedances, n, beta) < upper  # looking at all times costs something
    else:
        assert upper == 1.0


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
        lambda: split(0.05, ()),
        lambda: split(0.05, (1.0, 0.0)),
        lambda: split(0.05, (1.0, math.inf)),
        lambda: split(1.5, (1.0,)),
        lambda: anytime_evidence(3, 2, 0.1),
        lambda: anytime_evidence(1, 2, 1.0),
        lambda: anytime_upper(3, 2, 0.05),
        lambda: anytime_discards(10, 0.0, 0.05),
        lambda: anytime_discards(-1, 0.1, 0.05),
        lambda: anytime_sample_size(1e-12, 0.05),
    ],
)
def test_numbers_out_of_range_are_refused(call: object) -> None:
    assert callable(call)
    with pytest.raises(UsageError):
        call()
