"""Situations with faults in them: the gate's verdict and reason are those of the document, read independently.

The whole count: python tools/bench_gate_faults.py --count 100000
"""

from __future__ import annotations

import math
import random
from collections import Counter

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
