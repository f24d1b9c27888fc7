"""Friction and other forces on a rotary axis are in N m, or in rad/s² where the model file has no inertia."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT, MASS, LENGTH, TORQUE = 0.01, 1.3, 0.52, 0.03
INERTIA = MASS * LENGTH**2
LINK = """
import numpy as np
STATES, INPUTS, RATES, PARAMS = ("q", "qd"), ("torque",), {{"qd": "q"}}, {params}
UNITS = {{"q": "rad", "qd": "rad/s", "torque": "{unit}"}}

def step(x, u, dt, params):
    a = u[:, 0] / ({inertia}) - 4.0 * np.sin(x[:, 0])
    v = x[:, 1] + dt * a
    return np.column_stack([x[:, 0] + dt * 0.5 * (x[:, 1] + v), v])
"""
BY_MASS = {"params": {"mass": MASS, "length": LENGTH}, "inertia": 'params["mass"] * params["length"] ** 2', "unit": "N m"}
BY_INERTIA = {"params": {"inertia": INERTIA}, "inertia": 'params["inertia"]', "unit": "N m"}
BOTH = {"params": {"mass": 7.0, "inertia": INERTIA}, "inertia": 'params["inertia"]', "unit": "N m"}
NEITHER = {"params": {"k": 1.0 / INERTIA}, "inertia": '1.0 / params["k"]', "unit": "N m"}
NO_TORQUE = {"params": {"mass": MASS}, "inertia": "1.0", "unit": "V"}
TORQUES = (BY_MASS, BY_INERTIA, BOTH)
ONES = {
    "viscous_friction": ("qd", {"coefficient": 0.07}),
    "coulomb_friction": ("qd", {"force": 0.08}),
    "stribeck_friction": ("qd", {"force": 0.05, "static_force": 0.11, "velocity": 0.3}),
    "quadratic_drag": ("qd", {"coefficient": 0.04}),
    "cubic_stiffness": ("q", {"coefficient": 0.4}),
    "constant_disturbance": ("world", {"x": 0.2}),
}


def link(tmp_path, file, *effects):
    path = tmp_path / "link.py"
    path.write_text(LINK.format(**file))
    return compose(ModelSpec(str(path), DT, {}, tuple(EffectSpec(*e) for e in effects)))


@pytest.mark.parametrize("name", ONES)
@pytest.mark.parametrize("file", [*TORQUES, NEITHER, NO_TORQUE], ids=["mass", "inertia", "both", "neither", "no_torque"])
def test_a_torque_is_divided_by_the_inertia_and_an_acceleration_by_nothing(tmp_path, file, name):
    """As a joint of that inertia under the same effect does, beyond what the file itself does."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (40, 2)), rng.uniform(-2.0, 2.0, (40, 1))
    channel, p = ONES[name]
    inertia = INERTIA if file in TORQUES else 1.0
    bare = link(tmp_path, file)
    usual = bare.advance(x, u, u)
    a = (usual[:, 1:] - x[:, 1:]) / DT
    joint = compose(ModelSpec("joint", DT, {"mass": inertia}, (EffectSpec(name, channel, p),)))
    want = joint.advance(x, inertia * a, inertia * a)
    assert np.allclose(link(tmp_path, file, (name, channel, p)).advance(x, u, u), want, rtol=0.0, atol=1e-9)
    assert not np.allclose(want, usual, rtol=0.0, atol=1e-6)


def units(model, name):
    channel, p = ONES[name]
    return [registry().get("effects", name).unit(model.nominal, channel, parameter) for parameter in p]


@pytest.mark.parametrize("file", TORQUES, ids=["mass", "inertia", "both"])
def test_units_are_those_of_torques(tmp_path, file):
    model = link(tmp_path, file)
    assert units(model, "viscous_friction") == ["N m s/rad"]
    assert units(model, "coulomb_friction") == ["N m"]
    assert units(model, "stribeck_friction") == ["N m", "N m", "rad/s"]
    assert units(model, "quadratic_drag") == ["N m s²/rad²"]
    assert units(model, "cubic_stiffness") == ["N m/rad³"]
    assert units(model, "constant_disturbance") == ["N m"]


@pytest.mark.parametrize("file", [NEITHER, NO_TORQUE], ids=["neither", "no_torque"])
def test_units_are_those_of_angular_accelerations_without_an_inertia(tmp_path, file):
    model = link(tmp_path, file)
    assert units(model, "viscous_friction") == ["1/s"]
    assert units(model, "coulomb_friction") == ["rad/s²"]
    assert units(model, "stribeck_friction") == ["rad/s²", "rad/s²", "rad/s"]
    assert units(model, "quadratic_drag") == ["1/rad"]
    assert units(model, "cubic_stiffness") == ["1/(rad² s²)"]
    assert units(model, "constant_disturbance") == ["rad/s²"]


def test_a_joint_in_metres_keeps_its_newtons():
    model = compose(ModelSpec("joint", DT, {"mass": 2.0}))
    assert units(model, "viscous_friction") == ["N s/m"]
    assert units(model, "coulomb_friction") == ["N"]


def recorded(seed):
    """A link with dry friction of TORQUE N m, in 50 parts a step: (states, torques)."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.5, 0.5, 60), 15)
    q, v, rows = 0.3, 0.0, []
    for torque in u:
        rows.append((q, v))
        for _ in range(50):
            h = DT / 50
            q, before = q + h * v, v
            free = v + h * (torque / INERTIA - 4.0 * np.sin(q))
            v = np.sign(free) * max(abs(free) - h * TORQUE / INERTIA, 0.0)
            q += 0.5 * h * (v - before)
    rows.append((q, v))
    return np.array(rows) + rng.normal(size=(len(rows), 2)) * [2e-5, 5e-4], u[:, None]


@pytest.mark.parametrize(
    ("file", "force", "unit"),
    [(BY_MASS, TORQUE, "N m"), (NEITHER, TORQUE / INERTIA, "rad/s²")],
    ids=["mass", "neither"],
)
def test_the_friction_of_a_link_is_traced_in_its_own_unit(tmp_path, file, force, unit):
    model = link(tmp_path, file)
    found = trace(from_arrays(model, [recorded(4)]), model)
    (friction,) = [e for e in found.effects if e.name == "coulomb_friction"]
    value, low, high, said = friction.parameters["force"]
    assert said == unit
    assert abs(value - force) < max(high - low, 0.05 * force)
