"""What takes a tracer's time is asked of a model once: rounds of a fit, and what follows it, go back to what they know."""

import math
from collections import deque
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from s2r_runtime.effects import follower
from s2r_runtime.effects.periodic_disturbance import PeriodicDisturbance
from s2r_runtime.errors import ConfigError
from s2r_runtime.models import forces
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.models.double_integrator import DoubleIntegrator
from s2r_runtime.models.file_model import FileModel
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics import lack_of_fit
from s2r_runtime.trace.diagnostics import whole_recording as whole
from s2r_runtime.trace.diagnostics.lack_of_fit import left_of
from s2r_runtime.trace.diagnostics.rollout_error import Held, noise_floor
from s2r_runtime.trace.estimation import change_times, prediction
from s2r_runtime.trace.estimation import problem as problems
from s2r_runtime.trace.estimation.prediction import acting, state_jacobian, steps_of
from s2r_runtime.trace.estimation.problem import Problem, evaluate, fitted, foretold, foretold_by, insert, problem, scatter, without
from s2r_runtime.trace.hypotheses import random_fields
from s2r_runtime.trace.hypotheses.random_fields import Field
from s2r_runtime.trace.selection import exchange, relevance, scores, stepwise
from s2r_runtime.trace.selection.change_points import rivals_that_happen
from s2r_runtime.trace.sensor_faults.detect import Checked

DT_S, ROWS = 0.02, 300


def _given(drag: float = 0.3) -> tuple[Problem, problems.Fit]:
    """A body with drag, and a fit of it that begins elsewhere."""
    rng = np.random.default_rng(0)
    robot = compose(ModelSpec("double_integrator", DT_S, {}, (EffectSpec("viscous_friction", "vx", {"coefficient": drag}),)))
    model = compose(ModelSpec("double_integrator", DT_S))
    u = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 20, 2)), 20, axis=0)
    x, hidden, rows = np.zeros((1, 4)), robot.at_rest(1), [np.zeros(4)]
    for k in range(ROWS):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + 0.002 * rng.normal(size=(ROWS + 1, 4)), u)])
    given = problem(data, steps_of(data))
    start = insert(model, robot.effects[0], 0)
    return given, fitted(given, evaluate(given, model), start)


def test_rounds_of_a_fit_and_what_follows_ask_for_slopes_once_a_model(monkeypatch):
    asked: list[tuple[float, ...]] = []
    slopes = problems._slopes

    def counted(given, model, free):
        asked.append(tuple(problems.values_of(model, free)))
        return slopes(given, model, free)

    monkeypatch.setattr(problems, "_slopes", counted)
    given, fit = _given()
    scatter(given, fit)
    assert 1 < len(asked) == len({*asked})


def test_what_is_known_of_a_model_is_what_it_says():
    given, fit = _given()
    act = acting(fit.model, given.data)
    assert np.array_equal(given.residual(fit.model), prediction.residual(fit.model, given.steps, act))
    assert np.array_equal(given.jacobian(fit.model), state_jacobian(fit.model, given.steps, act))
    assert np.array_equal(problems.slopes(given, fit.model, fit.free), problems._slopes(given, fit.model, fit.free))
    with pytest.raises(ValueError, match="read-only"):
        given.predicted(fit.model)[0] = 0.0


def test_another_value_is_another_model():
    given, fit = _given()
    other = problems.with_values(fit.model, fit.free, 2.0 * problems.values_of(fit.model, fit.free))
    assert other is not None
    assert not np.array_equal(given.predicted(other), given.predicted(fit.model))


