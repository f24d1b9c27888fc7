"""Verbs about logs: audit, report, log recover, log info."""

from __future__ import annotations

import argparse
from pathlib import Path

from s2r_runtime.api.files import apart, writable
from s2r_runtime.cli import output
from s2r_runtime.errors import UsageError

HEAD_BYTES = 32


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    audit = verbs.add_parser("audit")
    audit.add_argument("log", type=Path, nargs="+", metavar="LOG", help="a run's files, in order if it was rotated")
    audit.add_argument(
        "--key", type=Path, metavar="PUB", help="the public key to trust (default: the one in the log, which shows consistency only)"
    )
    audit.add_argument(
        "--rerun-controllers", action="store_true", help="run the attached controllers again, confined, to recompute verifications"
    )
    audit.add_argument(
        "--rerun-traces",
        action="store_true",
        help="run every trace again, however long it takes (default: those within a minute of the processor; the others are named)",
    )
    audit.add_argument(
        "--head",
        type=_head,
        action="append",
        default=[],
        metavar="HEX",
        help="a head of the chain that was printed, shown in the status or published: the log must reach it, or its tail is missing",
    )
    audit.add_argument("--json", action="store_true", help="print one JSON object")
    audit.set_defaults(run=run_audit)

    report = verbs.add_parser("report")
    report.add_argument("log", type=Path, nargs="+", metavar="LOG", help="a run's files, in order if it was rotated")
    report.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.html", help="where the page goes")
    report.set_defaults(run=run_report)

    log = verbs.add_parser("log").add_subparsers(dest="what", metavar="WHAT", required=True)
    recover = log.add_parser("recover", help="write a clean file with all that is readable, and say what is missing")
    recover.add_argument("log", type=Path, metavar="LOG", help="a log that is damaged or was cut off; it is kept as it is")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="another file, for what is readable")
    recover.add_argument("--json", action="store_true", help="print one JSON object")
    recover.set_defaults(run=run_recover)
    info = log.add_parser("info", help="what a log holds, and whether it ends cleanly")
    info.add_argument("log", type=Path, metavar="LOG", help="one file of a log (MCAP)")
    info.add_argument("--json", action="store_true", help="print one JSON object")
    info.set_defaults(run=run_info)


def run_audit(args: argparse.Namespace) -> int:
    """Exit 0 if all that is there holds, 1 if something does not, 3 if nothing fails but parts that are needed were not given."""
    from s2r_runtime.api.logs import audited

    found = audited(
        args.log,
        output.Terminal(),
        key=args.key,
        rerun_controllers=args.rerun_controllers,
        rerun_traces=args.rerun_traces,
        heads=args.head,
    )
    if args.json:
        output.result_json(found.to_dict())
    else:
        output.out_lines(found.summary())
    return found.exit_code


def run_report(args: argparse.Namespace) -> int:
    """Exit 0 with the page written."""
    from s2r_runtime.report.run_page import log_page

    _need(args.log)
    writable(args.output)
    for log in args.log:
        apart({"-o": args.output}, {"the log": log})
    output.write(args.output, log_page(args.log))
    output.out(f"report written to {args.output}")
    return 0


def run_recover(args: argparse.Namespace) -> int:
    """Exit 0 with a readable file written."""
    from s2r_runtime.recording.salvage import recover

    _need([args.log])
    apart({"-o": args.output}, {"the log": args.log})
    writable(args.output)
    account = recover(args.log, args.output)
    if args.json:
        output.result_json(account)
    else:
        for key, value in account.items():
            output.out(f"{key.replace('_', ' '):18s} {value}")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Exit 0 if it is a log."""
    from s2r_runtime.recording.salvage import info

    _need([args.log])
    facts = info(args.log)
    if args.json:
        output.result_json(facts)
    else:
        for key, value in facts.items():
            if isinstance(value, dict):
                output.out(f"{key.replace('_', ' ')}:")
                for name, number in value.items():
                    output.out(f"    {name:30s} {number}")
            else:
                output.out(f"{key.replace('_', ' '):18s} {value}")
    return 0


def _head(text: str) -> bytes:
    try:
        head = bytes.fromhex(text)
    except ValueError:
        head = b""
    if len(head) != HEAD_BYTES:
        raise argparse.ArgumentTypeError(f"{text!r} is no head of a log's chain, must be {2 * HEAD_BYTES} hexadecimal digits")
    return head


def _need(paths: list[Path]) -> None:
    for path in paths:
        if not path.is_file():
            raise UsageError(f"{path}: no such log file")
