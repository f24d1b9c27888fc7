"""Steering ratio and offset of a car: which inputs steer, what they do, and that a trace lists them with the gain and the bias."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT = 0.05
ARC = ("integration_scheme", "*", {"scheme": "exact"})
FILE = "STATES, INPUTS, PARAMS, UNITS = ('a',), ({inputs},), {{}}, {units}\ndef step(x, u, dt, params):\n    return x + dt * u[:, :1]\n"


def car(*effects):
    return compose(ModelSpec("bicycle", DT, GEOMETRY["bicycle"], tuple(EffectSpec(*e) for e in (*effects, ARC))))


@pytest.mark.parametrize(
    ("inputs", "units", "steer"),
    [
        ("'steering', 'v'", {}, ("steering",)),
        ("'front_steer', 'v'", {"front_steer": "rad"}, ("front_steer",)),
        ("'delta', 'v'", {}, ("delta",)),
        ("'steering', 'v'", {"steering": "V"}, ()),
        ("'v', 'w'", {}, ()),
    ],
)
def test_an_input_steers_by_its_name_and_its_unit(tmp_path, inputs, units, steer):
    path = tmp_path / "mine.py"
    path.write_text(FILE.format(inputs=inputs, units=units))
    nominal = compose(ModelSpec(str(path), DT)).nominal
    for name in ("steering_ratio", "steering_offset"):
        assert registry().get("effects", name).channels(nominal) == steer


def test_the_road_wheels_turn_by_their_ratio_and_from_their_offset():
    """Of a car at 1 m/s: w = tan(0.9 delta + 0.03)/L. The offset stands behind the ratio in the list, and acts behind it."""
    x, delta = np.zeros((5, 4)), np.linspace(-0.5, 0.5, 5)
    model = car(("steering_ratio", "steer_cmd", {"ratio": 0.9}), ("steering_offset", "steer_cmd", {"angle": 0.03}))
    x1, _ = model.step(x, np.column_stack([delta, np.ones(5)]), model.at_rest(5))
    assert np.allclose(x1[:, 2], DT * np.tan(0.9 * delta + 0.03) / GEOMETRY["bicycle"]["wheel_base"], rtol=0.0, atol=1e-14)


@pytest.mark.slow
def test_a_trace_gives_the_steering_s_names_with_the_gain_and_the_bias():
    rng = np.random.default_rng(8)
    u = commands(rng, 1, 800, DT, [(-0.5, 0.5), (0.2, 1.5)])
    truth = (("input_gain", "steer_cmd", {"gain": 0.9}), ("input_bias", "steer_cmd", {"bias": 0.03}))
    y = drive(rng, "bicycle", u, truth, DT, np.array([0.001, 0.001, 0.003, 0.01]))
    model = car()
    found = trace(from_arrays(model, [(y[0], u[0])]), model)
    assert found.verdict == "traced"
    assert {(e.name, e.channel) for e in found.effects} == {("input_gain", "steer_cmd"), ("input_bias", "steer_cmd")}
    others = {e["name"]: e["parameters"] for e in found.to_json()["ambiguous_with"] if e["same_thing"]}
    assert set(others) == {"steering_ratio", "steering_offset"}
    assert others["steering_ratio"]["ratio"]["value"] == pytest.approx(0.9, abs=0.005)
    ratio_last = [e.name for e in found.spec.effects].index("input_gain") > [e.name for e in found.spec.effects].index("input_bias")
    assert others["steering_offset"]["angle"]["value"] == pytest.approx(0.03 / 0.9 if ratio_last else 0.03, abs=0.002)
