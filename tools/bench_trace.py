"""The tracer on recordings that it has never seen (tools/trace_sets): its blind targets, with exact intervals.

    tools/bench_trace.py [--family F]... [--seeds A:B] [--jobs J] [--json FILE] [--failures] [--from FILE]

Each set is written to a file and read back, as `s2r trace FILE --model MODEL.toml` does it; nothing of the truth goes in. One record
a set goes to --json FILE (a line each, as it is done), which --from reads again. Sets of `unopened` (all families
of that name: effects of no library, another robot) are only counted: --failures, --all and --by leave them out, so that nobody tunes on
them. Exit 0: the table was made, whatever it says.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).resolve().parent))

from trace_sets import sindy
from trace_sets.families import FAMILIES, UNTOUCHED, make
from trace_sets.log_kinds import LOG_KINDS
from trace_sets.log_scoring import delay_right
from trace_sets.recording import TraceSet
from trace_sets.scoring import covered, depends_right, located, outcome
from trace_sets.targets import Record, beside, by, reached, rows
from trace_sets.unopened import UNOPENED

KEPT = (
    "expect",
    "robot",
    "rate",
    "n",
    "law",
    "layout",
    "noise",
    "runs",
    "euler",
    "ratio",
    "kind",
    "values",
    "accepted",
    "depends_on",
    "share",
    "delayed",
)
SELDOM = {"long": 10, "long_clean": 10} | dict.fromkeys(UNOPENED, 5)
"""Of these families every tenth or fifth seed is run: one long set takes as long as ten others, and `unopened` are many families."""

GROUPS = {"unopened": [*UNOPENED], "logs": [*LOG_KINDS]}
"""Names that stand for some families each."""

GOOD = {"right", "clean", "tie", "found", "honest"}


def run_set(family: str, seed: int) -> Record:
    """Makes one set, traces it, judges the answer."""
    os.nice(10)
    return judged(make(family, seed))


def judged(given: TraceSet) -> Record:
    """The record of a set."""
    truth = given.truth
    record: Record = {"family": given.family, "seed": given.seed, **{k: truth[k] for k in KEPT if k in truth}, "truth": truth["effects"]}
    if "depends_on" in truth:
        record["true_depends_on"] = record.pop("depends_on")
    with tempfile.TemporaryDirectory() as folder:
        path, _ = given.write(Path(folder))
        return record | _answer(given, path)


def _answer(given: TraceSet, path: Path) -> Record:
    from s2r_runtime.errors import S2RError
    from s2r_runtime.models.composed import compose
    from s2r_runtime.modelspec import EffectSpec, ModelSpec
    from s2r_runtime.trace.data.unmeasured_states import alike
    from s2r_runtime.trace.pipeline import load_dataset, trace

    model = given.model
    spec = ModelSpec(model["name"], model["dt"], model["parameters"], tuple(EffectSpec(**e) for e in model["effects"]))
    nominal = compose(spec)
    begin = time.process_time()
    try:
        data = load_dataset(path, nominal)
        result = trace(data, nominal)
    except S2RError as error:
        text = str(error).replace(f"{path.parent}/", "")
        word = "refused" if given.truth["expect"] not in {"bad", "reversed"} else "honest" if "\n" not in text else "long_error"
        return {"outcome": word, "verdict": "", "cpu_s": time.process_time() - begin, "error": text, "digest": _digest(text)}
    except Exception as error:  # noqa: BLE001  a bench reports whatever the tracer does
        text = f"{type(error).__name__}: {error}"
        return {"outcome": "crash", "verdict": "", "cpu_s": time.process_time() - begin, "error": text, "digest": _digest(text)}
    cpu_s = time.process_time() - begin
    answer = json.loads(json.dumps(result.to_json(), default=float))
    told = {k: answer[k] for k in ("verdict", "effects", "ambiguous_with", "depends_on", "faults", "error", "suggested_excitation")}
    told["digest"] = digest(answer, result.spec, path.parent)
    truth = given.truth | {"unreached": _unreached(given)}
    told |= {"partial": answer.get("partial", []), "cpu_s": cpu_s, "outcome": outcome(truth, answer), "covered": covered(truth, answer)}
    told["located"] = "true_faults" in truth and located(truth, answer)
    told["delay_right"] = delay_right(truth, answer)
    told["depends_right"] = "depends_on" in truth and depends_right(truth, answer)
    if sindy.available() and truth["expect"] in {"one", "outside", "clean"}:
        told["sindy"] = sindy.answer(data, alike(nominal, data, None)[0])
        told["sindy"]["right"] = told["sindy"]["top"] in _sindy_right(given)
    if given.draft is not None and truth["expect"] in {"one", "pair", "outside", "clean"}:
        from trace_sets.again import errors_again

        repaired = compose(ModelSpec(spec.name, spec.dt, result.spec.parameters, result.spec.effects))  # at the step of the truth
        told["again"] = errors_again(given.draft, given.seed, nominal, repaired, truth["oracle"])
    return told


def digest(answer: dict[str, Any], spec: Any, folder: Path) -> str:
    """Of a whole answer, as `s2r trace --json` prints it, and of the model that it made, whatever the tracer's version and the folder."""
    # how rows are counted, and in which folder a model's file is, are no part of an answer
    model = msgspec.structs.replace(spec, name=Path(spec.name).name, fitted_on=())
    said = {key: value for key, value in answer.items() if key != "tracer"}
    return _digest(json.dumps([said, model.digest()], sort_keys=True).replace(str(folder), ""))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _sindy_right(given: TraceSet) -> set[str]:
    plant = given.draft.scale.plant
    if "depends_on" in given.truth:
        return set(given.truth["depends_on"])
    follows = {plant.inputs[j]: plant.states[i] for i, j in plant.reached.items()}
    return sindy.right_tokens(given.truth["effects"], plant.inputs, follows)


