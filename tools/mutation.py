"""make mutation: does a test notice every small change of the gate, the certificate and the core? (docs/gate.md)

    python tools/mutation.py [MODULE...] [--jobs N] [--share 0.1 --seed 1] [--list] [--coverage] [--json]

Every mutant (`mutants`) of gate.py, certificate.py and core/ is run against those tests that execute its lines, the quick ones first,
until one fails. In gate.py and certificate.py none may survive, in core/ at most 5 %. Mutants that behave as the original in all that
it promises stand in `mutation_equivalent.txt`, each with its reason, and count neither way; an entry there that a test kills, or that no
mutant has, is an error. Exit 1 if anything of this does not hold, or a line of these modules is run by none of the tests.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import pickle
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from mutants import Mutant, mutants
from mutation_run import BROKEN, KILLED, PRELOAD, ROOT, Plan, Session, constants, executable, run_pytest

PACKAGE = ROOT / "s2r_runtime"
KILLED_OF_CORE = 0.95
TESTS = (
    "test_gate.py",
    "test_gate_faults.py",
    "test_certificate.py",
    "test_certificate_issue.py",
    "test_core*.py",
    "test_anytime.py",
    "test_ledger.py",
    "test_bounds.py",
    "test_watch_tests.py",
    "test_blocked.py",
    "test_keys.py",
    "test_unsaved_state.py",
)
"""Neither the walks nor the draws of faults: they take too long for a few thousand times, and the recorded lives (test_core_replay) are
made of them.
"""
EQUIVALENT = Path(__file__).with_name("mutation_equivalent.txt")


def modules(wanted: list[str]) -> dict[str, Path]:
    """Short name -> file, of those that are asked for."""
    known = {"gate.py": PACKAGE / "gate.py", "certificate.py": PACKAGE / "trust" / "certificate.py"}
    known |= {f"core/{path.name}": path for path in sorted((PACKAGE / "core").glob("*.py"))}
    return {name: path for name, path in known.items() if not wanted or any(name.startswith(one) for one in wanted)}


# ---------------------------------------------------------------- the account


def equivalents() -> dict[str, str]:
    """Name -> why no test can notice it."""
    found, name = {}, ""
    for line in EQUIVALENT.read_text(encoding="utf-8").splitlines():
        if line.startswith("    ") and name:
            found[name] = f"{found[name]} {line.strip()}".strip()
        elif line.strip() and not line.startswith("#"):
            name = line.strip()
            found[name] = ""
    return found


def account(plan: Plan, missed: set[tuple[str, int]], *, whole: bool) -> int:
    """Prints what came of it; exit code."""
    known, wrong = equivalents(), 0
    for name, why in known.items():
        came = plan.results.get(name)
        if (came is not None and came[0] == KILLED) or (came is None and whole) or not why:
            print(f"{EQUIVALENT.name}: {name}: {'has no reason' if not why else 'is killed' if came else 'is no mutant (any more)'}")
            wrong += 1
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for one in plan.mutants:
        result = "equivalent" if one.name in known else plan.results.get(one.name, (BROKEN, ""))[0]
        rows[one.module][result] += 1
        if result not in (KILLED, "equivalent"):
            print(f"{result}: {one.name}   (line {one.lines[0]})")
    for module, line in sorted(missed):
        print(f"not run by any test: {module}:{line}")
    core: Counter[str] = Counter()
    print(f"{'module':24s} mutants  killed  equivalent  survived")
    for module, row in sorted(rows.items()):
        judged = row.total() - row["equivalent"]
        print(f"{module:24s} {row.total():7d} {row[KILLED]:7d} {row['equivalent']:11d} {judged - row[KILLED]:9d}")
        if module.startswith("core/"):
            core += row
        elif judged != row[KILLED]:
            wrong += 1
    judged = core.total() - core["equivalent"]
    if judged:
        print(f"core/: {core[KILLED]} of {judged} killed, {core[KILLED] / judged:.2%}")
        wrong += core[KILLED] < KILLED_OF_CORE * judged
    return 1 if wrong or missed else 0


def main() -> int:
    """0 if every line was run and every mutant killed or told to be equivalent, 1 otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", help="gate.py certificate.py core/drive.py ... (default: all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--share", type=float, default=1.0, help="run only a random share of the mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="run only mutants whose name contains this")
    parser.add_argument("--list", action="store_true", help="only name the mutants")
    parser.add_argument("--coverage", action="store_true", help="only look whether every line is run")
    parser.add_argument("--json", type=Path, help="write what came of each mutant there")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="run only these of the tests (files, patterns, or single tests)")
    parser.add_argument("--again", type=Path, help="what --told noted of a run before: run only what was not killed then, and count both")
    parser.add_argument("--told", type=Path, help="note what came of each mutant there, line by line, as soon as it is known")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    files = modules(options.modules)
    trees = {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in files.items()}
    chosen = [one for name in files for one in mutants(name, trees[name]) if options.only in one.name]
    if options.share < 1.0:
        chosen = [one for one in chosen if random.Random(f"{options.seed}{one.name}").random() < options.share]
    before = told(options.again) if options.again else {}
    if options.list:
        print("\n".join(one.name for one in chosen))
        return 0
    for name in PRELOAD:
        importlib.import_module(name)
    folder = Path(tempfile.mkdtemp(prefix="mutation"))
    plan = Plan(files, trees, [one for one in chosen if one.name not in before], folder, options.jobs, options.coverage, options.told)
    try:
        return _run(plan, options, chosen, before)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def told(path: Path) -> dict[str, tuple[str, str]]:
    """What earlier runs killed. Tests only become more, so what was killed once stays so; a changed line has mutants of other names."""
    rows = [line.split("\t") for line in path.read_text(encoding="utf-8").splitlines()]
    return {name: (result, by) for result, name, by in rows if result == KILLED}


