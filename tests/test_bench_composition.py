"""The benchmark of composed statements separates promises that hold from planted faults. (A thousand repetitions: run the tool.)"""

from __future__ import annotations

import bench_composition as bench
import numpy as np
import pytest


@pytest.mark.slow
def test_promises_hold_and_naive_compositions_are_caught() -> None:
    rng = np.random.default_rng(3)
    found = bench.coverage(150, 60, rng)
    assert len(found) == 9
    assert [one["what"] for one in found if not one["ok"]] == []
    assert sum(one["planted"] for one in found) == 2


def test_the_worst_sequence_is_in_the_gap_set_and_reaches_the_edge_of_the_tube() -> None:
    sequence = bench.worst_sequence()
    assert bench.GAP.norm(sequence) == pytest.approx(bench.GAP.radius)
    x = np.zeros((1, 4))
    for d in sequence:
        x = bench.MODEL.step(x, bench.hold(x, {}), ())[0] + d
    assert x[0, 0] == pytest.approx(bench.TUBE.reach[-1])