def _unreached(given: TraceSet) -> dict[str, float]:
    """Limits beyond the greatest command do not show in the data."""
    s = given.draft.scale
    return dict(zip(s.plant.inputs, (r.size for r in s.ranges), strict=True))


def went_wrong(r: Record) -> bool:
    """Whether it is worth a look."""
    if r["outcome"] == "flagged":
        return not r["depends_right"]
    return r["outcome"] not in GOOD and not (r["outcome"] == "none" and r["family"] == "weak")


def failure(r: Record) -> str:
    """One line: which set, what is true, what was answered."""
    what = "+".join(f"{e['name']}({e['channel']})" + _values(e["parameters"]) for e in r["truth"]) or r.get("kind") or "nothing"
    said = "+".join(f"{e['name']}({e['channel']})" + _values(e["parameters"]) for e in r.get("effects", []))
    rivals = ",".join(f"{e['name']}({e['channel']})" for e in r.get("ambiguous_with", ()) if not e["same_thing"])
    ties = f" ~ {rivals}" if rivals else ""
    left = f" left: {','.join(r['depends_on'])}" if r.get("depends_on") else ""
    part = " partial: " + "+".join(f"{e['name']}({e['channel']})" for e in r["partial"]) if r.get("partial") else ""
    wanted = f" depends: {'|'.join(r['true_depends_on'])}" if "true_depends_on" in r else ""
    faults = f" faults: {len(r['faults'])} {'|'.join(sorted({f['kind'] for f in r['faults']}))}" if r.get("faults") else ""
    ratio = f"{r['ratio']:.2f}" if r.get("ratio") else "-"
    error = r["error"] if isinstance(r.get("error"), str) else ""
    share = reached(r)
    got = f" reached {share:.0%}" if share is not None and r["truth"] else ""
    shape = f"{r['robot']} {r['rate']:g} Hz n={r['n']} {r['law']}/{r['layout']}/{r['noise']}" + (
        f" runs={r['runs']}" if r["runs"] > 1 else ""
    )
    return (
        f"{r['outcome']:<13}{r['family']}:{r['seed']} [{shape}{' euler' if r['euler'] else ''}] ratio {ratio}{got} TRUE {what}{wanted}"
        f" SAID {r['verdict']} {said}{ties}{left}{part}{faults}{error} ({r['cpu_s']:.1f} s)"
    )


