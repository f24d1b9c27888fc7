"""Robots with several axes in a model of one's own: links that move one another, and a body that moves up as well."""

import numpy as np
import pytest

from s2r_runtime.effects.viscous_friction import START_RATE, ViscousFriction
from s2r_runtime.models import forces
from s2r_runtime.models.composed import compose
from s2r_runtime.models.forces import coupled
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.prediction import acting, steps_of
from s2r_runtime.trace.estimation.problem import problem
from s2r_runtime.trace.hypotheses.basis import directions_of
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.reporting.result import TraceResult
from s2r_runtime.trace.selection.stepwise import select

DT_S, PARTS = 0.01, 20
ARM = """
import numpy as np

STATES = ("q1", "q2", "dq1", "dq2")
INPUTS = ("tau1", "tau2")
PARAMS = {"near": 1.2, "far": 0.15, "lever": 0.2}
RATES = {"dq1": "q1", "dq2": "q2"}


def rates(x, u, params):
    \"\"\"Two links in a horizontal plane.\"\"\"
    v, w, c, s = x[:, 2], x[:, 3], np.cos(x[:, 1]), params["lever"] * np.sin(x[:, 1])
    a, b, d = params["near"] + 2 * params["lever"] * c, params["far"] + params["lever"] * c, params["far"]
    one, two = u[:, 0] + s * (2 * v * w + w * w), u[:, 1] - s * v * v
    return np.column_stack([v, w, (d * one - b * two) / (a * d - b * b), (a * two - b * one) / (a * d - b * b)])


def step(x, u, dt, params):
    for _ in range(4):
        x = x + dt / 4 * rates(x + dt / 8 * rates(x, u, params), u, params)
    return x
"""
FINGER = ARM.replace('{"near": 1.2, "far": 0.15, "lever": 0.2}', '{"near": 1.2e-5, "far": 1.5e-6, "lever": 2e-6}')
LIGHT = """
import numpy as np

STATES = ("q1", "q2", "q3", "dq1", "dq2", "dq3")
INPUTS = ("tau1", "tau2", "tau3")
PARAMS = {"loss": 0.6}
RATES = {"dq1": "q1", "dq2": "q2", "dq3": "q3"}
MOBILITY = np.array([[2.0, -4.0, 3.0], [-4.0, 15.0, -20.0], [3.0, -20.0, 100.0]])


def step(x, u, dt, params):
    \"\"\"Three links that hardly leave where they are; the last one is so light that its losses stop it within 16 ms.\"\"\"
    for _ in range(4):
        v = x[:, 3:] + dt / 8 * (u - params["loss"] * x[:, 3:]) @ MOBILITY
        x = np.hstack([x[:, :3] + dt / 4 * v, x[:, 3:] + dt / 4 * (u - params["loss"] * v) @ MOBILITY])
    return x
"""
QUADROTOR = """
import numpy as np

STATES = ("x", "y", "z", "vx", "vy", "vz")
INPUTS = ("roll", "pitch", "thrust")
PARAMS = {"g": 9.81}
RATES = {"vx": "x", "vy": "y", "vz": "z"}


def step(x, u, dt, params):
    roll, pitch, thrust = u.T
    tilt = np.column_stack([np.sin(pitch) * np.cos(roll), -np.sin(roll), np.cos(roll) * np.cos(pitch)])
    a = thrust[:, None] * tilt - [0.0, 0.0, params["g"]]
    return np.hstack([x[:, :3] + dt * x[:, 3:] + dt * dt / 2 * a, x[:, 3:] + dt * a])
"""


def _model(folder, source, *effects):
    path = folder / "robot.py"
    path.write_text(source)
    return compose(ModelSpec(str(path), DT_S, {}, tuple(effects)))


def _brake(v, viscous, dry):
    return np.array(viscous) * v + np.array(dry) * np.tanh(v / 1e-4)


def _arm_step(model, x, u, viscous, dry, parts=PARTS):
    """The arm with friction in its joints, in parts so small that what is asked of the model is its accelerations."""
    h = DT_S / parts
    for _ in range(parts):
        held = u - _brake(x[:, 2:], viscous, dry)
        x = model.nominal.step(x, held, h, model.parameters)
    return x


