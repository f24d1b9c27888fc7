"""A change that may as well have been there from the beginning is none, nor is a sine that the drive makes."""

from dataclasses import replace

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection import change_points
from s2r_runtime.trace.selection.acceptance import accepted
from s2r_runtime.trace.selection.change_points import from_the_beginning, rivals_that_happen
from s2r_runtime.trace.selection.scores import STRICT, Scored, name_of
from s2r_runtime.trace.selection.stepwise import Selection, all_dated

DT_S, STANDS, CHANGED_S = 0.1, 40, 30.0


def _problem(robots):
    """Of a robot that stands at first, and its model."""
    rng, model = np.random.default_rng(0), compose(ModelSpec("unicycle", DT_S))
    u = np.repeat(rng.uniform([0.05, -1.0], [0.3, 1.0], (60, 2)), 10, axis=0)
    u[:STANDS] = 0.0
    robot = compose(ModelSpec("unicycle", DT_S, {}, robots))
    x, hidden, states = np.zeros((1, 3)), robot.at_rest(1), []
    for command in u:
        states.append(x[0])
        x, hidden = robot.step(x, command[None, :], hidden)
    y = np.array([*states, x[0]]) + 0.002 * rng.normal(size=(len(u) + 1, 3))
    data = from_arrays(model, [(y, u)])
    return problem(data, steps_of(data)), model


def _accepted(robots, time_s):
    """Whether a change of what all inputs do to 0.9 of it is believed."""
    given, model = _problem(robots)
    change = AppliedEffect(registry().get("effects", "regime_change"), "*", {"time": time_s, "gain": 0.9})
    return accepted(given, evaluate(given, insert(model, change, 0)), evaluate(given, model), 100, 10)


GAINS = tuple(EffectSpec("input_gain", channel, {"gain": 0.9}) for channel in ("v", "w"))
CHANGE = (EffectSpec("regime_change", "*", {"time": CHANGED_S, "gain": 0.9}),)


@pytest.mark.parametrize("time_s", [2.0, 3.9])
def test_a_robot_that_stands_at_first_has_a_gain_from_when_it_moves_and_no_change(time_s):
    assert not _accepted(GAINS, time_s)


def test_a_change_on_the_way_is_one():
    assert _accepted(CHANGE, CHANGED_S)


def _instead(robots, name, p):
    """What stands in the end in the place of an effect on all inputs."""
    given, model = _problem(robots)
    found = insert(model, AppliedEffect(registry().get("effects", name), "*", p), 0)
    fit = fitted(given, evaluate(given, found), found)
    return [name_of(a) for a in from_the_beginning(given, fit, STRICT).model.effects]


@pytest.mark.parametrize(("name", "p"), [("regime_change", {"time": 3.9, "gain": 0.95}), ("input_gain_drift", {"rate": -0.002})])
def test_two_gains_are_neither_a_change_of_all_at_first_nor_a_drift_of_all(name, p):
    assert _instead(GAINS, name, p) == [("input_gain", "v"), ("input_gain", "w")]


def test_a_change_on_the_way_and_a_drift_stay():
    assert _instead(CHANGE, "regime_change", {"time": CHANGED_S, "gain": 0.95}) == [("regime_change", "*")]
    drift = (EffectSpec("input_gain_drift", "*", {"rate": -0.003}),)
    assert _instead(drift, "input_gain_drift", {"rate": -0.002}) == [("input_gain_drift", "*")]


def test_a_change_before_the_robot_moves_is_no_rival(monkeypatch):
    given, model = _problem(GAINS[1:])

    def found(name, p):
        with_it = insert(model, AppliedEffect(registry().get("effects", name), "w", p), 0)
        return Scored(name, "w", 1.0, fitted(given, evaluate(given, with_it), with_it))

    gain = found("input_gain", {"gain": 0.95})
    others = [
        found("regime_change", {"time": 3.0, "gain": 0.95}),
        found("input_gain_asymmetry", {"gain_positive": 0.9, "gain_negative": 0.9}),
    ]
    monkeypatch.setattr(change_points, "rivals_of", lambda given, fit, place: others)
    assert rivals_that_happen(given, gain.fit) == others[1:]


def test_a_rival_is_dated_as_what_was_chosen_is():
    """Between what is fitted nobody can tell one time from another; all of the recording can, and told of one only, that foretells it."""
    rng = np.random.default_rng(5)
    model = compose(ModelSpec("unicycle", 0.02))
    u = np.repeat(rng.uniform([0.1, -0.8], [0.5, 0.8], (30, 2)), 20, axis=0)
    x, rows = np.zeros((1, 3)), [np.zeros(3)]
    for k, row in enumerate(u):
        x = model.nominal.step(x, row[None] * (0.6 if k >= 285 else 1.0), 0.02, model.parameters)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(601, 3)) * [1e-3, 1e-3, 3e-3], u)])
    steps = steps_of(data)
    given, everything = problem(data, steps.take(np.r_[:240, 360:600])), problem(data, steps)
    change = registry().get("effects", "regime_change")
    fits = [
        fitted(given, evaluate(given, model), replace(model, effects=(Added(change, channel, {"time": 6.5, "gain": 0.6}),)))
        for channel in ("w", "*")
    ]
    chosen = Selection(evaluate(given, model), fits[0], 1, (), (Scored("regime_change", "*", 1.0, fits[1]),))
    dated = all_dated(given, everything, chosen)
    for fit in (dated.fit, dated.rivals[0].fit):
        assert fit.model.effects[0].p["time"] == pytest.approx(5.7, abs=0.2)
    assert fits[1].model.effects[0].p["time"] == pytest.approx(6.5, abs=0.1)


def _of_a_sine(robots, seed):
    """What is named of a robot that turns to and fro at 0.45 Hz."""
    model, robot = (compose(ModelSpec("unicycle", 0.05, {}, effects)) for effects in ((), robots))
    rng, t = np.random.default_rng(seed), 0.05 * np.arange(1500)
    u = np.column_stack([0.3 + 0.1 * np.sin(2.0 * np.pi * 0.17 * t), 0.9 * np.sin(2.0 * np.pi * 0.4464 * t)])
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    return trace(from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * [0.001, 0.001, 0.003], u)]), model)


SLOW = EffectSpec("input_lag", "w", {"time_constant": 0.1})


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
def test_a_sine_at_the_frequency_of_the_drive_is_a_gain_and_a_delay(seed):
    """A gain, a delay and a lag: of a drive of one frequency two numbers can be told, and no sine of its own."""
    late = EffectSpec("input_delay", "w", {"delay": 0.1})
    found = _of_a_sine((EffectSpec("input_gain", "w", {"gain": 0.94}), SLOW, late), seed)
    assert len(found.effects) == 2
    assert {(e.name, e.channel) for e in found.effects} <= {(f"input_{name}", "w") for name in ("gain", "delay", "lag")}


@pytest.mark.parametrize("seed", first(1, range(2)))
def test_a_sine_at_another_frequency_is_one(seed):
    found = _of_a_sine((SLOW, EffectSpec("periodic_disturbance", "w", {"frequency": 1.3, "amplitude": 0.05, "phase": 0.4})), seed)
    assert [(e.name, e.channel) for e in found.effects] == [("input_lag", "w"), ("periodic_disturbance", "w")]
    assert found.effects[1].parameters["frequency"][0] == pytest.approx(1.3, abs=0.01)
