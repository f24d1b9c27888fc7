"""What opposes an input in closed loop is not taken for an input that does less, and an input that does less is not taken for that."""

import math
from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, problem
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.input_confounding import opposed

DT_S, PARTS, INERTIA = 0.008, 4, 2.0
JOINT = compose(ModelSpec("joint", DT_S, {"mass": INERTIA}))


def _led(seed, *, gravity=0.0, viscous=0.0, gain=1.0, rows=1200):
    """A link that a controller leads slowly along a path, with a torque for what it weighs."""
    rng, h = np.random.default_rng(seed), DT_S / PARTS
    t = DT_S * np.arange(rows + 1)
    wave = rng.uniform(0.3, 1.5, 4), rng.uniform(0.0, 6.28, 4), rng.uniform(0.2, 0.6, 4)
    path = sum(size * np.sin(pace * t + phase) for pace, phase, size in zip(*wave, strict=True))
    pace = np.gradient(path, DT_S)
    wanted = np.gradient(pace, DT_S)
    q, v, states, torques = path[0], pace[0], [], []
    for k in range(rows):
        states.append((q + 2e-5 * rng.normal(), v + 2e-3 * rng.normal()))
        u = (INERTIA * wanted[k] + gravity * math.sin(q) + 80.0 * (path[k] - states[-1][0]) + 25.0 * (pace[k] - states[-1][1])) / gain
        torques.append([u])
        for _ in range(PARTS):
            a = (gain * u - gravity * math.sin(q) - viscous * v) / INERTIA
            q, v = q + h * v + 0.5 * h * h * a, v + h * a
    return from_arrays(JOINT, [(np.array(states), np.array(torques[:-1]))])


def _fit(data, name, p):
    given = problem(data, steps_of(data))
    return given, fitted(given, evaluate(given, JOINT), replace(JOINT, effects=(Added(registry().get("effects", name), "force", p),)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_weight_of_a_link_that_is_led_slowly_is_no_torque_that_does_nothing(seed):
    given, fit = _fit(_led(seed, gravity=8.0, viscous=1.5), "input_gain", {"gain": 0.5})
    assert fit.model.effects[0].p["gain"] < 0.2
    assert "position" in opposed(given, fit)


@pytest.mark.parametrize("gain", [0.2, 0.6])
def test_a_torque_that_does_less_is_one_in_closed_loop_too(gain):
    given, fit = _fit(_led(4, gain=gain), "input_gain", {"gain": 0.5})
    assert fit.model.effects[0].p["gain"] == pytest.approx(gain, abs=0.05)
    assert opposed(given, fit) == ()


@pytest.mark.slow
def test_chance_makes_states_seem_to_push_no_more_often_than_it_is_said():
    """One in a thousand of 100: more than one is a chance of one in 200."""
    wrong = sum(bool(opposed(*_fit(_led(seed, gain=0.7, rows=300), "input_gain", {"gain": 0.7}))) for seed in range(100, 200))
    assert wrong <= 1


@pytest.mark.slow
def test_weight_and_friction_of_a_link_that_is_led_slowly_are_told_as_what_they_depend_on():
    found = trace(_led(2, gravity=8.0, viscous=1.5), JOINT)
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert found.depends_on[0] == "position"