def test_links_that_move_one_another_are_told_from_axes_that_do_not(tmp_path):
    assert coupled(_model(tmp_path, ARM).nominal)
    assert coupled(_model(tmp_path, FINGER).nominal)
    assert coupled(_model(tmp_path, LIGHT).nominal)
    assert not coupled(_model(tmp_path, QUADROTOR).nominal)
    assert not coupled(compose(ModelSpec("double_integrator", DT_S)).nominal)


@pytest.mark.parametrize(("viscous", "dry"), [((1.0, 0.3), (0.0, 0.0)), ((0.0, 0.0), (0.4, 0.1))])
def test_friction_in_the_joints_of_an_arm_acts_as_its_torques_do(tmp_path, viscous, dry):
    name, key, sizes = ("viscous_friction", "coefficient", viscous) if any(viscous) else ("coulomb_friction", "force", dry)
    braked = _model(tmp_path, ARM, *(EffectSpec(name, f"dq{i + 1}", {key: size}) for i, size in enumerate(sizes)))
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (400, 4)), rng.uniform(-1.0, 1.0, (400, 2))
    x[:, 2:] += 0.3 * np.sign(x[:, 2:])  # none of them stops within the step
    does = braked.step(x, u, braked.at_rest(400))[0]
    free = braked.nominal.step(x, u, DT_S, braked.parameters)
    true = _arm_step(braked, x, u, viscous, dry, 400)
    assert np.all(np.max(np.abs(does - true), axis=0) < 0.05 * np.max(np.abs(true - free), axis=0))


def test_dry_friction_holds_all_links_at_once(tmp_path):
    held = _model(tmp_path, ARM, *(EffectSpec("coulomb_friction", f"dq{i}", {"force": 0.5}) for i in (1, 2)))
    x = np.column_stack([np.zeros((50, 1)), np.linspace(-2.0, 2.0, 50)[:, None], np.zeros((50, 2))])
    moved = held.step(x, np.tile([0.4, -0.4], (50, 1)), held.at_rest(50))[0] - x
    assert np.max(np.abs(moved)) < 1e-6


def test_what_friction_holds_on_links_takes_a_few_rounds_and_only_of_the_rows_that_it_holds(tmp_path, monkeypatch):
    held = _model(tmp_path, ARM, *(EffectSpec("coulomb_friction", f"dq{i}", {"force": 0.5}) for i in (1, 2)))
    rng, glide, rows = np.random.default_rng(0), forces._glide, []
    monkeypatch.setattr(forces, "_glide", lambda v, *rest: (rows.append(len(v)), glide(v, *rest))[1])
    x, u = rng.uniform(-2.0, 2.0, (1000, 4)), rng.uniform(-0.4, 0.4, (1000, 2))
    x[::10, 2:] = 0.0
    found = held.step(x, u, held.at_rest(1000))[0]
    assert (
        sum(rows) < 20 * 1000
    )  # 50 times, if every row is swept until the last one is done, each time by as much as the sweep makes of it
    monkeypatch.setattr(forces, "SETTLED", 1e-14)
    monkeypatch.setattr(forces, "SWEEPS", 400)
    assert np.allclose(held.step(x, u, held.at_rest(1000))[0], found, rtol=0.0, atol=1e-9)


def test_six_links_that_stick_and_slip_in_turn_come_to_rest(monkeypatch):
    """Steps that go on to where sweeps seem to end would go round for ever where links change between sticking and slipping."""
    monkeypatch.setattr(forces, "SWEEPS", 400)
    rng, n, links = np.random.default_rng(6), 1000, 6
    turned = np.cumsum(rng.uniform(-3.0, 3.0, (n, links)), axis=1)
    beyond = np.arange(links)[:, None] <= np.arange(links)  # each link carries those after it
    reach = np.stack([-np.sin(turned), np.cos(turned)], axis=1)  # (n, 2, links) of a link of 1 m
    bodies = [np.einsum("nak,jk->naj", reach[:, :, : b + 1], beyond[:, : b + 1]) for b in range(links)]
    mass = sum(m * np.einsum("nai,naj->nij", jacobian, jacobian) for m, jacobian in zip(rng.uniform(0.5, 2.0, links), bodies, strict=True))
    w = np.linalg.inv(mass + 0.05 * np.eye(links))
    speeds = [np.where(rng.random(n) < 0.5, 0.0, 0.1 * rng.normal(size=n)) for _ in range(links)]
    given = [5.0 * rng.normal(size=n) for _ in range(links)]
    pushes = [forces.Push(np.zeros(n), (0.1 * w[:, i, i],) * 2, (2.0 * w[:, i, i],) * 2, None) for i in range(links)]
    found = forces._swept(speeds, given, pushes, w, 0.01)[0]
    for i in range(links):
        drive = given[i] + sum(w[:, i, j] * found[j] for j in range(links) if j != i)
        again = ((forces._glide(speeds[i], drive, pushes[i], 0.01)[0] - speeds[i]) / 0.01 - drive) / w[:, i, i]
        assert np.max(np.abs(again - found[i])) < 1e-6 * np.max(np.abs(found))


