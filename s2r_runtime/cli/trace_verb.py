"""s2r trace: residual -> effect -> repaired model -> error before and after."""

from __future__ import annotations

import argparse
from collections.abc import Set
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.api.files import apart, own_file, writable
from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_model_options, add_signal_options, chosen_model, count, positive, recording_of
from s2r_runtime.cli.daemon_verbs import add_daemon_options, run_live_trace
from s2r_runtime.errors import NotEnoughEvidence, UsageError

if TYPE_CHECKING:
    from s2r_runtime.api.tracing import Ready, Trace
    from s2r_runtime.trace.design.suggestion import Suggestion


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("trace")
    verb.add_argument(
        "recording",
        type=Path,
        nargs="*",
        metavar="RECORDING",
        help="a log's MCAP, CSV (.gz), or somebody else's format (docs/recordings.md); each of several is a run of its own",
    )
    add_model_options(verb)
    add_signal_options(verb)
    verb.add_argument(
        "--test",
        type=Path,
        metavar="RECORDING2",
        help="judge on this recording (default: the last part of the first, never seen by the fit)",
    )
    verb.add_argument(
        "--horizon",
        type=positive,
        metavar="S",
        help="length of the rollouts in s (default 1, or 10 steps if they take longer; shorter where what is judged on is)",
    )
    verb.add_argument("--seed", type=count, default=0, help="seed of everything random in it (default 0)")
    verb.add_argument(
        "--bandwidth",
        type=positive,
        metavar="HZ",
        help="within which states that the recording lacks are reconstructed from those that it has (default: what the data bear)",
    )
    verb.add_argument(
        "--suggest",
        type=Path,
        metavar="FILE.csv",
        help="write a sequence of inputs that would tell apart what these data cannot, within the profile's bounds (else the range seen)",
    )
    verb.add_argument("--suggest-duration", type=positive, metavar="S", help="length of that sequence in s (default 20)")
    verb.add_argument(
        "--live",
        choices=("campaign", "drive", "inputs"),
        help="instead of a recording: what the running daemon recorded, of its newest campaign, of controllers since, or of given inputs; "
        "it traces with its profile's model, and proposes the repaired one (s2r adopt)",
    )
    add_daemon_options(verb)
    verb.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="MODEL.toml",
        help="write the repaired model (marked if partial); as given, where nothing was found",
    )
    verb.add_argument("--report", type=Path, metavar="FILE.html", help="write a self-contained page with plots")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with any verdict, 3 with too little data."""
    if bool(args.recording) == (args.live is not None):
        raise UsageError("trace: give a RECORDING, or --live with what the running daemon recorded")
    for path in (args.output, args.report, args.suggest):
        writable(path)
    apart(
        {"-o": args.output, "--report": args.report, "--suggest": args.suggest},
        {
            **{f"the recording {one}" if len(args.recording) > 1 else "the recording": one for one in args.recording},
            "the test recording": args.test,
            "the model": args.model,
            "the profile": args.profile,
        },
    )
    if args.live:
        return run_live_trace(args)
    if args.suggest_duration and not args.suggest:
        raise UsageError("--suggest-duration: belongs to --suggest FILE.csv")
    return _traced(args)


def _traced(args: argparse.Namespace) -> int:
    from s2r_runtime.api import tracing
    from s2r_runtime.api.recordings import Recording

    chosen, watcher = chosen_model(args), output.Terminal()
    apart({"-o": args.output, "--report": args.report, "--suggest": args.suggest}, {"the model's file": own_file(chosen.model.spec)})
    tracing.check_duration(args.suggest_duration, chosen)
    test = Recording((args.test,)) if args.test else None
    given = recording_of(args, args.recording)
    ready = tracing.read(given, chosen, watcher, test=test, horizon=args.horizon, bandwidth=args.bandwidth)
    try:
        found = tracing.run(ready, watcher, args.horizon, args.seed)
        suggested = None
        if args.suggest:
            with watcher.phase("tracing") as report:
                report(100.0, 100.0, "looking for a drive")
                suggested = tracing.suggested(found, args.suggest_duration, args.seed)
    except NotEnoughEvidence as error:
        if args.suggest:
            error.also = _suggest_first(args, ready)
        raise
    result = found.result
    files = _files(args, found, suggested)
    trouble = {path: why for path, text in files.items() if (why := output.trouble_writing(path, text))}
    if args.json:
        drive = {"suggested_sequence": suggested.to_json(str(args.suggest) if args.suggest not in trouble else None)} if suggested else {}
        output.result_json(found.to_dict() | drive)
    else:
        _tell(args, found, suggested, files.keys() - trouble.keys())
    if args.horizon and result.held.horizon < round(args.horizon / result.nominal.dt):
        output.err(f"s2r: --horizon {args.horizon:g}: what was judged on bears no such rollouts; they are {result.horizon_s:.4g} s long")
    for why in trouble.values():  # last: what was found is told all the same
        output.err(f"s2r: {why}")
    return UsageError.exit_code if trouble else 0


def _files(args: argparse.Namespace, found: Trace, suggested: Suggestion | None) -> dict[Path, str]:
    """Texts of the files that were asked for."""
    files: dict[Path, str] = {}
    if args.output:
        files[args.output] = found.model_toml()
    if suggested and suggested.u is not None:
        files[args.suggest] = suggested.to_csv()
    if args.report:
        from s2r_runtime.report.trace_page import trace_page

        files[args.report] = trace_page(found.result, suggested)
    return files


def _tell(args: argparse.Namespace, found: Trace, suggested: Suggestion | None, written: Set[Path]) -> None:
    output.out_lines(found.summary())
    if suggested:
        _tell_drive(args.suggest if args.suggest in written else None, suggested)
    if args.output in written:
        changed = found.result.spec.effects != found.ready.chosen.model.spec.effects
        partial = " (a partial repair)" if found.result.repair is not None else ""
        output.out(f"model written to {args.output}" + (partial if changed else " (unchanged: no effect was added)"))
    if args.report in written:
        output.out(f"report written to {args.report}")


def _tell_drive(path: Path | None, suggested: Suggestion) -> None:
    from s2r_runtime.trace.reporting.text import labelled

    output.out("")
    for line in labelled("drive", suggested.lines()):
        output.out(line)
    if path is not None:
        output.out(f"drive written to {path}")


def _suggest_first(args: argparse.Namespace, ready: Ready) -> dict[str, object]:
    """For a recording that cannot be traced: a first drive, where a profile says what is allowed. What `--json` prints of it."""
    from s2r_runtime.api.tracing import suggested_first

    drive = suggested_first(ready, args.suggest_duration, args.seed)
    trouble = output.trouble_writing(args.suggest, drive.to_csv()) if drive.u is not None else ""
    written = args.suggest if drive.u is not None and not trouble else None
    if not args.json:
        _tell_drive(written, drive)
    if trouble:
        output.err(f"s2r: {trouble}")
    return {"suggested_sequence": drive.to_json(None if written is None else str(written))}
