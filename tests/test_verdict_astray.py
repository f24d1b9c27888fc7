"""What is noise from step to step, and takes rollouts much farther than noise does, is something."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.errors import Judged
from s2r_runtime.trace.verdict import goes_astray

CAR = compose(ModelSpec("bicycle", 0.1, {"wheel_base": 2.7}))
FLOOR = np.array([0.07, 0.07, 0.004, 0.03])


def _ends(*times_the_noise):
    ends = np.random.default_rng(1).normal(size=(400, 4)) * FLOOR * times_the_noise
    return Judged(ends, ends)


@pytest.mark.parametrize(
    ("before", "after", "astray"),
    [
        ((5, 5, 1, 1), (5, 5, 1, 1), True),  # a road's grade that nothing was named for
        ((5, 5, 1, 1), (4, 4, 1, 1), True),  # a name that leaves most of it
        ((30, 30, 9, 1), (4, 4, 2, 1), False),  # a name that leaves little
        ((2, 2, 2, 2), (2, 2, 2, 2), False),  # noise that is coloured
        ((1, 1, 1, 20), (1, 1, 1, 20), False),  # a speed that is set at once, late by part of a step
    ],
)
def test_what_takes_rollouts_far_and_is_left_is_no_noise(before, after, astray):
    assert goes_astray(CAR, _ends(*before), _ends(*after), FLOOR) is astray


def test_nothing_to_judge_on_is_nothing_astray():
    none = Judged(np.zeros((3, 4)), np.zeros((0, 4)))
    assert not goes_astray(CAR, none, none, FLOOR)
