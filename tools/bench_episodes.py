"""Limits of unsafe runs by repetition (guarantee G10): how often they miss the true mean when read after every run, and what they cost.

    tools/bench_episodes.py [--experiments 2000] [--runs 2000] [--seed 1] [--quick] [--json]

An experiment is one robot. The failure probability of its runs is constant, drifts, rises in bursts, falls after each failure, or is chosen
run by run to fool the limits. The limits are read after every run. It is a miss if the true mean of the probabilities so far lies outside
them once. Misses are counted by the evidence at the true mean, for all experiments side by side; that is compared with `anytime` at random
places. A life is several controllers one after the other, each with the share of its sequence; it misses if any of its limits does.

A promise is broken if the exact 99.9 % lower limit of the share of experiments with a miss exceeds what the limits have of beta. The
planted faults are a Clopper-Pearson bound read after every run, and a lower limit that is retained while the probabilities fall. Each must
be caught by the same count.

Then: the width without a failure, after how many runs a controller that fails in 5 % is revoked, how often one that fails in exactly
`max_unsafe` is, and the time of an update. Exit 1 if a promise is broken, a fault is not caught or a figure is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from s2r_runtime.core import anytime
from s2r_runtime.core.runs import LOWER_SHARE, share
from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper

Array = NDArray[np.float64]

BETA, BUDGET, SURE = 0.05, 0.1, 1e-3
CONTROLLERS = 6
"""Of a life, one after the other."""
MAX_UNSAFE, FAILS = 0.01, 0.05
WIDTH_N, WIDTH, BOUND_N, BOUND, REVOKED_AFTER, UPDATE_MS = 299, 1.25, 300, 0.013, 150, 1.0
"""Figures to meet: width over Clopper-Pearson's, bound after 300 safe runs, runs until revoked (median), time of an update."""
CENSORED = 0.3
"""Of the failures, in the experiments where some are censored; and of the safe runs a tenth of that."""

Process = Callable[[int, Array, Array, Array], Array]
"""(run, failures so far, sum of the probabilities so far, runs since the last failure), each (experiments,) -> probability of the next."""


def processes(runs: int) -> dict[str, Process]:
    """How runs fail. The next probability may depend on everything before."""
    return {
        "constant, 1 %": lambda _i, s, _p, _q: np.full(len(s), 0.01),
        "constant, 10 %": lambda _i, s, _p, _q: np.full(len(s), 0.1),
        "drifting, 0.2 to 15 %": lambda i, s, _p, _q: np.full(len(s), 0.076 + 0.074 * math.sin(6.0 * math.pi * i / runs)),
        "better and better": lambda i, s, _p, _q: np.full(len(s), 0.2 / (1.0 + 0.05 * i)),
        "never twice within ten runs": lambda _i, _s, _p, quiet: np.where(quiet < 10, 0.0, 0.2),
        "in bursts": lambda _i, _s, _p, quiet: np.where(quiet < 3, 0.5, 0.005),
        "chosen to fool the limits": lambda _i, s, p, _q: np.where(s <= p, 0.3, 0.001),
    }


class Experiment(NamedTuple):
    """All experiments side by side, (experiments, runs): outcomes, failures so far, the true mean so far."""

    outcomes: NDArray[np.bool_]
    failures: Array
    mean: Array


def drawn(process: Process, experiments: int, runs: int, rng: np.random.Generator) -> Experiment:
    """Runs by a process."""
    failures, total, quiet = np.zeros(experiments), np.zeros(experiments), np.full(experiments, 1e9)
    outcomes, mean = np.zeros((experiments, runs), dtype=bool), np.zeros((experiments, runs))
    for i in range(runs):
        p = process(i, failures, total, quiet)
        x = rng.random(experiments) < p
        failures, total, quiet = failures + x, total + p, np.where(x, 0.0, quiet + 1.0)
        outcomes[:, i], mean[:, i] = x, total / (i + 1)
    return Experiment(outcomes, np.cumsum(outcomes, axis=1, dtype=float), mean)


