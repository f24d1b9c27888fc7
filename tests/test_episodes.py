"""Scenario after scenario: in verification's order, repeatable one by one."""

from __future__ import annotations

import numpy as np

from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry

MODEL = ModelSpec("unicycle", 0.033)


def test_a_scenario_can_be_drawn_again_on_its_own() -> None:
    task = registry().get("tasks", "grid_world")({"steps": 3}, compose(MODEL).nominal, MODEL.dt)
    x = np.array([0.2, 0.2, 0.0])
    one, other = Episodes(task, seed=1), Episodes(task, seed=2)
    first = [one.look(x)[0] for _ in range(6)]
    rng = np.random.default_rng([1, 1])
    again = task.view(task.draw_at(rng, x))
    assert first[3] is not None
    for name, value in again.items():
        np.testing.assert_array_equal(first[3][name], value)
    seen = other.look(x)[0]
    assert first[0] is not None
    assert seen is not None
    assert any(not np.array_equal(first[0][name], value) for name, value in seen.items())
