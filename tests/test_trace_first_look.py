"""The first look at candidates and at pairs of them, by columns: which starts lead to a fit."""

import math
from itertools import product

import numpy as np
import pytest
from test_trace_for_a_while import DT, _held

from s2r_runtime.effects.input_effect import InputEffect
from s2r_runtime.hookspecs import Parameter
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.data.gridding import FEW, coarse, coarser
from s2r_runtime.trace.estimation.noise import weight
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, gain, insert, problem
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.hypotheses.starting_values import Leftover
from s2r_runtime.trace.selection.pairs import TAKEN, _nats, _nats_beside, _nats_of_spans, _span, _together, two_together
from s2r_runtime.trace.selection.relevance import _edges, relevant
from s2r_runtime.trace.selection.scores import best_candidates, names
from s2r_runtime.trace.selection.screening import _Aside, probes_of, screen
from s2r_runtime.trace.selection.stepwise import Selection, doing_something

JOINT, WHEELS = ModelSpec("joint", DT, {"mass": 1.0}, ()), ModelSpec("differential_drive", DT, {}, ())


def _drive(spec, effects, u, sigma, seed=21):
    """(problem, nominal model) of a robot with effects, driven by u (T, nu)."""
    true = compose(ModelSpec(spec.name, DT, spec.parameters, tuple(EffectSpec(*e) for e in effects)))
    x, hidden = np.zeros((1, len(true.states))), true.at_rest(1)
    rows = [x[0]]
    for row in u:
        x, hidden = true.step(x, row[None, :], hidden)
        rows.append(x[0])
    y = np.array(rows) + np.random.default_rng(seed).normal(size=(len(u) + 1, len(true.states))) * sigma
    model = compose(spec)
    data = from_arrays(model, [(y, u)])
    return problem(data, steps_of(data)), model


def _alike(fits):
    """Where what was not fitted is foretold as well by each."""
    return [0.0] * len(fits)


@pytest.mark.parametrize("second", [1.0, 1e-6, 0.0])
def test_what_moves_aside_is_weighted_least_squares_whatever_its_scale(second):
    """A column of nothing moves nothing."""
    rng = np.random.default_rng(5)
    z, j = rng.standard_t(3, 80), rng.normal(size=(80, 2)) * [1.0, second]
    root = np.sqrt(weight(z))
    beta = np.linalg.lstsq(root[:, None] * j / [1.0, second or 1.0], root * z, rcond=1e-12)[0] / [1.0, second or 1.0]
    _, found = _Aside(z, j)._left(z, j, j * root[:, None] ** 2)
    assert found == pytest.approx(beta, rel=1e-6)


def test_a_limit_that_depends_on_the_direction_is_fitted_from_one_that_does_not():
    """Where there is next to no noise, a search from anywhere else ends in a number of its own."""
    u = _held(np.random.default_rng(22), 500, [-4.0, -4.0], [4.0, 4.0])
    rates = {"rate": 3.0, "rate_down": 9.0}
    given, model = _drive(WHEELS, [("input_rate_limit", "cmd_right", rates)], u, 1e-5)
    base = evaluate(given, model)
    best = screen(given, base, candidates(model, given.data))[0][0]
    assert (best.candidate.name, best.candidate.channel) == ("input_rate_limit", "cmd_right")
    found = fitted(given, base, best.start).model.effects[-1].p
    assert found == pytest.approx(rates, rel=1e-3)


def test_what_changes_at_some_time_is_looked_at_with_the_size_that_explains_most():
    """A gain of 1.4 from 6 s on, the nearest starts being at other times and gains."""
    u = _held(np.random.default_rng(23), 400, [-1.0], [1.0])
    given, model = _drive(JOINT, [("regime_change", "force", {"time": 6.0, "gain": 1.4})], u, 1e-3)
    tried = [c for c in candidates(model, given.data) if c.name == "regime_change"]
    for s in screen(given, evaluate(given, model), tried)[0]:
        assert s.value > 0.0
        assert s.start.effects[-1].p["gain"] == pytest.approx(1.4, abs=0.1)


