"""Coverage of G1 and G2 by repetition: whole experiments, run again and again, and how often their statement was wrong.

    tools/bench_coverage.py [--repetitions 1000] [--seed 1] [--json]

G1: the built-in robot's campaign (docs/guarantee.md; paper, section V) in a vectorised form: 2 x repetitions robots side by side, each with
latency of one period, clipped wheels, arcs and pose noise, drive to waypoints, stop, and hold one input for 50 periods. One half are the
experiments, each bounded by `s2r_runtime.evidence.gap`; the other half are the law: V(r) is counted on all their discrepancies together.
G2: rollouts of the uncertain model, in groups of N; V(s*) is counted on as many others.

A promise is broken if the exact 99.9 % lower limit of the observed miss rate exceeds beta. The planted faults must be caught: all
held steps used as samples (G7), and campaigns that are repeated until r looks good. Exit 1 if a promise is broken or a fault is not caught.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.evidence.bounds import clopper_pearson_lower, sample_size, scenario_confidence
from s2r_runtime.evidence.gap import discrepancy, estimate_gap, hold_residuals, residuals
from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.models.composed import ComposedModel, compose, wrap
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.recordings.transitions import Transitions

Array = NDArray[np.float64]

DT, TRACK, WHEEL_SPEED = 0.033, 0.105, 0.2
NOISE = np.array([0.0005, 0.0005, 0.002])
"""m, m, rad."""
REGION = np.array([1.6, 1.0])
"""Half of its length and width, m; the geofence is wider by the longest hold."""
MARGIN, ARRIVED, STOP, JITTER, HOLD = 0.15, 0.1, 4, 4, 50
PATIENCE, NOISE_BLOCK = 600, 100
"""Periods after which another waypoint is drawn; periods of noise drawn at a time."""
INPUTS = np.array([0.2, np.pi])
WEIGHTS = np.array([1.0, 1.0, TRACK / 2.0])
EPSILON, BETA, SURE = 0.03, 0.05, 1e-3
WIDER, G2_EPSILON = 0.05, 0.1
"""With a discard, and for rollouts: fewer samples an experiment, so that a thousand of them take a minute."""
RADIUS, HOLD_RADIUS = 0.0025, 0.005
"""Of the uncertain model that G2 rolls out: a little above what the data sheet's model gives here."""
CONTROLLER = Path(__file__).parent.parent / "controllers" / "keep_out.py"
TRACED_HOLDS = 2
"""Holds a campaign whose every step is kept, for the planted fault: 100 held steps, where N = 99."""

DATA_SHEET = compose(
    ModelSpec(
        "unicycle",
        DT,
        effects=(
            EffectSpec("input_delay", "*", {"delay": DT}),
            EffectSpec("wheel_saturation", "*", {"speed": WHEEL_SPEED, "track": TRACK}),
            EffectSpec("integration_scheme", "*", {"scheme": "exact"}),
        ),
    )
)
PAPER = compose(ModelSpec("unicycle", DT))


class Row(NamedTuple):
    """One check. `planted`: a fault that must be caught rather than a promise that must hold."""

    what: str
    n: int
    repetitions: int
    missed: int
    lower: float
    beta: float
    planted: bool

    @property
    def ok(self) -> bool:
        """Whether it came out as it must."""
        return (self.lower > self.beta) == self.planted


@dataclass
class Campaigns:
    """R campaigns of N samples. x0, x1, held: (N, R, 3); u: (N, R, 2); path: (TRACED_HOLDS, HOLD + 1, R, 3) observations.

    early, late: (N, R, 3) before and after the step `chosen` (N, R) of each hold, drawn uniformly.
    """

    x0: Array
    u: Array
    x1: Array
    held: Array
    early: Array
    late: Array
    path: Array
    chosen: NDArray[np.int64]

    def transitions(self, robot: int, n: int, *, hold: bool) -> Transitions:
        """The first n samples of one campaign."""
        held = self.held[:n, robot] if hold else None
        x0, u, x1 = self.x0[:n, robot], self.u[:n, robot], self.x1[:n, robot]
        return Transitions(x0, u, x1, held, HOLD if hold else 1, True, {}, "", np.zeros(n), "campaign")

    def pooled(self, robots: slice) -> Transitions:
        """All samples of these campaigns."""
        x0, u, x1, held = (a[:, robots].reshape(-1, a.shape[-1]) for a in (self.x0, self.u, self.x1, self.held))
        return Transitions(x0, u, x1, held, HOLD, True, {}, "", np.zeros(len(x0)), "law")


