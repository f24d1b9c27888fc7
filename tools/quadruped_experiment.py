"""The paper's quadruped experiment as one command: gap, uncertain model, controllers, verification, runs on the robot, its figures.

    tools/quadruped_experiment.py [-o FILE.html] [--json FILE] [--seed 1] [--quick] [--readings N] [--effect TEXT]...

(make quadruped-experiment.)

The true system walks: a body of 37 states under a controller of its own at 1 kHz, in rigid-body physics (plugins/standins, extra `sim`).
The numbers of samples and scenarios are the paper's: 100 observations, 300 and 500 of 20 000 scenarios, 10 runs. What the paper's reading
can say of such a robot, and what says more of it, is in the table of readings (`quadruped_gaps`); every uncertain model is one of them.
It reproduces the experiment: no certificate comes of it (docs/guarantee.md, G4). --effect: something undeclared in the robot.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import quadruped_figures as figures
from numpy.typing import NDArray
from paper_experiment import LARGE, ROOT, SCENARIOS, Setting, Tries, claim_lines, claims, control_of, named, plain, verified
from paper_figures import PREDICTED, Again
from quadruped_gaps import BODY, READINGS, STRIDE_S, Reading, curve, of_more, row
from quadruped_truth import Holds, Run, Walker, placed, run, stops, walked

from s2r_runtime.errors import S2RError
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.uncertain import roll_out
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec
from s2r_runtime.plugins import registry
from s2r_runtime.profile import load_profile
from s2r_runtime.recordings.loading import from_samples
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.trace.data.dataset import Stream, from_streams
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.reporting.found import Found

Array = NDArray[np.float64]
PROFILE = load_profile(ROOT / "profiles" / "quadruped.toml")
EPSILON = 0.03
HOLD_S = 1.0
STEPS = np.round(np.arange(0.1, 1.001, 0.05), 2)
CONTROLLERS: Tries = (
    ("quadruped_grid_reckless.py", {}),
    ("quadruped_grid.py", {"margin": 0.0}),
    ("quadruped_grid.py", {"turn": 0.2}),
    ("quadruped_grid.py", {"aligned": 0.0}),
    ("quadruped_grid.py", {"lookahead": 2.0}),
    ("quadruped_grid.py", {"speed": 0.15, "margin": 0.05}),
    ("quadruped_grid.py", {"lookahead": 0.2}),
    ("quadruped_grid.py", {"hold": 0.8}),
    ("quadruped_grid.py", {}),
    ("quadruped_grid.py", {"lookahead": 0.35, "turn": 3.5, "aligned": 0.75}),
    ("quadruped_grid.py", {"margin": 0.2, "speed": 0.1, "fade": 0.15}),
    ("quadruped_grid.py", {"margin": 0.2, "speed": 0.1, "fade": 0.15, "lookahead": 0.35, "turn": 3.5}),
)
"""In the order in which somebody would try them: faults first, then the controller that ships, then more careful ones."""


class Size(NamedTuple):
    """How much of everything: the paper's numbers, or a smoke run's."""

    samples: int = 100
    starts: int = 60
    fresh: int = 400
    large: int = LARGE
    counts: tuple[int, ...] = SCENARIOS
    every: int = 1
    runs: int = 10
    horizon: int = 600
    rows: int = 40_000
    laws: tuple[str, ...] = ("uniform", "persistent")


QUICK = Size(12, 4, 30, 200, (60, 100), 8, 2, 100, 400, ("uniform",))


def task_for(model: ComposedModel, size: Size) -> GridWorld:
    """The profile's grid at this model's step: as many seconds, whatever its steps."""
    return GridWorld(_grid(model.dt, size), model.nominal, model.dt)


def _grid(dt: float, size: Size) -> dict[str, Any]:
    return {**PROFILE.task.parameters, "steps": round(size.horizon * PROFILE.model.dt / dt)}


# ---------------------------------------------------------------- what the model lacks


def traced(holds: Holds, model: ComposedModel, rows: int) -> dict[str, Any]:
    """What the tracer says of the campaign's drive (so many of its rows), and the effects that a model for tomorrow could take from it."""
    assert holds.drive is not None
    t, x, u = (column[:rows] for column in holds.drive)
    data = replace(from_streams(model, [(Stream(t, x), Stream(t, u))], "the campaign"), campaign=from_samples(holds.samples))
    try:
        found = trace(data, model, weights=BODY)
    except S2RError as error:
        return {"verdict": "none", "text": str(error), "effects": []}
    kept = found.effects or found.partial
    lasting = [e for e in kept if _lasting(model, e)]
    return {"verdict": found.verdict, "text": found.text(), "told": found.to_json(), "effects": [_spec(e) for e in lasting]}


