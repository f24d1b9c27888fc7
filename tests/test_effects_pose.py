"""Effects on the motion of a pose and on what is measured of it, against a thousand parts a step, written without the library."""

import time

import numpy as np
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import compose
from s2r_runtime.models.forces import axes
from s2r_runtime.modelspec import EffectSpec, ModelSpec, dump_model, load_model
from s2r_runtime.plugins import registry

PARTS = 1000
ROWS = 60
ARC = ("integration_scheme", "*", {"scheme": "exact"})
GEOMETRY = {"differential_drive": {"wheel_radius": 0.08, "track": 0.4}, "bicycle": {"wheel_base": 0.5}, "unicycle": {}}


def composed(name, dt, *effects, **parameters):
    return compose(ModelSpec(name, dt, parameters or GEOMETRY.get(name, {}), tuple(EffectSpec(*e) for e in effects)))


def commanded(name, u):
    """(n,) speed and yaw rate that the command means."""
    if name == "unicycle":
        return u[:, 0], u[:, 1]
    if name == "differential_drive":
        return 0.08 * (u[:, 0] + u[:, 1]) / 2.0, 0.08 * (u[:, 1] - u[:, 0]) / 0.4
    return u[:, 1], u[:, 1] * np.tan(u[:, 0]) / 0.5


def moved(x, v, w, dt, arc, side=0.0, ahead=lambda theta: 0.0, drift=lambda px, py: (0.0, 0.0)):
    """(n, 3) pose after dt: speeds ahead (v + ahead(theta)) and to the left (side) along the body, drift along the world's axes.

    The heading is the one of the moment on arcs, and the one at the start by Euler's rule.
    """
    px, py, theta, h = x[:, 0].copy(), x[:, 1].copy(), x[:, 2].copy(), dt / PARTS
    for k in range(PARTS):
        now = theta + (k + 0.5) * h * w if arc else theta
        forward = v + ahead(now)
        dx, dy = drift(px, py)
        qx, qy = px + 0.5 * h * (forward * np.cos(now) + dx), py + 0.5 * h * (forward * np.sin(now) + dy)
        dx, dy = drift(qx, qy)
        px = px + h * (forward * np.cos(now) - side * np.sin(now) + dx)
        py = py + h * (forward * np.sin(now) + side * np.cos(now) + dy)
    return np.column_stack([px, py, theta + dt * w])


M = np.array([[0.5, -0.3], [0.2, 0.4]])
EFFECTS = {
    "wind": (("constant_disturbance", "world", {"x": 0.1, "y": -0.2}), lambda v, w: {"drift": lambda px, py: (0.1, -0.2)}),
    "current": (("constant_disturbance", "body", {"x": 0.1, "y": -0.2}), lambda v, w: {"v": v + 0.1, "side": -0.2}),
    "slope": (
        ("gravity_slope", "*", {"x": 0.1, "y": -0.2}),
        lambda v, w: {"ahead": lambda theta: 0.1 * np.cos(theta) - 0.2 * np.sin(theta)},
    ),
    "sliding": (("lateral_slip", "*", {"coefficient": -0.15}), lambda v, w: {"side": -0.15 * v * w}),
    "slipping": (("longitudinal_slip", "*", {"ratio": 0.3}), lambda v, w: {"v": 0.7 * v}),
    "skidding": (("track_scale", "theta", {"gain": 0.6}), lambda v, w: {"w": 0.6 * w}),
    "field": (("position_field", "*", {"matrix": M.tolist()}), lambda v, w: {"drift": lambda px, py: M @ np.stack([px, py])}),
    "understeer": (("understeer", "theta", {"coefficient": 0.3}), lambda v, w: {"w": w * 0.5 / (0.5 + 0.3 * v**2)}),
    "tyres": (("rear_slip", "*", {"coefficient": 0.2}), lambda v, w: {"side": -0.2 * v * v * w}),
}
OF_CARS = {"understeer", "tyres"}


def _cases():
    return [(name, effect) for name in GEOMETRY for effect in EFFECTS if effect not in OF_CARS or name == "bicycle"]