def test_a_jacobian_is_one_call_of_a_model_where_rows_are_few(monkeypatch):
    given, fit = _given()
    model, rows = fit.model.nominal.shared, []
    step = DoubleIntegrator.step
    monkeypatch.setattr(DoubleIntegrator, "step", lambda self, x, *rest: (rows.append(len(x)), step(self, x, *rest))[1])
    found = state_jacobian(fit.model, given.steps, acting(fit.model, given.data))
    assert rows == [8 * len(given.steps)]
    monkeypatch.setattr(prediction, "TOGETHER", 1)
    assert np.allclose(found, state_jacobian(fit.model, given.steps, acting(fit.model, given.data)), rtol=0.0, atol=1e-9)
    assert rows[1:] == [len(given.steps)] * 8
    assert model.name == "double_integrator"


def test_rates_that_stay_are_worked_out_once_for_all_sweeps(monkeypatch):
    flow, rows, count, n = forces._flow, [], 3, 50
    monkeypatch.setattr(forces, "_flow", lambda rate, t: (rows.append(np.shape(t)), flow(rate, t))[1])
    rng = np.random.default_rng(1)
    w = np.eye(count) + 0.3 * (1.0 - np.eye(count))
    speeds, given = list(rng.uniform(1.0, 2.0, (count, n))), list(rng.normal(size=(count, n)))
    pushes = [forces.Push(rate=(np.full(n, 0.5),) * 2) for _ in range(count)]
    forces._swept(speeds, given, pushes, np.tile(w, (n, 1, 1)), 0.01)
    assert len(rows) == count


@pytest.mark.parametrize("z", [0.0, 1e-12, 5e-4, 0.2, -3.0])
def test_a_flow_of_many_rates_is_that_of_each(z):
    many = forces._flow(np.array([z, 1.0, 0.0]), 0.1)
    one = forces._flow(z, 0.1)
    assert [e[0] for e in many] == pytest.approx(list(one), rel=1e-12)
    assert [e[2] for e in many] == pytest.approx(list(forces._flow(0.0, 0.1)), rel=1e-15)


def test_columns_of_a_double_integrator_take_steps_of_their_own():
    rng = np.random.default_rng(2)
    x, u, dt = rng.normal(size=(5, 4)), rng.normal(size=(5, 2)), rng.uniform(0.01, 0.1, 5)
    step = partial(DoubleIntegrator().step, parameters={})
    together = step(x, u, dt)
    assert np.array_equal(together, np.concatenate([step(x[i : i + 1], u[i : i + 1], dt[i]) for i in range(5)]))


def test_models_that_differ_in_what_acts_take_their_steps_together(monkeypatch):
    given, fit = _given()
    lag, drag = registry().get("effects", "input_lag"), fit.model.effects[0]
    lags = [insert(fit.model, AppliedEffect(lag, "ax", {"time_constant": 0.05 * k}), 0) for k in range(1, 4)]
    slower = replace(fit.model, effects=(replace(drag, p={"coefficient": 0.7}),))
    pulled = insert(fit.model, AppliedEffect(registry().get("effects", "quadratic_drag"), "vx", {"coefficient": 0.5}), 0)
    models = [lags[0], slower, pulled, *lags[1:]]
    alone = [foretold(given, model) for model in models]
    rows, step = [], DoubleIntegrator.step
    monkeypatch.setattr(DoubleIntegrator, "step", lambda self, x, *rest: (rows.append(len(x)), step(self, x, *rest))[1])
    for one, other in zip(foretold_by(given, models), alone, strict=True):
        assert one is not None
        assert other is not None
        assert np.array_equal(one, other)
    assert rows == [3 * len(given.steps), len(given.steps), len(given.steps)]


def test_times_that_are_tried_take_their_steps_together(monkeypatch):
    given, fit = _given()
    change = AppliedEffect(registry().get("effects", "regime_change"), "ax", {"time": 2.0, "gain": 0.8})
    later = evaluate(given, insert(fit.model, change, 0))
    slot = next(slot for slot in later.free if change_times.is_time(later.model, slot))
    base = problems.under_noise(given, fit.model, later.noise)
    given.predicted(fit.model)
    calls, step, times = [], DoubleIntegrator.step, np.linspace(1.0, 5.0, 20)
    monkeypatch.setattr(DoubleIntegrator, "step", lambda self, x, *rest: (calls.append(len(x)), step(self, x, *rest))[1])
    together = change_times._nats(given, later, base, slot, times)
    assert len(calls) < len(times)
    alone = [change_times._nats(given, later, base, slot, times[k : k + 1])[0] for k in range(len(times))]
    assert together == pytest.approx(alone, rel=1e-9)