def test_friction_in_the_joints_of_an_arm_is_named(tmp_path):
    model, rng = _model(tmp_path, ARM), np.random.default_rng(1)
    f, size, phase = rng.uniform(0.2, 0.9, (2, 3)), rng.uniform(0.2, 0.5, (2, 3)), rng.uniform(0.0, 6.0, (2, 3))
    x, states, inputs = np.zeros((1, 4)), [], []
    for k in range(600):
        angle = 2.0 * np.pi * f * k * DT_S + phase
        q, v = np.sum(size * np.sin(angle), axis=1), np.sum(size * 2.0 * np.pi * f * np.cos(angle), axis=1)
        if k == 0:
            x[0] = *q, *v
        u = np.array([[20.0, 4.0]]) * (q - x[:, :2]) + np.array([[5.0, 0.8]]) * (v - x[:, 2:])
        states.append(x[0])
        inputs.append(u[0])
        x = _arm_step(model, x, u, (1.0, 0.3), (0.0, 0.0))
    noise = rng.normal(size=(600, 4)) * [1e-3, 1e-3, 0.01, 0.01]
    data = from_arrays(model, [(np.array(states) + noise, np.array(inputs[:-1]))])
    found = select(problem(data, steps_of(data)), model, 50, lambda share: None).fit.model.effects
    assert {(a.effect.name, a.channel) for a in found} == {("viscous_friction", "dq1"), ("viscous_friction", "dq2")}
    sizes = {a.channel: a.p["coefficient"] for a in found}  # one number: it is the same either way
    assert sizes == pytest.approx({"dq1": 1.0, "dq2": 0.3}, rel=0.05)


def _flown(folder, sag, wind, lost=(), lift=0.0) -> TraceResult:
    """lift: m/s² upwards, at a height of 0, however the robot tilts, and less by e each 0.4 m."""
    model, rng = _model(folder, QUADROTOR), np.random.default_rng(2)
    goal = np.repeat(rng.uniform(-2.0, 2.0, (10, 3)), 100, axis=0)
    x, states, inputs = np.zeros((1, 6)), [], []
    for k in range(1000):
        a = np.clip(1.8 * (goal[k] - x[0, :3]) - 2.2 * x[0, 3:] + 0.1 * rng.normal(size=3), -4.0, 4.0)
        u = np.array([[-a[1] / 9.81, a[0] / 9.81, 9.81 + a[2]]])
        states.append(x[0])
        inputs.append(u[0])
        x = model.nominal.step(x, u * [1.0, 1.0, 1.0 + sag], DT_S, model.parameters)
        push = np.array([wind[0], wind[1], wind[2] + lift * np.exp(-x[0, 2] / 0.4)])
        x[0] += np.concatenate([0.5 * DT_S * DT_S * push, DT_S * push])
    noise = rng.normal(size=(1000, 6)) * [0.002, 0.002, 0.002, 0.03, 0.03, 0.03]
    y = np.array(states) + noise
    for first in lost:
        y[first : first + 40] = y[first - 1]
    return trace(from_arrays(model, [(y, np.array(inputs[:-1]))]), model)


@pytest.mark.slow
def test_a_robot_that_moves_up_as_well_is_traced(tmp_path):
    found = _flown(tmp_path, -0.06, (0.0, 0.0, 0.0))
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "thrust")]