def evidence(failures: Array, mean: Array, *, upper: bool) -> Array:
    """log M_n(mean) of `anytime`, for every run of every experiment."""
    sign, all_in = (-1.0, anytime.ALL_IN) if upper else (1.0, 0.0)
    n = np.arange(1.0, failures.shape[1] + 1.0)
    found = np.full(failures.shape, -np.inf)
    for bet in anytime.BETS:
        term = math.log((1.0 - all_in) / len(anytime.BETS)) + sign * bet * failures - n * np.log1p(mean * math.expm1(sign * bet))
        found = np.logaddexp(found, term)
    if upper:
        found = np.logaddexp(found, np.where(failures == 0.0, math.log(all_in) - n * np.log1p(-mean), -np.inf))
    return found


def censored(process: Experiment, rng: np.random.Generator) -> tuple[Array, Array]:
    """Failures as the lower and the upper limit count them, where a part of the runs is censored, failures more often."""
    cut = rng.random(process.outcomes.shape) < np.where(process.outcomes, CENSORED, 0.1 * CENSORED)
    low, high = process.outcomes & ~cut, process.outcomes | cut
    return np.cumsum(low, axis=1, dtype=float), np.cumsum(high, axis=1, dtype=float)


def coverage(experiments: int, runs: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """A row for each process: misses of either limit, and of the planted faults."""
    rows, bar = [], -math.log(BETA)
    for name, process in processes(runs).items():
        made = drawn(process, experiments, runs, rng)
        low, high = censored(made, rng)
        for what, lower_count, upper_count in ((name, made.failures, made.failures), (f"{name}, some censored", low, high)):
            for side, count in (("upper", upper_count), ("lower", lower_count)):
                log_m = evidence(count, made.mean, upper=side == "upper")
                _compare_with_anytime(count, made.mean, log_m, rng, upper=side == "upper")
                rows.append(row(f"{side}, {what}", int(np.sum(np.any(log_m >= bar, axis=1))), experiments, BETA))
        if name == "constant, 10 %":
            missed = np.any(bdtr(made.failures, np.arange(1, runs + 1), 0.1) < BETA, axis=1)
            rows.append(row("fault: Clopper-Pearson read after every run", int(missed.sum()), experiments, BETA, planted=True))
        if name == "better and better":
            lowest_later = np.minimum.accumulate(made.mean[:, ::-1], axis=1)[:, ::-1]
            missed = np.any(evidence(made.failures, lowest_later, upper=False) >= bar, axis=1)
            rows.append(row("fault: highest lower limit kept while probabilities fall", int(missed.sum()), experiments, BETA, planted=True))
    return rows


def _compare_with_anytime(failures: Array, mean: Array, log_m: Array, rng: np.random.Generator, *, upper: bool, places: int = 20) -> None:
    """The limits of `anytime` miss where the evidence says so."""
    for _ in range(places):
        i, j = int(rng.integers(failures.shape[0])), int(rng.integers(failures.shape[1]))
        alpha = float(np.exp(-max(1e-6, abs(log_m[i, j]) * rng.uniform(0.5, 1.5))))
        n, s, m = j + 1, int(failures[i, j]), float(mean[i, j])
        missed = m > anytime.upper(n, s, alpha) if upper else m < anytime.lower(n, s, alpha)
        if missed != (log_m[i, j] >= -math.log(alpha)) and abs(log_m[i, j] + math.log(alpha)) > 1e-6:
            raise AssertionError(f"n {n}, S {s}, mean {m}: the limit {'misses' if missed else 'holds'}, log M is {log_m[i, j]}")


def lives(experiments: int, runs: int, rng: np.random.Generator) -> dict[str, Any]:
    """Robots with several controllers, by turns good and bad: a miss of any limit of any sequence."""
    missed = np.zeros(experiments, dtype=bool)
    kinds = list(processes(runs).values())
    for number in range(1, CONTROLLERS + 1):
        made = drawn(kinds[number % len(kinds)], experiments, runs, rng)
        part = share(BUDGET, number)
        for upper, beta in ((True, (1.0 - LOWER_SHARE) * part), (False, LOWER_SHARE * part)):
            missed |= np.any(evidence(made.failures, made.mean, upper=upper) >= -math.log(beta), axis=1)
    return row(f"a life of {CONTROLLERS} controllers, all limits", int(missed.sum()), experiments, BUDGET)


def row(what: str, missed: int, experiments: int, beta: float, *, planted: bool = False) -> dict[str, Any]:
    """One count. planted: a fault that must be caught rather than a promise that must hold."""
    lower = clopper_pearson_lower(missed, experiments, SURE)
    found = {"what": what, "experiments": experiments, "missed": missed, "share": missed / experiments, "lower": lower, "beta": beta}
    return {**found, "planted": planted, "ok": (lower > beta) == planted}


def revoked_after(fails: float, experiments: int, most: int, rng: np.random.Generator) -> Array:
    """Runs until the lower limit of the first controller of a robot exceeds MAX_UNSAFE; inf where it does not within `most`."""
    beta = LOWER_SHARE * share(BUDGET, 1)
    least: dict[int, int] = {}
    after = np.full(experiments, np.inf)
    outcomes = rng.random((experiments, most)) < fails
    for e in range(experiments):
        for s, n in enumerate(np.flatnonzero(outcomes[e]) + 1, 1):  # the limit grows with a failure alone
            if s not in least:  # largest n at which s failures exceed it
                least[s] = _largest(s, beta, most)
            if n <= least[s]:
                after[e] = n
                break
    return after


def _largest(failures: int, beta: float, most: int) -> int:
    low, high = 0, most + 1
    while high - low > 1:
        middle = (low + high) // 2
        exceeds = middle < failures or anytime.lower(middle, failures, beta) > MAX_UNSAFE
        low, high = (middle, high) if exceeds else (low, middle)
    return low


def figures(experiments: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """What must be met besides coverage."""
    upper_share = (1.0 - LOWER_SHARE) * share(BUDGET, 1)
    width = anytime.upper(WIDTH_N, 0, BETA) / clopper_pearson_upper(0, WIDTH_N, BETA)
    after = revoked_after(FAILS, experiments, 3000, rng)
    false = float(np.mean(np.isfinite(revoked_after(MAX_UNSAFE, experiments, 3000, rng))))
    counts = [anytime.Counts(int(n), int(n * 0.02), int(n * 0.01)) for n in rng.integers(1, 5000, 200)]
    began = time.process_time()
    for one in counts:
        anytime.limits(one, 0.0125, 0.0375)
        anytime.limits(one, 0.005, 0.015)
    update_ms = (time.process_time() - began) / len(counts) * 1e3
    median = float(np.median(after))
    false_limit = clopper_pearson_lower(round(false * experiments), experiments, SURE)
    return [
        {"what": f"width after {WIDTH_N} safe runs, over Clopper-Pearson's", "value": width, "most": WIDTH, "ok": width <= WIDTH},
        {
            "what": f"upper limit after {BOUND_N} safe runs, first controller",
            "value": anytime.upper(BOUND_N, 0, upper_share),
            "most": BOUND,
            "ok": anytime.upper(BOUND_N, 0, upper_share) <= BOUND,
        },
        {"what": f"runs until {FAILS:.0%} is revoked at {MAX_UNSAFE:.0%}, median", "value": median, "most": REVOKED_AFTER}
        | {"ok": median <= REVOKED_AFTER},
        {"what": f"robots at exactly {MAX_UNSAFE:.0%} that are revoked within 3000 runs", "value": false}
        | {"most": LOWER_SHARE * share(BUDGET, 1), "ok": false_limit <= LOWER_SHARE * share(BUDGET, 1)},
        {"what": "update of two sequences, ms of CPU", "value": update_ms, "most": UPDATE_MS, "ok": update_ms <= UPDATE_MS},
    ]


def main(arguments: list[str]) -> int:
    """Everything, as tables or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--experiments", type=int, default=2000)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="300 experiments of 400 runs")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    experiments, runs = (300, 400) if args.quick else (args.experiments, args.runs)
    rng, began = np.random.default_rng(args.seed), time.process_time()
    rows = [*coverage(experiments, runs, rng), lives(experiments, runs, rng)]
    found = figures(experiments, rng)
    if args.json:
        print(json.dumps({"beta": BETA, "runs": runs, "rows": rows, "figures": found}))
    else:
        print(f"{experiments} experiments of {runs} runs, limits read after every run")
        for one in rows:
            verdict = "as it must be" if one["ok"] else "WRONG"
            print(f"{one['what']:60s} missed {one['share']:7.2%}, at least {one['lower']:6.2%}  beta {one['beta']:.0%}  {verdict}")
        for one in found:
            print(f"{one['what']:60s} {one['value']:.4g}, at most {one['most']:.4g}  {'as it must be' if one['ok'] else 'MISSED'}")
        print(f"{time.process_time() - began:.0f} s of CPU")
    return 0 if all(one["ok"] for one in (*rows, *found)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
