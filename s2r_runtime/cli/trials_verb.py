"""s2r trials: closed-loop runs of a controller on the robot, taken from its logs, and what they show (guarantee G9, G10)."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_enclose_options, add_score_options, count, not_negative, pairs, probability, score_of
from s2r_runtime.errors import NotEnoughEvidence, UsageError

LAWS = ("uniform", "persistent", "adversarial")
SCORES = ("safe", "safety", "progress")


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("trials")
    verb.add_argument(
        "controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
    )
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
    verb.add_argument(
        "--simulate",
        type=count,
        default=0,
        metavar="M",
        help="roll each run out M times on the uncertain model, and M times in fresh scenarios: mean score and optimism",
    )
    verb.add_argument("--radius", type=not_negative, metavar="R", help="with --simulate: radius of the uncertain model (default: 0)")
    verb.add_argument(
        "--on", metavar="MODEL.toml", help="with --simulate: the model to roll out on, as a repaired one (default: the one in force)"
    )
    verb.add_argument("--law", choices=LAWS, metavar="L", help=f"with --simulate: {', '.join(LAWS)} (default: uniform)")
    verb.add_argument("--score", choices=SCORES, help="with --simulate: what a run scores (default: safe, 1 for a safe run, else 0)")
    add_score_options(verb)
    add_enclose_options(verb)
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if no run was unsafe, 1 if one was, 3 if there are not enough."""
    from s2r_runtime.api.composition import composition_of, tubes_of
    from s2r_runtime.api.models import controller_at, load_checked, profile_model
    from s2r_runtime.api.trials import Rollouts, trials_of
    from s2r_runtime.evidence.statements import of_composition, of_runs, of_simulated, of_trials
    from s2r_runtime.evidence.trials import newest_limits
    from s2r_runtime.trust.certificate import optimism_lack

    if not args.simulate and (args.radius is not None or args.on or args.law or args.score or args.range or args.better != "high"):
        raise UsageError(
            "--radius, --on, --law, --score, --range and --better go with --simulate M: they say what is rolled out and scored"
        )
    score = score_of(args, args.score or "safe")
    tubes = tubes_of(args.rate, args.because, enclose=args.enclose)
    profile = load_checked(args.profile)
    model = profile_model(args.model, profile, str(args.profile))
    on = profile_model(args.on or args.model, profile, str(args.profile))
    rollouts = Rollouts(args.simulate, args.radius or 0.0, args.law or "uniform", score, on) if args.simulate else None
    controller = controller_at(args.controller, pairs(args.param, "--param"))
    composed, beta = None, args.beta or profile.guarantee.beta
    if tubes is not None:
        composed = composition_of(args.logs, tubes, controller, model, profile, output.Terminal(), beta=beta)
    try:
        found = trials_of(args.logs, controller, model, profile, output.Terminal(), n=args.n, beta=args.beta, rollouts=rollouts)
    except NotEnoughEvidence:
        if not args.json and composed is not None:  # it may rest on the runs of other controllers
            output.out_lines("\n".join(of_composition(composed)))
        if not args.json and (counted := newest_limits(args.logs, controller.digest)) is not None:  # of logs that hold: they were audited
            output.out(of_runs(counted))
        raise
    counted = newest_limits(args.logs, controller.digest)
    statements = [of_trials(found), *(of_simulated(found.simulated) if found.simulated else ())]
    statements += of_composition(composed) if composed else ()
    demanded = found.simulated is not None and profile.verification.max_optimism < 1.0
    lack = optimism_lack(profile, found) if demanded else None
    if args.json:
        runs = None if counted is None else {**msgspec.to_builtins(counted), "statement": of_runs(counted)}
        result = {**msgspec.to_builtins(found), "statement": " ".join(statements), "optimism_lack": lack, "runs": runs}
        output.result_json({**result, "composition": msgspec.to_builtins(composed)})
    else:
        for why, number in found.left_out.items():
            output.out(f"left out    {number}: {why}")
        for line in (*statements, *(() if counted is None else (of_runs(counted),))):
            output.out(line)
        if lack is not None:
            output.out(f"max_optimism    {f'not met: {lack}' if lack else 'met'}")
    return 1 if found.unsafe else 0
