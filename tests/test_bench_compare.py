"""The benchmark of means and comparisons separates promises that hold from planted faults. (A thousand repetitions: run the tool.)"""

from __future__ import annotations

import bench_compare
import numpy as np
import pytest


@pytest.mark.slow
def test_promises_hold_and_naive_methods_are_caught() -> None:
    rng = np.random.default_rng(3)
    promises = bench_compare.coverage_rows(60, rng) + bench_compare.comparison_rows(60, rng)
    assert len(promises) == 21
    assert [one.what for one in promises if not one.ok] == []
    faults = bench_compare.naive_rows(300, rng)
    assert [one.what for one in faults if not one.ok] == []
    assert all(one.planted for one in faults)


def test_barnards_test_has_its_size_and_no_more_runs_than_it_needs() -> None:
    """Exact: the largest rejection probability over equal rates is at most alpha; one run fewer has less power."""
    n = bench_compare.barnard_runs(0.5, 0.9, 0.8, 0.05)
    region, counts = bench_compare.barnard(n, 0.05), np.arange(n + 1)
    for p in (0.1, 0.37, 0.5, 0.8):
        weights = bench_compare.binom.pmf(counts, n, p)
        assert float(weights @ region @ weights) <= 0.05
    power = float(bench_compare.binom.pmf(counts, n, 0.5) @ region @ bench_compare.binom.pmf(counts, n, 0.9))
    assert power >= 0.8


def test_the_best_bet_without_a_simulator_grows_by_the_relative_entropy() -> None:
    """Against "the mean is m" a coin of probability p gains KL(p || m) nats a run; a copy of the coin shows everything at once."""
    p, mean = 0.3, 0.25
    entropy = p * np.log(p / mean) + (1.0 - p) * np.log((1.0 - p) / (1.0 - mean))
    assert bench_compare.growth(p, 0.0, mean) == pytest.approx(entropy, rel=1e-4)
    assert bench_compare.growth(p, 0.9, mean) > 3.0 * entropy