def test_a_model_that_steps_nowhere_is_none_and_takes_no_other_with_it(monkeypatch):
    given, fit = _given()
    gain = registry().get("effects", "input_gain")
    models = [insert(fit.model, AppliedEffect(gain, "ax", {"gain": size}), 0) for size in (0.5, 9.0, 2.0)]
    alone, step = [foretold(given, model) for model in models], DoubleIntegrator.step

    def refusing(self, x, u, *rest):
        if np.max(np.abs(u)) > 4.0:
            raise ConfigError("no such motor")
        return step(self, x, u, *rest)

    monkeypatch.setattr(DoubleIntegrator, "step", refusing)
    found = foretold_by(given, models)
    assert [one is None for one in found] == [False, True, False]
    assert all(one is None or np.array_equal(one, other) for one, other in zip(found, alone, strict=True))


def test_a_file_model_asks_which_rows_were_given_only_where_something_is_not_finite(tmp_path, monkeypatch):
    path = tmp_path / "robot.py"
    path.write_text('STATES = ("q",)\nINPUTS = ("u",)\nPARAMS = {}\n\ndef step(x, u, dt, params):\n    return x / u\n')
    model, asked, check = compose(ModelSpec(str(path), DT_S)).nominal, [], FileModel._check_finite
    monkeypatch.setattr(FileModel, "_check_finite", lambda self, *given: (asked.append(1), check(self, *given))[1])
    model.step(np.ones((3, 1)), np.ones((3, 1)), DT_S, {})
    assert not asked
    assert np.isnan(model.step(np.array([[np.nan], [1.0]]), np.ones((2, 1)), DT_S, {})[0, 0])
    with pytest.raises(ConfigError, match="row 1"):
        model.step(np.ones((2, 1)), np.array([[1.0], [0.0]]), DT_S, {})
    assert len(asked) == 2


@pytest.mark.parametrize("where", [0, 1])
def test_a_file_model_is_asked_once_of_a_table_and_anew_of_one_that_differs_anywhere(tmp_path, monkeypatch, where):
    path = tmp_path / "robot.py"
    path.write_text('STATES = ("q",)\nINPUTS = ("u",)\nPARAMS = {}\n\ndef step(x, u, dt, params):\n    return x + dt * u\n')
    model, asked, called = compose(ModelSpec(str(path), DT_S)).nominal, [], FileModel._called
    monkeypatch.setattr(FileModel, "_called", lambda self, *given: (asked.append(1), called(self, *given))[1])
    tables = [np.zeros((ROWS, 1)), np.zeros((ROWS, 1))]
    first = model.step(*tables, DT_S, {})
    first[:] = 7.0  # of whoever asked
    assert np.array_equal(model.step(*tables, DT_S, {}), np.zeros((ROWS, 1)))
    assert len(asked) == 1
    for row in range(ROWS):
        tables[where][row] = 1.0
        assert np.array_equal(model.step(*tables, DT_S, {}), tables[0] + DT_S * tables[1])
    assert len(asked) == 1 + ROWS


@pytest.mark.parametrize("dt", [0.1, np.full((40, 1), 0.1)])
def test_a_sine_before_the_start_is_worked_out_for_the_rows_before_it_only(dt):
    p = {"frequency": 1.3, "amplitude": 0.7, "phase": 0.4}
    t, u = 0.1 * np.arange(-5.5, 34.5)[:, None], np.zeros((40, 1))
    found = PeriodicDisturbance().act_at(u, t, dt, p)
    fine = np.maximum(t + 0.1 * (np.arange(1000) + 0.5) / 1000, 0.0)
    assert found[:, 0] == pytest.approx(np.mean(0.7 * np.sin(2.0 * np.pi * 1.3 * fine + 0.4), axis=1), abs=1e-4)


