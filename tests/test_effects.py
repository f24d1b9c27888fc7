"""Effects do what their formulas say, batched, on every model where they make sense; step by step and over time at once alike."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

MODELS = ("unicycle", "differential_drive", "bicycle", "double_integrator", "joint")
EFFECTS = registry().names("effects")
DT = 0.05


def _starts(effect, u, model, channel):
    """What the tracer would begin from; effects that depend on time are told when the rows are."""
    if effect.name == "periodic_disturbance":  # the input alone does not show it
        return [{"frequency": f, "amplitude": 0.3, "phase": 0.5} for f in (0.3, 1.0, 4.0)]
    if getattr(effect, "timed", False):
        return effect.starts(u, model, channel, DT, DT * np.arange(len(u)))
    found = effect.starts(u, model, channel, DT)
    return found or [{p.name: min(max(0.1, p.low), p.high) for p in effect.parameters}]  # the input does not show it


def _places():
    """(effect name, model name, channel): every place that an effect offers itself for."""
    found = []
    for name in EFFECTS:
        for model in MODELS:
            found += [(name, model, channel) for channel in registry().get("effects", name).channels(registry().get("models", model))]
    return found


def _values(effect, data, model, channel):
    """A draw of parameter values within bounds and within what a robot could have."""
    u = np.array([[2.0] * len(model.inputs), [-2.0] * len(model.inputs)])
    start = data.draw(st.sampled_from(_starts(effect, u, model, channel)))
    factor = data.draw(st.floats(0.3, 3.0))
    return {k: v * factor if isinstance(v, float) else v for k, v in start.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "model_name", "channel"), _places())
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_stepping_and_the_whole_sequence_at_once_agree(name, model_name, channel, data):
    effect, model = registry().get("effects", name), registry().get("models", model_name)
    p = _values(effect, data, model, channel)
    seed = data.draw(st.integers(0, 1000))
    u = np.random.default_rng(seed).normal(size=(30, len(model.inputs)))
    z = effect.hidden(1, model, channel, DT, p)
    steps = []
    for row in u:
        acting, z = effect.input_step(row[None, :], z, model, channel, DT, p)
        steps.append(acting[0])
    assert np.allclose(np.array(steps), effect.input_sequence(u, model, channel, DT, p), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("name", "model_name", "channel"), _places())
def test_a_batch_acts_as_its_rows_do_and_leaves_the_command_as_it_was(name, model_name, channel):
    effect, model = registry().get("effects", name), registry().get("models", model_name)
    u = np.random.default_rng(2).normal(size=(6, len(model.inputs)))
    p = _starts(effect, u, model, channel)[0]
    kept = u.copy()
    z = effect.hidden(6, model, channel, DT, p)
    together, after = effect.input_step(u, z, model, channel, DT, p)
    for i in range(6):
        alone, z_alone = effect.input_step(u[i : i + 1], z[i : i + 1], model, channel, DT, p)
        assert np.array_equal(alone[0], together[i])
        assert np.array_equal(z_alone[0], after[i])
    assert np.array_equal(u, kept)


@pytest.mark.parametrize(("name", "model_name", "channel"), _places())
def test_neutral_values_change_nothing_and_every_parameter_has_a_unit(name, model_name, channel):
    effect, model = registry().get("effects", name), registry().get("models", model_name)
    for p in effect.parameters:
        assert isinstance(effect.unit(model, channel, p.name), str)
    if all(p.neutral is not None for p in effect.parameters):
        u = np.random.default_rng(3).normal(size=(20, len(model.inputs)))
        assert np.allclose(effect.input_sequence(u, model, channel, DT, {p.name: p.neutral for p in effect.parameters}), u)


@given(delay=st.floats(0.0, 0.4), seed=st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_a_delay_gives_the_mean_of_the_held_input_earlier(delay, seed):
    effect, model = registry().get("effects", "input_delay"), registry().get("models", "unicycle")
    u = np.random.default_rng(seed).normal(size=(25, 2))
    acting = effect.input_sequence(u, model, "w", DT, {"delay": delay})
    fine = 4000
    t = (np.arange(len(u) * fine) + 0.5) * DT / fine - delay
    held = np.where(t >= 0.0, u[np.clip((t / DT).astype(int), 0, None), 1], 0.0)
    assert acting[:, 1] == pytest.approx(held.reshape(len(u), fine).mean(axis=1), abs=5e-3)
    assert np.array_equal(acting[:, 0], u[:, 0])


@given(time_constant=st.floats(0.01, 2.0), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_a_lag_gives_the_mean_of_the_exact_first_order_response(time_constant, seed):
    effect, model = registry().get("effects", "input_lag"), registry().get("models", "joint")
    u = np.random.default_rng(seed).normal(size=(20, 1))
    acting = effect.input_sequence(u, model, "force", DT, {"time_constant": time_constant})
    s, expected = 0.0, []
    tau = np.linspace(0.0, DT, 2001)
    for value in u[:, 0]:
        response = value + (s - value) * np.exp(-tau / time_constant)
        expected.append(np.trapezoid(response, tau) / DT)
        s = response[-1]
    assert acting[:, 0] == pytest.approx(expected, abs=1e-5)


def test_wheel_saturation_clips_each_wheel_and_so_couples_v_and_w():
    effect, model = registry().get("effects", "wheel_saturation"), registry().get("models", "unicycle")
    p = {"speed": 0.2, "track": 0.105}
    inside, turning = np.array([[0.1, 1.0]]), np.array([[0.2, 2.0]])
    assert effect.input_sequence(inside, model, "*", DT, p)[0] == pytest.approx([0.1, 1.0])
    left = 0.2 - 0.0525 * 2.0
    assert effect.input_sequence(turning, model, "*", DT, p)[0] == pytest.approx([(left + 0.2) / 2.0, (0.2 - left) / 0.105])


@given(v=st.floats(-2.0, 2.0), w=st.floats(-4.0, 4.0), theta=st.floats(-3.0, 3.0))
@settings(max_examples=60, deadline=None)
def test_the_exact_scheme_moves_on_the_arc_of_what_acts(v, w, theta):
    model = compose(
        ModelSpec(
            "unicycle",
            0.1,
            {},
            (EffectSpec("integration_scheme", "*", {"scheme": "exact"}), EffectSpec("input_gain", "w", {"gain": 0.5})),
        )
    )
    x, _ = model.step(np.array([[1.0, -1.0, theta]]), np.array([[v, w]]), model.at_rest(1))
    fine = 20000
    heading = theta + 0.5 * w * (np.arange(fine) + 0.5) * 0.1 / fine
    assert x[0, 0] == pytest.approx(1.0 + v * 0.1 * np.cos(heading).mean(), abs=1e-9)
    assert x[0, 1] == pytest.approx(-1.0 + v * 0.1 * np.sin(heading).mean(), abs=1e-9)


@pytest.mark.parametrize("name", ["unicycle", "differential_drive", "bicycle"])
def test_runge_kutta_and_the_arc_agree_to_fourth_order_and_euler_is_the_nominal_step(name):
    def step(scheme, dt):
        effects = (EffectSpec("integration_scheme", "*", {"scheme": scheme}),) if scheme else ()
        model = compose(ModelSpec(name, dt, {}, effects))
        x, u = np.full((1, len(model.states)), 0.3), np.array([[0.4, 1.3]])
        return model.step(x, u, model.at_rest(1))[0]

    assert np.allclose(step("euler", 0.1), step("", 0.1), rtol=0.0, atol=1e-15)
    error = [np.max(np.abs(step("rk4", dt) - step("exact", dt))) for dt in (0.4, 0.2)]
    assert math.log2(error[0] / error[1]) == pytest.approx(5.0, abs=0.3)


def test_effects_apply_in_the_order_listed():
    gain, clip = EffectSpec("input_gain", "w", {"gain": 2.0}), EffectSpec("input_saturation", "w", {"low": -1.0, "high": 1.0})
    u = np.array([[0.0, 0.8]])
    for effects, turned in (((gain, clip), 1.0), ((clip, gain), 1.6)):
        model = compose(ModelSpec("unicycle", 0.1, {}, effects))
        assert model.step(np.zeros((1, 3)), u, model.at_rest(1))[0][0, 2] == pytest.approx(0.1 * turned)
