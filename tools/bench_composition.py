"""Composed statements by repetition (guarantee G13): how often they miss the true closed loop when read after every run.

    tools/bench_composition.py [--experiments 1000] [--runs 200] [--seed 1] [--quick] [--json]

An experiment is a robot: a point mass under linear feedback in front of a wall at a random distance. Its tube is tight, that is, some
disturbance sequence in D^J reaches its edge. The runs are simulated step by step; their residuals are computed from states and inputs as
those of a log. What pushes the robot inside D, and with which probability a run leaves D, depends on the row: a right simulator, one
that lacks a constant push of the worst kind, runs that leave D just where the scenario is enclosed (anti-correlated: then the sum of both
terms is the truth), probabilities that drift, and probabilities that depend on the past. A run that leaves D is unsafe.

It is a miss if the mean of the true probabilities of an unsafe run so far is above the statement after any run. A promise is broken if the
exact 99.9 % lower limit of the share of experiments with a miss exceeds beta. Planted faults must be caught by the same count: a second
term from sampled disturbances, and a first term by Clopper-Pearson, read after every run. The test of the assumption on who drives is
counted, too: refuted by mistake, and its power. Exit 1 if a promise is broken or a fault is not caught.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper
from s2r_runtime.evidence.composition import LEVEL, DrivenRun, dependence, enclosure_limit, inside_limit, largest_residual
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.enclosure import closed_loop, enclose, linear_tube
from s2r_runtime.evidence.uncertain import roll_out
from s2r_runtime.hookspecs import Scenario
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

BETA, SURE = 0.05, 1e-3
STEPS = 20
NAIVE_RUNS = 1000
SCENARIOS = 1000
"""Enclosed in each experiment."""
GAIN = np.array([[1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 2.0]])
MODEL = compose(ModelSpec("double_integrator", 0.1))
GAP = GapSet("ball", (1.0, 1.0, 0.5, 0.5), 0.001, 0.005, 50)
NOT_ENCLOSED = 0.1
"""True probability that a scenario is not enclosed: the wall is nearer than the tube's reach."""


class Corridor:
    """Interface: `hookspecs.Task`. Stay at 0; a wall stands at a distance that is uniform in (0, far)."""

    name = "corridor"
    position = ("x",)
    horizon = STEPS
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {}

    def __init__(self, far: float) -> None:
        self.far = far

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """n walls."""
        return {"start": np.zeros((n, 4)), "wall": rng.uniform(0.0, self.far, n)}

    def draw_at(self, rng: np.random.Generator, x: Array) -> Scenario:
        """One wall."""
        return {"start": x[None, :], "wall": rng.uniform(0.0, self.far, 1)}

    def advance(self, scenario: Scenario, rng: np.random.Generator) -> Scenario:
        """Nothing moves."""
        return scenario

    def view(self, scenario: Scenario) -> Scenario:
        """The wall."""
        return {"wall": scenario["wall"]}

    def clearance(self, x: Array, scenario: Scenario) -> Array:
        """Distance from the wall, m, (n,)."""
        return np.asarray(scenario["wall"] - x[:, 0])

    def enclosed(self, x: Array, reach: float, scenario: Scenario, threshold: float) -> tuple[Bools, Bools]:
        """In front of the wall by `reach`; never over."""
        return self.clearance(x, scenario) - reach >= threshold, np.zeros(len(x), dtype=np.bool_)

    def begin(self, scenario: Scenario) -> Array:
        """Least clearance so far, m, (n,)."""
        return np.full(len(scenario["wall"]), np.inf)

    def observe(self, tally: Array, x: Array, scenario: Scenario) -> Array:
        """Takes note."""
        return np.minimum(tally, self.clearance(x, scenario))

    def safety(self, tally: Array) -> Array:
        """Least clearance."""
        return tally

    def progress(self, tally: Array) -> Array:
        """None is needed."""
        return np.zeros(len(tally))

    def done(self, tally: Array) -> Bools:
        """At the horizon only."""
        return np.zeros(len(tally), dtype=np.bool_)

    def progress_ok(self, progress: Array) -> bool:
        """It is."""
        return True


def hold(x: Array, theta: Scenario) -> Array:
    """Linear feedback to 0."""
    return np.asarray(-x @ GAIN.T)


MATRIX = closed_loop(MODEL, GAIN)
TUBE = linear_tube(MATRIX, GAP, [0], STEPS)
TASK = Corridor(float(TUBE.reach[-1]) / NOT_ENCLOSED)


def worst_sequence() -> Array:
    """Disturbances in D, (STEPS, 4), that bring the robot to the edge of its tube in the last step."""
    found = []
    for k in range(STEPS):
        way = np.linalg.matrix_power(MATRIX, STEPS - 1 - k)[0] / np.asarray(GAP.weights)
        found.append(GAP.radius * way / np.linalg.norm(way) / np.asarray(GAP.weights))
    return np.array(found)


