"""Speeds without a position, in somebody's own model: all friction and drag acts on them as on an axis."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.models.forces import is_speed
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.dataset import from_arrays
from s2r_runtime.trace.tracer import trace

DT = 0.02
MOTOR = """
import numpy as np
STATES = ("omega",)
INPUTS = ("torque",)
PARAMS = {"inertia": 0.5}

def step(x, u, dt, params):
    return x + dt * u / params["inertia"]
"""
FLYING = """
import numpy as np
STATES = ("vx", "vy", "vz")
INPUTS = ("roll", "pitch", "thrust")
PARAMS = {"g": 9.81}

def step(x, u, dt, params):
    roll, pitch, thrust = u.T
    a = thrust[:, None] * np.column_stack([np.sin(pitch) * np.cos(roll), -np.sin(roll), np.cos(roll) * np.cos(pitch)])
    a[:, 2] -= params["g"]
    return x + dt * a
"""
ONES = {
    "viscous_friction": {"coefficient": 0.7},
    "coulomb_friction": {"force": 0.8},
    "stribeck_friction": {"force": 0.5, "static_force": 1.1, "velocity": 0.3},
    "quadratic_drag": {"coefficient": 0.4},
}


@pytest.fixture
def motor(tmp_path):
    path = tmp_path / "motor.py"
    path.write_text(MOTOR)
    return lambda *effects: compose(ModelSpec(str(path), DT, {}, effects))


@pytest.fixture
def flying(tmp_path):
    path = tmp_path / "flying.py"
    path.write_text(FLYING)
    return compose(ModelSpec(str(path), DT))


@pytest.mark.parametrize("names", [*((name,) for name in ONES), ("viscous_friction", "coulomb_friction"), tuple(ONES)], ids=" ".join)
def test_a_speed_without_a_position_is_braked_as_that_of_an_axis_over_its_mass(motor, names):
    rng = np.random.default_rng(0)
    v, u = rng.uniform(-1.0, 1.0, (60, 1)), rng.uniform(-2.0, 2.0, (60, 1))
    v[:5] = 0.0  # held, or not
    over = {name: {k: v if k == "velocity" else v / 0.5 for k, v in p.items()} for name, p in ONES.items()}
    alone = motor(*(EffectSpec(name, "omega", over[name]) for name in names))
    axis = compose(ModelSpec("joint", DT, {"mass": 0.5}, tuple(EffectSpec(name, "qd", ONES[name]) for name in names)))
    want = axis.advance(np.hstack([np.zeros_like(v), v]), u, u)[:, 1:]
    assert np.allclose(alone.advance(v, u, u), want, rtol=1e-6, atol=1e-9)


def test_what_brakes_it_has_units(motor):
    model = motor().nominal
    known = registry()
    told = {name: [known.get("effects", name).unit(model, "omega", p) for p in ONES[name]] for name in ONES}
    assert told == {
        "viscous_friction": ["1/s"],
        "coulomb_friction": ["rad/s²"],
        "stribeck_friction": ["rad/s²", "rad/s²", "rad/s"],
        "quadratic_drag": ["1/rad"],
    }


@pytest.mark.parametrize("seed", range(3))
def test_dry_friction_of_a_motor_is_named(motor, seed):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 15)
    v, seen = 0.0, [0.0]
    for torque in u:
        for _ in range(20):
            free = v + DT / 20 * torque / 0.5
            v = np.sign(free) * max(abs(free) - DT / 20 * 0.2 / 0.5, 0.0)
        seen.append(v)
    y = np.array(seen)[:, None] + 0.003 * rng.normal(size=(len(seen), 1))
    result = trace(from_arrays(motor(), [(y, u[:, None])]), motor())
    assert [(e.name, e.channel) for e in result.effects] == [("coulomb_friction", "omega")]
    _, low, high = result.effects[0].parameters["force"][:3]
    assert low < 0.2 / 0.5 < high


def test_drag_with_the_square_of_each_speed_of_a_flying_robot_is_named(flying):
    rng = np.random.default_rng(1)
    held = [np.repeat(rng.uniform(-a, a, 60), 20) for a in (0.2, 0.2, 1.0)]
    v, seen, asked = np.zeros(3), [np.zeros(3)], []
    for k in range(1200):
        u = np.array([held[0][k] + 0.15 * v[1], held[1][k] - 0.15 * v[0], 9.81 + held[2][k] - 0.8 * v[2]])
        asked.append(u)
        lift = u[2] * np.array([np.sin(u[1]) * np.cos(u[0]), -np.sin(u[0]), np.cos(u[0]) * np.cos(u[1])])
        for _ in range(20):
            v = v + DT / 20 * (lift - [0.0, 0.0, 9.81] - 0.15 * v * np.abs(v))
        seen.append(v)
    y = np.array(seen) + 0.01 * rng.normal(size=(1201, 3))
    result = trace(from_arrays(flying, [(y, np.array(asked))]), flying)
    assert {(e.name, e.channel) for e in result.effects} == {("quadratic_drag", s) for s in ("vx", "vy", "vz")}


DC_MOTOR = """
import numpy as np
STATES = ("current", "omega")
INPUTS = ("volts",)
PARAMS = {"R": 1.0, "L": 0.5, "k": 0.4, "J": 0.05}

def step(x, u, dt, p):
    i, w = x.T
    return x + dt * np.column_stack([(u[:, 0] - p["R"] * i - p["k"] * w) / p["L"], p["k"] * i / p["J"]])
"""


@pytest.mark.parametrize("name", ONES)
def test_what_brakes_a_motor_does_so_in_finer_steps_too(tmp_path, name):
    """In parts of a step, what its speed does to its current comes back to it: the file itself does not slow it down."""
    path = tmp_path / "dc.py"
    path.write_text(DC_MOTOR)
    brake = EffectSpec(name, "omega", ONES[name])
    finer = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
    x, u = np.array([[0.5, 3.0]]), np.array([[2.0]])
    plain, braked, both, fine = (
        compose(ModelSpec(str(path), DT, {}, effects)).advance(x, u, u)[0, 1] for effects in ((), (brake,), (brake, finer), (finer,))
    )
    assert braked < plain - 1e-3
    assert fine - both == pytest.approx(plain - braked, rel=0.05)


def test_names_of_speeds():
    speeds = ["velocity", "cmd_v", "wheel_speed", "yaw_rate", "omega", "linvel"]
    others = ["level", "roll", "drive", "v_bat", "flow_rate", "accelerate"]
    assert [name for name in (*speeds, *others) if is_speed(name)] == speeds
