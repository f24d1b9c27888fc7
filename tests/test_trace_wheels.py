"""Wheels of unequal or wrong radius are traced to the wheels, on a robot simulated without the library."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, commands, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

DT, STEPS = 0.05, 800
NOISE = np.array([0.001, 0.001, 0.003, 0.02, 0.02])
TRACK = {"differential_drive": 0.5, "unicycle": 0.3}
BOUNDS = {"differential_drive": [(-8.0, 8.0)] * 2, "unicycle": [(-0.5, 0.5), (-1.5, 1.5)]}


def traced(name, left, right, seed, track=1.0):
    """The trace of a recording whose wheels have left and right times the model's radius, and track times its track."""
    half = 0.5 * TRACK[name]

    def wheels(x, v, w):
        rolls = left * (v - half * w), right * (v + half * w)
        return 0.5 * (rolls[0] + rolls[1]), (rolls[1] - rolls[0]) / (2.0 * half * track), 0.0, 0.0

    rng = np.random.default_rng(seed)
    u = commands(rng, 1, STEPS, DT, BOUNDS[name])
    model = compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    states = len(model.states)
    y = drive(rng, name, u, (), DT, NOISE[:states], wheels)
    return trace(from_arrays(model, [(y[0], u[0])]), model)


DRIVE = """
import numpy as np
STATES, INPUTS, ANGLES = ("x", "y", "theta"), ("left", "right"), ("theta",)
PARAMS = {params}

def step(x, u, dt, params):
    v, w = 0.05 * (u[:, 0] + u[:, 1]), 0.1 * (u[:, 1] - u[:, 0]) / params["track"]
    half = 0.5 * dt * w
    ahead = dt * v * np.sinc(half / np.pi)
    return np.column_stack([x[:, 0] + ahead * np.cos(x[:, 2] + half), x[:, 1] + ahead * np.sin(x[:, 2] + half), x[:, 2] + dt * w])
"""


def dragged(folder, seed, loss, arm, **castor):
    """The trace of a differential drive with a castor, as a model file without wheel speeds."""

    def drags(x, v, w):
        share = loss / np.maximum(np.hypot(v, arm * w), 1e-12)
        return v * np.maximum(1.0 - share, 0.0), w * np.maximum(1.0 - 4.0 * (arm / 0.5) ** 2 * share, 0.0), 0.0, 0.0

    rng = np.random.default_rng(seed)
    u = commands(rng, 1, STEPS, DT, BOUNDS["differential_drive"])
    y = drive(rng, "differential_drive", u, (), DT, NOISE, drags)
    path = folder / "mine.py"
    path.write_text(DRIVE.format(params={"track": 0.5, **castor}))
    model = compose(ModelSpec(str(path), DT))
    return trace(from_arrays(model, [(y[0, :, :3], u[0])]), model)


def holds(effect, **truth):
    """Whether each true value lies in its interval, widened by half: a 95 % interval of three misses one in seven recordings."""
    ends = {name: effect.parameters[name][:3] for name in truth}
    return all(abs(true - ends[name][0]) <= 1.5 * (ends[name][2] - ends[name][0]) for name, true in truth.items())


@pytest.mark.parametrize(("left", "right"), [(1.02, 0.98), (1.0, 0.96), (0.96, 0.96)])
def test_wheels_that_differ_are_found_on_a_differential_drive(left, right):
    found = traced("differential_drive", left, right, seed=3)
    assert found.verdict == "traced"
    (effect,) = found.effects
    assert effect.name == "wheel_radius_scale"
    assert holds(effect, left=left, right=right)
    (other,) = [e for e in found.to_json()["ambiguous_with"] if e["name"] == "wheel_slip"]
    assert other["same_thing"]
    assert other["parameters"]["right"]["value"] == pytest.approx(1.0 - effect.parameters["right"][0])
    errors = found.to_json()["error"]
    assert all(errors["after"]["rollout_rms"][s] < 1.3 * floor for s, floor in errors["rollout_noise_floor"].items())


def test_wheels_that_differ_are_found_with_their_track_from_a_unicycle_s_commands():
    (effect,) = (found := traced("unicycle", 1.0, 0.96, seed=3)).effects
    assert (found.verdict, effect.name) == ("traced", "wheel_radius_scale")
    assert holds(effect, left=1.0, right=0.96, track=0.3)


@pytest.mark.parametrize(("loss", "arm"), [(0.01, 0.2), (0.03, 0.35)])
def test_a_castor_that_drags_is_found_with_its_place_where_the_model_has_one(tmp_path, loss, arm):
    (effect,) = (found := dragged(tmp_path, 3, loss, arm, castor=0.25)).effects
    assert (found.verdict, effect.name) == ("traced", "castor_drag")
    assert holds(effect, loss=loss, arm=arm)


def test_a_robot_without_a_castor_gets_none():
    """A skid-steered robot loses speed much as by a castor's drag."""
    effect = registry().get("effects", "castor_drag")
    nominal = compose(ModelSpec("differential_drive", DT, GEOMETRY["differential_drive"])).nominal
    assert effect.channels(nominal) == ("*",)
    assert effect.starts(np.ones((9, 2)), nominal, "*", DT) == []


@pytest.mark.slow
def test_radii_and_a_wrong_track_are_ambiguous_with_other_radii_and_a_slip_ahead():
    """The two are the same thing on all data (docs/effects.md)."""
    found = traced("differential_drive", 1.03, 0.99, seed=5, track=1.1)
    assert found.verdict == "ambiguous"
    effects = {e.name: e for e in found.effects}
    assert len(effects) == 2
    other = "longitudinal_slip" if "track_scale" in effects else "track_scale"
    assert {"wheel_radius_scale", "track_scale", "longitudinal_slip"} == {*effects, other}
    assert [e["name"] for e in found.to_json()["ambiguous_with"] if not e["same_thing"]] == [other]
    gain = 1.0 if other == "longitudinal_slip" else 1.0 / 1.1
    assert holds(effects["wheel_radius_scale"], left=1.03 * gain, right=0.99 * gain)
