"""Columns of a model of one's own, which says no units: degrees, cm, kelvin, another sign are told by what the model foretells."""

import numpy as np
import pytest
from trace_sets.families import make

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.checks import columns
from s2r_runtime.trace.checks.columns import check_plausible
from s2r_runtime.trace.data.dataset import Stream, from_streams
from s2r_runtime.trace.pipeline import load_dataset

HEADER = "import numpy as np\n\n"
TANKS = (
    HEADER
    + """
STATES, INPUTS, PARAMS = ("h1", "h2"), ("pump",), {"lift": 0.4e-2, "out1": 0.5e-2, "out2": 0.4e-2}


def step(x, u, dt, p):
    for _ in range(10):
        q1, q2 = (p[k] * np.sqrt(np.maximum(h, 0.0)) for k, h in zip(("out1", "out2"), x.T))
        x = x + 0.1 * dt * np.column_stack([p["lift"] * u[:, 0] - q1, q1 - q2])
    return x
"""
)
HEATER = (
    HEADER
    + """
STATES, INPUTS, PARAMS = ("T",), ("power",), {"capacity": 900.0, "loss": 6.0, "ambient": 20.0}


def step(x, u, dt, p):
    end = p["ambient"] + u / p["loss"]
    return end + (x - end) * np.exp(-dt * p["loss"] / p["capacity"])
"""
)
LIFT = (
    HEADER
    + """
STATES, INPUTS, PARAMS, RATES = ("z", "vz"), ("thrust",), {"mass": 1.2}, {"vz": "z"}


def step(x, u, dt, p):
    a = u[:, 0] / p["mass"] - 9.81
    return np.column_stack([x[:, 0] + dt * x[:, 1] + 0.5 * dt * dt * a, x[:, 1] + dt * a])
"""
)
ARM = (
    HEADER
    + """
STATES, INPUTS = ("q1", "q2", "qd1", "qd2"), ("tau1", "tau2")
PARAMS, RATES = {"i1": 0.8, "i2": 0.3}, {"qd1": "q1", "qd2": "q2"}


def step(x, u, dt, p):
    q, v, i = x[:, :2], x[:, 2:], np.array([p["i1"], p["i2"]])
    for _ in range(4):
        v = v + 0.25 * dt * (u - [6.0, 2.0] * np.sin(q)) / i
        q = q + 0.25 * dt * v
    return np.column_stack([q, v])
"""
)
ROBOTS = {  # file, its step, s, least and largest inputs, first state, standard deviations of what measures it
    "tanks": (TANKS, 4.0, [(0.2, 1.0)], [0.3, 0.4], [5e-4, 5e-4]),
    "heater": (HEATER, 10.0, [(0.0, 400.0)], [25.0], [0.1]),
    "lift": (LIFT, 0.05, [(10.5, 13.0)], [1.0, 0.0], [2e-3, 1e-2]),
    "arm": (ARM, 0.02, [(-4.0, 4.0), (-1.5, 1.5)], [0.1, -0.1, 0.0, 0.0], [1e-4, 1e-4, 5e-3, 5e-3]),
}
MISTAKES = {
    "cm": ("tanks", lambda y: 100.0 * y, "h1 and h2 seem to be 100 times"),
    "mm of one": ("tanks", lambda y: y * [1.0, 1000.0], "h2 seems to be 1000 times"),
    "exchanged": ("tanks", lambda y: y[:, ::-1], "h1 and h2 seem to be exchanged"),
    "kelvin": ("heater", lambda y: y + 273.15, "T seems to be in kelvin"),
    "Fahrenheit": ("heater", lambda y: 1.8 * y + 32.0, "T seems to be in degrees Fahrenheit"),
    "down": ("lift", lambda y: -y, "z and vz seem to have the other sign"),
    "degrees": ("arm", np.degrees, "q1, q2, qd1 and qd2 seem to be 57.3 times .* .degrees for radians"),
    "degrees of one": ("arm", lambda y: y * [57.29578, 1.0, 57.29578, 1.0], "q1 and qd1 seem to be 57.3 times"),
    "joints": ("arm", lambda y: y[:, [1, 0, 3, 2]], "q1 and q2, qd1 and qd2 seem to be exchanged"),
}


