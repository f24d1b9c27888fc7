"""s2r trials: closed-loop runs of a controller on the robot, taken from its logs, and what they show (guarantee G9, G10)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import controller_at, count, load_checked, probability
from s2r_runtime.errors import ConfigError, NotEnoughEvidence

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.messages import Trials
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("trials")
    verb.add_argument("controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters)")
    verb.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="logs of drives; each is audited first")
    verb.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verb.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    verb.add_argument(
        "-n",
        type=count,
        default=0,
        metavar="N",
        help="how many runs were fixed beforehand: the first N count, in the order in which the logs began",
    )
    verb.add_argument("--beta", type=probability, metavar="B", help="one minus the confidence of each bound (default: the profile's)")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if no run was unsafe, 1 if one was, 3 if there are not enough."""
    from s2r_runtime.cli.evidence import profile_model
    from s2r_runtime.evidence.statements import of_runs, of_trials
    from s2r_runtime.evidence.trials import newest_limits

    profile = load_checked(args.profile)
    model = profile_model(args, profile)
    controller = controller_at(args.controller, args.param)
    try:
        found = trials_of(args.logs, controller, model, profile, n=args.n, beta=args.beta)
    except NotEnoughEvidence:
        if not args.json and (counted := newest_limits(args.logs, controller.digest)) is not None:  # of logs that hold: they were audited
            output.out(of_runs(counted))
        raise
    counted = newest_limits(args.logs, controller.digest)
    if args.json:
        runs = None if counted is None else {**msgspec.to_builtins(counted), "statement": of_runs(counted)}
        output.result_json({**msgspec.to_builtins(found), "statement": of_trials(found), "runs": runs})
    else:
        for why, number in found.left_out.items():
            output.out(f"left out    {number}: {why}")
        output.out(of_trials(found))
        if counted is not None:
            output.out(of_runs(counted))
    return 1 if found.unsafe else 0


def trials_of(
    logs: Sequence[Path], controller: ControllerFile, model: ComposedModel, profile: Profile, *, n: int = 0, beta: float | None = None
) -> Trials:
    """The controller's runs in these logs, which are audited first. Raises ConfigError for a log that does not hold."""
    from s2r_runtime.audit.log import audit
    from s2r_runtime.evidence import trials
    from s2r_runtime.plugins import registry

    bar = output.Progress("auditing")
    try:
        result = audit(list(logs), progress=bar)
    finally:
        bar.close()
    if not result.ok:
        first = result.first_difference
        lacks = [*(f"{one} was not given" for one in result.incomplete), *result.unchecked]
        what = first.what if first is not None else "; ".join(lacks) or f"the chain is {result.chain}"
        raise ConfigError(f"{', '.join(map(str, logs))}: does not hold, so no trials are taken from it: {what} (s2r audit says more)")
    task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    digests = {"controller_digest": controller.digest, "model_digest": model.spec.digest()}
    found = trials.read_runs(logs, profile, task, **digests)
    share = beta or profile.guarantee.beta
    return trials.trials(found, **digests, task_digest=profile.task_digest(), beta=share, fixed=n)
