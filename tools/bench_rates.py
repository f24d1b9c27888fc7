"""Coverage of the gap (G1, G7) for robots that report at odd rates and with jitter, by repetition.

    tools/bench_rates.py [--repetitions 1000] [--seed 1] [--json]

A planar robot does 15 % more than it is commanded, after a short lag; the model lacks both. It reports `rate` times a step, each time off
by up to `jitter` of the interval. The campaign itself (`s2r_runtime.evidence.comparison`) drives it, one call a control instant: the
observation nearest to the grid. The law is what a whole step shows: from the same states and inputs, the robot's state exactly one step
later, with noise of its own. A promise is broken if the exact 99.9 % lower limit of the rate at which a gap misses it exceeds beta. Planted
fault: the rules of before, which took an observation 0.9 steps after the last one and compared it with a whole step. Exit 1 if a promise
breaks or the fault is not caught.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import time
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.evidence.bounds import clopper_pearson_lower, sample_size
from s2r_runtime.evidence.comparison import Campaign
from s2r_runtime.evidence.gap import discrepancy, estimate_gap
from s2r_runtime.messages import GRID, RULES, Observation, SampleTaken
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Sampling
from s2r_runtime.recordings.loading import from_samples

Array = NDArray[np.float64]

DT, LAG, GAIN, NOISE = 0.1, 0.005, 1.15, 0.0003
"""s, s, none, m and rad."""
EPSILON, BETA, SURE = 0.1, 0.05, 1e-3
BOUNDS = ((-0.5, 0.5), (-2.0, 2.0))
REGION = ((-1.0, 1.0), (-1.0, 1.0), (-math.pi, math.pi))
FENCE = ((-2.0, 2.0), (-2.0, 2.0), (-math.pi, math.pi))
WEIGHTS = (1.0, 1.0, 0.1)
SAMPLING = Sampling(hold_periods=4, stop_periods=2, waypoint_radius=0.6, waypoint_margin=0.1, max_rejections=100_000)
RATES, JITTERS = (1.0, 3.0, 7.0, 9.0, 9.5, 10.0, 25.0), (0.0, 0.3)
MODEL = compose(ModelSpec("unicycle", DT))
State = tuple[float, float, float, float, float]


class Row(NamedTuple):
    """One rate and jitter. `planted`: a fault that must be caught; `rejected`: samples that were rejected, for each one that counted."""

    rate: float
    jitter: float
    repetitions: int
    missed: int
    lower: float
    rejected: float
    planted: bool

    @property
    def ok(self) -> bool:
        """Whether it came out as it must."""
        return (self.lower > BETA) == self.planted


def moved(s: State, u: tuple[float, ...], t: float) -> State:
    """x, y, theta, v, w after t s: v and w follow u with the lag, exactly; the path by Simpson's rule, right to 1e-9 m here."""
    if t <= 0.0:
        return s
    u = (GAIN * u[0], GAIN * u[1])
    keep = math.exp(-t / LAG)
    half = math.exp(-0.5 * t / LAG)
    v, w = u[0] + (s[3] - u[0]) * keep, u[1] + (s[4] - u[1]) * keep
    middle_v = u[0] + (s[3] - u[0]) * half
    middle_theta = s[2] + u[1] * 0.5 * t + (s[4] - u[1]) * LAG * (1.0 - half)
    theta = s[2] + u[1] * t + (s[4] - u[1]) * LAG * (1.0 - keep)
    x = s[0] + t / 6.0 * (s[3] * math.cos(s[2]) + 4.0 * middle_v * math.cos(middle_theta) + v * math.cos(theta))
    y = s[1] + t / 6.0 * (s[3] * math.sin(s[2]) + 4.0 * middle_v * math.sin(middle_theta) + v * math.sin(theta))
    return x, y, theta, v, w


class Robot:
    """Reports at its rate; the campaign answers at control instants."""

    def __init__(self, rate: float, jitter: float, rng: random.Random) -> None:
        self._interval, self._jitter, self._rng = DT / rate, jitter, rng
        self._s: State = (0.0, 0.0, 0.0, 0.0, 0.0)
        self._t, self._k, self._due, self._last = 0.0, 0, 0.0, 0.0
        self.u: tuple[float, ...] = (0.0, 0.0)
        self._true: dict[int, State] = {}

    def seen(self, s: State) -> tuple[float, float, float]:
        """A state as it is measured."""
        x, y, theta = (value + self._rng.gauss(0.0, NOISE) for value in s[:3])
        return x, y, math.remainder(theta, 2.0 * math.pi)

    def next_instant(self, *, before: bool) -> Observation:
        """The observation that is the next control instant. before: by the rules of before."""
        while True:
            self._k += 1
            t = max(self._t + 1e-6, (self._k + self._jitter * self._rng.uniform(-0.5, 0.5)) * self._interval)
            self._s, interval, self._t = moved(self._s, self.u, t - self._t), t - self._t, t
            if (t - self._last >= 0.9 * DT - 1e-9) if before else (t + 0.5 * min(interval, DT) >= self._due - 1e-9):
                break
        self._last, self._due = t, self._due + DT * (1 + max(0, math.floor((t - self._due) / DT + 0.5)))
        self._true = {number: s for number, s in self._true.items() if number > self._k - 500} | {self._k: self._s}
        return Observation(self._k, round(t * 1e9), self.seen(self._s))

    def whole_step(self, sample: SampleTaken) -> tuple[float, float, float]:
        """What would be seen one step after x0."""
        return self.seen(moved(self._true[sample.obs_seq0], sample.u, DT))


