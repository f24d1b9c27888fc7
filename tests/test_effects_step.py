"""Effects on the step against physics in a thousand parts a step, written without the library."""

import numpy as np
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec, dump_model, load_model
from s2r_runtime.plugins import registry

PARTS = 1000
ROWS = 300
MASS = 2.0


def composed(name, dt, *effects, **parameters):
    return compose(ModelSpec(name, dt, parameters, tuple(EffectSpec(*e) for e in effects)))


def moving(rng, n=ROWS, speed=0.4):
    """Joint: (n, 2) states, many of them slow, and (n, 1) forces, some of them too small to start anything."""
    x = np.column_stack([rng.uniform(-1.0, 1.0, n), speed * rng.normal(size=n)])
    x[::7, 1] = 0.0
    return x, 3.0 * rng.normal(size=(n, 1))


def integrated(x, u, dt, force, dry):
    """q' = v, MASS v' = u + force(q, v) less dry(v) against the motion, which stops it and never turns it. Heun's rule in small parts."""
    q, v, h = x[:, 0].copy(), x[:, 1].copy(), dt / PARTS
    for _ in range(PARTS):
        first = (u[:, 0] + force(q, v)) / MASS
        middle = v + 0.5 * h * first
        after = v + h * (u[:, 0] + force(q + 0.5 * h * v, middle)) / MASS
        least = h * dry(after) / MASS
        after -= np.sign(after) * np.minimum(np.abs(after), least)
        q += 0.5 * h * (v + after)
        v = after
    return np.column_stack([q, v])


def nothing(*_):
    return 0.0


FRICTIONS = {
    "viscous": ([("viscous_friction", "qd", {"coefficient": 10.0})], lambda q, v: -10.0 * v, nothing),
    "viscous by direction": (
        [("viscous_friction", "qd", {"coefficient_positive": 10.0, "coefficient_negative": 3.0})],
        lambda q, v: -np.where(v > 0.0, 10.0, 3.0) * v,
        nothing,
    ),
    "coulomb": ([("coulomb_friction", "qd", {"force": 1.5})], nothing, lambda v: 1.5),
    "coulomb by direction": (
        [("coulomb_friction", "qd", {"force_positive": 1.5, "force_negative": 0.6})],
        nothing,
        lambda v: np.where(v > 0.0, 1.5, 0.6),
    ),
    "both": (
        [("coulomb_friction", "qd", {"force": 1.5}), ("viscous_friction", "qd", {"coefficient": 10.0})],
        lambda q, v: -10.0 * v,
        lambda v: 1.5,
    ),
    "both and a push": (
        [
            ("viscous_friction", "qd", {"coefficient": 10.0}),
            ("coulomb_friction", "qd", {"force": 1.5}),
            ("constant_disturbance", "world", {"x": -0.9}),
        ],
        lambda q, v: -10.0 * v - 0.9,
        lambda v: 1.5,
    ),
}


@pytest.mark.parametrize("dt", [0.001, 0.02, 0.1])
@pytest.mark.parametrize("case", FRICTIONS)
def test_friction_on_a_joint_agrees_with_a_thousand_parts_a_step_however_many_act_together(case, dt):
    effects, force, dry = FRICTIONS[case]
    x, u = moving(np.random.default_rng(1))
    model = composed("joint", dt, *effects, mass=MASS)
    x1, _ = model.step(x, u, model.at_rest(ROWS))
    expected = integrated(x, u, dt, force, dry)
    plain = composed("joint", dt, mass=MASS).step(x, u, ())[0]
    size = np.max(np.abs(plain - expected), axis=0)
    # a part that stops is stopped at its end: a thousandth of a step of a change that lasts a step at most
    assert np.all(np.max(np.abs(x1 - expected), axis=0) <= 3e-3 * size)
    assert np.all(size > 0.0)


