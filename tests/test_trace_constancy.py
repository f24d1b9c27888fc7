"""A named number is one number everywhere; one that is more here and less there is told by what it goes with, as a drifting heading is."""

import math

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics import parameter_constancy
from s2r_runtime.trace.diagnostics.lack_of_fit import left_of
from s2r_runtime.trace.diagnostics.parameter_constancy import ALPHA, TOLD, _recently, uneven
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem
from s2r_runtime.trace.pipeline import trace

DT = 0.05
NOISE = np.array([0.0008, 0.0008, 0.002])


def _driven(rng, steps, gain):
    """(steps + 1, 3) measured and (steps, 2) commands of a robot that does gain(x, v, w) of w."""
    u = np.repeat(rng.uniform([0.1, -1.5], [0.5, 1.5], (steps // 15 + 1, 2)), 15, axis=0)[:steps]
    x = np.zeros(3)
    rows = [x]
    for v, w in u:
        x = x + DT * np.array([v * math.cos(x[2]), v * math.sin(x[2]), w * gain(x, v, w)])
        rows.append(x)
    return np.array(rows) + rng.normal(size=(len(rows), 3)) * NOISE, u


def _left(rng, steps, gain):
    """What a gain of w, fitted, leaves."""
    return _of(*_driven(rng, steps, gain))


def _of(y, u):
    """The same of a recording."""
    bare = compose(ModelSpec("unicycle", DT, {}, ()))
    named = compose(ModelSpec("unicycle", DT, {}, (EffectSpec("input_gain", "w", {"gain": 0.8}),)))
    data = from_arrays(bare, [(y, u)])
    given = problem(data, steps_of(data))
    model = insert(bare, named.effects[0], 0)
    return left_of(given, fitted(given, evaluate(given, model), model))


@pytest.mark.parametrize(
    ("gain", "token"),
    [
        (lambda x, v, w: 0.75 + 0.5 * (v - 0.3), "w*v"),
        (lambda x, v, w: 0.75 + 0.1 * math.cos(x[2]), "heading"),
        (lambda x, v, w: 0.75 + 0.1 * abs(w), "w"),
    ],
)
def test_a_gain_that_is_more_here_and_less_there_is_no_gain(gain, token):
    found = uneven(_left(np.random.default_rng(1), 700, gain))
    assert found is not None
    assert found.sure
    assert found.judged.token == token


@pytest.mark.slow
def test_a_gain_that_is_one_number_is_not_told_to_vary():
    """The looks of 40 drives together have a chance of 40 ALPHA at most, of being told of 40 TOLD."""
    found = [uneven(_left(np.random.default_rng(seed), 400, lambda x, v, w: 0.75)) for seed in range(40)]
    assert sum(one is not None and one.sure for one in found) <= 1 < 1.0 / (40 * ALPHA)
    assert sum(one is not None for one in found) <= 40 * TOLD


def test_what_varies_is_not_taken_for_the_noise_of_its_own_test():
    """Three lumps in a turn, in a recording so short that each is met a few times: the blocks of time differ by what is looked for."""
    found = [uneven(_left(np.random.default_rng(seed), 400, lambda x, v, w: 0.75 + 0.12 * math.cos(3.0 * x[2]))) for seed in range(4)]
    assert [one is not None and one.sure and one.judged.token for one in found] == ["heading"] * 4


def test_what_wanders_is_no_number_that_varies():
    """A load that comes and goes within some seconds: whenever it is there, a gain looks like another one."""
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        y, u = _driven(rng, 700, lambda x, v, w: 0.75)
        load = np.zeros(len(y))
        for k in range(1, len(y)):
            load[k] = 0.97 * load[k - 1] + rng.normal() * 0.03
        y[:, 2] += DT * np.cumsum(load)
        found.append(uneven(_of(y, u)))
    assert sum(one is not None and one.sure for one in found) <= 1


def test_what_the_same_residual_shows_when_slid_along_the_recording_is_not_sure(monkeypatch):
    monkeypatch.setattr(parameter_constancy, "margin", lambda *of: -1.0)
    found = uneven(_left(np.random.default_rng(1), 700, lambda x, v, w: 0.75 + 0.5 * (v - 0.3)))
    assert found is not None
    assert not found.sure


def test_what_an_input_recently_was_begins_anew_with_each_run():
    first = np.repeat([0, 3], [3, 4])
    assert _recently(np.array([1.0, 3.0, 5.0, 0.0, 2.0, 4.0, 6.0]), 2, first).tolist() == [1.0, 2.0, 4.0, 0.0, 1.0, 3.0, 5.0]


@pytest.mark.parametrize(("by", "told"), [(0.005, False), (0.05, True)])
def test_a_number_that_varies_a_little_is_one_number_for_all_that_matters(by, told):
    """On many rows it is told beyond doubt, and explains next to nothing of what the gain does."""
    found = uneven(_left(np.random.default_rng(2), 6000, lambda x, v, w: 0.75 + by * (v - 0.3)))
    assert (found is not None) == told
    assert found is None or not found.sure


@pytest.mark.slow
def test_friction_that_is_more_at_some_places_is_not_told_as_friction_alone():
    """A joint on a guide that is dirty at one end."""
    rng, dt = np.random.default_rng(6), 1.0 / 30.0
    model = compose(ModelSpec("joint", dt, {"mass": 1.0}, ()))
    force = np.repeat(rng.uniform(-1.0, 1.0, 120), 10)
    q = qd = 0.0
    rows = [(q, qd)]
    for f in force:
        for _ in range(10):
            q, qd = q + 0.1 * dt * qd, qd + 0.1 * dt * (f - (0.6 + 0.25 * math.tanh(2.0 * q)) * qd)
        rows.append((q, qd))
    y = np.array(rows) + rng.normal(size=(len(rows), 2)) * [0.004, 0.02]
    result = trace(from_arrays(model, [(y, force[:, None])]), model)
    assert "position" in result.depends_on


@pytest.mark.slow
def test_a_heading_that_drifts_goes_with_time():
    """A gyroscope on a robot with wheels: its way turns aside, and it seems to turn."""
    rng = np.random.default_rng(3)
    model = compose(ModelSpec("differential_drive", DT, {"wheel_radius": 0.05, "track": 0.3}, ()))
    u = np.repeat(rng.uniform(-6.0, 8.0, (40, 2)), 20, axis=0)
    x, hidden = np.zeros((1, len(model.states))), model.at_rest(1)
    rows = [x[0]]
    for k in range(len(u)):
        x, hidden = model.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(len(rows), len(model.states))) * [0.001, 0.001, 0.003, 0.05, 0.05]
    y[:, 2] += 0.8 * np.linspace(0.0, 1.0, len(y))
    result = trace(from_arrays(model, [(y, u)]), model)
    assert result.depends_on[:1] == ("time",)