@pytest.mark.parametrize("angle", [1.2, -0.4, math.pi / 2, 2.9])
def test_a_heading_that_is_off_by_any_angle_is_found(angle):
    """What a small angle changes points across the way: from there no scale leads to a large one, and a lever arm does more."""
    u = _held(np.random.default_rng(32), 200, [0.2, -0.3], [0.4, 0.6])
    given, model = _drive(ModelSpec("unicycle", DT, {}, ()), [("heading_offset", "theta", {"angle": angle})], u, 1e-3)
    best = best_candidates(given, evaluate(given, model))[0][0]
    assert (best.name, best.fit.model.effects[-1].p["angle"]) == ("heading_offset", pytest.approx(angle, abs=0.02))


def test_nats_of_two_columns_are_those_of_a_least_squares_fit():
    rng = np.random.default_rng(24)
    c, z = rng.normal(size=(5, 300)), rng.normal(size=300)
    c[1] = c[0] + 0.1 * c[1]
    c[4] = c[3]
    c /= np.linalg.norm(c, axis=1)[:, None]
    nats = _nats(c, z, np.tile([-np.inf, np.inf], (5, 1)))
    for i in range(3):
        for j in range(i):
            rest = z - c[[i, j]].T @ np.linalg.lstsq(c[[i, j]].T, z, rcond=None)[0]
            assert nats[i, j] == pytest.approx(0.5 * (z @ z - rest @ rest), rel=1e-6)
    assert nats[4, 3] == 0.0  # one and the same
    both = np.linalg.lstsq(c[[0, 1]].T, z, rcond=None)[0]
    ranges = np.tile([-np.inf, np.inf], (5, 1))
    ranges[0] = sorted((0.0, -both[0]))
    assert _nats(c, z, ranges)[0, 1] == 0.0  # the other way round than it may be


def test_nats_of_several_columns_are_those_of_a_least_squares_fit():
    rng = np.random.default_rng(30)
    one, other, c, z = rng.normal(size=(200, 2)), rng.normal(size=(200, 3)), rng.normal(size=(4, 200)), rng.normal(size=200)
    other[:, 2] = other[:, 1] + 0.3 * one[:, 0]  # of both together, five columns span four directions
    c[1] = c[0] + 0.1 * one[:, 1]
    c[3] = one[:, 0] - 2.0 * one[:, 1]
    c /= np.linalg.norm(c, axis=1)[:, None]

    def explained(x):
        rest = z - x @ np.linalg.lstsq(x, z, rcond=1e-9)[0]
        return 0.5 * (z @ z - rest @ rest)

    assert _nats_of_spans(_span(one), _span(other), z) == pytest.approx(explained(np.hstack([one, other])), rel=1e-6)
    anything = np.tile([-np.inf, np.inf], (4, 1))
    nats = _nats_beside(_span(one), c, z, anything)
    assert nats[:3] == pytest.approx([explained(np.column_stack([one, single])) for single in c[:3]], rel=1e-6)
    assert nats[3] == 0.0  # it adds nothing to them
    beta = np.linalg.lstsq(np.column_stack([one, c[0]]), z, rcond=None)[0][2]
    anything[0] = sorted((0.0, -beta))
    assert _nats_beside(_span(one), c, z, anything)[0] == 0.0  # the other way round than it may be


@pytest.mark.parametrize("seed", [2, 8])
def test_a_slope_along_both_axes_is_found_beside_a_heading_that_is_off(seed):
    """By one of its two numbers at a time, a slope does less than a pair that takes up a part of everything."""
    u = _held(np.random.default_rng(seed), 300, [0.05, -0.6], [0.4, 0.6])
    effects = [("heading_offset", "theta", {"angle": 0.05}), ("gravity_slope", "*", {"x": 0.04, "y": 0.04})]
    given, model = _drive(ModelSpec("unicycle", DT, {}, ()), effects, u, [1e-3, 1e-3, 4e-3], seed)
    base = evaluate(given, model)
    pair = two_together(given, Selection(base, base, 100, (), ()), _alike)
    assert set(names(pair.fit.model)) == {("gravity_slope", "*"), ("heading_offset", "theta")}


