"""What verification costs: CPU time of the grid task's rollouts, and its ratio to the same rollouts in C.

    tools/bench_verify.py [--json] [--repeat 5] [--quick]

Figures: 300 rollouts and 20 000 rollouts under each law, scenarios drawn and rolled out, CPU seconds (the least of `repeat` runs; a
shared machine only ever adds to it). Promise: 0.15 s and 4 s under the laws that are required by default. A whole attempt as the daemon
makes it, three laws and the search for the headroom, where it has to halve, and where it fails down to the gap itself; promise: 1 s.
Then the ratio to kernel.c (compiled here with -O3, one thread) on the same scenarios, as many rollouts, law `uniform`; aim: at most 3.
Without a C compiler the ratio is left out, and said so. The kernel must agree: scenario by scenario without disturbance and turns, and
in the mean of the safety values with them. Exit 1 if a promise is broken or the kernel disagrees.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.core.ledger import share
from s2r_runtime.evidence.uncertain import LAWS, GapSet, roll_out
from s2r_runtime.evidence.verify import verify
from s2r_runtime.hookspecs import Scenario
from s2r_runtime.messages import Verification
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.profile import load_profile
from s2r_runtime.tasks.grid_world import GridWorld

Array = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
SMALL, LARGE = 300, 20_000
PROMISED_S = {SMALL: 0.15, LARGE: 4.0}
PROMISED_ATTEMPT_S = 1.0
AIM = 3.0
TIPPED = 1e-3
"""Share of scenarios that rounding may tip over an edge: the two add in another order, and a controller decides by comparing."""
RADIUS, HOLD_RADIUS, HOLD = 0.0015, 0.0016, 50
"""Of the built-in robot as its data sheet describes it, times the headroom."""

PARAMETERS = ("cell", "left", "bottom", "dt", "robot_radius", "touch", "turn_probability", "wheel_speed", "track")
CONTROLLER = ("speed", "turn", "max_turn", "aligned", "lookahead", "body", "margin", "wall", "fade", "keep", "foresight", "fear", "wary")


class Setting(ctypes.Structure):
    """kernel.c's `Setting`."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("rollouts", "steps", "width", "size", "rows", "movers", "period")),
        *((name, ctypes.c_double) for name in PARAMETERS),
        *((name, ctypes.c_double) for name in ("radius", "weight_x", "weight_y", "weight_theta")),
        *((name, ctypes.c_double) for name in CONTROLLER),
        ("seed", ctypes.c_uint64),
    ]


class Drawn(GridWorld):
    """The task with scenarios that were drawn beforehand, so that only their rollouts are timed."""

    def beforehand(self, rng: np.random.Generator, n: int) -> Scenario:
        """Draws n scenarios, which `draw` will hand out."""
        self._given, self._next = super().draw(rng, n), 0
        return self._given

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """The next n of them, from the first again after the last."""
        rows = slice(self._next, self._next + n)
        self._next = rows.stop % len(self._given["step"])
        return {name: np.asfortranarray(v[rows]) if name.startswith("mover") else v[rows] for name, v in self._given.items()}


