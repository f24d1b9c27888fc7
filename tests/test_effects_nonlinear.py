"""Forces that depend on the state, alone and together, against physics in a thousand parts a step, written without the library."""

import numpy as np
import pytest
from scipy.linalg import expm

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

PARTS = 1000
ROWS = 300
MASS = 2.0

DRAG = ("quadratic_drag", "qd", {"coefficient": 4.0})
SPRING = ("cubic_stiffness", "q", {"coefficient": 30.0})
STRIBECK = ("stribeck_friction", "qd", {"force": 0.6, "static_force": 1.5, "velocity": 0.15})
VISCOUS = ("viscous_friction", "qd", {"coefficient": 10.0})


def _curve(v):
    return 0.6 + 0.9 * np.exp(-((v / 0.15) ** 2))


def _none(*_):
    return 0.0


CASES = {
    "drag": ([DRAG], lambda q, v: -4.0 * v * np.abs(v), _none),
    "spring": ([SPRING], lambda q, v: -30.0 * q**3, _none),
    "stribeck": ([STRIBECK], _none, _curve),
    "stribeck and viscous": ([VISCOUS, STRIBECK], lambda q, v: -10.0 * v, _curve),
    "all": ([SPRING, STRIBECK, VISCOUS, DRAG], lambda q, v: -30.0 * q**3 - 10.0 * v - 4.0 * v * np.abs(v), _curve),
}


def composed(name, dt, *effects, **parameters):
    return compose(ModelSpec(name, dt, parameters, tuple(EffectSpec(*e) for e in effects)))


def integrated(x, u, dt, force, dry):
    """q' = v, MASS v' = u + force(q, v) less dry(v) against the motion, which stops it and never turns it. Heun's rule in small parts."""
    q, v, h = x[:, 0].copy(), x[:, 1].copy(), dt / PARTS
    for _ in range(PARTS):
        first = (u[:, 0] + force(q, v)) / MASS
        after = v + h * (u[:, 0] + force(q + 0.5 * h * v, v + 0.5 * h * first)) / MASS
        after -= np.sign(after) * np.minimum(np.abs(after), h * dry(after) / MASS)
        q += 0.5 * h * (v + after)
        v = after
    return np.column_stack([q, v])


@pytest.mark.parametrize(("dt", "share"), [(0.001, 0.01), (0.01, 0.02), (0.033, 0.02), (0.1, 0.02)])
@pytest.mark.parametrize("case", CASES)
def test_forces_that_depend_on_the_state_are_right_to_a_small_part_of_what_they_do(case, dt, share):
    effects, force, dry = CASES[case]
    rng = np.random.default_rng(1)
    x = np.column_stack([rng.uniform(-0.7, 0.7, ROWS), 0.5 * rng.normal(size=ROWS)])
    u = 3.0 * rng.normal(size=(ROWS, 1))
    model, bare = composed("joint", dt, *effects, mass=MASS), composed("joint", dt, mass=MASS)
    x1, expected = model.step(x, u, model.at_rest(ROWS))[0], integrated(x, u, dt, force, dry)
    done = np.sqrt(np.mean((expected - bare.step(x, u, ())[0]) ** 2, axis=0))
    assert np.all(np.sqrt(np.mean((x1 - expected) ** 2, axis=0)) < share * done)


def test_friction_that_holds_at_rest_is_the_larger_one():
    model = composed("joint", 0.02, ("stribeck_friction", "qd", {"force": 0.5, "static_force": 1.0, "velocity": 0.1}), mass=1.0)
    x1, _ = model.step(np.zeros((3, 2)), np.array([[0.9], [-0.99], [1.2]]), model.at_rest(3))
    assert np.max(np.abs(x1[:2])) < 1e-18
    assert 0.02 * 0.2 < x1[2, 1] < 0.02 * 0.7  # it got away, and is braked less from then on


@pytest.mark.parametrize("coefficient", [1.0, 1e4, 1e9])
def test_a_spring_of_any_hardness_stays_within_its_bounds(coefficient):
    model = composed("joint", 0.1, ("cubic_stiffness", "q", {"coefficient": coefficient}), mass=1.0)
    x, hidden = np.array([[1.0, 0.0]]), model.at_rest(1)
    far = 0.0
    for _ in range(500):
        x, hidden = model.step(x, np.zeros((1, 1)), hidden)
        far = max(far, abs(float(x[0, 0])))
    assert far < 1.5


def test_a_spring_keeps_its_energy_over_a_thousand_steps():
    model = composed("joint", 0.05, ("cubic_stiffness", "q", {"coefficient": 8.0}), mass=2.0)
    x, hidden = np.array([[0.8, 0.0]]), model.at_rest(1)
    energy = []
    for _ in range(1000):
        x, hidden = model.step(x, np.zeros((1, 1)), hidden)
        energy.append(float(0.5 * 2.0 * x[0, 1] ** 2 + 8.0 * x[0, 0] ** 4 / 4.0))
    assert np.max(np.abs(np.array(energy) - 8.0 * 0.8**4 / 4.0)) < 1e-3 * 8.0 * 0.8**4 / 4.0


def test_softening_springs_and_fields_that_push_away_stay_finite():
    spring = composed("joint", 0.1, ("cubic_stiffness", "q", {"coefficient": -1e9}), mass=1.0)
    field = composed("double_integrator", 0.1, ("position_field", "*", {"matrix": [[100.0, 100.0], [100.0, 100.0]]}))
    for model in (spring, field):
        x, hidden = np.ones((1, len(model.states))), model.at_rest(1)
        for _ in range(50):
            x, hidden = model.step(x, np.zeros((1, len(model.inputs))), hidden)
        assert np.all(np.isfinite(x))