def run_campaigns(robots: int, n: int, rng: np.random.Generator) -> Campaigns:
    """Drives them all, one period an iteration, until every one has its n samples."""
    x0, inputs, x1, held, early, late = (np.zeros((n, robots, columns)) for columns in (3, 2, 3, 3, 3, 3))
    path, chosen = np.zeros((TRACED_HOLDS, HOLD + 1, robots, 3)), rng.integers(0, HOLD, (n, robots))
    out = Campaigns(x0, inputs, x1, held, early, late, path, chosen)
    x = np.column_stack([rng.uniform(-REGION, REGION, (robots, 2)), rng.uniform(-np.pi, np.pi, robots)])
    target = rng.uniform(-(REGION - MARGIN), REGION - MARGIN, (robots, 2))
    pending, held_u = np.zeros((robots, 2)), np.zeros((robots, 2))
    hold, stop = np.full(robots, -1), np.full(robots, -1)  # periods held so far, of the stop left; -1: neither
    taken, under_way = np.zeros(robots, dtype=np.int64), np.zeros(robots, dtype=np.int64)
    period = 0
    while taken.min() < n:
        if period % NOISE_BLOCK == 0:
            noise = rng.standard_normal((NOISE_BLOCK, robots, 3)) * NOISE
        seen = x + noise[period % NOISE_BLOCK]
        period += 1
        u = go_to(seen, target)
        driving = (hold < 0) & (stop < 0)
        under_way = np.where(driving, under_way + 1, 0)
        arrived = driving & (np.hypot(target[:, 0] - seen[:, 0], target[:, 1] - seen[:, 1]) <= ARRIVED)
        stop[arrived] = STOP + rng.integers(0, JITTER, np.count_nonzero(arrived))
        begins = np.flatnonzero(stop == 0)
        hold[begins] = 0
        held_u[begins] = rng.uniform(-INPUTS, INPUTS, (len(begins), 2))
        _take(out, seen, hold, held_u, np.minimum(taken, n), n)
        taken[hold == HOLD] += 1
        onward = np.flatnonzero((hold == HOLD) | (under_way > PATIENCE))
        target[onward] = rng.uniform(-(REGION - MARGIN), REGION - MARGIN, (len(onward), 2))
        under_way[onward] = 0
        hold[hold == HOLD] = -1
        u[stop > 0] = 0.0
        u[hold >= 0] = held_u[hold >= 0]
        stop[stop >= 0] -= 1
        hold[hold >= 0] += 1
        x, pending = moved(x, pending), u
    return out


def _take(out: Campaigns, seen: Array, hold: NDArray[np.int64], held_u: Array, index: NDArray[np.int64], n: int) -> None:
    """Notes what samples are made of at this period."""
    running = np.flatnonzero((hold >= 0) & (index < n))
    traced = running[index[running] < TRACED_HOLDS]
    out.path[index[traced], hold[traced], traced] = seen[traced]
    chosen = out.chosen[index[running], running]
    for due, states in ((0, out.x0), (1, out.x1), (HOLD, out.held), (chosen, out.early), (chosen + 1, out.late)):
        rows = running[hold[running] == due]
        states[index[rows], rows] = seen[rows]
    begun = running[hold[running] == 0]
    out.u[index[begun], begun] = held_u[begun]


def moved(x: Array, u: Array) -> Array:
    """(R, 3) one period later: clipped wheels, along arcs."""
    turn = 0.5 * TRACK * u[:, 1]
    right, left = np.clip(u[:, 0] + turn, -WHEEL_SPEED, WHEEL_SPEED), np.clip(u[:, 0] - turn, -WHEEL_SPEED, WHEEL_SPEED)
    half = 0.5 * DT * (right - left) / TRACK
    chord = 0.5 * DT * (right + left) * np.sinc(half / np.pi)
    heading = x[:, 2] + half
    return np.column_stack([x[:, 0] + chord * np.cos(heading), x[:, 1] + chord * np.sin(heading), wrap(heading + half)])


