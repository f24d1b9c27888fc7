"""The controller is one function of rows: finite, within bounds, each row by itself, and it turns towards the goal."""

import importlib.util
from pathlib import Path

import numpy as np

FILE = Path(__file__).parent.parent / "my_thing.py"
SPEC = importlib.util.spec_from_file_location("my_thing", FILE)
MODULE = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(MODULE)


def seen(n):
    rng = np.random.default_rng(n)
    theta = {"goal": rng.uniform(-1.5, 1.5, (n, 2)), "disc": rng.uniform(-1.0, 1.0, (n, 2)), "disc_radius": np.full(n, 0.25)}
    return rng.uniform(-1.5, 1.5, (n, 3)), theta


def test_rows_are_finite_within_bounds_and_do_not_mix():
    x, theta = seen(200)
    u = MODULE.control(x, theta, MODULE.PARAMETERS)
    assert u.shape == (200, 2)
    assert np.isfinite(u).all()
    assert (np.abs(u) <= [0.2, 3.0]).all()
    for i in range(200):
        alone = MODULE.control(x[i : i + 1], {name: value[i : i + 1] for name, value in theta.items()}, MODULE.PARAMETERS)
        np.testing.assert_allclose(alone[0], u[i])


def test_it_turns_towards_a_goal_that_nothing_hides():
    theta = {"goal": np.array([[0.0, 1.0]]), "disc": np.array([[9.0, -9.0]]), "disc_radius": np.array([0.25])}
    assert MODULE.control(np.zeros((1, 3)), theta, MODULE.PARAMETERS)[0, 1] > 0.0
