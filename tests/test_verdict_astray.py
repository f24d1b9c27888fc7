"""What is noise from step to step, and takes rollouts much farther than noise does, is something."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.rollout_error import Held, Judged
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.verdict import goes_astray

CAR = compose(ModelSpec("bicycle", 0.1, {"wheel_base": 2.7}))
FLOOR = np.array([0.07, 0.07, 0.004, 0.03])
STEPS, AHEAD = 409, 10
STARTS = STEPS - AHEAD + 1


def _given():
    data = from_arrays(CAR, [(np.zeros((STEPS + 1, 4)), np.zeros((STEPS, 2)))])
    return Held(data, steps_of(data), (), np.ones(STEPS, dtype=bool), AHEAD)


def _ends(*times_the_noise):
    rng = np.random.default_rng(1)
    return Judged(rng.normal(size=(STEPS, 4)) * FLOOR, rng.normal(size=(STARTS, 4)) * FLOOR * times_the_noise)


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
    assert goes_astray(CAR, (_ends(*before), _ends(*after)), _given(), FLOOR) is astray


def test_a_few_steps_that_take_many_rollouts_far_are_no_outliers():
    """Commands that are lost twice, for five steps: too few rollouts pass there for most of them to say so."""
    judged = _ends(1, 1, 1, 1)
    for first in (100, 250):
        judged.one_step[first : first + 5, 2] += 10.0 * FLOOR[2]
        judged.ends[first - AHEAD + 5 : first, 2] += 50.0 * FLOOR[2]
    assert goes_astray(CAR, (judged, judged), _given(), FLOOR)


def test_rows_that_are_off_by_themselves_take_nothing_astray():
    judged = _ends(1, 1, 1, 1)
    for row in range(40, 380, 20):
        judged.one_step[row - 1 : row + 1, 2] += 50.0 * FLOOR[2]
        judged.ends[[row, row - AHEAD], 2] += 50.0 * FLOOR[2]
    assert not goes_astray(CAR, (judged, judged), _given(), FLOOR)


def test_rows_that_are_off_where_runs_begin_and_end_take_nothing_astray():
    """Runs as long as a rollout: all begin where a run does, and end where it does."""
    runs, judged = 40, _ends(1, 1, 1, 1)
    data = from_arrays(CAR, [(np.zeros((AHEAD + 1, 4)), np.zeros((AHEAD, 2)))] * runs)
    given = Held(data, steps_of(data), (), np.ones(AHEAD * runs, dtype=bool), AHEAD)
    judged = Judged(judged.one_step[: AHEAD * runs], judged.ends[:runs])
    for run, step in ((3, 0), (11, AHEAD - 1), (26, 0)):
        judged.one_step[AHEAD * run + step, 2] += 50.0 * FLOOR[2]
        judged.ends[run, 2] += 50.0 * FLOOR[2]
    assert not goes_astray(CAR, (judged, judged), given, FLOOR)
    judged.ends[:, 2] *= 20.0
    assert goes_astray(CAR, (judged, judged), given, FLOOR)


def test_nothing_to_judge_on_is_nothing_astray():
    given = _given()
    nothing = Held(given.data, given.steps, (), np.zeros(STEPS, dtype=bool), AHEAD)
    none = Judged(np.zeros((STEPS, 4)), np.zeros((0, 4)))
    assert not goes_astray(CAR, (none, none), nothing, FLOOR)
