"""How much evidence a name takes: about where the robot was, over all of a recording, however much noise scatters, within steps."""

import math

import numpy as np
import pytest
from scipy.stats import beta, chi2
from test_trace_for_a_while import _held
from trace_robots import commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace import second_search, verdict
from s2r_runtime.trace.data.dataset import from_arrays, from_streams
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import SCORE_BLOCKS, evaluate, fitted, gain, insert, nearer, problem
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection import stepwise
from s2r_runtime.trace.selection.acceptance import BY_CHANCE, _scattered
from s2r_runtime.trace.selection.scores import STRICT
from s2r_runtime.trace.selection.stepwise import Selection

DT = 0.005
SPEC = ModelSpec("double_integrator", DT, {}, ())
SIGMA, PUSH = np.array([0.09, 0.05, 0.01, 0.09]), 10.0
"""Of the sensors (m, m, m/s, m/s); and of what pushes the robot, m/s^2 a step."""


def _sled(stiffness, steps=318, seed=0, sigma=SIGMA, push=PUSH, parts=10):
    """A sled between springs of which the force grows with the third power, integrated in parts of a step by hand."""
    rng = np.random.default_rng(seed)
    u = _held(rng, steps, [-9.0, -9.0], [9.0, 9.0])
    x, v = np.array([0.5, -0.3]), np.zeros(2)
    rows = [np.array([*x, *v])]
    for asked in u:
        noise = push * rng.normal(size=2)
        for _ in range(parts):
            a = asked + noise - np.array([stiffness * x[0] ** 3, 0.0])
            x, v = x + v * DT / parts + 0.5 * a * (DT / parts) ** 2, v + a * DT / parts
        rows.append(np.array([*x, *v]))
    return np.array(rows) + rng.normal(size=(steps + 1, 4)) * sigma, u


def _given(y, u):
    model = compose(SPEC)
    data = from_arrays(model, [(y, u)])
    return problem(data, steps_of(data)), model


def _with(model, name, channel, parameters):
    effect = compose(ModelSpec(SPEC.name, DT, {}, (EffectSpec(name, channel, parameters),))).effects[0]
    return insert(model, effect, 0)


def test_a_spring_is_told_from_pushes_where_positions_are_noisy():
    """About where its sensors say that it was, the law of pushes that remember explains nearly as much as the spring does."""
    y, u = _sled(450.0)
    given, model = _given(y, u)
    base = evaluate(given, model)
    fit = fitted(given, base, _with(model, "cubic_stiffness", "x", {"coefficient": 450.0}))
    assert fit.white - base.white > 3.0 * gain(fit, base)
    assert nearer(given, fit, base) > 0.5 * gain(fit, base) > 0.0


@pytest.mark.slow
def test_a_spring_that_noise_hides_is_named(monkeypatch):
    """And would not be, were it asked only where the sensors say that the robot is."""
    y, u = _sled(450.0, steps=260, seed=10, sigma=np.array([0.09, 0.05, 0.005, 0.09]), push=20.0)
    model = compose(SPEC)
    data = from_arrays(model, [(y, u)])
    result = trace(data, model)
    assert [e.name for e in result.spec.effects] == ["cubic_stiffness"]
    assert result.spec.effects[0].parameters["coefficient"] == pytest.approx(450.0, rel=0.1)
    monkeypatch.setattr(stepwise, "nearer", lambda *_: 0.0)
    assert trace(data, model).verdict == "unexplained"


@pytest.mark.slow
def test_what_is_not_there_explains_no_more_where_the_robot_was():
    """Effects that are not there: what a noisy state adds to the best they do is a sixth of what a name takes, at the most."""
    most = 0.0
    for seed in range(10):
        y, u = _sled(0.0, seed=10 + seed)
        given, model = _given(y, u)
        base = evaluate(given, model)
        for name, parameters in (("cubic_stiffness", {"coefficient": 1.0}), ("quadratic_drag", {"coefficient": 0.1})):
            fit = fitted(given, base, _with(model, name, "x" if name == "cubic_stiffness" else "vx", parameters))
            most = max(most, nearer(given, fit, base))
    assert most < STRICT.needed(200, 1, 318) / 6.0


def test_scores_of_white_noise_seldom_scatter_beyond_their_lower_bound():
    """The bound is the chi-squared one: as often as BY_CHANCE, for one number and for several, and never far."""
    rng, sets = np.random.default_rng(3), 4000
    for numbers in (1, 3):
        ratios = np.sqrt(rng.chisquare(SCORE_BLOCKS, size=(sets, numbers)) / SCORE_BLOCKS)
        more = np.array([_scattered(one, False) for one in ratios])
        often = int(np.sum(more > 1.0))
        low, high = beta.ppf([5e-4, 1 - 5e-4], [often, often + 1], [sets - often + 1, sets - often])
        assert low < 1.0 - (1.0 - BY_CHANCE / numbers) ** numbers < high
        assert np.quantile(more, 0.999) < 2.0


def test_scores_that_scatter_cost_as_much_as_they_surely_do():
    """Continuous where chance ends, and exact beyond: a ratio of variances of 9 is one of at least 9 / 1.83."""
    bound = chi2.ppf(1.0 - BY_CHANCE, SCORE_BLOCKS) / SCORE_BLOCKS
    assert _scattered(np.array([math.sqrt(1.001 * bound)]), False) == pytest.approx(1.001)
    assert _scattered(np.array([math.sqrt(0.999 * bound)]), False) == 1.0
    assert _scattered(np.array([3.0]), False) == pytest.approx(9.0 / bound)
    assert _scattered(np.array([3.0]), True) == pytest.approx(9.0)