@pytest.mark.parametrize("loud", [0.0, 0.4])
def test_a_noise_floor_is_one_call_of_a_model_a_step(monkeypatch, loud):
    given, fit = _given()
    data = given.data
    judged_on = Held(data, given.steps, (), np.ones(ROWS, dtype=bool), 5)
    fit = replace(fit, colour=replace(fit.colour, coefficients=loud * np.eye(4)))  # each state on one of its last values
    calls, step = [], DoubleIntegrator.step
    monkeypatch.setattr(DoubleIntegrator, "step", lambda self, x, *rest: (calls.append(len(x)), step(self, x, *rest))[1])
    one, ends = noise_floor(fit, judged_on, 0)
    assert np.all(ends > 0.5 * one)
    assert len(calls) == 1 + judged_on.horizon  # one is the Jacobian's


def test_what_is_absurd_in_one_column_only_is_cut_off_there():
    x, far = np.array([[1.0, 5.0], [-3.0, np.nan]]), np.array([2.0, 100.0])
    assert not prediction.near(x, far)
    assert np.array_equal(prediction.no_farther(x, far), [[1.0, 5.0], [-2.0, np.nan]], equal_nan=True)
    assert prediction.no_farther(x[:1, :1], far[:1]).base is x


@pytest.mark.parametrize(("name", "values"), [("input_rate_limit", {"rate": 3.0}), ("input_backlash", {"width": 0.2})])
def test_where_an_input_holds_is_worked_out_once_for_all_numbers(monkeypatch, name, values):
    stretched, asked = follower._stretched, []
    monkeypatch.setattr(follower, "_KNOWN", deque())
    monkeypatch.setattr(follower, "_stretched", lambda *given: (asked.append(len(given[0])), stretched(*given))[1])
    model, effect = compose(ModelSpec("unicycle", DT_S)).nominal, registry().get("effects", name)
    u = np.repeat(np.random.default_rng(3).normal(size=(30, 2)), 7, axis=0)
    for share in (1.0, 0.5, 2.0):
        effect.input_sequence(u, model, "v", DT_S, {key: share * value for key, value in values.items()}, mixed=True)
    assert len(asked) == 1
    u[20:27, 0] += 0.4  # another input, in the same place
    again = effect.input_sequence(u, model, "v", DT_S, values, mixed=True)
    assert len(asked) == 2
    monkeypatch.setattr(follower, "_KNOWN", deque())
    assert np.array_equal(again, effect.input_sequence(u, model, "v", DT_S, values, mixed=True))


def test_what_acts_at_the_ends_of_rows_is_asked_of_inputs_that_set_a_state(monkeypatch):
    u = np.repeat(np.random.default_rng(4).normal(size=(10, 2)), 7, axis=0)
    model, lag, asked = compose(ModelSpec("bicycle", DT_S)), registry().get("effects", "input_lag"), []
    steer, speed = (AppliedEffect(lag, name, {"time_constant": 0.1}) for name in ("steer_cmd", "speed_cmd"))
    mean, end = Inputs([u], DT_S, [0.0]).with_ends(model, [steer])
    assert end is mean
    at_end = type(lag).at_end
    monkeypatch.setattr(type(lag), "at_end", lambda self, *given: (asked.append(given[3]), at_end(self, *given))[1])
    _, both = Inputs([u], DT_S, [0.0]).with_ends(model, [steer, speed])
    assert asked == ["speed_cmd"]
    assert np.array_equal(both[:, 1], Inputs([u], DT_S, [0.0]).with_ends(model, [speed])[1][:, 1])
    coupling = AppliedEffect(registry().get("effects", "input_coupling"), "speed_cmd", {"from": "steer_cmd", "coefficient": 0.3})
    Inputs([u], DT_S, [0.0]).with_ends(model, [steer, speed, coupling])
    assert {*asked[1:]} == {"steer_cmd", "speed_cmd"}  # there, the steering comes into the speed


