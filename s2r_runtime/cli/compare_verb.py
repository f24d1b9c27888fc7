"""s2r compare: two controllers on common scenarios, or one before and after an update; may be read after every run (guarantee G14)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_score_options, count, not_negative, pairs, probability, score_of
from s2r_runtime.errors import NotEnoughEvidence, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from s2r_runtime.evidence.paired_comparison import Comparison
    from s2r_runtime.evidence.run_pairs import Pairs
    from s2r_runtime.evidence.scores import Score

EXIT = {"not worse": 0, "worse": 1, "undecided": 3}
PAIRS = 200
"""As many as a day of driving holds."""


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
    verb.add_argument(
        "--live",
        type=count,
        nargs="?",
        const=PAIRS,
        metavar="N",
        help=f"drive both in turns on common scenarios, through the running daemon of that robot: at most N pairs (default: {PAIRS})",
    )
    verb.add_argument(
        "--seed", type=count, metavar="S", help="scenarios of this seed alone; with --live: go on with this comparison (default: begin one)"
    )
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
    score = score_of(args, "score" if args.table else args.score or "safe")
    if args.delta >= score.spread:
        raise UsageError(f"--delta {args.delta:g}: must be below the length of the score's range, {score.spread:g}")
    if args.live is not None:
        return _live(args, score)
    paired, left_out = _from_table(args) if args.table else _from_logs(args, score)
    return _report(args, score, paired, left_out)


def _compared(args: argparse.Namespace, score: Score, paired: Pairs) -> tuple[Comparison, tuple[str, ...], tuple[str, ...]]:
    """What the pairs show, in the score's unit, and lines about scores of A and of B outside its range."""
    from s2r_runtime.evidence.paired_comparison import compare, in_unit
    from s2r_runtime.evidence.scores import known_merits

    a, notes_a = known_merits(paired.a, score, what="pair")
    b, notes_b = known_merits(paired.b, score, what="pair")
    return in_unit(compare(a, b, delta=args.delta / score.spread, beta=args.beta), score), notes_a, notes_b


def _report(
    args: argparse.Namespace, score: Score, paired: Pairs, left_out: dict[str, int], also: Mapping[str, object] | None = None
) -> int:
    """The result. Returns the exit code. also: for --json."""
    from s2r_runtime.evidence.paired_comparison import statement

    found, notes_a, notes_b = _compared(args, score, paired)
    output.notes("A", notes_a)
    output.notes("B", notes_b)
    of_a, of_b = ("A", "B") if args.a == args.b else (args.a, args.b)
    text = statement(found, of_a, of_b, what="success rate" if score.name == "safe" else score.name)
    if args.json:
        known = [value for value in (*paired.a, *paired.b) if value is not None]
        output.result_json(
            {
                **msgspec.to_builtins(found),
                "score": score,
                "pair": "row" if args.table else args.pair,
                "unpaired": paired.unpaired,
                "left_out": left_out,
                "outside_range": sum(not score.low <= value <= score.high for value in known),
                "statement": text,
                **(also or {}),
            }
        )
        return EXIT[found.answer]
    for why, number in left_out.items():
        output.out(f"left out    {number}: {why}")
    if any(paired.unpaired):
        output.out(f"unpaired    {paired.unpaired[0]} runs of A, {paired.unpaired[1]} of B")
    if found.censored:
        output.out(f"censored    {found.censored} pairs with a run that was cut: each counts as whatever is worst for what is shown")
    output.out(text)
    output.out(f"evidence    {_evidence(found)}; {found.agree} of {found.n} pairs have equal scores")
    return EXIT[found.answer]


def _evidence(found: Comparison) -> str:
    return f"worse {found.e_worse:.3g}, not worse {found.e_not_worse:.3g}; shown at {found.e_required:.3g}"


def _live(args: argparse.Namespace, score: Score) -> int:
    """Drives pairs until one thing is shown, and shows the evidence after every run."""
    from s2r_runtime.api.live_compare import LiveComparison

    for given, option in (
        (args.table, "--table"),
        (args.a_log, "--a-log"),
        (args.b_log, "--b-log"),
        (args.pair == "order", "--pair order"),
    ):
        if given:
            raise UsageError(f"{option} does not go with --live: both drive the same scenarios on one robot")
    if args.profile is None:
        raise UsageError("--profile is needed with --live: it says what a safe run is")
    if args.logs and args.seed is None:
        raise UsageError("LOG with --live needs --seed: the comparison of that log to go on with")
    if args.live == 0:
        raise UsageError("--live 0: must be at least 1 pair")
    params = (pairs(args.a_param, "--a-param"), pairs(args.b_param, "--b-param"))
    live = LiveComparison((Path(args.a), Path(args.b)), params, args.profile, args.logs, score, args.seed or 0, output.Terminal())
    line = output.err if args.json else output.out
    line(f"comparison  seed {live.seed}; A is {args.a}, B is {args.b}")

    def look(text: str, paired: Pairs | None) -> bool:
        found = None if paired is None else _compared(args, score, paired)[0]
        line(f"{text}; " + ("no pair yet" if found is None else f"{found.n} pairs: {_evidence(found)}"))
        output.flush()
        return found is not None and found.answer != "undecided"

    ended = live.run(args.live, look)
    if ended.stopped:
        output.err(f"s2r: the comparison stopped: {ended.stopped}")
    logs = " ".join(map(str, (*args.logs, *ended.logs)))
    if not args.json:
        output.out(f"again       s2r compare {args.a} {args.b} {logs} --profile {args.profile} --seed {ended.seed}  (and the same options)")
    if ended.pairs is None:
        raise NotEnoughEvidence("no pair of runs, at least one is needed", 1)
    also = {"seed": ended.seed, "logs": list(map(str, ended.logs)), "stopped": ended.stopped}
    return _report(args, score, ended.pairs, ended.left_out, also)


def _from_table(args: argparse.Namespace) -> tuple[Pairs, dict[str, int]]:
    from s2r_runtime.evidence.run_pairs import from_table

    for given, option in (
        (args.logs, "LOG"),
        (args.a_log, "--a-log"),
        (args.b_log, "--b-log"),
        (args.score, "--score"),
        (args.seed, "--seed"),
    ):
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
        args.seed,
    )
