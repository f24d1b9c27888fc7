"""Dry friction that is larger at rest, where that is seen at some speeds only: it is named, and not plain dry friction in its place."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

DT, MASS, ROWS, RAMP = 0.02, 2.0, 900, 60
CURVE = {"force": 0.4, "static_force": 1.0, "velocity": 0.12}


@pytest.mark.parametrize("seed", first(1, [0, 22, 23]))
def test_a_curve_is_looked_for_from_all_its_starts_and_beside_what_it_ties_with(seed):
    """From a start at next to no speed, the fit ends in plain dry friction. What ties with that, and leaves nothing of the speed, is
    named.
    """
    rng = np.random.default_rng(seed)
    model = compose(ModelSpec("joint", DT, {"mass": MASS}))
    robot = compose(ModelSpec("joint", DT / 10, {"mass": MASS}, (EffectSpec("stribeck_friction", "qd", CURVE),)))
    knots = rng.uniform(-2.0, 2.0, ROWS // RAMP + 2)
    u = np.interp(np.arange(ROWS) / RAMP, np.arange(len(knots)), knots)[:, None]
    x, hidden = np.zeros((1, 2)), robot.at_rest(1)
    rows = [x[0]]
    for k in range(ROWS):
        for _ in range(10):
            x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(ROWS + 1, 2)) * [0.004, 0.04]
    result = trace(from_arrays(model, [(y, u)]), model)
    assert (result.verdict, [e.name for e in result.effects]) == ("traced", ["stribeck_friction"])
