"""Limits of the mean failure probability: valid after every run, for every robot, and nearly as narrow as for one fixed number."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from s2r_runtime.core import anytime
from s2r_runtime.evidence.bounds import clopper_pearson_upper

TOOL = Path(__file__).parent.parent / "tools" / "bench_episodes.py"
PROCESSES: dict[str, Callable[[tuple[int, ...]], float]] = {
    "constant": lambda _past: 0.3,
    "never twice": lambda past: 0.0 if past and past[-1] else 0.6,
    "in bursts": lambda past: 0.8 if past and past[-1] else 0.1,
    "drifting": lambda past: 0.05 + 0.07 * len(past),
    "chosen to fool the limits": lambda past: 0.7 if 3 * sum(past) <= len(past) else 0.05,
}


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("alpha", [0.3, 0.1])
def test_the_probability_of_ever_missing_the_mean_is_at_most_alpha_for_processes_that_depend_on_the_past(name: str, alpha: float) -> None:
    """Exact: all 2^11 outcomes of eleven runs, each with its probability."""
    process, n = PROCESSES[name], 11
    limits = {(k, s): anytime.limits(anytime.Counts(k, s), alpha, alpha) for k in range(1, n + 1) for s in range(k + 1)}
    missed = {"upper": 0.0, "lower": 0.0}
    for path in itertools.product((0, 1), repeat=n):
        probability, total, out = 1.0, 0.0, set()
        for i, x in enumerate(path):
            p = process(path[:i])
            probability *= p if x else 1.0 - p
            if probability == 0.0:
                break
            total += p
            failures, mean = sum(path[: i + 1]), total / (i + 1)
            out |= {"upper"} if mean > limits[i + 1, failures].upper else set()
            out |= {"lower"} if mean < limits[i + 1, failures].lower else set()
        for side in out:
            missed[side] += probability
    assert max(missed.values()) <= alpha


@pytest.mark.parametrize(
    ("n", "failures", "alpha", "lower", "upper"),
    [
        (1, 0, 0.05, 0.0, 0.9721333650832883),
        (20, 0, 0.05, 0.0, 0.15761264085909907),
        (299, 0, 0.05, 0.0, 0.011382178416033693),
        (299, 1, 0.05, 0.0, 0.025769024859776706),
        (299, 5, 0.0456, 0.002871151719847747, 0.05265529074840074),
        (10, 4, 0.0152, 0.04823614858269057, 0.8768517649589929),
        (50, 30, 0.05, 0.3863782040000089, 0.8038876207523533),
        (130, 7, 0.0152, 0.010380747286009368, 0.15462445475584552),
        (2000, 60, 0.01, 0.017919299505359913, 0.04694449959804357),
        (5000, 3000, 0.0152, 0.5757216006193826, 0.6254434924045633),
        (100_000, 2000, 0.05, 0.018632676848410894, 0.021529763717335497),
    ],
)
def test_the_limits_are_where_the_evidence_reaches_the_confidence(n: int, failures: int, alpha: float, lower: float, upper: float) -> None:
    """Reference: sixty halvings of the interval with another program of the formula. A log is audited with these very numbers."""
    found = anytime.limits(anytime.Counts(n, failures), alpha, alpha)
    assert found.lower == pytest.approx(lower, rel=1e-10)
    assert found.upper == pytest.approx(upper, rel=1e-10)


def test_without_a_failure_the_upper_limit_is_within_a_quarter_of_the_least_that_any_method_can_give() -> None:
    for n in (10, 100, 299, 3000):
        least = 1.0 - 0.05 ** (1.0 / n)
        assert least <= anytime.upper(n, 0, 0.05) <= 1.0 - 0.025 ** (1.0 / n)
    assert anytime.upper(299, 0, 0.05) <= 1.15 * clopper_pearson_upper(0, 299, 0.05)
    assert anytime.upper(300, 0, 0.0456) <= 0.013


def test_limits_enclose_the_share_and_grow_with_the_failures() -> None:
    for n in (1, 7, 50, 1000):
        found = [anytime.limits(anytime.Counts(n, s), 0.05, 0.05) for s in range(0, n + 1, max(1, n // 25))]
        shares = [s / n for s in range(0, n + 1, max(1, n // 25))]
        assert all(0.0 <= one.lower <= share <= one.upper <= 1.0 for one, share in zip(found, shares, strict=True))
        assert [one.upper for one in found] == sorted(one.upper for one in found)
        assert [one.lower for one in found] == sorted(one.lower for one in found)
    assert anytime.limits(anytime.Counts(), 0.05, 0.05) == (0.0, 1.0)
    assert anytime.upper(40, 40, 0.05) == 1.0
    assert 0.0 < anytime.lower(40, 40, 0.05) < 1.0


def test_a_censored_run_counts_as_a_failure_above_and_as_none_below() -> None:
    found = anytime.limits(anytime.Counts(50, unsafe=2, censored=3), 0.02, 0.04)
    assert found == (anytime.lower(50, 2, 0.02), anytime.upper(50, 5, 0.04))


def test_many_runs_give_the_share_itself() -> None:
    found = anytime.limits(anytime.Counts(10**7, 10**4), 0.05, 0.05)
    assert found.lower == pytest.approx(1e-3, rel=0.05)
    assert found.upper == pytest.approx(1e-3, rel=0.05)
    assert anytime.upper(10**9, 0, 0.05) <= 1e-8


@pytest.mark.parametrize(("n", "failures"), [(3, 4), (3, -1), (0, 1)])
def test_impossible_counts_are_refused(n: int, failures: int) -> None:
    for side in (anytime.upper, anytime.lower):
        with pytest.raises(ValueError, match="must be between 0 and the number of runs"):
            side(n, failures, 0.05)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, math.nan])
def test_an_impossible_confidence_is_refused(alpha: float) -> None:
    for side in (anytime.upper, anytime.lower):
        with pytest.raises(ValueError, match="must be between 0 and 1"):
            side(3, 1, alpha)


def test_no_limit_that_is_right_for_every_robot_can_be_below_what_n_safe_runs_show() -> None:
    """A process that fails just below 1 - alpha^(1/n) shows n safe runs with probability alpha, simulation or not."""
    for n in (29, 59, 299):
        p = 0.999 * (1.0 - 0.05 ** (1.0 / n))
        assert (1.0 - p) ** n > 0.05
        assert 1.0 - 0.05 ** (1.0 / n) == pytest.approx({29: 0.1, 59: 0.05, 299: 0.01}[n], rel=0.02)


@pytest.mark.slow
def test_the_benchmark_finds_promises_kept_and_planted_faults() -> None:
    found = subprocess.run([sys.executable, str(TOOL), "--quick"], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    assert found.stdout.count("fault: ") == 2
