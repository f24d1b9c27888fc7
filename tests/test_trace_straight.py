"""Recordings slower than the loop that set their inputs: these moved on between the rows."""

import numpy as np
import pytest
from trace_sets.families import make

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.dataset import Stream, from_streams
from s2r_runtime.trace.dataset_files import load_dataset
from s2r_runtime.trace.tracer import trace

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


@pytest.mark.parametrize("held", [True, False])
def test_a_car_whose_speed_was_not_measured_is_asked_as_well(tmp_path, held):
    """The motion does not need that state: it is traced in a model without it."""
    rng = np.random.default_rng(4)
    exact = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
    model = compose(ModelSpec("bicycle", DT_S, {"wheel_base": 0.3}, (exact,)))
    fine = compose(ModelSpec("bicycle", DT_S / TICKS, {"wheel_base": 0.3}, (exact,)))
    t = np.arange(1000 * TICKS) * DT_S / TICKS
    f, phase = rng.uniform(0.2, 1.0, (2, 3, 1)), rng.uniform(0.0, 6.3, (2, 3, 1))
    u = (np.sum(np.cos(2.0 * np.pi * f * t + phase), axis=1) * [[0.1], [0.3]] + [[0.0], [1.0]]).T
    u = np.repeat(u[::TICKS], TICKS, axis=0) if held else u
    x, states = np.zeros((1, 4)), []
    for k in range(len(u)):
        if k % TICKS == 0:
            states.append(x[0, :3])
        x = fine.advance(x, u[k : k + 1], u[k : k + 1])
    table = np.column_stack([t[::TICKS], np.array(states) + rng.normal(size=(1000, 3)) * 2e-4, u[::TICKS]])
    np.savetxt(tmp_path / "run.csv", table, "%.9g", ",", header="t,x,y,theta,steer_cmd,speed_cmd", comments="")
    result = trace(load_dataset(tmp_path / "run.csv", model), model)
    assert (result.verdict, bool(result.straight), result.unseen) == ("none", not held, ("speed",))


def test_a_run_that_begins_under_way_is_asked_as_well(tmp_path):
    """What was commanded before its first row is told by its residual, otherwise for inputs that moved on: it was an error."""
    given = make("tiny", 73003)
    path, _ = given.write(tmp_path)
    model = compose(ModelSpec(given.model["name"], given.model["dt"], given.model["parameters"]))
    result = trace(load_dataset(path, model), model)
    assert (result.verdict, result.straight) == ("none", 0.0)
