"""Seeded faults in gate and core: nothing passes that an independent reading of the document would not let pass, and everything mends.

The whole count: python tools/bench_gate_faults.py --count 100000
"""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest
from core_faults import run_case
from gate_law import case, holds_all, reason, table

from s2r_runtime import gate

SEED = 20261121


def test_the_gate_says_what_the_document_says_of_situations_with_faults_in_them() -> None:
    """Allowed or not, and the reason: the first row of the document's table that holds."""
    given: Counter[str] = Counter()
    for number in range(4000):
        settings, situation, command, now, changed = case(random.Random(f"{SEED}/{number}"))
        verdict = gate.decide(settings, situation, command, now)
        wanted = reason(settings, situation, command, now)
        assert (verdict.reason, verdict.allow) == (wanted, wanted == gate.ALLOWED), (number, changed)
        assert math.isfinite(verdict.margin)
        assert (verdict.margin >= 0.0) == verdict.allow
        given[verdict.reason.split(":")[0]] += 1
    by_the_core = {"not_started", "memory_refused", "controller_fault"}  # the core gives these, no situation does
    assert set(given) == {*gate.REASONS, gate.ALLOWED} - by_the_core


def test_the_documents_table_is_in_the_gates_order_and_its_list_of_latches_is_the_gates() -> None:
    assert table() == gate.REASONS
    assert sorted(holds_all()) == sorted(gate.LATCH_HOLDS_ALL)


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
