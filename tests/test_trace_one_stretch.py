"""A name that comes from one short stretch of the recording may be about that time; the answer says so."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.assemble import with_time
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics import whole_recording
from s2r_runtime.trace.diagnostics.block_influence import _once, in_one_stretch
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.pipeline import trace

DT, HOLD = 0.05, 20
UNICYCLE = compose(ModelSpec("unicycle", DT))


def _nats(*where, each=2.0, n=800):
    nats = np.zeros(n)
    for first in where:
        nats[first : first + 25] = each
    return nats


@pytest.mark.parametrize(
    ("nats", "once"),
    [
        (_nats(300), True),
        (_nats(300, 600), False),
        (_nats(300, 340), True),  # two holds, a stretch
        (_nats(300, each=20.0) + _nats(600, each=0.6), False),  # a thirtieth, and beyond chance by itself
        (_nats(300) + 0.003, True),
        (np.zeros(0), False),
    ],
    ids=["once", "twice", "next to each other", "a little, but sure", "no more than chance", "not asked"],
)
def test_a_name_needs_two_stretches(nats, once):
    assert _once(nats, 1) == once


def _limited(met):
    """A unicycle that turns at 0.6 rad/s at most, and was asked for more in some of 40 holds of a second."""
    rng = np.random.default_rng(5)
    level = rng.uniform([0.1, -0.4], [0.5, 0.4], (40, 2))
    level[list(met), 1] = 0.9
    u = np.repeat(level, HOLD, axis=0)
    x, rows = np.zeros(3), [np.zeros(3)]
    for v, w in u:
        x = x + DT * np.array([v * np.cos(x[2]), v * np.sin(x[2]), min(w, 0.6)])
        rows.append(x)
    return from_arrays(UNICYCLE, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * [0.002, 0.002, 0.02], u)])


def _named(name, p):
    """A unicycle with an effect that the data put there."""
    (given,) = compose(ModelSpec("unicycle", DT, {}, (EffectSpec(name, "w", p),))).effects
    return replace(UNICYCLE, effects=(Added(given.effect, given.channel, given.p),))


@pytest.mark.parametrize(("met", "once"), [((11,), True), ((3, 11, 22, 34), False)], ids=["once", "now and then"])
def test_a_limit_that_was_met_once_was_seen_in_one_stretch(met, once):
    data = _limited(met)
    given = problem(data, steps_of(data))
    assert in_one_stretch(given, evaluate(given, _named("input_saturation", {"high": 0.6}))) == once


def test_a_change_at_some_time_is_about_time_anyhow():
    data = _limited((11,))
    given = problem(data, steps_of(data))
    assert not in_one_stretch(given, evaluate(given, _named("regime_change", {"time": 39.5, "gain": 0.5})))


@pytest.mark.slow
def test_the_answer_says_that_a_name_may_be_about_that_time(monkeypatch):
    data = _limited((3, 11, 22, 34))
    for once in (False, True):
        monkeypatch.setattr(whole_recording, "in_one_stretch", lambda *of, once=once: once)
        found = trace(data, UNICYCLE)
        assert [(e.name, e.channel) for e in found.effects] == [("input_saturation", "w")]
        assert ("time" in found.may_depend_on) == ("time" in found.depends_on) == once


@pytest.mark.slow
def test_what_is_left_beyond_doubt_is_no_less_sure_for_a_name_from_one_stretch():
    found = trace(_limited((3, 11, 22, 34)), UNICYCLE)
    left = replace(found, depends_on=("time",))
    assert "structure" in with_time(left).text()
    assert with_time(left).may_depend_on == ()
    assert with_time(found).may_depend_on == ("time",)