def test_a_field_of_accelerations_is_the_linear_system_that_it_says():
    matrix = np.array([[-3.0, 1.0], [0.5, -2.0]])
    model = composed("double_integrator", 0.1, ("position_field", "*", {"matrix": matrix.tolist()}))
    x0, u = np.array([[0.5, -0.3, 0.2, 0.4]]), np.array([[0.3, -0.6]])
    x1, _ = model.step(x0, u, model.at_rest(1))
    system = np.zeros((6, 6))  # x, y, vx, vy, ax, ay are its state, and the accelerations stay
    system[:2, 2:4], system[2:4, :2], system[2:4, 4:6] = np.eye(2), matrix, np.eye(2)
    exact = expm(0.1 * system) @ np.concatenate([x0[0], u[0]])
    bare = composed("double_integrator", 0.1).step(x0, u, ())[0][0]
    assert np.max(np.abs(x1[0] - exact[:4])) < 2e-3 * np.max(np.abs(bare - exact[:4]))


def test_a_length_of_a_step_that_is_no_number_leaves_the_other_rows_of_a_field_alone():
    p = {"matrix": np.array([[-3.0, 1.0], [0.5, -2.0]])}
    model, effect = composed("unicycle", 0.1).nominal, registry().get("effects", "position_field")
    x, x_next, u = np.array([[0.5, -0.3, 0.2]] * 2), np.array([[0.52, -0.26, 0.2]] * 2), np.zeros((2, 2))
    both, one = (effect.after_step(x, u, x_next, model, "*", np.array([0.1, dt]), p) for dt in (0.1, np.nan))
    assert np.array_equal(one[0], both[0])
    assert np.max(np.abs(both[0] - x_next[0])) > 0.1


def test_drag_on_an_input_is_what_the_input_loses():
    model = composed("unicycle", 0.1, ("quadratic_drag", "v", {"coefficient": 0.4}))
    x1, _ = model.step(np.zeros((3, 3)), np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 1.0]]), model.at_rest(3))
    assert x1[:, 0] == pytest.approx([0.1 * (0.5 - 0.1), -0.1 * (0.5 - 0.1), 0.0])
    assert x1[2, 2] == pytest.approx(0.1)


def test_drag_stands_before_or_behind_what_acts_on_the_same_input():
    gain, drag, u = ("input_gain", "v", {"gain": 2.0}), ("quadratic_drag", "v", {"coefficient": 0.4}), np.array([[0.5, 0.0]])
    for effects, speed in (((gain, drag), 1.0 - 0.4), ((drag, gain), 2.0 * (0.5 - 0.1))):
        model = composed("unicycle", 0.1, *effects)
        assert model.step(np.zeros((1, 3)), u, model.at_rest(1))[0][0, 0] == pytest.approx(0.1 * speed)


def test_forces_act_behind_every_effect_on_inputs_wherever_they_are_listed():
    lag = ("input_lag", "force", {"time_constant": 0.2})
    x, u = np.array([[0.0, 0.4]]), np.array([[3.0]])
    results = []
    for effects in ((DRAG, STRIBECK, lag), (lag, STRIBECK, DRAG), (STRIBECK, lag, DRAG)):
        model = composed("joint", 0.05, *effects)
        hidden = model.at_rest(1)
        y = x
        for _ in range(5):
            y, hidden = model.step(y, u, hidden)
        results.append(y)
    assert np.allclose(results[0], results[1], rtol=0.0, atol=1e-14)
    assert np.allclose(results[0], results[2], rtol=0.0, atol=1e-14)


def test_a_heavier_joint_is_pushed_less_whatever_else_acts_on_it():
    for effect in (("mass_change", "*", {"mass": 3.0}), ("mass_change", "*", {"ratio": 1.5})):
        for effects in ((effect, STRIBECK), (STRIBECK, effect)):
            heavy = composed("joint", 0.05, *effects, mass=2.0)
            weak = composed("joint", 0.05, ("input_gain", "force", {"gain": 2.0 / 3.0}), STRIBECK, mass=2.0)
            x, u = np.array([[0.0, 0.1], [0.0, 0.0]]), np.array([[2.0], [2.2]])
            assert np.allclose(heavy.step(x, u, heavy.at_rest(2))[0], weak.step(x, u, weak.at_rest(2))[0], rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("speed", ["ground_speed", "v_cmd", "ref_w", "Velocity"])
def test_drag_is_looked_for_on_inputs_that_say_that_they_are_speeds(tmp_path, speed):
    """Nothing drags at a steering angle."""
    path = tmp_path / "own.py"
    path.write_text(
        f'STATES = ("x", "r")\nINPUTS = ("steer", "{speed}")\nPARAMS = {{}}\n\n\ndef step(x, u, dt, params):\n    return x + dt * u\n',
        "utf-8",
    )
    model = compose(ModelSpec(str(path), 0.1)).nominal
    drag, u = registry().get("effects", "quadratic_drag"), np.ones((5, 2))
    assert drag.starts(u, model, speed, 0.1)
    assert not drag.starts(u, model, "steer", 0.1)
    assert {"steer", speed} <= {*drag.channels(model)}, "who knows better may say so"
