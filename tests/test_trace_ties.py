"""Which explanations tie, which one is the likeliest, and two effects that hide each other."""

from dataclasses import replace

import numpy as np
import pytest
from test_trace_for_a_while import DT, _held, _unicycle
from trace_sets.families import make

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace import second_search, verdict
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.rollout_error import Judged, held
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, gain, insert, problem
from s2r_runtime.trace.pipeline import load_dataset, trace
from s2r_runtime.trace.selection.acceptance import _scattered
from s2r_runtime.trace.selection.scores import Scored, _search, names, unlimited
from s2r_runtime.trace.selection.shared_dependence import any_shape_of
from s2r_runtime.trace.selection.stepwise import Selection, doing_something
from s2r_runtime.trace.selection.ties import SURELY, rivals_of, simplified, tied
from s2r_runtime.trace.verdict import confirmed, harms

pytestmark = pytest.mark.slow

UNICYCLE = ModelSpec("unicycle", DT, {}, ())


def _problem(u, share=lambda k, x: 0.8):
    model = compose(UNICYCLE)
    data = from_arrays(model, [(_unicycle(np.random.default_rng(12), u, share, "euler"), u)])
    return problem(data, steps_of(data)), model


def _with(given, model, name, channel, **p):
    bare = evaluate(given, model)
    return fitted(given, bare, insert(model, AppliedEffect(registry().get("effects", name), channel, p), 0))


