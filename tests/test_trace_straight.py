"""Recordings slower than the loop that set their inputs: these moved on between the rows."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.gap import Transitions
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace import straight as inputs_straight
from s2r_runtime.trace.dataset import Stream, from_streams
from s2r_runtime.trace.fitting import evaluate, problem
from s2r_runtime.trace.residual import steps_of
from s2r_runtime.trace.straight import NATS, ROUNDS, moved_on, straight
from s2r_runtime.trace.tracer import load_dataset, trace

DT_S, TICKS, NOISE = 0.02, 10, 1e-3


def _joint(seed, friction, held, rows=1500):
    """A joint under a force of some sines, set TICKS times a row, or held for each row; as a table's streams."""
    model, rng = compose(ModelSpec("joint", DT_S)), np.random.default_rng(seed)
    f, phase = rng.uniform(0.2, 1.5, 5)[:, None], rng.uniform(0.0, 6.3, 5)[:, None]
    t = np.arange(rows * TICKS) * DT_S / TICKS
    force = np.sum(np.cos(2.0 * np.pi * f * t + phase), axis=0)
    force = np.repeat(force[::TICKS], TICKS) if held else force
    q, v, h, states = 0.0, 0.0, DT_S / TICKS, []
    for k, u in enumerate(force.tolist()):
        if k % TICKS == 0:
            states.append((q, v))
        a = u - friction * v
        q, v = q + h * v + 0.5 * h * h * a, v + h * a
    stamps = t[::TICKS]
    measured = np.array(states) + rng.normal(size=(rows, 2)) * NOISE
    return model, from_streams(model, [(Stream(stamps, measured), Stream(stamps, force[::TICKS, None]))], "a table")


def test_a_force_that_moves_on_between_the_rows_is_no_structure():
    model, data = _joint(1, friction=0.0, held=False)
    result = trace(data, model)
    assert result.verdict == "none"
    assert result.straight == pytest.approx(1.0 - 1.0 / TICKS, abs=0.03)
    assert result.to_json()["inputs_moved_on"] == pytest.approx(0.5 - 0.5 / TICKS, abs=0.015)
    assert "went on changing between the rows" in result.text()


def test_friction_beside_a_force_that_moves_on_has_its_size():
    model, data = _joint(2, friction=0.3, held=False)
    (found,) = trace(data, model).effects
    assert (found.name, found.channel) == ("viscous_friction", "qd")
    _, low, high, _ = found.parameters["coefficient"]
    assert low < 0.3 < high


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_force_that_is_held_is_taken_as_held(friction):
    model, data = _joint(3, friction, held=True)
    result = trace(data, model)
    assert not result.straight
    assert [e.name for e in result.effects] == ["viscous_friction"] * (friction > 0.0)


def test_runs_of_which_some_began_under_way_tell_it_too():
    """Which of them did is another question with each way that inputs may have gone."""
    model, data = _joint(1, friction=0.3, held=False)
    ((states, inputs),) = data.segments
    rows = [slice(k, k + 170) for k in range(0, 1440, 180)]
    runs = [tuple(Stream(one.t[some] - one.t[some.start], one.values[some]) for one in (states, inputs)) for some in rows]
    assert trace(from_streams(model, runs, "runs"), model).straight == pytest.approx(1.0 - 1.0 / TICKS, abs=0.03)


@pytest.mark.parametrize("held", [True, False])
def test_a_recording_without_a_state_that_the_motion_does_not_need_is_laid_without_it(tmp_path, held):
    """A car whose speed nobody measured, steered by a wheel that moves on, or commanded anew every row."""
    model, fine, rng = compose(ModelSpec("bicycle", 0.05)), compose(ModelSpec("bicycle", 0.05 / TICKS)), np.random.default_rng(5)
    t = np.arange(600 * TICKS) * 0.05 / TICKS
    u = np.column_stack([0.2 * np.sin(2.3 * t) + 0.1 * np.cos(4.1 * t), np.full(len(t), 0.8)])
    u = np.repeat(u[::TICKS], TICKS, axis=0) if held else u
    x, hidden, rows = np.zeros((1, 4)), fine.at_rest(1), []
    for k in range(len(t)):
        if k % TICKS == 0:
            rows.append([t[k], *(x[0, :3] + NOISE * rng.normal(size=3)), *u[k]])
        x, hidden = fine.step(x, u[k : k + 1], hidden)
    path = tmp_path / "car.csv"
    np.savetxt(path, rows, delimiter=",", header="t,x,y,theta,steer_cmd,speed_cmd", comments="")
    data = load_dataset(path, model)
    result = trace(data, model, test=data)
    assert result.unseen == ("speed",)
    assert result.straight == pytest.approx(0.0 if held else 1.0 - 1.0 / TICKS, abs=0.1)


def test_samples_of_a_campaign_stay_with_inputs_that_moved_on():
    model, data = _joint(4, friction=0.0, held=False, rows=50)
    samples = Transitions(np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)), None, 1, True, {}, "", np.zeros(2), "here")
    assert straight(replace(data, campaign=samples), model, 0.5).campaign is samples


@pytest.mark.parametrize(("after", "told"), [(-0.05, 0.8), (-0.9, 0.0)])
def test_what_is_hardly_on_its_way_when_numbers_are_fitted_again_is_held(monkeypatch, after, told):
    model, data = _joint(6, friction=0.0, held=False, rows=100)
    given = problem(data, steps_of(data))
    says = iter([(0.85, 2.0 * NATS), (after, 0.0), *[(min(after + 0.05, 0.0), 0.0)] * ROUNDS])
    monkeypatch.setattr(inputs_straight, "_beta", lambda *asked: next(says))
    assert moved_on(lambda share: given, evaluate(given, model)) == pytest.approx(told)
