"""Noise that wanders: a force that comes and goes within seconds, a sensor that is wrong for a while."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from seeds import first

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.checks.columns import check_plausible
from s2r_runtime.trace.data.dataset import Dataset, from_arrays
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import rms
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

FORCE = 2.4
"""Rms of the force that the motion below takes, N."""


def _ornstein_uhlenbeck(rng: np.random.Generator, n: int, memory: float, dt: float) -> Array:
    """(n,) of variance 1 that forgets within `memory` s."""
    keep = np.exp(-dt / memory)
    found = np.zeros(n)
    for k, w in enumerate(rng.normal(size=n - 1)):
        found[k + 1] = keep * found[k] + np.sqrt(1.0 - keep * keep) * w
    return found


def _held_at_work(seed: int, lag: float = 0.0) -> Dataset:
    """A joint that a controller takes along sines against a force that wanders within 2 s; with a lag of its own. Ten parts a step."""
    rng = np.random.default_rng([seed, 5])
    dt, n, parts = 0.02, 3000, 10
    h = dt / parts
    push = 0.2 * FORCE * _ornstein_uhlenbeck(rng, n * parts, 2.0, h)
    frequency, phase = rng.uniform(0.1, 0.6, 3), rng.uniform(0.0, 6.0, 3)
    e = rng.normal(size=(n + 1, 2)) * [2e-4, 1e-3]
    y, u = np.zeros((n + 1, 2)), np.zeros((n, 1))
    q = qd = acts = 0.0
    for k in range(n):
        turn = 2.0 * np.pi * frequency * k * dt + phase
        wanted, rate = 0.3 * np.sin(turn).sum(), 0.3 * (2.0 * np.pi * frequency * np.cos(turn)).sum()
        y[k] = q, qd
        u[k] = 36.0 * (wanted - q - e[k, 0]) + 8.0 * (rate - qd - e[k, 1])
        for i in range(parts):
            acts += (u[k, 0] - acts) * (1.0 - np.exp(-h / lag)) if lag else u[k, 0] - acts
            acceleration = acts + push[k * parts + i]
            q, qd = q + h * qd + 0.5 * h * h * acceleration, qd + h * acceleration
    y[n] = q, qd
    return from_arrays(compose(ModelSpec("joint", dt, {"mass": 1.0})), [(y + e, u)])


@pytest.mark.parametrize("seed", first(1, [0, 1]))
def test_a_controller_that_answers_a_force_that_wanders_is_no_memory_of_its_input(seed: int) -> None:
    data = _held_at_work(seed)
    result = trace(data, compose(ModelSpec("joint", data.dt, {"mass": 1.0})))
    assert (result.verdict, {*result.depends_on}) == ("none", {"noise"})
    assert np.all((result.floor[1] > 0.5 * rms(result.after.ends)) & (result.floor[1] < 2.0 * rms(result.after.ends)))


@pytest.mark.parametrize("seed", first(1, [2, 3]))
def test_a_lag_is_named_beside_a_force_that_wanders(seed: int) -> None:
    data = _held_at_work(seed, lag=0.05)
    result = trace(data, compose(ModelSpec("joint", data.dt, {"mass": 1.0})))
    assert [(e.name, e.channel) for e in result.effects] == [("input_lag", "force")]
    _, low, high, _ = result.effects[0].parameters["time_constant"]
    assert isinstance(low, float)
    assert isinstance(high, float)
    assert low < 0.05 < high < 1.2 * low


def test_a_sensor_that_is_wrong_for_a_while_does_not_add_up() -> None:
    rng = np.random.default_rng(8)
    dt, n = 0.02, 1500
    robot = compose(ModelSpec("unicycle", dt, {}, (EffectSpec("input_gain", "w", {"gain": 0.8}),)))
    u = np.column_stack([np.repeat(rng.uniform(0.1, 0.5, n // 25), 25), np.repeat(rng.uniform(-1.0, 1.0, n // 25), 25)])
    y, hidden = np.zeros((n + 1, 3)), robot.at_rest(1)
    for k in range(n):
        after, hidden = robot.step(y[k : k + 1], u[k : k + 1], hidden)
        y[k + 1] = after[0]
    wrong = np.column_stack([_ornstein_uhlenbeck(rng, n + 1, 0.4, dt) for _ in range(3)]) * [2e-3, 2e-3, 5e-3]
    result = trace(from_arrays(robot, [(y + wrong, u)]), compose(ModelSpec("unicycle", dt)))
    assert [(e.name, e.channel) for e in result.effects] == [("input_gain", "w")]
    ends = rms(result.after.ends)
    assert np.all((result.floor[1] > 0.6 * ends) & (result.floor[1] < 1.6 * ends))  # twice to three times as a walk


def test_what_wanders_is_told_from_what_does_not() -> None:
    rng = np.random.default_rng(9)
    joined = np.append(False, np.ones(2999, dtype=bool))
    white = rng.normal(size=(3000, 2))
    assert noises.wandering(white, joined, noises.colour(white, joined)) is None
    slow = white + np.column_stack([0.5 * _ornstein_uhlenbeck(rng, 3000, 80.0, 1.0), np.zeros(3000)])
    law = noises.wandering(slow, joined, noises.colour(slow, joined))
    assert law is not None
    assert np.any(law.slow[0])
    assert not np.any(law.slow[1])
    past = noises.Past(law, (400, 2))
    drawn = np.stack([past.follow(rng.normal(size=(400, 2))) for _ in range(1200)])[600:]
    assert past.settled
    for lag, expected in ((20, 0.25 * np.exp(-0.25)), (80, 0.25 * np.exp(-1.0))):
        assert float(np.mean(drawn[lag:, :, 0] * drawn[:-lag, :, 0])) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("late", "refused"), [(0, False), (12, True)])
def test_friction_in_closed_loop_is_no_clock_that_is_wrong(late: int, refused: bool) -> None:
    """A controller that pushes against friction asks for a force that comes after the acceleration; stamps may be late all the same."""
    rng = np.random.default_rng([19, 3])
    dt, n, parts = 0.01, 1200, 10
    h = dt / parts
    frequency, phase = rng.uniform(0.1, 0.6, 3), rng.uniform(0.0, 6.0, 3)
    e = rng.normal(size=(n + 1, 2)) * [2e-4, 1e-3]
    y, u = np.zeros((n + 1, 2)), np.zeros((n, 1))
    q = qd = 0.0
    for k in range(n):
        turn = 2.0 * np.pi * frequency * k * dt + phase
        y[k] = q, qd
        u[k] = 36.0 * (0.3 * np.sin(turn).sum() - q - e[k, 0])
        u[k] += 8.0 * (0.6 * np.pi * (frequency * np.cos(turn)).sum() - qd - e[k, 1])
        for _ in range(parts):
            acceleration = u[k, 0] - 1.8 * qd
            q, qd = q + h * qd + 0.5 * h * h * acceleration, qd + h * acceleration
    y[n] = q, qd
    model = compose(ModelSpec("joint", dt, {"mass": 1.0}))
    data = from_arrays(model, [((y + e)[late:], np.concatenate([np.zeros((late, 1)), u])[late:n])])
    if refused:
        with pytest.raises(RecordingError, match="the motion comes about"):
            check_plausible(model, data)
    else:
        check_plausible(model, data)