def test_what_was_not_fitted_decides_between_explanations_that_tie():
    """At one speed a gain and an offset are one thing; on the other part of the recording one of them foretells more, or both as much."""
    u = np.column_stack([np.full(400, 0.3), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    one, other = _with(given, model, "input_gain", "v", gain=0.8), _with(given, model, "input_bias", "v", bias=-0.06)
    assert abs(gain(other, one)) < 0.5
    found = [Scored("input_bias", "v", 1.0, other)]
    assert tied(given, one, found, [0.0, 0.0]) == (one, found)
    assert tied(given, one, found, [0.0, -20.0]) == (one, [])
    assert tied(given, one, found, [0.0, 20.0]) == (other, [])
    best, rest = tied(given, one, found, [0.0, 2.0])
    assert best is other
    assert [(s.name, s.channel, s.fit) for s in rest] == [("input_gain", "v", one)]


def test_ties_of_one_effect_outlast_another_one_that_gives_way(monkeypatch):
    """What was held out says of w that it is an offset: on v, where a gain and an offset are one thing, they still tie, beside that."""
    u = np.column_stack([np.full(400, 0.3), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    gain_v = _with(given, model, "input_gain", "v", gain=0.8).model
    bias_v = _with(given, model, "input_bias", "v", bias=-0.06).model
    bare = evaluate(given, model)
    both = fitted(given, bare, _more(gain_v, "input_gain", "w", gain=0.9))
    on_v, on_w = (fitted(given, bare, m) for m in (_more(bias_v, "input_gain", "w", gain=0.9), _more(gain_v, "input_bias", "w", bias=0.01)))
    found = [Scored("input_bias", "v", 1.0, on_v), Scored("input_bias", "w", 1.0, on_w)]

    def of_w(_, fits):
        return [500.0 * (("input_bias", "w") in names(fit.model)) for fit in fits]

    monkeypatch.setattr(verdict, "foretelling", of_w)
    third = fitted(given, bare, _more(bias_v, "input_bias", "w", bias=0.01))  # has the winner in the place of another effect
    best, ties = verdict._likeliest(given, both, [*found, Scored("input_bias", "v", 1.0, third)], None)
    assert [names(s.fit.model) for s in ties].count((("input_bias", "v"), ("input_bias", "w"))) >= 1
    best, ties = verdict._likeliest(given, both, found, None)
    assert names(best.model) == (("input_bias", "w"), ("input_gain", "v"))
    assert [(s.name, s.channel, names(s.fit.model)) for s in ties] == [("input_bias", "v", (("input_bias", "v"), ("input_bias", "w")))]


def _more(model, name, channel, **p):
    return insert(model, AppliedEffect(registry().get("effects", name), channel, p), len(model.effects))


@pytest.mark.parametrize(("white", "behind", "tie"), [(40.0, 8.0, True), (12.0, 8.0, False), (40.0, 30.0, False), (-40.0, 8.0, False)])
def test_what_only_the_colour_of_noise_decides_is_not_decided(white, behind, tie):
    """By noise without a memory the other one is likelier by `white`, by noise with one it is less likely by `behind`: nobody knows which
    law holds of a rig whose model is coarse."""
    u = np.column_stack([np.full(400, 0.3), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    one = _with(given, model, "input_gain", "v", gain=0.8)
    other = replace(_with(given, model, "input_bias", "v", bias=-0.06), white=one.white + white, coloured=one.coloured - behind)
    found = [Scored("input_bias", "v", 1.0, other)]
    assert tied(given, one, found, [0.0, 0.0]) == (one, found if tie else [])


def test_what_many_explanations_share_is_all_that_is_known():
    """Of an input at one speed a gain, an offset and a limit say one thing; two may be just the two that are there."""
    u = np.column_stack([np.full(400, 0.3), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    one = _with(given, model, "input_gain", "v", gain=0.8)
    other, limit = _with(given, model, "input_bias", "v", bias=-0.06), _with(given, model, "input_saturation", "v", high=0.24)
    lag, late = _with(given, model, "input_lag", "w", time_constant=0.1), _with(given, model, "input_delay", "w", delay=0.1)
    ramp = _with(given, model, "input_rate_limit", "w", rate=3.0)
    assert any_shape_of(one, [other, limit], given.data, given.steps) == ("v",)
    assert any_shape_of(one, [other], given.data, given.steps) == ()
    push, drag = (
        _with(given, model, "constant_disturbance", "body", x=-0.06, y=0.0),
        _with(given, model, "quadratic_drag", "v", coefficient=0.6),
    )
    assert any_shape_of(one, [push, other, drag], given.data, given.steps) == ("v",), "the push is the offset by another name"
    assert any_shape_of(late, [lag, ramp], given.data, given.steps) == ("memory(w)",)
    assert any_shape_of(one, [other, late], given.data, given.steps) == ()
    assert any_shape_of(one, [other, limit, late], given.data, given.steps) == ("v",), "one that is about something else does not matter"


def test_what_ties_is_seen_however_large_the_error_was():
    """A force of two values on a mass, measured to a ten-thousandth: under the noise that the mass as given needs, everything looks like
    next to nothing of what it explains under its own.
    """
    rng = np.random.default_rng(5)
    u = np.where(np.repeat(rng.random(60) < 0.5, 15), -0.5, 0.5)[:, None]
    model = compose(ModelSpec("joint", 0.1, {"mass": 2.0}, ()))
    y = np.zeros((len(u) + 1, 2))
    for k, force in enumerate(0.8 * u[:, 0]):
        y[k + 1] = y[k] + [0.1 * y[k, 1] + 0.005 * force / 2.0, 0.1 * force / 2.0]
    found = trace(from_arrays(model, [(y + rng.normal(0.0, 1e-4, y.shape), u)]), model)
    assert found.verdict == "ambiguous"
    there = {(e.name, e.channel) for e in (*found.effects, *found.ambiguous_with)}
    assert {("input_gain", "force"), ("input_deadband", "force"), ("input_saturation", "force")} <= there


def test_four_numbers_that_come_near_to_one_are_no_rival_of_it():
    """A sine of any frequency, size and phase, on a drive in which the speed goes up and down: one gain foretold that."""
    u = np.column_stack([0.3 + 0.2 * np.sin(0.1 * np.arange(400)), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    one = _with(given, model, "input_gain", "v", gain=0.8)
    assert one.k == 1
    many = _with(given, model, "input_gain", "v", gain=0.8)
    object.__setattr__(many, "free", many.free * 4)
    found = [Scored("periodic_disturbance", "v", 1.0, many)]
    assert 3 * 0.5 * np.log(400) > SURELY
    assert tied(given, one, found, [0.0, 0.0]) == (one, [])


def test_a_gain_of_what_was_never_commanded_makes_no_tie():
    """The robot only ever drove forward: a gain by sign says the same of that, and nothing of the rest."""
    rng = np.random.default_rng(13)
    given, model = _problem(_held(rng, 500, [0.1, -1.0], [0.5, 1.0]))
    one = _with(given, model, "input_gain", "v", gain=0.8)
    assert "input_gain_asymmetry" not in {s.name for place in one.added for s in rivals_of(given, one, place)}


@pytest.mark.parametrize(("velocity", "gone"), [(1e-9, True), (0.02, False)])
def test_a_curve_that_shrank_to_a_point_is_none(velocity, gone):
    """Friction that is larger at standstill only is seen by nobody."""
    model = compose(ModelSpec("joint", DT, {"mass": 1.0}, ()))
    rng = np.random.default_rng(14)
    data = from_arrays(model, [(rng.normal(size=(100, 2)), rng.normal(size=(99, 1)))])
    given = problem(data, steps_of(data))
    p = {"force": 0.1, "static_force": 0.3, "velocity": velocity}
    there = evaluate(given, insert(model, AppliedEffect(registry().get("effects", "stribeck_friction"), "qd", p), 0))
    assert unlimited(there, 0) is gone


@pytest.mark.parametrize(("static", "name"), [(0.41, "coulomb_friction"), (0.9, "stribeck_friction")])
def test_dry_friction_that_is_hardly_larger_at_rest_is_dry_friction(static, name):
    """A filter in a recorded speed bends a line by as much."""
    model, rng = compose(ModelSpec("joint", DT, {"mass": 1.0}, ())), np.random.default_rng(16)
    p = {"force": 0.4, "static_force": static, "velocity": 0.3}
    robot = insert(model, AppliedEffect(registry().get("effects", "stribeck_friction"), "qd", p), 0)
    u = np.repeat(rng.uniform(-2.0, 2.0, (60, 1)), 10, axis=0)
    rows = [np.zeros((1, 2))]
    for k in range(len(u)):
        rows.append(robot.advance(rows[-1], u[k : k + 1], u[k : k + 1]))
    data = from_arrays(model, [(np.concatenate(rows) + rng.normal(size=(len(u) + 1, 2)) * 1e-4, u)])
    given = problem(data, steps_of(data))
    assert names(simplified(given, evaluate(given, robot)).model) == ((name, "qd"),)


@pytest.mark.parametrize(
    ("seed", "names"),
    [(20014, {"periodic_disturbance", "input_bias"}), (20011, {"periodic_disturbance", "cubic_stiffness"})],
    ids=["hidden", "short"],
)
def test_the_second_of_two_effects_is_found(tmp_path, seed, names):
    """On a joint: a steady push and one that swings, beside either of which what is left scatters too much for the other; and a spring that
    only all of the recording shows.
    """
    found = _traced_pair(tmp_path, seed)
    assert found.verdict == "traced"
    assert {e.name for e in found.effects} == names


def test_two_effects_that_foretell_no_better_what_was_not_fitted_are_not_taken(tmp_path, monkeypatch):
    """However little structure they leave."""
    monkeypatch.setattr(second_search, "foretelling", lambda judged_on, fits: [0.0] + [-1.0] * (len(fits) - 1))
    found = _traced_pair(tmp_path, 20014)
    assert not found.effects
    assert found.verdict == "unexplained"


@pytest.mark.parametrize(("ratios", "taken"), [([1.3], 1.0), ([1.0, 1.4], 1.0), ([1.4], 1.96), ([1.0, 2.0], 4.0), ([], 1.0)])
def test_scores_of_ten_blocks_scatter_by_as_much_as_chance_makes_them(ratios, taken):
    """Of one number, 1.35 times in one of 20 recordings; of two, 1.43 times."""
    assert _scattered(np.array(ratios), True) == pytest.approx(taken)


def _traced_pair(folder, seed):
    return _traced(folder, "pair", seed)


def _traced(folder, family, seed):
    made = make(family, seed)
    path, _ = made.write(folder)
    m = made.model
    model = compose(ModelSpec(m["name"], m["dt"], m["parameters"], tuple(EffectSpec(**e) for e in m["effects"])))
    return trace(load_dataset(path, model), model)


@pytest.mark.slow
def test_what_is_named_is_asked_again_where_rollouts_go_astray(tmp_path):
    """A drift of all inputs, and a change that undoes it on one, leave what looks like noise; a drift and a gain leave nothing."""
    found = _traced_pair(tmp_path, 68110)
    assert found.verdict == "traced"
    assert {(e.name, e.channel) for e in found.effects} == {("input_gain_drift", "v"), ("input_gain", "w")}


def test_a_repair_that_makes_rollouts_worse_is_none():
    """However much better a single step is; a speed that nobody measured says nothing."""
    rng = np.random.default_rng(15)
    noise, floor = rng.normal(size=(400, 2)), np.ones(2)
    near, far = Judged(noise, noise), Judged(0.5 * noise, 1.2 * noise)
    assert harms(near, far, floor)
    assert not harms(near, Judged(noise, 1.05 * noise), floor)
    assert not harms(far, near, floor)
    assert not harms(near, Judged(noise, noise * [1.0, 9.0]), np.array([1.0, np.inf]))


def test_a_ramp_that_is_over_within_a_step_is_no_delay():
    """Wheels that are measured, at changes a step that the ramp catches up with in a third of it."""
    rng = np.random.default_rng(16)
    t = 0.04 * np.arange(500)
    u = 3.0 * np.column_stack([np.sin(1.3 * t) + np.sin(2.9 * t), np.sin(1.7 * t + 1.0) + np.sin(3.1 * t)])
    model = compose(ModelSpec("differential_drive", 0.04, {}, ()))
    true = compose(ModelSpec("differential_drive", 0.04, {}, (EffectSpec("input_rate_limit", "cmd_right", {"rate": 45.0}),)))
    x, hidden, rows = np.zeros((1, 5)), true.at_rest(1), [np.zeros(5)]
    for row in u:
        x, hidden = true.step(x, row[None, :], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(501, 5)) * [1e-3, 1e-3, 1e-3, 5e-3, 5e-3]
    found = trace(from_arrays(model, [(y, u)]), model)
    assert [(e.name, e.channel) for e in found.effects] == [("input_rate_limit", "cmd_right")]
    assert found.effects[0].parameters["rate"][0] == pytest.approx(45.0, rel=0.1)


def test_rivals_are_those_of_what_held_out_data_confirm():
    """Where an effect is dropped there, rivals of the model with both say nothing of the one that is left."""
    u = np.column_stack([np.full(400, 0.3), _held(np.random.default_rng(11), 400, [-1.0], [1.0])[:, 0]])
    given, model = _problem(u)
    both = evaluate(given, insert(_with(given, model, "input_gain", "v", gain=0.8).model, _bias(), 0))
    here = held(model, given.data, given.steps, (), np.ones(400, dtype=bool), 1.0)
    found = [Scored("input_bias", "v", 1.0, evaluate(given, insert(both.model, _bias("v"), 0)))]
    chosen = Selection(evaluate(given, model), both, 100, (), tuple(found))
    left = confirmed(given, chosen, here)
    assert {left.fit.model.effects[i].effect.name for i in left.fit.added} <= {
        "input_gain",
        "input_bias",
        "quadratic_drag",
        "input_deadband",
    }
    assert left.rivals
    assert all(len(s.fit.added) == len(left.fit.added) == 1 for s in left.rivals)


def test_what_has_an_effect_more_beside_one_that_does_nothing_is_no_tie(monkeypatch):
    """A gain of 1 of the turning is not told. A model with a bias in its place, a little likelier, has then one effect more than what is
    told, and none of what is told is gone from it.
    """
    u = _held(np.random.default_rng(11), 400, [0.1, -1.0], [0.5, 1.0])
    given, model = _problem(u)
    gain_of = registry().get("effects", "input_gain")
    one = fitted(given, evaluate(given, model), insert(model, AppliedEffect(gain_of, "v", {"gain": 0.8}), 0))
    fit = evaluate(given, insert(one.model, AppliedEffect(gain_of, "w", {"gain": 1.0}), 0))
    with_bias = evaluate(given, insert(one.model, AppliedEffect(registry().get("effects", "input_bias"), "w", {"bias": 1e-3}), 0))
    told = doing_something(given, fit)
    assert [told.model.effects[i].channel for i in told.added] == ["v"]
    likelier = replace(with_bias, white=told.white + 4.5, coloured=told.coloured + 4.5)
    for name in ("asked", "_once"):
        monkeypatch.setattr(verdict, name, lambda *_: False)
    monkeypatch.setattr(verdict, "foretelling", lambda judged_on, fits: [0.0 for _ in fits])
    here = held(model, given.data, given.steps, (), np.ones(400, dtype=bool), 1.0)
    chosen = Selection(evaluate(given, model), fit, 100, (), (Scored("input_bias", "w", 1.0, likelier),))
    left = confirmed(given, chosen, here)
    assert [left.fit.model.effects[i].channel for i in left.fit.added] == ["v"]
    assert left.rivals == ()


def _bias(channel="w"):
    return AppliedEffect(registry().get("effects", "input_bias"), channel, {"bias": 1e-9})


def test_a_search_beside_another_scheme_is_another_one():
    """Names and channels are the same; what is fitted beside one model says nothing of what the other one leaves."""
    rng = np.random.default_rng(3)
    given, model = _problem(np.column_stack([_held(rng, 300, [-0.5], [0.5])[:, 0], _held(rng, 300, [-1.0], [1.0])[:, 0]]))
    ways = [_with(given, model, "integration_scheme", "*", scheme=scheme) for scheme in ("exact", "rk4")]
    assert _search(given, ways[0]) is not _search(given, ways[1])
    assert _search(given, ways[0]) is _search(given, ways[0])


@pytest.mark.parametrize(("back", "told"), [(0.402, {"force"}), (0.41, {"force_positive", "force_negative"})])
def test_friction_that_is_a_fortieth_more_one_way_has_two_numbers(back, told):
    """As a measured joint of a robot has it; to a hundredth, one number says as much."""
    model = compose(ModelSpec("joint", DT, {"mass": 1.0}, ()))
    robot = insert(
        model, AppliedEffect(registry().get("effects", "coulomb_friction"), "qd", {"force_positive": 0.4, "force_negative": back}), 0
    )
    u = np.repeat(np.random.default_rng(17).uniform(-2.0, 2.0, (40, 1)), 10, axis=0)
    rows = [np.zeros((1, 2))]
    for k in range(len(u)):
        rows.append(robot.advance(rows[-1], u[k : k + 1], u[k : k + 1]))
    data = from_arrays(model, [(np.concatenate(rows), u)])
    given = problem(data, steps_of(data))
    assert set(simplified(given, evaluate(given, robot)).model.effects[0].p) == told


@pytest.mark.parametrize(("linear", "cubic", "shape"), [(-3.0, -2.0, ("position",)), (3.0, 2.0, ("position",)), (-3.0, 2.0, ())])
def test_springs_that_pull_against_each_other_are_how_many_a_force_begins(linear, cubic, shape):
    """A sine is x less a sixth of its cube near zero, and something else far from there. A spring that stiffens is one."""
    rng = np.random.default_rng(12)
    y = np.column_stack([rng.uniform(-0.5, 0.5, (201, 2)), rng.normal(size=(201, 2))])
    model = compose(ModelSpec("double_integrator", 0.05))
    data = from_arrays(model, [(y, rng.normal(size=(200, 2)))])
    given = problem(data, steps_of(data))
    field = _more(model, "position_field", "*", matrix=[[linear, 0.0], [0.0, 0.0]])
    both = evaluate(given, _more(field, "cubic_stiffness", "x", coefficient=cubic))
    elsewhere = evaluate(given, _more(field, "cubic_stiffness", "y", coefficient=cubic))
    assert any_shape_of(both, [], data, given.steps) == shape
    assert any_shape_of(elsewhere, [], data, given.steps) == ()


def test_a_rival_that_is_gone_on_with_has_no_numbers_that_it_does_not_need(monkeypatch):
    """Dry friction by direction, likelier by chance, gives way to one that is larger at rest by next to nothing: that is dry friction."""
    rng, model = np.random.default_rng(13), compose(ModelSpec("joint", 0.05))
    robot, x, rows = _more(model, "coulomb_friction", "qd", force=0.4), np.zeros((1, 2)), [np.zeros(2)]
    u = np.repeat(rng.uniform(-2.0, 2.0, (60, 1)), 10, axis=0)
    for one in u:
        x = robot.step(x, one[None], robot.at_rest(1))[0]
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(601, 2)) * [1e-3, 0.01], u)])
    given = problem(data, steps_of(data))
    by_direction = _with(given, model, "coulomb_friction", "qd", force_positive=0.42, force_negative=0.38)
    at_rest = evaluate(given, _more(model, "stribeck_friction", "qd", force=0.4, static_force=0.4003, velocity=1.0))
    chosen = Selection(evaluate(given, model), by_direction, 100, (), (Scored("stribeck_friction", "qd", 1.0, at_rest),))
    monkeypatch.setattr(verdict, "_likeliest", lambda given, fit, found, judged_on: (at_rest, []))
    left = confirmed(given, chosen, held(model, data, given.steps, (), np.ones(len(given.steps), dtype=bool), 1.0))
    assert names(left.fit.model) == (("coulomb_friction", "qd"),)
    (slot,) = left.fit.free
    assert slot.name == "force"
