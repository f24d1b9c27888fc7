"""Numbers on their way to where they are best: from one rate to two, and from a part of a recording to all of it."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem
from s2r_runtime.trace.selection.exchange import parted
from s2r_runtime.trace.selection.scores import STRICT, best_candidates, names
from s2r_runtime.trace.selection.stepwise import Selection
from s2r_runtime.trace.sensor_faults.detect import check

DT, NOISE = 0.05, np.array([0.001, 0.001, 0.003])


def _recorded(*effects, seed=0, steps=600):
    """(model, data): a unicycle that lacks effects (name, channel, p), driven in steps of its commands."""
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    robot = compose(ModelSpec("unicycle", DT, {}, tuple(EffectSpec(*one) for one in effects)))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([-0.3, -1.0], [0.3, 1.0], (steps // 15, 2)), 15, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(steps):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    return model, from_arrays(model, [(np.array(rows) + rng.normal(size=(steps + 1, 3)) * NOISE, u)])


def _named(model, name, channel, p):
    return insert(model, AppliedEffect(registry().get("effects", name), channel, p), 0)


@pytest.mark.parametrize(("rates", "told"), [({"rate": 6.0, "rate_down": 3.0}, True), ({"rate": 4.0}, False)])
def test_a_limit_gets_a_rate_down_of_its_own_where_that_explains_more(rates, told):
    model, data = _recorded(("input_rate_limit", "w", rates))
    given = problem(data, steps_of(data))
    p = next(s.fit for s in best_candidates(given, evaluate(given, model))[0] if s.name == "input_rate_limit").model.effects[0].p
    assert ("rate_down" in p) == told
    assert p == pytest.approx(rates, rel=0.05)


def test_numbers_that_are_a_little_off_elsewhere_are_no_structure():
    """A gain that was fitted to a part: the structure of what it leaves on all of the recording is that of its error."""
    model, data = _recorded(("input_gain", "w", {"gain": 0.8}))
    whole = Whole(check(model, data), model, 20)
    off = evaluate(whole.given, _named(model, "input_gain", "w", {"gain": 0.77}))
    found = whole.structure(Selection(whole.nominal, off, 100, (), ()))
    assert (found.matters, found.tokens) == (False, ())


def test_structure_beside_a_number_stays_where_the_number_is_fitted_anew():
    model, data = _recorded(("input_gain", "w", {"gain": 0.8}))
    runs = tuple(replace(run, y=run.y + np.outer(0.02 * np.sin(0.05 * np.arange(len(run.y))), [1.0, 0.0, 0.0])) for run in data.runs)
    whole = Whole(check(model, replace(data, runs=runs)), model, 20)
    off = evaluate(whole.given, _named(model, "input_gain", "w", {"gain": 0.77}))
    found = whole.structure(Selection(whole.nominal, off, 100, (), ()))
    assert found.matters


ONE_LATE = ("input_delay", "w", {"delay": 0.12})


@pytest.mark.parametrize(
    ("lacks", "found"),
    [
        ([("input_lag", "v", {"time_constant": 0.12}), ONE_LATE], (("input_delay", "w"), ("input_lag", "v"))),
        ([("input_delay", "*", {"delay": 0.12})], (("input_delay", "*"),)),
    ],
)
def test_a_delay_of_all_inputs_is_one_of_some_where_another_input_lags(lacks, found):
    model, data = _recorded(*lacks)
    given = problem(data, steps_of(data))
    nominal = evaluate(given, model)
    ranking, _ = best_candidates(given, nominal)
    late = fitted(given, nominal, _named(model, "input_delay", "*", {"delay": 0.12}))
    assert names(parted(given, late, ranking, STRICT).model) == found


def test_what_acts_on_all_inputs_together_is_not_parted():
    model, data = _recorded(("wheel_saturation", "*", {"speed": 0.25, "track": 0.4}), ("input_lag", "v", {"time_constant": 0.3}))
    given = problem(data, steps_of(data))
    nominal = evaluate(given, model)
    ranking, _ = best_candidates(given, nominal)
    fit = fitted(given, nominal, _named(model, "wheel_saturation", "*", {"speed": 0.25, "track": 0.4}))
    assert parted(given, fit, ranking, STRICT) is fit
