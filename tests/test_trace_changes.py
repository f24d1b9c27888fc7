"""A change that may as well have been there from the beginning is none."""

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.dataset import from_arrays
from s2r_runtime.trace.fitting import evaluate, insert, problem
from s2r_runtime.trace.residual import steps_of
from s2r_runtime.trace.selection import accepted

DT_S, STANDS, CHANGED_S = 0.1, 40, 30.0


def _accepted(robots, time_s):
    """Whether a change of what all inputs do to 0.9 of it is believed, of a robot that stands at first."""
    rng, model = np.random.default_rng(0), compose(ModelSpec("unicycle", DT_S))
    u = np.repeat(rng.uniform([0.05, -1.0], [0.3, 1.0], (60, 2)), 10, axis=0)
    u[:STANDS] = 0.0
    robot = compose(ModelSpec("unicycle", DT_S, {}, robots))
    x, hidden, states = np.zeros((1, 3)), robot.at_rest(1), []
    for command in u:
        states.append(x[0])
        x, hidden = robot.step(x, command[None, :], hidden)
    y = np.array([*states, x[0]]) + 0.002 * rng.normal(size=(len(u) + 1, 3))
    data = from_arrays(model, [(y, u)])
    given = problem(data, steps_of(data))
    change = AppliedEffect(registry().get("effects", "regime_change"), "*", {"time": time_s, "gain": 0.9})
    return accepted(given, evaluate(given, insert(model, change, 0)), evaluate(given, model), 100, 10)


@pytest.mark.parametrize("time_s", [2.0, 3.9])
def test_a_robot_that_stands_at_first_has_a_gain_from_when_it_moves_and_no_change(time_s):
    gains = tuple(EffectSpec("input_gain", channel, {"gain": 0.9}) for channel in ("v", "w"))
    assert not _accepted(gains, time_s)


def test_a_change_on_the_way_is_one():
    assert _accepted((EffectSpec("regime_change", "*", {"time": CHANGED_S, "gain": 0.9}),), CHANGED_S)