class Bench:
    """Model, task, controller and disturbance, as the profile robotarium has them."""

    def __init__(self, repeat: int) -> None:
        self.repeat = repeat
        self.profile = load_profile(ROOT / "profiles" / "robotarium.toml")
        self.model: ComposedModel = compose(self.profile.model)
        self.file = load(ROOT / "controllers" / "grid.py")
        self.control = batch_control(self.file, len(self.model.inputs))
        self.weights = tuple(self.profile.norm.weights.get(name, 1.0) for name in self.model.states)

    def parameters(self, **others: float) -> dict[str, float]:
        """The profile's task's, with others."""
        return {**{name: default for name, (default, _) in GridWorld.PARAMETERS.items()}, **self.profile.task.parameters, **others}

    def cpu(self, run: Callable[[], Any]) -> float:
        """Least CPU seconds of `repeat` runs."""
        took = []
        for _ in range(self.repeat):
            start = time.process_time()
            run()
            took.append(time.process_time() - start)
        return min(took)

    def python(self, task: GridWorld, law: str, n: int, radius: float = RADIUS, hold: float = HOLD_RADIUS) -> Array:
        """Safety values of n rollouts."""
        gap = GapSet("ball", self.weights, radius, hold, HOLD)
        return roll_out(self.control, task, self.model, gap, law, np.random.default_rng(1), n).safety

    def attempt(self, task: GridWorld, most: float) -> Verification:
        """The first verification attempt of a robot's life, at radii from the gap's to `most` times it."""
        gap = GapSet("ball", self.weights, most * RADIUS, most * HOLD_RADIUS, HOLD)
        settings = self.profile.verification
        return verify(
            self.control,
            task,
            self.model,
            gap_set=gap,
            least_radius=RADIUS,
            laws=settings.laws,
            required=settings.required,
            n=0,
            epsilon=settings.epsilon,
            beta=share(self.profile.guarantee.beta, 1),
            threshold=settings.threshold,
            seed=1,
            controller_digest=self.file.digest,
            task_digest=self.profile.task_digest(),
        )


class Kernel:
    """kernel.c, compiled."""

    def __init__(self, compiler: str, directory: Path) -> None:
        library = directory / "kernel.so"
        subprocess.run([compiler, "-O3", "-shared", "-fPIC", str(ROOT / "tools" / "kernel.c"), "-o", str(library), "-lm"], check=True)
        self._roll_out = ctypes.CDLL(str(library)).roll_out
        self._roll_out.restype = None

    def safety(self, bench: Bench, p: dict[str, float], s: Scenario, radius: float) -> Array:
        """Safety values of these scenarios, (n,), for task parameters p."""
        kinds = {"start": "f8", "blocked": "u1", "distance": "f8", "mover_cell": "i8", "mover_direction": "i8", "mover_moves": "u1"}
        arrays = [np.ascontiguousarray(s[name], dtype=kind) for name, kind in kinds.items()]
        result = np.empty(len(s["step"]))
        setting = self._setting(bench, p, len(result), radius)
        self._roll_out(ctypes.byref(setting), *(a.ctypes.data_as(ctypes.c_void_p) for a in (*arrays, result)))
        return result

    @staticmethod
    def _setting(bench: Bench, p: dict[str, float], n: int, radius: float) -> Setting:
        wheels = next(e for e in bench.model.effects if e.effect.name == "wheel_saturation").p
        columns, rows, cell, dt = int(p["columns"]), int(p["rows"]), p["cell"], bench.model.dt
        return Setting(
            rollouts=n,
            steps=int(p["steps"]),
            width=columns + 2,
            size=(columns + 2) * (rows + 2),
            rows=rows,
            movers=int(p["movers"]),
            period=max(1, round(cell / (p["mover_speed"] * dt))),
            cell=cell,
            left=p["center_x"] - columns * cell / 2.0,
            bottom=p["center_y"] - rows * cell / 2.0,
            dt=dt,
            robot_radius=p["robot_radius"],
            touch=p["robot_radius"] + p["mover_radius"],
            turn_probability=p["turn"],
            wheel_speed=wheels["speed"],
            track=wheels["track"],
            radius=radius,
            **dict(zip(("weight_x", "weight_y", "weight_theta"), bench.weights, strict=True)),
            **{name: float(bench.file.parameters[name]) for name in CONTROLLER},
            seed=1,
        )


