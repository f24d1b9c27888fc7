"""How many good campaigns the test of independence refuses (guarantee G1): must be at most `whiteness.SERIAL_ALPHA`.

    python tools/bench_serial.py [--count 4000] [--seed 1]

Campaigns of independent samples of the robotarium's model, with Gaussian noise and with noise of heavy tails (Student's t, 3 degrees).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.gap import estimate_gap
from s2r_runtime.evidence.whiteness import SERIAL_ALPHA
from s2r_runtime.messages import SERIAL
from s2r_runtime.models.composed import compose
from s2r_runtime.profile import load_profile
from s2r_runtime.recordings.transitions import Transitions

PROFILE = Path(__file__).parent.parent / "profiles" / "robotarium.toml"
SAMPLES, BETA = 161, 0.0152
"""Those of a first campaign at epsilon = 3 %."""
SURE = 1e-3


def refused(count: int, seed: int) -> int:
    """Of `count` campaigns, how many the test refuses."""
    profile = load_profile(PROFILE)
    model, rng, found = compose(profile.model), np.random.default_rng(seed), 0
    weights, periods = tuple(profile.norm.weights.get(name, 1.0) for name in model.states), profile.sampling.hold_periods
    size = (SAMPLES, 3)
    for number in range(count):
        x0, u = rng.uniform((-1.5, -0.9, -3.1), (1.5, 0.9, 3.1), size), rng.uniform((-0.2, -3.1), (0.2, 3.1), (SAMPLES, 2))
        noise = 2e-4 * (rng.standard_t(3, size) if number % 2 else rng.normal(size=size))
        x1, _ = model.step(x0, u, model.at_rest(SAMPLES))
        held = model.hold(x0, u, periods) + 3e-3 * rng.normal(size=size)
        drawn = Transitions(x0, u, x1 + noise, held, periods, True, {}, "bench", 3.0 * np.arange(SAMPLES), "bench")
        gap = estimate_gap(model, drawn, epsilon=0.03, beta=BETA, weights=weights)
        found += gap.white_reason.startswith(SERIAL)
    return found


def main() -> int:
    """Exit 0 if the level is not refuted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    found = refused(args.count, args.seed)
    low = clopper_pearson_lower(found, args.count, SURE)
    print(f"{found} of {args.count} refused: {found / args.count:.2%}; at least {low:.2%} (99.9 %), must be <= {SERIAL_ALPHA:.2%}")
    return 0 if low <= SERIAL_ALPHA else 1


if __name__ == "__main__":
    raise SystemExit(main())
