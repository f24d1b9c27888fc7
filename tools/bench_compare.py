"""Means with simulation, optimism and comparison (guarantee G11, G12, G14) by repetition, and how many runs they need.

    tools/bench_compare.py [--repetitions 1000] [--seed 1] [--json]

Coverage: whole experiments with a look after every run; a miss is any look at which something false was claimed. A promise is broken if
the exact 99.9 % lower limit of the miss rate exceeds beta. Planted faults must be caught: the asymptotic prediction-powered interval at
n = 20, slopes fitted on the pairs that they judge, and fixed-number tests read after every run.

Width: runs for an interval of half-width h with a simulator of correlation rho, over (1 - rho^2) times the runs without one. `best` is
that ratio for the bet that knows the distribution of the pairs, from its growth: the binary information that no method gets past.

Comparison: mean runs of the sequential test, stopped at the latest where its power is that of Barnard's test with a fixed number.
Limit: the upper limits after n pairs that all agree, and 1 - beta^(1/n). Exit 1 if a promise is broken or a fault is not caught.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import binom, norm

from s2r_runtime.evidence import betting, real_means
from s2r_runtime.evidence.bounds import clopper_pearson_lower

Array = NDArray[np.float64]

BETA, SURE = 0.05, 1e-3
RUNS, ROLLOUTS = 200, 300
"""Runs of an experiment, each followed by a look; rollouts for the simulator's mean."""
BLOCK = 250
"""Experiments at a time: their arrays stay small."""
FAIL = 0.2
"""Failure probability of the real runs, unless it drifts."""
WIDTHS = ((0.3, 0.05), (0.3, 0.02), (0.1, 0.03), (0.1, 0.01))
"""p and half-width."""
CORRELATIONS = (0.5, 0.8, 0.9)
STEP_PAIRS = ((0.5, 0.7), (0.8, 0.9))
"""Success rates of T. Snyder et al., *Is your imitation learning policy better than mine?* (RSS 2025)."""
POWERS = (0.8, 0.9, 0.95)


class Row(NamedTuple):
    """One check. `planted`: a fault that must be caught rather than a promise that must hold."""

    what: str
    n: int
    repetitions: int
    missed: int
    lower: float
    beta: float
    planted: bool

    @property
    def ok(self) -> bool:
        """Whether it came out as it must."""
        return (self.lower > self.beta) == self.planted


def row(what: str, n: int, missed: NDArray[np.bool_], beta: float = BETA, *, planted: bool = False) -> Row:
    """Counts the misses, with the exact lower limit of their rate."""
    count = int(np.count_nonzero(missed))
    return Row(what, n, len(missed), count, clopper_pearson_lower(count, len(missed), SURE), beta, planted)


# ---------------------------------------------------------------- pairs of a real and a simulated run


class Experiments(NamedTuple):
    """R experiments: merits real, simulated (R, n), means of both given the past (n,), and rollouts (R, N)."""

    real: Array
    simulated: Array
    mean: Array
    simulated_mean: float
    rollouts: Array


def experiments(kind: str, repetitions: int, rng: np.random.Generator, n: int = RUNS) -> Experiments:
    """kind: `right`, `wrong` (unrelated, and never fails as often), `anti` (fails where the robot does not), `drifting` (the robot's
    failures come and go, the simulator's do not).
    """
    u, v = rng.random((2, repetitions, n))
    fail = FAIL * (1.0 + np.sin(np.arange(n) / 15.0)) if kind == "drifting" else np.full(n, FAIL)
    real = (u >= fail).astype(np.float64)
    if kind in {"right", "drifting"}:
        shared = rng.random((repetitions, n)) < 0.8
        simulated, simulated_fail = np.where(shared, u >= FAIL, v >= FAIL).astype(np.float64), FAIL
    elif kind == "wrong":
        simulated, simulated_fail = (v >= 0.05).astype(np.float64), 0.05
    else:
        simulated, simulated_fail = (u < FAIL).astype(np.float64), 1.0 - FAIL
    rollouts = (rng.random((repetitions, ROLLOUTS)) >= simulated_fail).astype(np.float64)
    return Experiments(real, simulated, 1.0 - fail, 1.0 - simulated_fail, rollouts)