def test_a_candidate_that_a_round_leaves_far_behind_gets_no_other_one(monkeypatch):
    given, fit = _given()
    base = evaluate(given, without(fit.model, 0))
    rounds, found = [], []
    monkeypatch.setattr(problems, "evaluate", lambda *asked: (rounds.append(1), evaluate(*asked))[1])
    for share in (0.0, scores.ONWARD):
        rounds.clear()
        monkeypatch.setattr(scores, "ONWARD", share)
        best, _ = scores.best_candidates(replace(given, searches={}), base, 6)
        found.append((len(rounds), best[0].name, best[0].channel, best[0].score))
    assert found[1][0] < found[0][0]
    assert found[1][1:] == found[0][1:]


@pytest.mark.slow
def test_what_is_far_from_needed_is_not_asked_how_it_began(monkeypatch):
    given, fit = _given()
    asked, found = [], []
    began = stepwise.from_the_beginning
    monkeypatch.setattr(stepwise, "from_the_beginning", lambda *of: (asked.append(1), began(*of))[1])
    for share in (-math.inf, stepwise.NEAR):
        asked.clear()
        monkeypatch.setattr(stepwise, "NEAR", share)
        chosen = stepwise.called_for(replace(given, searches={}), without(fit.model, 0), 20, lambda share: None)
        found.append((len(asked), scores.names(chosen.fit.model), chosen.fit.white))
    assert found[1][0] < found[0][0]
    assert found[1][1:] == found[0][1:]


def test_no_dictionary_explains_more_where_next_to_nothing_is_left(monkeypatch):
    given, fit = _given()
    asked, found = [], []
    explains = whole.explains_more
    monkeypatch.setattr(whole, "explains_more", lambda *of, left: (asked.append(1), explains(*of, left=left))[1])
    monkeypatch.setattr(whole, "ALIKE", -math.inf)
    for share in (-math.inf, whole.LITTLE):
        asked.clear()
        monkeypatch.setattr(whole, "LITTLE", share)
        everything = whole.Whole(Checked(given.data, (), (), 0), without(fit.model, 0), 20)
        structure = everything.structure(stepwise.Selection(everything.nominal, fit, 1, (), ()))
        found.append((len(asked), structure.tokens, structure.matters))
    assert found == [(1, *found[1][1:]), (0, *found[1][1:])]


def test_what_a_field_is_beyond_other_noise_is_not_asked_where_no_rollout_shows_it(monkeypatch):
    given, fit = _given()
    looks = lack_of_fit.Looks(left_of(given, fit))

    def asked() -> float:
        raise AssertionError

    x = np.zeros((*looks.left.r.shape, 1))
    looks.__dict__.update(field=Field("position", (), x, np.zeros(1), 50.0, asked), chosen=([], {}))
    monkeypatch.setattr(lack_of_fit, "_weight_of", lambda *given: (False, 0.0))
    assert not lack_of_fit.lack_of_fit(looks, fit, 20).matters


def test_candidates_are_held_against_what_one_model_foretells(monkeypatch):
    given, fit = _given()
    base, asked, errors = evaluate(given, without(fit.model, 0)), [], relevance._held_out_errors
    monkeypatch.setattr(relevance, "_held_out_errors", lambda given, of, *rest: (asked.append(of), errors(given, of, *rest))[1])
    other = fitted(
        given, base, insert(base.model, AppliedEffect(registry().get("effects", "viscous_friction"), "vy", {"coefficient": 0.1}), 0)
    )
    told = [relevance.relevant(given, one, base, 20) for one in (other, fit, other)]
    assert told == [False, True, False]
    assert len([of for of in asked if of is base]) == len([of for of in asked if of is other]) == 3  # one a length of rollouts


