"""What effects make of a held input, against physics in a hundred parts a step, written without the library."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Stream, from_arrays, from_streams
from s2r_runtime.trace.estimation.prediction import acting

DT = 0.04
PARTS = 100
STEPS = 60


def _effect(name):
    return registry().get("effects", name)


UNICYCLE = registry().get("models", "unicycle")


def _held(seed, size=1.0):
    """(STEPS, 2): values held for one to twelve steps, with zeros between, and a stretch that never holds."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-size, size, (STEPS, 2)), rng.integers(1, 13, STEPS), axis=0)[: STEPS - 10]
    u[20:26] = 0.0
    return np.concatenate([u, rng.normal(size=(10, 2)) * size])


def _means(fine):
    """(STEPS * PARTS + 1,) of what acts at the parts' ends -> mean over each step (trapezoids)."""
    middle = 0.5 * (fine[1:] + fine[:-1])
    return middle.reshape(STEPS, PARTS).mean(axis=1)


def _at_middles(u, function):
    """(STEPS,): mean over each step of function(u, t) at the middle of its parts."""
    t = (np.arange(STEPS * PARTS) + 0.5) * DT / PARTS
    return function(np.repeat(u, PARTS), t).reshape(STEPS, PARTS).mean(axis=1)


@given(up=st.floats(0.1, 200.0), down=st.none() | st.floats(0.1, 200.0), seed=st.integers(0, 999))
@settings(max_examples=50, deadline=None)
def test_a_rate_limit_gives_the_mean_of_a_ramp_that_stops_at_the_command(up, down, seed):
    u = _held(seed)
    p = {"rate": up} if down is None else {"rate": up, "rate_down": down}
    acting = _effect("input_rate_limit").input_sequence(u, UNICYCLE, "w", DT, p)
    y, fine, h = 0.0, [0.0], DT / PARTS
    for target in u[:, 1]:
        for _ in range(PARTS):
            step = target - y
            y += min(step, up * h) if step > 0.0 else max(step, -(up if down is None else down) * h)
            fine.append(y)
    worst = max(up, down or up) * h / 2 / PARTS  # a ramp that ends within a part: half a part's triangle, spread over the step
    assert acting[:, 1] == pytest.approx(_means(np.array(fine)), abs=1.01 * worst + 1e-12)
    assert np.array_equal(acting[:, 0], u[:, 0])


@given(width=st.floats(0.0, 3.0), seed=st.integers(0, 999))
@settings(max_examples=50, deadline=None)
def test_a_play_leaves_the_output_where_it_is_until_the_input_has_crossed_it(width, seed):
    u = _held(seed)
    acting = _effect("input_backlash").input_sequence(u, UNICYCLE, "w", DT, {"width": width})
    y, expected = 0.0, []
    for target in u[:, 1]:
        for part in range(1, PARTS + 1):  # the input moves to its next value in small parts, as a jump does
            here = target if part == PARTS else y + (target - y) * part / PARTS
            while here - y > width / 2 + 1e-15:
                y = here - width / 2
            while y - here > width / 2 + 1e-15:
                y = here + width / 2
        expected.append(y)
    assert acting[:, 1] == pytest.approx(expected, abs=1e-9)


def test_the_width_of_a_play_is_all_of_it_and_that_of_a_deadband_one_side():
    there_and_back = np.column_stack([np.zeros(8), [0.05, 0.2, 1.0, 0.9, 0.81, 0.7, -1.0, 0.0]])
    play = _effect("input_backlash").input_sequence(there_and_back, UNICYCLE, "w", DT, {"width": 0.2})[:, 1]
    assert play == pytest.approx([0.0, 0.1, 0.9, 0.9, 0.9, 0.8, -0.9, -0.1])
    band = _effect("input_deadband").input_sequence(there_and_back, UNICYCLE, "w", DT, {"width": 0.2})[:, 1]
    assert band == pytest.approx([0.0, 0.0, 0.8, 0.7, 0.61, 0.5, -0.8, 0.0])


