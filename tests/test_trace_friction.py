"""Dry and viscous friction hide each other: a joint that a stiff controller leads along a smooth path, as industrial arms are recorded."""

import math

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.pipeline import load_dataset, trace
from s2r_runtime.trace.selection.friction_start import with_friction

INERTIA, DRY, VISCOUS = 3.5, 12.0, 9.0


def _recorded(rng, seconds, dry=DRY, viscous=VISCOUS, bias=0.0):
    """(n, 3) of t, position (an encoder's) and torque at 1 kHz."""
    f, size, phase = rng.uniform(0.1, 0.6, 4), rng.uniform(0.2, 0.4, 4), rng.uniform(0.0, 6.0, 4)
    h, parts = 2.5e-4, 4
    t = 1e-3 * np.arange(round(1000 * seconds))
    angle = 2.0 * np.pi * f * t[:, None] + phase
    w = 2.0 * np.pi * f
    goal, rate, more = ((one * size).sum(axis=1).tolist() for one in (np.sin(angle), w * np.cos(angle), -w * w * np.sin(angle)))
    q, v, rows = goal[0], rate[0], []
    for k in range(len(t)):
        seen = round(q / 3e-5) * 3e-5
        led = INERTIA * more[k] + 900.0 * (goal[k] - seen) + 120.0 * (rate[k] - v)
        torque = led + DRY * math.tanh(rate[k] / 0.02) + VISCOUS * rate[k]
        rows.append((t[k], seen, torque))
        for _ in range(parts):
            a = (torque + bias - dry * math.tanh(v / 1e-3) - viscous * v) / INERTIA
            q, v = q + h * (v + h / 2.0 * a), v + h * a
    return np.array(rows)


def _joint(dt=0.01):
    return compose(ModelSpec("joint", dt, {"mass": INERTIA}))


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
def test_a_joint_led_along_a_smooth_path_has_both_frictions_and_no_deadband(tmp_path, seed):
    rows = _recorded(np.random.default_rng(seed), 12.0)
    path = tmp_path / "joint.csv"
    np.savetxt(path, rows, delimiter=",", header="t,q,force", comments="", fmt="%.8g")
    model = _joint()
    found = {e.name: e for e in trace(load_dataset(path, model), model).effects}
    assert set(found) == {"coulomb_friction", "viscous_friction"}
    assert found["coulomb_friction"].parameters["force"][0] == pytest.approx(DRY, rel=0.01)
    assert found["viscous_friction"].parameters["coefficient"][0] == pytest.approx(VISCOUS, rel=0.01)


def _problem(rows, rng):
    """At 100 Hz with speeds, and the mean torque of each step."""
    v, mean = np.gradient(rows[:, 1], rows[:, 0]), rows[:, 2].reshape(-1, 10).mean(axis=1)
    y = np.column_stack([rows[::10, 1], v[::10] + 2e-3 * rng.normal(size=len(mean))])
    data = from_arrays(_joint(), [(y, mean[:-1, None])])
    return problem(data, steps_of(data))


def test_friction_of_one_kind_is_not_split_into_two():
    rng = np.random.default_rng(5)
    given = _problem(_recorded(rng, 10.0, viscous=0.0), rng)
    both = with_friction(given, evaluate(given, _joint()))
    sizes = {} if both is None else {a.effect.name: a.p for a in both.model.effects}
    assert both is None or sizes["viscous_friction"]["coefficient"] < 0.02 * VISCOUS


def test_a_model_with_friction_already_is_given_no_more():
    rng = np.random.default_rng(6)
    given = _problem(_recorded(rng, 4.0), rng)
    both = with_friction(given, evaluate(given, _joint()))
    assert both is not None
    assert with_friction(given, both) is None
