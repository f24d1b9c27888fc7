"""The watch's tests of change and exchangeability, what is kept of the stream, and that all of it stays as small and quick as it began."""

from __future__ import annotations

import itertools
import math
import sys
import tracemalloc

import msgspec
import numpy as np
import pytest
from scipy.stats import kstest

from s2r_runtime.core import stream
from s2r_runtime.core.stream import BINS, EDGES, bin_of
from s2r_runtime.evidence.bounds import anytime_discards, clopper_pearson_lower, clopper_pearson_upper
from s2r_runtime.evidence.watch import GRID, ChangeDetector, ConformalTest, EProcess, tie_break
from s2r_runtime.messages import Measured, WatchStood

SURE = 1e-3

# ---------------------------------------------------------------- change


@pytest.mark.parametrize("epsilon", [0.005, 0.03, 0.3])
def test_the_detector_s_mean_grows_by_one_a_step_under_the_null_summed_over_all_paths(epsilon: float) -> None:
    """Exact: all 2^10 sequences at P(X=1) = eps; also with a restart in the middle. Ever rarer exceedances: less."""
    for rate, restart in ((epsilon, None), (epsilon, 4), (epsilon / 2, None)):
        total = []
        for path in itertools.product((False, True), repeat=10):
            detector = ChangeDetector(epsilon, 1e200)
            for i, exceeds in enumerate(path):
                if i == restart:
                    detector = ChangeDetector(epsilon, 1e200, value=detector.value)
                detector.update(exceeds)
            total.append(detector.value * rate ** sum(path) * (1 - rate) ** (10 - sum(path)))
        assert math.fsum(total) == pytest.approx(10.0, rel=1e-9) if rate == epsilon else math.fsum(total) < 10.0


def test_false_notices_are_at_least_as_far_apart_as_stated_on_average() -> None:
    """Many runs until the first notice at a run length of 200, exceedances at rate eps; mean of a nonnegative time, by its own spread."""
    rng = np.random.default_rng(1)
    epsilon, run_length, runs = 0.05, 200.0, 600
    times = []
    for _ in range(runs):
        detector, n = ChangeDetector(epsilon, run_length), 1
        while detector.update(bool(rng.random() < epsilon)) < run_length:
            n += 1
        times.append(n)
    assert np.mean(times) + 3.3 * np.std(times) / math.sqrt(runs) >= run_length


def test_a_change_from_half_a_percent_to_five_is_noticed_within_120_samples_at_the_median() -> None:
    rng = np.random.default_rng(2)
    delays = []
    for _ in range(150):
        detector, delay = ChangeDetector(0.005, 1e5), 1
        for exceeds in (rng.random(1500) < 0.005).tolist():
            detector.update(exceeds)
        while detector.update(bool(rng.random() < 0.05)) < 1e5:
            delay += 1
        delays.append(delay)
    late = sum(delay > 120 for delay in delays)
    assert clopper_pearson_lower(late, len(delays), SURE) <= 0.5
    assert np.median(delays) > 40  # and not because it notices everything


def test_a_notice_begins_the_detector_anew() -> None:
    detector = ChangeDetector(0.01, 50.0)
    while detector.update(True) < 50.0:
        pass
    after, fresh = detector.update(True), ChangeDetector(0.01, 50.0)
    assert after == fresh.update(True)
    again = ChangeDetector(0.01, 50.0, value=73.0)  # it was persisted at its notice
    assert again.update(True) == after
    assert ChangeDetector(0.01, 50.0, value=30.0).value == pytest.approx(30.0)


@pytest.mark.parametrize(
    "wrong", [{"epsilon": 0.0, "run_length": 10.0}, {"epsilon": 0.1, "run_length": 0.5}, {"epsilon": 0.1, "run_length": math.inf}]
)
def test_impossible_detectors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        ChangeDetector(**wrong)


# ---------------------------------------------------------------- exchangeability


def saturated(rng: np.random.Generator, n: int) -> list[float]:
    """58 % are exactly 0, as where saturation hides the error."""
    return (np.abs(rng.normal(size=n)) * (rng.uniform(size=n) > 0.58)).tolist()


def conformal_p(discrepancies: list[float], seed: int) -> list[float]:
    """p-values as the test's docstring defines them, from all of the discrepancies so far."""
    bins = [bin_of(d, 2.0) for d in discrepancies]
    found = []
    for n in range(1, len(bins) + 1):
        newest = bins[n - 1]
        larger, equal = sum(b > newest for b in bins[:n]), bins[:n].count(newest)
        found.append((larger + tie_break(seed, n) * equal) / n)
    return found


def test_p_values_of_saturated_discrepancies_are_uniform_and_do_not_follow_each_other() -> None:
    p = np.array(conformal_p(saturated(np.random.default_rng(3), 1500), 4))
    assert kstest(p, "uniform").pvalue > SURE
    assert abs(np.corrcoef(p[1:], p[:-1])[0, 1]) < 3.3 / math.sqrt(len(p))


