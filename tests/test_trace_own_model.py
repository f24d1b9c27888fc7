"""A model of one's own may say a parameter wrongly: it is named, unless it is the same as something that every model can have."""

import math

import numpy as np
import pytest
from seeds import first
from test_trace_first_look import _alike

from s2r_runtime.effects.classes import same
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.models.bound import integrating, steps_coarsely
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.rollout_error import held
from s2r_runtime.trace.estimation.prediction import Acting, steps_of, wherever
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem
from s2r_runtime.trace.pipeline import trace, usual_horizon
from s2r_runtime.trace.selection import screening
from s2r_runtime.trace.selection.pairs import two_together
from s2r_runtime.trace.selection.scores import names
from s2r_runtime.trace.selection.stepwise import Selection
from s2r_runtime.trace.selection.unnamed_alternatives import better_shape
from s2r_runtime.trace.verdict import foretelling

DT_S, NOISE_M, PARTS = 2.0, 0.01, 20
TANK = """
import numpy as np

STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"lift": 0.05, "outflow": 0.04, "leak": 0.0}


def step(x, u, dt, params):
    if params["outflow"] > NARROWEST:
        raise ValueError("no such valve")
    level = x[:, 0]
    for _ in range(PARTS):
        level = np.maximum(level, 0.0)
        level = level + dt / PARTS * (params["lift"] * u[:, 0] - params["outflow"] * np.sqrt(level) - params["leak"] * level)
    return level[:, None]
"""


def _model(folder, narrowest=1e9):
    path = folder / "tank.py"
    path.write_text(TANK.replace("NARROWEST", repr(narrowest)).replace("PARTS", str(PARTS)))
    return compose(ModelSpec(str(path), DT_S))


def _drive(model, lift=0.05, outflow=0.04, leak=0.0, rows=1500, seed=1):
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 3.0, rows // 25), 25)
    level, levels = 4.0, [4.0]
    for u in pump:
        for _ in range(PARTS):
            level += DT_S / PARTS * (lift * u - outflow * np.sqrt(max(level, 0.0)) - leak * level)
        levels.append(level)
    return from_arrays(model, [(np.array(levels)[:, None] + NOISE_M * rng.normal(size=(rows + 1, 1)), pump[:, None])])


@pytest.mark.parametrize(
    ("robot", "name", "channel", "value"),
    [
        ({"outflow": 0.05}, "parameter_change", "outflow", 1.25),
        ({"leak": 0.004}, "parameter_change", "leak", 0.004),
        ({"lift": 0.04}, "input_gain", "pump", 0.8),
    ],
    ids=["a ratio", "what the model has as zero", "the same as a gain"],
)
def test_a_parameter_that_is_another_one_is_named_with_its_value(tmp_path, robot, name, channel, value):
    model = _model(tmp_path)
    found = trace(_drive(model, **robot), model)
    (effect,) = found.effects
    ((known, low, high, _),) = effect.parameters.values()
    assert (found.verdict, effect.name, effect.channel) == ("traced", name, channel)
    assert known == pytest.approx(value, rel=0.08)
    assert low < known < high
    assert channel in found.text()


def test_parameters_that_changed_together_are_the_step_with_all_of_them(tmp_path):
    """What two change together is more than both alone do: a lift that is stronger flows out of a wider hole."""
    model = _model(tmp_path)
    both = tuple(EffectSpec("parameter_change", name, {"ratio": ratio}) for name, ratio in (("outflow", 1.5), ("lift", 0.7)))
    values = {**model.parameters, "outflow": 1.5 * model.parameters["outflow"], "lift": 0.7 * model.parameters["lift"]}
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0.5, 5.0, (20, 1)), rng.uniform(0.0, 3.0, (20, 1))
    for effects in (both, both[::-1]):
        repaired = compose(ModelSpec(model.spec.name, DT_S, {}, effects))
        there, _ = repaired.step(x, u, repaired.at_rest(20))
        assert there == pytest.approx(model.nominal.step(x, u, DT_S, values), rel=1e-12)


def test_a_model_that_is_right_gets_no_other_parameters(tmp_path):
    model = _model(tmp_path)
    assert trace(_drive(model), model).verdict == "none"