def mean_misses(e: Experiments) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether an experiment's sequence was ever wrong: the limits of the mean (of its largest and least value, where it drifts), and those
    of the running mean. The capital at the true value is at the threshold exactly where the limit is beyond it.
    """
    share = (1.0 - real_means.ROLLOUT_SHARE) * BETA
    expected = real_means.from_rollouts(e.rollouts, real_means.ROLLOUT_SHARE * BETA)
    slope = real_means.slopes(e.real, e.simulated - 0.5 * (expected.low + expected.high))[..., :-1]
    mirrored = real_means.Expected(1.0 - expected.high, 1.0 - expected.low, expected.known)
    bar, constant, running = np.log(2.0 / share), [], []
    for real, simulated, known, mean in (
        (e.real, e.simulated, expected, e.mean),
        (1.0 - e.real, 1.0 - e.simulated, mirrored, 1.0 - e.mean),
    ):
        x, least = real_means.corrected(real, simulated, known, slope)
        constant.append(np.any(betting.log_capital(x, least, float(np.max(mean))) >= bar, axis=-1))
        spread = real_means.spread(known)
        deviation = np.cumsum(x - mean, axis=-1) / spread
        running.append(np.any(betting.running_log_capital(deviation, betting.variations(x, least, spread)) >= bar, axis=-1))
    return constant[0] | constant[1], running[0] | running[1]


def fresh_misses(e: Experiments, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The same limits of the mean, with ten fresh rollouts for each run instead of a bound on the simulator's mean."""
    fresh = rng.binomial(10, e.simulated_mean, e.real.shape) / 10.0
    expected, mirrored = real_means.from_fresh(fresh), real_means.from_fresh(1.0 - fresh)
    slope = real_means.slopes(e.real, e.simulated - fresh)[..., :-1]
    missed = np.zeros(len(e.real), np.bool_)
    for real, simulated, known, mean in (
        (e.real, e.simulated, expected, e.mean),
        (1.0 - e.real, 1.0 - e.simulated, mirrored, 1.0 - e.mean),
    ):
        x, least = real_means.corrected(real, simulated, known, slope)
        missed |= np.any(betting.log_capital(x, least, float(np.max(mean))) >= np.log(2.0 / BETA), axis=-1)
    return missed


def optimism_misses(e: Experiments) -> NDArray[np.bool_]:
    """Whether the upper limit of the optimism was ever below the least of its true values."""
    d, least_true = e.simulated - e.real, e.simulated_mean - float(np.max(e.mean))
    return np.any(betting.log_capital(-d, -1.0, -least_true) >= np.log(1.0 / BETA), axis=-1)


def coverage_rows(repetitions: int, rng: np.random.Generator) -> list[Row]:
    """G11 and G12 for each kind of simulator."""
    rows = []
    for kind in ("right", "wrong", "anti", "drifting"):
        parts = [experiments(kind, min(BLOCK, repetitions - k), rng) for k in range(0, repetitions, BLOCK)]
        constant, running = (np.concatenate(found) for found in zip(*map(mean_misses, parts), strict=True))
        rows += [
            row(f"mean, {kind} simulator", RUNS, constant),
            row(f"running mean, {kind} simulator", RUNS, running),
            row(f"mean, fresh rollouts, {kind} simulator", RUNS, np.concatenate([fresh_misses(e, rng) for e in parts])),
            row(f"optimism, {kind} simulator", RUNS, np.concatenate([optimism_misses(e) for e in parts])),
        ]
    return rows