def test_dry_friction_stops_a_motion_holds_it_and_lets_go_of_it():
    model = composed("joint", 0.1, ("coulomb_friction", "qd", {"force": 1.0}), mass=1.0)
    x = np.array([[0.0, 0.05], [0.0, 0.0], [0.0, 0.0], [0.0, 0.05]])
    u = np.array([[0.0], [0.99], [1.5], [-3.0]])
    x1, _ = model.step(x, u, model.at_rest(4))
    assert x1[0] == pytest.approx([0.05**2 / 2.0, 0.0], abs=1e-15)  # v²/(2 a)
    assert x1[1] == pytest.approx([0.0, 0.0], abs=1e-15)
    assert x1[2] == pytest.approx([0.5 * 0.5 * 0.01, 0.05], abs=1e-15)
    stopped = 0.05 / 4.0  # s, against 3 N and 1 N; then 3 N against 1 N
    assert x1[3] == pytest.approx([0.05 * stopped / 2.0 - (0.1 - stopped) ** 2, -2.0 * (0.1 - stopped)], abs=1e-15)


@pytest.mark.parametrize("coefficient", [0.0, 1e-12, 1e-6, 1e-3, 1.0])
def test_slow_and_vanishing_losses_are_exact_to_the_last_digits(coefficient):
    model = composed("joint", 0.05, ("viscous_friction", "qd", {"coefficient": coefficient}), mass=1.0)
    x1, _ = model.step(np.array([[0.2, 0.7]]), np.array([[0.3]]), model.at_rest(1))
    c, t = np.longdouble(coefficient), np.longdouble(0.05)
    terms = [np.longdouble(1.0)]
    for k in range(1, 12):
        terms.append(terms[-1] * (-c * t) / (k + 1))
    first = sum(terms)
    second = sum(term / (k + 2) for k, term in enumerate(terms))
    a, v0 = np.longdouble(0.3), np.longdouble(0.7)
    v = v0 + (a - c * v0) * t * first
    q = np.longdouble(0.2) + v0 * t + (a - c * v0) * t * t * second
    assert x1[0] == pytest.approx([float(q), float(v)], rel=1e-15, abs=1e-16)


def test_friction_on_the_double_integrator_is_per_unit_mass_and_leaves_the_other_axis_alone():
    model = composed("double_integrator", 0.1, ("coulomb_friction", "vy", {"force": 0.5}), ("viscous_friction", "vy", {"coefficient": 2.0}))
    one = composed("joint", 0.1, ("coulomb_friction", "qd", {"force": 0.5}), ("viscous_friction", "qd", {"coefficient": 2.0}), mass=1.0)
    x, u = moving(np.random.default_rng(2))
    both = np.column_stack([np.ones(ROWS), x[:, 0], np.full(ROWS, -0.3), x[:, 1]])
    x1, _ = model.step(both, np.column_stack([np.full(ROWS, 0.2), u]), model.at_rest(ROWS))
    assert np.allclose(x1[:, [1, 3]], one.step(x, u, one.at_rest(ROWS))[0], rtol=0.0, atol=1e-14)
    assert x1[0, [0, 2]] == pytest.approx([1.0 - 0.03 + 0.001, -0.28])


def test_a_car_loses_the_speed_that_it_was_set_to():
    model = composed("bicycle", 0.1, ("viscous_friction", "speed", {"coefficient": 3.0}))
    x1, _ = model.step(np.array([[0.0, 0.0, 0.0, 5.0]]), np.array([[0.2, 1.5]]), model.at_rest(1))
    t = np.linspace(0.0, 0.1, 20001)
    way = np.trapezoid(1.5 * np.exp(-3.0 * t), t)
    assert x1[0] == pytest.approx([way, 0.0, way * np.tan(0.2) / 0.33, 1.5 * np.exp(-0.3)], rel=1e-9, abs=1e-12)


def test_what_pushes_along_the_body_follows_the_heading_that_holds_during_the_step():
    x, u = np.array([[0.0, 0.0, 0.7]]), np.array([[0.5, 3.0]])
    push = ("constant_disturbance", "body", {"x": 0.1, "y": -0.2})
    for effects, heading in (
        ((push,), np.full(10001, 0.7)),
        (((("integration_scheme", "*", {"scheme": "exact"})), push), 0.7 + 3.0 * np.linspace(0.0, 0.1, 10001)),
        ((push, ("integration_scheme", "*", {"scheme": "exact"})), 0.7 + 3.0 * np.linspace(0.0, 0.1, 10001)),
    ):
        model = composed("unicycle", 0.1, *effects)
        x1, _ = model.step(x, u, model.at_rest(1))
        c, s = np.trapezoid(np.cos(heading)) / 10000, np.trapezoid(np.sin(heading)) / 10000
        assert x1[0] == pytest.approx([0.1 * (0.6 * c + 0.2 * s), 0.1 * (0.6 * s - 0.2 * c), 1.0], abs=1e-8)


