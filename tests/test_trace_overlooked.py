"""What explains much at first sight, and turns out to be none, hides nothing that explains less."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import Problem, evaluate, gain, problem
from s2r_runtime.trace.selection import scores, stepwise

DT_S = 0.02
MODEL = compose(ModelSpec("double_integrator", DT_S))


def _given(slow_y: float) -> Problem:
    """A body that is braked hard along x, and a little along y."""
    drags = tuple(EffectSpec("viscous_friction", name, {"coefficient": c}) for name, c in (("vx", 2.0), ("vy", slow_y)))
    robot = compose(ModelSpec("double_integrator", DT_S, {}, drags))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, (40, 2)), 20, axis=0)
    x, hidden, rows = np.zeros((1, 4)), robot.at_rest(1), [np.zeros(4)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(MODEL, [(np.array(rows) + 0.002 * rng.normal(size=(len(rows), 4)), u)])
    return problem(data, steps_of(data))


@pytest.mark.parametrize(("slow_y", "found"), [(0.1, {("viscous_friction", "vy")}), (0.0, set())])
def test_what_is_refused_hides_nothing_else(monkeypatch, slow_y, found):
    given, accepted = _given(slow_y), stepwise.accepted
    asked = []

    def but_along_x(given, fit, base, *more):
        new = {*scores.names(fit.model)} - {*scores.names(base.model)}
        asked.extend(new)
        return {channel for _, channel in new} <= {"vy", "ay", "y"} and accepted(given, fit, base, *more)

    monkeypatch.setattr(stepwise, "accepted", but_along_x)
    chosen = stepwise.called_for(given, MODEL, 50, lambda share: None)
    assert {*scores.names(chosen.fit.model)} == found
    assert ("viscous_friction", "vx") in asked
    if slow_y:
        monkeypatch.setattr(stepwise, "overlooked", lambda *_: [])
        assert not stepwise.called_for(given, MODEL, 50, lambda share: None).fit.added


def test_nothing_is_asked_again_where_the_rest_says_too_little(monkeypatch):
    given = _given(0.1)
    base = evaluate(given, MODEL)
    found, _ = scores.best_candidates(given, base)
    assert ("viscous_friction", "vy") in {(s.name, s.channel) for s in scores.overlooked(given, base, found, scores.STRICT, 20.0)}
    monkeypatch.setattr(scores, "fitted", lambda *_: pytest.fail("fitted again"))
    assert scores.overlooked(given, base, found, scores.STRICT, 1e5) == []
    assert scores.overlooked(given, base, [], scores.STRICT, 20.0) == []


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_what_makes_next_to_nothing_of_what_is_looked_for_is_not_gone_on_from(share):
    """A drag that explains so many nats, where something without a name explains a little fewer, or more, than five times as many."""
    given = _given(0.1)
    usual = stepwise.called_for(given, MODEL, 50, lambda share: None)
    before = stepwise.Selection(usual.nominal, usual.nominal, usual.tried, usual.ranking, ())
    lacks = share * gain(usual.fit, usual.nominal) / stepwise.A_PART  # of both axes, which are looked for together
    chosen = stepwise.called_for(given, MODEL, 50, lambda share: None, scores.LENIENT, before, lacks=lacks)
    assert bool(chosen.fit.added) == (share < 1.0)
