"""What is left is told by terms in two things at once, and by overtones of what was named."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.hypotheses.crossed_basis import bent_product, over_time, overtones
from s2r_runtime.trace.pipeline import trace

DT, PARTS = 0.02, 10
JOINT = compose(ModelSpec("joint", DT, {"mass": 2.0}))


def _joint(friction, rows=1200, seed=4):
    """A mass of 2 kg under forces that are held; friction(t, v): N."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-4.0, 4.0, rows // 50), 50)
    x, v, t, states = 0.0, 0.0, 0.0, [(0.0, 0.0)]
    for force in u:
        for _ in range(PARTS):
            v += DT / PARTS * (force - friction(t, v)) / 2.0
            x += DT / PARTS * v
            t += DT / PARTS
        states.append((x, v))
    y = np.array(states) + rng.normal(size=(rows + 1, 2)) * [0.004, 0.004]
    return from_arrays(JOINT, [(y, u[:, None])])


@pytest.mark.slow
def test_friction_that_goes_as_a_bearing_warms_up_depends_on_the_speed():
    found = trace(_joint(lambda t, v: 2.0 * math.exp(-t / 4.0) * v), JOINT)
    assert found.depends_on[0] == "speed"


def test_terms_over_time_have_friction_that_is_the_same_all_the_time_in_them():
    t, v = np.linspace(0.0, 1.0, 50), np.sin(np.arange(50.0))
    terms = over_time(t, [v])
    assert np.array_equal(terms[0], v)
    assert np.linalg.matrix_rank(np.array(terms)) == len(terms) == 6


def test_a_product_that_acts_from_some_size_on_is_among_its_bent_terms():
    a, b = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 400))
    p = a * b / np.max(np.abs(a * b))
    beyond = np.sign(p) * np.maximum(np.abs(p) - 0.25, 0.0)
    table = np.array(bent_product(a, b)).T
    assert np.allclose(table @ np.linalg.lstsq(table, beyond, rcond=None)[0], beyond)
    assert not np.any(bent_product(a, 0.0 * b))


def test_a_square_wave_is_a_sine_and_its_overtones():
    sine = EffectSpec("periodic_disturbance", "force", {"frequency": 0.5, "amplitude": 1.0, "phase": 0.0})
    model = compose(ModelSpec("joint", DT, {"mass": 2.0}, (sine,)))
    steps = SimpleNamespace(t=7.0 + DT * np.arange(1000))  # ten periods
    push = np.tile([0.0, 1.0], (1000, 1))
    (terms,) = overtones(steps, model, DT, [push])
    t = steps.t - 7.0 + 0.5 * DT
    square, own = np.sign(np.sin(np.pi * t)), 4.0 / np.pi * np.sin(np.pi * t)
    table = np.array([term[:, 1] for term in terms]).T
    rest = (square - own) - table @ np.linalg.lstsq(table, square - own, rcond=None)[0]
    share = (1.0 / 9.0 + 1.0 / 25.0) / sum(1.0 / k**2 for k in range(3, 4001, 2))  # of all overtones, by Fourier
    assert 1.0 - np.sum(rest**2) / np.sum((square - own) ** 2) == pytest.approx(share, abs=0.02)
    assert not list(overtones(steps, JOINT, DT, [push]))


@pytest.mark.parametrize(("frequency", "seen"), [(4.0, (2, 3, 4, 5)), (6.0, (2, 3, 4)), (10.0, (2,)), (20.0, ())])
def test_an_overtone_that_is_too_fast_to_be_seen_is_not_asked_about(frequency, seen):
    """At 50 Hz, five times 10 Hz would be a constant."""
    sine = EffectSpec("periodic_disturbance", "force", {"frequency": frequency, "amplitude": 1.0, "phase": 0.0})
    model = compose(ModelSpec("joint", DT, {"mass": 2.0}, (sine,)))
    found = list(overtones(SimpleNamespace(t=DT * np.arange(200)), model, DT, [np.ones((200, 2))]))
    assert [len(terms) for terms in found] == ([2 * len(seen)] if seen else [])
    assert all(np.ptp(term) > 1.0 for terms in found for term in terms)
