"""The search for faults of measurement on recordings that have one, and on recordings that have none (tools/trace_sets).

    tools/bench_faults.py [--seeds A:B] [--faulty A:B] [--listed]

Found: at least four of five true faults, under a name that fits, on their channel, overlapping by half (as bench_trace.py has it). Exact:
both ends within three rows of the truth (of a heading that wanders off, within a third of the interval). False: any fault but a dropout on
a recording without one; dropouts only where no row was lost. Exit 0: the table was made.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from trace_sets.__main__ import seeds
from trace_sets.families import make
from trace_sets.scoring import located
from trace_sets.targets import clopper_pearson

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import thinned
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.sensor_faults.detect import Fault, check

CLEAN = (
    "clean",
    "clean_closed",
    "clean_coloured",
    "clean_outliers",
    "clean_student",
    "clean_quantised",
    "clean_jittered",
    "clean_poor",
    "one",
    "pair",
    "outside",
)


def searched(family: str, seed: int) -> tuple[dict[str, Any], tuple[Fault, ...]]:
    """(truth, faults found) of one set, written to a file and read back."""
    made = make(family, seed)
    spec = ModelSpec(made.model["name"], made.model["dt"], made.model["parameters"], tuple(EffectSpec(**e) for e in made.model["effects"]))
    model = compose(spec)
    with tempfile.TemporaryDirectory() as folder:
        path, _ = made.write(Path(folder))
        model, data, _ = thinned(model, load_dataset(path, model))
    return made.truth, check(model, with_history(model, data)).faults


def exact(truth: dict[str, Any], told: tuple[Fault, ...]) -> bool:
    """Whether four of five true faults have both ends where they are."""
    step = 1.0 / truth["rate"]
    met = 0
    for true in truth["true_faults"]:
        slack = 3.0 * step
        if truth["kind"] == "inconsistent":
            slack = max(slack, (true["to_s"] - true["from_s"]) / 3.0)
        met += any(
            f.kind in true["kinds"] and abs(f.from_s - true["from_s"]) <= slack and abs(f.to_s - true["to_s"]) <= slack for f in told
        )
    return met >= 0.8 * len(truth["true_faults"])


def share(k: int, n: int) -> str:
    """k of n, with the exact 95 % interval."""
    low, high = clopper_pearson(k, n)
    return f"{k:>4} of {n:<4} {k / n:>6.1%}  ({low:.1%} to {high:.1%})"


def main() -> int:
    """Exit 0."""
    parser = argparse.ArgumentParser(prog="bench_faults", description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=range(40), metavar="A:B", help="of each family without a fault (default 0:40)")
    parser.add_argument("--faulty", type=seeds, default=range(120), metavar="A:B", help="of recordings with one (default 0:120)")
    parser.add_argument("--listed", action="store_true", help="name the sets that were missed or had a false fault")
    args = parser.parse_args()
    found: dict[str, Counter[str]] = defaultdict(Counter)
    for seed in args.faulty:
        truth, told = searched("fault", seed)
        plain = {"faults": [{"from_s": f.from_s, "to_s": f.to_s, "channel": f.channel, "kind": f.kind} for f in told]}
        there = located(truth, plain)
        found[truth["kind"]].update(n=1, found=there, exact=exact(truth, told))
        if args.listed and not there:
            print(f"missed: fault {seed} ({truth['kind']})", file=sys.stderr)
    print(f"{'fault':<16}{'found':<36}exact")
    for kind, c in sorted(found.items()):
        print(f"{kind:<16}{share(c['found'], c['n']):<36}{share(c['exact'], c['n'])}")
    print(f"\n{'no fault in':<16}false faults")
    for family in CLEAN:
        kinds: Counter[str] = Counter()
        false = 0
        for seed in args.seeds:
            truth, told = searched(family, seed)
            loud = {f.kind for f in told if f.kind != "dropout" or truth.get("seen") != "lost"}
            false += bool(loud)
            kinds.update(loud)
            if args.listed and loud:
                print(f"false: {family} {seed} {sorted(loud)}", file=sys.stderr)
        print(f"{family:<16}{share(false, len(args.seeds))}  {dict(kinds) or ''}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