@given(positive=st.floats(0.2, 2.0), negative=st.floats(0.2, 2.0), value=st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_an_asymmetric_gain_takes_the_factor_of_the_sign(positive, negative, value):
    p = {"gain_positive": positive, "gain_negative": negative}
    acting = _effect("input_gain_asymmetry").input_sequence(np.array([[0.3, value]]), UNICYCLE, "w", DT, p)
    assert acting[0] == pytest.approx([0.3, value * (positive if value > 0 else negative)])


@pytest.mark.parametrize(
    ("p", "expected"),
    [({"low": -0.2, "high": 0.5}, [-0.2, 0.1, 0.5]), ({"high": 0.5}, [-1.0, 0.1, 0.5]), ({"low": -0.2}, [-0.2, 0.1, 1.0])],
)
def test_a_limit_that_is_left_out_is_not_there(p, expected):
    u = np.column_stack([[-1.0, 0.1, 1.0], np.zeros(3)])
    assert _effect("input_saturation").input_sequence(u, UNICYCLE, "v", DT, p)[:, 0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("p", "wrong"),
    [({}, "has neither low nor high, must have at least one"), ({"low": 1.0, "high": 0.5}, "low is 1.0, must be below high")],
)
def test_limits_that_make_no_sense_are_refused(p, wrong):
    with pytest.raises(ConfigError, match=wrong):
        compose(ModelSpec("unicycle", DT, {}, (EffectSpec("input_saturation", "v", p),)))


def test_a_coupling_adds_its_share_of_the_other_input_as_it_arrives_there():
    effects = (EffectSpec("input_gain", "v", {"gain": 2.0}), EffectSpec("input_coupling", "w", {"from": "v", "coefficient": -0.3}))
    for order, turned in ((effects, 1.0 - 0.3 * 2.0 * 0.5), (effects[::-1], 1.0 - 0.3 * 0.5)):
        model = compose(ModelSpec("unicycle", DT, {}, order))
        x, _ = model.step(np.zeros((1, 3)), np.array([[0.5, 1.0]]), model.at_rest(1))
        assert x[0] == pytest.approx([2.0 * 0.5 * DT, 0.0, DT * turned])


@pytest.mark.parametrize("name", ["left", "cmd_left", 3.0])
def test_a_coupling_from_what_is_no_other_input_is_refused_with_those_that_are(name):
    spec = ModelSpec("differential_drive", DT, {}, (EffectSpec("input_coupling", "cmd_left", {"from": name, "coefficient": 0.1}),))
    with pytest.raises(ConfigError, match=r"from is .*, must be one of: cmd_right"):
        compose(spec)


def test_a_coupling_has_the_units_of_one_input_for_one_of_the_other():
    effect = _effect("input_coupling")
    drive, joint = registry().get("models", "differential_drive"), registry().get("models", "joint")
    assert effect.unit(UNICYCLE, "w", "coefficient") == "(rad/s)/(m/s)"
    assert effect.unit(drive, "cmd_left", "coefficient") == effect.unit(UNICYCLE, "w", "from") == ""
    assert effect.channels(joint) == ()


@given(rate=st.floats(-0.3, 0.3), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_drifting_gain_is_one_plus_rate_times_time(rate, seed):
    u = _held(seed)
    acting = _effect("input_gain_drift").input_sequence(u, UNICYCLE, "w", DT, {"rate": rate})
    assert acting[:, 1] == pytest.approx(_at_middles(u[:, 1], lambda v, t: v * (1.0 + rate * t)), abs=1e-9)


@given(time=st.floats(0.0, DT * STEPS), gain=st.floats(0.0, 2.0), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_a_regime_changes_at_its_time_within_the_step_too(time, gain, seed):
    u = _held(seed)
    acting = _effect("regime_change").input_sequence(u, UNICYCLE, "w", DT, {"time": time, "gain": gain})
    expected = _at_middles(u[:, 1], lambda v, t: np.where(t >= time, gain * v, v))
    assert acting[:, 1] == pytest.approx(expected, abs=0.51 * abs(gain - 1.0) * np.abs(u).max() / PARTS + 1e-12)  # half a part of the step


@given(frequency=st.floats(0.05, 12.0), amplitude=st.floats(0.01, 2.0), phase=st.floats(-3.1, 3.1))
@settings(max_examples=40, deadline=None)
def test_a_periodic_disturbance_adds_the_sines_mean_over_the_step(frequency, amplitude, phase):
    u = _held(1)
    p = {"frequency": frequency, "amplitude": amplitude, "phase": phase}
    acting = _effect("periodic_disturbance").input_sequence(u, UNICYCLE, "w", DT, p)
    expected = _at_middles(u[:, 1], lambda v, t: v + amplitude * np.sin(2.0 * np.pi * frequency * t + phase))
    bend = amplitude * (2.0 * np.pi * frequency * DT / PARTS) ** 2 / 24.0  # error of the midpoint rule
    assert acting[:, 1] == pytest.approx(expected, abs=1.1 * bend + 1e-12)


def test_effects_on_all_inputs_alike_do_to_each_what_they_do_to_one():
    u = _held(4)
    for name, p in (("regime_change", {"time": 0.7, "gain": 0.6}), ("input_gain_drift", {"rate": 0.2})):
        effect = _effect(name)
        both = effect.input_sequence(u, UNICYCLE, "*", DT, p)
        one_by_one = effect.input_sequence(effect.input_sequence(u, UNICYCLE, "v", DT, p), UNICYCLE, "w", DT, p)
        assert np.allclose(both, one_by_one, rtol=1e-15, atol=0.0)


def test_the_wheels_speed_is_the_end_of_the_ramp_and_the_pose_moves_by_its_mean():
    model = compose(ModelSpec("differential_drive", 0.1, {}, (EffectSpec("input_rate_limit", "cmd_left", {"rate": 20.0}),)))
    x, hidden = model.step(np.zeros((1, 5)), np.array([[5.0, 0.0]]), model.at_rest(1))
    assert x[0, 3] == pytest.approx(2.0, rel=1e-12)
    assert x[0, 0] == pytest.approx(0.1 * 0.1 * 1.0 / 2.0)  # radius * dt * the ramp's mean / 2
    x, _ = model.step(x, np.array([[5.0, 0.0]]), hidden)
    assert x[0, 3] == pytest.approx(4.0, rel=1e-12)
    x, _ = model.step(x, np.array([[4.5, 0.0]]), model.step(x, np.array([[5.0, 0.0]]), hidden)[1])
    assert x[0, 3] == pytest.approx(4.5, rel=1e-12)  # it got there within the step


@pytest.mark.parametrize("tau", [0.03, 0.2, 1.5])
def test_the_wheels_speed_is_where_the_lag_stands_at_the_steps_end(tau):
    lag = EffectSpec("input_lag", "cmd_left", {"time_constant": tau})
    for effects, factor in (((lag,), 1.0), ((lag, EffectSpec("input_gain", "cmd_left", {"gain": 0.6})), 0.6)):
        model = compose(ModelSpec("differential_drive", 0.05, {}, effects))
        x, hidden = np.zeros((1, 5)), model.at_rest(1)
        for k in range(3):
            x, hidden = model.step(x, np.array([[1.0, 2.0]]), hidden)
            assert x[0, 3] == pytest.approx(-factor * np.expm1(-0.05 * (k + 1) / tau), rel=1e-9)
            assert x[0, 4] == 2.0


def test_what_acts_at_the_ends_of_steps_is_the_same_over_time_at_once_as_step_by_step():
    chains = (
        [("input_lag", "cmd_left", {"time_constant": 0.2})],
        [
            ("input_delay", "cmd_left", {"delay": 0.13}),
            ("input_lag", "cmd_left", {"time_constant": 0.2}),
            ("input_deadband", "cmd_left", {"width": 0.3}),
        ],
        [("input_lag", "cmd_left", {"time_constant": 0.1}), ("input_coupling", "cmd_right", {"from": "cmd_left", "coefficient": 0.3})],
        [
            ("input_lag", "cmd_left", {"time_constant": 0.1}),
            ("input_delay", "*", {"delay": 0.07}),
            ("input_gain_drift", "*", {"rate": 0.2}),
        ],
        [("input_rate_limit", "cmd_right", {"rate": 9.0, "rate_down": 4.0}), ("input_backlash", "cmd_right", {"width": 0.2})],
    )
    u = np.repeat(np.random.default_rng(5).normal(size=(20, 2)).round(1), 3, axis=0)
    for chain in chains:
        model = compose(ModelSpec("differential_drive", 0.05, {}, tuple(EffectSpec(*link) for link in chain)))
        data = from_arrays(model, [(np.zeros((len(u) + 1, 5)), u)])
        act, hidden = acting(model, data), model.at_rest(1)
        for k, row in enumerate(u):
            mean, end, hidden = model.act(row[None], hidden)
            assert act.mean[k] == pytest.approx(mean[0], rel=1e-9, abs=1e-12)
            assert act.end[k] == pytest.approx(end[0], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("even", [True, False])
def test_what_acts_at_the_ends_of_steps_is_exact_behind_a_lag_a_ramp_and_a_delay_by_a_part_of_a_step(even):
    dt, parts = 0.05, 400
    rng = np.random.default_rng(3)
    t = dt * (np.arange(81) + (0.0 if even else np.append(0.0, rng.uniform(-0.2, 0.2, 80))))
    u = np.repeat(rng.normal(size=(20, 2)).round(1), 4, axis=0)
    model = compose(ModelSpec("differential_drive", dt))
    streams = Stream(t, np.zeros((81, 5))), Stream(t[:-1], u)
    data = from_streams(model, [streams], "made")
    fine = np.repeat(u, parts, axis=0)
    lasts = np.repeat(np.diff(t) / parts, parts)
    for name, values, off in (
        ("input_lag", {"time_constant": 0.08}, 1e-9),
        ("input_rate_limit", {"rate": 9.0}, 1e-9),
        ("input_delay", {"delay": 0.048}, 0.0),
    ):
        one = compose(ModelSpec("differential_drive", dt, {}, (EffectSpec(name, "cmd_left", values),)))
        effect = one.effects[0].effect
        acts = effect.input_sequence(fine, one.nominal, "cmd_left", lasts, values)
        ends = effect.at_end((fine, acts, fine), None, one.nominal, "cmd_left", lasts[:, None], values)[parts - 1 :: parts, 0]
        assert acting(one, data).end[:, 0] == pytest.approx(ends, abs=off)


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.05, 0.1234, 0.35, 2.0, 9.0])
def test_a_delay_of_even_rows_ends_them_as_one_of_rows_of_any_length_does(delay):
    model = compose(ModelSpec("differential_drive", 0.05, {}, (EffectSpec("input_delay", "*", {"delay": delay}),)))
    u = np.random.default_rng(3).normal(size=(60, 3, 2))
    effect = model.effects[0].effect
    even, uneven = (effect.at_end((u, u, u), None, model.nominal, "*", dt, {"delay": delay}) for dt in (0.05, np.full((60, 1, 1), 0.05)))
    assert np.array_equal(even, uneven)


def test_a_delay_may_stand_before_or_behind_a_lag_and_the_wheel_is_where_both_have_it():
    lag, delay = EffectSpec("input_lag", "cmd_left", {"time_constant": 0.08}), EffectSpec("input_delay", "cmd_left", {"delay": 0.034})
    u = np.repeat(np.random.default_rng(4).normal(size=(15, 2)).round(1), 4, axis=0)
    ends = []
    for effects in ((lag, delay), (delay, lag)):
        model = compose(ModelSpec("differential_drive", 0.05, {}, effects))
        data = from_arrays(model, [(np.zeros((len(u) + 1, 5)), u)])
        act, hidden = acting(model, data), model.at_rest(1)
        for k, row in enumerate(u):
            mean, end, hidden = model.act(row[None], hidden)
            assert act.mean[k] == pytest.approx(mean[0], rel=1e-9, abs=1e-12)
            assert act.end[k] == pytest.approx(end[0], rel=1e-9, abs=1e-12)
        ends.append(act.end)
    assert ends[0] == pytest.approx(ends[1], abs=1e-12)


def test_a_wheels_sine_is_that_at_the_end_of_the_step():
    values = {"frequency": 0.8, "amplitude": 1.0, "phase": 0.3}
    model = compose(ModelSpec("differential_drive", 0.05, {}, (EffectSpec("periodic_disturbance", "cmd_left", values),)))
    data = from_arrays(model, [(np.zeros((41, 5)), np.zeros((40, 2)))])
    end = 0.05 * np.arange(1, 41)
    assert acting(model, data).end[:, 0] == pytest.approx(np.sin(2.0 * np.pi * 0.8 * end + 0.3), abs=1e-6)