def test_wind_pushes_along_the_worlds_axes_wherever_it_stands_in_the_list():
    x, u = np.array([[0.0, 0.0, 0.7]]), np.array([[0.5, 3.0]])
    wind, arc = ("constant_disturbance", "world", {"x": 0.1, "y": -0.2}), ("integration_scheme", "*", {"scheme": "exact"})
    without = composed("unicycle", 0.1, arc)
    for effects in ((wind, arc), (arc, wind)):
        model = composed("unicycle", 0.1, *effects)
        change = model.step(x, u, model.at_rest(1))[0] - without.step(x, u, without.at_rest(1))[0]
        assert change[0] == pytest.approx([0.01, -0.02, 0.0], abs=1e-15)


def test_forces_are_divided_by_the_mass_that_is_used_not_by_the_default():
    push = ("constant_disturbance", "world", {"x": 3.0})
    for mass in (1.0, 4.0):
        model = composed("joint", 0.1, push, mass=mass)
        assert model.step(np.zeros((1, 2)), np.zeros((1, 1)), model.at_rest(1))[0][0] == pytest.approx([0.005 * 3.0 / mass, 0.3 / mass])
    assert registry().get("models", "joint").parameters == {"mass": 1.0}


@pytest.mark.parametrize(
    ("model", "effect", "said"),
    [
        ("joint", ("constant_disturbance", "world", {"x": 1.0, "y": 1.0}), "has no parameter 'y'; it has: x"),
        ("unicycle", ("constant_disturbance", "world", {"x": 1.0}), "lacks the parameter y"),
        ("joint", ("constant_disturbance", "body", {"x": 1.0}), "channel is 'body', must be one of: world"),
        ("joint", ("viscous_friction", "qd", {}), "must have either coefficient or both coefficient_positive and coefficient_negative"),
        ("joint", ("coulomb_friction", "qd", {"force": 1.0, "force_positive": 1.0}), "must have either force or both"),
        ("joint", ("coulomb_friction", "qd", {"force": -1.0}), "must be in [0.0"),
        ("joint", ("coulomb_friction", "qd", {"force": [[1.0, 0.0], [0.0, 1.0]]}), "must be a number"),
        ("unicycle", ("viscous_friction", "v", {"coefficient": 1.0}), "(viscous_friction): acts on nothing that the model unicycle has"),
        ("joint", ("viscos_friction", "qd", {}), "model.effects[0].name: unknown effect 'viscos_friction'; did you mean"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(model, effect, said):
    with pytest.raises(ConfigError) as error:
        composed(model, 0.1, effect)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('[model]\nname = "joint"\ndt = 0.01\n[[effects]]\nname = "input_gain"\n', "effects"),
        ('[model]\nname = "joint"\ndt = 0.01\n[parameters]\nmass = 2.0\n', "parameters"),
        ('fitted_on = ["sha256:0"]\n[model]\nname = "joint"\ndt = 0.01\n', "fitted_on"),
    ],
)
def test_a_model_file_never_loses_what_stands_beside_its_table(tmp_path, text, name):
    path = tmp_path / "model.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_model(path)
    assert str(error.value) == f"{path}: has {name} beside [model], where nothing reads it; it must be in that table"


def test_a_model_with_such_effects_survives_its_file(tmp_path):
    spec = ModelSpec(
        "joint",
        0.01,
        {"mass": 95.1},
        (
            EffectSpec("viscous_friction", "qd", {"coefficient_positive": 166.7, "coefficient_negative": 240.4}),
            EffectSpec("coulomb_friction", "qd", {"force": 20.4}),
        ),
    )
    path = tmp_path / "model.toml"
    path.write_text(dump_model(spec), encoding="utf-8")
    assert load_model(path) == spec
    assert compose(load_model(path)).effects[0].p["coefficient_negative"] == 240.4