@pytest.mark.parametrize("other", ["input_gain", "input_bias"])
def test_pairs_that_explain_as_much_are_told_apart_by_what_was_not_fitted(other):
    """At one speed, a gain and a bias do the same."""
    u = np.column_stack([np.full(300, 0.3), _held(np.random.default_rng(31), 300, [-0.8], [0.8])[:, 0]])
    effects = [("input_bias", "v", {"bias": 0.05}), ("input_gain", "w", {"gain": 0.8})]
    given, model = _drive(ModelSpec("unicycle", DT, {}, ()), effects, u, 1e-3)
    base = evaluate(given, model)
    foretells = lambda fits: [5.0 * ((other, "v") in names(fit.model)) for fit in fits]  # noqa: E731
    assert (other, "v") in names(two_together(given, Selection(base, base, 100, (), ()), foretells).fit.model)


def test_two_effects_of_which_either_alone_shows_little_are_found_together():
    """A push and friction on a joint that always moves one way, so that each looks like the other with the other sign."""
    u = 1.0 + 0.6 * np.sign(np.sin(0.05 * np.arange(600)))[:, None]
    effects = [("input_bias", "force", {"bias": 0.5}), ("viscous_friction", "qd", {"coefficient": 0.9})]
    given, model = _drive(JOINT, effects, u, 2e-3)
    base = evaluate(given, model)
    nothing = Selection(base, base, 100, (), ())
    pair = two_together(given, nothing, _alike)
    assert names(pair.fit.model) == (("input_bias", "force"), ("viscous_friction", "qd"))
    assert two_together(given, Selection(base, pair.fit, 100, (), ()), _alike) is None  # nothing explains more than they do


def test_a_pair_has_both_and_all_that_the_user_declared():
    """An effect that is inserted before a declared one moves its place, at which another scheme would replace it."""
    declared = (EffectSpec("input_lag", "v", {"time_constant": 0.1}), EffectSpec("integration_scheme", "*", {"scheme": "euler"}))
    model = compose(ModelSpec("unicycle", DT, {}, declared))
    data = from_arrays(model, [(np.zeros((101, 3)), _held(np.random.default_rng(29), 100, [-0.5, -2.0], [0.5, 2.0]))])
    probes = probes_of(model, candidates(model, data))
    others = [p for p in probes if p.candidate.replaced >= 0]
    assert others
    assert any(p.candidate.place == 0 and p.candidate.replaced < 0 for p in probes)
    for one, other in product(probes, others):
        for both in _together(one, other):
            assert {one.candidate.name, other.candidate.name, "input_lag"} <= {a.effect.name for a in both.effects}


def test_one_that_is_inserted_before_it_leaves_the_users_own_effect_where_it_is():
    """The model as declared moves on arcs; of pairs with another scheme none may replace what was just put in."""
    spec = ModelSpec("unicycle", DT, {}, (EffectSpec("integration_scheme", "*", {"scheme": "euler"}),))
    u = _held(np.random.default_rng(25), 400, [-0.5, -2.0], [0.5, 2.0])
    given, _ = _drive(ModelSpec("unicycle", DT, {}, ()), [("input_gain", "v", {"gain": 0.8}), ("input_bias", "w", {"bias": 0.2})], u, 1e-4)
    model = compose(spec)
    base = evaluate(given, model)
    pair = two_together(given, Selection(base, base, 100, (), ()), _alike)
    assert pair is not None
    assert gain(pair.fit, base) > 0.0
    assert sum(a.effect.name == "integration_scheme" for a in pair.fit.model.effects) == 1


@pytest.mark.parametrize(("substeps", "left"), [(1, 1), (5, 1), (10, 2), (12, 3), (7, 1)])
def test_a_coarse_recording_has_the_same_mean_input_in_every_step(substeps, left):
    rng = np.random.default_rng(26)
    model = compose(WHEELS)
    data = from_arrays(model, [(rng.normal(size=(41, 5)), rng.normal(size=(40, 2)))])
    fine = data.__class__(
        **{**data.__dict__, "substeps": substeps, "runs": tuple(_cut(run, data.substeps, substeps, rng) for run in data.runs)}
    )
    few = coarse(fine)
    assert few.substeps == left <= FEW
    for run, other in zip(fine.runs, few.runs, strict=True):
        means = run.u.reshape(40, substeps, 2).mean(axis=1)
        assert other.u.reshape(40, left, 2).mean(axis=1) == pytest.approx(means)
    assert coarser(fine, 1).runs[0].u == pytest.approx(fine.runs[0].u)


