"""Noise that pushes a robot along its body is noise, and no field; what goes on from step to step is none of it."""

import math

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.lack_of_fit import left_of
from s2r_runtime.trace.estimation import body_frame_noise
from s2r_runtime.trace.estimation.body_frame_noise import body_noise, whitener
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.hypotheses import random_fields

DT, STEPS = 0.05, 900
PROCESS, SENSOR = np.array([3e-4, 3e-4, 1e-3]), np.array([8e-4, 8e-4, 2e-3])


def _left(seed, along, *, sideways=0.0, wind=0.0, process=PROCESS, sensor=SENSOR, floor=lambda x: 1.0, rolls=lambda x: 1.0):
    """What a unicycle's model leaves of a drive whose speed is off by `along` m/s in each step, and by `wind` m/s for a second or two;
    which is pushed sideways by so much; and turns, or rolls, on a floor that makes more or less of it here and there.
    """
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([0.1, -1.2], [0.5, 1.2], (STEPS // 20, 2)), 20, axis=0)
    x, blows, rows = np.zeros(3), 0.0, [np.zeros(3)]
    for v, w in u:
        blows += -DT * blows + math.sqrt(2.0 * DT) * wind * rng.normal()
        ahead, across = rolls(x) * v + blows + along * rng.normal(), sideways * rng.normal()
        c, s = math.cos(x[2]), math.sin(x[2])
        x = x + DT * np.array([ahead * c - across * s, ahead * s + across * c, floor(x) * w]) + rng.normal(size=3) * process
        rows.append(x)
    y = np.array(rows) + rng.normal(size=(STEPS + 1, 3)) * sensor
    return _of(compose(ModelSpec("unicycle", DT, {}, ())), y, u)


def _of(model, y, u):
    given = problem(data := from_arrays(model, [(y, u)]), steps_of(data))
    return left_of(given, evaluate(given, model))


def _headed(left, along):
    """(n, nx) along the body, or across it."""
    heading = left.given.steps.y0[:, 2] + (0.0 if along else 0.5 * math.pi)
    return np.column_stack([np.cos(heading), np.sin(heading), 0.0 * heading])


@pytest.mark.parametrize("along", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_it_goes_along_the_body_or_across(seed, along):
    left = _left(seed, 0.06 if along else 0.0, sideways=0.0 if along else 0.06)
    assert np.allclose(body_noise(left).push, _headed(left, along))


@pytest.mark.parametrize("along", [0.01, 0.02, 0.06])
def test_its_share_is_what_it_is_of_the_noise_of_the_process(along):
    """Beside 0.3 mm a step in each direction: 0.58, 0.85, and 0.98. What is tried is a factor of 4 apart, in what is left of a variance."""
    found = body_noise(_left(5, along))
    rest = 2.0 * PROCESS[0] ** 2 / ((DT * along) ** 2 + 2.0 * PROCESS[0] ** 2)
    assert rest / 4.0 < 1.0 - found.share < rest * 4.0


def test_shares_leave_the_trace_as_it_is_and_floors_where_they_are():
    """Against the whole covariance: of one step alone, after which nothing is joined."""
    left = _left(0, 0.06)
    noise, floor = left.fit.noise, left.given.floor
    for heading in (0.3, 2.0):
        push = np.tile([math.cos(heading), math.sin(heading), 0.0], (STEPS, 1))
        given, plain = whitener(left, noise, push, 0.8), left.fit.whiten
        unit = np.zeros((STEPS, 3, 3))
        unit[0] = np.eye(3)
        covariances = [np.linalg.inv(white(unit)[0].T @ white(unit)[0]) for white in (given, plain)]
        spare = 0.8 * (noise.q - floor.q) * [1.0, 1.0, 0.0]
        expected = covariances[1] - np.diag(spare) + np.sum(spare) * np.outer(push[0], push[0])
        assert np.allclose(covariances[0], expected, rtol=0.02, atol=1e-9)  # what follows the step is whitened beside it
        assert np.trace(expected) == pytest.approx(np.trace(covariances[1]))


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_has_no_direction_is_by_state(seed):
    assert body_noise(_left(seed, 0.06, sideways=0.06)) is None


@pytest.mark.parametrize("process", [0.0, 1e-9])
@pytest.mark.parametrize("sensor", [1e-9, 1e-6, 1e-5])
def test_what_is_more_precise_than_a_model_is_meant_to_be_has_no_direction(process, sensor):
    """The floor of the noise is nobody's share."""
    assert body_noise(_left(1, 0.0, process=np.full(3, process), sensor=np.full(3, sensor))) is None


@pytest.mark.parametrize(("along", "wind"), [(0.0, 0.06), (0.06, 0.06), (0.1, 0.04)])
@pytest.mark.parametrize("seed", range(3))
def test_what_goes_on_is_a_push_however_loud_the_noise_is(seed, along, wind):
    assert body_noise(_left(seed, along, wind=wind)) is None


def test_a_joint_has_no_body():
    rng = np.random.default_rng(0)
    u, x, rows = np.repeat(rng.uniform(-2.0, 2.0, (30, 1)), 20, axis=0), np.zeros(2), [np.zeros(2)]
    for force in u[:, 0] + rng.normal(size=600):
        x = x + np.array([0.02 * x[1] + 2e-4 * force, 0.02 * force])
        rows.append(x)
    model = compose(ModelSpec("joint", 0.02, {"mass": 1.0}, ()))
    assert body_noise(_of(model, np.array(rows) + rng.normal(size=(601, 2)) * [1e-4, 1e-3], u)) is None


@pytest.mark.slow
def test_it_makes_no_field(monkeypatch):
    """Of 12 robots that do what they are told. A field has a chance of one in a thousand to have its price; under noise by state alone,
    three have it, of which one in a hundred such tests would have one.
    """
    noisy = [_left(seed, 0.03) for seed in range(12)]
    assert [random_fields.field(left) for left in noisy] == [None] * 12
    monkeypatch.setattr(random_fields, "body_noise", lambda left: None)
    assert any(random_fields.field(left) is not None for left in noisy)


@pytest.mark.parametrize("seed", range(3))
def test_a_floor_is_a_field_beside_it(seed):
    left = _left(seed, 0.03, floor=lambda x: 1.0 - 0.5 * math.sin(4.0 * math.pi * x[0]) * math.cos(4.0 * math.pi * x[1]))
    assert body_noise(left) is not None
    found = random_fields.field(left)
    assert found is not None
    assert found.tokens == ("position",)


@pytest.mark.parametrize("seed", range(3))
def test_a_floor_that_slips_here_and_there_is_no_noise_along_the_body(seed):
    """Patches of 6 cm, where it goes up to 2.5 cm in a step. Of a step or two, they are as good as noise, which explains far more."""
    left = _left(seed, 0.0, rolls=lambda x: 1.0 - 0.4 * math.sin(16.0 * math.pi * x[0]) * math.cos(16.0 * math.pi * x[1]))
    assert body_noise(left) is None
    assert random_fields.field(left) is not None


def test_it_must_be_clear(monkeypatch):
    """Of a robot without any, the likeliest of six brings a nat or two."""
    lefts = [_left(seed, 0.0) for seed in range(6)]
    assert [body_noise(left) for left in lefts] == [None] * 6
    monkeypatch.setattr(body_frame_noise, "CLEARLY", -1e9)
    assert any(body_noise(left) is not None for left in lefts)
