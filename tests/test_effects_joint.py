"""Gravity of a link, load-dependent and static friction, against small steps in time written without the library."""

import numpy as np
import pytest

from s2r_runtime.effects.classes import same, several
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

ROWS, PARTS, MASS = 60, 4000, 2.5
FILE = """
import numpy as np
STATES, INPUTS, RATES, PARAMS = ("{q}", "v"), ("force",), {{"v": "{q}"}}, {{"mass": 2.5}}
UNITS = {units}

def step(x, u, dt, params):
    a = u[:, 0] / params["mass"]
    return np.column_stack([x[:, 0] + dt * x[:, 1] + 0.5 * dt * dt * a, x[:, 1] + dt * a])
"""


def joint(dt, *effects):
    return compose(ModelSpec("joint", dt, {"mass": MASS}, tuple(EffectSpec(*e) for e in effects)))


def in_small_steps(x, u, dt, force, dry):
    """(n, 2): forces force(q, v) act, and dry friction of at most dry(q, v) N holds or brakes."""
    q, v, h = x[:, 0].copy(), x[:, 1].copy(), dt / PARTS
    for _ in range(PARTS):
        free = v + h * (u[:, 0] + force(q, v)) / MASS
        after = np.sign(free) * np.maximum(np.abs(free) - h * dry(q, v) / MASS, 0.0)
        q += 0.5 * h * (v + after)
        v = after
    return np.column_stack([q, v])


def anywhere(seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-2.0, 2.0, (ROWS, 2)), rng.uniform(-4.0, 4.0, (ROWS, 1))
    x[:6, 1] = 0.0
    return x, u


@pytest.mark.parametrize("dt", [0.005, 0.1])
def test_gravity_pulls_a_link_to_where_it_hangs(dt):
    x, u = anywhere()
    want = in_small_steps(x, u, dt, lambda q, v: -1.7 * np.sin(q - 0.4), lambda q, v: 0.0)
    done = joint(dt, ("link_gravity", "q", {"torque": 1.7, "angle": 0.4})).advance(x, u, u)
    share = 2e-3 if dt > 0.05 else 1e-5  # the library takes a step in parts of 12.5 ms
    assert np.max(np.abs(done - want)) < share * np.max(np.abs(want - joint(dt).advance(x, u, u)))


@pytest.mark.parametrize("dt", [0.005, 0.1])
def test_ripple_repeats_with_the_position(dt):
    x, u = anywhere(3)
    want = in_small_steps(x, u, dt, lambda q, v: 0.6 * np.sin(2.0 * np.pi * q / 0.9 + 1.0), lambda q, v: 0.0)
    done = joint(dt, ("torque_ripple", "q", {"amplitude": 0.6, "period": 0.9, "phase": 1.0})).advance(x, u, u)
    share = 0.02 if dt > 0.05 else 2e-4  # the library takes a step in parts of 12.5 ms
    assert np.max(np.abs(done - want)) < share * np.max(np.abs(want - joint(dt).advance(x, u, u)))


def test_at_a_steady_speed_ripple_is_a_sine_in_time():
    """Of frequency v/period: the periodic_disturbance that a recording at one speed shows."""
    speed, period, dt = 0.5, 0.25, 0.01
    ripple = joint(dt, ("torque_ripple", "q", {"amplitude": 1e-3, "period": period, "phase": 0.3}))
    sine = joint(dt, ("periodic_disturbance", "force", {"frequency": speed / period, "amplitude": 1e-3, "phase": 0.3}))
    x, hidden = np.array([[0.0, speed]]), sine.at_rest(1)
    other, u = x, np.zeros((1, 1))
    for _ in range(205):
        x, (other, hidden) = ripple.advance(x, u, u), sine.step(other, u, hidden)
    assert np.allclose(x, other, rtol=0.0, atol=2e-7)
    assert abs(x[0, 1] - speed) > 5e-6


