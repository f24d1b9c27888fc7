"""Seeded faults in the core: nothing moves that may not, every case ends in a named reason, and everything mends.

The whole count: python tools/bench_gate_faults.py --count 100000
"""

from __future__ import annotations

from collections import Counter

import pytest
from core_faults import run_case

SEED = 20261121


@pytest.mark.parametrize("share", range(4))
def test_faults_in_the_core_move_nothing_end_in_a_named_reason_and_mend(share: int) -> None:
    """A quarter of them in each test; `core_faults` says which faults."""
    reasons: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    for number in range(500 * share, 500 * (share + 1)):
        outcome = run_case(SEED, number)
        reasons.update(outcome.reasons)
        faults.update(outcome.faults)
    assert len(faults) > 25  # the draws were where it matters
    assert len(reasons) > 15
