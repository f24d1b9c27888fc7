"""Runs that all begin in one place: what a sensor says of their first row says nothing of each run."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.checks.common_start import from_one_place
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT, NOISE = 0.05, np.array([0.001, 0.01])


def _joint(*effects):
    return compose(ModelSpec("joint", DT, {"mass": 1.0}, effects))


def _runs(robot, starts, seed=0, steps=1):
    """[(y (steps + 1, 2), u (steps, 1))] measured with NOISE, from true starts (runs, 2)."""
    rng = np.random.default_rng(seed)
    runs = []
    for start in starts:
        x, hidden, rows = start[None, :], robot.at_rest(1), [start]
        u = np.repeat(rng.uniform(-1.0, 1.0, (1, 1)), steps, axis=0)
        for k in range(steps):
            x, hidden = robot.step(x, u[k : k + 1], hidden)
            rows.append(x[0])
        runs.append((np.array(rows) + rng.normal(size=(steps + 1, 2)) * NOISE, u))
    return runs


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 2])
def test_runs_from_one_place_lack_nothing(steps):
    result = trace(from_arrays(_joint(), _runs(_joint(), np.zeros((300, 2)), steps=steps)), _joint())
    assert (result.verdict, result.effects) == ("none", ())


def test_starts_in_one_place_are_where_they_are_on_average():
    data = from_arrays(_joint(), _runs(_joint(), np.tile([1.0, 0.0], (100, 1))))
    y0 = np.array([run.y[0] for run in from_one_place(_joint(), data).runs])
    assert np.ptp(y0, axis=0) == pytest.approx(0.0, abs=1e-12)
    assert np.all(np.abs(y0[0] - [1.0, 0.0]) < 4.0 * NOISE / np.sqrt(100))


@pytest.mark.parametrize("brake", [0.0, 30.0])
def test_starts_that_differ_are_kept_even_if_a_brake_takes_them_back(brake):
    robot = _joint(EffectSpec("viscous_friction", "qd", {"coefficient": brake})) if brake else _joint()
    starts = np.random.default_rng(1).normal(size=(100, 2)) * 5.0 * NOISE
    data = from_arrays(_joint(), _runs(robot, starts))
    assert from_one_place(_joint(), data) is data


def test_few_runs_say_nothing_of_where_runs_begin():
    """By eight of this seed it would seem to be told."""
    data = from_arrays(_joint(), _runs(_joint(), np.zeros((8, 2)), seed=6, steps=20))
    assert from_one_place(_joint(), data) is data