Leaving = Callable[[int, Array], tuple[Array, Array]]
"""(run, runs since the last one outside) -> probability that the run leaves D given the past: where the scenario is enclosed, and where it
is not, (experiments,) each.
"""


def alike(p: Array) -> tuple[Array, Array]:
    """Whether the scenario is enclosed does not matter."""
    return p, p


def rows(runs: int) -> dict[str, tuple[bool, Leaving]]:
    """What the robot does: whether the worst push acts inside D, and how its runs leave D."""
    return {
        "right simulator": (False, lambda _i, quiet: alike(np.full(len(quiet), 0.02))),
        "wrong simulator: a constant worst push": (True, lambda _i, quiet: alike(np.full(len(quiet), 0.02))),
        "anti-correlated: leaves D where enclosed": (True, lambda _i, quiet: (np.full(len(quiet), 0.1), np.zeros(len(quiet)))),
        "drifting, 0 to 20 %": (True, lambda i, quiet: alike(np.full(len(quiet), 0.1 - 0.1 * math.cos(4.0 * math.pi * i / runs)))),
        "in bursts": (True, lambda _i, quiet: alike(np.where(quiet < 3, 0.4, 0.02))),
    }


class Driven:
    """Experiments side by side, (experiments, runs): whether a run counts as outside, and the mean of the true probabilities so far."""

    def __init__(self, worst: bool, leaving: Leaving, experiments: int, runs: int, rng: np.random.Generator) -> None:
        self.outside = np.zeros((experiments, runs), dtype=bool)
        truth, unsafe = np.zeros((experiments, runs)), np.zeros((experiments, runs), dtype=bool)
        quiet, reach = np.full(experiments, 1e9), float(TUBE.reach[-1])
        # inside D a run hits the wall if it is nearer than the farthest x: always within the tube's reach, or as often as x says
        hits = 1.0 if worst else float(np.mean(_simulated(False, np.zeros(100_000, dtype=bool), rng)[1])) / reach
        for i in range(runs):
            wall = TASK.draw(rng, experiments)["wall"]
            enclosed, not_enclosed = leaving(i, quiet)
            out = rng.random(experiments) < np.where(wall >= reach, enclosed, not_enclosed)
            residual, farthest = _simulated(worst, out, rng)
            self.outside[:, i] = residual > GAP.radius
            unsafe[:, i] = farthest > wall
            truth[:, i] = (1.0 - NOT_ENCLOSED) * enclosed + NOT_ENCLOSED * (not_enclosed + (1.0 - not_enclosed) * hits)
            quiet = np.where(self.outside[:, i], 0.0, quiet + 1.0)
        off = abs(float(np.mean(unsafe) - np.mean(truth)))
        if off > 5.0 * math.sqrt(0.25 / unsafe.size) + 1e-3:
            raise AssertionError(f"the true probabilities are off by {off:.4f} from what the simulated runs did")
        self.mean = np.cumsum(truth, axis=1) / np.arange(1, runs + 1)


def _simulated(worst: bool, out: Bools, rng: np.random.Generator) -> tuple[Array, Array]:
    """One run of each experiment: its largest residual, as from a log, and the largest x, (experiments,) each."""
    n = len(out)
    x, push, kicked = np.zeros((n, 4)), 0.999999 * worst_sequence(), rng.integers(0, STEPS, n)
    states, inputs = [x], []
    for k in range(STEPS):
        u = hold(x, {})
        d = np.repeat(push[k][None, :], n, axis=0) if worst else GAP.inside(rng, n, 0.3 * GAP.radius)
        d[:, 0] += np.where(out & (kicked == k), 1.1 * TASK.far, 0.0)  # beyond any wall
        x = MODEL.step(x, u, ())[0] + d
        states.append(x)
        inputs.append(u)
    path, answers = np.stack(states, axis=1), np.stack(inputs, axis=1)
    if n > LOOKED_AT:
        return np.zeros(n), path[:, :, 0].max(axis=1)
    residual = [largest_residual(MODEL, GAP, one.tolist(), u.tolist()) for one, u in zip(path, answers, strict=True)]
    return np.array(residual), path[:, :, 0].max(axis=1)


LOOKED_AT = 10_000
"""Experiments whose residuals are computed; more of them are a mean of x."""


@cache
def _first(n: int, outside: int) -> float:
    return inside_limit(n, outside, BETA / 2.0, chosen=False)


