"""The paper's Robotarium experiment as one command: gap, uncertain model, controllers, verification, runs on the true system, its figures.

    tools/robotarium_experiment.py [-o FILE.html] [--json FILE] [--seed 1] [--quick] [--reading WORDS]...   (make robotarium-experiment)

What the paper leaves open is a setting, and every reading is reported: the norm (literal, mixing metres and radians, or a radian counted
as half the wheel base), whether headings are wrapped, which of the 50 held periods is the sample, what still acts when it begins, whether
the wheels saturate, 300 or 500 scenarios, which disturbance law. --reading random,clipped,literal,wrapped,first adds one of your own, and
verifies the controllers against the ball that it gives. The numbers of samples and scenarios are the paper's (600 of 2400,
300 and 500 of 20 000, 40 runs). It reproduces the experiment: no certificate comes of it, because a method that tries controllers until
one passes has to pay for every try (docs/guarantee.md, G4). The true system is the built-in robot's data sheet (`robotarium_truth`).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import robotarium_figures as figures
from numpy.typing import NDArray
from paper_experiment import LARGE, SCENARIOS, Setting, claim_lines, claims, control_of, named, plain, verified
from robotarium_truth import HOLD, NOISE, TRACK, Before, Samples, campaign

from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.uncertain import Control, GapSet, Rollouts, roll_out
from s2r_runtime.models.composed import compose, wrap
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.tasks.grid_world import GridWorld

Array = NDArray[np.float64]

DT, EPSILON, PAPER_R = 0.033, 0.005, 0.198
SAMPLES, FIRST, RUNS = 2400, 600, 40
LITERAL, HALF_TRACK = (1.0, 1.0, 1.0), (1.0, 1.0, TRACK / 2.0)
DATA_SHEET = (
    EffectSpec("input_delay", "*", {"delay": DT}),
    EffectSpec("wheel_saturation", "*", {"speed": 0.2, "track": TRACK}),
    EffectSpec("integration_scheme", "*", {"scheme": "exact"}),
)
PAPER_MODEL, TRUTH = compose(ModelSpec("unicycle", DT)), compose(ModelSpec("unicycle", DT, effects=DATA_SHEET))
CONTROLLERS: tuple[tuple[str, dict[str, float]], ...] = (
    ("grid_reckless.py", {}),
    ("grid.py", {"speed": 0.2, "margin": 0.0, "wall": 0.0, "keep": 0.05}),
    ("grid.py", {"speed": 0.2, "margin": 0.005, "keep": 0.1}),
    ("grid.py", {"turn": 1.0}),
    ("grid.py", {"keep": 0.0, "foresight": 0.0}),
    ("grid.py", {"keep": 0.15}),
    ("grid.py", {"margin": 0.0}),
    ("grid.py", {"aligned": 0.2, "lookahead": 0.15}),
    ("grid.py", {"speed": 0.05}),
    ("grid.py", {"lookahead": 0.2}),
    ("grid.py", {"margin": 0.025, "speed": 0.12}),
    ("grid.py", {}),
    ("grid.py", {"margin": 0.03, "speed": 0.1, "keep": 0.35}),
    ("grid.py", {"margin": 0.045, "speed": 0.1, "keep": 0.35, "wall": 0.09}),
    ("grid.py", {"margin": 0.06, "speed": 0.08, "keep": 0.4, "wall": 0.1}),
)
"""In the order in which somebody would try them: faults first, then the controller that ships, then more careful ones."""


Period = Literal["first", "last", "all", "random"]


class Reading(NamedTuple):
    """One way to read the paper. period: which held one is the sample; `all`: each of them is one, 48 holds of 50."""

    before: Before
    saturated: bool
    norm: str
    wrapped: bool
    period: Period

    @property
    def words(self) -> str:
        """For tables."""
        which = {"all": "all 50 periods", "random": "a random period"}.get(self.period, f"{self.period} period")
        wheels, wrapped = "clipped" if self.saturated else "free", "wrapped" if self.wrapped else "not wrapped"
        return f"{self.before}, wheels {wheels}, {self.norm} norm, {wrapped}, {which}"


READINGS = (
    Reading("random", False, "literal", True, "first"),
    Reading("random", True, "literal", True, "first"),
    Reading("arriving", True, "literal", True, "first"),
    Reading("stopped", False, "literal", True, "first"),
    Reading("stopped", True, "literal", True, "first"),
    Reading("random", True, "literal", False, "first"),
    Reading("random", True, "literal", True, "last"),
    Reading("random", True, "literal", True, "all"),
    Reading("random", True, "weighted", True, "first"),
    Reading("arriving", True, "weighted", True, "first"),
    Reading("stopped", True, "weighted", True, "first"),
    Reading("stopped", True, "weighted", True, "random"),
)


WORDS = (
    ("random", "stopped", "arriving"),
    ("clipped", "free"),
    ("literal", "weighted"),
    ("wrapped", "unwrapped"),
    ("first", "last", "all", "random"),
)


def reading_of(text: str) -> Reading:
    """argparse type: one word of each kind, in their order."""
    words = text.split(",")
    if len(words) != len(WORDS) or any(word not in known for word, known in zip(words, WORDS, strict=True)):
        raise argparse.ArgumentTypeError(f"{text!r} must be one of each, in this order: " + "; ".join("|".join(known) for known in WORDS))
    return Reading(cast("Before", words[0]), words[1] == "clipped", words[2], words[3] == "wrapped", cast("Period", words[4]))


def discrepancies(errors: Array, norm: str, *, wrapped: bool) -> Array:
    """(n,) from errors (n, 3). Not wrapped: headings as they are read in [0, 2 pi], so that one that passes 0 is wrong by 6.28."""
    e = errors.copy()
    e[:, 2] = wrap(e[:, 2]) if wrapped else e[:, 2]
    return np.asarray(np.sqrt(np.sum((e * np.array(LITERAL if norm == "literal" else HALF_TRACK)) ** 2, axis=1)))


def sampled(reading: Reading, n: int, rng: np.random.Generator) -> Array:
    """n discrepancies under this reading."""
    holds = campaign(
        -(-n // HOLD) if reading.period == "all" else n,
        reading.before,
        rng,
        saturated=reading.saturated,
        periods=1 if reading.period == "first" else HOLD,
    )
    if reading.period in ("first", "last"):
        errors = holds.errors(0 if reading.period == "first" else HOLD - 1)
    else:
        each = np.stack([holds.errors(period) for period in range(HOLD)], axis=1)
        errors = each.reshape(-1, 3)[:n] if reading.period == "all" else each[np.arange(n), rng.integers(HOLD, size=n)]
    return discrepancies(errors, reading.norm, wrapped=reading.wrapped)


def gap_row(reading: Reading, repetitions: int, rng: np.random.Generator) -> dict[str, Any]:
    """r of the first 600 against the 99.5 % cutoff of all 2400; the same in repeated experiments: r (median, 5 %, 95 %), and how often it
    reaches the cutoff.
    """
    d = sampled(reading, SAMPLES, rng)
    r, cutoff = _first_and_cutoff(d)
    again = np.array([_first_and_cutoff(sampled(reading, SAMPLES, rng)) for _ in range(repetitions)] or [(r, cutoff)])
    spread = [float(q) for q in np.quantile(again[:, 0], (0.5, 0.05, 0.95))]
    reached = float(np.mean(again[:, 0] >= again[:, 1]))
    return {
        "reading": reading.words,
        "r": r,
        "cutoff": cutoff,
        "holds": r >= cutoff,
        "r_repeated": spread,
        "reached": reached,
        "discrepancies": d,
    }


def _first_and_cutoff(d: Array) -> tuple[float, float]:
    return float(d[:FIRST].max()), float(np.quantile(d, 1.0 - EPSILON))


def settings(rng: np.random.Generator, asked: Sequence[Reading]) -> list[Setting]:
    """The paper's literal one; the paper's model in a norm that means something; the model that knows the data sheet; those asked for."""
    taken = campaign(FIRST, "stopped", rng)
    known = _data_sheet_errors(taken)
    held = taken.held_errors()
    return [
        Setting("paper's model, literal r", PAPER_MODEL, GapSet("ball", LITERAL, PAPER_R, PAPER_R, HOLD)),
        Setting("paper's model, weighted", PAPER_MODEL, _gap_set(taken.errors(), held)),
        Setting("data sheet's model, weighted", TRUTH, _gap_set(*known)),
        *(Setting(f"paper's model, {reading.words}", PAPER_MODEL, _gap_set_of(reading, rng)) for reading in asked),
    ]


def _gap_set_of(reading: Reading, rng: np.random.Generator) -> GapSet:
    """The ball of a reading; its hold gap is that of the same holds, in the same norm."""
    weights = LITERAL if reading.norm == "literal" else HALF_TRACK
    held = campaign(FIRST, reading.before, rng, saturated=reading.saturated).held_errors()
    r, r_h = float(sampled(reading, FIRST, rng).max()), float(discrepancies(held, reading.norm, wrapped=True).max())
    return GapSet("ball", weights, r, r_h, HOLD)


def _gap_set(errors: Array, held: Array) -> GapSet:
    r, r_h = (float(discrepancies(e, "weighted", wrapped=True).max()) for e in (errors, held))
    return GapSet("ball", HALF_TRACK, r, r_h, HOLD)


def _data_sheet_errors(taken: Samples) -> tuple[Array, Array]:
    """(N, 3) each, over one period and over the hold, against the model that knows the latency, the wheels and the arcs."""
    x, hidden = taken.path[0], TRUTH.at_rest(len(taken.u))
    one = x
    for period in range(HOLD):
        x, hidden = TRUTH.step(x, taken.u, hidden)
        one = x if period == 0 else one
    return taken.path[1] - one, taken.path[-1] - x


def seen(control: Control, rng: np.random.Generator) -> Control:
    """The controller sees measured poses."""
    return lambda x, theta: control(x + NOISE * rng.standard_normal(x.shape), theta)


def on_the_truth(number: int, runs: int, seed: int, keep: int) -> Rollouts:
    """Runs of a controller on the true system, in fresh scenarios."""
    nothing, rng = GapSet("ball", LITERAL, 0.0), np.random.default_rng([seed, 99])
    control = seen(control_of(*CONTROLLERS[number]), rng)
    return roll_out(control, GridWorld({}, TRUTH.nominal, DT), TRUTH, nothing, "uniform", rng, runs, keep=keep)


def _draws(seed: int, number: int) -> Callable[[int, int], np.random.Generator]:
    """Random numbers of the winner's 20 000 rollouts, and of the fresh ones."""
    return lambda kind, n: np.random.default_rng([seed, 8, number, n] if kind else [seed, 7, number])


