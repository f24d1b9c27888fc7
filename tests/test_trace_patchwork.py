"""Several names that together are no more than one dependence, and what an effect is about."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import fitted, gain, insert
from s2r_runtime.trace.hypotheses.dependence import about, about_states, carried, only_pushes
from s2r_runtime.trace.selection.several_or_one import AS_MUCH, MOSTLY, patchwork
from s2r_runtime.trace.selection.stepwise import Selection
from s2r_runtime.trace.sensor_faults.detect import Checked

DT, PARTS = 0.05, 10
NOISE = np.array([0.001, 0.001, 0.002, 0.002])


def _effect(name, channel, p):
    return AppliedEffect(registry().get("effects", name), channel, p)


def _whole(push, steps=600, seed=4):
    """All of a drive of a mass in the plane, pushed besides by what push says of (x, y, vx, vy, command), seen under the plain model."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (steps // 15, 2)), 15, axis=0)
    state, rows = np.zeros(4), [np.zeros(4)]
    for a in u:
        for _ in range(PARTS):
            pull = a - 0.4 * state[:2] - 0.4 * state[2:]  # the command leads it back: it stays where fields are known
            state = state + DT / PARTS * np.concatenate([state[2:], pull + np.asarray(push(*state, pull))])
        rows.append(state)
    model = compose(ModelSpec("double_integrator", DT))
    y = np.array(rows)
    asked = u - 0.4 * y[:-1, :2] - 0.4 * y[:-1, 2:]
    data = from_arrays(model, [(y + rng.normal(size=y.shape) * NOISE, asked)])
    return Whole(Checked(data, (), (), 0), model, 20)


def _named(whole, *effects):
    model = whole.nominal.model
    for place, effect in enumerate(effects):
        model = insert(model, effect, place)
    return fitted(whole.given, whole.nominal, model)


FIELD = ("position_field", "*", {"matrix": [[0.01, 0.0], [0.0, 0.01]]})
BIAS = ("input_bias", "ay", {"bias": 0.01})


def _drag(state):
    return _effect("viscous_friction", state, {"coefficient": 0.1})


def test_names_that_follow_what_depends_on_the_speed_are_a_patchwork_of_that():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.8 * vx * vy, 0.8 * vx * vx))  # what a spinning wheel on board does
    fit = _named(whole, _effect(*FIELD), _effect(*BIAS))
    assert gain(fit, whole.nominal) > 20.0, "they do explain something"
    assert {whole.unnamed.token} == {"speed"}
    assert patchwork(whole.given, fit, whole.nominal, whole.unnamed)
    assert not patchwork(whole.given, _named(whole, _effect(*BIAS)), whole.nominal, whole.unnamed), "one name is no patchwork"


def test_what_explains_clearly_less_than_the_best_without_a_name_falls_short_of_it():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.8 * vx * vy, 0.8 * vx * vx))
    bias = Selection(whole.nominal, _named(whole, _effect(*BIAS)), 1, (), ())
    assert whole.unnamed.gain > 2.0 * max(gain(bias.fit, whole.nominal), 20.0), "far from any limit"
    assert whole.falls_short(bias)


def test_what_is_there_falls_short_of_nothing():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.3 * vx, -0.3 * vy))
    drag = Selection(whole.nominal, _named(whole, _drag("vx"), _drag("vy")), 1, (), ())
    assert gain(drag.fit, whole.nominal) > 100.0
    assert not whole.falls_short(drag)


def test_two_effects_that_are_there_are_none():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.3 * vx + 0.2 * x, 0.2 * y))
    fit = _named(whole, _drag("vx"), _effect(*FIELD))
    assert not patchwork(whole.given, fit, whole.nominal, whole.unnamed)
    as_much = replace(whole.unnamed, gain=AS_MUCH * gain(fit, whole.nominal))
    assert patchwork(whole.given, fit, whole.nominal, as_much), "but for what one dictionary does not explain"


