"""Entries of a vector or a matrix that the drive does not tell apart are drawn in; what is well known stays."""

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.intervals import spread_of
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem, told, values_of
from s2r_runtime.trace.estimation.shrinkage import _size, drawn_in

pytestmark = pytest.mark.slow

FIELD = [[0.02, 0.04], [-0.03, 0.01]]


def _pushed(name, channel, p, seed, turning):
    """Problem and fit of a unicycle on which something pushes. turning: rad/s; where it is 0, it goes along one line."""
    nominal = compose(ModelSpec("unicycle", 0.05))
    robot = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec(name, channel, p),)))
    rng = np.random.default_rng(seed)
    u = np.column_stack([np.repeat(rng.uniform(0.1, 0.5, 15), 10), np.repeat(rng.uniform(-turning, turning, 15), 10)])
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(nominal, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * 0.01, u)])
    given = problem(data, steps_of(data))
    effect = AppliedEffect(registry().get("effects", name), channel, p)
    return given, fitted(given, evaluate(given, nominal), insert(nominal, effect, 0))


def test_a_field_that_was_seen_along_one_line_is_nearer_to_the_truth_on_average():
    """Beside the line the likeliest entries are the noise's: seldom far off, and then very far."""
    off = []
    for seed in range(40):
        given, fit = _pushed("position_field", "*", {"matrix": FIELD}, seed, turning=0.0)
        fit, there, near = told(given, fit)
        less = drawn_in(given, fit, there, near)
        off.append([np.sum((values_of(f.model, f.free) - np.ravel(FIELD)) ** 2) for f in (fit, less)])
        assert less.white > fit.white - 4.0  # what the recording does tell is kept
    likeliest, drawn = np.array(off).T
    assert np.mean(drawn) < 0.8 * np.mean(likeliest)
    assert np.max(drawn) < np.max(likeliest)


def test_what_is_well_known_stays():
    push = {"x": 0.1, "y": 0.02}
    given, fit = _pushed("constant_disturbance", "world", push, 0, turning=2.0)
    fit, there, near = told(given, fit)
    less, spread = drawn_in(given, fit, there, near), np.sqrt(np.diag(spread_of(there, near).widened))
    assert np.all(np.abs(values_of(less.model, less.free) - values_of(fit.model, fit.free)) < 0.3 * spread)


@pytest.mark.parametrize(("name", "channel", "p"), [("input_gain", "w", {"gain": 0.8}), ("lateral_slip", "*", {"coefficient": 0.1})])
def test_one_number_by_itself_is_as_the_data_say(name, channel, p):
    given, fit = _pushed(name, channel, p, 0, turning=1.0)
    fit, there, near = told(given, fit)
    assert drawn_in(given, fit, there, near) is fit


def test_the_size_of_entries_is_that_under_which_they_are_likeliest():
    """Against a direct search: e ~ N(0, own + t^2 I)."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        root = rng.normal(size=(3, 3))
        own, e = root @ root.T, 3.0 * rng.normal(size=3)

        def nats(size, own=own, e=e):
            total = own + size * np.eye(3)
            return -0.5 * np.linalg.slogdet(total)[1] - 0.5 * e @ np.linalg.solve(total, e)

        tried = np.logspace(-9, 4, 2000)
        assert nats(_size(e, own)) == pytest.approx(max(map(nats, tried)), abs=0.02)