@pytest.mark.slow
def test_wind_may_blow_downwards(tmp_path):
    (found,) = _flown(tmp_path, 0.0, (0.3, 0.0, -0.2)).effects
    assert (found.name, found.channel) == ("constant_disturbance", "world")
    assert [found.parameters[k][0] for k in "xyz"] == pytest.approx([0.3, 0.0, -0.2], abs=0.02)


CART = """
import numpy as np

STATES, INPUTS, PARAMS, RATES = ("x", "y", "vx", "vy"), ("ax",), {}, {"vx": "x", "vy": "y"}


def step(x, u, dt, params):
    a = np.column_stack([u[:, 0], 0.0 * u[:, 0]])
    return np.hstack([x[:, :2] + dt * x[:, 2:], x[:, 2:] + dt * a])
"""


def _directions(folder, source, dt):
    path = folder / "robot.py"
    path.write_text(source)
    model, rng = compose(ModelSpec(str(path), dt)), np.random.default_rng(0)
    nx, nu = len(model.states), len(model.inputs)
    data = from_arrays(model, [(rng.uniform(-0.2, 0.2, (50, nx)), rng.uniform(0.05, 0.3, (49, nu)))])
    given = problem(data, steps_of(data))
    return directions_of(given, model, acting(model, data))


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.5])
def test_an_axis_along_which_an_input_pushes_is_no_other_direction(tmp_path, dt):
    body, world = _directions(tmp_path, CART, dt)  # Euler's rule: the input moves the speed alone
    assert len(body) == 1
    assert [np.flatnonzero(axis[0]).tolist() for axis in world] == [[1, 3]]
    body, world = _directions(tmp_path, QUADROTOR, dt)
    assert len(body) == 3
    assert [np.flatnonzero(axis[0]).tolist() for axis in world][-1] == [2, 5]
    assert _directions(tmp_path, ARM, dt)[1] == []  # links that move one another


@pytest.mark.slow
def test_what_depends_on_a_place_is_asked_about_where_inputs_push_as_well(tmp_path):
    (tmp_path / "robot.py").write_text(CART)
    model, rng = compose(ModelSpec(str(tmp_path / "robot.py"), DT_S)), np.random.default_rng(4)
    u = np.repeat(rng.uniform(-1.0, 1.0, 40), 25)
    x, rows = np.array([0.0, 0.0, 0.0, 0.2]), []
    for a in u:
        rows.append(x)
        for _ in range(PARTS):
            h = DT_S / PARTS
            x = x + h * np.array([x[2], x[3], a - 6.0 * x[0], 0.0])  # a spring along the way that it is driven
    y = np.array([*rows, x]) + rng.normal(size=(1001, 4)) * [1e-4, 1e-4, 1e-3, 1e-3]
    found = trace(from_arrays(model, [(y, u[:, None])]), model)
    assert "position" in found.depends_on or any(e.name in {"position_field", "cubic_stiffness"} for e in found.effects)


@pytest.mark.slow
def test_the_ground_lifts_what_flies_low_however_it_tilts(tmp_path):
    found = _flown(tmp_path, 0.0, (0.0, 0.0, 0.0), lift=0.15)
    assert found.verdict == "unexplained"
    assert "position" in found.depends_on


@pytest.mark.slow
def test_a_message_that_repeats_is_frozen_in_all_that_it_says(tmp_path):
    found = _flown(tmp_path, 0.0, (0.0, 0.0, 0.0), lost=(300, 700))
    assert found.verdict == "sensor_fault"
    assert sorted(f.channel for f in found.faults) == sorted(2 * ["x", "y", "z", "vx", "vy", "vz"])
    assert {f.kind for f in found.faults} == {"frozen"}


SPEEDS_ONLY = """
import numpy as np

STATES = ("vx", "vy")
INPUTS = ("tilt_x", "tilt_y")
PARAMS = {"g": 9.81, "drag": DRAG}


def step(x, u, dt, params):
    return x + dt * (params["g"] * np.tan(u) - params["drag"] * x)
"""