def test_a_parameter_that_only_scales_an_input_is_its_gain(tmp_path):
    nominal = _model(tmp_path).for_effects
    assert same(nominal, "parameter_change", "lift", {"ratio": 0.8})[0] == ("input_gain", "pump", {"gain": 0.8})
    assert same(nominal, "parameter_change", "outflow", {"ratio": 0.8}) == []


WEIRS = """
import numpy as np

STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"stroke": 0.05, "most": 1.5, "weir": 0.3, "crest": 3.0, "spill": 0.1}


def step(x, u, dt, params):
    level = x[:, 0]
    out = params["weir"] * np.maximum(level - params["crest"], 0.0) + params["spill"] * np.maximum(level - 4.0, 0.0)
    return (level + dt * (np.minimum(params["stroke"] * u[:, 0], params["most"]) - out))[:, None]
"""


def test_parameters_that_act_only_far_from_zero_are_not_taken_for_one(tmp_path):
    """Near zero all of these change nothing, and so are alike there."""
    path = tmp_path / "weirs.py"
    path.write_text(WEIRS)
    nominal = compose(ModelSpec(str(path), DT_S)).for_effects
    assert [same(nominal, "parameter_change", name, {"ratio": 0.8}) for name in ("most", "weir", "crest", "spill")] == [[]] * 4


@pytest.mark.slow
def test_a_model_that_fails_at_other_values_is_traced_all_the_same(tmp_path):
    """The right one cannot be tried; what can be lowers the error."""
    model = _model(tmp_path, narrowest=0.041)
    found = trace(_drive(model, outflow=0.05), model)
    assert ("parameter_change", "outflow") not in {(e.name, e.channel) for e in found.effects}
    assert np.std(found.after.ends) < 0.5 * np.std(found.before.ends)


FAN = """
STATES = ("speed",)
INPUTS = ("asked",)
PARAMS = {"keeps": 0.2}


def step(x, u, dt, params):
    return params["keeps"] * x + (1.0 - params["keeps"]) * u
"""


@pytest.mark.slow
def test_a_robot_that_answers_at_once_and_is_asked_for_something_else_in_every_step_is_traced(tmp_path):
    """It goes no farther in ten steps than in one, and it is not noise that moves it."""
    path = tmp_path / "fan.py"
    path.write_text(FAN)
    rng, model = np.random.default_rng(1), compose(ModelSpec(str(path), 0.1))
    u, speeds = rng.uniform(-1.0, 1.0, (1000, 1)), [0.0]
    for asked in u[:, 0]:
        speeds.append(0.2 * speeds[-1] + 0.8 * 0.4 * asked)
    noise = 0.005 * rng.normal(size=(1001, 1))
    found = trace(from_arrays(model, [(np.array(speeds)[:, None] + noise, u)]), model)
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "asked")]
    with pytest.raises(NotEnoughEvidence, match="nothing can be traced"):
        trace(from_arrays(model, [(noise, u)]), model)


def test_rollouts_are_a_second_or_ten_steps():
    assert (usual_horizon(0.02), usual_horizon(0.1), usual_horizon(2.0)) == (1.0, 1.0, 20.0)


def test_what_gives_no_numbers_on_held_out_data_is_out_of_the_question_there(tmp_path):
    """A pump that draws empties a tank that was full where the fit was, and is not where it is judged."""
    path = tmp_path / "tank.py"
    path.write_text(TANK.replace("NARROWEST", "1e9").replace("PARTS", "2").replace("level = np.maximum(level, 0.0)", "pass"))
    model = compose(ModelSpec(str(path), DT_S))
    rows, pump = np.linspace(1.0, 2.0, 61)[:, None], np.ones((60, 1))
    data = from_arrays(model, [(rows, pump)])
    here = held(model, data, steps_of(data), (), np.ones(60, dtype=bool), 10.0 * DT_S)
    given = problem(from_arrays(model, [(rows + 3.0, pump)]), steps_of(from_arrays(model, [(rows + 3.0, pump)])))
    off = compose(ModelSpec(str(path), DT_S, {}, (EffectSpec("input_bias", "pump", {"bias": -60.0}),)))
    fits = [evaluate(given, model), evaluate(given, off)]
    with np.errstate(invalid="ignore"):
        assert foretelling(here, fits) == [0.0, -math.inf]
        assert foretelling(here, fits[::-1]) == [0.0, 0.0]