def naive_rows(repetitions: int, rng: np.random.Generator) -> list[Row]:
    """Faults that must be caught."""
    n, fail = 20, 0.1
    real = (rng.random((repetitions, n)) < fail).astype(np.float64)
    simulated = np.where(rng.random(real.shape) < 0.9, real, (rng.random(real.shape) < fail).astype(np.float64))
    residual = real - (simulated - fail)
    z, spread = float(norm.ppf(1.0 - BETA / 2.0)), np.std(residual, axis=1, ddof=1)
    asymptotic = np.abs(residual.mean(axis=1) - fail) > z * spread / np.sqrt(n)
    # one real score and eight simulators that have nothing to do with it: their slopes are fitted on the pairs that they judge
    score, eight = rng.random((repetitions, n)), rng.random((repetitions, n, 8)) - 0.5
    same = np.empty(repetitions, np.bool_)
    for k in range(repetitions):
        slope = np.linalg.lstsq(eight[k] - eight[k].mean(axis=0), score[k] - score[k].mean(), rcond=None)[0]
        x = score[k] - eight[k] @ slope
        same[k] = abs(x.mean() - 0.5) > z * x.std(ddof=1) / np.sqrt(n)
    a, b = (rng.random((2, repetitions, RUNS)) < 0.5).astype(np.float64)
    d, runs = np.cumsum(b - a, axis=1), np.arange(1, RUNS + 1)
    pooled = (np.cumsum(a, axis=1) + np.cumsum(b, axis=1)) / (2.0 * runs)
    looks = np.abs(d) / np.sqrt(np.maximum(2.0 * runs * pooled * (1.0 - pooled), 1e-12)) > z
    return [
        row("fault: asymptotic prediction-powered interval", n, asymptotic, planted=True),
        row("fault: slopes fitted on the pairs they judge", n, same, planted=True),
        row("fault: two-sample test read after every pair", RUNS, np.any(looks[:, 9:], axis=1), planted=True),
    ]


# ---------------------------------------------------------------- comparison


def pairs(kind: str, repetitions: int, rng: np.random.Generator, n: int = 300) -> tuple[Array, Array, float]:
    """Merits of A and B (R, n), and the mean of A - B, which the drift does not change."""
    u, v = rng.random((2, repetitions, n))
    if kind == "B worse by delta":
        return (u < 0.7).astype(np.float64), (v < 0.6).astype(np.float64), 0.1
    rate = 0.5 + 0.4 * np.sin(np.arange(n) / 20.0) if kind == "equal, drifting" else np.full(n, 0.8)
    if kind == "equal, anti-correlated":
        return (u < rate).astype(np.float64), (u >= 1.0 - rate).astype(np.float64), 0.0
    if kind == "equal scores":
        return u, u**0.9 - 0.0 * v, 1.0 / 2.0 - 1.0 / 1.9
    return (u < rate).astype(np.float64), (v < rate).astype(np.float64), 0.0


def comparison_rows(repetitions: int, rng: np.random.Generator) -> list[Row]:
    """G14: whether anything false was ever shown at the true difference, which is the limit of both null hypotheses."""
    rows = []
    for kind in ("equal", "equal, anti-correlated", "equal, drifting", "equal scores", "B worse by delta"):
        a, b, difference = pairs(kind, repetitions, rng)
        d = a - b
        capitals = (betting.log_capital(x, -1.0, mean, betting.COMPARISON_BETS) for x, mean in ((d, difference), (-d, -difference)))
        missed = np.any([np.any(log >= np.log(2.0 / BETA), axis=-1) for log in capitals], axis=0)
        rows.append(row(f"comparison, {kind}", a.shape[1], missed))
    return rows


def barnard(n: int, alpha: float) -> NDArray[np.bool_]:
    """Rejection region (n + 1, n + 1) of Barnard's one-sided test of n runs each, by the pooled z statistic, exact over all rates."""
    first, second = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    pooled = (first + second) / (2.0 * n)
    variance = pooled * (1.0 - pooled) * 2.0 / n
    z = np.divide((second - first) / n, np.sqrt(variance), out=np.zeros(variance.shape), where=variance > 0.0)
    cuts = np.unique(np.round(z, 10))
    weights = [binom.pmf(np.arange(n + 1), n, p) for p in np.linspace(0.01, 0.99, 99)]
    low, high = 0, len(cuts) - 1
    while low < high:
        middle = (low + high) // 2
        region = z >= cuts[middle] - 1e-9
        low, high = (low, middle) if max(float(w @ region @ w) for w in weights) <= alpha else (middle + 1, high)
    return np.asarray(z >= cuts[low] - 1e-9)