def test_two_effects_of_one_kind_are_none_although_one_dictionary_has_both():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.3 * vx, -0.3 * vy))
    fit = _named(whole, _drag("vx"), _drag("vy"))
    named = gain(fit, whole.nominal)
    as_much = replace(whole.unnamed, gain=AS_MUCH * named)
    assert all(gain(_named(whole, _drag(state)), whole.nominal) <= MOSTLY * named for state in ("vx", "vy"))
    assert not patchwork(whole.given, fit, whole.nominal, as_much)


def test_what_an_input_does_now_is_no_other_thing_than_what_it_did_lately():
    late = [0.0]

    def lagged_and_more(x, y, vx, vy, asked):
        late[0] += (asked[0] - late[0]) * DT / PARTS / 0.03
        return 1.06 * late[0] - asked[0], 0.0

    whole = _whole(lagged_and_more)
    gain_of, lag = _effect("input_gain", "ax", {"gain": 1.05}), _effect("input_lag", "ax", {"time_constant": 0.03})
    fit = _named(whole, gain_of, lag)
    named = gain(fit, whole.nominal)
    assert all(20.0 < gain(_named(whole, one), whole.nominal) <= MOSTLY * named for one in (gain_of, lag))
    for token, found in (("memory(ax)", False), ("memory(ay)", True)):
        assert patchwork(whole.given, fit, whole.nominal, replace(whole.unnamed, token=token, gain=AS_MUCH * named)) is found


def test_a_name_that_explains_nearly_all_is_none_whatever_stands_beside_it():
    whole = _whole(lambda x, y, vx, vy, asked: (-0.3 * vx, 0.0))
    fit = _named(whole, _drag("vx"), _effect(*BIAS))
    as_much = replace(whole.unnamed, gain=AS_MUCH * gain(fit, whole.nominal))
    assert about(fit.model, 1, whole.given.data, whole.given.steps) == {"ay"}, "the other one is about something else"
    assert not patchwork(whole.given, fit, whole.nominal, as_much)


@pytest.mark.parametrize(
    ("name", "channel", "p", "tokens"),
    [
        ("gravity_slope", "*", {"x": 0.1, "y": 0.05}, {"heading"}),
        ("constant_disturbance", "world", {"x": 0.1, "y": 0.05}, {"heading"}),
        ("constant_disturbance", "body", {"x": 0.1, "y": 0.05}, set()),
        ("position_field", "*", {"matrix": [[0.1, 0.02], [0.0, 0.1]]}, {"position", "heading"}),
        ("lateral_slip", "*", {"coefficient": 0.1}, {"v", "w"}),
        ("longitudinal_slip", "*", {"ratio": 0.1}, {"v"}),
        ("input_gain", "w", {"gain": 0.8}, {"w"}),
        ("input_lag", "w", {"time_constant": 0.2}, {"w", "memory(w)"}),
        ("input_gain_drift", "w", {"rate": 0.01}, {"w", "time"}),
        ("input_coupling", "w", {"from": "v", "coefficient": 0.2}, {"v", "w"}),
    ],
)
def test_what_an_effect_is_about_is_seen_from_the_robot(name, channel, p, tokens):
    rng = np.random.default_rng(2)
    model = insert(compose(ModelSpec("unicycle", DT)), _effect(name, channel, p), 0)
    data = from_arrays(model, [(rng.normal(size=(41, 3)), rng.normal(size=(40, 2)))])
    steps = steps_of(data)
    assert about(model, 0, data, steps) == tokens
    assert about_states(model, (0,), data, steps) == tokens & {"heading", "position"}


def test_what_a_car_makes_of_a_bias_of_its_steering_goes_with_its_speed():
    rng = np.random.default_rng(3)
    steer, speed = rng.uniform(-0.3, 0.3, 300), rng.uniform(1.0, 5.0, 300)
    effects = (_effect("input_bias", "steer_cmd", {"bias": 0.02}), _effect("longitudinal_slip", "*", {"ratio": 0.1}))
    model = compose(ModelSpec("bicycle", DT))
    data = from_arrays(model, [(rng.normal(size=(301, 4)), np.column_stack([steer, speed]))])
    model, steps = insert(insert(model, effects[0], 0), effects[1], 1), steps_of(data)
    assert about(model, 0, data, steps) == {"steer_cmd"}, "its own word"
    assert "speed_cmd" in carried(model, 0, data, steps)
    assert carried(model, 1, data, steps) == set(), "what acts on no input is tried as it is"


