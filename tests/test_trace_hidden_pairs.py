"""Two effects of which one begins where nothing was fitted: together they are found, and when it began is told."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT_S, ROWS, CHANGE_S = 0.02, 900, 7.2
"""What is held out begins at 30 % of the time, and goes on to 50 %: the change is in it."""


def _followed(seed, effects):
    """A joint that follows steps by what it truly does, read with noise."""
    rng, model = np.random.default_rng(seed), compose(ModelSpec("joint", DT_S))
    robot = compose(ModelSpec("joint", DT_S, {}, effects))
    x, hidden = np.zeros((1, 2)), robot.at_rest(1)
    states, forces = [x[0]], []
    for wanted in np.repeat(rng.uniform(-0.5, 0.5, ROWS // 60), 60):
        force = np.clip([[9.0 * (wanted - x[0, 0]) - 4.2 * x[0, 1]]], -3.0, 3.0)
        x, hidden = robot.step(x, force, hidden)
        states.append(x[0])
        forces.append(force[0])
    return model, from_arrays(model, [(np.array(states) + rng.normal(size=(ROWS + 1, 2)) * [0.004, 0.01], np.array(forces))])


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, [0, 2]))
def test_a_change_between_the_parts_that_are_fitted_is_found_beside_a_gain_and_dated(seed):
    effects = (EffectSpec("input_gain", "force", {"gain": 1.4}), EffectSpec("regime_change", "force", {"time": CHANGE_S, "gain": 1.6}))
    model, data = _followed(seed, effects)
    result = trace(data, model)
    found = {e.name: e.parameters for e in result.effects}
    assert set(found) == {"input_gain", "regime_change"}
    assert found["regime_change"]["time"][0] == pytest.approx(CHANGE_S, abs=1.5 * DT_S)
