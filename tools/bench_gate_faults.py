"""Seeded faults in the gate and in the core, as many as asked for; none may let a command pass that the document would not.

    python tools/bench_gate_faults.py --count 100000 [--seed 1] [--first 0] [--core] [--json]

*Gate*: the situation in which everything holds, one to three of its fields, its certificate's, its command's, its observation's or its
settings' replaced by hostile values; the verdict and its reason are compared with the document's table (tests/gate_law.py). *Core*: one
to three faults in a life that samples, verifies or drives (tests/core_faults.py); every event is judged by the law of tests/core_law.py,
and when the cause goes a certified controller must drive again. Exit 1 if one case does not hold; `--first N` and `--count 1` run it alone.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "rigs"))

from core_faults import run_case  # noqa: E402
from gate_law import case, reason  # noqa: E402

from s2r_runtime import gate  # noqa: E402

SHOWN = 10
"""Failures that are printed one by one."""


def gate_cases(seed: int, numbers: range) -> tuple[Counter[str], list[str]]:
    """Reason -> verdicts, and what was wrong."""
    given: Counter[str] = Counter()
    wrong = []
    for number in numbers:
        settings, situation, command, now, changed = case(random.Random(f"{seed}/{number}"))
        verdict = gate.decide(settings, situation, command, now)
        wanted = reason(settings, situation, command, now)
        if (verdict.reason, verdict.allow) != (wanted, wanted == gate.ALLOWED):
            wrong.append(f"gate case {number} ({', '.join(changed)}): {verdict.reason}, not {wanted}")
        given[verdict.reason.split(":")[0]] += 1
    return given, wrong


def core_cases(seed: int, numbers: range) -> tuple[Counter[str], Counter[str], list[int], list[str]]:
    """Fault -> times, reason -> times, events until each case had mended, and what was wrong."""
    faults: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    events, wrong = [], []
    for number in numbers:
        try:
            outcome = run_case(seed, number)
        except AssertionError as error:
            wrong.append(f"core case {number}: {error}")
            continue
        except KeyboardInterrupt:  # whoever waits no longer is told what was run
            break
        faults.update(outcome.faults)
        reasons.update(one.split(":")[0] for one in outcome.reasons)
        events.append(outcome.events)
    return faults, reasons, events, wrong


def main() -> int:
    """0 if no case came out otherwise than the law says, 1 otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="cases in the gate, and as many in the core")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--core", action="store_true", help="only the cases in the core; an interrupt (SIGINT) ends them with what was run")
    parser.add_argument("--quick", action="store_true", help="a hundredth of them")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    numbers = range(options.first, options.first + (options.count // 100 if options.quick else options.count))
    begun = time.process_time()
    given, wrong = gate_cases(options.seed, numbers) if not options.core else (Counter[str](), [])
    faults, reasons, events, wrong_too = core_cases(options.seed, numbers)
    wrong += wrong_too
    spent = time.process_time() - begun
    if options.json:
        found = {
            "cases": given.total() + len(events) + len(wrong_too),
            "wrong": wrong,
            "gate": given,
            "core": reasons,
            "faults": faults,
            "cpu_s": spent,
        }
        print(json.dumps(found))
        return 1 if wrong else 0
    print("\n".join(wrong[:SHOWN]))
    if not options.core:
        print(f"gate: {len(numbers)} cases, {given[gate.ALLOWED]} of them harmless and allowed, {len(given) - 1} reasons given")
    ran = len(events) + len(wrong_too)
    mended = f"all mended, the last after {max(events, default=0)} events" if len(events) == ran else f"{len(events)} mended"
    print(f"core: {ran} cases of {len(faults)} kinds of fault, {faults.total()} faults; {len(reasons)} reasons; {mended}")
    for name, count in sorted(faults.items()):
        print(f"    {count:7d}  {name}")
    print(f"{len(wrong)} wrong; seed {options.seed}, {spent:.0f} s of the processor")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