def barnard_runs(p: float, q: float, power: float, alpha: float) -> int:
    """Fewest runs of each controller with which Barnard's test finds q > p with this probability."""
    z = float(norm.ppf(1.0 - alpha) + norm.ppf(power))
    n = max(int(0.85 * z**2 * (p * (1.0 - p) + q * (1.0 - q)) / (q - p) ** 2), 5)
    while True:
        counts = np.arange(n + 1)
        if float(binom.pmf(counts, n, p) @ barnard(n, alpha) @ binom.pmf(counts, n, q)) >= power:
            return n
        n += 1


def savings(repetitions: int, rng: np.random.Generator, n: int = 900) -> list[dict[str, Any]]:
    """Mean runs of the sequential comparison at the power of Barnard's test, one side at beta/2 each."""
    found = []
    for p, q in STEP_PAIRS:
        d = (rng.random((repetitions, n)) < q).astype(np.float64) - (rng.random((repetitions, n)) < p)
        shown = betting.log_capital(d, -1.0, 0.0, betting.COMPARISON_BETS) >= np.log(2.0 / BETA)
        stopped = np.where(shown.any(axis=1), shown.argmax(axis=1) + 1, n + 1)
        for power in POWERS:
            fixed = barnard_runs(p, q, power, BETA / 2.0)
            latest = int(np.quantile(stopped, power, method="higher"))
            mean = float(np.minimum(stopped, latest).mean())
            error = float(np.minimum(stopped, latest).std() / np.sqrt(repetitions))
            found.append(
                {
                    "p": p,
                    "q": q,
                    "power": power,
                    "barnard": fixed,
                    "mean": mean,
                    "error": error,
                    "latest": latest,
                    "saved": 1.0 - mean / fixed,
                }
            )
    return found


# ---------------------------------------------------------------- width


def half_width(real: Array, simulated: Array, p: float, n: int, *, alone: bool) -> float:
    """Mean half-width of the interval after n runs."""
    y, f = real[:, :n], simulated[:, :n]
    expected = real_means.Expected(np.array([p]), np.array([p]), known=True)
    slope = np.zeros_like(y) if alone else real_means.slopes(y, f - p)[..., :-1]
    low, high = real_means.limits(y, f, expected, slope, BETA)
    return float(np.mean(high - low) / 2.0)


def runs_for(half: float, p: float, rho: float, uniform: Array) -> int:
    """Runs after which the mean half-width is `half`: binary outcomes of probability p, a binary simulator of correlation rho.

    uniform: (3, R, n), the same for every rho.
    """
    real = (uniform[0] < p).astype(np.float64)
    simulated = np.where(uniform[1] < rho, real, (uniform[2] < p).astype(np.float64))
    n = int(real.shape[1] * (1.0 - rho**2)) // 2
    for _ in range(6):
        following = round(n * (half_width(real, simulated, p, n, alone=rho == 0.0) / half) ** 2)
        following = min(max(following, 20), real.shape[1])
        if abs(following - n) <= 0.003 * n:
            return following
        n = following
    return n


def growth(p: float, rho: float, mean: float) -> float:
    """Largest expected log factor, nats a run, against "E[Y] is `mean`, E[f] is p", of bets that know the distribution of the pair."""
    both = p * p + rho * p * (1.0 - p)
    pmf = {(1, 1): both, (1, 0): p - both, (0, 1): p - both, (0, 0): 1.0 - 2.0 * p + both}

    def loss(bet: Array) -> float:
        factors = [1.0 + bet[0] * (y - mean) + bet[1] * (f - p) for y, f in pmf]
        return -sum(q * np.log(x) for q, x in zip(pmf.values(), factors, strict=True)) if min(factors) > 0.0 else 1e3

    toward = 1.0 if p > mean else -1.0
    begins = (np.array([toward * size, -rho * toward * size]) for size in (0.05, 0.3, 0.8))
    options = {"xatol": 1e-7, "fatol": 1e-12, "maxiter": 4000}
    return -min(float(minimize(loss, begin, method="Nelder-Mead", options=options).fun) for begin in begins)