def compare(bench: Bench, kernel: Kernel, n: int) -> dict[str, Any]:
    """Agreement and ratio over n rollouts. `disagree`: scenarios whose safety differs where nothing is random."""
    rng = np.random.default_rng(2)
    fixed, usual = bench.parameters(turn=0.0), bench.parameters()
    still, task = (Drawn(p, bench.model.nominal, bench.model.dt) for p in (fixed, usual))
    scenarios = still.beforehand(rng, n)
    alike = np.isclose(bench.python(still, "uniform", n, 0.0, 0.0), kernel.safety(bench, fixed, scenarios, 0.0), rtol=0.0, atol=1e-9)
    scenarios = task.beforehand(rng, n)
    ours, theirs = bench.python(task, "uniform", n), kernel.safety(bench, usual, scenarios, RADIUS)
    python_s = bench.cpu(lambda: bench.python(task, "uniform", n))
    c_s = bench.cpu(lambda: kernel.safety(bench, usual, scenarios, RADIUS))
    return {
        "python_s": python_s,
        "c_s": c_s,
        "ratio": python_s / c_s,
        "disagree": int(np.sum(~alike)),
        "mean_safety": [float(np.mean(ours)), float(np.mean(theirs))],
        "spread": float(np.std(ours) / np.sqrt(n)),
        "crashes": [int(np.sum(ours < 0.0)), int(np.sum(theirs < 0.0))],
    }


def measure(repeat: int, n: int) -> dict[str, Any]:
    """All figures. n: rollouts of the large run."""
    bench = Bench(repeat)
    task = GridWorld(bench.parameters(), bench.model.nominal, bench.model.dt)
    found: dict[str, Any] = {"cpu_s": {}, "large": n}
    for law in LAWS:
        found["cpu_s"][law] = {str(k): bench.cpu(lambda law=law, k=k: bench.python(task, law, k)) for k in (SMALL, n)}
    found["attempt_s"] = {
        name: bench.cpu(lambda most=most: bench.attempt(task, most)) for name, most in (("halving", 1.5), ("down to the gap", 20.0))
    }
    compiler = next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)
    if compiler:
        with tempfile.TemporaryDirectory() as directory:
            found["c"] = compare(bench, Kernel(compiler, Path(directory)), n)
    return found


def broken(found: dict[str, Any]) -> list[str]:
    """Promises that do not hold."""
    wrong = [
        f"{law}: {n} rollouts took {took:.3f} s of CPU, promised {PROMISED_S[int(n)]} s"
        for law, runs in found["cpu_s"].items()
        for n, took in runs.items()
        if law != "adversarial" and took > PROMISED_S.get(int(n), np.inf)
    ]
    wrong += [
        f"an attempt ({name}) took {took:.2f} s of CPU, promised {PROMISED_ATTEMPT_S} s"
        for name, took in found["attempt_s"].items()
        if took > PROMISED_ATTEMPT_S
    ]
    c = found.get("c")
    if c and c["disagree"] > found["large"] * TIPPED:
        wrong.append(f"the kernel in C disagrees in {c['disagree']} of {found['large']} scenarios without anything random")
    if c and abs(c["mean_safety"][0] - c["mean_safety"][1]) > 5.0 * c["spread"]:
        wrong.append(f"the kernel in C has another mean safety: {c['mean_safety'][1]:.4f}, not {c['mean_safety'][0]:.4f}")
    return wrong


def main() -> int:
    """Prints the figures; exit 1 if a promise is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="runs of which the least counts (default 5)")
    parser.add_argument("--quick", action="store_true", help="2000 rollouts once, for a smoke run")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    found = measure(1 if args.quick else args.repeat, 2000 if args.quick else LARGE)
    wrong = broken(found)
    if args.json:
        print(json.dumps({**found, "promised_s": PROMISED_S, "aim": AIM, "broken": wrong}))
        return 1 if wrong else 0
    for law, runs in found["cpu_s"].items():
        print(f"{law:12s} " + "   ".join(f"{n} rollouts {took:.3f} s CPU" for n, took in runs.items()))
    print("an attempt, three laws with headroom: " + ", ".join(f"{name} {took:.3f} s CPU" for name, took in found["attempt_s"].items()))
    c = found.get("c")
    if c:
        print(f"rollouts alone: Python {c['python_s']:.3f} s, C {c['c_s']:.3f} s: ratio {c['ratio']:.2f} (aim: at most {AIM:g})")
        print(f"agreement: {c['disagree']} of {found['large']} scenarios differ where nothing is random; crashes {c['crashes']}")
    else:
        print("no C compiler here (cc, gcc, clang): the ratio was left out")
    print("\n".join(wrong) if wrong else "every promise holds")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