def experiments(rate: float, jitter: float, count: int, n: int, seed: int, rules: int) -> tuple[list[float], list[float], float]:
    """Radii of so many campaigns of n samples; the discrepancies of whole steps at all their samples; rejections a sample."""
    rng = random.Random(f"{seed}/{rate}/{jitter}/{rules}")
    robot, radii, whole, rejected = Robot(rate, jitter, rng), [], [], 0
    sampling = SAMPLING if rules >= GRID else msgspec.structs.replace(SAMPLING, hold_periods=1)  # they never met the end of four
    names = ("x", "y", "theta")
    for number in range(count):
        campaign = Campaign(
            "unicycle", names, ("theta",), REGION, FENCE, BOUNDS, DT, sampling,
            n=n, epoch=1, seed=1000 * seed + number, rules=rules, any_step=rules >= GRID,
        )  # fmt: skip
        samples: list[SampleTaken] = []
        ends: list[tuple[float, float, float]] = []
        while len(samples) < n:
            step = campaign.step(robot.next_instant(before=rules < GRID))
            if step.failed:
                raise RuntimeError(step.failed)
            if step.sample is not None:
                samples.append(step.sample)
                ends.append(robot.whole_step(step.sample))
            robot.u = step.u
        rejected += sum(campaign.progress().rejected.values())
        gap = estimate_gap(MODEL, from_samples(samples), epsilon=EPSILON, beta=BETA, weights=WEIGHTS)
        radii.append(gap.radius)
        x0, u = np.array([s.x0 for s in samples]), np.array([s.u for s in samples])
        predicted, _ = MODEL.step(x0, u, MODEL.at_rest(n))
        whole += discrepancy(MODEL.difference(np.array(ends), predicted), np.array(WEIGHTS), "ball").tolist()
    return radii, whole, rejected / (count * n)


def measured(rate: float, jitter: float, repetitions: int, seed: int, rules: int = RULES) -> Row:
    """One half are the experiments; the other half are the law."""
    n = sample_size(EPSILON, BETA)
    radii, _, rejected = experiments(rate, jitter, repetitions, n, seed, rules)
    _, whole, _ = experiments(rate, jitter, repetitions, n, seed + 1, rules)
    law = np.sort(np.array(whole))
    above = 1.0 - np.searchsorted(law, np.array(radii), side="right") / len(law)
    missed = int(np.count_nonzero(above > EPSILON))
    return Row(rate, jitter, repetitions, missed, clopper_pearson_lower(missed, repetitions, SURE), rejected, rules < GRID)


def main(arguments: list[str]) -> int:
    """Runs all and prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    began = time.process_time()
    rows = [measured(rate, jitter, given.repetitions, given.seed) for rate in RATES for jitter in JITTERS]
    rows.append(measured(10.0, 0.0, given.repetitions, given.seed, rules=0))
    ok, seconds = all(row.ok for row in rows), time.process_time() - began
    if given.json:
        print(json.dumps({"ok": ok, "beta": BETA, "cpu_s": seconds, "rows": [{**row._asdict(), "ok": row.ok} for row in rows]}))
        return 0 if ok else 1
    print(f"epsilon {EPSILON:.0%}, beta {BETA:.0%}, N = {sample_size(EPSILON, BETA)}")
    print(f"{'reports a step':>14s} {'jitter':>7s} {'runs':>6s} {'missed':>8s} {'99.9 % lower':>13s} {'rejected a sample':>18s}")
    for row in rows:
        verdict = ("caught" if row.ok else "NOT CAUGHT") + ": rules of before" if row.planted else "holds" if row.ok else "BROKEN"
        rate = row.missed / row.repetitions
        print(f"{row.rate:14g} {row.jitter:7.0%} {row.repetitions:6d} {rate:8.2%} {row.lower:13.2%} {row.rejected:18.3f}  {verdict}")
    print(f"{seconds:.1f} s of CPU")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