@pytest.mark.parametrize("arc", [True, False])
@pytest.mark.parametrize("dt", [0.01, 0.1])
@pytest.mark.parametrize(("name", "effect"), _cases())
def test_poses_move_as_small_parts_of_the_step_do(name, effect, dt, arc):
    spec, physics = EFFECTS[effect]
    rng = np.random.default_rng(4)
    model, bare = composed(name, dt, spec, *((ARC,) if arc else ())), composed(name, dt, *((ARC,) if arc else ()))
    x = rng.uniform(-1.5, 1.5, (ROWS, len(model.states)))
    u = rng.uniform(-1.0, 1.0, (ROWS, 2)) * {"unicycle": (1.0, 3.0), "differential_drive": (9.0, 9.0), "bicycle": (0.7, 1.5)}[name]
    v, w = commanded(name, u)
    expected = moved(x, dt=dt, arc=arc, **{"v": v, "w": w, **physics(v, w)})
    x1, plain = model.advance(x, u, u), bare.advance(x, u, u)
    done = np.sqrt(np.mean((expected - plain[:, :3]) ** 2))
    # what a field does along a path that bends changes within the step: second order in it
    share = 0.01 if effect == "field" else 1e-5
    assert np.sqrt(np.mean((x1[:, :3] - expected) ** 2)) < share * done
    assert np.array_equal(x1[:, 3:], plain[:, 3:])  # wheels and speed are as commanded


def test_changes_of_the_body_apply_before_the_arc_and_the_worlds_after_it_in_any_order():
    rng = np.random.default_rng(5)
    x, u = rng.uniform(-1.0, 1.0, (ROWS, 3)), rng.uniform(-2.0, 2.0, (ROWS, 2))
    wind, slip, skid = EFFECTS["wind"][0], EFFECTS["sliding"][0], EFFECTS["skidding"][0]
    expected = moved(x, u[:, 0], 0.6 * u[:, 1], 0.1, arc=True, side=-0.15 * u[:, 0] * 0.6 * u[:, 1], drift=lambda px, py: (0.1, -0.2))
    for effects in ((ARC, skid, slip, wind), (wind, skid, slip, ARC), (skid, ARC, wind, slip)):
        assert np.allclose(composed("unicycle", 0.1, *effects).advance(x, u, u), expected, rtol=0.0, atol=1e-7)
    # the order of two changes of the body is that of the list: sliding by the yaw rate before it is scaled
    other = composed("unicycle", 0.1, ARC, slip, skid).advance(x, u, u)
    assert np.max(np.abs(other - expected)) > 1e-3


def test_tyres_give_way_by_the_yaw_rate_that_is_left_in_any_order():
    rng = np.random.default_rng(5)
    x = rng.uniform(-1.0, 1.0, (ROWS, 4))
    u = rng.uniform(0.5, 2.0, (ROWS, 2)) * [0.3, 1.0]
    less, slides = EFFECTS["understeer"][0], EFFECTS["tyres"][0]
    one, other = (composed("bicycle", 0.1, ARC, *both).advance(x, u, u) for both in ((less, slides), (slides, less)))
    v, w = commanded("bicycle", u)
    w = w * 0.5 / (0.5 + 0.3 * v**2)
    assert np.allclose(one, other, rtol=0.0, atol=1e-12)
    assert np.allclose(one[:, :3], moved(x, v, w, 0.1, arc=True, side=-0.2 * v * v * w), rtol=0.0, atol=1e-6)


def test_a_slope_of_the_world_is_no_wind():
    model = composed("unicycle", 0.1, ("gravity_slope", "*", {"x": 0.2, "y": 0.0}))
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.0, 0.0, np.pi]])
    u = np.tile([0.5, 0.0], (3, 1))
    x1 = model.advance(x, u, u)
    assert x1[:, :2] == pytest.approx(np.array([[0.07, 0.0], [0.0, 0.05], [-0.03, 0.0]]), abs=1e-15)


def test_a_slope_on_axes_is_a_constant_push():
    for name, p in (("joint", {"x": 0.3}), ("double_integrator", {"x": 0.3, "y": -0.4})):
        slope, push = (composed(name, 0.1, (e, c, p)) for e, c in (("gravity_slope", "*"), ("constant_disturbance", "world")))
        x, u = np.ones((1, len(slope.states))), np.ones((1, len(slope.inputs)))
        assert np.array_equal(slope.advance(x, u, u), push.advance(x, u, u))


def test_a_car_that_oversteers_too_fast_turns_at_most_twenty_times_as_sharply():
    model = composed("bicycle", 0.01, ("understeer", "theta", {"coefficient": -1.0}))
    u = np.array([[0.1, 5.0]])
    x1 = model.advance(np.zeros((1, 4)), u, u)
    assert x1[0, 2] == pytest.approx(20.0 * 0.01 * 5.0 * np.tan(0.1) / 0.5)


# ---------------------------------------------------------------- sensors


