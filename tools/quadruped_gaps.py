"""The quadruped's gap, reading by reading, and against what it could say at most.

    r        the largest of the first N discrepancies, literal (a metre counts as a radian) or weighted, ball or box
    still    what a robot that never moved would score: the largest input over one step, |(v dt, w dt)|_W
    r/still  1 and more: the model foretells no more than `it may be anywhere that it could have gone`

    still = sqrt((.15 * .1)^2 + (.3 * .1)^2) = .0335 at the paper's .1 s in the literal norm

Model steps from .1 to 1 s are read off the same holds. Each reading's statement holds by itself (guarantee G1); that all are read off the
same samples costs nothing as long as nobody picks the one that he likes best.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from quadruped_truth import FINE, Holds

from s2r_runtime.evidence.bounds import scenario_confidence
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.gap import Kind, discrepancy
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec

Array = NDArray[np.float64]

V_MAX, W_MAX = 0.15, 0.3
LITERAL, BODY = (1.0, 1.0, 1.0), (1.0, 1.0, 0.2)
"""Weights: a radian as a metre; a radian as half the distance between front and rear hips (0.2 m)."""
ARCS = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
"""A step of a second turns by up to .3 rad: the paper's Euler step would be off by 2 cm for that alone."""
IN_STRIDE_S = 0.4
"""So long after its beginning a robot walks as it was told."""


class Reading(NamedTuple):
    """One way to take the gap. begins: `standing` (after a full stop, the paper's), or `in stride`. effects: what else the model knows."""

    dt: float
    begins: str = "standing"
    norm: str = "weighted"
    kind: Kind = "ball"
    effects: tuple[EffectSpec, ...] = ()
    known: str = ""

    @property
    def words(self) -> str:
        """For tables."""
        return f"{self.dt:g} s, {self.begins}, {self.norm} {self.kind}" + (f", {self.known}" if self.known else "")

    @property
    def weights(self) -> tuple[float, ...]:
        """One a state."""
        return LITERAL if self.norm == "literal" else BODY

    @property
    def model(self) -> ComposedModel:
        """The paper's at the paper's step; at longer ones along arcs."""
        arcs = () if self.dt <= 0.1 + 1e-9 else (ARCS,)
        return compose(ModelSpec("unicycle", self.dt, effects=(*self.effects, *arcs)))

    @property
    def still(self) -> float:
        """The score of a robot that stands still, at the largest input."""
        furthest = np.array([[V_MAX * self.dt, 0.0, W_MAX * self.dt]])
        return float(discrepancy(furthest, np.array(self.weights), self.kind)[0])

    def errors(self, holds: Holds) -> Array:
        """(N, 3)."""
        after = 0 if self.begins == "standing" else max(1, round(IN_STRIDE_S / self.dt))
        return holds.errors(self.model, after)

    def fits(self, holds: Holds) -> bool:
        """Whether a hold is long enough."""
        after = 0 if self.begins == "standing" else max(1, round(IN_STRIDE_S / self.dt))
        return round((after + 1) * self.dt / FINE) < holds.path.shape[1]

    def discrepancies(self, holds: Holds) -> Array:
        """(N,)."""
        return discrepancy(self.errors(holds), np.array(self.weights), self.kind)

    def gap_set(self, holds: Holds) -> GapSet:
        """D and the hold gap of these samples."""
        model = self.model
        e = discrepancy(holds.held_errors(model), np.array(self.weights), self.kind)
        return GapSet(self.kind, self.weights, float(self.discrepancies(holds).max()), float(e.max()), holds.periods(model))


STRIDE_S = 0.47
"""The gait's period: x0 and x1 are then met at about the same phase of it, whichever that is."""

READINGS = (
    Reading(0.1, norm="literal"),
    Reading(0.1),
    Reading(0.1, kind="box"),
    Reading(0.1, "in stride"),
    Reading(0.2),
    Reading(STRIDE_S),
    Reading(STRIDE_S, "in stride"),
    Reading(0.5, norm="literal"),
    Reading(0.5),
    Reading(0.5, "in stride"),
    Reading(1.0, norm="literal"),
    Reading(1.0),
)


def row(reading: Reading, holds: Holds, epsilon: float) -> dict[str, Any]:
    """r and its parts: the largest distance in the plane, the largest error of heading, what standing still would score."""
    e = reading.errors(holds)
    d = discrepancy(e, np.array(reading.weights), reading.kind)
    position, heading = np.hypot(e[:, 0], e[:, 1]), np.abs(e[:, 2])
    still = discrepancy(_standing(reading, holds), np.array(reading.weights), reading.kind)
    return {
        "reading": reading.words,
        "n": len(d),
        "confidence": 1.0 - float(scenario_confidence(len(d), 0, epsilon)),
        "r": float(d.max()),
        "median": float(np.median(d)),
        "position": float(position.max()),
        "heading": float(heading.max()),
        "furthest": [V_MAX * reading.dt, W_MAX * reading.dt],
        "still": reading.still,
        "share": float(d.max() / reading.still),
        "still_median": float(np.median(still)),
        "discrepancies": d,
        "drawn": {"position": position, "heading": heading},
    }


def _standing(reading: Reading, holds: Holds) -> Array:
    """(N, 3) what these inputs would have scored on a robot that doesn't move."""
    x = holds.path[:, 0].copy()
    plain = reading._replace(effects=()).model
    foretold, _ = plain.step(x, holds.u, plain.at_rest(len(x)))
    return plain.difference(x, foretold)


def curve(holds: Holds, steps: Sequence[float], begins: str, kind: Kind = "ball", effects: tuple[EffectSpec, ...] = ()) -> Array:
    """(steps, 2): model step, r / still."""
    readings = [Reading(round(float(dt), 3), begins, "weighted", kind, effects) for dt in steps]
    return np.array([(one.dt, one.discrepancies(holds).max() / one.still) for one in readings if one.fits(holds)])


def of_more(reading: Reading, holds: Holds, choices: Sequence[tuple[int, int, float]]) -> list[dict[str, Any]]:
    """What more samples say: choices of (N, k discarded, epsilon); r is the (k+1)-th largest of the first N."""
    d = reading.discrepancies(holds)
    rows = []
    for n, k, epsilon in choices:
        if n <= len(d):
            r = float(np.sort(d[:n])[n - 1 - k])
            beyond = float(np.mean(d[n:] > r)) if len(d) > n else None
            confidence = 1.0 - float(scenario_confidence(n, k, epsilon))
            rows.append(
                {"n": n, "discarded": k, "epsilon": epsilon, "confidence": confidence, "r": r, "share": r / reading.still}
                | {"beyond": beyond}
            )
    return rows