def _recorded(folder, robot, seed=1, steps=600, gain=1.0, **other):
    """A model as its file says, and what was recorded of a robot with these parameters, whose inputs act `gain` times."""
    text, dt, bounds, first, noise = ROBOTS[robot]
    path = folder / f"{robot}.py"
    path.write_text(text)
    model = compose(ModelSpec(str(path), dt))
    rng = np.random.default_rng(seed)
    u = np.column_stack([np.repeat(rng.uniform(low, high, 1 + steps // 15), 15)[:steps] for low, high in bounds])
    x, rows = np.array([first]), []
    for k in range(steps):
        if robot == "lift":  # held up by somebody's stick
            u[k] = np.clip(u[k] - 6.0 * (x[0, 0] - 1.0) - 4.0 * x[0, 1], 8.0, 16.0)
        rows.append(x[0])
        x = model.nominal.step(x, gain * u[k : k + 1], dt, {**model.parameters, **other})
    return model, np.array(rows) + rng.normal(size=(steps, len(first))) * noise, u


def _check(model, y, u):
    t = model.dt * np.arange(len(y))
    check_plausible(model, from_streams(model, [(Stream(t, y), Stream(t, u))], "here.csv"))


@pytest.mark.parametrize("case", MISTAKES)
def test_states_in_another_unit_or_sign_are_told(tmp_path, case):
    robot, spoil, said = MISTAKES[case]
    model, y, u = _recorded(tmp_path, robot)
    with pytest.raises(RecordingError, match=said):
        _check(model, spoil(y), u)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_that_is_as_the_file_says_or_far_from_it_is_not_accused(tmp_path, robot):
    for seed, change in enumerate([{}, {"gain": 0.3}, {"gain": 3.0}, {"gain": 1e-3}]):
        _check(*_recorded(tmp_path, robot, 10 + seed, **change))


@pytest.mark.parametrize("ambient", [-30.0, 60.0, 120.0])
def test_surroundings_are_not_kelvin(tmp_path, ambient):
    _check(*_recorded(tmp_path, "heater", ambient=ambient))


@pytest.mark.parametrize("gain", [10.0, 45.0, 52.0, 63.0, 100.0, 1000.0])
def test_a_light_joint_is_not_in_degrees(gain):
    """Its mass is whatever it is; just 180/pi times what the model has, it is not."""
    rng, dt = np.random.default_rng(3), 0.01
    model = compose(ModelSpec("joint", dt, {"mass": 1.0}))
    x, rows, forces = np.zeros(2), [], []
    for k in range(1500):
        force = (60.0 * (np.sin(0.9 * k * dt) - x[0]) - 12.0 * x[1] + rng.normal()) / gain
        rows.append(x + rng.normal(size=2) * [1e-4, 4e-3])
        forces.append([force])
        x = np.array([x[0] + dt * x[1] + 0.5 * dt * dt * gain * force, x[1] + dt * gain * force])
    _check(model, np.array(rows), np.array(forces))
    with pytest.raises(RecordingError, match=r"q and qd seem to be 57.3 times what the model takes them for"):
        _check(model, np.degrees(rows), gain * np.array(forces))


def test_no_position_and_no_speed_is_a_temperature(tmp_path):
    """Little more than half the mass moves nearly as far as nine fifths of the motion."""
    given = make("one", 1000694)
    path, _ = given.write(tmp_path)
    model = compose(ModelSpec(given.model["name"], given.model["dt"], given.model["parameters"]))
    check_plausible(model, load_dataset(path, model))


def test_a_model_that_needs_some_input_is_not_asked_what_none_does(tmp_path):
    path = tmp_path / "own.py"
    path.write_text('STATES, INPUTS, PARAMS = ("q",), ("fan",), {}\n\n\ndef step(x, u, dt, params):\n    return x + dt * (1.0 / u - x)\n')
    model, rng = compose(ModelSpec(str(path), 0.1)), np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.5, 3.0, (50, 1)), 10, axis=0)
    rows = [np.ones(1)]
    for given in u[:-1]:
        rows.append(rows[-1] + 0.1 * (1.0 / given - rows[-1]))
    _check(model, np.array(rows) + rng.normal(size=(500, 1)) * 1e-3, u)


def _short_runs(rate_in):
    """Of a joint, 0.24 s each, and its model."""
    model, rng, segments = compose(ModelSpec("joint", 0.002)), np.random.default_rng(0), []
    for run in range(30):
        u = np.repeat(rng.uniform(-30.0, 30.0, (4, 1)), 30, axis=0)
        x, rows = rng.normal(size=(1, 2)) * [0.1, 3.0], []
        for k in range(len(u)):
            rows.append(x[0])
            x, _ = model.step(x, u[k : k + 1], model.at_rest(1))
        t = 100.0 * run + 0.002 * np.arange(len(u))
        segments.append((Stream(t, (np.array(rows) + rng.normal(size=(len(u), 2)) * [1e-5, 1e-3]) * [1.0, rate_in]), Stream(t, u)))
    return model, from_streams(model, segments, "here.csv")


def test_a_rate_in_another_unit_is_told_where_runs_are_shorter_than_half_a_second():
    check_plausible(*_short_runs(1.0))
    with pytest.raises(RecordingError, match="qd seems to be in mm/s"):
        check_plausible(*_short_runs(1000.0))


def test_a_mistake_and_what_else_it_may_be_are_compared_on_the_same_rows(monkeypatch):
    model, data = _short_runs(1.0)
    monkeypatch.setattr(columns, "ROWS", 60)
    few = columns._few(model, data)
    assert {len(run.y) for run in few.runs} == {len(states.t) for states, _ in few.segments} == {60}