def test_the_martingale_is_the_mixture_of_jumpers_over_starts() -> None:
    """Against the definition: one simple jumper begun at every step, weighted by T(k-1) - T(k)."""
    d, seed = saturated(np.random.default_rng(5), 60), 6
    d[40:] = [3.0] * 20
    test = ConformalTest(seed, 1e-9)
    for one in d:
        value = test.update(bin_of(one, 2.0))
    p, expected = conformal_p(d, seed), 1.0 / (1.0 + math.log1p(60))
    for k in range(1, 61):
        capital = np.full(3, 1.0 / 3.0)
        for n in range(k, 61):
            if n > k:
                capital = 0.99 * capital + 0.01 / 3.0 * capital.sum()
            capital *= 1.0 + np.array([-1.0, 0.0, 1.0]) * (p[n - 1] - 0.5)
        weight = 1.0 / (1.0 + math.log1p(k - 1)) - 1.0 / (1.0 + math.log1p(k))
        expected += weight * capital.sum()
    assert value == pytest.approx(expected, rel=1e-9)


def test_exchangeable_discrepancies_reach_the_bar_no_more_often_than_alpha() -> None:
    rng = np.random.default_rng(7)
    alpha, runs, reached = 0.1, 200, 0
    for run in range(runs):
        test = ConformalTest(run, alpha)
        d = saturated(rng, 600)
        if run % 2:
            d = sorted(d)[::2] * 2
            rng.shuffle(d)  # exchangeable, not independent
        reached += max(test.update(bin_of(one, 2.0)) for one in d) >= 1 / alpha
    assert clopper_pearson_lower(reached, runs, SURE) <= alpha


@pytest.mark.parametrize("quiet", [300, 30_000])
def test_a_drift_is_found_however_long_all_was_well(quiet: int) -> None:
    rng = np.random.default_rng(8)
    test = ConformalTest(9, 0.01)
    for one in saturated(rng, quiet):
        assert test.update(bin_of(one, 2.0)) < 100
    steps = 0
    while test.update(bin_of(float(rng.uniform(1.0, 3.0)), 2.0)) < 100:
        steps += 1
    assert steps < 100
    stands = test.value
    assert test.update(0) == stands  # the epoch's driving is not of one law, whatever follows


def test_without_breaking_ties_the_same_stream_would_be_called_one_of_many_laws() -> None:
    """The planted fault: p-values that count ties as larger are not uniform where half of the discrepancies are equal."""
    p = np.array([min(1.0, one) for one in conformal_p(saturated(np.random.default_rng(3), 800), 4)])
    bins = [bin_of(d, 2.0) for d in saturated(np.random.default_rng(3), 800)]
    tied = np.array([sum(b >= bins[n] for b in bins[: n + 1]) / (n + 1) for n in range(len(bins))])
    assert kstest(p, "uniform").pvalue > SURE > kstest(tied, "uniform").pvalue


def test_ties_are_broken_uniformly_and_the_same_way_again() -> None:
    draws = [tie_break(123, n) for n in range(5000)]
    assert kstest(draws, "uniform").pvalue > SURE
    assert draws == [tie_break(123, n) for n in range(5000)]
    assert draws != [tie_break(124, n) for n in range(5000)]
    assert all(0.0 <= u < 1.0 for u in draws)
    # SplitMix64's published first outputs from seed 1234567
    assert [math.floor(tie_break(1234567, n) * 2**53) for n in (1, 2)] == [6457827717110365317 >> 11, 3203168211198807973 >> 11]


def test_a_restart_goes_on_with_what_was_counted_and_without_it_begins_anew() -> None:
    rng = np.random.default_rng(10)
    test = ConformalTest(11, 0.01)
    for one in [*saturated(rng, 400), *[1.9] * 10]:
        test.update(bin_of(one, 2.0))
    again = ConformalTest(11, 0.01, counts=tuple(test.counts), value=test.value)
    assert (again.n, again.value, again.counts) == (410, test.value, test.counts)
    assert again.update(3) == pytest.approx(test.update(3), rel=0.2)
    forgotten = ConformalTest(11, 0.01, counts=(1, 2, 3), value=55.0)
    assert (forgotten.n, forgotten.value) == (0, 1.0)


def test_impossible_levels_are_refused() -> None:
    with pytest.raises(ValueError, match=r"alpha is 1\.0"):
        ConformalTest(1, 1.0)


# ---------------------------------------------------------------- what is kept of the stream