def _lasting(model: ComposedModel, found: Found) -> bool:
    """Whether it foretells another recording: effects that count their time from this one's start don't."""
    effect = registry().get("effects", found.name)
    return not getattr(effect, "timed", False)


def _spec(found: Found) -> EffectSpec:
    return EffectSpec(found.name, found.channel, found.values)


def _said(effect: EffectSpec) -> str:
    numbers = (f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in effect.parameters.items())
    return f"{effect.name} on {effect.channel} ({', '.join(numbers)})"


# ---------------------------------------------------------------- uncertain models


class Candidate(NamedTuple):
    """An uncertain model, and how it came about."""

    setting: Setting
    reading: Reading


def candidates(campaign: Holds, fresh: Holds, lacking: tuple[EffectSpec, ...], size: Size) -> list[Candidate]:
    """The paper's literal one; in a norm that means something; with longer steps; with what the tracer found, on samples it never saw."""
    chosen = [(Reading(0.1, norm="literal"), campaign), (Reading(0.1), campaign), (Reading(0.5), campaign), (Reading(1.0), campaign)]
    if lacking:
        chosen.append((Reading(0.1, "standing", "weighted", "ball", lacking, "with what was traced"), fresh[: size.samples]))
    return [Candidate(Setting(reading.words, reading.model, reading.gap_set(holds)), reading) for reading, holds in chosen]


def drives(robot: Walker, number: int, model: ComposedModel, size: Size, seed: int) -> list[Run]:
    """Runs of a controller on the robot, in fresh scenarios."""
    task = task_for(model, size)
    control = control_of(*CONTROLLERS[number])
    rng = np.random.default_rng([seed, 99])
    drawn = task.draw(rng, size.runs)
    scenarios = [{name: value[k : k + 1] for name, value in drawn.items()} for k in range(size.runs)]
    return [run(robot, control, task, scenario, PROFILE, model.dt, seed + k) for k, scenario in enumerate(scenarios)]


def inside(runs: Sequence[Run], setting: Setting) -> dict[str, Any]:
    """Of all steps driven, how many stayed in the one-step reachable set f(x, u) + D; the largest discrepancy of each run."""
    model, largest, within, total = setting.model, [], 0, 0
    for one in runs:
        d = setting.gap.norm(step_errors(one, model)[0])
        largest.append(float(d.max()))
        within, total = within + int(np.sum(d <= setting.gap.radius)), total + len(d)
    return {
        "steps": total,
        "inside": within / total,
        "largest": largest,
        "runs_inside": int(np.sum(np.array(largest) <= setting.gap.radius)),
    }


def step_errors(one: Run, model: ComposedModel) -> tuple[Array, Array]:
    """((k, 3) measured less foretold, (k, 3) foretold) of each step of a run, the model's memory carried along."""
    hidden, foretold = model.at_rest(1), []
    for x, u in zip(one.path[:-1], one.u, strict=True):
        ahead, hidden = model.step(x[None], u[None], hidden)
        foretold.append(ahead[0])
    predicted = np.array(foretold)
    return model.difference(one.path[1:].copy(), predicted), predicted


def judged(candidate: Candidate, law: str, size: Size, seed: int, ran: Callable[[int, ComposedModel], list[Run]]) -> dict[str, Any]:
    """Controllers against one uncertain model under one law, and the first that passes: in 20 000 rollouts, and on the robot."""
    setting = candidate.setting
    task = task_for(setting.model, size)
    rows = verified(setting, law, CONTROLLERS, task, seed, counts=size.counts, every=size.every)
    one: dict[str, Any] = {
        "name": setting.name,
        "law": law,
        "r": setting.gap.radius,
        "r_h": setting.gap.hold_radius,
        "h": setting.gap.hold_periods,
        "share": setting.gap.radius / candidate.reading.still,
        "controllers": rows,
    }
    passing = [found["number"] for found in rows if found["passed"]]
    if not passing:
        return one
    best = passing[0]
    control = control_of(*CONTROLLERS[best])
    one |= {"winner": named(*CONTROLLERS[best]), "winner_number": best}
    one["final"] = claims(setting, law, control, task, size.large, lambda kind, n: np.random.default_rng([seed, 7 + kind, best, n]))
    runs = ran(best, setting.model)
    bad = sum(r.safety < 0.0 for r in runs)
    one["true_runs"] = {
        "n": len(runs),
        "crashes": bad,
        "falls": sum(bool(r.fallen) for r in runs),
        "made_progress": sum(r.progress > 0.0 for r in runs),
        "arrived": sum(_arrived(task, r) for r in runs),
        "safety": [r.safety for r in runs],
        "crash_upper": float(clopper_pearson_upper(bad, len(runs), 0.05)),
        "steps": inside(runs, setting),
        "rollouts": runs,
    }
    one["reach"] = _reach(candidate, law, runs[0], size, seed, best)
    return one