def go_to(x: Array, target: Array) -> Array:
    """(R, 2) the campaign's Lyapunov law (`s2r_runtime.core.goto`), for many robots."""
    away = target - x[:, :2]
    rho = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
    alpha = wrap(np.arctan2(away[:, 1], away[:, 0]) - x[:, 2])
    back = np.abs(alpha) > 0.5 * np.pi
    alpha = np.where(back, alpha - np.copysign(np.pi, alpha), alpha)
    speed = np.minimum(rho, INPUTS[0]) * np.cos(alpha)
    u = np.column_stack([np.where(back, -speed, speed), 3.0 * alpha + speed * np.sin(alpha) / rho])
    return np.asarray(u / np.maximum(1.0, np.max(np.abs(u) / INPUTS, axis=1))[:, None])


# ---------------------------------------------------------------- G1


def g1_rows(repetitions: int, rng: np.random.Generator) -> list[Row]:
    """Coverage of r, of r with a discard, of r and r_h together, and the faults."""
    plain, together, discarding = sample_size(EPSILON, BETA), sample_size(EPSILON, BETA / 2.0), sample_size(WIDER, BETA, 1)
    campaigns = run_campaigns(2 * repetitions, max(plain, together, discarding), rng)
    law = campaigns.pooled(slice(repetitions, None))

    def gap_of(model: ComposedModel, robot: int, n: int, k: int, hold: bool) -> tuple[float, float]:
        found = campaigns.transitions(robot, n, hold=hold)
        gap = estimate_gap(model, found, epsilon=WIDER if k else EPSILON, beta=BETA, discard=k, weights=WEIGHTS)
        return gap.radius, gap.hold_radius

    rows = []
    for name, model in (("data sheet model", DATA_SHEET), ("paper's model", PAPER)):
        one = np.sort(discrepancy(residuals(model, law), WEIGHTS, "ball"))
        e_hold = hold_residuals(model, law)
        assert e_hold is not None
        whole = np.sort(discrepancy(e_hold, WEIGHTS, "ball"))
        alone = np.array([gap_of(model, robot, plain, 0, False)[0] for robot in range(repetitions)])
        rows.append(row(f"G1 r, {name}", plain, violation(one, alone) > EPSILON, planted=False))
        both = np.array([gap_of(model, robot, together, 0, True) for robot in range(repetitions)])
        missed = (violation(one, both[:, 0]) > EPSILON) | (violation(whole, both[:, 1]) > EPSILON)
        rows.append(row(f"G1 r and r_h together, {name}", together, missed, planted=False))
    second = np.array([gap_of(model, robot, discarding, 1, False)[0] for robot in range(repetitions)])
    rows.append(row(f"G1 r, one discarded, epsilon {WIDER:.0%}", discarding, violation(one, second) > WIDER, planted=False))
    rows += held_step_rows(campaigns, repetitions, plain)
    best = alone[: repetitions // 5 * 5].reshape(-1, 5).min(axis=1)
    return [*rows, row("fault: best of five campaigns", plain, violation(one, best) > EPSILON, planted=True)]


def held_step_rows(campaigns: Campaigns, repetitions: int, n: int) -> list[Row]:
    """One step of each hold, drawn at random, against every step of a hold taken for a sample of its own: the same law, the same n.

    The model knows the latency and not the limits of the wheels, so that all steps of a hold lack the same.
    """
    acting = np.where(campaigns.chosen[..., None] > 0, campaigns.u, 0.0)
    one = _step_discrepancies(campaigns.early, acting, campaigns.late)
    steps = np.arange(HOLD).reshape(1, HOLD, 1, 1) > 0
    acting = np.where(steps, campaigns.u[:TRACED_HOLDS, None], 0.0)
    every = _step_discrepancies(campaigns.path[:, :-1], acting, campaigns.path[:, 1:]).reshape(TRACED_HOLDS * HOLD, -1)
    law = np.sort(one[:, repetitions:].ravel())
    return [
        row("G1 one step of each hold", n, violation(law, one[:n, :repetitions].max(axis=0)) > EPSILON, planted=False),
        row("fault: all steps of each hold", n, violation(law, every[:n, :repetitions].max(axis=0)) > EPSILON, planted=True),
    ]


def _step_discrepancies(before: Array, u: Array, after: Array) -> Array:
    """All but the last axis."""
    rows = [a.reshape(-1, a.shape[-1]) for a in (before, np.broadcast_to(u, (*before.shape[:-1], 2)), after)]
    steps = Transitions(rows[0], rows[1], rows[2], None, 1, True, {}, "", np.zeros(len(rows[0])), "steps")
    return discrepancy(residuals(PAPER, steps), WEIGHTS, "ball").reshape(before.shape[:-1])


# ---------------------------------------------------------------- G2


def g2_rows(name: str, draw: Callable[[int], Array], repetitions: int) -> list[Row]:
    """Coverage of s*, the least of N safety values. draw: n -> (n,) safety values, independent, of one law."""
    n = sample_size(G2_EPSILON, BETA)
    least = draw(repetitions * n).reshape(repetitions, n).min(axis=1)
    law = np.sort(draw(repetitions * n))
    below = np.searchsorted(law, least, side="left") / len(law)
    return [row(f"G2 s*, {name}", n, below > G2_EPSILON, planted=False)]


def rollouts(law: str, rng: np.random.Generator) -> Callable[[int], Array]:
    """Safety values of the keep-out task under its controller, on the uncertain model."""
    task = registry().get("tasks", "keep_out")({}, DATA_SHEET.nominal, DT)
    control = batch_control(load(CONTROLLER, {}))
    gap_set = GapSet("ball", tuple(WEIGHTS.tolist()), RADIUS, HOLD_RADIUS, HOLD)
    return lambda n: roll_out(control, task, DATA_SHEET, gap_set, law, rng, n).safety


# ---------------------------------------------------------------- counting


def violation(ordered: Array, radii: Array) -> Array:
    """V(r): share of the law's discrepancies (ascending) above each r."""
    return np.asarray(1.0 - np.searchsorted(ordered, radii, side="right") / len(ordered))


def row(what: str, n: int, missed: NDArray[np.bool_], *, planted: bool) -> Row:
    """Counts the misses, with the exact lower limit of their rate."""
    count, repetitions = int(np.count_nonzero(missed)), len(missed)
    return Row(what, n, repetitions, count, clopper_pearson_lower(count, repetitions, SURE), BETA, planted)


def main(arguments: list[str]) -> int:
    """Runs all and prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    began = time.process_time()
    rng = np.random.default_rng(given.seed)
    rows = g1_rows(given.repetitions, rng)
    for law in ("uniform", "persistent"):
        rows += g2_rows(f"keep_out, {law}", rollouts(law, rng), given.repetitions)
    seconds = time.process_time() - began
    ok = all(r.ok for r in rows)
    if given.json:
        told = [{**r._asdict(), "rate": r.missed / r.repetitions, "ok": r.ok} for r in rows]
        print(json.dumps({"ok": ok, "epsilon": EPSILON, "epsilon_g2": G2_EPSILON, "beta": BETA, "cpu_s": seconds, "rows": told}))
        return 0 if ok else 1
    n = sample_size(EPSILON, BETA)
    exact = scenario_confidence(n, 0, EPSILON)
    print(f"epsilon {EPSILON:.0%} (G2: {G2_EPSILON:.0%}), beta {BETA:.0%}; N = {n} misses {exact:.2%} of the time on a continuous law")
    print(f"{'':44s} {'N':>5s} {'runs':>6s} {'missed':>8s} {'99.9 % lower':>13s}")
    for r in rows:
        verdict = ("caught" if r.ok else "NOT CAUGHT") if r.planted else ("holds" if r.ok else "BROKEN")
        print(f"{r.what:44s} {r.n:5d} {r.repetitions:6d} {r.missed / r.repetitions:8.2%} {r.lower:13.2%}  {verdict}")
    print(f"{seconds:.1f} s of CPU")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