def _values(parameters: dict[str, Any]) -> str:
    def one(v: Any) -> str:
        v = v["value"] if isinstance(v, dict) else v
        return f"{v:.3g}" if isinstance(v, float | int) else str(v) if isinstance(v, str) else "..."

    return "[" + " ".join(one(v) for v in parameters.values()) + "]"


def run_all(tasks: list[tuple[str, int]], jobs: int, file: Path | None) -> Iterator[Record]:
    """Records as they are done; each is appended to the file."""
    context = multiprocessing.get_context("spawn")
    for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(threads, "1")  # CPU seconds are measured; processes share the cores
    with ProcessPoolExecutor(jobs, mp_context=context) as pool, (file or Path(os.devnull)).open("w", encoding="utf-8") as out:
        waiting = [pool.submit(run_set, *task) for task in tasks]
        for done, future in enumerate(as_completed(waiting), 1):
            record = future.result()
            out.write(json.dumps(record) + "\n")
            out.flush()
            if sys.stderr.isatty():
                print(f"\r{done}/{len(tasks)} sets", end="", file=sys.stderr, flush=True)
            yield record


def tasks(families: Iterable[str], seeds: Iterable[int]) -> list[tuple[str, int]]:
    """(family, seed) of every set of these families, seed by seed; without any: of all, of SELDOM ones some."""
    named = [*families]
    return [(family, seed) for seed in seeds for family in named or FAMILIES if named or seed % SELDOM.get(family, 1) == 0]


def ungrouped(names: Iterable[str] | None) -> list[str]:
    """The families that names of families and of GROUPS stand for."""
    return [family for name in names or () for family in GROUPS.get(name, [name])]


def seeds(text: str) -> range:
    """argparse type: A:B, or one seed."""
    first, sign, last = text.partition(":")
    if not first.isdecimal() or (sign and not last.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} must be A:B or a seed")
    return range(int(first), int(last) if sign else int(first) + 1)


def main() -> int:
    """Exit 0."""
    parser = argparse.ArgumentParser(prog="bench_trace.py", description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--family", action="append", choices=[*GROUPS, *FAMILIES], help="may be repeated; default: all")
    parser.add_argument("--seeds", type=seeds, default=range(10), metavar="A:B", help="of every family (default 0:10)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write one record a set, a line each")
    parser.add_argument("--from", dest="source", type=Path, metavar="FILE", help="make the table of a file that --json wrote; run nothing")
    parser.add_argument("--failures", action="store_true", help="print the sets that went wrong, a line each")
    parser.add_argument("--by", metavar="KEY", help="count outcomes by effect, robot, layout, noise, law, rate or family")
    parser.add_argument("--all", action="store_true", help="print every set, a line each")
    args = parser.parse_args()
    args.family = ungrouped(args.family)
    if (args.failures or args.all) and not args.source and args.seeds.stop > UNTOUCHED.start:
        parser.error(
            f"seeds from {UNTOUCHED.start} on are not looked at one by one: they would be tuned on; take others with --failures and --all"
        )
    if args.source:
        records = [json.loads(line) for line in args.source.read_text(encoding="utf-8").splitlines()]
        records = [r for r in records if not args.family or r["family"] in args.family]
    else:
        records = []
        for record in run_all(tasks(args.family, args.seeds), args.jobs, args.json):
            records.append(record)
            if (args.all or (args.failures and went_wrong(record))) and record["family"] not in UNOPENED:
                print(failure(record), flush=True)
    opened = [r for r in records if r["family"] not in UNOPENED]
    if args.source and (args.all or args.failures):
        for record in opened:
            if args.all or went_wrong(record):
                print(failure(record))
    for line in by(opened, args.by) if args.by else ():
        print(line)
    print()
    for row in rows(records):
        print(row.text())
    if not sindy.available():
        print("\nPySINDy beside it: skipped, it is not installed (pip install '.[bench]')")
    for row in beside(records):
        print(row.text())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