def _arrived(task: GridWorld, one: Run) -> bool:
    tally = task.observe(task.begin(one.scenario), one.path[-1:], one.scenario)
    return bool(tally.arrived[0]) and one.safety >= 0.0


def _reach(candidate: Candidate, law: str, one: Run, size: Size, seed: int, number: int) -> dict[str, Any]:
    """The run's own scenario, as the uncertain model foretells it; and its one-step reachable sets."""
    setting = candidate.setting
    again = Again(_grid(setting.model.dt, size), setting.model.nominal, setting.model.dt, scenario=one.scenario)
    control, rng = control_of(*CONTROLLERS[number]), np.random.default_rng([seed, 6])
    predicted = roll_out(control, again, setting.model, setting.gap, law, rng, PREDICTED, keep=PREDICTED)
    errors, foretold = step_errors(one, setting.model)
    return {"predicted": predicted.paths, "run": one, "foretold": foretold, "errors": errors, "gap": setting.gap, "dt": setting.model.dt}


# ---------------------------------------------------------------- all of it


def experiment(robot: Walker, seed: int, size: Size, told: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """All of it, on this robot."""
    told(f"{size.samples} observations: to a random waypoint, stop, hold a random input")
    robot.reset(seed, (0.0, 0.0, 0.0))
    campaign = walked(robot, PROFILE, size.samples, seed)
    walked_s = robot.now_s
    told("fresh holds, from start states that are set directly")
    fresh = placed(robot, stops(robot, size.starts, seed + 1, PROFILE), size.fresh, seed + 2, PROFILE, HOLD_S)
    told("what does the model lack?")
    lacking = traced(campaign, compose(PROFILE.model), size.rows)
    effects = tuple(lacking["effects"])
    told(lacking["text"])
    found: dict[str, Any] = {
        "seed": seed,
        "walked_s": walked_s,
        "gaps": [row(reading, campaign, EPSILON) for reading in READINGS if reading.fits(campaign)],
        "traced": {
            "verdict": lacking["verdict"],
            "text": lacking["text"],
            "told": lacking.get("told"),
            "effects": [_said(e) for e in effects],
        },
        "more": {r.words: of_more(r, fresh, MORE) for r in (Reading(0.1), Reading(1.0))},
        "models": [],
    }
    if effects:
        known = [Reading(dt, "standing", "weighted", "ball", effects, "with what was traced") for dt in (0.1, STRIDE_S, 0.5, 1.0)]
        found["repaired"] = [row(reading, fresh[: size.samples], EPSILON) for reading in known if reading.fits(fresh)]
    found["drawn"] = {
        "standing start": curve(campaign, STEPS, "standing"),
        "in stride": curve(campaign, STEPS, "in stride"),
        **({"standing start, with what was traced": curve(fresh, STEPS, "standing", effects=effects)} if effects else {}),
    }
    told("\n".join(_gap_lines(found)))
    driven: dict[tuple[int, float], list[Run]] = {}

    def ran(number: int, model: ComposedModel) -> list[Run]:
        if (number, model.dt) not in driven:
            told(f"{size.runs} runs of {named(*CONTROLLERS[number])} on the robot, {model.dt:g} s a step")
            driven[number, model.dt] = drives(robot, number, model, size, seed)
        return driven[number, model.dt]

    for candidate in candidates(campaign, fresh, effects, size):
        for law in size.laws:
            told(f"verification: {candidate.setting.name}, {law}")
            found["models"].append(judged(candidate, law, size, seed, ran))
            told("\n".join(_model_lines(found["models"][-1])))
    return found


def readings(robot: Walker, seed: int, n: int) -> list[str]:
    """The gap reading by reading, on n holds that nobody walked to."""
    holds = placed(robot, stops(robot, max(2, n // 3), seed + 1, PROFILE), n, seed + 2, PROFILE, HOLD_S)
    return [GAP_HEAD, *(_gap_line(row(reading, holds, EPSILON)) for reading in READINGS)]


MORE = ((100, 0, 0.03), (299, 0, 0.01), (299, 3, 0.03))
"""N samples, k discarded, epsilon: each at 95 %."""


def lines_of(found: dict[str, Any]) -> list[str]:
    """What came out, in lines."""
    return [*_gap_lines(found), *(line for one in found["models"] for line in _model_lines(one))]


def _gap_lines(found: dict[str, Any]) -> list[str]:
    lines = [f"the robot walked {found['walked_s'] / 60.0:.0f} minutes for its {found['gaps'][0]['n']} samples"]
    lines += [GAP_HEAD, *(_gap_line(g) for g in [*found["gaps"], *found.get("repaired", [])])]
    lines.append("more samples: N, k discarded, epsilon, confidence: r, its share; how many of the others exceed it")
    for name, rows in found["more"].items():
        for m in rows:
            beyond = "" if m["beyond"] is None else f"; {m['beyond']:.1%} of the others exceed it"
            lines.append(
                f"  {m['n']} {m['discarded']} {m['epsilon']:.1%} {m['confidence']:.1%}: {m['r']:.4f}, {m['share']:.0%}{beyond}   {name}"
            )
    lines.append(f"traced: {found['traced']['verdict']}; in the repaired model: {', '.join(found['traced']['effects']) or 'nothing'}")
    return lines


GAP_HEAD = "gap: r, median; in parts (position m, heading rad); what standing still would score, r as a share of that"


def _gap_line(g: dict[str, Any]) -> str:
    parts = f"{g['position']:.4f} {g['heading']:.4f}"
    return f"  {g['r']:.4f}  {g['median']:.4f}  ({parts})  {g['still']:.4f}  {g['share']:5.0%}   {g['reading']}"


def _model_lines(one: dict[str, Any]) -> list[str]:
    passed = sum(c["passed"] for c in one["controllers"])
    gap = f"r {one['r']:.4g} ({one['share']:.0%} of standing still), r_h {one['r_h']:.4g} after {one['h']}"
    lines = [f"{one['name']}, {one['law']}: {gap}; {passed} of {len(one['controllers'])} controllers pass"]
    if not passed:
        return lines
    runs = one["true_runs"]
    steps = runs["steps"]
    crashed = f"{runs['crashes']} of {runs['n']} runs crash (at most {runs['crash_upper']:.1%}, 95 %), {runs['falls']} fall"
    return [
        *lines,
        f"  winner: {one['winner']}",
        *claim_lines(one["final"]),
        f"  on the robot: {crashed}, {runs['made_progress']} make progress, {runs['arrived']} arrive",
        f"  {steps['inside']:.1%} of {steps['steps']} steps stay in their reachable set, all of them in {steps['runs_inside']} runs",
    ]


def quadruped(effects: Sequence[str]) -> Walker:
    """The built-in robot. Raises ConfigError where its physics are missing, or for an unknown effect."""
    from s2r_standins.quadruped_body import Quadruped
    from s2r_standins.quadruped_sheet import QuadrupedSheet

    robot = Quadruped(QuadrupedSheet(), start=(0.0, 0.0, 0.0), seed=1)
    for effect in effects:
        robot.switch_on(effect)
    return cast("Walker", robot)


def main(arguments: list[str], make: Callable[[Sequence[str]], Walker] = quadruped) -> int:
    """Exit 0: a statement with confidence 95 % may fail in one run; how often it does is what bench_quadruped_coverage.py looks at."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="the figures on one page (needs matplotlib)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all numbers")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effect", action="append", default=[], metavar="TEXT", help="undeclared in the robot; may be repeated")
    parser.add_argument("--quick", action="store_true", help="a smoke run: a hundredth of the rollouts, a tenth of the samples")
    parser.add_argument(
        "--readings",
        type=int,
        default=0,
        metavar="N",
        help="only the gap, reading by reading, on N holds whose start states are set directly",
    )
    given = parser.parse_args(arguments)
    start = time.process_time()
    try:
        if given.readings:
            print("\n".join(readings(make(given.effect), given.seed, given.readings)))
            return 0
        found = experiment(
            make(given.effect), given.seed, QUICK if given.quick else Size(), lambda text: print(f"# {text}", file=sys.stderr)
        )
    except S2RError as error:
        print(f"quadruped_experiment: {error}", file=sys.stderr)
        return error.exit_code
    lines = lines_of(found)
    print("\n".join(lines))
    print(f"{time.process_time() - start:.0f} s of CPU")
    if given.json:
        given.json.write_text(json.dumps(plain(found), indent=1))
    if given.output:
        given.output.write_text(figures.page(found, lines), encoding="utf-8")
        print(f"figures: {given.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
