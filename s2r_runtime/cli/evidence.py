"""Verbs about evidence: gap (is the model right) and verify (is the controller)."""

from __future__ import annotations

import argparse
from pathlib import Path

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import (
    add_enclose_options,
    add_limit,
    add_model_options,
    add_signal_options,
    chosen_model,
    count,
    not_negative,
    pairs,
    positive,
    probability,
    recording_of,
    weights,
)

LAWS = ("uniform", "persistent", "adversarial")


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    gap = verbs.add_parser("gap")
    gap.add_argument(
        "recording",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="a campaign's MCAP, CSV (.gz), or somebody else's format (docs/recordings.md); several of one kind count together",
    )
    add_model_options(gap)
    add_signal_options(gap)
    gap.add_argument("--epsilon", type=probability, metavar="E", help="violation probability (default: the profile's, else 0.01)")
    gap.add_argument("--beta", type=probability, metavar="B", help="one minus the confidence (default 0.05)")
    gap.add_argument("--discard", type=count, metavar="K", help="largest discrepancies to leave out, fixed beforehand (default 0)")
    gap.add_argument("--set", choices=("ball", "box"), help="shape of the gap set (default: the profile's, else ball)")
    gap.add_argument("--weight", action="append", default=[], metavar="STATE=W", help="weight of a state in the norm; may be repeated")
    gap.add_argument(
        "--blocking",
        type=positive,
        metavar="S",
        help="ordinary driving: assume that transitions S seconds apart are independent; the assumption stands in the statement",
    )
    gap.add_argument("--json", action="store_true", help="print one JSON object")
    gap.set_defaults(run=run_gap)

    verify = verbs.add_parser("verify")
    verify.add_argument(
        "controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
    )
    verify.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verify.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    size = verify.add_mutually_exclusive_group(required=True)
    size.add_argument("--radius", type=not_negative, metavar="R", help="radius of the gap set (0: the model as it is)")
    size.add_argument(
        "--recording", type=Path, action="append", metavar="REC", help="take radius and hold gap from this campaign; may be repeated"
    )
    verify.add_argument(
        "--hold-radius",
        type=positive,
        metavar="R",
        help="hold gap for the persistent law (with --radius; default: the radius times sqrt(hold periods))",
    )
    verify.add_argument(
        "--headroom",
        type=positive,
        metavar="H",
        help="look for the largest radius, up to H times, at which it passes (default: the profile's with --recording, else 1)",
    )
    verify.add_argument("-n", type=count, default=0, metavar="N", help="scenarios for each law (default: what beta asks for)")
    verify.add_argument(
        "--law",
        action="append",
        choices=LAWS,
        metavar="L",
        help=f"disturbance law: {', '.join(LAWS)}; may be repeated (default: the profile's)",
    )
    add_enclose_options(verify)
    verify.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    add_limit(verify)
    verify.add_argument("--json", action="store_true", help="print one JSON object")
    verify.set_defaults(run=run_verify)


def run_gap(args: argparse.Namespace) -> int:
    """Exit 0 with a statement, 3 if the data do not carry one (the numbers are printed all the same)."""
    from s2r_runtime.api.gaps import measure

    chosen = chosen_model(args)
    given = recording_of(args, args.recording)
    result = measure(
        given,
        chosen,
        output.Terminal(),
        epsilon=args.epsilon,
        beta=args.beta,
        discard=args.discard,
        shape=args.set,
        weight=weights(args.weight, chosen.model.states),
        blocking=args.blocking,
    )
    if args.json:
        output.result_json(result.to_dict())
    else:
        output.out_lines(result.summary())
    return 0 if result.independent else 3


def run_verify(args: argparse.Namespace) -> int:
    """Exit 0 if it passed, 1 if it did not."""
    from s2r_runtime.api.verification import verified

    result = verified(
        args.controller,
        args.profile,
        output.Terminal(),
        model=args.model,
        radius=args.radius,
        recordings=args.recording,
        hold_radius=args.hold_radius,
        headroom=args.headroom,
        n=args.n,
        law=tuple(args.law or ()),
        param=pairs(args.param, "--param"),
        max_gb=args.max_gb,
        enclose=args.enclose,
        rate=args.rate,
        because=args.because,
    )
    if args.json:
        output.result_json(result.to_dict())
    else:
        print_verification(result.summary())
    return 0 if result.passed else 1


def print_verification(summary: str) -> None:
    """The account that a person reads, its first word in a colour."""
    first, *rest = summary.split("\n")
    word = "passed" if first.startswith("passed") else "not passed"
    output.out(output.styled(word, "green" if word == "passed" else "red") + first.removeprefix(word))
    for line in rest:
        output.out(line)
