"""What the paper's two experiments have in common (section V): controllers against an uncertain model, and what their safety values show.

    s* of 300 and of 500 scenarios, against the cutoff of 20 000:   P[s < s*] <= 1 %, .6 %  with confidence 95 %   (corollary 2)

It reproduces: nothing is paid for trying one controller after the other, and no certificate comes of it (docs/guarantee.md, G4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.evidence.bounds import scenario_confidence
from s2r_runtime.evidence.uncertain import Control, GapSet, roll_out
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.tasks.grid_world import GridWorld

ROOT = Path(__file__).parent.parent
SCENARIOS, LARGE = (300, 500), 20_000
CLAIMED = {300: 0.01, 500: 0.006}
"""The epsilon that so many scenarios pay at 95 %."""
QUIETLY = frozenset({"discrepancies", "safety", "rollouts", "reach", "drawn"})
"""Keys whose values are for figures: arrays and rollouts."""

Tries = Sequence[tuple[str, dict[str, float]]]


class Setting(NamedTuple):
    """An uncertain model: the model, and the gap set that a reading gives."""

    name: str
    model: ComposedModel
    gap: GapSet


def control_of(name: str, parameters: dict[str, float]) -> Control:
    """A controller of the project's, with parameters."""
    return batch_control(load(ROOT / "controllers" / name, parameters), 2)


def named(name: str, parameters: dict[str, float]) -> str:
    """For tables."""
    return name.removesuffix(".py") + "".join(f" {key}={value:g}" for key, value in parameters.items())


def verified(
    setting: Setting, law: str, tries: Tries, task: GridWorld, seed: int, *, counts: tuple[int, ...] = SCENARIOS, every: int = 1
) -> list[dict[str, Any]]:
    """Controllers against one uncertain model: s* of the first 300 and of 500 scenarios, and whether it passes (paper, corollary 2)."""
    rows = []
    for number, (name, parameters) in list(enumerate(tries))[::every]:
        rng = np.random.default_rng([seed, number])
        rollouts = roll_out(control_of(name, parameters), task, setting.model, setting.gap, law, rng, max(counts))
        stars = {str(n): float(rollouts.safety[:n].min()) for n in counts}
        rows.append(
            {
                "controller": named(name, parameters),
                "number": number,
                "s_star": stars,
                "crashes": int(np.sum(rollouts.safety < 0.0)),
                "progress": float(np.median(rollouts.progress)),
                "passed": min(stars.values()) >= 0.0 and task.progress_ok(rollouts.progress),
            }
        )
    return rows


def claims(
    setting: Setting, law: str, control: Control, task: GridWorld, large: int, draws: Callable[[int, int], np.random.Generator]
) -> dict[str, Any]:
    """s* of 300 and 500 fresh scenarios against the cutoffs that `large` others show, and how often that holds in these.

    draws(0, 0): random numbers of the large run; draws(1, n): of n fresh scenarios.
    """
    safety = roll_out(control, task, setting.model, setting.gap, law, draws(0, 0), large).safety
    told: dict[str, Any] = {"safety": safety, "crashes": int(np.sum(safety < 0.0)), "n": large, "claims": []}
    for n, epsilon in CLAIMED.items():
        fresh = roll_out(control, task, setting.model, setting.gap, law, draws(1, n), n).safety
        cutoff = float(np.quantile(safety, epsilon, method="lower"))
        below = float(np.mean(safety < fresh.min()))
        groups = safety[: large // n * n].reshape(-1, n).min(axis=1) if large >= n else np.empty(0)
        kept = float(np.mean([np.mean(safety < least) <= epsilon for least in groups])) if len(groups) else None
        claim = {"n": n, "epsilon": epsilon, "s_star": float(fresh.min()), "cutoff": cutoff, "below": below, "holds": below <= epsilon}
        told["claims"].append(
            {**claim, "groups": len(groups), "groups_hold": kept, "confidence": 1.0 - float(scenario_confidence(n, 0, epsilon))}
        )
    return told


def claim_lines(final: dict[str, Any]) -> list[str]:
    """What `claims` found, in lines."""
    lines = []
    for claim in final["claims"]:
        verdict = "holds" if claim["holds"] else "FAILS"
        star = f"s* of {claim['n']}: {claim['s_star']:.2f}"
        cutoff = f"{claim['epsilon']:.1%} cutoff of {final['n']}: {claim['cutoff']:.2f}"
        groups = f"; it holds in {claim['groups_hold']:.0%} of {claim['groups']} groups of them" if claim["groups"] else ""
        lines.append(f"  {star}, {cutoff}; {claim['below']:.2%} score below s*: {verdict}{groups}")
    return [*lines, f"  {final['crashes']} of {final['n']} rollouts crash"]


def plain(found: Any) -> Any:
    """Without arrays and rollouts, for JSON."""
    if isinstance(found, dict):
        return {k: plain(v) for k, v in found.items() if k not in QUIETLY}
    return [plain(v) for v in found] if isinstance(found, list) else found
