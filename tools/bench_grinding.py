"""Free retries: owners who try many variants of a bad controller offline and certify the best one once (guarantee G2, G4).

    tools/bench_grinding.py [--owners 1000] [--variants 200] [--seed 1] [--json]

Each owner's controller fails in 1.33 epsilon of all rollouts. A variant differs in a comment: another digest, the same behaviour. The owner
rolls out all variants with whatever seed he can know beforehand, takes one that passes, if any does, and certifies it: the attempt is paid
for in a real ledger, its seed comes from there, and `verify` decides. A rollout is one draw of a stand-in task.

The promise is broken if the exact 99.9 % lower limit of the share of owners with a certificate exceeds what the attempt spends of beta.
The planted fault is the rule of before: a seed that follows from digests and attempt number. Exit 1 if a promise is broken or the fault is
not caught.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.evidence.bounds import attempt_beta, clopper_pearson_lower, sample_size
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.evidence.verify import seed_for, verify
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trust import offline_ledger

Array = NDArray[np.float64]

EPSILON, BETA, SURE = 0.03, 0.05, 1e-3
FAILS = 1.33 * EPSILON
MODEL = compose(ModelSpec("unicycle", 0.033))
N = sample_size(EPSILON, attempt_beta(BETA, 1))


class OneDraw:
    """A task of one step whose scenario fails with probability FAILS, whatever the controller does."""

    horizon = 1

    def draw(self, rng: np.random.Generator, n: int) -> dict[str, Any]:
        """The scenarios' luck, one number each."""
        return {"luck": rng.random(n), "start": np.zeros((n, 3))}

    def view(self, _scenario: dict[str, Any]) -> dict[str, Any]:
        """Nothing."""
        return {}

    def advance(self, scenario: dict[str, Any], _rng: np.random.Generator) -> dict[str, Any]:
        """Nothing moves."""
        return scenario

    def begin(self, scenario: dict[str, Any]) -> Array:
        """The safety values, which are there from the beginning."""
        return safety(scenario["luck"])

    def observe(self, tally: Array, _x: Array, _scenario: dict[str, Any]) -> Array:
        """Nothing to see."""
        return tally

    def done(self, tally: Array) -> NDArray[np.bool_]:
        """At the horizon."""
        return np.zeros(len(tally), dtype=bool)

    def safety(self, tally: Array) -> Array:
        """>= 0 iff the draw was lucky."""
        return tally

    def progress(self, tally: Array) -> Array:
        """All of it."""
        return np.ones(len(tally))

    def progress_ok(self, _progress: Array) -> bool:
        """Always."""
        return True


def safety(luck: Array) -> Array:
    """Of draws from [0, 1)."""
    return luck - FAILS


def passes(seed: int) -> bool:
    """What a verification with this seed will come to: the owner's own program, quicker than `verify` and of the same draws."""
    return bool(np.min(safety(np.random.default_rng([seed, 0]).random(N))) >= 0.0)


def verified(seed: int, digest: str, attempt: int) -> bool:
    """The verification itself."""
    gap_set = GapSet("ball", (1.0, 1.0, 0.05), 0.0, 0.0, 1)
    choices: dict[str, Any] = {"laws": ("uniform",), "required": ("uniform",), "n": 0, "threshold": 0.0, "task_digest": "task"}
    guarantee = {"epsilon": EPSILON, "beta": attempt_beta(BETA, attempt)}
    standing: Callable[..., Array] = lambda x, _theta: np.zeros((len(x), 2))  # noqa: E731
    result = verify(
        standing, OneDraw(), MODEL, gap_set=gap_set, seed=seed, attempt=attempt, controller_digest=digest, **choices, **guarantee
    )
    return result.passed


def seed_of_before(digest: str, attempt: int) -> int:
    """As seeds were before they were drawn: known to everybody who knows the file."""
    text = f"{digest}\n{MODEL.spec.digest()}\ntask\n{attempt}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def certificates(owners: int, variants: int, first: int, folder: Path, *, before: bool) -> int:
    """How many of the owners get one. before: by the rule of before."""
    issued = 0
    for owner in range(first, first + owners):
        files = [hashlib.sha256(f"{owner}/{variant}".encode()).hexdigest() for variant in range(variants)]
        known = seed_of_before if before else lambda digest, number: seed_for(digest, MODEL.spec.digest(), "task", number)
        best = next((digest for digest in files if passes(known(digest, 1))), files[0])
        offline_ledger.create(key := folder / f"{owner}-{before}.pem")
        ledger = offline_ledger.open_ledger(key, "robot")
        attempt = ledger.spend_attempt(best)
        issued += verified(seed_of_before(best, attempt) if before else ledger.draw_seed(attempt), best, attempt)
    return issued


def main(arguments: list[str]) -> int:
    """Both rules, as a table or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--owners", type=int, default=1000)
    parser.add_argument("--variants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the variants' names; seeds of attempts come from the operating system")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--quick", action="store_true", help="200 owners")
    args = parser.parse_args(arguments)
    owners, began, rows = 200 if args.quick else args.owners, time.process_time(), []
    with tempfile.TemporaryDirectory() as folder:
        for what, before in (("seed drawn after the payment", False), ("fault: seed known beforehand", True)):
            issued = certificates(owners, args.variants, args.seed * 1_000_000, Path(folder), before=before)
            lower, spent = clopper_pearson_lower(issued, owners, SURE), attempt_beta(BETA, 1)
            row = {"what": what, "owners": owners, "variants": args.variants, "certificates": issued, "share": issued / owners}
            rows.append({**row, "lower": lower, "spent": spent, "planted": before, "ok": (lower > spent) == before})
    if args.json:
        print(json.dumps({"epsilon": EPSILON, "fails": FAILS, "n": N, "rows": rows}))
    else:
        print(f"epsilon {EPSILON:.0%}, every controller fails in {FAILS:.2%}, N = {N}, the attempt spends {attempt_beta(BETA, 1):.2%}")
        for row in rows:
            told = f"{row['certificates']:5d} of {owners} owners certified ({row['share']:.2%}, at least {row['lower']:.2%})"
            print(f"{row['what']:32s}{told}  {'as it must be' if row['ok'] else 'WRONG'}")
        print(f"{time.process_time() - began:.0f} s of CPU")
    return 0 if all(row["ok"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
