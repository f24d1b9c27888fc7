"""Delays of a robot whose wheels turn at once as they are told."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_streams
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.pipeline import trace

DT_S, TICK_S, TICKS = 0.01, 0.001, 6000
RADIUS_M, TRACK_M = 0.05, 0.4


@pytest.mark.parametrize("seed", first(2, range(6)))
def test_a_delay_is_found_where_wheels_say_it_although_no_slope_leads_there(seed):
    """Commands come every 6 to 10 ms. Of a delay between 64 and 65 ms, measured wheels are the same; the pose is too noisy to say which."""
    rng = np.random.default_rng([60, seed])
    stamps = np.cumsum(rng.integers(6, 11, size=TICKS // 6)) * TICK_S
    stamps = stamps[stamps < TICKS * TICK_S]
    f, phase = rng.uniform(0.1, 0.8, (3, 2, 1)), rng.uniform(0.0, 6.3, (3, 2, 1))
    asked = 20.0 + 4.0 * np.sum(np.cos(2.0 * np.pi * f * stamps + phase), axis=0).T
    delay = np.array([0.0, rng.uniform(0.0642, 0.0648)])
    t = TICK_S * np.arange(TICKS)
    wheels = np.column_stack([_held(stamps, asked[:, j], t + 1e-9 - delay[j]) for j in range(2)])
    ahead, turn = RADIUS_M * wheels.mean(axis=1) * TICK_S, RADIUS_M / TRACK_M * np.diff(wheels, axis=1)[:, 0] * TICK_S
    theta = np.concatenate([[0.0], np.cumsum(turn)[:-1]])
    x = np.column_stack([np.concatenate([[0.0], np.cumsum(ahead * e)[:-1]]) for e in (np.cos(theta), np.sin(theta))])
    states = np.column_stack([x, theta, wheels])[::10]
    measured = states + rng.normal(size=states.shape) * [0.01, 0.01, 0.01, 0.1, 0.1]
    exact = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
    model = compose(ModelSpec("differential_drive", DT_S, {"wheel_radius": RADIUS_M, "track": TRACK_M}, (exact,)))
    found = trace(from_streams(model, [(Stream(t[::10], measured), Stream(stamps, asked))], "a table"), model)
    assert (found.verdict, found.depends_on) == ("traced", ())
    (effect,) = found.effects
    assert (effect.name, effect.channel) == ("input_delay", "cmd_right")
    assert 0.064 <= effect.values["delay"] <= 0.065
    _, low, high, _ = effect.parameters["delay"]
    assert low <= delay[1] <= high


def _held(stamps, values, t):
    """Values that hold from their stamps on, at times t; zero before the first one."""
    row = np.searchsorted(stamps, t, side="right") - 1
    return np.where(row >= 0, values[row], 0.0)
