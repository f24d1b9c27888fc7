"""Means with simulation and optimism: valid with any simulator, narrower with a good one, and never beyond what n pairs can show."""

from __future__ import annotations

import numpy as np
import pytest

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.real_means import (
    PRIOR_PAIRS,
    PRIOR_SLOPE,
    Expected,
    corrected,
    from_rollouts,
    least_upper_limit,
    limits,
    mean_with_simulation,
    optimism,
    slopes,
    spread,
)

BETA, SURE = 0.2, 1e-3


def pair(n: int, rho: float, seed: int, p: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Binary real and simulated merits, both 1 with probability p, of correlation rho."""
    rng = np.random.default_rng(seed)
    real = (rng.random(n) < p).astype(np.float64)
    return real, np.where(rng.random(n) < rho, real, rng.random(n) < p).astype(np.float64)


def test_a_slope_is_the_shrunk_least_squares_of_the_earlier_pairs_alone() -> None:
    real, simulated = pair(30, 0.7, 1)
    found = slopes(real, simulated - 0.3)
    for i in (0, 2, 10, 30):
        g, y = simulated[:i] - 0.3, real[:i]
        fitted = np.polyfit(g, y, 1)[0] if i > 1 and np.ptp(g) > 0.0 else PRIOR_SLOPE
        assert found[i] == pytest.approx(np.clip((i * fitted + PRIOR_PAIRS * PRIOR_SLOPE) / (i + PRIOR_PAIRS), -1.0, 1.0))
    changed = real.copy()
    changed[20:] = 1.0 - changed[20:]
    assert slopes(changed, simulated - 0.3)[:21] == pytest.approx(found[:21])


@pytest.mark.parametrize("slope", [-1.0, -0.4, 0.0, 0.6, 1.0])
@pytest.mark.parametrize(
    "expected", [Expected(np.array([0.2]), np.array([0.3]), known=True), Expected(np.array([0.25]), np.array([0.25]), known=False)]
)
def test_corrected_scores_are_within_their_range_and_below_the_true_mean(slope: float, expected: Expected) -> None:
    """All corners of real and simulated merits; where c is a mean of fresh rollouts, that one's too."""
    centres = [expected] if expected.known else [Expected(np.array([c]), np.array([c]), known=False) for c in (0.0, 1.0)]
    for centre in centres:
        for y in (0.0, 1.0):
            for f in (0.0, 1.0):
                x, least = corrected(np.array([y]), np.array([f]), centre, np.array([slope]))
                assert least[0] - 1e-12 <= x[0] <= least[0] + spread(centre) + 1e-12
    if expected.known:
        for mean in (0.2, 0.26, 0.3):  # of the simulator, anywhere within the limits
            x, _ = corrected(np.array([0.5]), np.array([mean]), expected, np.array([slope]))
            assert x[0] <= 0.5 + 1e-12


def test_a_good_simulator_saves_runs_and_a_bad_one_says_so() -> None:
    real, good = pair(600, 0.9, 2)
    _, bad = pair(600, 0.0, 3)
    rollouts = (np.random.default_rng(4).random(20_000) < 0.3).astype(np.float64)
    with_good = mean_with_simulation(real, good, rollouts=rollouts, beta=0.05)
    with_bad = mean_with_simulation(real, bad, rollouts=rollouts, beta=0.05)
    assert with_good.lower > with_good.alone_lower
    assert with_good.upper < with_good.alone_upper
    assert with_good.correlation > 0.8
    assert with_good.runs_saved > 400
    assert with_good.runs_alone == pytest.approx(600 + with_good.runs_saved)
    assert abs(with_bad.correlation) < 0.15
    assert -200 < with_bad.runs_saved < 30
    assert with_good.running_lower < with_good.lower < with_good.mean < with_good.upper < with_good.running_upper


def test_fresh_rollouts_do_for_scenarios_whose_law_changes() -> None:
    rng = np.random.default_rng(5)
    p = 0.2 + 0.6 * (np.arange(800) % 2)
    real = (rng.random(800) < p).astype(np.float64)
    simulated = np.where(rng.random(800) < 0.8, real, rng.random(800) < p).astype(np.float64)
    found = mean_with_simulation(real, simulated, fresh=rng.binomial(50, p) / 50.0, beta=0.05)
    assert found.running_lower < 0.5 < found.running_upper
    assert found.upper - found.lower < 0.15


def test_both_limits_hold_with_a_simulator_that_is_wrong_and_anti_correlated() -> None:
    """1 - beta and few enough misses: exact lower limit of the miss rate, looks after every run by the running maximum."""
    rng, missed, repetitions = np.random.default_rng(6), 0, 60
    for _ in range(repetitions):
        real = (rng.random(60) < 0.4).astype(np.float64)
        expected = from_rollouts((rng.random(200) < 0.6).astype(np.float64), 0.1 * BETA)
        slope = slopes(real, 1.0 - real - 0.6)
        low, high = limits(real, 1.0 - real, expected, slope[:-1], 0.9 * BETA)
        missed += not low <= 0.4 <= high
    assert clopper_pearson_lower(missed, repetitions, SURE) <= BETA


def test_optimism_is_the_mean_of_simulated_less_real() -> None:
    real, simulated = pair(400, 0.5, 7)
    simulated = np.maximum(simulated, (np.random.default_rng(8).random(400) < 0.3).astype(np.float64))
    found = optimism(real, simulated, beta=0.05)
    assert found.mean == pytest.approx(float(np.mean(simulated) - np.mean(real)))
    true = 0.3 + 0.7 * 0.3 - 0.3
    assert found.lower < true < found.upper
    assert found.lower > 0.0


@pytest.mark.parametrize("n", [1, 29, 59, 299])
def test_no_upper_limit_is_below_what_agreeing_pairs_can_show(n: int) -> None:
    least = least_upper_limit(n, 0.05)
    assert (1.0 - least) ** n == pytest.approx(0.05)
    ones = np.ones(n)
    assert optimism(ones, ones, beta=0.05).upper >= least
    rollouts = np.ones(5000)
    assert 1.0 - mean_with_simulation(ones, ones, rollouts=rollouts, beta=0.05).lower >= least


def test_an_asymptotic_interval_misses_a_failure_that_simulation_never_shows() -> None:
    """A failure of probability 5 % that is in no simulation: 20 agreeing pairs give width 0, as often as the proof says."""
    rng = np.random.default_rng(9)
    real = (rng.random((2000, 20)) < 0.05).astype(np.float64)
    missed = int(np.sum(real.std(axis=1) == 0.0))  # simulated: 0 always; the interval is [0, 0]
    assert clopper_pearson_lower(missed, 2000, SURE) > 0.05
    assert abs(missed / 2000 - 0.95**20) < 4.0 * np.sqrt(0.25 / 2000)
    assert least_upper_limit(20, 0.05) > 0.05


def test_what_does_not_fit_is_refused() -> None:
    one = np.ones(1)
    with pytest.raises(NotEnoughEvidence, match="no pairs"):
        optimism(np.zeros(0), np.zeros(0), beta=0.05)
    with pytest.raises(NotEnoughEvidence, match="no rollouts"):
        mean_with_simulation(one, one, beta=0.05)
    with pytest.raises(UsageError, match="one of each for each run"):
        optimism(one, np.ones(2), beta=0.05)
    with pytest.raises(UsageError, match="one for each"):
        mean_with_simulation(one, one, fresh=np.ones(2), beta=0.05)
    with pytest.raises(UsageError, match="outside 0 to 1"):
        optimism(one, 2.0 * one, beta=0.05)
    with pytest.raises(UsageError, match="beta"):
        optimism(one, one, beta=0.0)
