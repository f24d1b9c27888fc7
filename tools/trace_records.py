"""Records of what the tracer answers, set by set; and two such files compared in pairs.

    tools/trace_records.py record FILE [--family F]... [--seeds A:B] [--jobs J] [--measured FOLDER]
    tools/trace_records.py compare OLD NEW [--identical] [--changed]

tests/records holds what version 1 of the tracer answered; a record without a digest is compared by its numbers only.
`record` appends one JSON line a set to FILE as it is done, seed by seed over all families, and skips what FILE has: a run that was
stopped goes on where it was. --measured: only the measured recordings in FOLDER (default with an empty FOLDER: $S2R_DATA).
`compare` takes the sets that both files have (plain or .gz). Of each property it counts the sets that have it in one file only and tests
whether the two counts differ significantly (McNemar, exact, two-sided). Sets of `unopened` are counted and never listed: their
records hold no more than the counts need. Exit 0: no worse; 1: worse, or with --identical any answer differs.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).resolve().parent))

import bench_trace
from trace_sets.families import FAMILIES
from trace_sets.measured import RECORDINGS, trace_measured
from trace_sets.targets import Record
from trace_sets.unopened import UNOPENED

DIGITS = 6
"""Significant ones of a record's numbers. The digest is of all."""
ALPHA = 0.01
"""Level of the test of each property."""
NET_LOSS = 0.01
"""Share of a family's sets that may be lost, net of those that were gained."""
HARM = {"alarm", "wrong", "false_name", "named", "accepted", "overclaimed", "crash", "long_error"}
"""Outcomes in which the answer says something that is not so."""
DETAILS = {"effects", "depends_on", "faults", "error"}
"""Of an answer; without them a record says whether it was right, and not what it was."""
WORSE = 1.02
"""Error of the repaired model over that of the nominal one, on a new recording, from which on the repair did harm."""

Key = tuple[str, str]
"""Family; seed, or the name of a measured recording."""


# ---------------------------------------------------------------- one record


def compact(r: Record) -> Record:
    """A record of the bench, without what its set says by itself. Of an unopened set nothing that could be tuned on."""
    r = {key: value for key, value in r.items() if key not in DETAILS} if r["family"] in UNOPENED else r
    return {
        "family": r["family"],
        "seed": r["seed"],
        "verdict": r["verdict"],
        "outcome": r["outcome"],
        "judgement": judgement(r),
        **_answered(r),
        "again": r["again"]["noisy"][:2] if r.get("again") else None,
        "cpu_s": round(r["cpu_s"], 2),
        "digest": r["digest"],
    }


def judgement(r: Record) -> str:
    """right, wrong or tie. With another thing missing than the library has, `depends_on` is judged."""
    return "tie" if r["outcome"] == "tie" else "wrong" if bench_trace.went_wrong(r) else "right"


def of_measured(name: str, folder: Path) -> Record:
    """The record of a measured recording, which nobody judges."""
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        result = trace_measured(RECORDINGS[name], folder, Path(scratch))
        cpu_s = time.process_time() - begin
        answer = json.loads(json.dumps(result.to_json(), default=float))
        digest = bench_trace.digest(answer, result.spec, Path(scratch))
    return {
        "family": "measured",
        "seed": name,
        "verdict": answer["verdict"],
        "outcome": "",
        "judgement": "",
        **_answered(answer),
        "again": None,
        "cpu_s": round(cpu_s, 2),
        "digest": digest,
    }


def _answered(r: Record) -> Record:
    error = r["error"] if isinstance(r.get("error"), dict) else None
    return {
        "effects": [[e["name"], e["channel"], _values(e["parameters"])] for e in r.get("effects", [])],
        "depends_on": r.get("depends_on", []),
        "faults": len(r.get("faults", [])),
        "error": error and {when: {k: v for k, v in error[when].items() if k.endswith("_rms")} for when in ("before", "after")},
    }


def _values(parameters: dict[str, Any]) -> dict[str, Any]:
    return {name: value["value"] if isinstance(value, dict) else value for name, value in parameters.items()}