def _car(seed, steer_off, goes=1.0, heading_off=0.0):
    """All of a drive of a car of 1 m, with a bias of its steering, wheels that slip and a heading that is measured off."""
    rng = np.random.default_rng(seed)
    command = np.column_stack([np.repeat(rng.uniform(-0.3, 0.3, 40), 20), np.repeat(rng.uniform(1.0, 5.0, 40), 20)])
    pose, rows = np.array([0.0, 0.0, 0.0]), [np.zeros(4)]
    for steer, speed in command:
        for _ in range(PARTS):
            pose = pose + DT / PARTS * goes * speed * np.array([np.cos(pose[2]), np.sin(pose[2]), np.tan(steer + steer_off)])
        rows.append(np.append(pose, speed))
    model = compose(ModelSpec("bicycle", DT, {"wheel_base": 1.0}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    y = np.array(rows) + [0.0, 0.0, heading_off, 0.0] + rng.normal(size=(801, 4)) * [0.01, 0.01, 0.005, 0.02]
    return Whole(Checked(from_arrays(model, [(y, command)]), (), (), 0), model, 20)


def test_slip_and_a_bias_of_the_steering_are_no_patchwork_of_the_speed():
    whole = _car(5, 0.02, goes=0.98)
    fit = _named(whole, _effect("input_bias", "steer_cmd", {"bias": 0.02}), _effect("longitudinal_slip", "*", {"ratio": 0.02}))
    named, of_speed = gain(fit, whole.nominal), "speed_cmd"
    assert all(gain(_named(whole, a), whole.nominal) < MOSTLY * named for a in [fit.model.effects[p] for p in fit.added])
    assert not patchwork(whole.given, fit, whole.nominal, replace(whole.unnamed, token=of_speed, gain=named))


def test_a_steady_push_is_part_of_no_patchwork_although_the_square_of_a_two_valued_command_is_one():
    rng = np.random.default_rng(6)
    asked = np.repeat(rng.choice([-1.0, 1.0], (40, 2)), 15, axis=0)
    speeds = np.cumsum(np.concatenate([np.zeros((1, 2)), DT * (asked * [1.0, 0.8] + [0.1, 0.0])]), axis=0)
    places = np.cumsum(np.concatenate([np.zeros((1, 2)), 0.5 * DT * (speeds[1:] + speeds[:-1])]), axis=0)
    y = np.column_stack([places, speeds]) + rng.normal(size=(601, 4)) * [0.001, 0.001, 0.004, 0.004]
    model = compose(ModelSpec("double_integrator", DT))
    whole = Whole(Checked(from_arrays(model, [(y, asked)]), (), (), 0), model, 20)
    fit = _named(whole, _effect("input_gain", "ay", {"gain": 0.8}), _effect("input_bias", "ax", {"bias": 0.1}))
    of_input = "ay"
    as_much = replace(whole.unnamed, token=of_input, gain=AS_MUCH * gain(fit, whole.nominal))
    assert only_pushes(fit.model, 1, whole.given.data, whole.given.steps)
    assert not patchwork(whole.given, fit, whole.nominal, as_much)


def test_what_goes_with_a_commanded_speed_goes_with_the_speed_that_a_car_is_set_to():
    """A heading that is measured off by little, and a bias of the steering: both are more, the faster the car goes."""
    whole = _car(7, 0.01, heading_off=0.01)
    fit = _named(whole, _effect("input_bias", "steer_cmd", {"bias": 0.01}), _effect("heading_offset", "theta", {"angle": 0.01}))
    named = gain(fit, whole.nominal)
    assert all(gain(_named(whole, fit.model.effects[p]), whole.nominal) < MOSTLY * named for p in fit.added)
    for token, found in (("speed", False), ("speed_cmd", False), ("position", True)):
        assert patchwork(whole.given, fit, whole.nominal, replace(whole.unnamed, token=token, gain=named)) is found