def experiment(seed: int, *, quick: bool, asked: Sequence[Reading] = ()) -> dict[str, Any]:
    """All of it. quick: a hundredth of the rollouts, and every fifth controller. asked: further readings."""
    rng = np.random.default_rng(seed)
    repetitions, large, counts, every = (0, 200, (60, 100), 5) if quick else (300, LARGE, SCENARIOS, 1)
    found: dict[str, Any] = {"gaps": [gap_row(reading, repetitions, rng) for reading in (*READINGS, *asked)], "models": []}
    literal, *usable = settings(rng, asked)
    reckless = roll_out(control_of("grid.py", {}), GridWorld({}, PAPER_MODEL.nominal, DT), PAPER_MODEL, literal.gap, "uniform", rng, large)
    found["literal"] = {"r": PAPER_R, "n": large, "crashed": float(np.mean(reckless.safety < 0.0))}
    for setting in usable:
        for law in ("uniform", "persistent"):
            task = GridWorld({}, setting.model.nominal, DT)
            rows = verified(setting, law, CONTROLLERS, task, seed, counts=counts, every=every)
            passing = [row["number"] for row in rows if row["passed"]]
            one: dict[str, Any] = {
                "name": setting.name,
                "law": law,
                "r": setting.gap.radius,
                "r_h": setting.gap.hold_radius,
                "controllers": rows,
            }
            if passing:
                best = passing[0]
                truth = on_the_truth(best, RUNS, seed, 4)
                bad = int(np.sum(truth.safety < 0.0))
                arrived = int(np.sum(truth.progress > 0.0))
                upper = float(clopper_pearson_upper(bad, RUNS, 0.05))
                control = control_of(*CONTROLLERS[best])
                draws = _draws(seed, best)
                one |= {"winner": named(*CONTROLLERS[best]), "winner_number": best}
                one["final"] = claims(setting, law, control, task, large, draws)
                one |= {"true_runs": {"n": RUNS, "crashes": bad, "made_progress": arrived, "crash_upper": upper, "rollouts": truth}}
                one["reach"] = figures.reach(setting, law, control, seed)
            found["models"].append(one)
    return found