def short(value: Any) -> Any:
    """Plain data with numbers of DIGITS digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {k: short(v) for k, v in value.items()}
    return [short(v) for v in value] if isinstance(value, list) else value


# ---------------------------------------------------------------- recording


def record(path: Path, made: Iterable[Record]) -> None:
    """Appends each record as it is made."""
    with path.open("a", encoding="utf-8") as out:
        for one in made:
            out.write(json.dumps(short(one), separators=(",", ":")) + "\n")
            out.flush()


def read(path: Path) -> dict[Key, Record]:
    """Of a file, plain or packed, by set. A line that a stopped run left half written does not count."""
    whole = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    records = [json.loads(line) for line in whole.splitlines(keepends=True) if line.endswith(b"}\n")]
    return {(r["family"], str(r["seed"])): r for r in records}


def _repair_end(path: Path) -> None:
    """Cuts off half a line at the end."""
    if path.exists() and (whole := path.read_bytes()) and not whole.endswith(b"\n"):
        path.write_bytes(whole[: whole.rfind(b"\n") + 1])


# ---------------------------------------------------------------- comparison


class Paired(NamedTuple):
    """Of n sets: how many have the property in the old file, in the new one, and in one of them only."""

    n: int
    old: int
    new: int
    gained: int
    lost: int

    @property
    def p(self) -> float:
        """Of McNemar's test, exact and two-sided: under the null a set that differs is gained or lost with the same chance.

        Q. McNemar, Note on the sampling error of the difference between correlated proportions, Psychometrika 12, 1947.
        """
        return mcnemar(self.gained, self.lost)


def mcnemar(gained: int, lost: int) -> float:
    """Exact two-sided p of `gained` against `lost` discordant pairs; 1 without any."""
    return float(binomtest(gained, gained + lost, 0.5).pvalue) if gained + lost else 1.0


def paired(pairs: list[tuple[Record, Record]], has: Callable[[Record], bool]) -> Paired:
    """The counts of a property."""
    both = [(has(a), has(b)) for a, b in pairs]
    gained, lost = sum(b and not a for a, b in both), sum(a and not b for a, b in both)
    return Paired(len(pairs), sum(a for a, _ in both), sum(b for _, b in both), gained, lost)


def is_good(r: Record) -> bool:
    """Right, or an honest tie."""
    return r["judgement"] in {"right", "tie"}


def is_harmful(r: Record) -> bool:
    """A false alarm, a wrong name, a crash."""
    return r["outcome"] in HARM


def is_worse(r: Record) -> bool:
    """The repaired model errs more than the nominal one on a new recording."""
    return bool(r["again"]) and r["verdict"] in {"traced", "ambiguous"} and r["again"][1] > WORSE * r["again"][0]


def verdict_of(pairs: list[tuple[Record, Record]]) -> Iterator[tuple[str, str, Paired, bool]]:
    """(property, family or `all`, counts, whether it got worse) of every family and property."""
    families = [*dict.fromkeys(a["family"] for a, _ in pairs)]
    for family in ["all", *families]:
        of = [(a, b) for a, b in pairs if family in {"all", a["family"]} and a["judgement"]]
        if not of:
            continue
        good = paired(of, is_good)
        significant = good.p < ALPHA and good.lost > good.gained
        yield "good", family, good, significant or good.lost - good.gained > max(1.0, NET_LOSS * good.n)
        for name, has in (("harmful", is_harmful), ("repaired worse", is_worse)):
            harm = paired(of, has)
            yield name, family, harm, harm.p < ALPHA and harm.gained > harm.lost


def compare(old: dict[Key, Record], new: dict[Key, Record], *, changed: bool) -> tuple[list[str], bool, int]:
    """The lines of the report; whether it got worse; how many answers differ."""
    keys = [k for k in old if k in new]
    pairs = [(old[k], new[k]) for k in keys]
    known = [(a, b) for a, b in pairs if a["digest"] and b["digest"]]
    differ = [(a, b) for a, b in known if a["digest"] != b["digest"]]
    lines = [f"{len(pairs)} sets in both, {len(old) - len(keys)} in the old file only, {len(new) - len(keys)} in the new one only"]
    lines.append(f"{len(differ)} of {len(known)} answers differ")
    worse = False
    for name, family, counts, is_bad in verdict_of(pairs):
        worse |= is_bad
        if family == "all" or counts.gained or counts.lost:
            net = 100.0 * (counts.new - counts.old) / counts.n
            line = f"{counts.old:>5} -> {counts.new:<5} of {counts.n:<5} gained {counts.gained:<4} lost {counts.lost:<4}"
            lines.append(f"{name:<15} {family:<17} {line} net {net:+.1f} %  p = {counts.p:.3g}{'  WORSE' if is_bad else ''}")
    spent = [sum(r["cpu_s"] for r in side) for side in zip(*pairs, strict=True)] if pairs else [0.0, 0.0]
    ratio = f", ratio {spent[1] / spent[0]:.3f}" if spent[0] else ""
    lines.append(f"CPU s {spent[0]:.1f} -> {spent[1]:.1f}{ratio}")
    otherwise = [(a, b) for a, b in pairs if (a["judgement"], a["outcome"]) != (b["judgement"], b["outcome"])]
    shown = differ if changed else [*otherwise, *((a, b) for a, b in differ if not a["judgement"])]
    lines += [f"{a['family']}:{a['seed']}  {_said(a)}  ->  {_said(b)}" for a, b in shown if a["family"] not in UNOPENED]
    return lines, worse, len(differ)


def _said(r: Record) -> str:
    effects = "+".join(f"{name}({channel})" for name, channel, _ in r["effects"])
    return " ".join(part for part in (r["judgement"], r["outcome"], r["verdict"], effects, ",".join(r["depends_on"])) if part)


# ---------------------------------------------------------------- command line


def main(argv: list[str] | None = None) -> int:
    """Exit code, as above."""
    parser = argparse.ArgumentParser(prog="trace_records.py", description=__doc__.partition("\n")[0] if __doc__ else "")
    verbs = parser.add_subparsers(dest="verb", required=True)
    making = verbs.add_parser("record", help="append a record of every set to FILE")
    making.add_argument("file", type=Path, metavar="FILE")
    making.add_argument("--family", action="append", choices=[*bench_trace.GROUPS, *FAMILIES], help="may be repeated; default: all")
    making.add_argument("--seeds", type=bench_trace.seeds, default=range(10), metavar="A:B", help="of every family (default 0:10)")
    making.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    making.add_argument("--measured", metavar="FOLDER", help="the measured recordings in FOLDER instead ('': of $S2R_DATA)")
    comparing = verbs.add_parser("compare", help="two files in pairs")
    comparing.add_argument("old", type=Path, metavar="OLD")
    comparing.add_argument("new", type=Path, metavar="NEW")
    comparing.add_argument("--identical", action="store_true", help="exit 1 if any answer differs")
    comparing.add_argument(
        "--changed", action="store_true", help="list every answer that differs, not only those that are judged otherwise"
    )
    args = parser.parse_args(argv)
    if args.verb == "compare":
        for path in (args.old, args.new):
            if not path.exists():
                parser.error(f"{path} does not exist")
        lines, worse, differ = compare(read(args.old), read(args.new), changed=args.changed)
        print("\n".join(lines))
        return int(worse or (args.identical and differ > 0))
    _repair_end(args.file)
    has = read(args.file) if args.file.exists() else {}
    if args.measured is not None:
        folder = Path(args.measured or os.environ.get("S2R_DATA", ""))
        names = [n for n, one in RECORDINGS.items() if (folder / one.fit).exists()]
        if not names:
            parser.error(f"{folder} holds none of the measured recordings")
        record(args.file, (of_measured(n, folder) for n in names if ("measured", n) not in has))
    else:
        tasks = [t for t in bench_trace.tasks(bench_trace.ungrouped(args.family), args.seeds) if (t[0], str(t[1])) not in has]
        record(args.file, (compact(r) for r in bench_trace.run_all(tasks, args.jobs, None)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
