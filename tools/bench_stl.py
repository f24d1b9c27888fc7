"""Signal temporal logic beside RTAMT: the same values on random formulas, and the throughput on a batch of traces.

    tools/bench_stl.py [--formulas 3000] [--traces 1000] [--samples 200] [--seed 1] [--json] [--quick]

Values: random formulas of every operator on random traces, compared at every sample. Throughput: robustness of all the traces at
their first sample, CPU seconds, the least of several runs; RTAMT (discrete time, offline, parsed once) does the same traces one
after the other; so that a minute is enough it is timed on some of them, and the time scaled up. Promise: at least 100 times its
throughput on every formula. Exit 1 if a value differs or the promise is broken; 0, and a word about it, where rtamt is not installed
(pip install '.[bench]').
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import random
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "rigs"))

import stl_random

from s2r_runtime.tasks.stl.robustness import Formula

PROMISED = 100.0
FORMULAS = {
    "always": "always (x > -9)",
    "bounded": "always[0,150] ((x > -9) and (abs(y) < 9))",
    "reach": "(eventually[0,100] (always[0,20] (x > 1))) and (always (y > -9))",
    "respond": "always ((x > 2) -> (eventually[0,25] (y > 0)))",
    "until": "(x > -2) until[0,20] (y > 2)",
}
"""In the words that both read alike."""


def values(count: int, seed: int) -> dict[str, int]:
    """Random formulas on a random trace each. `differ`: of how many a value at any sample is another one."""
    rng, differ = random.Random(seed), 0
    for _ in range(count):
        node = stl_random.random_formula(rng, rng.randint(0, 4))
        trace = {name: [round(rng.uniform(-3.0, 3.0), 3) for _ in range(30)] for name in stl_random.NAMES}
        signals = {name: np.array(trace[name])[:, None] for name in trace}
        ours = Formula.parse(stl_random.text(node), stl_random.NAMES, 1.0).robustness(signals, whole=True)[:, 0]
        if not np.allclose(ours, stl_random.rtamt_robustness(node, trace), rtol=1e-12, atol=1e-12):
            differ += 1
            print(f"differs: {stl_random.text(node)}", file=sys.stderr)
    return {"formulas": count, "differ": differ}


def throughput(text: str, signals: dict[str, np.ndarray], timed: int, repeat: int) -> dict[str, Any]:
    """CPU seconds for the whole batch, ours and RTAMT's; signals (T, runs)."""
    import rtamt

    runs = signals["x"].shape[1]
    formula = Formula.parse(text, stl_random.NAMES, 1.0)
    ours, found = _least(repeat, lambda: formula.robustness(signals))
    spec = rtamt.StlDiscreteTimeSpecification()
    for name in stl_random.NAMES:
        spec.declare_var(name, "float")
    spec.spec = text
    spec.parse()
    traces = [{"time": list(range(len(signals["x"]))), **{n: v[:, k].tolist() for n, v in signals.items()}} for k in range(timed)]
    theirs, told = _least(2, lambda: [spec.evaluate(trace)[0][1] for trace in traces])
    theirs *= runs / timed
    same = bool(np.allclose(found[:timed], told, rtol=1e-12, atol=1e-12))
    return {"formula": text, "s2r_s": ours, "rtamt_s": theirs, "ratio": theirs / ours, "same": same}


def _least(repeat: int, run: Any) -> tuple[float, Any]:
    took, result = [], None
    for _ in range(repeat):
        start = time.process_time()
        result = run()
        took.append(time.process_time() - start)
    return max(min(took), 1e-6), result


def main() -> int:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--formulas", type=int, default=3000)
    parser.add_argument("--traces", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--quick", action="store_true", help="100 formulas")
    given = parser.parse_args()
    if importlib.util.find_spec("rtamt") is None:
        print("rtamt is not installed (pip install '.[bench]', Python up to 3.12): nothing to compare with")
        return 0
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(given.seed)
    signals = {name: np.cumsum(rng.standard_normal((given.samples, given.traces)), axis=0) / 4.0 for name in stl_random.NAMES}
    timed = min(given.traces, 20 if given.quick else 100)
    rows = [throughput(text, signals, timed, 3 if given.quick else 15) for text in FORMULAS.values()]
    compared = values(100 if given.quick else given.formulas, given.seed)
    wrong = [
        f"{row['formula']}: {row['ratio']:.0f} times RTAMT's throughput, promised {PROMISED:g}" for row in rows if row["ratio"] < PROMISED
    ]
    wrong += [f"{row['formula']}: the values differ" for row in rows if not row["same"]]
    wrong += [f"{compared['differ']} of {compared['formulas']} random formulas differ"] if compared["differ"] else []
    if given.json:
        print(json.dumps({"rows": rows, "values": compared, "broken": wrong}))
        return 1 if wrong else 0
    print(f"{given.traces} traces of {given.samples} samples; CPU seconds for all of them (RTAMT timed on {timed})")
    for row in rows:
        print(f"  {row['s2r_s'] * 1e3:8.2f} ms   RTAMT {row['rtamt_s']:8.2f} s   ratio {row['ratio']:8.0f}   {row['formula']}")
    print(f"random formulas: {compared['formulas']}, of which differ at any sample: {compared['differ']}")
    print("\n".join(wrong) if wrong else "every promise holds")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