def test_a_field_that_was_looked_at_goes_on_from_there(monkeypatch):
    given, fit = _given()
    left = left_of(given, evaluate(given, without(fit.model, 0)))
    offer = max(random_fields._offered(left), key=lambda offer: random_fields._marginal(left, offer.x, 1)[0])
    whole, first = random_fields._marginal(left, offer.x, random_fields.PASSES), random_fields._marginal(left, offer.x, 1)
    passes, evidence = [], random_fields.evidence
    monkeypatch.setattr(random_fields, "evidence", lambda *asked: (passes.append(1), evidence(*asked))[1])
    onward = random_fields._marginal(left, offer.x, random_fields.PASSES, first)
    assert onward[0] == whole[0]
    assert np.array_equal(onward[1], whole[1])
    asked = len(passes)
    random_fields._marginal(left, offer.x, random_fields.PASSES)
    assert len(passes) == 2 * asked + 1


def test_a_candidate_that_is_fitted_already_is_not_fitted_again(monkeypatch):
    given, fit = _given()
    (place,) = fit.added
    base = fitted(given, fit, without(fit.model, place), 1)
    mine = scores.name_of(fit.model.effects[place])
    began: list[tuple[tuple[str, str], ...]] = []

    def counted(given, start, model, rounds, hopeless):
        began.append(scores.names(model))
        return fitted(given, start, model, rounds, hopeless)

    monkeypatch.setattr(scores, "fitted", counted)
    itself = scores.Scored(*mine, problems.gain(fit, base), fit)
    found, _ = scores.best_candidates(given, base, known=itself)
    assert found[0] is itself
    assert began
    assert (mine,) not in began
    given.searches.clear()
    again, _ = scores.best_candidates(given, base)
    assert (mine,) in began
    assert {(s.name, s.channel) for s in found} == {(s.name, s.channel) for s in again}


@pytest.mark.slow
def test_a_rival_takes_its_place_at_once_and_only_then_are_the_others_asked_again(monkeypatch):
    """Drag, dry friction in the place of the other axis' drag, and a push."""
    drags = [EffectSpec("viscous_friction", name, {"coefficient": 0.3}) for name in ("vx", "vy")]
    push = EffectSpec("constant_disturbance", "world", {"x": 0.2, "y": 0.1})
    robot, model = (compose(ModelSpec("double_integrator", DT_S, {}, effects)) for effects in ((*drags, push), ()))
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 10, 2)), 20, axis=0)
    x, hidden, rows = np.zeros((1, 4)), robot.at_rest(1), [np.zeros(4)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + 0.002 * rng.normal(size=(len(rows), 4)), u)])
    given = problem(data, steps_of(data))
    dry = AppliedEffect(registry().get("effects", "coulomb_friction"), "vy", {"force": 0.1})
    start = evaluate(given, model)
    for a in (robot.effects[0], dry, robot.effects[2]):
        start = fitted(given, start, insert(start.model, a, len(start.model.effects)))
    asked: list[tuple[str, str]] = []

    def counted(given, fit, places):
        asked.extend(scores.name_of(fit.model.effects[place]) for place in places)
        return rivals_that_happen(given, fit, places)

    monkeypatch.setattr(exchange, "rivals_that_happen", counted)
    fit, rivals = exchange.overtaken(given, start, scores.STRICT)
    ahead, behind = ("viscous_friction", "vx"), ("constant_disturbance", "world")
    assert asked[:3] == [ahead, ("coulomb_friction", "vy"), ("viscous_friction", "vy")]
    assert sorted(asked[3:]) == sorted([ahead, behind])
    assert {scores.name_of(fit.model.effects[i]) for i in fit.added} == {ahead, ("viscous_friction", "vy"), behind}
    kept = {*scores.names(fit.model)}
    assert all(len({*scores.names(s.fit.model)} - kept) == 1 for s in rivals if s.fit is not None)