def _stuck(model):
    """A tank whose valve stays until it is asked for something far enough away."""
    rng = np.random.default_rng(2)
    goal = np.repeat(rng.uniform(1.5, 6.0, 15), 100)
    level, at, total, levels, asked = 4.0, 1.5, 1.5, [4.0], []
    for wanted in goal:
        off = wanted - levels[-1]
        total = float(np.clip(total + 0.01 * off, 0.0, 4.0))
        asked.append(float(np.clip(0.5 * off + total, 0.0, 4.0)))
        at = asked[-1] if abs(asked[-1] - at) > 0.15 else at
        for _ in range(PARTS):
            level += DT_S / PARTS * (0.05 * at - 0.04 * np.sqrt(max(level, 0.0)))
        levels.append(level + NOISE_M * rng.normal())
    return from_arrays(model, [(np.array(levels)[:, None], np.array(asked)[:, None])])


@pytest.mark.slow
def test_a_valve_that_sticks_and_jumps_is_no_play(tmp_path):
    """A play follows every change but the first part of it."""
    model = _model(tmp_path)
    found = trace(_stuck(model), model)
    assert found.verdict == "unexplained"
    assert "memory(pump)" in found.depends_on


def test_a_play_is_challenged_by_what_sticks_from_reaches_near_its_own(tmp_path):
    """From those that know nothing of the play, no search comes there."""
    model = _model(tmp_path)
    data = _stuck(model)
    given = problem(data, steps_of(data))
    play = AppliedEffect(registry().get("effects", "input_backlash"), "pump", {"width": 0.15})
    better = better_shape(given, fitted(given, evaluate(given, model), insert(model, play, 0)), 20)
    assert better is not None
    assert "memory(pump)" in better.token


FLOW = """
import numpy as np

STATES = ("flow",)
INPUTS = ("valve",)
PARAMS = {"time_constant": 0.8, "most": 4.0}


def step(x, u, dt, params):
    rest = params["most"] * u
    return rest + (x - rest) * np.exp(-dt / params["time_constant"])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("reach", "short", "name"), [(0.08, 0.03, None), (0.04, 0.04, "input_backlash")], ids=["sticks", "play"])
def test_a_valve_that_jumps_and_stays_short_of_what_is_asked_is_no_play(tmp_path, reach, short, name):
    """It stays until it is asked for something beyond its reach: if it then stays as short as that, it is a play of twice the reach."""
    path = tmp_path / "flow.py"
    path.write_text(FLOW)
    model = compose(ModelSpec(str(path), 0.1))
    rng = np.random.default_rng(1)
    asked = np.repeat(rng.uniform(0.1, 0.9, 90), rng.integers(10, 30, 90))
    at, flow, rows = asked[0], 4.0 * asked[0], []
    for wanted in [*asked, asked[-1]]:
        rows.append((flow + 0.01 * rng.normal(),))
        at = wanted - math.copysign(short, wanted - at) if abs(wanted - at) > reach else at
        flow = 4.0 * at + (flow - 4.0 * at) * math.exp(-0.1 / 0.8)
    found = trace(from_arrays(model, [(np.array(rows), asked[:, None])]), model)
    assert [effect.name for effect in found.effects if found.verdict == "traced"] == ([name] if name else [])
    assert name or "memory(valve)" in found.depends_on


NARROW = """
import numpy as np

STATES = ("level",)
INPUTS = ("pump", "valve")
PARAMS = {"lift": 0.3, "outflow": 0.2}


def step(x, u, dt, params):
    if np.any(u < LEAST) or np.any(u > 1.0 - LEAST):
        raise ValueError("no such opening")
    return x + dt * (params["lift"] * u[:, :1] - params["outflow"] * u[:, 1:] * np.sqrt(np.maximum(x, 0.0)))
