"""Writes sets: tools/trace_sets --family one --seeds 0:20 --out DIR [--packed]. Nothing that the tracer reads tells of the truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from trace_sets.families import FAMILIES, make


def seeds(text: str) -> range:
    """argparse type: A:B, or one seed."""
    first, sign, last = text.partition(":")
    if not first.isdecimal() or (sign and not last.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} must be A:B or a seed")
    return range(int(first), int(last) if sign else int(first) + 1)


def main() -> int:
    """Exit 0."""
    parser = argparse.ArgumentParser(prog="trace_sets", description=__doc__)
    parser.add_argument("--family", action="append", choices=[*FAMILIES], help="may be repeated; default: all")
    parser.add_argument("--seeds", type=seeds, default=range(10), metavar="A:B", help="default 0:10")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--packed", action="store_true", help="write CSV.gz")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for family in args.family or FAMILIES:
        for seed in args.seeds:
            data, _ = make(family, seed).write(args.out, packed=args.packed)
            print(data)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
