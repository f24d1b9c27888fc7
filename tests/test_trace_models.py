"""The tracer on every built-in model, at other steps and in other units than the built-in robot's."""

import math
from dataclasses import replace

import numpy as np
import pytest
from seeds import first
from trace_robots import GEOMETRY, INPUTS, POSES, commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Stream, from_arrays, from_streams
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, problem
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.exchange import parted
from s2r_runtime.trace.selection.scores import STRICT

ROBOTS = {
    "unicycle": (0.05, [(-0.5, 0.5), (-2.0, 2.0)], [0.001, 0.001, 0.004]),
    "differential_drive": (0.05, [(-6.0, 6.0), (-6.0, 6.0)], [0.002, 0.002, 0.004, 0.03, 0.03]),
    "bicycle": (0.025, [(-0.4, 0.4), (0.0, 2.0)], [0.003, 0.003, 0.004, 0.02]),
    "double_integrator": (0.1, [(-1.0, 1.0), (-1.0, 1.0)], [0.003, 0.003, 0.005, 0.005]),
    "joint": (0.01, [(-20.0, 20.0)], [0.0005, 0.005]),
}


def _model(name):
    arcs = (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),) if name in POSES else ()
    return compose(ModelSpec(name, ROBOTS[name][0], GEOMETRY.get(name, {}), arcs))


def _undeclared(name):
    """Effects on the model's first or last input, sized to its step and its commands."""
    dt, bounds, _ = ROBOTS[name]
    first, last = INPUTS[name][0], INPUTS[name][-1]
    return {
        "gain": [("input_gain", last, {"gain": 0.8})],
        "bias": [("input_bias", first, {"bias": 0.06 * bounds[0][1]})],
        "lag": [("input_lag", last, {"time_constant": 4 * dt})],
        "delay": [("input_delay", last, {"delay": 2.4 * dt})],
        "saturation": [("input_saturation", last, {"low": -0.6 * bounds[-1][1], "high": 0.6 * bounds[-1][1]})],
        "bias and lag": [("input_bias", last, {"bias": 0.05 * bounds[-1][1]}), ("input_lag", first, {"time_constant": 3 * dt})],
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "differential_drive" else n for n in ROBOTS])
def test_effects_get_their_names_on_every_model_and_clean_data_give_none(name):
    dt, bounds, noise = ROBOTS[name]
    model, rng = _model(name), np.random.default_rng(17)
    u = commands(rng, 1, 900, dt, bounds, hold=(10 * dt, 32 * dt))
    assert trace(from_arrays(model, [(drive(rng, name, u, [], dt, noise)[0], u[0])]), model).verdict == "none"
    right = []
    for effects in _undeclared(name).values():
        u = commands(rng, 1, 900, dt, bounds, hold=(10 * dt, 32 * dt))
        found = trace(from_arrays(model, [(drive(rng, name, u, effects, dt, noise)[0], u[0])]), model)
        right.append((found.verdict, {(e.name, e.channel) for e in found.effects}) == ("traced", {(n, c) for n, c, _ in effects}))
    assert sum(right) >= 5, list(zip(_undeclared(name), right, strict=True))


def test_arcs_are_told_from_an_euler_step():
    model, rng = compose(ModelSpec("unicycle", 0.1)), np.random.default_rng(3)
    u = commands(rng, 1, 900, 0.1, [(-0.5, 0.5), (-2.0, 2.0)])
    y = drive(rng, "unicycle", u, [], 0.1, [0.0005, 0.0005, 0.001])
    found = trace(from_arrays(model, [(y[0], u[0])]), model)
    assert [(e.name, e.parameters["scheme"][0]) for e in found.effects] == [("integration_scheme", "exact")]


@pytest.mark.slow
def test_many_runs_are_traced_together_and_whole_runs_are_held_out():
    dt, bounds, noise = ROBOTS["bicycle"]
    model, rng = _model("bicycle"), np.random.default_rng(8)
    effects = [("input_lag", "speed_cmd", {"time_constant": 0.14}), ("input_bias", "steer_cmd", {"bias": -0.03})]
    u = commands(rng, 20, 120, dt, bounds, rest=0.0)
    y = drive(rng, "bicycle", u, effects, dt, noise)
    found = trace(from_arrays(model, list(zip(y, u, strict=True))), model)
    assert {(e.name, e.channel) for e in found.effects} == {("input_lag", "speed_cmd"), ("input_bias", "steer_cmd")}
    assert (found.n_fit, len(found.held.steps)) == (12 * 120, 8 * 120)