def test_bins_are_as_documented() -> None:
    r = 0.25
    assert [bin_of(q * r, r) for q in (0.0, 1e-9, 1 / 16, 1.0, 1.0000001, 1.25, 1.26, 28.0, 29.0, 1e300)] == [
        0,
        1,
        1,
        16,
        17,
        17,
        18,
        31,
        32,
        32,
    ]
    assert BINS == len(EDGES) + 1 == 33
    assert (bin_of(0.0, 0.0), bin_of(1e-300, 0.0)) == (0, BINS - 1)
    d = np.sort(np.random.default_rng(12).exponential(size=300)).tolist()
    assert [bin_of(one, 0.5) for one in d] == sorted(bin_of(one, 0.5) for one in d)
    assert sum(one > 0.5 for one in d) == sum(bin_of(one, 0.5) > 16 for one in d)


def test_where_the_watch_stands_follows_each_discrepancy_and_no_rejected_one() -> None:
    stood = WatchStood()
    for n, d in enumerate((0.0, 0.4, 0.9, 0.9), 1):
        stood = stream.after(stood, Measured(0, n, d, "", 2.0, n, 0, 1, 3.0, 4.0), 0.8)
    assert (stood.n, stood.e_value, stood.change, stood.exchange, sum(stood.counts)) == (4, 2.0, 3.0, 4.0, 4)
    assert (stood.counts[0], stood.counts[8], stood.counts[17]) == (1, 1, 2)
    assert stream.after(stood, Measured(0, 9, 99.0, "jump", 2.0, 4, 0, 1), 0.8) is stood
    assert msgspec.json.decode(msgspec.json.encode(stood), type=WatchStood) == stood


def test_the_quantile_at_all_times_is_below_the_law_s_no_more_often_than_alpha() -> None:
    """Read after every sample; the law's (1-eps)-quantile lies between two edges, and only an edge below it is wrong."""
    rng = np.random.default_rng(13)
    epsilon, alpha, runs, r = 0.1, 0.1, 250, 2.0
    law = -math.log(epsilon)  # Exp(1)
    wrong, told = 0, 0
    for _ in range(runs):
        counts, ever = [0] * BINS, False
        for n, d in enumerate(rng.exponential(size=400).tolist(), 1):
            counts[bin_of(d, r)] += 1
            if n % 5 == 0:
                found = stream.quantile(tuple(counts), r, epsilon, alpha)
                ever |= found is not None and found < law
        wrong += ever
        told += found is not None and found < 1.6 * law
    assert clopper_pearson_lower(wrong, runs, SURE) <= alpha
    assert clopper_pearson_lower(told, runs, SURE) > 0.9


def test_the_quantile_from_counts_is_the_edge_above_that_of_the_draws_themselves() -> None:
    d = np.sort(np.random.default_rng(14).exponential(size=5000))
    counts = [0] * BINS
    for one in d.tolist():
        counts[bin_of(one, 3.0)] += 1
    exact = d[-1 - anytime_discards(len(d), 0.02, 0.01)]
    found = stream.quantile(tuple(counts), 3.0, 0.02, 0.01)
    edges = [3.0 * edge for edge in EDGES]
    assert found in edges
    assert found is not None
    assert exact <= found <= next(edge for edge in edges if edge >= 1.3 * exact)
    assert stream.quantile((), 3.0, 0.02, 0.01) is None
    assert stream.quantile(tuple([1] + [0] * (BINS - 1)), 3.0, 0.02, 0.01) is None


# ---------------------------------------------------------------- for ever


def test_all_of_it_stays_as_small_as_it_began() -> None:
    """A share of the 10^7 updates that the benchmark makes."""
    rng = np.random.default_rng(15)
    d = saturated(rng, 20_000)
    tests = EProcess(0.01), ChangeDetector(0.01, 1e5), ConformalTest(1, 0.01)
    stood = WatchStood()

    def go_on() -> None:
        nonlocal stood
        for one in d:
            exceeds = one > 2.6
            e = tests[0].update(exceeds)
            change, exchange = tests[1].update(exceeds), tests[2].update(bin_of(one, 2.6))
            stood = stream.after(stood, Measured(0, 0, one, "", e, tests[0].n, tests[0].exceedances, 1, change, exchange), 2.6)

    go_on()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    go_on()
    go_on()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 4096
    assert stood.n == sum(stood.counts) == 60_000
    assert len(tests[0]._won) == len(tests[1]._sums) == GRID
    assert sys.getsizeof(tests[2].counts) < 1000


def test_rates_of_the_figures_are_reached_on_both_sides() -> None:
    """The tolerance of the rate that `exceedance_upper` reports: it covers at all times, and narrows."""
    rng = np.random.default_rng(16)
    alpha, runs, p = 0.1, 200, 0.03
    missed = 0
    for _ in range(runs):
        exceedances = np.cumsum(rng.random(2000) < p)
        looks = (*range(10, 200, 10), *range(200, 2001, 100))
        missed += any(stream.share_above(int(exceedances[n - 1]), n, alpha) < p for n in looks)
    assert clopper_pearson_lower(missed, runs, SURE) <= alpha
    assert clopper_pearson_upper(missed, runs, SURE) < 0.5
    assert stream.share_above(60, 2000, alpha) < 0.05
