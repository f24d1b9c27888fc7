"""s2r compare: two controllers on common scenarios, or one before and after an update; may be read after every run (guarantee G14)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_score_options, not_negative, pairs, probability, score_of
from s2r_runtime.errors import UsageError

if TYPE_CHECKING:
    from s2r_runtime.evidence.run_pairs import Pairs
    from s2r_runtime.evidence.scores import Score

EXIT = {"not worse": 0, "worse": 1, "undecided": 3}


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("compare")
    verb.add_argument("a", metavar="A", help="a controller's file; with --table, the column of A's scores")
    verb.add_argument("b", metavar="B", help="the other controller, or the same one with other logs; with --table, B's column")
    verb.add_argument("logs", type=Path, nargs="*", metavar="LOG", help="logs of both; each is audited first")
    verb.add_argument("--profile", type=Path, metavar="P", help="the robot's profile (TOML); needed with logs")
    verb.add_argument("--a-log", type=Path, action="append", default=[], metavar="LOG", help="a log for A's runs alone; may be repeated")
    verb.add_argument("--b-log", type=Path, action="append", default=[], metavar="LOG", help="a log for B's runs alone; may be repeated")
    verb.add_argument("--a-param", action="append", default=[], metavar="K=V", help="a parameter of controller A; may be repeated")
    verb.add_argument("--b-param", action="append", default=[], metavar="K=V", help="a parameter of controller B; may be repeated")
    verb.add_argument("--table", type=Path, metavar="FILE.csv", help="paired outcomes instead of logs, one pair a row")
    verb.add_argument(
        "--pair",
        choices=("scenario", "order"),
        default="scenario",
        help="which runs are a pair: in the same scenario (seed and number; default), or of the same place in the order of driving",
    )
    verb.add_argument(
        "--delta", type=not_negative, default=0.0, metavar="D", help="loss that does not matter, in the score's unit (default: 0)"
    )
    verb.add_argument(
        "--score", choices=("safe", "safety", "progress"), help="what a run in a log scores (default: safe, 1 for a safe run, else 0)"
    )
    add_score_options(verb)
    verb.add_argument("--beta", type=probability, default=0.05, metavar="B", help="one minus the confidence (default: 0.05)")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if B is shown not to be worse by more than --delta, 1 if it is shown to be, 3 while neither is shown."""
    from s2r_runtime.evidence.paired_comparison import compare, in_unit, statement
    from s2r_runtime.evidence.scores import merits

    score = score_of(args, "score" if args.table else args.score or "safe")
    paired, left_out = _from_table(args) if args.table else _from_logs(args, score)
    a, notes_a = merits(paired.a, score, what="pair")
    b, notes_b = merits(paired.b, score, what="pair")
    output.notes("A", notes_a)
    output.notes("B", notes_b)
    if args.delta >= score.spread:
        raise UsageError(f"--delta {args.delta:g}: must be below the length of the score's range, {score.spread:g}")
    found = in_unit(compare(a, b, delta=args.delta / score.spread, beta=args.beta), score)
    of_a, of_b = ("A", "B") if args.a == args.b else (args.a, args.b)
    text = statement(found, of_a, of_b, what="success rate" if score.name == "safe" else score.name)
    if args.json:
        outside = sum(not score.low <= value <= score.high for value in (*paired.a, *paired.b))
        output.result_json(
            {
                **msgspec.to_builtins(found),
                "score": score,
                "pair": "row" if args.table else args.pair,
                "unpaired": paired.unpaired,
                "left_out": left_out,
                "outside_range": outside,
                "statement": text,
            }
        )
        return EXIT[found.answer]
    for why, number in left_out.items():
        output.out(f"left out    {number}: {why}")
    if any(paired.unpaired):
        output.out(f"unpaired    {paired.unpaired[0]} runs of A, {paired.unpaired[1]} of B")
    output.out(text)
    evidence = f"worse {found.e_worse:.3g}, not worse {found.e_not_worse:.3g}; shown at {found.e_required:.3g}"
    output.out(f"evidence    {evidence}; {found.agree} of {found.n} pairs have equal scores")
    return EXIT[found.answer]


def _from_table(args: argparse.Namespace) -> tuple[Pairs, dict[str, int]]:
    from s2r_runtime.evidence.run_pairs import from_table

    for given, option in ((args.logs, "LOG"), (args.a_log, "--a-log"), (args.b_log, "--b-log"), (args.score, "--score")):
        if given:
            raise UsageError(f"{option} does not go with --table: A and B are its columns")
    return from_table(args.table, args.a, args.b), {}


def _from_logs(args: argparse.Namespace, score: Score) -> tuple[Pairs, dict[str, int]]:
    """The pairs, and which runs were left out, by reason."""
    from s2r_runtime.api.trials import pairs_of

    if args.profile is None:
        raise UsageError("--profile is needed with logs: it says what a safe run is (or give paired outcomes: --table FILE.csv)")
    return pairs_of(
        (Path(args.a), Path(args.b)),
        (pairs(args.a_param, "--a-param"), pairs(args.b_param, "--b-param")),
        args.profile,
        (args.logs, args.a_log, args.b_log),
        score,
        args.pair,
        output.Terminal(),
    )