def test_two_streams_with_stamps_of_their_own_give_the_delay_between_them():
    """Commands at 95 Hz, poses at 62 Hz, both irregular, a model at 10 Hz, a delay of 0.17 s."""
    rng, dt, fine = np.random.default_rng(6), 0.1, 0.005
    held = commands(rng, 1, 24000, fine, [(0.0, 0.3), (-1.2, 1.2)], hold=(0.3, 1.5))
    y = drive(rng, "unicycle", held, [("input_delay", "*", {"delay": 0.17})], fine, [0.0, 0.0, 0.0])[0]
    model = compose(ModelSpec("unicycle", dt, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    grid = fine * np.arange(len(y))
    t_y = np.cumsum(rng.uniform(0.008, 0.024, 7000))
    t_u = np.cumsum(rng.uniform(0.005, 0.016, 11000))
    t_y, t_u = t_y[t_y < grid[-1]], t_u[t_u < grid[-1]]
    y[:, 2] = np.unwrap(y[:, 2])
    states = np.column_stack([np.interp(t_y, grid, y[:, j]) for j in range(3)]) + rng.normal(size=(len(t_y), 3)) * [0.001, 0.001, 0.004]
    inputs = held[0][np.minimum((t_u / fine).astype(int), len(held[0]) - 1)]
    gap = (t_y > 50.0) & (t_y < 52.0)
    data = from_streams(model, [(Stream(t_y[~gap], states[~gap]), Stream(t_u, inputs))], "streams")
    found = trace(data, model)
    assert {(e.name, e.channel) for e in found.effects} == {("input_delay", "*")}
    value = found.effects[0].parameters["delay"][0]
    assert value == pytest.approx(0.17, abs=0.012)  # a command is seen at its stamp, up to 16 ms after it was given
    assert [f.kind for f in found.faults] == ["dropout"]
    assert math.isclose(found.faults[0].to_s - found.faults[0].from_s, 2.0, abs_tol=0.06)


@pytest.mark.slow
def test_runs_that_begin_under_way_show_the_same_lag_as_those_from_rest():
    """Each run is cut out of a drive: before its first row the first command had been held for a while."""
    dt, _, noise = ROBOTS["bicycle"]
    model, rng = _model("bicycle"), np.random.default_rng(9)
    u = commands(rng, 12, 260, dt, [(-0.4, 0.4), (0.5, 2.0)], rest=0.0, hold=(1.5, 3.0))
    u[:, :140] = u[:, 139:140]
    y = drive(rng, "bicycle", u, [("input_lag", "speed_cmd", {"time_constant": 0.3})], dt, noise)
    runs = [(states[120:], inputs[120:]) for states, inputs in zip(y, u, strict=True)]
    found = trace(from_arrays(model, runs), model)
    assert {(e.name, e.channel) for e in found.effects} == {("input_lag", "speed_cmd")}
    assert found.effects[0].parameters["time_constant"][0] == pytest.approx(0.3, rel=0.05)


@pytest.mark.slow
def test_a_command_before_the_recording_began_that_nobody_recorded_is_let_be_forgotten():
    """A unicycle was on its way when it was asked to turn, a moment before the first row: its lag is still catching up."""
    rng, dt = np.random.default_rng(10), 0.01
    u = commands(rng, 1, 520, dt, [(0.3, 0.9), (-1.5, 1.5)], rest=0.0, hold=(0.4, 1.2))
    u[0, :40] = [0.7, 0.0]
    u[0, 40:90] = [0.7, 1.2]
    y = drive(rng, "unicycle", u, [("input_lag", "w", {"time_constant": 0.0164})], dt, [1e-4, 1e-4, 2e-4])
    states, inputs = y[0][40:], u[0][40:]
    model = compose(ModelSpec("unicycle", dt))
    data = with_history(model, from_arrays(model, [(states, inputs)]))
    there = np.flatnonzero(~np.isnan(data.runs[0].y).any(axis=1))
    begin = len(data.runs[0].y) - len(states)
    assert 5 <= there[0] - begin <= 0.05 * len(states)
    found = trace(from_arrays(model, [(states, inputs)]), model)
    rows = there[0] - begin
    assert found.to_json()["first_left_out"] == [{"from_s": 0.0, "to_s": pytest.approx(dt * rows)}]
    assert f"left out: 0 to {dt * rows:.4g} s; commands from before the recording may still act there" in " ".join(found.text().split())
    assert {(e.name, e.channel) for e in found.effects} >= {("input_lag", "w")}
    assert next(e for e in found.effects if e.channel == "w").parameters["time_constant"][0] == pytest.approx(0.0164, rel=0.05)
    known = with_history(model, from_arrays(model, [(states[50:], inputs[50:])]))  # all that acts had been held
    assert np.flatnonzero(~np.isnan(known.runs[0].y).any(axis=1))[0] == len(known.runs[0].y) - len(states[50:])


@pytest.mark.slow
def test_a_limit_that_is_met_in_the_first_rows_alone_is_no_command_from_before():
    """Nothing is found that remembers, so these rows count: the model does not explain them. Somebody may have held the robot, once."""
    rng, dt = np.random.default_rng(11), 0.01
    u = commands(rng, 1, 480, dt, [(-15.0, 15.0)], rest=0.0, hold=(0.1, 0.4))
    u[0, :7], u[0, 7:10] = 16.7, -16.7
    y = drive(rng, "joint", u, [("input_saturation", "force", {"low": -16.3, "high": 16.3})], dt, [2e-5, 1e-4])
    found = trace(from_arrays(_model("joint"), [(y[0], u[0])]), _model("joint"))
    assert found.verdict == "unexplained"
    assert any("force" in token for token in found.depends_on)
    assert found.forgetting == ()


@pytest.mark.slow
@pytest.mark.parametrize("remembers", [False, True])
def test_first_rows_count_where_nothing_remembers_and_are_told_where_something_does(tmp_path, remembers):
    """Of files that lack the wheels' speeds, of the one that is fitted and of the one that is judged on."""
    name = "differential_drive"
    model, dt, before = _model(name), ROBOTS[name][0], 40
    effect, asked = ("input_saturation", "cmd_left", {"low": -9.0, "high": 9.0}), (9.6, 9.6)
    if remembers:
        effect, asked = ("input_lag", "cmd_left", {"time_constant": 0.08}), (4.0, 7.0)
    read = []
    for i in (0, 1):
        rng = np.random.default_rng(20 + i)
        u = commands(rng, 1, 260 + before, dt, [(-3.0, 8.0)] * 2, rest=0.0, hold=(0.2, 0.8))
        u[0, : before - 1], u[0, before - 1 : before + 3] = [asked[0], 2.0], [asked[1], 2.0]
        y = drive(rng, name, u, [effect], dt, 1e-5)[0]
        table = np.column_stack([dt * np.arange(260), y[before:-1, :3], u[0, before:]])
        path = tmp_path / f"{i}.csv"
        np.savetxt(path, table, delimiter=",", header=",".join(["t", "x", "y", "theta", *INPUTS[name]]), comments="")
        read.append(load_dataset(path, model))
    found = trace(read[0], model, test=read[1])
    assert {(e.name, e.channel) for e in found.effects} == {effect[:2]}
    told = " ".join(found.text().split())
    assert bool(found.to_json()["first_left_out"]) == remembers
    assert (f" of {tmp_path}/1.csv; what acts there may follow" in told) == remembers


def test_one_delay_of_all_inputs_gives_way_to_as_long_a_lag_of_each():
    rng = np.random.default_rng(3)
    dt, bounds, noise = ROBOTS["double_integrator"]
    u = commands(rng, 1, 500, dt, bounds)
    y = drive(rng, "double_integrator", u, [("input_lag", name, {"time_constant": 0.3}) for name in ("ax", "ay")], dt, np.array(noise))
    model = _model("double_integrator")
    data = from_arrays(model, [(y[0], u[0])])
    given = problem(data, steps_of(data))
    delay = Added(registry().get("effects", "input_delay"), "*", {"delay": 0.3})
    late = fitted(given, evaluate(given, model), replace(model, effects=(delay,)))
    found = parted(given, late, (), STRICT).model.effects
    assert [(a.effect.name, a.channel) for a in found] == [("input_lag", "ax"), ("input_lag", "ay")]
    assert [a.p["time_constant"] for a in found] == pytest.approx([0.3, 0.3], rel=0.05)


@pytest.mark.slow
def test_an_effect_that_is_hardly_noticed_is_named_where_what_it_leaves_is_noticed():
    """On arcs at 100 Hz rollouts of an Euler step end a twentieth farther off: a little less by the fit's part, a little more by all."""
    rng = np.random.default_rng(0)
    u = commands(rng, 1, 3000, 0.01, [(-0.2, 0.9), (-1.3, 1.3)], hold=(0.6, 3.0), rest=0.0)
    y = drive(rng, "unicycle", u, (), 0.01, np.array([0.002, 0.002, 0.002]))
    model = compose(ModelSpec("unicycle", 0.01))
    found = trace(from_arrays(model, [(y[0], u[0])]), model)
    assert found.verdict == "traced"
    assert [e.name for e in found.effects] == ["integration_scheme"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(3)))
def test_a_car_that_is_fast_when_the_recording_begins_had_been_for_longer_than_its_lag(seed):
    """At 14 m/s with a lag of 0.8 s: what is left of it from rest is 0.3 m/s after three seconds, thirty times the speed's noise."""
    rng = np.random.default_rng(seed)
    rows, parts, dt = 900, 50, 0.1
    u = np.zeros((rows, 2))
    u[:, 1] = np.repeat(rng.uniform(12.0, 24.0, rows // 30), 30)
    u[:60, 1] = 14.0
    u[:, 0] = np.repeat(rng.uniform(-0.03, 0.03, rows // 15), 15)
    x, y, theta, v = 0.0, 0.0, 0.0, 14.0
    seen = [(x, y, theta, v)]
    for steer, asked in u:
        for _ in range(parts):
            v += (asked - v) * (1.0 - math.exp(-dt / parts / 0.8))
            x, y = x + dt / parts * v * math.cos(theta), y + dt / parts * v * math.sin(theta)
            theta += dt / parts * v * math.tan(steer) / 2.7
        seen.append((x, y, theta, v))
    measured = np.array(seen) + rng.normal(size=(rows + 1, 4)) * [0.02, 0.02, 0.0015, 0.01]
    model = compose(ModelSpec("bicycle", dt, {"wheel_base": 2.7}))
    result = trace(from_arrays(model, [(measured, u)]), model)
    assert {e.name for e in result.effects} == {"input_lag", "integration_scheme"}
    assert result.depends_on == ()