def missed(driven: Driven, second: Array, first: Callable[[int, int], float]) -> int:
    """Experiments in which the sum of both terms is below the true mean after any run. second: (experiments,)."""
    count = np.cumsum(driven.outside, axis=1)
    limit = np.array([[first(j + 1, int(count[e, j])) for j in range(count.shape[1])] for e in range(len(count))])
    return int(np.sum(np.any(driven.mean > np.minimum(limit + second[:, None], 1.0), axis=1)))


def enclosures(experiments: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Second terms of each experiment: by enclosure, and (a fault) by rollouts under drawn disturbances."""
    tubes, sampled = np.empty(experiments), np.empty(experiments)
    for e in range(experiments):
        found = enclose(hold, TASK, MODEL, GAP, TUBE, rng, SCENARIOS)
        tubes[e] = enclosure_limit(found.failed, SCENARIOS, BETA / 2.0)
        safety = roll_out(hold, TASK, MODEL, GAP, "uniform", rng, SCENARIOS).safety
        sampled[e] = clopper_pearson_upper(int(np.sum(safety < 0.0)), SCENARIOS, BETA / 2.0)
    return tubes, sampled


def who_drives(experiments: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The test of the assumption: refuted by mistake, and where one controller's residuals are half as large again."""
    counts = {1.0: 0, 1.5: 0}
    for scale in counts:
        for _ in range(experiments):
            residual = rng.gamma(8.0, 1.0, 120) * np.where(np.arange(120) % 2, scale, 1.0)
            lives = [DrivenRun(str(k % 2), float(r)) for k, r in enumerate(residual)]
            counts[scale] += dependence(lives, int(rng.integers(1 << 31))) >= -math.log(LEVEL)
    return [
        row("who drives: refuted by mistake", counts[1.0], experiments, LEVEL),
        row("who drives: residuals half as large again, 120 runs", counts[1.5], experiments, LEVEL, planted=True),
    ]


def row(what: str, count: int, experiments: int, beta: float, *, planted: bool = False) -> dict[str, Any]:
    """One count. planted: a fault that must be caught rather than a promise that must hold."""
    lower = clopper_pearson_lower(count, experiments, SURE)
    found = {"what": what, "experiments": experiments, "missed": count, "share": count / experiments, "lower": lower, "beta": beta}
    return {**found, "planted": planted, "ok": (lower > beta) == planted}


def coverage(experiments: int, runs: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """A row for each robot, and the planted faults."""
    tubes, sampled = enclosures(experiments, rng)
    found = []
    for name, (worst, leaving) in rows(runs).items():
        driven = Driven(worst, leaving, experiments, runs, rng)
        found.append(row(name, missed(driven, tubes, _first), experiments, BETA))
        if name.startswith("wrong"):
            found.append(
                row("fault: second term from drawn disturbances", missed(driven, sampled, _first), experiments, BETA, planted=True)
            )
        if name.startswith("anti"):
            exact = np.full(experiments, NOT_ENCLOSED)  # as from any number of scenarios
            found.append(row("anti-correlated, second term known exactly", missed(driven, exact, _first), experiments, BETA))
    return [*found, *naive_first(experiments, rng)]


def naive_first(experiments: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The first term by Clopper-Pearson, read after each of 1000 runs; and in its place the limit that may be read so. The second term is
    known exactly, and the two events exclude each other.
    """
    outside = rng.random((experiments, NAIVE_RUNS)) < 0.3
    count, n = np.cumsum(outside, axis=1), np.arange(1, NAIVE_RUNS + 1)
    naive = np.any(bdtr(count, n, 0.3) < BETA / 2.0, axis=1)  # the bound is below 0.3 just then
    valid = [any(_first(int(j), int(k)) < 0.3 for j, k in zip(n[9::10], one[9::10], strict=True)) for one in count]
    return [
        row("anti-correlated, 1000 runs", int(np.sum(valid)), experiments, BETA),
        row("fault: first term by Clopper-Pearson after every run", int(naive.sum()), experiments, BETA, planted=True),
    ]


def main(arguments: list[str]) -> int:
    """Everything, as a table or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--experiments", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="200 experiments of 100 runs")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    experiments, runs = (200, 100) if args.quick else (args.experiments, args.runs)
    rng, began = np.random.default_rng(args.seed), time.process_time()
    found = [*coverage(experiments, runs, rng), *who_drives(experiments, rng)]
    if args.json:
        print(json.dumps({"beta": BETA, "runs": runs, "rows": found}))
    else:
        print(f"{experiments} experiments of {runs} runs, {SCENARIOS} scenarios enclosed in each; the statement is read after every run")
        for one in found:
            verdict = "as it must be" if one["ok"] else "WRONG"
            print(f"{one['what']:54s} {one['share']:7.2%}, at least {one['lower']:6.2%}  beta {one['beta']:.0%}  {verdict}")
        print(f"{time.process_time() - began:.0f} s of CPU")
    return 0 if all(one["ok"] for one in found) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