def test_a_robot_is_judged_by_what_its_sensors_would_show():
    """The true robot knows nothing of its sensors: it moves, and then it is measured."""
    rng = np.random.default_rng(6)
    x, u = rng.uniform(-1.0, 1.0, (ROWS, 3)), rng.uniform(-2.0, 2.0, (ROWS, 2))
    bare = composed("unicycle", 0.1, ARC)

    def measured(true):
        c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
        return np.column_stack([true[:, 0] + 0.1 * c + 0.3 * s, true[:, 1] + 0.1 * s - 0.3 * c, true[:, 2] + 0.2])

    sensed = composed("unicycle", 0.1, ("sensor_lever_arm", "*", {"x": 0.1, "y": -0.3}), ("heading_offset", "theta", {"angle": 0.2}), ARC)
    assert np.allclose(sensed.advance(measured(x), u, u), measured(bare.advance(x, u, u)), rtol=0.0, atol=1e-13)


def test_offsets_that_no_step_shows_are_no_channels():
    offset = registry().get("effects", "sensor_offset")
    channels = {name: offset.channels(registry().get("models", name)) for name in registry().names("models")}
    assert channels == {
        "unicycle": ("theta",),
        "differential_drive": ("theta", "wheel_left", "wheel_right"),
        "bicycle": ("theta", "speed"),
        "double_integrator": ("vx", "vy"),
        "joint": ("qd",),
    }


def test_a_rate_that_is_measured_with_an_offset_moves_the_position_at_another_one():
    model = composed("joint", 0.1, ("sensor_offset", "qd", {"offset": 0.3}), mass=2.0)
    u = np.array([[0.8]])
    assert model.advance(np.array([[0.0, 1.0]]), u, u)[0] == pytest.approx([0.07 + 0.5 * 0.01 * 0.4, 1.04])


def test_a_speed_that_is_set_at_once_is_measured_with_its_offset():
    model = composed("bicycle", 0.1, ("sensor_offset", "speed", {"offset": 0.3}), ("input_lag", "speed_cmd", {"time_constant": 0.2}))
    x1, _ = model.step(np.array([[0.0, 0.0, 0.0, 5.0]]), np.array([[0.0, 1.0]]), model.at_rest(1))
    bare = composed("bicycle", 0.1, ("input_lag", "speed_cmd", {"time_constant": 0.2}))
    plain, _ = bare.step(np.array([[0.0, 0.0, 0.0, 5.0]]), np.array([[0.0, 1.0]]), bare.at_rest(1))
    assert x1[0] - plain[0] == pytest.approx([0.0, 0.0, 0.0, 0.3], abs=1e-15)


def test_headings_wrap_with_their_offset():
    model = composed("unicycle", 0.1, ("heading_offset", "theta", {"angle": 3.0}))
    x1, _ = model.step(np.array([[0.0, 0.0, 3.1]]), np.array([[1.0, 1.0]]), model.at_rest(1))
    assert x1[0] == pytest.approx([0.1 * np.cos(0.1), 0.1 * np.sin(0.1), 3.2 - 2.0 * np.pi])


# ---------------------------------------------------------------- in files, in models of others


def test_a_matrix_survives_its_file_and_a_wrong_one_is_refused(tmp_path):
    spec = ModelSpec("unicycle", 0.1, {}, (EffectSpec("position_field", "*", {"matrix": [[0.1, -2e-7], [0.3, 4.0]]}),))
    path = tmp_path / "model.toml"
    path.write_text(dump_model(spec), encoding="utf-8")
    assert load_model(path) == spec
    path.write_text('[model]\nname="unicycle"\ndt=0.1\n[[model.effects]]\nname="position_field"\nparameters={matrix=[[0, 1], [1, 0]]}\n')
    assert compose(load_model(path)).effects[0].p["matrix"] == [[0.0, 1.0], [1.0, 0.0]]
    for matrix, said in (
        ([[0.1, 0.2]], "must be 2 rows of 2 numbers"),
        ([[1e4, 0.0], [0.0, 0.0]], "must be in [-100"),
        (0.3, "2 rows of 2"),
    ):
        with pytest.raises(ConfigError, match="matrix") as error:
            composed("unicycle", 0.1, ("position_field", "*", {"matrix": matrix}))
        assert said in str(error.value)


CART = """
import numpy as np
STATES = {states}
INPUTS = ("push",)
PARAMS = {{"mass": 2.0}}
{rates}

def step(x, u, dt, params):
    a = u[:, 0] / params["mass"]
    return np.column_stack([x[:, 0] + dt * x[:, 1] + 0.5 * dt * dt * a, x[:, 1] + dt * a])
"""


