"""A precise position beside a loud speed: the speed's noise makes nearly all of the position's residual, and hides its own."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.noise import Noise, Whitener, estimate, hidden_by_others, together
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.pipeline import trace

DT_S, ROWS = 0.004, 570
JOINT = compose(ModelSpec("joint", DT_S, {"mass": 0.2}))


def _driven(seed, sigma, *effects, rows=ROWS):
    robot = compose(ModelSpec("joint", DT_S, {"mass": 0.2}, effects))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2.0, 2.0, rows // 10 + 1), 10)[:rows, None]
    x, hidden, states = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(rows):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        states.append(x[0])
    return from_arrays(JOINT, [(np.array(states) + rng.normal(size=(rows + 1, 2)) * sigma, u)])


@pytest.mark.parametrize("seed", range(4))
def test_both_sensors_are_known(seed):
    """1e-5 beside 0.06 * 0.004 = 2.4e-4 in a step. A standard deviation is known to 1 / sqrt(2 * 2000), 0.016 of it."""
    sigma = np.array([1e-5, 0.06])
    data = _driven(seed, sigma, rows=2000)
    given = problem(data, steps_of(data))
    fit = evaluate(given, JOINT)
    assert hidden_by_others(given.jacobian(JOINT), Noise(np.zeros(2), sigma**2))
    assert np.sqrt(fit.noise.r[1]) == pytest.approx(0.06, rel=0.07)
    assert 2.0 * fit.noise.r[0] + fit.noise.q[0] == pytest.approx(2e-10, rel=0.4)
    z = np.clip(fit.z, -4.0, 4.0)
    assert np.mean(z**2, axis=0) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_no_other_noise_is_clearly_likelier(seed):
    """Held against the whole likelihood itself, about the maximum, along each variance and a step of each pair."""
    data = _driven(seed, [1e-5, 0.06])
    given = problem(data, steps_of(data))
    r, f, joined = given.residual(JOINT), given.jacobian(JOINT), given.steps.joined
    found = together(r, f, joined, np.zeros_like(r), [Noise(np.full(2, 1e-8), np.full(2, 1e-8))], given.floor)

    def nats(noise):
        whiten = Whitener(noise, f, joined)
        return float(-0.5 * np.sum(whiten(r) ** 2)) - whiten.logdet

    best = nats(found)
    for times_q in np.array([[1, 1], [2, 1], [0.5, 1], [1, 2], [1, 0.5], [3, 3]]):
        for times_r in np.array([[1, 1], [1.2, 1], [0.8, 1], [1, 1.2], [1, 0.8], [0.5, 2]]):
            other = Noise(np.maximum(found.q * times_q, given.floor.q), np.maximum(found.r * times_r, given.floor.r))
            assert nats(other) < best + 1.0


def test_where_nothing_is_hidden_states_are_asked_one_by_one():
    data = _driven(0, [1e-3, 2e-3])
    given = problem(data, steps_of(data))
    fit = evaluate(given, JOINT)
    assert not hidden_by_others(given.jacobian(JOINT), fit.noise)
    assert np.sqrt(fit.noise.r) == pytest.approx([1e-3, 2e-3], rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.02, 0.06])
@pytest.mark.parametrize(
    ("name", "values"),
    [("input_gain", {"gain": 0.2}), ("input_saturation", {"low": -0.3, "high": 0.3}), ("input_deadband", {"width": 1.0})],
)
def test_a_loud_speed_hides_no_effect(name, values, noise):
    """The position tells it. With the noise of each state by itself a limit seemed likelier than the gain that was there."""
    result = trace(_driven(4, [1e-5, noise], EffectSpec(name, "force", values)), JOINT)
    assert [(e.name, e.values) for e in result.effects] == [(name, {k: pytest.approx(v, rel=0.01) for k, v in values.items()})]


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(10, 14)))
@pytest.mark.parametrize(
    "effects",
    [
        (EffectSpec("coulomb_friction", "qd", {"force": 0.3}), EffectSpec("viscous_friction", "qd", {"coefficient": 0.5})),
        (EffectSpec("input_delay", "force", {"delay": 0.012}),),
    ],
    ids=["friction", "delay"],
)
def test_a_loud_speed_makes_no_other_name_and_no_memory(seed, effects):
    """Two of these eight were named wrongly or not at all, and a delay came with memory that was left."""
    result = trace(_driven(seed, [1e-5, 0.02], *effects), JOINT)
    true = {e.name: next(iter(e.parameters.values())) for e in effects}
    assert sorted(e.name for e in result.effects) == sorted(true)
    for e in result.effects:  # friction by direction or not
        assert [*e.values.values()] == [pytest.approx(true[e.name], rel=0.05)] * len(e.values)
    assert not {*result.depends_on} - {"noise"}


def test_an_outlier_is_left_to_itself():
    data = _driven(5, [1e-5, 0.06])
    y = data.runs[0].y
    y[100] += [0.0, 5.0]
    y[300] += [3e-3, 0.0]
    given = problem(data, steps_of(data))
    r, f = given.residual(JOINT), given.jacobian(JOINT)
    found = estimate(r, f, given.steps.joined, given.floor)
    assert np.sqrt(found.r[1]) == pytest.approx(0.06, rel=0.15)
    assert 2.0 * found.r[0] + found.q[0] == pytest.approx(2e-10, rel=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_what_another_model_left_is_no_trap(seed):
    """A model that lacks an effect leaves much noise of the process, and little of the sensors. From there the position's is not found."""
    data = _driven(seed, [1e-5, 0.06])
    given = problem(data, steps_of(data))
    r, f, joined = given.residual(JOINT), given.jacobian(JOINT), given.steps.joined
    alone = estimate(r, f, joined, given.floor)
    after = estimate(r, f, joined, given.floor, Noise(np.array([1e-10, 3.6e-3]), np.array([3e-11, 1e-12])))
    assert after.r == pytest.approx(alone.r, rel=0.1)
    whiten = [Whitener(noise, f, joined) for noise in (alone, after)]
    nats = [float(-0.5 * np.sum(w(r) ** 2)) - w.logdet for w in whiten]
    assert nats[1] > nats[0] - 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_that_is_more_precise_than_a_model_is_meant_to_be_makes_no_coloured_noise(seed):
    """Where it goes far in a step, the least noise of the process is as large as the encoder's: what is left is steadier than that."""
    joint, rng, rows = compose(ModelSpec("joint", 0.02, {"mass": 2.0})), np.random.default_rng(seed), 800
    u = np.repeat(rng.uniform(-20.0, 20.0, rows // 16), 16)[:, None]
    x, states = np.zeros((1, 2)), []
    for k in range(rows):
        states.append(x[0])
        x, _ = joint.step(x, u[k : k + 1], joint.at_rest(1))
    data = from_arrays(joint, [(np.array([*states, x[0]]) + rng.normal(size=(rows + 1, 2)) * [1e-5, 1e-3], u)])
    given = problem(data, steps_of(data))
    assert given.floor.q[0] > 0.1 * 1e-5**2
    result = trace(data, joint)
    assert (result.verdict, result.depends_on) == ("none", ())
