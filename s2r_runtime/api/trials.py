"""Runs of controllers on the robot, from logs that are audited first: trials, means with simulation, and comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from s2r_runtime.api.jobs import gap_at, work
from s2r_runtime.api.models import controller_at, load_checked
from s2r_runtime.api.progress import Watcher
from s2r_runtime.errors import ConfigError, ControllerError, UsageError
from s2r_runtime.evidence import seeds, trials
from s2r_runtime.evidence.compared_runs import judge_compared
from s2r_runtime.evidence.logged_deployments import read_deployments
from s2r_runtime.evidence.logged_scenarios import LoggedScenario
from s2r_runtime.evidence.run_pairs import How, Pairs, from_logs
from s2r_runtime.evidence.scores import Score
from s2r_runtime.evidence.simulated_runs import fitted_on_runs, with_real
from s2r_runtime.messages import Simulated, Trials
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.profile import Profile

if TYPE_CHECKING:
    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.hookspecs import Task


class Rollouts(NamedTuple):
    """What is rolled out for each run: number, radius of the uncertain model in the norm's unit, disturbance model, score, and model."""

    number: int
    radius: float
    law: str
    score: Score
    model: ComposedModel


def trials_of(
    logs: Sequence[Path],
    controller: ControllerFile,
    model: ComposedModel,
    profile: Profile,
    watcher: Watcher,
    *,
    n: int = 0,
    beta: float | None = None,
    rollouts: Rollouts | None = None,
) -> Trials:
    """The controller's runs in these logs, which are audited first; in addition, rollouts.

    Raises ConfigError for a log that does not hold, or a model to roll out on that was fitted on these runs.
    """
    check_logs(logs, watcher)
    digests = {"controller_digest": controller.digest, "model_digest": model.spec.digest()}
    fitted = rollouts is not None and bool(rollouts.model.spec.fitted_on)  # then the runs' states are looked for among the fitted rows
    found = trials.read_runs(logs, profile, task_of(profile, model), **digests, with_states=fitted)
    share = beta or profile.guarantee.beta
    result = trials.trials(found, **digests, task_digest=profile.task_digest(), beta=share, fixed=n)
    if rollouts is None:
        return result
    return msgspec.structs.replace(result, simulated=_simulated(trials.first(found, n), result, rollouts, controller, profile, watcher))


def check_logs(logs: Sequence[Path], watcher: Watcher) -> None:
    """Audits them. Raises ConfigError for logs that do not hold."""
    from s2r_runtime.audit.log import audit

    with watcher.phase("auditing") as report:
        result = audit(list(logs), progress=report)
    if not result.ok:
        first = result.first_difference
        lacks = [*(f"{one} was not given" for one in result.incomplete), *result.unchecked]
        what = first.what if first is not None else "; ".join(lacks) or f"the chain is {result.chain}"
        raise ConfigError(f"{', '.join(map(str, logs))}: does not hold, so no trials are taken from it: {what} (s2r audit says more)")


def task_of(profile: Profile, model: ComposedModel) -> Task:
    """The profile's task, with this model."""
    from s2r_runtime.plugins import registry

    task: Task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    return task


def pairs_of(
    controllers: tuple[Path, Path],
    params: tuple[Mapping[str, float], Mapping[str, float]],
    profile_path: Path,
    logs: tuple[Sequence[Path], Sequence[Path], Sequence[Path]],
    score: Score,
    how: How,
    watcher: Watcher,
    seed: int | None = None,
) -> tuple[Pairs, dict[str, int]]:
    """Pairs of runs of controllers A and B, and which runs were left out, by reason. logs: of both, of A alone, of B alone. seed: runs in
    scenarios of this seed alone.

    Raises UsageError where there is no log of one of them, or where A and B cannot be separated; ConfigError for a log that does not hold.
    """
    both, *own = logs
    for name, paths in zip("AB", own, strict=True):
        if not (both or paths):
            raise UsageError(f"no log of {name}'s runs: name logs of both, or --{name.lower()}-log LOG")
    profile = load_checked(profile_path)
    task = task_of(profile, compose(profile.model, f"{profile_path}: model"))
    files = [controller_at(path, param) for path, param in zip(controllers, params, strict=True)]
    if both and files[0].digest == files[1].digest:
        names = f"{controllers[0]} and {controllers[1]}"
        raise UsageError(f"{names} are one controller: say which logs are before and which after by --a-log and --b-log")
    for paths in logs:
        if paths:
            check_logs(paths, watcher)
    found = [
        judge_compared(read_deployments([*both, *paths], profile, task), file.digest, profile.verification.threshold, seed)
        for paths, file in zip(own, files, strict=True)
    ]
    left_out = {f"{name}: {why}": number for name, one in zip("AB", found, strict=True) for why, number in one.left_out.items()}
    return from_logs(found[0], found[1], score, how), left_out


def _simulated(
    found: trials.Found, result: Trials, rollouts: Rollouts, controller: ControllerFile, profile: Profile, watcher: Watcher
) -> Simulated:
    """Mean and optimism from rollouts, in a worker process. Raises ControllerError where the controller cannot be rolled out."""
    from s2r_runtime.daemon.worker import Result, SimulateJob

    model = rollouts.model
    if fitted_on_runs(model.spec.fitted_on, [run.states for run, _ in found.counted]):
        raise ConfigError(
            "the model to roll out on was fitted on rows of these runs, so what it answers there is no prediction (G6); drive other runs"
        )
    seed = seeds.known("runs", result.controller_digest, model.spec.digest(), result.task_digest, *result.logs)
    gap = gap_at(rollouts.radius, None, model, profile)
    job = SimulateJob(
        profile=msgspec.structs.replace(profile, model=model.spec),
        controller=controller,
        gap=gap,
        radius=gap.radius,
        hold_radius=gap.hold_radius,
        law=rollouts.law,
        scenarios=tuple(LoggedScenario(run.seed, run.index, run.start) for run, _ in found.counted),
        score=rollouts.score.name,
        rollouts=rollouts.number,
        seed=seed,
    )
    done = work(job, profile.verification.timeout, "simulating", watcher)
    if not isinstance(done, Result) or done.simulated is None:
        raise ControllerError(f"the runs cannot be simulated: {getattr(done, 'text', 'the worker gave no scores')}")
    simulated, lines = with_real(
        trials.values_of(found, rollouts.score),
        done.simulated,
        rollouts.score,
        law=rollouts.law,
        radius=rollouts.radius,
        seed=seed,
        beta=result.beta,
    )
    watcher.notes("trials", lines)
    return simulated