@pytest.mark.parametrize(("states", "rates"), [(("q", "qd"), ""), (("s", "v"), 'RATES = {"v": "s"}')])
def test_a_model_of_the_users_own_has_axes_where_it_names_or_tells_its_rates(tmp_path, states, rates):
    path = tmp_path / "cart.py"
    path.write_text(CART.format(states=states, rates=rates), encoding="utf-8")
    position, velocity = states
    theirs = (
        ("coulomb_friction", velocity, {"force": 0.5}),
        ("quadratic_drag", velocity, {"coefficient": 0.7}),
        ("cubic_stiffness", position, {"coefficient": 3.0}),
        ("constant_disturbance", "world", {"x": 0.2}),
        ("sensor_offset", velocity, {"offset": 0.1}),
        ("mass_change", "*", {"ratio": 1.2}),
    )
    ours = tuple((n, {position: "q", velocity: "qd"}.get(c, c), p) for n, c, p in theirs)
    rng = np.random.default_rng(7)
    x, u = rng.normal(size=(ROWS, 2)), rng.normal(size=(ROWS, 1))
    mine = compose(ModelSpec(str(path), 0.05, {"mass": 3.0}, tuple(EffectSpec(*e) for e in theirs)))
    built_in = composed("joint", 0.05, *ours, mass=3.0)
    assert np.allclose(mine.advance(x, u, u), built_in.advance(x, u, u), rtol=0.0, atol=1e-14)


def test_a_model_of_the_users_own_with_a_pose_has_the_effects_of_poses(tmp_path):
    path = tmp_path / "robot.py"
    path.write_text(
        "import numpy as np\nSTATES = ('theta', 'x', 'y', 'charge')\nINPUTS = ('ahead', 'turn')\nPARAMS = {}\nANGLES = ('theta',)\n"
        "def step(x, u, dt, params):\n"
        "    half = dt * u[:, 1] / 2\n"
        "    d, h = dt * u[:, 0] * np.sinc(half / np.pi), x[:, 0] + half\n"
        "    return np.column_stack([x[:, 0] + 2 * half, x[:, 1] + d * np.cos(h), x[:, 2] + d * np.sin(h), x[:, 3] - dt])\n",
        encoding="utf-8",
    )
    rng = np.random.default_rng(8)
    x, u = rng.uniform(-1.0, 1.0, (ROWS, 3)), rng.uniform(-2.0, 2.0, (ROWS, 2))
    full = np.column_stack([x[:, 2], x[:, 0], x[:, 1], np.ones(ROWS)])
    for effect, (spec, _) in EFFECTS.items():
        if effect in OF_CARS:
            continue
        theirs, ours = compose(ModelSpec(str(path), 0.1, {}, (EffectSpec(*spec),))), composed("unicycle", 0.1, ARC, spec)
        assert np.allclose(theirs.advance(full, u, u)[:, [1, 2, 0]], ours.advance(x, u, u), rtol=0.0, atol=1e-13), effect
        assert np.allclose(theirs.advance(full, u, u)[:, 3], 0.9)
    sensor = ("sensor_lever_arm", "*", {"x": 0.1, "y": 0.2})
    theirs, ours = compose(ModelSpec(str(path), 0.1, {}, (EffectSpec(*sensor),))), composed("unicycle", 0.1, ARC, sensor)
    assert np.allclose(theirs.advance(full, u, u)[:, [1, 2, 0]], ours.advance(x, u, u), rtol=0.0, atol=1e-13)


def test_velocities_along_an_unknown_heading_are_no_axes(tmp_path):
    path = tmp_path / "boat.py"
    path.write_text(
        "STATES = ('x', 'y', 'theta', 'vx')\nINPUTS = ('a',)\nPARAMS = {}\ndef step(x, u, dt, params):\n    return x\n", encoding="utf-8"
    )
    assert axes(compose(ModelSpec(str(path), 0.1)).nominal) == ()


def test_a_hundred_thousand_rows_take_milliseconds():
    """CPU time of this process, the best of five; the bounds are far above what one core needs."""
    rng = np.random.default_rng(9)
    x, u = rng.normal(size=(100_000, 3)), rng.normal(size=(100_000, 2))
    for spec, _ in EFFECTS.values():
        if spec[0] in {"understeer", "rear_slip"}:
            continue
        model = composed("unicycle", 0.01, ARC, spec)
        took = []
        for _ in range(5):
            begun = time.process_time()
            model.advance(x, u, u)
            took.append(time.process_time() - begun)
        assert min(took) < 0.12, spec[0]
