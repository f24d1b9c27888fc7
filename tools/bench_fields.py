"""Changes one field of one record of a sound log, signs it with the true key, and counts what the audit does not see (docs/auditor.md).

    tools/bench_fields.py [--count 5000] [--seed 1] [--quick] [--json]

The log is that of a whole run: campaign, gap, trace, certificate, drive, given inputs. Every field of every kind of record that is in it is
changed in turn, at random records: numbers by a little or a lot, texts by a character, flags flipped, lists shortened. Whoever has the key
can do that, so only recomputing shows it. Exit 0: every change was seen, but for the fields that `NOT_RECOMPUTED` names with the reason.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "rigs"))

import audit_bench

from s2r_runtime.audit.log import audit
from s2r_runtime.errors import S2RError
from s2r_runtime.messages import Struct

Where = tuple[str | int, ...]

NOT_RECOMPUTED = {
    "Frame arrival_ns": "when bytes came or left, by the daemon's clock",
    "Frame inbound": "bytes that no transport can read say nothing, whether they came or left; a command without its frame is found",
    "Started unix_s": "the wall clock at the start; certificates are checked against it",
    "Started memory": "what the daemon remembered at its start; recomputed where the run's earlier logs are given, too",
    "Measured t_ns": "when a discrepancy came back from the process that measures",
    "Requested by": "who made the request: the user number that the operating system gave",
    "Requested": "what a person requested, and when; what the core made of it is recomputed",
    "CampaignFinished detail": "why a campaign that is not complete ended, in words",
    "InputsFinished detail": "the same of given inputs",
    "JobFinished safety": "safety values of single scenarios: only with --rerun-controllers; number, failures and least value always",
    "JobFinished trace.cpu_s": "what a trace took of the processor",
    "JobFinished trace.model_path": "where its model's file was put",
    "JobFinished trace.tracer": "which version of the tracer made it; a trace of another version is reported as that, and not run again",
    "JobFinished behaviour": "what a controller did on the probe observations; what the core made of it is recomputed",
    "SourceStarted t_ns": "when a controller or another source had started",
    "Proposed command.ttl_ns": "for how long a controller's command was to hold; what the gate made of it is recomputed",
}
"""What only the recorder's signature vouches for, or another option: kind of record, and field with what is in it -> what it is."""


def leaves(value: Any, at: Where = ()) -> Iterator[tuple[Where, Any]]:
    """Every number, text and flag in plain data, and where it stands. A list that holds something is a leaf too: it can be cut."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, (*at, key))
    elif isinstance(value, list) and value:
        yield at, value
        for index, inner in enumerate(value):
            yield from leaves(inner, (*at, index))
    else:
        yield at, value


def other(value: Any, rng: random.Random) -> Any:
    """Another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + rng.choice((-1, 1, 1000))
    if isinstance(value, float):
        return rng.choice((value * (1.0 + 1e-9) + 1e-12, value + 0.01, -value - 1.0))
    if isinstance(value, str):
        return rng.choice((value + "x", value[:-1] if value else "y", "another"))
    if isinstance(value, list):
        return value[:-1]
    return {"x": 1} if isinstance(value, dict) else 1.0


def put(plain: Any, at: Where, value: Any) -> Any:
    """A copy with that value there."""
    if not at:
        return value
    copy = dict(plain) if isinstance(plain, dict) else list(plain)
    copy[at[0]] = put(plain[at[0]], at[1:], value)  # type: ignore[index,call-overload]
    return copy


def named(message: Struct, at: Where) -> str:
    """`out/send u`: the kind of record and the field, whichever element of a list it is."""
    return f"{type(message).__name__} {'.'.join('[]' if isinstance(part, int) else part for part in at)}"


def reason_of(name: str) -> str:
    """Why this field is not recomputed; empty if it is."""
    return next((why for known, why in NOT_RECOMPUTED.items() if name == known or name.startswith((f"{known}.", f"{known} "))), "")


def run(folder: Path, *, traced: bool) -> audit_bench.Bench:
    """The sound run; with a trace in it its audit takes ten times as long, since it traces again."""
    folder.mkdir()
    bench = audit_bench.Bench(folder).sample()
    bench.gain = 0.7
    if traced:
        bench.trace()
    bench.drive(60)
    bench.gain = 2.0
    bench.steps(40)
    bench.ask("undeploy")
    bench.excite(20)
    return bench.stop()


def places(items: list[Any]) -> dict[str, list[tuple[int, Where]]]:
    """Field -> where it stands in the log."""
    found = defaultdict(list)
    for number, item in enumerate(items):
        if isinstance(item, Struct):
            for at, _ in leaves(msgspec.to_builtins(item)):
                found[named(item, at)].append((number, at))
    return dict(found)


def changed(item: Struct, at: Where, rng: random.Random) -> Struct | None:
    """The record with another value there; None where the log's format has no such value."""
    plain = msgspec.to_builtins(item)
    value = plain
    for part in at:
        value = value[part]
    try:
        made: Struct = msgspec.convert(put(plain, at, other(value, rng)), type(item))
    except msgspec.ValidationError:
        return None
    return None if made == item else made


def seen(bench: audit_bench.Bench, number: int, item: Struct, path: Path) -> bool:
    """Whether the audit sees this record in the place of the one there."""
    before = bench.items[number]
    bench.items[number] = item
    path.unlink(missing_ok=True)
    log = bench.write(path)
    bench.items[number] = before
    try:
        return not audit([log], audit_bench.PUBLIC).ok
    except S2RError:
        return True


def main() -> int:
    """Exit 0 if every change of a field that is recomputed was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="one change of each field")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    tried: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    with tempfile.TemporaryDirectory() as folder:
        benches = [run(Path(folder) / str(traced), traced=traced) for traced in (True, False)]
        fields = {name: (bench, found) for bench in benches for name, found in places(bench.items).items()}
        path = Path(folder) / "changed.mcap"
        total = len(fields) if args.quick else args.count
        order = list(fields)
        done = idle = 0
        while done < total and idle < 10 * len(order):
            name = order[(done + idle) % len(order)]
            bench, found = fields[name]
            number, at = rng.choice(found)
            made = changed(bench.items[number], at, rng)
            if made is None:
                idle += 1
                continue
            done += 1
            tried[name][0] += 1
            tried[name][1] += seen(bench, number, made, path)
    missed = {name: (n, n - found, reason_of(name)) for name, (n, found) in sorted(tried.items()) if found < n}
    if args.json:
        print(json.dumps({"changes": done, "fields": len(tried), "missed": missed}))
    else:
        unexpected = sum(unseen for _, unseen, reason in missed.values() if not reason)
        total = sum(unseen for _, unseen, _ in missed.values())
        print(f"{done} changes of {len(tried)} fields; unseen: {unexpected}, and {total - unexpected} of fields that nothing recomputes")
        for name, (n, unseen, reason) in missed.items():
            print(f"  {name}: {unseen} of {n}" + (f" ({reason})" if reason else ""))
    return 0 if all(reason for _, _, reason in missed.values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
