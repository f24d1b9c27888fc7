"""Effects on motion and sensors where models are used: rollouts of the uncertain model, linearisation, residuals, the tracer."""

import numpy as np
import pytest

from s2r_runtime.evidence.uncertain import GapSet, roll_out
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.tasks.keep_out import KeepOut
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.prediction import acting, residual, state_jacobian, steps_of
from s2r_runtime.trace.pipeline import trace

ARC = ("integration_scheme", "*", {"scheme": "exact"})
DT = 0.05


def composed(name, *effects, dt=DT, **parameters):
    return compose(ModelSpec(name, dt, parameters, tuple(EffectSpec(*e) for e in effects)))


def driven(name, u, dt, noise, seed, parts=50, **how):
    """Measured states (T + 1, nx) of a robot that these tests step through small parts themselves."""
    rng = np.random.default_rng(seed)
    x = np.zeros(2 if name == "joint" else 3)
    rows, h = [x.copy()], dt / parts
    for row in u:
        for _ in range(parts):
            if name == "joint":
                middle = x[1] + 0.5 * h * (row[0] - how["viscous"] * x[1]) / how["mass"]
                v = x[1] + h * (row[0] - how["viscous"] * middle) / how["mass"]
                v -= np.sign(v) * min(abs(v), h * how["dry"] / how["mass"])
                x[:] = x[0] + 0.5 * h * (x[1] + v), v
            else:
                middle = x[2] + 0.5 * h * row[1]
                x += h * np.array([row[0] * np.cos(middle), row[0] * np.sin(middle), row[1]])
                x[:2] += h * np.array(how.get("wind", (0.0, 0.0)))
        rows.append(x.copy())
    y = np.array(rows)
    if "arm" in how:
        c, s, (a, b) = np.cos(y[:, 2]), np.sin(y[:, 2]), how["arm"]
        y[:, 0], y[:, 1] = y[:, 0] + a * c - b * s, y[:, 1] + a * s + b * c
    return y + rng.normal(size=y.shape) * noise


def held(seed, steps, bounds):
    """(steps, nu): values held for a quarter of a second to a second."""
    rng = np.random.default_rng(seed)
    u = np.zeros((steps, len(bounds)))
    k = 0
    while k < steps:
        length = int(rng.uniform(0.25, 1.0) / DT)
        u[k : k + length] = [rng.uniform(-b, b) for b in bounds]
        k += length
    return u


def test_rollouts_drive_the_true_robot_and_show_the_measured_one():
    effects = (("longitudinal_slip", "*", {"ratio": 0.2}), ("constant_disturbance", "world", {"x": 0.02, "y": -0.03}), ARC)
    sensors = (("sensor_lever_arm", "*", {"x": 0.1, "y": 0.05}), ("heading_offset", "theta", {"angle": 0.3}))
    model, true = composed("unicycle", *effects, *sensors), composed("unicycle", *effects)
    seen = []

    def control(x, theta):
        seen.append(x[0].copy())
        return np.tile([0.1, 0.8], (len(x), 1))

    task = KeepOut({"steps": 40}, model.nominal, model.dt)
    done = roll_out(control, task, model, GapSet("ball", (1.0, 1.0, 1.0), 0.0), "uniform", np.random.default_rng(1), 3, keep=1)
    path = done.paths[0]
    assert np.allclose(path[: len(seen)], seen[: len(path)], rtol=0.0, atol=1e-14)

    def off(y, sign):
        heading = y[:, 2] - (0.3 if sign < 0.0 else 0.0)
        c, s = np.cos(heading), np.sin(heading)
        arm = np.column_stack([0.1 * c - 0.05 * s, 0.1 * s + 0.05 * c, np.full(len(y), 0.3)])
        return y + sign * arm

    x, hidden = off(path[:1], -1.0), true.at_rest(1)
    for row in path[1:]:
        x, hidden = true.step(x, np.array([[0.1, 0.8]]), hidden)
        gap = model.difference(off(x, 1.0), row[None, :])
        assert np.max(np.abs(gap)) < 1e-12