@pytest.mark.slow
def test_drag_on_speeds_without_positions_is_named(tmp_path):
    model, rng = _model(tmp_path, SPEEDS_ONLY.replace("DRAG", "0.0")), np.random.default_rng(3)
    u = np.repeat(rng.uniform(-0.2, 0.2, (40, 2)), 25, axis=0)
    v = [np.zeros((1, 2))]
    for tilt in u:
        v.append(v[-1])
        for _ in range(PARTS):
            v[-1] = v[-1] + DT_S / PARTS * (9.81 * np.tan(tilt) - np.array([0.4, 0.3]) * v[-1])
    y = np.concatenate(v) + 0.02 * rng.normal(size=(1001, 2))
    found = trace(from_arrays(model, [(y, u)]), model)
    assert {(e.name, e.channel, round(e.parameters["coefficient"][0], 1)) for e in found.effects} == {
        ("viscous_friction", "vx", 0.4),
        ("viscous_friction", "vy", 0.3),
    }


TURNTABLE = """
import numpy as np

STATES = ("q", "qd", "omega")
INPUTS = ("force", "spin")
PARAMS = {"mass": 2000.0}


def step(x, u, dt, params):
    a = u[:, :1] / params["mass"]
    return x + dt * np.hstack([x[:, 1:2] + dt / 2 * a, a, u[:, 1:]])
"""


def test_drag_on_a_speed_without_a_position_begins_at_a_rate_whatever_the_mass(tmp_path):
    model = _model(tmp_path, TURNTABLE).nominal
    drag, u = ViscousFriction(), np.ones((10, 2))
    assert drag.channels(model) == ("qd", "omega")
    assert drag.starts(u, model, "qd", DT_S)[0] == {"coefficient": START_RATE * 2000.0}
    assert drag.starts(u, model, "omega", DT_S)[0] == {"coefficient": START_RATE}


def test_a_model_that_slows_its_speeds_down_has_a_parameter_for_it(tmp_path):
    drags = [ViscousFriction().channels(_model(tmp_path, SPEEDS_ONLY.replace("DRAG", drag)).nominal) for drag in ("0.0", "0.2")]
    assert drags == [("vx", "vy"), ()]


def test_another_thread_that_asks_of_the_same_arm_changes_no_answer(tmp_path, monkeypatch):
    """The daemon steps a model in its worker, too: the rows of another are kept last, between question and answer."""
    model, rng = _model(tmp_path, ARM).nominal, np.random.default_rng(7)
    one, other = (rng.uniform(-1.0, 1.0, (6, 4)) for _ in range(2))
    u, usual = np.ones((6, 2)), forces.response
    alone = usual(one, u, model, DT_S)

    class Shared(dict):
        def __setitem__(self, key, value):
            super().__setitem__(key, value)
            super().__setitem__(key, (DT_S, other, u, usual(other, u, model, DT_S)))

    monkeypatch.setattr(forces, "_LAST", Shared())
    assert np.array_equal(forces._response(one, u, model, DT_S), alone)


PROPELLERS = """
import numpy as np

STATES = ("z", "vz", "qw", "qx")
INPUTS = ("{first}", "second")
PARAMS = {{"mass": 0.5, "pull": 2e-6}}
RATES = {{"vz": "z"}}
UNITS = {{"z": "m", "vz": "m/s", "{first}": "{unit}"}}


def step(x, u, dt, params):
    q = x[:, 2:] / np.linalg.norm(x[:, 2:], axis=1, keepdims=True)
    a = {force} * (1 - 2 * q[:, 1] ** 2) / params["mass"] - 9.81
    return np.column_stack([x[:, 0] + dt * x[:, 1], x[:, 1] + dt * a, q])
"""


@pytest.mark.parametrize(
    ("first", "unit", "force", "said"),
    [("rotor", "rad/s", "params['pull'] * u[:, 0] ** 2", "N"), ("thrust", "lbf", "u[:, 0]", "lbf"), ("tilt", "rad", "u[:, 1]", "N")],
)
def test_what_brakes_is_told_in_units_of_an_input_only_if_that_is_a_force(tmp_path, first, unit, force, said):
    """The speed of a rotor is none, although a mass divides what it does; no attitude is a quaternion of zeros."""
    model = _model(tmp_path, PROPELLERS.format(first=first, unit=unit, force=force))
    assert ViscousFriction().unit(model.nominal, "vz", "coefficient") == f"{said} s/m"
