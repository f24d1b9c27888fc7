"""Columns that are not what they say are refused in one line that says what they seem to be; a robot with a strong effect is not."""

from functools import partial

import numpy as np
import pytest
from trace_robots import GEOMETRY, INPUTS, commands, drive

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.checks.columns import _if_each_taken_back, _if_taken_back, _mistake, _mistakes, _scaled, check_plausible
from s2r_runtime.trace.checks.prediction_error import unforetold
from s2r_runtime.trace.data.dataset import Stream, from_streams
from s2r_runtime.trace.pipeline import trace

DT, STEPS = 0.05, 700
BOUNDS = {
    "unicycle": [(-0.3, 1.0), (-1.5, 1.5)],
    "bicycle": [(-0.4, 0.4), (0.2, 2.0)],
    "differential_drive": [(-3.0, 8.0)] * 2,
    "joint": [(-3.0, 3.0)],
    "double_integrator": [(-1.0, 1.0)] * 2,
}


def _model(name):
    pose = (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),) if name not in {"joint", "double_integrator"} else ()
    return compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), pose))


def _driven(name, seed=1, effects=()):
    rng = np.random.default_rng(seed)
    u = commands(rng, 1, STEPS, DT, BOUNDS[name])
    y = drive(rng, name, u, effects, DT, 1e-3)[0]
    return y[:-1], u[0]


def _data(model, y, u, early=0.0, rate=1.0):
    t = DT * np.arange(STEPS)
    return from_streams(model, [(Stream(t, y), Stream(rate * t + early, u))], "here.csv")