def test_friction_is_linearised_as_it_is():
    """df/dx of v' = a - c v - f sign(v) away from rest, and where it is held."""
    model = composed("joint", ("viscous_friction", "qd", {"coefficient": 3.0}), ("coulomb_friction", "qd", {"force": 0.5}), mass=1.0)
    y = np.array([[0.0, 1.0], [0.1, -0.7], [0.3, 0.001], [0.0, 0.4]])
    data = from_arrays(model, [(y, np.zeros((3, 1)))])
    steps = steps_of(data)
    f = state_jacobian(model, steps, acting(model, data))
    keep = np.exp(-3.0 * DT)
    assert f[:2] == pytest.approx(np.array([[[1.0, (1.0 - keep) / 3.0], [0.0, keep]]] * 2), abs=1e-8)
    assert f[2, 1] == pytest.approx([0.0, 0.0], abs=1e-9)  # stopped within the step: whatever it was, it is over


def test_predictions_have_derivatives_in_every_number_of_a_force_that_depends_on_the_state():
    """No jumps where a scheme would change its number of parts: two steps of differencing agree."""
    rng = np.random.default_rng(3)
    x, u = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    for name, channel, p in (
        ("stribeck_friction", "qd", {"force": 0.3, "static_force": 0.7, "velocity": 0.2}),
        ("quadratic_drag", "qd", {"coefficient": 0.5}),
        ("cubic_stiffness", "q", {"coefficient": 2.0}),
    ):
        for key in p:

            def slope(h, name=name, channel=channel, p=p, key=key):
                ends = [composed("joint", (name, channel, {**p, key: p[key] + s * h})).advance(x, u, u) for s in (1.0, -1.0)]
                return (ends[0] - ends[1]) / (2.0 * h)

            coarse, fine = slope(1e-4 * p[key]), slope(1e-6 * p[key])
            apart = np.abs(coarse - fine) > 1e-5 * np.max(np.abs(coarse))
            assert np.mean(apart) < 0.02, (name, key)  # a row that just comes to rest has a kink


def test_a_model_leaves_nothing_of_what_it_made():
    effects = (("track_scale", "theta", {"gain": 0.7}), ("position_field", "*", {"matrix": [[0.1, 0.0], [0.2, -0.1]]}), ARC)
    model = composed("unicycle", ("input_lag", "w", {"time_constant": 0.2}), *effects, ("heading_offset", "theta", {"angle": 0.3}))
    u = held(4, 200, (0.5, 2.0))
    x, hidden, rows = np.array([[0.1, 0.2, 0.3]]), model.at_rest(1), []
    for row in u:
        rows.append(x[0])
        x, hidden = model.step(x, row[None, :], hidden)
    data = from_arrays(model, [(np.array([*rows, x[0]]), u)])
    assert np.max(np.abs(residual(model, steps_of(data), acting(model, data)))) < 1e-10


@pytest.mark.slow
def test_the_tracer_names_friction_on_a_joint_and_measures_it():
    u = held(5, 900, (8.0,))
    y = driven("joint", u, DT, [0.0005, 0.005], 6, mass=2.0, viscous=3.0, dry=1.5)
    model = composed("joint", mass=2.0)
    found = trace(from_arrays(model, [(y, u)]), model)
    assert found.verdict == "traced"
    assert {(e.name, e.channel) for e in found.effects} == {("viscous_friction", "qd"), ("coulomb_friction", "qd")}
    values = {e.name: e.parameters for e in found.effects}
    # twice the interval: 5 % of seeds are outside of one
    for name, key, true in (("viscous_friction", "coefficient", 3.0), ("coulomb_friction", "force", 1.5)):
        value, low, high, unit = values[name][key]
        assert abs(value - true) < 2.0 * max(high - value, value - low)
        assert unit == {"coefficient": "N s/m", "force": "N"}[key]


@pytest.mark.slow
def test_the_tracer_tells_wind_from_a_lever_arm():
    u = held(7, 700, (0.5, 2.0))
    model = composed("unicycle", ARC)
    noise = [0.002, 0.002, 0.004]
    for how, name, channel, true in (
        ({"wind": (0.05, -0.03)}, "constant_disturbance", "world", {"x": 0.05, "y": -0.03}),
        ({"arm": (0.1, -0.06)}, "sensor_lever_arm", "*", {"x": 0.1, "y": -0.06}),
    ):
        found = trace(from_arrays(model, [(driven("unicycle", u, DT, noise, 8, **how), u)]), model)
        assert (found.verdict, [(e.name, e.channel) for e in found.effects]) == ("traced", [(name, channel)])
        for key, value in true.items():
            assert found.effects[0].parameters[key][0] == pytest.approx(value, abs=0.01)
