"""Searches a controller's parameters on the uncertain model. What it finds is a candidate: nothing is stated of it until it is verified on
scenarios that had no part in choosing it (guarantee G2), which costs a verification attempt like any other (G4).

    minimise   max over the required laws of   J = share of rollouts below the threshold
                                                 + 1/2 if the task's progress requirement does not hold
                                                 - 1/20 (m / (1 + |m|) + p / (1 + |p|))

(m the 5 % quantile of the safety values less the threshold, p the median progress: failures first, then room to spare and what was done)
over the box that the controller declares, by differential evolution (Storn and Price 1997) from a seed. Every candidate is rolled out in
the same scenarios with the same draws, so that two of them differ by what they do alone; these belong to the search, and the
verification's seed is another one. The file's own values are among the first candidates.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.candidates import Bounds, Candidate, Synthesis
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.errors import ControllerError
from s2r_runtime.evidence.uncertain import LAWS, Control, GapSet, roll_out
from s2r_runtime.files.canonical import digest_of
from s2r_runtime.hookspecs import Task
from s2r_runtime.models.composed import ComposedModel

Array = NDArray[np.float64]

BROKEN = 2.0
"""J of a controller that raises or answers nonsense: worse than any that drives."""
POPULATION = 8
"""Generations that the evaluations are divided into at least: fewer, and evolution is a random search."""


class _Enough(Exception):
    """All evaluations are used up."""


def search(
    file: ControllerFile,
    bounds: Bounds,
    load: Callable[[ControllerFile], Control],
    task: Task,
    model: ComposedModel,
    *,
    gap_set: GapSet,
    laws: Sequence[str],
    threshold: float,
    n: int,
    evaluations: int,
    seed: int,
    progress: Callable[[float, float, str], None] = lambda done, total, detail: None,
) -> Synthesis:
    """At least 2 evaluations, n scenarios each. laws: those that are required. load: makes a file's `control`."""
    from scipy.optimize import differential_evolution

    names, whole = list(bounds), [isinstance(file.parameters[name], int) for name in bounds]
    box = np.array([bounds[name] for name in names])
    tried: list[Candidate] = []

    def values(point: Array) -> dict[str, float]:
        return {name: round(v) if one else float(v) for name, v, one in zip(names, point, whole, strict=True)}

    def cost(point: Array) -> float:
        if len(tried) >= evaluations:
            raise _Enough
        candidate = _tried(file, values(point), load, task, model, gap_set, laws, threshold, n, seed)
        tried.append(candidate)
        progress(len(tried), evaluations, f"best so far {min(c.cost for c in tried):.4f}")
        return candidate.cost

    first = np.clip(np.array([float(file.parameters[name]) for name in names]), box[:, 0], box[:, 1])
    count = max(5, min(evaluations // POPULATION, 10 * len(names)))
    rng = np.random.default_rng([seed, 0])
    population = box[:, 0] + (box[:, 1] - box[:, 0]) * _latin(rng, count, len(names))
    population[0] = first
    with contextlib.suppress(_Enough):
        differential_evolution(
            cost, box, init=population, seed=np.random.default_rng([seed, 1]), maxiter=evaluations, tol=0.0, polish=False, integrality=whole
        )
    return Synthesis(min(tried, key=lambda c: c.cost), tuple(tried), n, seed)


def _latin(rng: np.random.Generator, count: int, dimensions: int) -> Array:
    """(count, dimensions) in [0, 1]: in every dimension one in each of `count` equal parts."""
    return np.stack([(rng.permutation(count) + rng.random(count)) / count for _ in range(dimensions)], axis=1)


def _tried(
    file: ControllerFile,
    parameters: dict[str, float],
    load: Callable[[ControllerFile], Control],
    task: Task,
    model: ComposedModel,
    gap_set: GapSet,
    laws: Sequence[str],
    threshold: float,
    n: int,
    seed: int,
) -> Candidate:
    worst, failures, progress = -math.inf, {}, math.inf
    try:
        control = load(msgspec.structs.replace(file, parameters={**file.parameters, **parameters}))
        for law in laws:
            rng = np.random.default_rng([seed, 2, list(LAWS).index(law)])
            rollouts = roll_out(control, task, model, gap_set, law, rng, n)
            failed, median = float(np.mean(~(rollouts.safety >= threshold))), float(np.median(rollouts.progress))
            failures[law], progress = failed, min(progress, median)
            standing = 0.0 if task.progress_ok(rollouts.progress) else 0.5
            margin = float(np.quantile(np.nan_to_num(rollouts.safety, nan=threshold - 1e9), 0.05)) - threshold
            worst = max(worst, failed + standing - 0.05 * (_squashed(margin) + _squashed(median)))
    except ControllerError as error:
        return Candidate(parameters, BROKEN, failures, trouble=str(error))
    return Candidate(parameters, worst if math.isfinite(worst) else BROKEN, failures, progress)


def _squashed(value: float) -> float:
    """To (-1, 1), whatever the unit."""
    return value / (1.0 + abs(value))


def search_seed(file: ControllerFile, gap_set: GapSet, model: ComposedModel, task_digest: str, number: int) -> int:
    """The search's own seed: of what is searched, and a number that a person may choose."""
    return int(digest_of(["search", file.digest, gap_set.radius, model.spec.digest(), task_digest, number])[7:19], 16)