def told(found: dict[str, Any]) -> list[str]:
    """What came out, in lines."""
    lines = ["gap: r of the first 600, 99.5 % cutoff of all 2400; repeated: median of r [5 %, 95 %], share that reaches the cutoff"]
    for row in found["gaps"]:
        median, low, high = row["r_repeated"]
        repeated = f"{median:.4f} [{low:.4f}, {high:.4f}] {row['reached']:4.0%}"
        lines.append(f"  {row['r']:.4f}  {row['cutoff']:.4f}  {'holds' if row['holds'] else 'FAILS'}   {repeated}   {row['reading']}")
    lines.append(f"the paper's .198 in the literal norm: {found['literal']['crashed']:.2%} of {found['literal']['n']} rollouts crash")
    for one in found["models"]:
        passed = sum(row["passed"] for row in one["controllers"])
        lines.append(
            f"{one['name']}, {one['law']}: r {one['r']:.4g}, r_h {one['r_h']:.4g}; {passed} of {len(one['controllers'])} controllers pass"
        )
        if passed:
            lines.append(f"  winner: {one['winner']}")
            lines += claim_lines(one["final"])
            runs = one["true_runs"]
            crashed = f"{runs['crashes']} of {runs['n']} runs crash (at most {runs['crash_upper']:.1%}, 95 %)"
            lines.append(f"  true system: {crashed}, {runs['made_progress']} make progress")
    return lines


def main(arguments: list[str]) -> int:
    """Exit 0: a statement with confidence 95 % may fail in one run; that it fails no more often is what bench_coverage.py looks at."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="the figures on one page (needs matplotlib)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all numbers")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--reading", type=reading_of, action="append", default=[], metavar="WORDS", help="one more; may be repeated")
    parser.add_argument("--quick", action="store_true", help="a hundredth of the rollouts, for a smoke run")
    given = parser.parse_args(arguments)
    start = time.process_time()
    found = experiment(given.seed, quick=given.quick, asked=given.reading)
    seconds = time.process_time() - start
    print("\n".join(told(found)))
    print(f"{seconds:.0f} s of CPU")
    if given.json:
        given.json.write_text(json.dumps(plain(found), indent=1))
    if given.output:
        given.output.write_text(figures.page(found, plain(found), told(found)), encoding="utf-8")
        print(f"figures: {given.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
