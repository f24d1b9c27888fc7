"""s2r trace: residual -> effect -> repaired model -> error before and after."""

from __future__ import annotations

import argparse
from pathlib import Path

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_model_options, chosen_model, count, positive, weights_of, writable
from s2r_runtime.errors import UsageError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("trace", help="find the effect that the model lacks, add it, and report the error before and after")
    verb.add_argument(
        "recording", type=Path, metavar="RECORDING", help="a log's MCAP, CSV (.gz), or a robot's own log that a plug-in reads"
    )
    add_model_options(verb)
    verb.add_argument(
        "--test",
        type=Path,
        metavar="RECORDING2",
        help="judge on this recording (default: the last part of the first, never seen by the fit)",
    )
    verb.add_argument("--horizon", type=positive, default=1.0, metavar="S", help="length of the rollouts in s (default 1)")
    verb.add_argument("--seed", type=count, default=0, help="seed of everything random in it (default 0)")
    verb.add_argument(
        "--bandwidth",
        type=positive,
        metavar="HZ",
        help="within which states that the recording lacks are reconstructed from those that it has (default: what the data bear)",
    )
    verb.add_argument("-o", "--output", type=Path, metavar="MODEL.toml", help="write the repaired model")
    verb.add_argument("--report", type=Path, metavar="FILE.html", help="write a self-contained page with plots")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with any verdict, 3 with too little data."""
    from s2r_runtime.modelspec import dump_model
    from s2r_runtime.trace.tracer import load_dataset, trace

    writable(args.output)
    writable(args.report)
    model, profile = chosen_model(args)
    columns, transport = (dict(profile.columns), profile.transport) if profile else ({}, None)
    data = load_dataset(args.recording, model, columns, bandwidth=args.bandwidth, transport=transport)
    used = data.reconstruction.bandwidth if data.reconstruction else args.bandwidth
    test = load_dataset(args.test, model, columns, bandwidth=used, transport=transport) if args.test else None
    if test and set(test.digests) & set(data.digests):
        raise UsageError(f"--test {args.test}: is the recording that the fit is made on; take one that the fit never sees")
    bar = output.Progress("tracing")
    try:
        result = trace(
            data,
            model,
            test=test,
            horizon=args.horizon,
            seed=args.seed,
            progress=bar,
            weights=weights_of(model.states, [], profile),
            kind=profile.norm.set if profile else "ball",
        )
    finally:
        bar.close()
    if args.output:
        args.output.write_text(dump_model(result.spec, result.comments()), encoding="utf-8")
    if args.report:
        from s2r_runtime.report.trace_page import trace_page

        args.report.write_text(trace_page(result), encoding="utf-8")
    if args.json:
        output.result_json(result.to_json())
    else:
        output.out(result.text())
        if args.output:
            output.out(
                f"model written to {args.output}"
                + ("" if result.spec.effects != model.spec.effects else " (unchanged: no effect was added)")
            )
        if args.report:
            output.out(f"report written to {args.report}")
    return 0
