"""A position and a speed that do not belong together: no input does that, and no noise of either."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.lack_of_fit import dictionaries_of, left_of
from s2r_runtime.trace.estimation.prediction import acting, residual, steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.hypotheses.basis import dictionaries
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.basis_evidence import first_look

DT_S, ROWS = 0.01, 1200
NOISE = np.array([2e-4, 4e-3])


def _followed(seed):
    """A joint that follows steps on what a sensor without noise says: (q, qd) (ROWS + 1, 2), force (ROWS, 1)."""
    rng = np.random.default_rng(seed)
    wanted = np.repeat(rng.uniform(-0.3, 0.3, ROWS // 100), 100)
    q, v, states, forces = 0.0, 0.0, [(0.0, 0.0)], []
    for target in wanted.tolist():
        force = float(np.clip(16.0 * (target - q) - 5.6 * v, -3.0, 3.0))
        q, v = q + DT_S * v + 0.5 * DT_S * DT_S * force, v + DT_S * force
        states.append((q, v))
        forces.append((force,))
    return np.array(states), np.array(forces)


def _seen_by_its_controller(seed, step=0.03):
    """A joint whose controller sees what was measured: noise of its position is in the speeds that come after."""
    rng, model = np.random.default_rng(seed), compose(ModelSpec("joint", step))
    x, states, forces = np.zeros(2), [], []
    for target in np.repeat(rng.uniform(-0.02, 0.02, ROWS // 50), 50).tolist():
        seen = x + rng.normal(size=2) * [5e-3, 4e-3]
        force = float(np.clip(36.0 * (target - seen[0]) - 8.4 * seen[1], -9.0, 9.0))
        states.append(seen)
        forces.append((force,))
        x = np.array([x[0] + step * x[1] + 0.5 * step * step * force, x[1] + step * force + 1.4e-3 * rng.normal()])
    return model, from_arrays(model, [(np.array([*states, x]), np.array(forces))])


def _recorded(seed, measured):
    model = compose(ModelSpec("joint", DT_S))
    states, forces = _followed(seed)
    noise = np.random.default_rng(seed + 1).normal(size=states.shape) * NOISE
    return model, from_arrays(model, [(measured(states) + noise, forces)])


def _late(states, rows=3):
    return np.column_stack([np.concatenate([np.full(rows, states[0, 0]), states[:-rows, 0]]), states[:, 1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "measured",
    [lambda s: s * [1.08, 1.0], lambda s: s * [1.0, 1.08], _late],
    ids=["a scale of the position", "a scale of the speed", "a position that comes late"],
)
def test_a_position_that_moves_otherwise_than_its_speed_says_is_told(measured):
    model, data = _recorded(3, measured)
    result = trace(data, model)
    assert result.verdict != "none"
    assert "speed" in result.depends_on, "beside a name, too: a speed that is measured too large is first of all a gain of the force"


@pytest.mark.parametrize("seed", range(4))
def test_those_that_belong_together_are_no_structure(seed):
    model, data = _recorded(10 + seed, lambda s: s)
    assert trace(data, model).verdict == "none"


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_position_that_its_controller_sees_is_no_structure(seed):
    model, data = _seen_by_its_controller(seed)
    given = problem(data, steps_of(data))
    left = left_of(given, evaluate(given, model))
    nats = [first_look(left, x) for about, x in dictionaries_of(left) if about.startswith("speed")]
    assert max(nats) < 3.0
    assert trace(data, model).verdict == "none"


def test_what_it_is_told_by_pushes_positions_alone():
    model, data = _recorded(3, lambda s: s)
    given = problem(data, steps_of(data))
    fit = evaluate(given, model)
    act = acting(model, data)
    found = dictionaries(given, model, act, fit.noise, residual(model, given.steps, act))
    alone = [terms for about, terms in found if about.startswith("speed") and not any(np.any(term[:, 1]) for term in terms)]
    assert sorted(len(terms) for terms in alone) == [1, 9]
