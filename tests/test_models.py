"""The nominal models step as docs/recordings.md states, batched; a composed model adds effects to that step."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import compose, wrap
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

NAMES = ("unicycle", "differential_drive", "bicycle", "double_integrator", "joint")


def _model(name, dt=0.1, effects=(), **parameters):
    return compose(ModelSpec(name, dt, parameters, tuple(EffectSpec(*e) for e in effects)))


def _draw(model, n=7, seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, len(model.states))), rng.normal(size=(n, len(model.inputs)))


def test_unicycle_is_euler_with_the_heading_at_the_start():
    x, u = np.array([[1.0, 2.0, 0.3]]), np.array([[0.2, 1.5]])
    after, _ = _model("unicycle", 0.033).step(x, u, ())
    assert after[0] == pytest.approx([1.0 + 0.033 * 0.2 * math.cos(0.3), 2.0 + 0.033 * 0.2 * math.sin(0.3), 0.3 + 0.033 * 1.5])


def test_differential_drive_reaches_its_wheel_commands_at_once_and_moves_with_them():
    x, u = np.array([[1.0, 2.0, 0.3, 9.0, -9.0]]), np.array([[4.0, 6.0]])
    after, _ = _model("differential_drive", 0.05, wheel_radius=0.165, track=0.55).step(x, u, ())
    v, w = 0.165 * 5.0, 0.165 * 2.0 / 0.55
    assert after[0] == pytest.approx([1.0 + 0.05 * v * math.cos(0.3), 2.0 + 0.05 * v * math.sin(0.3), 0.3 + 0.05 * w, 4.0, 6.0])


def test_bicycle_reaches_its_speed_command_at_once_and_turns_about_the_rear_axle():
    x, u = np.array([[1.0, 2.0, 0.3, 9.0]]), np.array([[0.2, 1.5]])
    after, _ = _model("bicycle", 0.025, wheel_base=0.33).step(x, u, ())
    d = 0.025 * 1.5
    assert after[0] == pytest.approx([1.0 + d * math.cos(0.3), 2.0 + d * math.sin(0.3), 0.3 + d * math.tan(0.2) / 0.33, 1.5])


def test_double_integrator_and_joint_are_exact_for_a_held_input():
    after, _ = _model("double_integrator", 0.1).step(np.array([[1.0, 2.0, 3.0, 4.0]]), np.array([[5.0, -6.0]]), ())
    assert after[0] == pytest.approx([1.0 + 0.3 + 0.025, 2.0 + 0.4 - 0.03, 3.5, 3.4])
    after, _ = _model("joint", 0.1, mass=2.0).step(np.array([[1.0, 3.0]]), np.array([[5.0]]), ())
    assert after[0] == pytest.approx([1.0 + 0.3 + 0.0125, 3.25])


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_steps_as_its_rows_do(name):
    model = _model(name)
    x, u = _draw(model)
    together, _ = model.step(x, u, ())
    alone = np.concatenate([model.step(x[i : i + 1], u[i : i + 1], ())[0] for i in range(len(x))])
    assert np.array_equal(together, alone)


@pytest.mark.parametrize("name", NAMES)
def test_a_step_leaves_its_arguments_as_they_were(name):
    model = _model(name)
    x, u = _draw(model)
    kept = x.copy(), u.copy()
    model.step(x, u, ())
    assert np.array_equal(x, kept[0])
    assert np.array_equal(u, kept[1])


@pytest.mark.parametrize("name", NAMES)
def test_every_state_and_input_has_a_unit(name):
    model = registry().get("models", name)
    assert set(model.units) == {*model.states, *model.inputs}


@given(st.floats(-50.0, 50.0))
@settings(max_examples=200)
def test_wrap_gives_the_same_direction_within_half_a_turn(angle):
    wrapped = float(wrap(np.array([angle]))[0])
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-12)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-12)


def test_a_state_that_is_reached_at_once_is_the_input_at_the_end_of_the_step_and_the_pose_moves_with_its_mean():
    lag, dt = 0.2, 0.1
    model = _model("bicycle", dt, [("input_lag", "speed_cmd", {"time_constant": lag})])
    x, _ = model.step(np.zeros((1, 4)), np.array([[0.0, 1.0]]), model.at_rest(1))
    keep = math.exp(-dt / lag)
    mean = 1.0 - lag / dt * (1.0 - keep)
    assert x[0, 0] == pytest.approx(dt * mean)
    assert x[0, 3] == pytest.approx(1.0 - keep)


def test_an_effect_behind_a_bias_rests_at_what_the_bias_makes_of_zero_input():
    model = _model("unicycle", 0.033, [("input_bias", "w", {"bias": 0.5}), ("input_delay", "*", {"delay": 0.1})])
    x, _ = model.step(np.zeros((2, 3)), np.zeros((2, 2)), model.at_rest(2))
    assert x[:, 2] == pytest.approx([0.033 * 0.5] * 2)


def test_an_effect_that_may_stand_once_is_refused_twice():
    scheme = ("integration_scheme", "*", {"scheme": "exact"})
    with pytest.raises(ConfigError, match="is there twice"):
        _model("unicycle", 0.1, [scheme, scheme])


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (("integration_scheme", "*", {"scheme": "simpson"}), "must be one of: euler, exact, rk4"),
        (("input_gain", "w", {"gain": "big"}), "must be a number"),
        (("input_saturation", "w", {"low": 1.0, "high": -1.0}), "must be below high"),
        (("input_delay", "w", {"delay": -0.1}), r"must be in \[0.0, 600.0\] s"),
        (("input_lag", "theta", {"time_constant": 0.1}), "channel is 'theta', must be one of: v, w"),
    ],
)
def test_bad_parameters_of_an_effect_are_named(effect, said):
    with pytest.raises(ConfigError, match=said):
        _model("unicycle", 0.1, [effect])


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("differential_drive", "wheel_radius", 0.0),
        ("differential_drive", "track", -0.5),
        ("joint", "mass", 0.0),
    ],
)
def test_a_size_that_no_body_has_is_refused(name, parameter, value):
    with pytest.raises(ConfigError, match=f"{parameter} is .*, must be > 0"):
        _model(name, **{parameter: value})


def test_a_size_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match=r"parameters\.wheel_base must be finite"):
        _model("bicycle", wheel_base=math.inf)