def widths(repetitions: int, rng: np.random.Generator) -> list[dict[str, float]]:
    """Runs with a simulator over (1 - rho^2) times those without, and the least ratio that a bet can reach."""
    found = []
    for p, half in WIDTHS:
        uniform, slowest = rng.random((3, repetitions, int(12.0 * p * (1.0 - p) / half**2))), {}
        alone = runs_for(half, p, 0.0, uniform)
        for rho in (0.0, *CORRELATIONS):
            slowest[rho] = sum(1.0 / growth(p, rho, p + side * half) for side in (-1.0, 1.0))
        for rho in CORRELATIONS:
            n, formula = runs_for(half, p, rho, uniform), 1.0 - rho**2
            best = slowest[rho] / (slowest[0.0] * formula)
            found.append({"p": p, "half_width": half, "rho": rho, "alone": alone, "runs": n, "ratio": n / (alone * formula), "best": best})
    return found


def agreeing() -> list[dict[str, float]]:
    """Upper limits after n pairs that agree on safe: the least valid one, of the optimism, and of P(unsafe) with a simulator."""
    found = []
    for n in (29, 59, 299, 1000):
        ones = np.ones(n)
        optimism = real_means.optimism(ones, ones, beta=BETA).upper
        mean = real_means.mean_with_simulation(ones, ones, rollouts=np.ones(10_000), beta=BETA)
        found.append({"n": n, "least": real_means.least_upper_limit(n, BETA), "optimism": optimism, "unsafe": 1.0 - mean.lower})
    return found


def main(arguments: list[str]) -> int:
    """Runs all and prints tables, or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="few repetitions, which catch no fault")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    began, rng = time.process_time(), np.random.default_rng(given.seed)
    repetitions = 50 if given.quick else given.repetitions
    rows = coverage_rows(repetitions, rng) + comparison_rows(repetitions, rng) + naive_rows(repetitions, rng)
    saved = savings(2 * repetitions, rng)
    wide = widths(max(repetitions // 40, 4), rng)
    limits = agreeing()
    seconds = time.process_time() - began
    ok = all(r.ok for r in rows) and all(one["optimism"] >= one["least"] and one["unsafe"] >= one["least"] for one in limits)
    if given.json:
        plain = [{**r._asdict(), "rate": r.missed / r.repetitions, "ok": r.ok} for r in rows]
        print(json.dumps({"ok": ok, "beta": BETA, "cpu_s": seconds, "rows": plain, "saved": saved, "widths": wide, "limits": limits}))
        return 0 if ok else 1
    print(f"{'':50s} {'n':>5s} {'runs':>6s} {'missed':>8s} {'99.9 % lower':>13s}    beta {BETA:.0%}")
    for r in rows:
        verdict = ("caught" if r.ok else "NOT CAUGHT") if r.planted else ("holds" if r.ok else "BROKEN")
        print(f"{r.what:50s} {r.n:5d} {r.repetitions:6d} {r.missed / r.repetitions:8.2%} {r.lower:13.2%}  {verdict}")
    for s in saved:
        print(
            f"comparison {s['p']:g} vs {s['q']:g}, power {s['power']:.0%}: {s['mean']:.0f} pairs (+-{s['error']:.1f}), at most "
            f"{s['latest']}; Barnard {s['barnard']}: {s['saved']:.0%} fewer"
        )
    for w in wide:
        print(
            f"width p {w['p']:g} +-{w['half_width']:g}, rho {w['rho']:g}: {w['runs']} runs, without {w['alone']}; "
            f"{w['ratio']:.2f} x formula, the best bet {w['best']:.2f} x"
        )
    for one in limits:
        print(f"{one['n']} pairs agree: optimism <= {one['optimism']:.2%}, unsafe <= {one['unsafe']:.2%}, least valid {one['least']:.2%}")
    print(f"{seconds:.1f} s of CPU")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
