"""A state that was not measured, and that the motion does not need, is left out: nothing is filtered for it; the model comes back whole."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, INPUTS, commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.data.unmeasured_states import unneeded, without
from s2r_runtime.trace.pipeline import trace

DT = 0.05
BOUNDS = {"bicycle": [(-0.3, 0.3), (0.2, 1.5)], "differential_drive": [(-3.0, 8.0)] * 2}
SPEEDS = {"bicycle": ("speed",), "differential_drive": ("wheel_left", "wheel_right")}
NOISE = {"bicycle": 1e-3, "differential_drive": np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2])}
EXACT = EffectSpec("integration_scheme", "*", {"scheme": "exact"})


def _model(name, *effects):
    return compose(ModelSpec(name, DT, GEOMETRY[name], (EXACT, *effects)))


def _recorded(path, name, effects=(), lacking=None, seed=1, steps=600):
    rng = np.random.default_rng(seed)
    u = commands(rng, 1, steps, DT, BOUNDS[name])
    y = drive(rng, name, u, effects, DT, NOISE[name])[0]
    model = _model(name)
    kept = [j for j, s in enumerate(model.states) if s not in (SPEEDS[name] if lacking is None else lacking)]
    rows = [",".join(["t", *(model.states[j] for j in kept), *INPUTS[name]])]
    rows += [",".join(f"{v:.9g}" for v in (k * DT, *y[k, kept], *u[0, k])) for k in range(steps)]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("bicycle", ("input_lag", "steer_cmd", {"time_constant": 0.15})),
        ("differential_drive", ("input_gain", "cmd_left", {"gain": 0.8})),
    ],
)
def test_an_effect_is_found_from_the_pose_alone_without_a_filter(tmp_path, name, effect):
    model, data = _model(name), load_dataset(_recorded(tmp_path / "run.csv", name, [effect]), _model(name))
    assert data.reconstruction is None
    assert data.states == ("x", "y", "theta")
    found = trace(data, model)
    assert [(e.name, e.channel) for e in found.effects] == [effect[:2]]
    ((value, true),) = zip((v[0] for v in found.effects[0].parameters.values()), effect[2].values(), strict=True)
    assert value == pytest.approx(true, rel=0.05)
    assert found.to_json()["unmeasured"] == list(SPEEDS[name])
    assert found.to_json()["step_s"] == DT
    assert "not measured, and not needed" in found.text()
    assert compose(found.spec).states == model.states  # the model that is handed on has all of them


@pytest.mark.parametrize("name", SPEEDS)
def test_nothing_is_found_where_nothing_is(tmp_path, name):
    data = load_dataset(_recorded(tmp_path / "run.csv", name, seed=2), _model(name))
    assert trace(data, _model(name)).verdict == "none"


def test_another_recording_that_has_the_speeds_judges_without_them(tmp_path):
    name = "differential_drive"
    gain = [("input_gain", "cmd_left", {"gain": 0.8})]
    seen = load_dataset(_recorded(tmp_path / "a.csv", name, gain), _model(name))
    judge = load_dataset(_recorded(tmp_path / "b.csv", name, gain, lacking=(), seed=3), _model(name))
    found = trace(seen, _model(name), test=judge, weights=(1.0, 1.0, 0.25, 0.0, 0.0))
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "cmd_left")]
    assert set(found.to_json()["error"]["after"]["one_step_rms"]) == {"x", "y", "theta"}
    assert found.to_json()["gap"]["after"]["radius"] < found.to_json()["gap"]["before"]["radius"]


def test_what_the_motion_needs_is_not_left_out(tmp_path):
    name = "differential_drive"
    assert unneeded(_model(name), SPEEDS[name]) == SPEEDS[name]
    assert unneeded(_model("bicycle", EffectSpec("viscous_friction", "speed", {"coefficient": 0.1})), ("speed",)) == ()
    assert unneeded(compose(ModelSpec("joint", DT)), ("qd",)) == ()
    assert unneeded(_model(name), ("theta",)) == ()


@pytest.mark.parametrize("name", SPEEDS)
def test_the_model_of_the_rest_moves_as_the_whole_one_does(name):
    rng = np.random.default_rng(4)
    whole = _model(
        name, EffectSpec("lateral_slip", "*", {"coefficient": 0.05}), EffectSpec("input_lag", INPUTS[name][0], {"time_constant": 0.1})
    )
    less = without(whole, SPEEDS[name])
    x, u = rng.normal(size=(40, len(whole.states))), rng.normal(size=(40, 2))
    z, z_less = whole.at_rest(40), less.at_rest(40)
    y = x[:, :3].copy()
    for _ in range(5):
        x, z = whole.step(x, u, z)
        y, z_less = less.step(y, u, z_less)
    assert np.allclose(x[:, :3], y, rtol=0.0, atol=1e-12)
