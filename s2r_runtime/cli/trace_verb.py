"""s2r trace: residual -> effect -> repaired model -> error before and after."""

from __future__ import annotations

import argparse
from collections.abc import Set
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import (
    add_model_options,
    add_signal_options,
    apart,
    chosen_model,
    columns_of,
    count,
    own_file,
    positive,
    signals_of,
    transport_of,
    weights_of,
    writable,
)
from s2r_runtime.cli.daemon_verbs import add_daemon_options, run_live_trace
from s2r_runtime.errors import NotEnoughEvidence, UsageError

if TYPE_CHECKING:
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile
    from s2r_runtime.trace.data.dataset import Dataset
    from s2r_runtime.trace.design.suggestion import Suggestion
    from s2r_runtime.trace.reporting.result import TraceResult


MOST_SUGGESTED = 100_000
"""Steps of a drive: many are drawn side by side, and every rival is simulated under each."""


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
        "-o", "--output", type=Path, metavar="MODEL.toml", help="write the repaired model; as it was given, where nothing was found"
    )
    verb.add_argument("--report", type=Path, metavar="FILE.html", help="write a self-contained page with plots")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with any verdict, 3 with too little data."""
    from s2r_runtime.files.table_text import limits_of
    from s2r_runtime.trace.pipeline import load_dataset, trace

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
    model, profile = chosen_model(args)
    apart({"-o": args.output, "--report": args.report, "--suggest": args.suggest}, {"the model's file": own_file(model.spec)})
    if args.suggest_duration and args.suggest_duration > MOST_SUGGESTED * model.dt:
        most = MOST_SUGGESTED * model.dt
        raise UsageError(f"--suggest-duration {args.suggest_duration:g}: must be at most {most:g} s, {MOST_SUGGESTED} steps of the model")
    if args.horizon and args.horizon < model.dt:
        raise UsageError(f"--horizon {args.horizon:g}: must be at least the model's step, {model.dt:g} s")
    columns, transport = columns_of(args, model, profile, *args.recording, args.test), transport_of(args, profile)
    reading = output.Progress("reading")
    read = partial(load_dataset, model=model, columns=columns, transport=transport, signals=signals_of(args, model))
    read = partial(read, limits=limits_of(args.max_gb), progress=reading)
    try:
        data = read(args.recording, bandwidth=args.bandwidth)
        used = data.reconstruction.bandwidth if data.reconstruction and not data.reconstruction.axes else args.bandwidth
        test = read(args.test, bandwidth=used, behind=data.behind) if args.test else None
    finally:
        reading.close()
    for one in (data, test):
        output.notes(one.source if one else "", one.notes if one else ())
    if test and _seen_by_the_fit(data, test):
        raise UsageError(
            f"--test {args.test}: is the recording that the fit is made on, or has rows of it; take one that the fit never sees"
        )
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
        if args.suggest:
            bar(100.0, 100.0, "looking for a drive")
        suggested = _suggested(args, result, profile) if args.suggest else None
    except NotEnoughEvidence as error:
        bar.close()
        if args.suggest:
            error.also = _suggest_first(args, model, data, profile)
        raise
    finally:
        bar.close()
    files = _files(args, result, suggested)
    trouble = {path: why for path, text in files.items() if (why := output.trouble_writing(path, text))}
    if args.json:
        told = result.to_json()
        drive = {"suggested_sequence": suggested.to_json(str(args.suggest) if args.suggest not in trouble else None)} if suggested else {}
        output.result_json(told | drive)
    else:
        _tell(args, result, suggested, files.keys() - trouble.keys(), changed=result.spec.effects != model.spec.effects)
    if args.horizon and result.held.horizon < round(args.horizon / result.nominal.dt):
        output.err(f"s2r: --horizon {args.horizon:g}: what was judged on bears no such rollouts; they are {result.horizon_s:.4g} s long")
    for why in trouble.values():  # last: what was found is told all the same
        output.err(f"s2r: {why}")
    return UsageError.exit_code if trouble else 0


def _seen_by_the_fit(data: Dataset, test: Dataset) -> bool:
    """Whether the fit would see rows of the test (guarantee G6)."""
    from s2r_runtime.evidence.seen_rows import seen
    from s2r_runtime.modelspec import is_sketch

    if set(test.digests) & set(data.digests):
        return True
    rows = [states.values for states, _ in test.segments]
    return any(seen(text, rows).refused for text in data.digests if is_sketch(text))


def _files(args: argparse.Namespace, result: TraceResult, suggested: Suggestion | None) -> dict[Path, str]:
    """Texts of the files that were asked for."""
    from s2r_runtime.modelspec import dump_model

    files: dict[Path, str] = {}
    if args.output:
        files[args.output] = dump_model(result.spec, result.comments())
    if suggested and suggested.u is not None:
        files[args.suggest] = suggested.to_csv()
    if args.report:
        from s2r_runtime.report.trace_page import trace_page

        files[args.report] = trace_page(result, suggested)
    return files


def _tell(args: argparse.Namespace, result: TraceResult, suggested: Suggestion | None, written: Set[Path], *, changed: bool) -> None:
    output.out_lines(result.text())
    if suggested:
        _tell_drive(args.suggest if args.suggest in written else None, suggested)
    if args.output in written:
        output.out(f"model written to {args.output}" + ("" if changed else " (unchanged: no effect was added)"))
    if args.report in written:
        output.out(f"report written to {args.report}")


def _tell_drive(path: Path | None, suggested: Suggestion) -> None:
    from s2r_runtime.trace.reporting.text import labelled

    output.out("")
    for line in labelled("drive", suggested.lines()):
        output.out(line)
    if path is not None:
        output.out(f"drive written to {path}")


def _suggested(args: argparse.Namespace, result: TraceResult, profile: Profile | None) -> Suggestion:
    from s2r_runtime.trace.design.suggest import suggest

    bounds, region = _allowed(profile)
    return suggest(result, bounds=bounds, region=region, duration=args.suggest_duration, seed=args.seed)


def _suggest_first(args: argparse.Namespace, model: ComposedModel, data: Dataset, profile: Profile | None) -> dict[str, object]:
    """For a recording that cannot be traced: a first drive, where a profile says what is allowed. What `--json` tells of it."""
    from s2r_runtime.trace.design.suggest import suggest_first

    bounds, region = _allowed(profile)
    drive = suggest_first(model, data, bounds=bounds, region=region, duration=args.suggest_duration, seed=args.seed)
    trouble = output.trouble_writing(args.suggest, drive.to_csv()) if drive.u is not None else ""
    written = args.suggest if drive.u is not None and not trouble else None
    if not args.json:
        _tell_drive(written, drive)
    if trouble:
        output.err(f"s2r: {trouble}")
    return {"suggested_sequence": drive.to_json(None if written is None else str(written))}


def _allowed(profile: Profile | None) -> tuple[dict[str, tuple[float, float]] | None, dict[str, tuple[float, float]] | None]:
    """Bounds of the inputs, and of the states: the geofence where there is one, else the region."""
    return (dict(profile.inputs), {**profile.region, **profile.geofence}) if profile else (None, None)