def test_ripple_s_period_is_found_over_positions_that_come_in_any_order():
    effect, rng = registry().get("effects", "torque_ripple"), np.random.default_rng(5)
    q = rng.uniform(-2.0, 3.0, 800)
    x = np.column_stack([q, 0.5 * np.cos(q)])
    pushes = np.tile([0.5 * 0.01**2 / MASS, 0.01 / MASS], (800, 1))
    residual = pushes * (0.4 * np.sin(2.0 * np.pi * q / 0.35 + 1.0))[:, None] + rng.normal(size=(800, 2)) * [1e-7, 5e-4]
    best = effect.starts_from_states(x, residual, pushes, joint(0.01).nominal, "q", 0.01)[0]
    assert best["period"] == pytest.approx(0.35, rel=5e-3)
    assert best["amplitude"] == pytest.approx(0.4, rel=0.1)
    assert best["phase"] == pytest.approx(1.0, abs=0.2)
    for rows in (0, 1, 3):
        assert effect.starts_from_states(x[:rows], residual[:rows], pushes[:rows], joint(0.01).nominal, "q", 0.01) == []
    still = np.zeros((50, 2))
    assert effect.starts_from_states(still, residual[:50], pushes[:50], joint(0.01).nominal, "q", 0.01) == []


def two_bodies(forces, dt, backlash, share, parts=2000):
    """(T + 1, 2) position and speed of a link that a motor with this share of MASS drives through a backlash, inelastic contact."""
    motor, link, h = share * MASS, (1.0 - share) * MASS, dt / parts
    gap = v_m = q = v = 0.0
    rows = [(q, v)]
    for force in forces:
        for _ in range(parts):
            if abs(gap) >= 0.5 * backlash and gap * force >= 0.0 and v_m == v:
                v_m = v = v + h * force / MASS
            else:
                v_m += h * force / motor
                gap += h * (v_m - v)
                if abs(gap) >= 0.5 * backlash and gap * (v_m - v) > 0.0:
                    gap = np.copysign(0.5 * backlash, gap)
                    v_m = v = (motor * v_m + link * v) / MASS
            q += h * v
        rows.append((q, v))
    return np.array(rows)


@pytest.mark.parametrize(("backlash", "share"), [(0.02, 0.4), (0.08, 0.1), (0.3, 0.5)])
def test_a_gear_with_backlash_moves_its_link_as_two_bodies_do(backlash, share):
    """Only the product of backlash and share shows. Speeds agree but for when a contact comes, within one small step."""
    rng = np.random.default_rng(6)
    forces, dt, parts = np.repeat(rng.uniform(-4.0, 4.0, 25), 3), 0.02, 2000
    model = joint(dt, ("gear_backlash", "force", {"width": backlash * share}))
    want = two_bodies(forces, dt, backlash, share, parts)
    x, hidden, speeds = np.zeros((1, 2)), model.at_rest(1), []
    for force in forces:
        x, hidden = model.step(x, np.array([[force]]), hidden)
        speeds.append(x[0, 1])
    bare, x0 = [0.0], 0.0
    for force in forces:
        x0 += dt * force / MASS
        bare.append(x0)
    assert np.allclose(speeds, want[1:, 1], rtol=0.0, atol=20 * 4.0 / MASS * dt / parts)
    assert np.max(np.abs(want[:, 1] - bare)) > 0.01


def test_all_of_the_momentum_arrives_when_the_motor_does():
    """A constant force: the link rests until the motor is there, and then has the speed that it has without backlash."""
    dt, force, width = 0.01, 3.0, 0.01
    model = joint(dt, ("gear_backlash", "force", {"width": width}))
    arrives = np.sqrt(width * MASS / force)  # half of the width, from its middle
    x, hidden = np.zeros((1, 2)), model.at_rest(1)
    for k in range(1, 21):
        x, hidden = model.step(x, np.array([[force]]), hidden)
        assert x[0, 1] == pytest.approx(force * dt * k / MASS if dt * k > arrives else 0.0, abs=1e-12)


@pytest.mark.parametrize("many", [1, 7])
def test_backlash_is_the_same_row_by_row_for_many_at_once(many):
    effect, nominal = registry().get("effects", "gear_backlash"), joint(0.01).nominal
    rng = np.random.default_rng(7)
    u = np.repeat(rng.uniform(-3.0, 3.0, (20, many, 1)), 5, axis=0)
    p = {"width": 0.013}
    at_once = effect.input_sequence(u, nominal, "force", 0.01, p)
    z = effect.hidden(many, nominal, "force", 0.01, p)
    for row, expected in zip(u, at_once, strict=True):
        acting, z = effect.input_step(row, z, nominal, "force", 0.01, p)
        assert np.allclose(acting, expected, rtol=1e-9, atol=1e-12)
    assert np.any(at_once != u)


