"""Which partial repair is offered: it lowers the error of rollouts on held-out data, and raises none that noise does not hide."""

from __future__ import annotations

import numpy as np
import pytest

from s2r_runtime.trace.diagnostics.rollout_error import Judged
from s2r_runtime.trace.verdict import HELPS, helps

FLOOR = np.array([0.1, 0.1])


def _judged(*ends: float) -> Judged:
    return Judged(np.zeros((1, 2)), np.array([ends]))


@pytest.mark.parametrize(
    ("before", "after", "offered"),
    [
        ((1.0, 1.0), (0.5, 0.5), True),
        ((1.0, 1.0), (1.0, 1.0), False),
        ((1.0, 1.0), (0.99 * HELPS, 0.99 * HELPS), True),
        ((1.0, 1.0), (1.01 * HELPS, 1.01 * HELPS), False),
        ((9.0, 1.0), (1.0, 1.2), False),  # better in all, but one state is clearly worse
        ((9.0, 0.1), (1.0, 0.2), True),  # that one is within what noise makes
    ],
)
def test_a_repair_is_offered_if_it_helps_and_harms_nothing(before: tuple[float, float], after: tuple[float, float], offered: bool) -> None:
    assert helps(_judged(*before), _judged(*after), FLOOR) is offered


def test_a_state_that_nobody_measured_does_not_count() -> None:
    assert helps(_judged(1.0, 1.0), _judged(0.5, 9.0), np.array([0.1, np.inf]))


def test_without_rollouts_nothing_is_offered() -> None:
    none = Judged(np.zeros((1, 2)), np.zeros((0, 2)))
    assert not helps(none, none, FLOOR)