"""


@pytest.mark.parametrize("least", [0.05, 0.2])
def test_two_effects_may_lead_together_to_where_somebodys_model_does_not_step_although_neither_does_alone(tmp_path, least):
    path = tmp_path / "narrow.py"
    path.write_text(NARROW.replace("LEAST", repr(least)))
    model, rng = compose(ModelSpec(str(path), 0.1)), np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.2, 0.8, (40, 2)), 15, axis=0)
    levels = [2.0]
    for pump, valve in u:
        levels.append(levels[-1] + 0.1 * (0.3 * (0.1 + 0.8 * pump) - 0.2 * valve * math.sqrt(levels[-1])))
    data = from_arrays(model, [(np.array(levels)[:, None] + 1e-3 * rng.normal(size=(601, 1)), u)])
    given = problem(data, steps_of(data))
    base = evaluate(given, model)
    pair = two_together(given, Selection(base, base, 100, (), ()), _alike)
    assert pair is not None
    if least < 0.1:
        assert names(pair.fit.model) == (("input_bias", "pump"), ("input_gain", "pump"))


def test_where_somebodys_model_steps_nowhere_else_no_two_effects_are_promising(monkeypatch, tmp_path):
    model = _model(tmp_path)
    data = _drive(model, rows=100)
    given = problem(data, steps_of(data))
    base = evaluate(given, model)
    monkeypatch.setattr(screening, "foretold", lambda given, model: None)
    assert two_together(given, Selection(base, base, 100, (), ()), _alike) is None


FLYING = """
import numpy as np

STATES = ("vx", "vy", "vz")
INPUTS = ("tilt_x", "tilt_y", "thrust")
PARAMS = {"g": 9.81}


def step(x, u, dt, params):
    f = u[:, 2]
    return x + dt * np.column_stack([f * np.sin(u[:, 0]), f * np.sin(u[:, 1]), f * np.cos(u[:, 0]) * np.cos(u[:, 1]) - params["g"]])
"""


@pytest.mark.slow
def test_a_push_on_a_flying_robot_of_which_only_speeds_are_known(tmp_path):
    path = tmp_path / "flying.py"
    path.write_text(FLYING)
    model, rng, dt, rows = compose(ModelSpec(str(path), 0.02)), np.random.default_rng(4), 0.02, 1500
    v, wanted, states, inputs = np.zeros(3), np.zeros(3), [np.zeros(3)], []
    for k in range(rows):
        wanted = rng.uniform([-4.0, -4.0, -1.0], [4.0, 4.0, 1.0]) if k % 100 == 0 else wanted
        tilt = np.clip(0.12 * (wanted - states[-1])[:2], -0.4, 0.4)
        u = np.array([*tilt, 9.81 + (wanted - states[-1])[2]])
        v = v + dt * np.array([u[2] * np.sin(u[0]) + 1.2, u[2] * np.sin(u[1]) - 0.6, u[2] * np.cos(u[0]) * np.cos(u[1]) - 9.81])
        inputs.append(u)
        states.append(v + 0.01 * rng.normal(size=3))
    (found,) = trace(from_arrays(model, [(np.array(states), np.array(inputs))]), model).effects
    assert (found.name, found.channel, found.parameters["x"][3]) == ("constant_disturbance", "world", "m/s²")
    assert found.values == pytest.approx({"x": 1.2, "y": -0.6}, abs=0.02)


def test_a_flying_robots_wind_does_not_push_its_joints(tmp_path):
    path = tmp_path / "arms.py"
    path.write_text(
        'import numpy as np\nSTATES = ("vx", "vy", "q1", "w1", "q2", "w2")\nINPUTS = ("ax", "ay", "a1", "a2")\nPARAMS = {}\n'
        'RATES = {"w1": "q1", "w2": "q2"}\n\ndef step(x, u, dt, params):\n'
        "    return x + dt * np.column_stack([u[:, :2], x[:, 3], u[:, 2], x[:, 5], u[:, 3]])\n"
    )
    assert registry().get("effects", "constant_disturbance").channels(compose(ModelSpec(str(path), 0.05)).nominal) == ()


REACTOR = """
import numpy as np

STATES = ("c", "T")
INPUTS = ("q", "Tc")
PARAMS = {"k0": 7.2e10, "E_R": 8750.0, "heat": 209.2, "UA": 2.092}


def step(x, u, dt, params):
    def rates(x):
        r = params["k0"] * np.exp(-params["E_R"] / x[:, 1]) * x[:, 0]
        flow, off = u[:, 0] / 100.0, params["UA"] * (u[:, 1] - x[:, 1])
        return np.column_stack([flow * (1.0 - x[:, 0]) - r, flow * (350.0 - x[:, 1]) + params["heat"] * r + off])

    for _ in range(4):
        x = x + dt / 4 * rates(x + dt / 8 * rates(x))
    return x