MISTAKES = {
    "degrees": ("unicycle", lambda y, u: (y * [1, 1, 180 / np.pi], u), "theta seems to be in degrees"),
    "x and y": ("unicycle", lambda y, u: (y[:, [1, 0, 2]], u), "the columns x and y seem to be exchanged"),
    "inputs": ("bicycle", lambda y, u: (y, u[:, ::-1]), "the columns steer_cmd and speed_cmd seem to be exchanged"),
    "left and right": (
        "differential_drive",
        lambda y, u: (y[:, [0, 1, 2, 4, 3]], u[:, ::-1]),
        "wheel_right, cmd_left and cmd_right seem to be",
    ),
    "clockwise": ("unicycle", lambda y, u: (y * [1, 1, -1], u), "seems to"),
    "compass": ("bicycle", lambda y, u: (np.column_stack([y[:, :2], np.pi / 2 - y[:, 2], y[:, 3]]), u), "clockwise from y"),
    "millimetres": ("unicycle", lambda y, u: (y * [1000, 1000, 1], u), "x and y seem to be in mm"),
    "degrees a second": ("unicycle", lambda y, u: (y, u * [1, 180 / np.pi]), "w seems to be in degrees a second"),
    "compass in degrees": ("unicycle", lambda y, u: (np.column_stack([y[:, :2], 90 - np.degrees(y[:, 2])]), u), "degrees clockwise from y"),
    "km/h": ("bicycle", lambda y, u: (y * [1, 1, 1, 3.6], u), "speed seems to be in km/h"),
    "wheels in rpm": ("differential_drive", lambda y, u: (y * [1, 1, 1, 30 / np.pi, 30 / np.pi], u), "wheel_.* revolutions a minute"),
    "both in km/h": ("bicycle", lambda y, u: (y * [1, 1, 1, 3.6], u * [1, 3.6]), "speed and speed_cmd seem to be in km/h"),
    "all wheels in rpm": (
        "differential_drive",
        lambda y, u: (y * [1, 1, 1, 30 / np.pi, 30 / np.pi], u * 30 / np.pi),
        "wheel_left, wheel_right, cmd_left and cmd_right seem to be in revolutions a minute",
    ),
    "steering wheel": ("bicycle", lambda y, u: (y, u * [15 * 180 / np.pi, 1]), "steer_cmd goes to .* steering wheel"),
    "steer in degrees": ("bicycle", lambda y, u: (y, u * [180 / np.pi, 1]), "steer_cmd seems to be in degrees"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_usual_mistake_is_named(case):
    name, spoil, said = MISTAKES[case]
    with pytest.raises(RecordingError, match=said):
        check_plausible(_model(name), _data(_model(name), *spoil(*_driven(name))))


@pytest.mark.parametrize("name", BOUNDS)
def test_mistakes_tried_at_once_say_what_each_says_by_itself(name):
    """Commands come where they like: steps are taken in parts, but where all of them are zero."""
    model, (y, u) = _model(name), _driven(name)
    t = DT * np.arange(STEPS)
    data = from_streams(model, [(Stream(t, y), Stream(np.append(0.0, t[1:] + 0.95 * DT), u))], "here.csv")
    dead = [_mistake("inputs", "", partial(_scaled, [*range(j)], 0.0)) for j in range(1, len(model.inputs) + 1)]
    tried = [*_mistakes(model), *dead]
    together = _if_each_taken_back(model, data, tried)
    for mistake, found in zip(tried, together, strict=True):
        alone = _if_taken_back(model, data, mistake)
        assert (alone is None) == (found is None)
        assert alone is None or np.allclose(alone, found, rtol=1e-12)


def test_too_few_rows_are_no_question_to_somebodys_own_model(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        'STATES, INPUTS, PARAMS = ("x",), ("f",), {}\n\ndef step(x, u, dt, params):\n    assert len(x), "no rows"\n    return x + dt * u\n'
    )
    model = compose(ModelSpec(str(path), DT))
    t, rng = DT * np.arange(10), np.random.default_rng(3)
    rows = Stream(t, rng.normal(size=(10, 1))), Stream(t, rng.normal(size=(10, 1)))
    check_plausible(model, from_streams(model, [rows], "here.csv"))


def test_the_tracer_says_so_instead_of_looking_for_an_effect():
    name, spoil, said = MISTAKES["degrees"]
    with pytest.raises(RecordingError, match=said):
        trace(_data(_model(name), *spoil(*_driven(name))), _model(name))


@pytest.mark.parametrize("steady", [True, False])
def test_a_speed_that_says_the_same_under_the_same_command_was_measured(steady):
    """By a sensor of 0.1 m/s, on a car that goes a tenth slower than it is asked to; under other commands it was not."""
    rng, model = np.random.default_rng(7), _model("bicycle")
    u = commands(rng, 1, STEPS, DT, BOUNDS["bicycle"], rest=0.0)
    u[0, :, 1] = 1.0 if steady else u[0, :, 1]
    y = drive(rng, "bicycle", u, [("input_gain", "speed_cmd", {"gain": 0.9})], DT, 1e-3)[0]
    y[:, 3] = 0.9
    data = _data(model, y[:-1], u[0])
    if steady:
        check_plausible(model, data)
        return
    with pytest.raises(RecordingError, match="the model moves it: it was not measured"):
        check_plausible(model, data)


@pytest.mark.parametrize("name", ["unicycle", "joint"])
def test_motion_that_comes_before_its_cause_is_of_another_clock(name):
    with pytest.raises(RecordingError, match=r"the motion comes about 0.[23]\d* s before"):
        check_plausible(_model(name), _data(_model(name), *_driven(name), early=0.25))


@pytest.mark.slow
def test_a_fast_recording_shows_it_too():
    """In one step of 5 ms nothing moves beyond noise."""
    dt, steps = 0.005, 2700
    rng, model = np.random.default_rng(4), compose(ModelSpec("unicycle", 0.005, {}, _model("unicycle").spec.effects))
    u = commands(rng, 1, steps, dt, BOUNDS["unicycle"])
    y = drive(rng, "unicycle", u, (), dt, 2e-3)[0]
    t = dt * np.arange(steps)
    with pytest.raises(RecordingError, match=r"the motion comes about 0.(3|29|31)\d* s before"):
        check_plausible(model, from_streams(model, [(Stream(t, y[:-1]), Stream(t + 0.3, u[0]))], "here.csv"))
    check_plausible(model, from_streams(model, [(Stream(t, y[:-1]), Stream(t, u[0]))], "here.csv"))


@pytest.mark.parametrize("rate", [1.03, 0.97])
def test_clocks_that_drift_apart_are_told(rate):
    early = 0.0 if rate > 1.0 else 1.0
    with pytest.raises(RecordingError, match="their clocks run at different rates"):
        check_plausible(_model("unicycle"), _data(_model("unicycle"), *_driven("unicycle"), early=early, rate=rate))


@pytest.mark.parametrize("seed", range(3))
def test_a_delay_that_grows_by_the_same_all_the_time_is_a_clock(seed):
    """Its clock loses 2 %: no motion comes before its cause, and the commands seem to come later and later."""
    with pytest.raises(
        RecordingError, match=r"s after the inputs .* at first and .* s after them in the end: their clocks run at different"
    ):
        check_plausible(_model("unicycle"), _data(_model("unicycle"), *_driven("unicycle", seed), early=-0.1, rate=0.98))


@pytest.mark.parametrize("seed", range(3))
def test_a_delay_that_changed_once_is_not(seed):
    _, u = _driven("unicycle", seed)
    late = np.concatenate([u[: STEPS // 2], np.repeat(u[STEPS // 2 : STEPS // 2 + 1], 8, axis=0), u[STEPS // 2 : -8]])
    again = drive(np.random.default_rng(seed), "unicycle", late[None], (), DT, 1e-3)[0]
    check_plausible(_model("unicycle"), _data(_model("unicycle"), again[:-1], u))


@pytest.mark.parametrize("delay", [0.0, 0.37, 0.6, 1.31])
def test_commands_that_repeat_themselves_come_before_and_after_what_they_cause(delay):
    """A delay of 0.6 s of what has a period of 2 s looks like a lead of 1.4 s."""
    t = DT * np.arange(STEPS)
    u = np.column_stack([0.4 + 0.3 * np.sin(np.pi * t), 1.2 * np.sin(np.pi * t + 1.0)])
    effects = [("input_delay", "*", {"delay": delay})] if delay else []
    y = drive(np.random.default_rng(3), "unicycle", u[None], effects, DT, 1e-4)[0]
    check_plausible(_model("unicycle"), _data(_model("unicycle"), y[:-1], u))


@pytest.mark.slow
@pytest.mark.parametrize("name", BOUNDS)
def test_a_strong_effect_is_no_mistake_of_the_columns(name):
    channels = INPUTS[name]
    strong = [
        [],
        [("input_delay", "*", {"delay": 0.4})],
        *[[("input_lag", c, {"time_constant": 1.2})] for c in channels],
        *[[("input_gain", c, {"gain": 0.3})] for c in channels],
        *[[("input_bias", c, {"bias": 0.5 * high})] for c, (_, high) in zip(channels, BOUNDS[name], strict=True)],
        *[[("input_saturation", c, {"low": 0.3 * low, "high": 0.3 * high})] for c, (low, high) in zip(channels, BOUNDS[name], strict=True)],
    ]
    for seed, effects in enumerate(strong):
        check_plausible(_model(name), _data(_model(name), *_driven(name, 20 + seed, effects)))


@pytest.mark.parametrize("effect", [("input_gain", {"gain": 0.0}), ("input_deadband", {"width": 0.59})], ids=["dead", "numb"])
@pytest.mark.parametrize(("name", "motor"), [("differential_drive", 0), ("differential_drive", 1), ("bicycle", 0)])
def test_a_motor_that_hardly_answers_is_in_no_other_unit(name, motor, effect):
    """What is asked of it says next to nothing then; nor would it as the share of it that degrees are."""
    model, (_, u) = _model(name), _driven(name, 5)
    named, ((parameter, value),) = effect[0], effect[1].items()
    spec = EffectSpec(named, INPUTS[name][motor], {parameter: value * BOUNDS[name][motor][1]})
    check_plausible(model, _data(model, _stepped(name, u, spec), u))


def _stepped(name, u, effect, noise=1e-3, heading=0.0):
    """(STEPS, nx), measured, of a robot with an effect as the library has it."""
    robot = compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), (*_model(name).spec.effects, effect)))
    x, hidden = np.zeros((1, len(robot.states))), robot.at_rest(1)
    x[:, robot.angle_columns] = heading
    rows = []
    for row in u:
        rows.append(x[0])
        x, hidden = robot.step(x, row[None], hidden)
    return np.array(rows) + np.random.default_rng(1).normal(size=(STEPS, len(robot.states))) * noise


STRONG = {
    "a joint that keeps up with its force": ("joint", EffectSpec("viscous_friction", "qd", {"coefficient": 6.0}), [3e-3, 1e-2]),
    "an axis that is braked to a crawl": (
        "double_integrator",
        EffectSpec("viscous_friction", "vx", {"coefficient": 10.0}),
        [3e-3] * 2 + [1e-2] * 2,
    ),
    "a tenth of what is asked": ("double_integrator", EffectSpec("input_gain", "ay", {"gain": 0.1}), 1e-3),
}


@pytest.mark.parametrize("case", STRONG)
def test_what_a_strong_effect_does_under_slow_commands_is_no_mistake_of_the_columns(case):
    name, effect, noise = STRONG[case]
    for seed in (41, 42):
        _, u = _driven(name, seed)
        slow = np.repeat(u[: STEPS // 2], 2, axis=0)
        check_plausible(_model(name), _data(_model(name), _stepped(name, slow, effect, noise), slow))


def test_wind_that_carries_a_robot_as_its_mirror_image_would_go_is_wind():
    """It drives at 0.05 m/s to where the wind comes from, and its model with x and y exchanged drives as fast with the wind."""
    u = np.column_stack([0.05 + 0.0 * np.arange(STEPS), 0.2 * np.sin(2.0 * DT * np.arange(STEPS))])
    wind = EffectSpec("constant_disturbance", "world", {"x": 0.07, "y": -0.07})
    y = _stepped("unicycle", u, wind, 1e-3, heading=2.0)
    check_plausible(_model("unicycle"), _data(_model("unicycle"), y, u))


def _hardly_turning(seed, heading):
    t = DT * np.arange(STEPS)
    u = np.column_stack([0.5 + 0.3 * np.sin(0.9 * t), 0.1 * np.sin(0.6 * t + 0.3)])
    return _stepped("unicycle", u, EffectSpec("input_delay", "*", {"delay": 0.0}), 1e-3 * (1 + seed), heading), u


@pytest.mark.parametrize("off", [0.645, 1.2, -0.9, 2.5])
@pytest.mark.parametrize("mirrored", [0.0, 0.5 * np.pi, np.pi], ids=["y", "x and y", "x"])
def test_a_heading_that_is_off_is_no_axis_that_was_mirrored(off, mirrored):
    """It hardly turns, and goes as with a mirrored axis, which lies half way between where it heads and where it says so."""
    y, u = _hardly_turning(1, 0.5 * (mirrored - off))
    y[:, 2] += off
    check_plausible(_model("unicycle"), _data(_model("unicycle"), y, u))


@pytest.mark.parametrize("heading", [0.35, 1.2, 2.3])
@pytest.mark.parametrize(
    ("mirrored", "said"), [(lambda y: y * [1, -1, 1], "y seems to"), (lambda y: y[:, [1, 0, 2]], "x and y seem to be exchanged")]
)
def test_a_mirrored_axis_is_told_though_it_hardly_turns(heading, mirrored, said):
    y, u = _hardly_turning(2, heading)
    with pytest.raises(RecordingError, match=said):
        check_plausible(_model("unicycle"), _data(_model("unicycle"), mirrored(y), u))


def test_a_rate_in_another_unit_than_its_position_is_told():
    y, u = _driven("joint")
    with pytest.raises(RecordingError, match="qd seems to be in mm/s"):
        check_plausible(_model("joint"), _data(_model("joint"), y * [1.0, 1000.0], u))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("friction", [1.0, 3.0])
@pytest.mark.parametrize("dry", [0.0, 1.5])
def test_friction_in_a_loop_is_no_clock_that_is_late(seed, friction, dry):
    """Under a controller, friction makes a joint's speed go with its force, and not with its integral: as if it knew the force ahead."""
    rng, dt, mass = np.random.default_rng(seed), 0.005, 0.8
    x, rows, forces = np.zeros(2), [], []
    phase = rng.uniform(0.0, 6.0, 3)
    for k in range(3000):
        t = k * dt
        wanted = sum(np.sin(w * t + p) for w, p in zip((1.1, 2.7, 4.3), phase, strict=True)) * 0.4
        ahead = sum(w * np.cos(w * t + p) for w, p in zip((1.1, 2.7, 4.3), phase, strict=True)) * 0.4
        force = 60.0 * (wanted - x[0]) + 12.0 * (ahead - x[1])
        rows.append(x + rng.normal(size=2) * [2e-5, 1e-3])
        forces.append([force])
        for _ in range(10):
            x = x + 0.1 * dt * np.array([x[1], (force - friction * x[1] - dry * np.tanh(x[1] / 1e-3)) / mass])
    model = compose(ModelSpec("joint", dt, {"mass": mass}))
    t = dt * np.arange(3000)
    check_plausible(model, from_streams(model, [(Stream(t, np.array(rows)), Stream(t, np.array(forces)))], "here.csv"))


@pytest.mark.parametrize("hertz", [2.0, 4.3, 7.0])
@pytest.mark.parametrize("dry", [0.2, 0.5])
def test_dry_friction_on_a_fast_sine_is_no_clock_that_is_late(hertz, dry):
    """The joint turns round while it is foretold: how it went at the start says little of which way friction pushed since."""
    model, dt, n = compose(ModelSpec("joint", 0.002)), 0.002, 700
    t = dt * np.arange(n)
    u = np.sin(2.0 * np.pi * hertz * t + 0.4)[:, None]
    friction = EffectSpec("coulomb_friction", "qd", {"force_positive": 0.8 * dry, "force_negative": 1.2 * dry})
    robot = compose(ModelSpec("joint", dt, {}, (EffectSpec("input_gain", "force", {"gain": 0.8}), friction)))
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), []
    for row in u:
        rows.append(x[0])
        x, hidden = robot.step(x, row[None], hidden)
    y = np.array(rows)
    y = y + np.random.default_rng(4).normal(size=y.shape) * 0.02 * y.std(axis=0)
    check_plausible(model, from_streams(model, [(Stream(t, y), Stream(t, u))], "here.csv"))


def test_a_joint_whose_clock_is_late_is_still_found():
    name = "joint"
    y, u = _driven(name)
    with pytest.raises(RecordingError, match="before the inputs that cause it"):
        check_plausible(_model(name), _data(_model(name), y, u, early=0.4))


def test_a_joint_that_friction_holds_from_then_on_has_no_clock_that_runs_away():
    """Once it is held, forces do nothing, whatever they are: the smallest, wherever it stands, foretells that best."""
    dt, n, u = 0.01, 800, np.repeat([[-1.69], [-0.62], [-0.94], [-0.07]], 212, axis=0)[:800]
    robot = compose(ModelSpec("joint", dt, {}, (EffectSpec("coulomb_friction", "qd", {"force": 1.6}),)))
    x, rows = np.zeros((1, 2)), []
    for k in range(n):
        rows.append(x[0])
        x, _ = robot.step(x, u[k : k + 1], robot.at_rest(1))
    y, t = np.array(rows) + np.random.default_rng(3).normal(size=(n, 2)) * [2e-4, 3e-3], dt * np.arange(n)
    model = compose(ModelSpec("joint", dt))
    check_plausible(model, from_streams(model, [(Stream(t, y), Stream(t, u))], "here.csv"))


def test_a_heading_that_is_wrapped_to_chance_is_not_asked_instead_of_foretold():
    """A robot that skids, turns at a third of the ideal rate, and whose position is lost in noise: only heading and wheels go anywhere."""
    model, rng = _model("differential_drive"), np.random.default_rng(3)
    y, u = _driven("differential_drive")
    y = y * [1.0, 1.0, 0.3, 1.0, 1.0] + rng.normal(size=y.shape) * [1.0, 1.0, 0.01, 0.01, 0.01]
    data = _data(model, y, u)
    check_plausible(model, data)
    times_57 = _mistake("states", "", partial(_scaled, [2], 180.0 / np.pi))
    assert _if_each_taken_back(model, data, [times_57])[0] is None
    assert len(_if_taken_back(model, data, times_57)) < len(unforetold(model, data)), "it does leave fewer that go"
