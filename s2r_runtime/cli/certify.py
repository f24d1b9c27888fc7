"""s2r certify: gap + verify + sign, offline. The budget is kept in a ledger beside the key (guarantee G4)."""

from __future__ import annotations

import argparse
from pathlib import Path

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_enclose_options, add_limit, count, pairs
from s2r_runtime.cli.evidence import print_verification
from s2r_runtime.errors import UsageError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("certify")
    verb.add_argument(
        "controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
    )
    verb.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verb.add_argument(
        "--recording",
        type=Path,
        action="append",
        required=True,
        metavar="REC",
        help="a campaign's MCAP; or drives, also folders of bags, if the profile vouches for blocks of them ([driving]); may be repeated",
    )
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="CERT", help="where the certificate goes")
    verb.add_argument(
        "--trials", type=Path, action="append", default=[], metavar="LOG", help="closed-loop runs of it, from this log; may be repeated"
    )
    verb.add_argument(
        "--simulate",
        type=count,
        default=0,
        metavar="M",
        help="with --trials: roll each run out M times, as in s2r trials (default: 20 where the profile demands max_optimism, else 0)",
    )
    add_enclose_options(verb)
    verb.add_argument(
        "--runs",
        type=Path,
        action="append",
        default=[],
        metavar="LOG",
        help="with --enclose: runs of any certified controller, whose residuals are compared with verification.run_radius; may be repeated",
    )
    verb.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    verb.add_argument("--key", type=Path, metavar="FILE", help="signing key (default: the user's; make one with s2r keys new)")
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    add_limit(verb)
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with a certificate written, 1 if the controller did not pass (the attempt is spent all the same)."""
    from s2r_runtime.api.certification import certified

    found = certified(
        args.controller,
        args.profile,
        args.recording,
        args.output,
        output.Terminal(),
        trials=args.trials,
        simulate=args.simulate,
        model=args.model,
        key=args.key,
        param=pairs(args.param, "--param"),
        max_gb=args.max_gb,
        enclose=args.enclose,
        rate=args.rate,
        because=args.because,
        runs=args.runs,
    )
    if args.json:
        output.result_json(found.to_dict())
    else:
        print_verification(found.summary())
    if found.trouble:
        output.err(f"s2r: {found.trouble}")
        return UsageError.exit_code
    return 0 if found.passed else 1