def test_a_link_rests_where_it_hangs_and_where_it_stands():
    model = joint(0.01, ("link_gravity", "q", {"torque": 1.7, "angle": 0.4}))
    x = np.array([[0.4, 0.0], [0.4 + np.pi, 0.0]])
    assert np.allclose(model.advance(x, np.zeros((2, 1)), np.zeros((2, 1))), x, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("dt", [0.005, 0.1])
@pytest.mark.parametrize("base", [0.0, 0.8])
def test_friction_grows_with_the_force_that_is_transmitted(dt, base):
    x, u = anywhere(1)
    want = in_small_steps(x, u, dt, lambda q, v: 0.0, lambda q, v: 0.3 * np.abs(u[:, 0]) + base)
    effects = [("load_friction", "qd", {"coefficient": 0.3})] + ([("coulomb_friction", "qd", {"force": base})] if base else [])
    assert np.allclose(joint(dt, *effects).advance(x, u, u), want, rtol=0.0, atol=2e-3 * dt)


def test_a_gear_that_takes_all_of_the_force_holds_against_any():
    model = joint(0.01, ("load_friction", "qd", {"coefficient": 1.0}))
    x, u = np.zeros((3, 2)), np.array([[-50.0], [0.0], [900.0]])
    assert np.array_equal(model.advance(x, u, u), x)


def test_a_force_that_always_drives_the_motion_makes_load_friction_a_gain():
    x, u = anywhere(2)
    x[:, 1] = np.sign(u[:, 0]) * np.abs(x[:, 1])
    gear, gain = joint(0.01, ("load_friction", "qd", {"coefficient": 0.2})), joint(0.01, ("input_gain", "force", {"gain": 0.8}))
    first, second = (model.step(x, u, model.at_rest(ROWS))[0] for model in (gear, gain))
    assert np.allclose(first, second, rtol=0.0, atol=1e-12)


def test_a_force_of_one_size_makes_load_friction_a_dry_one():
    x, u = anywhere(2)
    u = 3.0 * np.sign(u)
    gear, dry = joint(0.01, ("load_friction", "qd", {"coefficient": 0.2})), joint(0.01, ("coulomb_friction", "qd", {"force": 0.6}))
    assert np.allclose(gear.advance(x, u, u), dry.advance(x, u, u), rtol=0.0, atol=1e-12)


def test_static_friction_holds_and_fades_with_speed():
    model = joint(0.01, ("static_friction", "qd", {"force": 1.0, "velocity": 0.2}))
    x = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.2], [0.0, 4.0]])
    u = np.array([[0.99], [-1.5], [0.0], [0.0]])
    after = model.advance(x, u, u)
    assert np.allclose(after[0], x[0], rtol=0.0, atol=1e-15)
    assert after[1, 1] < -0.01 * 0.5 / MASS * 0.9  # it breaks away with what is beyond
    assert after[2, 1] == pytest.approx(0.2 - 0.01 * np.exp(-1.0) / MASS, rel=1e-3)
    assert after[3, 1] == pytest.approx(4.0, abs=1e-12)


def test_stribeck_s_curve_is_dry_friction_with_static_friction():
    bare = joint(0.01).for_effects
    assert same(bare, "static_friction", "qd", {"force": 0.3, "velocity": 0.1})[0] == (
        "stribeck_friction",
        "qd",
        {"force": 0.0, "static_force": 0.3, "velocity": 0.1},
    )
    (parts,) = several(bare, "stribeck_friction", "qd", {"force": 0.2, "static_force": 0.5, "velocity": 0.1})
    assert parts == [("coulomb_friction", "qd", {"force": 0.2}), ("static_friction", "qd", {"force": 0.3, "velocity": 0.1})]


@pytest.mark.parametrize(
    ("q", "units", "gravity", "loaded"),
    [("q", {}, ("q",), ("v",)), ("q", {"q": "m"}, (), ("v",)), ("s", {"s": "m"}, (), ("v",)), ("a", {"a": "rad"}, ("a",), ())],
)
def test_only_what_may_turn_has_weight_and_only_what_a_force_moves_has_a_load(tmp_path, q, units, gravity, loaded):
    """On a rotary axis a force over the mass is no torque over an inertia."""
    path = tmp_path / "mine.py"
    path.write_text(FILE.format(q=q, units=units))
    nominal = compose(ModelSpec(str(path), 0.01)).nominal
    assert registry().get("effects", "link_gravity").channels(nominal) == gravity
    assert registry().get("effects", "load_friction").channels(nominal) == loaded
    pushed = registry().get("models", "double_integrator")
    assert registry().get("effects", "link_gravity").channels(pushed) == ()
    assert registry().get("effects", "load_friction").channels(pushed) == ("vx", "vy")