def test_paths(patterns: list[str]) -> list[str]:
    """Files and single tests; the long walks only where they are named."""
    found = []
    for pattern in patterns:
        files, _, name = pattern.partition("::")
        paths = sorted(path for path in (ROOT / "tests").glob(files) if name or path.name != "test_core_walk.py")
        found += [f"{path}::{name}" if name else str(path) for path in paths]
    return list(dict.fromkeys(found))


def _run(plan: Plan, options: Any, chosen: list[Mutant], before: dict[str, tuple[str, str]]) -> int:
    begun = time.monotonic()
    paths = test_paths(options.tests)
    pid = os.fork()
    if pid == 0:
        os.dup2(os.open(plan.folder / "pytest", os.O_WRONLY | os.O_CREAT), 1)
        code = 3
        try:
            code = run_pytest([Session(plan)], paths, plan)
        except BaseException:  # noqa: BLE001 - the process ends here
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    os.waitpid(pid, 0)
    if not (plan.folder / "baseline").exists():
        print((plan.folder / "pytest").read_text(), "the tests could not be run without any change", file=sys.stderr)
        return 70
    notes = pickle.loads((plan.folder / "baseline").read_bytes())  # noqa: S301 - our own child
    missed: set[tuple[str, int]] = set()
    for name, path in plan.files.items():
        missed |= executable(name, plan.trees[name], path) - notes["covered"]
    if options.coverage:
        for module, line in sorted(missed):
            print(f"not run by any test: {module}:{line}")
        print(f"{len(missed)} lines are not run" if missed else "every line is run")
        return 1 if missed else 0
    plan.results.update(pickle.loads((plan.folder / "functions").read_bytes()))  # noqa: S301 - our own child
    constants(plan, notes["files"])
    if options.json:
        options.json.write_text(json.dumps(plan.results, indent=1))
    plan.mutants, plan.results = chosen, {**plan.results, **before}
    code = account(plan, missed, whole=options.share >= 1.0 and not options.only and not options.modules)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{time.monotonic() - begun:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of the processor")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