"""


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(4)))
def test_a_reaction_that_runs_away_under_other_values_ends_no_trace(tmp_path, seed):
    """Rates go with e to the power of what temperature is: in a candidate's steps, and in rollouts, numbers leave what a computer holds."""
    path = tmp_path / "reactor.py"
    path.write_text(REACTOR)
    model, rng, rows = compose(ModelSpec(str(path), 0.05)), np.random.default_rng(seed), 1000
    u = np.column_stack([np.repeat(rng.uniform(95.0, 105.0, rows // 50), 50), np.repeat(rng.uniform(296.0, 303.0, rows // 40), 40)])
    robot = compose(ModelSpec(str(path), 0.005, {"UA": 0.9 * 2.092}))
    x, states = np.array([[0.55, 345.0]]), []
    for k in range(rows + 1):
        states.append(x[0])
        for _ in range(10 if k < rows else 0):
            x = robot.nominal.step(x, u[k : k + 1], 0.005, robot.parameters)
    found = trace(from_arrays(model, [(np.array(states) + rng.normal(size=(rows + 1, 2)) * [0.002, 0.15], u)]), model)
    assert {(e.name, e.channel) for e in found.effects} <= {("parameter_change", "UA")}


def test_a_rollout_from_nowhere_goes_nowhere_whatever_a_model_says_to_no_rows(tmp_path):
    path = tmp_path / "picky.py"
    path.write_text(
        'STATES, INPUTS, PARAMS = ("h",), ("q",), {}\n\ndef step(x, u, dt, params):\n    assert len(x)\n    return x + dt * u\n'
    )
    model = compose(ModelSpec(str(path), 0.1))
    act = Acting(np.zeros((5, 1)), np.zeros((5, 1)))
    assert wherever(model, np.zeros((0, 1)), act, np.arange(0)).shape == (0, 1)


POOL = """
import numpy as np

STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"lift": 0.05, "outflow": 0.04}


def step(x, u, dt, params):
    return x + dt * (params["lift"] * u - params["outflow"] * np.sqrt(np.maximum(x, 0.0)))
"""
"""In one Euler step, however long."""


def _pool(tmp_path, text=POOL):
    file = tmp_path / "pool.py"
    file.write_text(text)
    return compose(ModelSpec(str(file), 8.0))


def _flowing(model, outflow=0.04, rows=800, seed=0):
    """A pool that flows: in a hundredth of the model's step."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 2.5, (rows // 10, 1)), 10, axis=0)
    level, y = 2.0, [2.0]
    for pump in u[:, 0].tolist():
        for _ in range(100):
            level += 0.08 * (0.05 * pump - outflow * math.sqrt(max(level, 0.0)))
        y.append(level)
    return from_arrays(model, [(np.array(y)[:, None] + rng.normal(size=(rows + 1, 1)) * 0.003, u)])


def test_an_own_model_whose_steps_are_too_coarse_is_told_so_and_gets_no_other_valves(tmp_path):
    model = _pool(tmp_path)
    result = trace(_flowing(model), model)
    assert [(e.name, e.channel) for e in result.effects] == [("integration_scheme", "*")]
    assert "the model uses Euler integration" in result.text()


def test_what_else_is_wrong_is_told_beside_it_as_large_as_it_is(tmp_path):
    model = _pool(tmp_path)
    result = trace(_flowing(model, outflow=0.046), model)
    assert {(e.name, e.channel) for e in result.effects} == {("integration_scheme", "*"), ("parameter_change", "outflow")}
    ratio = next(e for e in result.effects if e.name == "parameter_change").parameters["ratio"]
    assert ratio[0] == pytest.approx(1.15, rel=2e-3)


@pytest.mark.parametrize("name", ["joint", "double_integrator"])
def test_a_model_that_is_exact_is_not_asked_how_it_integrates(name):
    assert not steps_coarsely(compose(ModelSpec(name, 0.1)).nominal)


def test_how_an_own_model_integrates_is_asked_of_its_steps_alone(tmp_path):
    assert steps_coarsely(_pool(tmp_path).nominal)
    exact = POOL.replace("x + dt * (params[", "x * np.exp(-dt) + (1.0 - np.exp(-dt)) * (params[").replace(
        "np.sqrt(np.maximum(x, 0.0))", "1.0"
    )
    assert not steps_coarsely(_pool(tmp_path, exact).nominal)
    nowhere = POOL.replace("np.maximum(x, 0.0)", "np.where(x < 1e9, np.nan, x)")
    assert not steps_coarsely(_pool(tmp_path, nowhere).nominal)


@pytest.mark.slow
def test_a_step_in_parts_is_off_by_a_higher_power_of_its_length(tmp_path):
    """Against a solution in ten thousand steps: a step of Euler's is off by its square, one in parts by its fourth power."""
    model = _pool(tmp_path)
    finer = integrating(model.nominal, "exact")
    x, u, p = np.array([[1.0], [3.0]]), np.array([[1.0], [0.2]]), model.nominal.parameters

    def off(bound, dt):
        true = x
        for _ in range(10_000):
            true = model.nominal.step(true, u, dt / 10_000, p)
        return np.max(np.abs(bound.step(x, u, dt, p) - true))

    assert off(model.nominal, 8.0) / off(model.nominal, 4.0) == pytest.approx(4.0, rel=0.1)
    assert off(finer, 8.0) / off(finer, 4.0) == pytest.approx(16.0, rel=0.25)
    assert off(finer, 8.0) < 0.01 * off(model.nominal, 8.0)


def test_a_step_in_parts_is_the_same_whether_the_file_brings_headings_back_into_one_turn(tmp_path):
    text = """
import numpy as np

STATES = ("theta", "w")
INPUTS = ("u",)
PARAMS = {}
ANGLES = ("theta",)


def step(x, u, dt, params):
    theta = x[:, 0] + dt * x[:, 1]
    return np.column_stack([BACK, x[:, 1] + dt * 5.0 * (u[:, 0] - x[:, 1])])
"""
    models = []
    for name, back in (("turns.py", "theta"), ("one_turn.py", "np.arctan2(np.sin(theta), np.cos(theta))")):
        (tmp_path / name).write_text(text.replace("BACK", back))
        models.append(integrating(compose(ModelSpec(str(tmp_path / name), 0.1)).nominal, "exact"))
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(-np.pi, np.pi, 20_000), rng.uniform(-3.0, 3.0, 20_000)])
    free, kept = (model.step(x, np.zeros((20_000, 1)), 0.1, {}) for model in models)
    off = np.remainder(kept - free + np.pi, 2.0 * np.pi) - np.pi
    assert np.max(np.abs(off)) < 1e-9


def test_where_a_frozen_state_would_lead_to_no_numbers_the_trace_goes_on(tmp_path):
    model = _pool(tmp_path, POOL.replace("np.maximum(x, 0.0)", "np.where(x < 0.0, np.nan, x)"))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.5, 2.5, (40, 1)), 10, axis=0)
    u[200:300] = 0.0
    level, y = 2.0, [2.0]
    for pump in u[:, 0].tolist():
        level += 8.0 * (0.05 * pump - 0.01 * math.sqrt(max(level, 0.0)))  # it drains at a quarter of what the model says
        y.append(max(level, 0.0))
    y = np.array(y)[:, None] + rng.normal(size=(401, 1)) * 0.003
    y[210:290] = y[210]
    assert trace(from_arrays(model, [(y, u)]), model).verdict in {"none", "traced", "ambiguous", "unexplained", "sensor_fault"}


def test_rows_of_which_a_model_makes_no_numbers_are_not_looked_for_one_by_one(tmp_path):
    path = tmp_path / "runs_away.py"
    path.write_text(
        "import numpy as np\nSTATES, INPUTS, PARAMS, CALLS = ('x', 'v'), ('u',), {}, []\n\n\n"
        "def step(x, u, dt, p):\n    CALLS.append(len(x))\n"
        "    return np.column_stack([x[:, 0] + dt * x[:, 1], np.where(x[:, 0] > 0.9, np.inf, x[:, 1] + dt * u[:, 0])])\n"
    )
    model = compose(ModelSpec(str(path), 0.1))
    calls = model.nominal.shared.function.__globals__["CALLS"]
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (1000, 2)), rng.uniform(-1.0, 1.0, (1000, 1))
    calls.clear()
    there = wherever(model, x, Acting(u, u), slice(None))
    gone = x[:, 0] > 0.9
    assert 10 < np.count_nonzero(gone) < 200
    assert np.array_equal(there[gone], x[gone])
    assert np.allclose(there[~gone], np.column_stack([x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]])[~gone], atol=1e-15)
    assert calls == [1000, 1000 - np.count_nonzero(gone)]
