"""Speeds without a position, in somebody's own model: all friction and drag acts on them as on an axis."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.models.forces import is_speed, own_rate
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

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


@pytest.mark.slow
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


LOSING = """
import numpy as np
STATES, INPUTS, PARAMS = ("omega",), ("volt",), {"gain": 40.0, "loss": 7.0}

def step(x, u, dt, p):
    end = p["gain"] / p["loss"] * u
    return end + (x - end) * np.exp(-p["loss"] * dt)
"""
FOLLOWING = """
import numpy as np
STATES, INPUTS, PARAMS = ("y", "vy"), ("vy_cmd",), {"tau": 0.4}

def step(x, u, dt, p):
    keep = np.exp(-dt / p["tau"])
    off = x[:, 1:] - u
    return np.column_stack([x[:, :1] + u * dt + off * p["tau"] * (1.0 - keep), u + off * keep])
"""


def finely(rates, x, dt, parts=4000):
    """States (n, nx) after dt by small steps of rates(x)."""
    for _ in range(parts):
        x = x + dt / parts * rates(x)
    return x


@pytest.mark.parametrize("name", ["coulomb_friction", "stribeck_friction", "quadratic_drag"])
def test_what_brakes_a_speed_that_the_model_slows_down_acts_all_the_while(tmp_path, name):
    (tmp_path / "losing.py").write_text(LOSING)
    p = {"coulomb_friction": {"force": 5.0}, "stribeck_friction": {"force": 3.0, "static_force": 9.0, "velocity": 4.0}}.get(
        name, {"coefficient": 0.6}
    )
    model = compose(ModelSpec(str(tmp_path / "losing.py"), 0.05, {}, (EffectSpec(name, "omega", p),)))
    effect = registry().get("effects", name)
    v, u = np.array([[8.0], [-6.0], [3.0]]), np.array([[2.0], [-1.0], [2.5]])

    def rates(v):
        if name == "quadratic_drag":
            brake = p["coefficient"] * v * np.abs(v)
        elif name == "coulomb_friction":
            brake = p["force"] * np.sign(v)
        else:
            brake = (p["force"] + (p["static_force"] - p["force"]) * np.exp(-((v / p["velocity"]) ** 2))) * np.sign(v)
        return 40.0 * u - 7.0 * v - brake

    want = finely(rates, v, 0.05)
    bent = 1e-2 if effect.varies else 1e-3  # coefficients that bend are one number in each part of a step
    alone = compose(ModelSpec(str(tmp_path / "losing.py"), 0.05)).advance(v, u, u)
    assert np.all(np.abs(model.advance(v, u, u) - want) < bent * np.abs(want - alone))
    assert "omega" not in registry().get("effects", "viscous_friction").channels(model.nominal)  # that is another `loss`


def test_wind_on_a_robot_that_follows_its_commands_is_slowed_down_too(tmp_path):
    (tmp_path / "following.py").write_text(FOLLOWING)
    model = compose(ModelSpec(str(tmp_path / "following.py"), 0.1, {}, (EffectSpec("constant_disturbance", "world", {"x": -0.9}),)))
    x, u = np.array([[0.0, 1.0], [2.0, -0.5]]), np.array([[0.7], [-1.0]])
    want = finely(lambda x: np.column_stack([x[:, 1], (u[:, 0] - x[:, 1]) / 0.4 - 0.9]), x, 0.1)
    assert np.allclose(model.advance(x, u, u), want, atol=5e-5)


@pytest.mark.parametrize(
    ("step", "rate"),
    [
        ("return x * np.exp(-p['loss'] * dt) + dt * u", 7.0),
        ("return x * (1.0 - p['loss'] * dt) + dt * u", 7.0 * 1.0035),  # Euler's rule, over a millisecond
        ("return 0.8 * x + u", -np.log(0.8) / 0.05),  # identified for one step, however long it is
        ("return x + dt * (u - p['loss'] * x * np.abs(x))", 0.0),  # not in proportion
        ("return x + dt * u", 0.0),
        ("return u + 0.0 * x", 0.0),  # set at once
        ("return x * (1.0 + 3.0 * dt) + dt * u", 0.0),  # it runs away
        ("return np.where(np.abs(x) > 0.05, x + dt * (u - 2.0 * np.sign(x)), 0.0)", 0.0),  # dry friction of its own
        ("return np.where(x > 0.0, np.sqrt(x - 100.0), x)", 0.0),  # no numbers there
    ],
)
def test_losses_in_proportion_to_speed_are_told_from_others(tmp_path, step, rate):
    (tmp_path / "own.py").write_text(
        f"import numpy as np\nSTATES, INPUTS, PARAMS = ('omega',), ('u',), {{'loss': 7.0}}\n\ndef step(x, u, dt, p):\n    {step}\n"
    )
    assert own_rate(compose(ModelSpec(str(tmp_path / "own.py"), 0.05)).nominal, 0, 0.05) == pytest.approx(rate, rel=1e-4)


def test_a_loss_that_is_another_one_slows_pushes_down_as_if_it_stood_in_the_file(tmp_path):
    (tmp_path / "losing.py").write_text(LOSING)
    friction = EffectSpec("coulomb_friction", "omega", {"force": 5.0})
    change = EffectSpec("parameter_change", "loss", {"ratio": 2.0})
    v, u = np.array([[8.0], [-6.0]]), np.array([[2.0], [-1.0]])
    changed = compose(ModelSpec(str(tmp_path / "losing.py"), 0.05, {}, (change, friction)))
    said = compose(ModelSpec(str(tmp_path / "losing.py"), 0.05, {"loss": 14.0}, (friction,)))
    assert np.allclose(changed.advance(v, u, u), said.advance(v, u, u), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_dry_friction_of_a_motor_with_losses_of_its_own_is_named(tmp_path, seed):
    (tmp_path / "losing.py").write_text(LOSING)
    model = compose(ModelSpec(str(tmp_path / "losing.py"), DT))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3.0, 3.0, (60, 1)), 15, axis=0)
    v, rows = np.zeros((1, 1)), [0.0]
    for k in range(len(u)):
        for _ in range(200):  # friction holds what it can hold
            pushed = 40.0 * u[k] - 7.0 * v
            v = v + DT / 200 * np.where(np.abs(v) > 0.02, pushed - 9.0 * np.sign(v), pushed - np.clip(pushed, -9.0, 9.0))
        rows.append(float(v[0, 0]))
    measured = np.array(rows)[:, None] + rng.normal(scale=0.02, size=(len(u) + 1, 1))
    found = trace(from_arrays(model, [(measured, u)]), model)
    assert [(e.name, e.channel) for e in found.effects] == [("coulomb_friction", "omega")]
    assert found.effects[0].values["force"] == pytest.approx(9.0, rel=0.02)
