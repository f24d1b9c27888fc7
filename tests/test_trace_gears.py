"""What real joints lack, on a joint simulated without the library: gravity of its link, friction under load, ripple, backlash."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT, STEPS, PARTS, MASS, NOISE = 0.01, 1000, 20, 2.0, (1e-4, 1e-3)


def traced(seed, gravity=0.0, load=0.0, dry=0.0, ripple=0.0):
    """The trace of a joint in closed loop under noise of its own force, with its link hanging at 0.4 rad."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(STEPS)
    wanted = 1.5 * np.sin(1.3 * t + 0.3) + 0.9 * np.sin(3.1 * t + 1.0)
    shaken = np.repeat(rng.uniform(-1.0, 1.0, STEPS // 20), 20)
    q, v, rows, forces, h = 0.1, 0.0, [], [], DT / PARTS
    for k in range(STEPS):
        u = shaken[k] + 8.0 * (wanted[k] - q) - 2.4 * v
        rows.append((q, v))
        forces.append(u)
        for _ in range(PARTS):
            free = v + h * (u - gravity * np.sin(q - 0.4) + ripple * np.sin(2.0 * np.pi * q / 0.35 + 1.0)) / MASS
            after = np.sign(free) * max(abs(free) - h * (dry + load * abs(u)) / MASS, 0.0)
            q, v = q + 0.5 * h * (v + after), after
    rows.append((q, v))
    y = np.array(rows) + rng.normal(size=(STEPS + 1, 2)) * NOISE
    model = compose(ModelSpec("joint", DT, {"mass": MASS}))
    return trace(from_arrays(model, [(y, np.array(forces)[:, None])]), model)


TRUTHS = {
    "gravity": ({"gravity": 3.0}, {"link_gravity": {"torque": 3.0, "angle": 0.4}}),
    "load": ({"load": 0.15}, {"load_friction": {"coefficient": 0.15}}),
    "ripple": ({"ripple": 0.4}, {"torque_ripple": {"amplitude": 0.4, "period": 0.35, "phase": 1.0}}),
    "ripple and dry friction": (
        {"ripple": 0.4, "dry": 0.5},
        {"torque_ripple": {"amplitude": 0.4, "period": 0.35, "phase": 1.0}, "coulomb_friction": {"force": 0.5}},
    ),
    "gravity and dry friction": (
        {"gravity": 3.0, "dry": 0.5},
        {"link_gravity": {"torque": 3.0, "angle": 0.4}, "coulomb_friction": {"force": 0.5}},
    ),
    "load and dry friction": ({"load": 0.15, "dry": 0.4}, {"load_friction": {"coefficient": 0.15}, "coulomb_friction": {"force": 0.4}}),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if "and" in n else []) for n in TRUTHS])
def test_what_a_joint_lacks_is_found_with_its_numbers(name):
    robot, truth = TRUTHS[name]
    found = traced(2, **robot)
    assert found.verdict == "traced"
    assert {e.name for e in found.effects} == set(truth)
    for effect in found.effects:
        for parameter, true in truth[effect.name].items():
            value, low, high, _ = effect.parameters[parameter]
            assert abs(true - value) <= 1.5 * (high - low), (parameter, value, low, high)  # a 95 % interval misses one in twenty


def two_bodies(seed, backlash, share, noise, steps=1200, parts=40):
    """The trace of a link that a motor with this share of the mass drives through a backlash, in closed loop."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(steps)
    wanted = 1.5 * np.sin(1.3 * t + 0.3) + 0.9 * np.sin(3.1 * t + 1.0)
    shaken = np.repeat(rng.uniform(-1.0, 1.0, steps // 20), 20)
    motor, link, h = share * MASS, (1.0 - share) * MASS, DT / parts
    gap = v_m = v = 0.0
    q, rows, forces = 0.1, [], []
    for k in range(steps):
        u = shaken[k] + 8.0 * (wanted[k] - q) - 2.4 * v
        rows.append((q, v))
        forces.append(u)
        for _ in range(parts):
            if abs(gap) >= 0.5 * backlash and gap * u >= 0.0 and v_m == v:
                v_m = v = v + h * u / MASS
            else:
                v_m += h * u / motor
                gap += h * (v_m - v)
                if abs(gap) >= 0.5 * backlash and gap * (v_m - v) > 0.0:
                    gap = float(np.copysign(0.5 * backlash, gap))
                    v_m = v = (motor * v_m + link * v) / MASS
            q += h * v
    rows.append((q, v))
    y = np.array(rows) + rng.normal(size=(steps + 1, 2)) * noise
    model = compose(ModelSpec("joint", DT, {"mass": MASS}))
    return trace(from_arrays(model, [(y, np.array(forces)[:, None])]), model)


def test_backlash_of_a_gear_is_found_by_its_product_with_the_motor_s_share():
    found = two_bodies(1, 0.01, 0.3, (1e-3, 5e-3))
    assert found.verdict == "traced"
    (effect,) = found.effects
    value, low, high, unit = effect.parameters["width"]
    assert (effect.name, unit) == ("gear_backlash", "m")
    assert abs(value - 0.003) <= max(1.5 * (high - low), 0.05 * 0.003)
