"""A coarse sensor of a state that an input sets: what it rounds off goes with the input, and is no structure."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.lack_of_fit import beyond_rounding
from s2r_runtime.trace.pipeline import trace

DT_S, STEP = 0.02, 0.24
NOISE = np.array([0.02, 0.02, 0.004, 0.1 * STEP])


def _driven(seed, answers=lambda v: v, rows=1500):
    """A car whose speed is read in coarse steps after some noise; answers: what it does of the speed that it is asked for."""
    rng = np.random.default_rng(seed)
    model = compose(ModelSpec("bicycle", DT_S, {"wheel_base": 2.7}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    t = np.arange(rows) * DT_S
    command = np.column_stack([0.2 * np.sin(0.7 * t), 8.0 + 4.0 * np.sin(2.0 * np.pi * (0.02 + 0.005 * t) * t)])
    acting = np.column_stack([command[:, 0], answers(command[:, 1])])
    x, states = np.zeros((1, 4)), [np.zeros(4)]
    for u in acting:
        x, _ = model.step(x, u[None], model.at_rest(1))
        states.append(x[0])
    y = np.array(states) + rng.normal(size=(rows + 1, 4)) * NOISE
    y[:, 3] = STEP * np.rint(y[:, 3] / STEP)
    return model, from_arrays(model, [(y, command)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_a_coarse_sensor_rounds_off_after_some_noise_is_no_structure(seed):
    model, data = _driven(seed)
    assert trace(data, model).verdict == "none"


@pytest.mark.slow
def test_what_is_more_than_rounding_is_told():
    model, data = _driven(4, lambda v: v - 0.3 * np.sin(1.3 * v))  # no step of the sensor: it comes again every five metres a second
    result = trace(data, model)
    assert result.verdict == "unexplained"
    assert "speed_cmd" in result.depends_on


@pytest.mark.parametrize("noise", [0.05, 0.1, 0.3])
def test_beyond_rounding_lies_what_a_reading_that_is_nearly_on_edge_becomes(noise):
    """sqrt(mean of P (1 - P)) of the step: of a uniform place in it, noise / sqrt(pi), for little noise."""
    rng = np.random.default_rng(1)
    true = rng.uniform(0.0, 100.0, 20_000)
    r = np.rint(true + noise * rng.normal(size=true.shape)) - true
    assert float(np.mean(beyond_rounding(r, 1.0) ** 2)) == pytest.approx(noise / np.sqrt(np.pi), rel=0.08)