def _cut(run, before, substeps, rng):
    u = np.repeat(run.u[::before], substeps, axis=0)
    return run.__class__(run.start_s, run.y, u + rng.normal(size=u.shape))


def test_a_start_of_the_wrong_sign_is_worth_nothing_to_a_pair():
    """Behind a kink a start is a line for some way only."""
    low, high = TAKEN
    rng = np.random.default_rng(27)
    c = rng.normal(size=(2, 200))
    c /= np.linalg.norm(c, axis=1)[:, None]
    for share, told in ((1.0, True), (-1.0, False), (2.0 * high, False), (0.5 * low, False)):
        nats = _nats(c, c.T @ np.array([share, 1.0]), np.array([TAKEN, TAKEN]))
        assert bool(nats[0, 1] > 0.0) is told


def test_an_effect_of_the_tracers_is_at_the_place_at_which_it_was_looked_at():
    given, model = _drive(JOINT, [("input_bias", "force", {"bias": 0.2})], _held(np.random.default_rng(28), 200, [-1.0], [1.0]), 1e-3)
    model = insert(model, AppliedEffect(registry().get("effects", "input_gain"), "force", {"gain": 1.1}), 0)
    for s in screen(given, evaluate(given, model), candidates(model, given.data))[0]:
        place = s.candidate.place if s.candidate.replaced < 0 else s.candidate.replaced
        assert (s.start.effects[place].effect.name, s.start.effects[place].channel) == (s.candidate.name, s.candidate.channel)


def test_a_sine_of_other_parameters_begins_as_it_says():
    """Somebody's own effect with a frequency and a phase, and a share instead of an amplitude."""

    class Ripple(InputEffect):
        """u_act = u (1 + share sin(2 pi frequency t + phase))."""

        name = "ripple"
        parameters = (
            Parameter("frequency", "Hz", 0.0, 100.0),
            Parameter("share", "", 0.0, 1.0, neutral=0.0),
            Parameter("phase", "rad", -10.0, 10.0),
        )

        def act(self, u, p):
            return u * (1.0 + p["share"] * np.sin(np.arange(len(u))[:, None] + p["phase"]))

        def starts_from_residual(self, residual, t, pushes, model, channel, dt):
            return [{"frequency": 1.0, "share": 0.1, "phase": 0.5}]

    given, model = _drive(JOINT, [], _held(np.random.default_rng(29), 200, [-1.0], [1.0]), 1e-3)
    (found,) = Leftover(given, evaluate(given, model)).starts(Ripple(), "force")
    assert found["frequency"] == 1.0


def test_a_limit_that_is_hardly_met_is_begun_from_near_it():
    """The largest commands are cut by a fortieth, on one side: starts that cut them by a tenth and more are worse than none."""
    u = 2.0 * np.sin(0.001 * np.arange(300) ** 2)[:, None]
    given, model = _drive(JOINT, [("input_saturation", "force", {"high": 1.95})], u, 1e-4)
    best = screen(given, evaluate(given, model), candidates(model, given.data))[0][0]
    assert (best.candidate.name, best.candidate.channel) == ("input_saturation", "force")


def _best(given, model, name):
    """The start of an effect that looks best."""
    tried = [c for c in candidates(model, given.data) if c.name == name]
    return screen(given, evaluate(given, model), tried)[0][0]


def test_of_delays_that_look_alike_the_one_that_explains_most_as_it_stands_is_begun_from():
    """A delay of 30 steps, sought from 25 and from 50. By a line from none at all to it the shorter one looks better; from there, the
    search ends at the next command.
    """
    u = np.repeat(np.random.default_rng(3).uniform(-1.0, 1.0, 9), 40)[:, None]
    spec = ModelSpec("joint", 0.002, {"mass": 1.0}, ())
    true, model = compose(ModelSpec("joint", 0.002, {"mass": 1.0}, (EffectSpec("input_delay", "force", {"delay": 0.0628}),))), compose(spec)
    x, hidden, rows = np.zeros((1, 2)), true.at_rest(1), [np.zeros(2)]
    for row in u:
        x, hidden = true.step(x, row[None, :], hidden)
        rows.append(x[0])
    y = np.array(rows) + np.random.default_rng(4).normal(size=(len(u) + 1, 2)) * 2e-4
    data = from_arrays(model, [(y, u)])
    given = problem(data, steps_of(data))
    assert fitted(given, evaluate(given, model), _best(given, model, "input_delay").start).model.effects[-1].p["delay"] == pytest.approx(
        0.0628, abs=2e-3
    )