@pytest.mark.parametrize("seed", [1, 5])
def test_what_only_all_of_a_recording_shows_is_named(seed, monkeypatch):
    """A gain of 0.98 under 6 mm of noise: too little on what is fitted, and on what is held out, enough on both under one law of noise."""
    rng = np.random.default_rng(seed)
    model = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    u = commands(rng, 1, 300, 0.05, [(-0.5, 0.5), (-1.5, 1.5)])
    y = drive(rng, "unicycle", u, (("input_gain", "v", {"gain": 0.98}),), 0.05, np.array([0.006, 0.006, 0.01]))
    data = from_arrays(model, [(y[0], u[0])])
    result = trace(data, model)
    assert result.verdict in {"traced", "ambiguous"}
    assert "input_gain" in {e.name for e in result.spec.effects}
    monkeypatch.setattr(verdict, "_of_all", lambda *_: 0.0)
    assert trace(data, model).verdict in {"none", "unexplained"}


def test_what_is_foretold_worse_is_no_name_however_well_it_fits():
    """Asked where the robot was, a spring explains enough of what was fitted; what was not fitted has the last word."""
    y, u = _sled(450.0, seed=2, sigma=np.array([0.09, 0.05, 0.005, 0.09]), push=15.0)
    given, model = _given(y, u)
    none_yet = Selection(evaluate(given, model), evaluate(given, model), 200, (), ())
    assert stepwise.one_more(given, none_yet, 20, lambda fit, base: 1.0).fit.added
    for foretold in (0.0, -3.0, -math.inf):
        assert stepwise.one_more(given, none_yet, 20, lambda fit, base, told=foretold: told) is none_yet


def _late(u, start, step, dt, share=0.7, parts=50):
    """(rows, nx) of a robot that each command reaches a share of a step after the row."""
    x, rows = start, [start]
    for k in range(len(u)):
        for i in range(parts):
            x = step(x, u[k] if i >= share * parts else u[k - 1] * (k > 0), dt / parts)
        rows.append(x)
    return np.array(rows)


def _mass(x, a, h):
    return np.array([*(x[:2] + x[2:] * h + 0.5 * a * h * h), *(x[2:] + a * h)])


def _wheels(x, u, h):
    heading = x[2] + 0.5 * h * u[1]
    return x + np.array([u[0] * math.cos(heading), u[0] * math.sin(heading), u[1]]) * h


def _streams(model, y, u, dt):
    t = dt * np.arange(len(y))
    return from_streams(model, [(Stream(t, y), Stream(t[:-1] + 0.7 * dt, u))], "here")


def test_what_commands_do_within_steps_is_no_structure():
    """They come 14 ms after each row, 20 ms apart. Positions are told to 0.1 mm, and a mean over the step is farther off."""
    rng = np.random.default_rng(4)
    u = _held(rng, 400, [-2.0, -2.0], [2.0, 2.0])
    y = _late(u, np.zeros(4), _mass, 0.02) + rng.normal(size=(401, 4)) * [7e-5, 7e-5, 1e-4, 1e-4]
    model = compose(ModelSpec("double_integrator", 0.02, {}, ()))
    data = _streams(model, y, u, 0.02)
    result = trace(data, model)
    assert result.verdict == "none", result.text()
    assert "each step in 10 parts" in result.text()
    assert result.to_json()["step_parts"] == 10
    judged = trace(data, model, test=from_arrays(model, [(y, u)]))  # arrays have no stamps: their inputs change with their rows
    assert len(judged.held.steps) == 400


def test_parts_in_which_a_model_gives_no_numbers_are_no_reason(monkeypatch):
    """What was left by whole steps stays left, and the trace ends."""
    rng = np.random.default_rng(4)
    u = _held(rng, 400, [-2.0, -2.0], [2.0, 2.0])
    y = _late(u, np.zeros(4), _mass, 0.02) + rng.normal(size=(401, 4)) * [7e-5, 7e-5, 1e-4, 1e-4]
    model = compose(ModelSpec("double_integrator", 0.02, {}, ()))
    monkeypatch.setattr(second_search, "foretold", lambda given, model: None)
    result = trace(_streams(model, y, u, 0.02), model)
    assert result.verdict == "unexplained"
    assert result.to_json()["step_parts"] == 1


@pytest.mark.parametrize("seed", [4, 6])
def test_a_model_of_coarse_steps_is_not_judged_on_finer_ones(seed):
    """Commands come within steps of a model that goes straight in each, which is what it lacks. In parts it would lack that less."""
    rng = np.random.default_rng(seed)
    u = _held(rng, 400, [0.2, -2.0], [1.0, 2.0], hold=3 if seed == 4 else 2)
    y = _late(u, np.zeros(3), _wheels, 0.1) + 1.5e-3 * rng.normal(size=(401, 3))
    model = compose(ModelSpec("unicycle", 0.1, {}, ()))
    result = trace(_streams(model, y, u, 0.1), model)
    assert [e.name for e in result.effects] == ["integration_scheme"]
    assert result.to_json()["step_parts"] == 1
