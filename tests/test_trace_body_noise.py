"""Noise that pushes a robot along its body is noise, and no push that wanders."""

import math
from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace import fields
from s2r_runtime.trace.body_noise import BodyNoise, body_noise
from s2r_runtime.trace.dataset import from_arrays
from s2r_runtime.trace.fitting import evaluate, problem
from s2r_runtime.trace.lack_of_fit import left_of
from s2r_runtime.trace.residual import steps_of

DT, STEPS = 0.05, 900


def _left(seed, along, keep=0.0, sideways=0.0):
    """What a unicycle's model leaves of a drive whose speed is off by `along`, m/s, of which a part `keep` goes on in the next step, and
    which is pushed sideways by so much.
    """
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([0.1, -1.2], [0.5, 1.2], (STEPS // 20, 2)), 20, axis=0)
    x, off, rows = np.zeros(3), 0.0, [np.zeros(3)]
    for v, w in u:
        off = keep * off + math.sqrt(1.0 - keep * keep) * along * rng.normal()
        ahead, across = v + off, sideways * rng.normal()
        c, s = math.cos(x[2]), math.sin(x[2])
        x = x + DT * np.array([ahead * c - across * s, ahead * s + across * c, w]) + rng.normal(size=3) * [3e-4, 3e-4, 1e-3]
        rows.append(x)
    y = np.array(rows) + rng.normal(size=(STEPS + 1, 3)) * [8e-4, 8e-4, 2e-3]
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    given = problem(data := from_arrays(model, [(y, u)]), steps_of(data))
    return left_of(given, evaluate(given, model))


def _by_state(left):
    """The same, of which no noise goes along the body."""
    plain = replace(left)
    plain.known["body noise"] = BodyNoise(plain, None, 0.0, (left.fit.whiten, left.fit.z))
    return plain


@pytest.mark.parametrize("seed", range(2))
def test_wheels_that_slip_now_more_now_less_are_noise_along_the_way(seed):
    """By state, a push that may be another one every few steps seems to explain some eighty nats."""
    left = _left(seed, along=0.02)
    found, plain = body_noise(left), _by_state(left)
    heading = left.given.steps.y0[:, 2]
    assert np.allclose(found.push, np.column_stack([np.cos(heading), np.sin(heading), 0.0 * heading]))
    assert fields.bare_nats(left) > fields.bare_nats(plain) + 50.0
    assert fields.wandering_nats(plain) > fields.bare_nats(plain) + 50.0
    assert fields.wandering_nats(left) < fields.bare_nats(left) + 5.0


@pytest.mark.parametrize("along", [0.02, 0.06])
def test_its_share_is_what_it_is_of_the_noise_of_the_process(along):
    """Beside 0.3 mm a step in each direction: 0.85, and 0.98. The values that are tried are a factor of 5 apart at most."""
    found = body_noise(_left(5, along))
    rest = 2.0 * 3e-4**2 / ((DT * along) ** 2 + 2.0 * 3e-4**2)
    assert rest / 5.0 < 1.0 - found.share < rest * 5.0


def test_it_may_push_sideways():
    left = _left(4, along=0.0, sideways=0.06)
    heading = left.given.steps.y0[:, 2]
    assert np.allclose(body_noise(left).push, np.column_stack([-np.sin(heading), np.cos(heading), 0.0 * heading]))


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_has_no_direction_keeps_its_variances(seed):
    left = _left(seed, along=0.06, sideways=0.06)
    assert body_noise(left).push is None
    assert body_noise(left).white[0] is left.fit.whiten


@pytest.mark.parametrize("seed", range(3))
def test_what_goes_on_from_step_to_step_is_a_push(seed):
    left = _left(seed, along=0.06, keep=0.9)
    assert body_noise(left).push is None
    assert fields.wandering_nats(left) > fields.bare_nats(left) + 50.0


@pytest.mark.parametrize("seed", range(3))
def test_beside_what_took_it_up_nothing_of_it_is_left(seed):
    """Of what another model leaves, the likelier of the two is taken."""
    left = _left(seed, along=0.06)
    found = body_noise(left)
    quiet = np.random.default_rng(seed).normal(size=left.r.shape) * np.sqrt(left.fit.noise.q + left.fit.noise.r)
    whiten, z = found.of(left.fit.noise, quiet)
    plain = left.fit.whiten
    assert whiten.logdet == pytest.approx(plain.logdet)
    assert np.allclose(z, plain(quiet))
    whiten, _ = found.of(left.fit.noise, left.r)
    assert whiten.logdet == pytest.approx(found.white[0].logdet)