def test_a_curve_of_two_forces_is_begun_as_large_as_it_explains_most():
    """Starts are a tenth of the largest input; friction that is a two hundredth of it they overdo so much that no step leads back."""
    u = _held(np.random.default_rng(31), 600, [-1.0], [1.0])
    friction = {"force": 0.004, "static_force": 0.009, "velocity": 0.2}
    given, model = _drive(JOINT, [("stribeck_friction", "qd", friction)], u, 1e-4)
    best = _best(given, model, "stribeck_friction")
    assert best.value > 0.9 * _best(given, model, "coulomb_friction").value
    assert fitted(given, evaluate(given, model), best.start).model.effects[-1].p == pytest.approx(friction, rel=0.2)


@pytest.mark.parametrize("share", [0.98, 0.85])
def test_a_limit_of_both_wheels_is_found_by_a_quiet_sensor(share):
    """A start that is a little too low takes off so much more than there is that it is far worse than nothing."""
    u = _held(np.random.default_rng(32), 600, [-0.5, -1.0], [0.5, 1.0])
    track = 0.7
    load = np.max(np.abs(u[:, :1] + u[:, 1:] * np.array([-0.5, 0.5]) * track))
    limit = {"speed": share * float(load), "track": track}
    given, model = _drive(ModelSpec("unicycle", DT, {}, ()), [("wheel_saturation", "*", limit)], u, 1e-5)
    best = screen(given, evaluate(given, model), candidates(model, given.data))[0][0]
    assert best.candidate.name == "wheel_saturation"
    assert fitted(given, evaluate(given, model), best.start).model.effects[-1].p == pytest.approx(limit, rel=0.02)


def test_a_lag_of_a_tenth_of_a_step_is_begun_from():
    """Its mean over a step is a tenth less of what is new; its end is none."""
    u = _held(np.random.default_rng(33), 300, [-4.0, -4.0], [4.0, 4.0])
    given, model = _drive(WHEELS, [("input_lag", "cmd_left", {"time_constant": 0.1 * DT})], u, [1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
    best = _best(given, model, "input_lag")
    assert best.candidate.channel == "cmd_left"
    assert best.value > 100.0


def test_what_was_asked_for_once_only_is_foretold_from_a_part_of_it():
    """A wheel turns for a tenth of the time, in the last of the blocks; from the others, which know nothing of its gain, it is foretold."""
    u = np.tile([3.0, 5e-5], (600, 1))
    u[520:580, 1] = np.repeat(np.random.default_rng(34).uniform(1.0, 4.0, 6), 10)
    given, model = _drive(WHEELS, [("input_gain", "cmd_right", {"gain": 1.2})], u, [1e-3, 1e-3, 2e-3, 1e-2, 1e-2])
    base = evaluate(given, model)
    fit = fitted(given, base, insert(model, Added(registry().get("effects", "input_gain"), "cmd_right", {"gain": 1.1}), 0))
    assert relevant(given, fit, base, 20)
    change = Added(registry().get("effects", "input_gain_drift"), "cmd_right", {"rate": 0.01})
    fit = fitted(given, base, insert(model, change, 0))
    assert _edges(given, fit, base) == pytest.approx(np.linspace(0, 599, 6))  # what depends on time must be seen at other times


def test_an_effect_that_came_to_do_nothing_beside_a_later_one_is_left_out():
    given, model = _drive(
        JOINT, [("input_lag", "force", {"time_constant": 0.1})], _held(np.random.default_rng(35), 300, [-1.0], [1.0]), 1e-3
    )
    late = Added(registry().get("effects", "input_delay"), "force", {"delay": 0.0})
    lag = Added(registry().get("effects", "input_lag"), "force", {"time_constant": 0.1})
    both = evaluate(given, insert(insert(model, lag, 0), late, 0))
    assert names(doing_something(given, both).model) == (("input_lag", "force"),)
    assert names(doing_something(given, evaluate(given, insert(model, lag, 0))).model) == (("input_lag", "force"),)
